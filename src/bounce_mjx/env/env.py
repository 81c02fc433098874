"""`Env`: one environment, which is a world and a task. It and `State` match brax's by structure."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.env.checks import (
    check_has_task,
    check_joint_angles,
    check_start,
    check_starts,
    check_task,
)
from bounce_mjx.env.contract import ENDS, CheckedTask, Outline
from bounce_mjx.env.ranges import check_ranges, within_queues
from bounce_mjx.errors import UserError
from bounce_mjx.physics import Control, PhysicsParameters, PhysicsState
from bounce_mjx.physics.engine import Engine, make_engine
from bounce_mjx.physics.parameters import MODEL_PARAMETERS
from bounce_mjx.robot import model as robot_model
from bounce_mjx.task.task import Start, Step, Task, TaskStep
from bounce_mjx.world import noise
from bounce_mjx.world.actuation import ActuationMemory, Actuators
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.model import world_model
from bounce_mjx.world.noise import Clock
from bounce_mjx.world.observation import Kinematics
from bounce_mjx.world.randomization import TERMS, Ranges, World
from bounce_mjx.world.sampling import (
    check_contacts,
    check_overlap,
    nominal_values,
    physics_parameters,
    sample_world,
)
from bounce_mjx.world.sensing import Instant, Sensing, Sensors

# MuJoCo's mjMAXVAL: a coordinate beyond it has diverged and counts as non-finite.
_MAX_COORDINATE = 1e10
# What a critic may see beside noisy measurements. Without the ball's quaternion: the orientation of
# a sphere tells nothing.
_TRUE_QUANTITIES = (
    "joint_angles",
    "ball_position",
    "joint_velocities",
    "ball_velocity",
    "ball_angular_velocity",
    "paddle_position",
)


class Redraw(NamedTuple):
    """What later samples of the goals within an episode need, and the age of the last one."""

    age: jax.Array
    """Time since the goals were sampled [], s (an evaluation's `Moment.goal_seconds`)."""
    ranges: dict[str, tuple[jax.Array, jax.Array]]
    """The range of each goal."""


class ResetDraws(NamedTuple):
    """Uniform random numbers of a reset: from -1 to 1 for the noise, from 0 to 1 for the others."""

    joint_angles: jax.Array
    """Noise of each joint angle [n]."""
    joint_velocities: jax.Array
    """Noise of each joint velocity [n]."""
    ball_positions: jax.Array
    """Noise of each ball's coordinates [B, 3]."""
    goals: jax.Array
    """Place of each goal within its range [number of goals]."""
    task: jax.Array
    """The task's own numbers [num_draws]."""


class EnvState(NamedTuple):
    """The whole state of one environment, `State.pipeline_state`."""

    physics: PhysicsState
    goal: dict[str, jax.Array]
    """Value [] of each goal."""
    last_action: jax.Array
    """Clipped action of the step that led here [n], a task's `Step.action`; zero after a reset."""
    task: Any = ()
    """What the task keeps of the episode."""
    parameters: PhysicsParameters = PhysicsParameters()
    """The physics of the next step."""
    world: World = {}
    """The values that the reset sampled for the active randomisation terms."""
    clock: Clock | None = None
    """For a randomised world, or where there is `sensing`."""
    redraw: Redraw | None = None
    """For goals that are sampled again within an episode."""
    actuation: ActuationMemory = ActuationMemory()
    steps: jax.Array | None = None
    """Control steps since the reset [], int32, for a task whose step reads the time."""
    sensing: Sensing | None = None
    """For an observation that differs from the true state of one instant."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """A pytree with the fields of brax's `State`, so that brax's wrappers work on it."""

    pipeline_state: Any
    """Everything that the next step depends on."""
    obs: jax.Array
    """Observation [observation_size]."""
    reward: jax.Array
    """Reward of the last step []."""
    done: jax.Array
    """1 where the last step ended the episode, else 0 []."""
    metrics: dict[str, jax.Array] = dataclasses.field(default_factory=dict)
    """Named numbers of the last step, each []."""
    info: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Data of wrappers, which the environment passes on unchanged."""

    def replace(self, **changes: Any) -> "State":
        """A copy with other values of the named fields."""
        return dataclasses.replace(self, **changes)


class Env:
    """One environment, unbatched and pure: apply `jax.vmap` and `jax.jit` to `reset` and `step`.

    It has the interface of brax's `Env` by structure. `done` is 1 where the episode terminated;
    the time limit is that of `env.vector.step`, or of another library's wrapper.
    """

    def __init__(
        self,
        config: WorldConfig,
        randomize: Callable[[jax.Array], PhysicsParameters] | None = None,
    ):
        """Compiles the model and chooses the physics engine.

        Args:
          randomize: key -> the physics parameters of one episode, which each reset samples; None
            for the model's own.

        Raises:
          UserError: the config has no task, or its task, start or terms, the MJCF file or the
            engine do not fit it.
        """
        check_has_task(config)
        self.config = config
        self.task: Task = config.task(config)
        check_task(config, self.task)
        self.mj_model: mujoco.MjModel = world_model(config)
        self.addresses = robot_model.find_addresses(self.mj_model)
        self.engine: Engine = make_engine(self.mj_model, config.physics, self.addresses)
        self.layout = config.layout
        check_joint_angles(config, self.mj_model, self.addresses)
        check_contacts(self.mj_model, config.randomization.terms, self.addresses)
        self.task.geometry = robot_model.read_geometry(
            self.mj_model, self.addresses, config.default_joint_angles
        )
        check_start(config, self.task)
        check_starts(config, self.mj_model, self.addresses, self.task)
        self._actuators = Actuators(config, self.mj_model, self.addresses)
        self._checked_task = CheckedTask(self.task, config)
        self._sensors = Sensors(
            config, self.mj_model, self.addresses, self.engine, self._checked_task
        )
        self._randomize = randomize
        if randomize is not None:
            terms = config.randomization.terms
            check_overlap(self.mj_model, self.addresses, terms, randomize)
        self.nominals = nominal_values(self.mj_model, config.randomization.terms, self.addresses)
        """Values of the terms of the randomisation in an episode that does not sample them."""
        self._fingerprint = robot_model.fingerprint(self.mj_model)
        self.dt = config.control_dt
        """Time of one control step, s."""
        self.observation_size = self.layout.size
        """Length of the observation vector."""
        self.action_size = config.num_joints
        """Length of the action vector."""
        self.backend = self.engine.name
        """Name of the physics engine."""
        self.warmup_steps = config.randomization.warmup_steps
        """Environment steps of a training run over which the ranges grow (`ranges`)."""

    def __reduce__(self) -> tuple:
        """Pickled as its settings; a copy is built again."""
        return type(self), (self.config, self._randomize)

    @property
    def is_of_its_settings(self) -> bool:
        """Whether the settings alone decide what it does: nothing else samples its physics."""
        return self._randomize is None

    @property
    def unwrapped(self) -> "Env":
        """The environment itself, as there is no wrapper around it."""
        return self

    def ranges(self, progress: jax.Array | float = 1.0) -> Ranges:
        """The ranges of the randomisation, and of the goals where they grow too; `progress` []
        is the share of the warm-up that has passed."""
        ranges = self.config.randomization.ranges(progress, self.nominals)
        first = self.config.randomization.first_goal_range
        if first == 1.0:
            return ranges
        for name, goal in self.config.goals.items():
            middle = (goal.low + goal.high) / 2.0
            half = (goal.high - goal.low) / 2.0
            half *= first + (1.0 - first) * progress
            low = jnp.asarray(middle - half, jnp.float32)
            high = jnp.asarray(middle + half, jnp.float32)
            ranges[name] = (low, high)
        return ranges

    def reset(
        self, rng: jax.Array, ranges: Ranges | None = None, share: float | None = None
    ) -> State:
        """Starts an episode, with its own world, clock (`noise.first_clock`), goals and start.

        Args:
          rng: key; consumed.
          ranges: ranges for all active terms and, if they differ from the config's, for goals;
            by default, the config's. The queues of delayed actions and pictures are only as long as
            the config's ranges need: longer delays are refused or, of traced ends, cut to them,
            in the world too.
          share: probability that each term is sampled, in place of the config's `share` and
            `shares`.

        Raises:
          UserError: the ranges are none of the environment's (`ranges.check_ranges`), or with them
            the arm or the ball cannot start; the task's code returns wrong names, or arrays where
            one number is expected; the model lacks what a term changes, or was edited; or the
            engine does not support what a term changes.
        """
        robot_model.check_unedited(self.mj_model, self._fingerprint)
        are_given = ranges is not None
        if are_given:
            self._check_ranges(ranges)
        else:
            ranges = self.ranges()
        rng, world, clock = self._sample_world(rng, ranges, share)
        if are_given:
            world = within_queues(self.config.randomization, world)
        rng, randomized = self._sample_parameters(rng)
        parameters = physics_parameters(world, self.mj_model)._replace(**_given(randomized))
        draws = self._draw(rng)

        goal_ranges = self._goal_ranges(ranges)
        sampled = sample_goals(goal_ranges, draws.goals)
        thrown = self._checked_task.throw(draws.task, sampled)
        physics = self._first_physics(draws, world, thrown)
        truth = self._kinematics(physics, parameters)
        first_goal = self._checked_task.first_goal(sampled)
        task = self._checked_task.reset(Start(truth, first_goal, draws.task))
        goal = self._checked_task.next_goal(task, first_goal)

        state = EnvState(
            physics=physics,
            goal=goal,
            last_action=jnp.zeros(self.action_size, physics.qpos.dtype),
            task=task,
            parameters=parameters,
            world=world,
            clock=clock,
            redraw=self._first_redraw(world, goal_ranges, physics.qpos.dtype),
            actuation=self._actuators.first(physics.qpos),
        )
        if self._sensors.are_needed:
            state = state._replace(sensing=self._sensors.first(_instant(state, truth)))
        outline = self._outline(state, truth)
        if outline.reads_time:
            state = state._replace(steps=jnp.zeros((), jnp.int32))
        return State(
            pipeline_state=state,
            obs=self.observe(state, truth),
            reward=jnp.zeros((), physics.qpos.dtype),
            done=jnp.zeros((), physics.qpos.dtype),
            metrics=self._first_metrics(state, truth, outline),
        )

    def step(self, state: State, action: jax.Array) -> State:
        """Advances one control step under the action [n], clipped to [-1, 1]. A NaN action ends the
        episode and acts as 0.

        The action becomes the servos' targets, which latency and lag delay (`Actuators.next`); the
        physics takes its steps; the task judges the true state under the goal that the policy
        has seen; then goals change, the clock moves on, and the sensors measure.

        Raises:
          UserError: the action has another shape, which NumPy's rules would spread over the joints.
        """
        if jnp.shape(action) != (self.action_size,):
            raise UserError(
                f"the action has the shape {jnp.shape(action)}; give {(self.action_size,)} for one "
                "environment, and batch environments with jax.vmap"
            )
        robot_model.check_unedited(self.mj_model, self._fingerprint)
        before = state.pipeline_state
        control, actuation = self.control(before, action)
        num_substeps = self.config.num_substeps
        physics = self.engine.step(before.parameters, before.physics, control, num_substeps)
        return self.finish_step(state, action, actuation, physics)

    def control(self, before: EnvState, action: jax.Array) -> tuple[Control, ActuationMemory]:
        """The part of a step before the physics: the inputs of the physics under the action [n] of
        `step`, late by the world's latency and lag, and the memory of the actuation after the
        step."""
        action, _ = _clip_action(action)
        return self._actuators.next(
            before.actuation, before.physics.qpos, action, before.world, before.clock
        )

    def finish_step(
        self, state: State, action: jax.Array, actuation: ActuationMemory, physics: PhysicsState
    ) -> State:
        """The part of a step after the physics: the task's, and the observation.

        A non-finite physics state ends the episode and is replaced by the previous one, so that
        nothing non-finite leaves the environment. A NaN action ends it too.

        Args:
          state: before the step.
          action: [n], as `step` takes it.
          actuation: from `control`.
          physics: after the step, from any engine.
        """
        before = state.pipeline_state
        physics, finite = _keep_finite(physics, before.physics)
        action, is_number = _clip_action(action)
        # The physics is then that before the step, and so is the action.
        action = jnp.where(finite, action, before.last_action)
        after = before._replace(physics=physics, last_action=action, actuation=actuation)
        truth = self.kinematics(after)

        if before.steps is not None:
            after = after._replace(steps=before.steps + 1)
        task_step = Step(
            truth=truth,
            goal=before.goal,
            action=action,
            last_action=before.last_action,
            ball_radius=before.parameters.ball_radius,
            seconds=0.0 if after.steps is None else after.steps * self.dt,
        )
        result = self.task.step(before.task, task_step)
        ends = {
            "non_finite": ~(finite & is_number),
            "too_fast": jnp.any(jnp.abs(truth.joint_velocities) > self.config.max_joint_velocity),
        }

        after = self._redraw_goals(after)
        # The reset has compared what it returns.
        goal = self.task.next_goal(result.state, after.goal)
        after = after._replace(task=result.state, goal=goal)
        if after.clock is not None:
            after = after._replace(clock=noise.next_clock(after.clock))
        if after.sensing is not None:
            sensing = self._sensors.next(after.sensing, _instant(after, truth))
            after = after._replace(sensing=sensing)

        dtype = truth.ball_position.dtype
        metrics = _metrics(result, dtype)
        metrics |= {name: end.astype(dtype) for name, end in ends.items()}
        metrics |= self._privileged_metrics(after.world, truth)
        ended = result.ended | ends["non_finite"] | ends["too_fast"]
        return state.replace(
            pipeline_state=after,
            obs=self.observe(after, truth),
            reward=sum(result.reward.values()),
            done=ended.astype(dtype),
            # Wrappers add their own metrics, which a step must keep.
            metrics=state.metrics | metrics,
        )

    def _check_ranges(self, ranges: Ranges) -> None:
        """Refuses ranges that the environment cannot act on, and starts that it cannot have."""
        randomization = check_ranges(self.config, ranges, self.nominals)
        config = self.config.model_copy(update={"randomization": randomization})
        check_starts(config, self.mj_model, self.addresses, self.task)

    def _sample_world(
        self, rng: jax.Array, ranges: Ranges, share: float | None
    ) -> tuple[jax.Array, World, Clock | None]:
        """An unused key, the world of an episode, and its clock; the arguments are those of
        `reset`."""
        term_ranges = {name: ends for name, ends in ranges.items() if name in TERMS}
        if not (term_ranges or self._sensors.are_needed):
            return rng, {}, None
        dtype = jnp.result_type(float)
        rng, world_rng, clock_rng = jax.random.split(rng, 3)
        shares = {}
        if share is None:
            share = self.config.randomization.share
            shares = self.config.randomization.shares or {}
        world = sample_world(
            term_ranges, world_rng, dtype, self.action_size, self.nominals, share, shares
        )
        return rng, world, noise.first_clock(clock_rng, dtype)

    def _sample_parameters(self, rng: jax.Array) -> tuple[jax.Array, PhysicsParameters]:
        """An unused key, and the parameters that `randomize` samples."""
        if self._randomize is None:
            return rng, MODEL_PARAMETERS
        rng, parameters_rng = jax.random.split(rng)
        return rng, self._randomize(parameters_rng)

    def _draw(self, rng: jax.Array) -> ResetDraws:
        """The random numbers of a reset; consumes the key."""
        num_joints = self.action_size
        num_balls = self.config.num_balls
        num_noises = 2 * num_joints + 3 * num_balls
        num_goals = len(self.config.goals)
        # One sample for all numbers: splitting keys for several would cost more than they do.
        count = num_noises + num_goals + self.task.num_draws
        draws = jax.random.uniform(rng, (count,), minval=-1.0, maxval=1.0)
        noises, goals, task = jnp.split(draws, [num_noises, num_noises + num_goals])
        return ResetDraws(
            joint_angles=noises[:num_joints],
            joint_velocities=noises[num_joints : 2 * num_joints],
            ball_positions=noises[2 * num_joints :].reshape(num_balls, 3),
            goals=0.5 * (goals + 1.0),
            task=0.5 * (task + 1.0),
        )

    def _first_physics(
        self, draws: ResetDraws, world: World, thrown: tuple[jax.Array, jax.Array] | None
    ) -> PhysicsState:
        """The arm and the balls at a reset.

        Args:
          thrown: the task's position and velocity of the ball [3], or of the balls [B, 3]; None for
            balls at rest at `ball_init_pos` and above it.
        """
        dtype = draws.joint_angles.dtype
        num_balls = self.config.num_balls
        noise_widths = self.config.reset
        scatter = robot_model.scatter

        joint_angles = jnp.asarray(self.config.default_joint_angles, dtype)
        joint_angles = joint_angles + noise_widths.joint_angles * draws.joint_angles
        joint_angles = joint_angles + world.get("joint_start", 0.0)
        joint_velocities = noise_widths.joint_velocities * draws.joint_velocities
        qpos = scatter(self.mj_model.qpos0, self.addresses.arm_qpos, joint_angles)
        qvel = scatter(np.zeros(self.mj_model.nv), self.addresses.arm_qvel, joint_velocities)

        if thrown is None:
            above = robot_model.balls_above(self.config.ball_init_pos, num_balls)
            thrown = (above, np.zeros((num_balls, 3)))
        thrown_positions, thrown_velocities = thrown
        positions = jnp.asarray(thrown_positions, dtype).reshape(num_balls, 3)
        velocities = jnp.asarray(thrown_velocities, dtype).reshape(num_balls, 3)
        positions = positions + noise_widths.ball_position * draws.ball_positions
        positions = positions + world.get("ball_start", 0.0)
        level = jnp.array([1.0, 0.0, 0.0, 0.0], dtype)
        for i, ball in enumerate(self.addresses.balls):
            qpos = scatter(qpos, ball.qpos, jnp.concatenate([positions[i], level]))
            qvel = scatter(qvel, ball.qvel[:3], velocities[i])
        return PhysicsState(qpos, qvel)

    def _goal_ranges(self, ranges: Ranges) -> Ranges:
        """The range of each goal: one of `ranges`, or the config's."""
        return {
            name: ranges.get(name, (goal.low, goal.high))
            for name, goal in self.config.goals.items()
        }

    def _first_redraw(self, world: World, ranges: Ranges, dtype: jnp.dtype) -> Redraw | None:
        """What later samples of the goals need; None if they are not sampled again."""
        if "goal_interval" not in world:
            return None
        goal_ranges = {}
        for name, (low, high) in ranges.items():
            goal_ranges[name] = (jnp.asarray(low, dtype), jnp.asarray(high, dtype))
        return Redraw(age=jnp.zeros((), dtype), ranges=goal_ranges)

    def _redraw_goals(self, state: EnvState) -> EnvState:
        """The state with new goals after a control step in which their interval passes; its
        clock is still that of the step."""
        if state.redraw is None:
            return state
        age, ranges = state.redraw
        clock = state.clock
        is_due = noise.is_due(state.world["goal_interval"], clock.goal_phase, clock.step, self.dt)
        # At the reset, the clock's counter has given the phases from this stream.
        counter = noise.next_counter(clock.counter)
        draws = noise.uniform(counter, noise.GOAL, (len(ranges),), age.dtype)
        # JAX has sorted the keys of the state's dictionary.
        in_order = {name: ranges[name] for name in self.config.goals}
        new_goal = self.task.first_goal(sample_goals(in_order, draws))
        goal = {}
        for name, last_value in state.goal.items():
            goal[name] = jnp.where(is_due, new_goal[name], last_value)
        redraw = Redraw(age=jnp.where(is_due, 0.0, age + self.dt), ranges=ranges)
        return state._replace(goal=goal, redraw=redraw)

    def _outline(self, state: EnvState, truth: Kinematics) -> Outline:
        """What the task's step returns, traced from the state of a reset."""
        step = Step(
            truth=truth,
            goal=state.goal,
            action=state.last_action,
            last_action=state.last_action,
        )
        own = [*ENDS, *self._privileged_metrics(state.world, truth)]
        return self._checked_task.outline(state.task, step, own)

    def _first_metrics(
        self, state: EnvState, truth: Kinematics, outline: Outline
    ) -> dict[str, jax.Array]:
        """The metrics of a reset, which are zero except for the privileged ones."""
        zero = jnp.zeros((), truth.joint_angles.dtype)
        metrics = dict.fromkeys([*outline.metrics, *ENDS], zero)
        return metrics | self._privileged_metrics(state.world, truth)

    def kinematics(self, state: EnvState) -> Kinematics:
        """True positions and velocities of one environment's state, read from its physics."""
        return self._kinematics(state.physics, state.parameters)

    def _kinematics(self, physics: PhysicsState, parameters: PhysicsParameters) -> Kinematics:
        """The `kinematics` of a state with this physics."""
        addresses = self.addresses
        qpos = physics.qpos
        qvel = physics.qvel

        ball_qpos = []
        ball_qvel = []
        for ball in addresses.balls:
            ball_qpos.append(ball.qpos)
            ball_qvel.append(ball.qvel)

        return Kinematics(
            joint_angles=_entries(qpos, addresses.arm_qpos),
            ball_position=_ball_rows(qpos, ball_qpos, slice(0, 3)),
            ball_quaternion=_ball_rows(qpos, ball_qpos, slice(3, 7)),
            joint_velocities=_entries(qvel, addresses.arm_qvel),
            ball_velocity=_ball_rows(qvel, ball_qvel, slice(0, 3)),
            ball_angular_velocity=_ball_rows(qvel, ball_qvel, slice(3, 6)),
            paddle_position=self.engine.paddle_position(parameters, qpos),
        )

    def observe(self, state: EnvState, truth: Kinematics | None = None) -> jax.Array:
        """The observation [observation_size] of a state, laid out as `layout`.

        Args:
          truth: `kinematics(state)`, if it has already been computed.
        """
        goals = {name: value[None] for name, value in state.goal.items()}
        if state.sensing is None:
            truth = self.kinematics(state) if truth is None else truth
            values = truth._asdict() | goals
        else:
            values = dict(state.sensing.histories)
            # A goal may have been set since the last step. (A loop over a set of names would
            # have another order, and so another program, in each process.)
            for name, goal in goals.items():
                if name in values:
                    values[name] = jnp.concatenate([goal[None], values[name][1:]])
        return self.layout.pack({name: jnp.ravel(value) for name, value in values.items()})

    def with_world(self, state: EnvState, world: World) -> EnvState:
        """The state with other values of the terms of its world; the parameters that `randomize`
        sampled stay. Delays are cut to the queues of the config (`ranges.within_queues`)."""
        world = within_queues(self.config.randomization, world)
        parameters = physics_parameters(world, self.mj_model)
        if self._randomize is not None:
            # The shapes alone say which parameters it gives.
            shapes = jax.eval_shape(self._randomize, jax.random.PRNGKey(0))
            kept = {name: getattr(state.parameters, name) for name in _given(shapes)}
            parameters = parameters._replace(**kept)
        return state._replace(world=world, parameters=parameters)

    def _privileged_metrics(self, world: World, truth: Kinematics) -> dict[str, jax.Array]:
        """Quantities that only a critic may see: `world/<term>` and, where the observation may
        differ from the true state of one instant, `true/<quantity>`. Each entry of an array has its
        own name with an index."""
        quantities = {f"world/{name}": value for name, value in world.items()}
        if self._sensors.are_needed:
            quantities |= {f"true/{name}": getattr(truth, name) for name in _TRUE_QUANTITIES}
        metrics = {}
        for name, value in quantities.items():
            if value.ndim == 0:
                metrics[name] = value
                continue
            for i, entry in enumerate(jnp.ravel(value)):
                metrics[f"{name}_{i}"] = entry
        return metrics


def sample_goals(ranges: Ranges, draws: jax.Array) -> dict[str, jax.Array]:
    """A sample [] of each goal within its range, from numbers between 0 and 1 [number of
    goals]."""
    sampled = {}
    for draw, (name, (low, high)) in zip(draws, ranges.items(), strict=True):
        sampled[name] = low + (high - low) * draw
    return sampled


def _entries(coordinates: jax.Array, places: Sequence[int]) -> jax.Array:
    """The coordinates [len(places)] at some places."""
    return jnp.stack([coordinates[place] for place in places])


def _ball_rows(coordinates: jax.Array, places: list[tuple[int, ...]], part: slice) -> jax.Array:
    """The coordinates of one ball [size], or a row for each of several [B, size].

    Args:
      coordinates: qpos [nq] or qvel [nv].
      places: of each ball's coordinates.
      part: which of them.
    """
    rows = []
    for ball_places in places:
        rows.append(_entries(coordinates, ball_places[part]))
    return rows[0] if len(rows) == 1 else jnp.stack(rows)


def _given(parameters: PhysicsParameters) -> dict[str, Any]:
    """The parameters that are not the model's own, by name."""
    return {name: value for name, value in parameters._asdict().items() if value is not None}


def _instant(state: EnvState, truth: Kinematics) -> Instant:
    """What the sensors depend on in a state."""
    return Instant(
        truth=truth,
        goal=state.goal,
        last_action=state.last_action,
        setpoint=state.actuation.setpoint,
        world=state.world,
        clock=state.clock,
    )


def _keep_finite(physics: PhysicsState, before: PhysicsState) -> tuple[PhysicsState, jax.Array]:
    """The physics after a step, or before it if the step diverged; and whether it did not []."""
    finite = jnp.array(True)
    for coordinates in jax.tree.leaves(physics):
        finite &= jnp.all(jnp.abs(coordinates) < _MAX_COORDINATE)

    def newest_finite(new: jax.Array, old: jax.Array) -> jax.Array:
        # The previous state is checked too, in case memory was corrupted.
        old = jnp.where(jnp.abs(old) < _MAX_COORDINATE, old, 0.0)
        return jnp.where(finite, new, old)

    return jax.tree.map(newest_finite, physics, before), finite


def _clip_action(action: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The action [n] that acts, clipped, and whether it is a number []: with a NaN in it, all its
    entries are 0."""
    is_number = ~jnp.any(jnp.isnan(action))
    return jnp.where(is_number, jnp.clip(action, -1.0, 1.0), 0.0), is_number


def _metrics(result: TaskStep, dtype: jnp.dtype) -> dict[str, jax.Array]:
    """The metrics of a task's step, each []."""
    rewards = {f"reward/{name}": value for name, value in result.reward.items()}
    numbers = {name: jnp.asarray(value, dtype) for name, value in result.metrics.items()}
    return rewards | numbers
