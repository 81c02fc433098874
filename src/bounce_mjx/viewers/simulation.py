"""Episodes as NumPy frames: stepped live for a viewer, or recorded."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bounce_mjx.env.env import Env, EnvState, State
from bounce_mjx.learning.policy import Actor, Policy
from bounce_mjx.viewers.world import WorldSlider, sliders_for
from bounce_mjx.world.randomization import TERMS, Ranges, World

_PICTURES_PER_SECOND = 50.0
# If a simulation falls behind the clock by more than this, it slows down instead of catching up, s.
_MAX_LAG = 0.1
_RECORDED_SECONDS = 10.0

Controller = Callable[[Policy | None, State, jax.Array], jax.Array]
"""A controller of N environments: (policy, if it has one; states, batch last; key, which is
consumed) -> actions [n, N]."""


def make_policy_controller(actor: Actor) -> Controller:
    """The policy's most likely action."""
    return lambda policy, states, key: actor.act(policy, states.obs.T).T


def make_random_controller(env: Env) -> Controller:
    """Uniform in [-1, 1]."""
    return lambda _, states, key: jax.random.uniform(
        key, (env.action_size, states.obs.shape[-1]), minval=-1.0, maxval=1.0
    )


def make_zero_controller(env: Env) -> Controller:
    """Zero: the servos hold the measured angles."""
    return lambda _, states, key: jnp.zeros((env.action_size, states.obs.shape[-1]))


class EnvFrame(NamedTuple):
    """N environments after a control step; a recording has a leading axis of T frames."""

    time: np.ndarray
    """Time since the episode's reset [N], s."""
    qpos: np.ndarray
    """Generalised positions [N, nq], in MuJoCo's order."""
    balls: np.ndarray
    """Centre of each ball [N, B, 3], m."""
    paddle: np.ndarray
    """The paddle's centre [N, 3], m."""
    goal: dict[str, np.ndarray]
    """Goals [N]."""
    metrics: dict[str, np.ndarray]
    """Metrics of the step [N], among them the weighted reward terms `reward/<term>`."""
    over: np.ndarray
    """Whether the episode ended or timed out on this step [N]; the next frame then starts a new
    episode."""
    lost: np.ndarray
    """Whether the episode ended on this step [N] before its time limit: the ball was lost, an arm
    joint was too fast, or what else ends an episode."""


def at_index(values: dict[str, np.ndarray], index: int) -> dict[str, float]:
    """Goals or metrics [N] of one environment, each a number."""
    return {name: float(value[index]) for name, value in values.items()}


def environment_pose(
    frame: EnvFrame, index: int
) -> tuple[np.ndarray, dict[str, float], dict[str, float]]:
    """The positions [nq], the goals and the metrics of one environment of a frame."""
    goal, metrics = (at_index(x, index) for x in (frame.goal, frame.metrics))
    return frame.qpos[index], goal, metrics


def frame_readings(env: Env, frame: EnvFrame, index: int = 0) -> dict[str, str]:
    """The task's readings of one environment of a frame."""
    return env.task.readings(at_index(frame.goal, index), at_index(frame.metrics, index))


def frame_at(recording: EnvFrame, i: int) -> EnvFrame:
    """One frame of a recording."""
    return jax.tree.map(lambda values: values[i], recording)


class Simulation:
    """N environments under a controller; an environment is reset when its episode ends."""

    is_film = False
    """Whether it plays an episode that nothing can change."""

    def __init__(
        self,
        env: Env,
        controller: Controller,
        num_envs: int,
        seed: int,
        ranges: Ranges | None = None,
        policy: Policy | None = None,
    ):
        """Compiles the programs, which takes seconds, and resets all environments.

        Args:
          ranges: from which the resets sample the worlds, see `Env.reset`.
          policy: the first value of `policy`.
        """
        self.env = env
        self.policy = policy
        """The policy that acts; another one of the same shapes may replace it between two steps."""
        self.goal: dict[str, float] = {}
        """Goals of all environments that are set; the others are sampled."""
        self.world: dict[str, Sequence[float]] | None = None
        """Entries of terms of the world that are set in all environments; those that are not named
        are nominal. None for a world sampled at each reset. `world_value` tells what holds."""
        self.others: Sequence[Simulation] = ()
        """Simulations of the same robot that are shown with this one, after its environments, and
        have its goals and its world."""
        self._controller = controller
        self._ranges = ranges
        self._key = jax.random.PRNGKey(seed)
        self._push = np.zeros(3, np.float32)
        self._steps = np.zeros(num_envs, np.int32)
        shapes = jax.eval_shape(self._fresh_states, self._key)
        self._states = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)
        over = np.ones(num_envs, bool)
        restart = jax.jit(self._restart).lower(self._key, self._states, self._steps, over)
        advance = jax.jit(self._advance).lower(*self._inputs())
        # Together, as one compilation does not keep two cores busy.
        with ThreadPoolExecutor() as pool:
            compiled = pool.map(lambda program: program.compile(), (restart, advance))
            self._reset_program, self._step_program = compiled
        self.reset()

    @property
    def num_envs(self) -> int:
        """Number of environments, with those of the others."""
        return len(self._steps) + sum(other.num_envs for other in self.others)

    @property
    def frame(self) -> EnvFrame:
        """The current frame, which already shows the goals that the next step sets."""
        frame = self._frame
        if self.others:
            frame = _side_by_side([frame, *(other.frame for other in self.others)])
        given = {name: np.full_like(frame.goal[name], x) for name, x in self.goal.items()}
        return frame._replace(goal=frame.goal | given)

    @property
    def sliders(self) -> tuple[WorldSlider, ...]:
        """Sliders of the terms that can be moved."""
        return sliders_for(self.env.config)

    def world_value(self, term: str) -> float:
        """The first entry of a term of the world in the first environment."""
        return float(np.ravel(self._states.pipeline_state.world[term][..., 0])[0])

    def reset(self) -> None:
        """Starts a new episode in every environment."""
        self._frame = self._reset(np.ones(len(self._steps), bool))
        for other in self.others:
            other.reset()

    def push(self, velocity: tuple[float, float, float]) -> None:
        """Adds a velocity (m/s) to every ball at the start of the next step; to be called between
        two steps."""
        self._push = self._push + np.asarray(velocity, np.float32)

    def step(self) -> EnvFrame:
        """Advances one control step."""
        for other in self.others:
            other.goal = self.goal
            other.world = self.world
            other.push(self._push)
            other.step()
        inputs = self._inputs()
        self._push = np.zeros(3, np.float32)
        self._key, self._states, self._steps, frame = self._step_program(*inputs)
        self._frame = jax.device_get(frame)
        # The last frame of an episode stays until the next step.
        if self._frame.over.any():
            self._reset(self._frame.over)
        return self.frame

    def record(self, seconds: float | None = None) -> EnvFrame:
        """The current frame and the frames of the following seconds, 10 by default."""
        seconds = _RECORDED_SECONDS if seconds is None else seconds
        frames = [self.frame]
        frames += [self.step() for _ in range(round(seconds / self.env.dt))]
        return jax.tree.map(lambda *values: np.stack(values), *frames)

    def _inputs(self) -> tuple:
        """Arguments of the program of a step."""
        config = self.env.config
        goal = {name: np.float32(self.goal.get(name, np.nan)) for name in config.goals}
        world = {}
        for name in config.randomization.terms:
            # A term without a nominal value stays sampled.
            if name in self.env.nominals:
                shape = TERMS[name].shape(self.env.action_size)
                entries = self._entries(name)
                # A number has the shape (), and its entries may be a tuple of one.
                world[name] = np.full(shape or 1, entries, np.float32).reshape(shape)
        return self.policy, self._key, self._states, self._steps, goal, self._push, world

    def _entries(self, term: str) -> np.ndarray | Sequence[float] | float:
        """Entries of a term of the world that are set; nan where it is sampled."""
        if self.world is None:
            return np.nan
        return self.world.get(term, self.env.nominals[term])

    def _reset(self, over: np.ndarray) -> EnvFrame:
        """Starts a new episode in some environments [N]; the frame of all."""
        self._key, key = jax.random.split(self._key)
        self._states, self._steps, frame = self._reset_program(key, self._states, self._steps, over)
        return jax.device_get(frame)

    def _fresh_states(self, key: jax.Array) -> State:
        return jax.vmap(lambda key: self.env.reset(key, self._ranges), out_axes=-1)(
            jax.random.split(key, len(self._steps))
        )

    def _restart(self, key, states, steps, over):
        fresh = self._fresh_states(key)
        states = jax.tree.map(lambda new, old: jnp.where(over, new, old), fresh, states)
        steps = jnp.where(over, 0, steps)
        return states, steps, _view(self.env, states, steps, jnp.zeros_like(over))

    def _advance(self, policy, key, states, steps, goal, push, world):
        key, action_key = jax.random.split(key)
        states = _change(self.env, states, goal, push, world)
        actions = self._controller(policy, states, action_key)
        after = jax.vmap(self.env.step, in_axes=-1, out_axes=-1)(states, actions)
        steps = steps + 1
        over = (after.done > 0) | (steps >= self.env.config.episode_steps)
        return key, after, steps, _view(self.env, after, steps, over)


def _side_by_side(frames: Sequence[EnvFrame]) -> EnvFrame:
    """The environments of several frames in one, with the metrics that all of them have, because
    each world has its own."""
    shared = set.intersection(*(set(frame.metrics) for frame in frames))
    frames = [f._replace(metrics={name: f.metrics[name] for name in shared}) for f in frames]
    return jax.tree.map(lambda *values: np.concatenate(values), *frames)


def in_real_time(
    simulation: Simulation, seconds: float | None, speed: Callable[[], float] = lambda: 1.0
) -> Iterator[list[EnvFrame]]:
    """Steps a simulation with the clock, and yields for each picture the frames since the last one.

    Args:
      seconds: simulated time; None for no end.
      speed: the present factor of real time; 0 is a pause.
    """
    dt = simulation.env.dt
    left = float("inf") if seconds is None else round(seconds / dt)
    owed = 0.0
    last = time.monotonic()
    while left > 0:
        now = time.monotonic()
        owed += speed() * min(now - last, _MAX_LAG) / dt
        due = min(int(owed), left)
        owed -= due
        left -= due
        last = now
        yield [simulation.step() for _ in range(due)]
        time.sleep(1.0 / _PICTURES_PER_SECOND)


def resample(recording: EnvFrame, dt: float, fps: float) -> EnvFrame:
    """A recording [T, N, ...] at another rate.

    Positions are interpolated in time, but not across a reset; `over` and `lost` tell what came
    since the frame before; other values come from the last control step.

    Args:
      dt: time between the frames of the recording, s.
      fps: desired frames per second.

    Returns:
      The frames at 0, 1/fps, 2/fps, ... s up to the last one of the recording: [F, N, ...].
    """
    last = len(recording.time) - 1
    num_frames = 1 + math.ceil(last * dt * fps - 1e-6)
    steps = np.minimum(np.arange(num_frames) / (fps * dt), last)
    # Rounding may leave a picture at the time of a frame just before it.
    before = (steps + 1e-6).astype(int)
    after = np.minimum(before + 1, last)
    fraction = (steps - before)[:, None] * ~recording.over[before]
    frames = jax.tree.map(lambda values: values[before], recording)

    def blend(values: np.ndarray) -> np.ndarray:
        # Transposed, a share for each frame and environment fits values of any further axes.
        return (values[before].T + fraction.T * (values[after] - values[before]).T).T

    def happened(values: np.ndarray) -> np.ndarray:
        counts = np.cumsum(values, axis=0)[before]
        return values[before] | (np.diff(counts, axis=0, prepend=0) > 0)

    moving = "time", "qpos", "balls", "paddle"
    blended = {name: blend(getattr(recording, name)) for name in moving}
    return frames._replace(**blended, over=happened(recording.over), lost=happened(recording.lost))


def _change(env: Env, states: State, goal: World, push: jax.Array, world: World) -> State:
    """States [..., N] with what a user changes.

    Args:
      goal: goals; nan keeps one.
      push: velocity that is added to the ball's [3], m/s.
      world: terms of the world that have a nominal value; nan keeps an entry.
    """
    before = states.pipeline_state
    qvel = before.physics.qvel
    for ball in env.addresses.balls:
        qvel = qvel.at[jnp.array(ball.qvel[:3])].add(push[:, None])
    changed = before._replace(
        physics=before.physics._replace(qvel=qvel),
        goal=_replace_given(goal, before.goal),
    )

    def with_world(state: EnvState) -> EnvState:
        return env.with_world(state, _replace_given(world, state.world))

    if world:
        changed = jax.vmap(with_world, in_axes=-1, out_axes=-1)(changed)
    observation = jax.vmap(env.observe, in_axes=-1, out_axes=-1)(changed)
    return states.replace(pipeline_state=changed, obs=observation)


def _replace_given(given: World, sampled: World) -> World:
    """Sampled values by name, some of which are replaced; nan replaces none."""
    return sampled | {
        name: jnp.where(jnp.isnan(value), sampled[name], value) for name, value in given.items()
    }


def _view(env: Env, states: State, steps: jax.Array, over: jax.Array) -> EnvFrame:
    """The frame of states (batch last) `steps` control steps after their resets."""
    now = states.pipeline_state
    kinematics = jax.vmap(env.kinematics, in_axes=-1, out_axes=-1)(now)
    places = [ball.qpos[:3] for ball in env.addresses.balls]
    return EnvFrame(
        time=steps * env.dt,
        qpos=now.physics.qpos.T,
        balls=jnp.moveaxis(now.physics.qpos[jnp.array(places)], -1, 0),
        paddle=kinematics.paddle_position.T,
        goal=now.goal,
        metrics=states.metrics,
        over=over,
        lost=over & (states.done > 0),
    )
