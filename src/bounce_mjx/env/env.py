"""`Env`: one environment, which is a world and a task. It and `State` match brax's by structure."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.physics import Control, PhysicsParameters, PhysicsState, edited_model
from bounce_mjx.physics.engine import Engine, make_engine
from bounce_mjx.physics.parameters import MODEL_PARAMETERS
from bounce_mjx.robot import model as robot_model
from bounce_mjx.robot.balls import BALLS_APART
from bounce_mjx.robot.geometry import read_geometry
from bounce_mjx.task.rewards import check_names
from bounce_mjx.task.task import Start, Step, Task, TaskStep
from bounce_mjx.world import noise
from bounce_mjx.world.actuation import Actuation, Actuators, recurs
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.noise import Clock
from bounce_mjx.world.observation import Kinematics
from bounce_mjx.world.randomization import (
    TERMS,
    Ranges,
    World,
    nominal_values,
    physics_parameters,
    sample_world,
)
from bounce_mjx.world.sensing import Sensing, Sensors

# MuJoCo's mjMAXVAL: a coordinate beyond it has diverged and counts as non-finite.
_MAX_COORDINATE = 1e10
# Two turns of a joint without a range, rad; or m.
_MAX_ANGLE = 4.0 * np.pi
# Poses in files are rounded, rad or m.
_ROUNDING = 1e-3


class Redraw(NamedTuple):
    """What later samples of the commands within an episode need."""

    age: jax.Array
    """Time since the commands were sampled [], s."""
    ranges: dict[str, tuple[jax.Array, jax.Array]]
    """The range of each command."""


class EnvState(NamedTuple):
    """The whole state of one environment, `State.pipeline_state`."""

    physics: PhysicsState
    command: dict[str, jax.Array]
    """Value [] of each command."""
    last_action: jax.Array
    """Clipped action of the last step [n]."""
    task: Any = ()
    """What the task keeps of the episode."""
    parameters: PhysicsParameters = PhysicsParameters()
    """The physics of the next step."""
    world: World = {}
    """The values that the reset sampled for the active randomisation terms."""
    clock: Clock | None = None
    """For a randomised world, or an observation with a history."""
    redraw: Redraw | None = None
    """For commands that change within an episode."""
    actuation: Actuation = Actuation()
    sensing: Sensing | None = None
    """For an observation that differs from the true state of one instant."""


# A ball that starts farther beside the paddle falls before the paddle is under it, m.
_FARTHEST_BESIDE = 0.3


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
    the time limit belongs to the training wrapper.
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
          UserError: the MJCF file or the engine does not fit the task.
        """
        self.config = config
        self.task: Task = config.task(config)
        _check_seen(config)
        if config.num_balls not in self.task.num_balls:
            takes = " or ".join(map(str, self.task.num_balls))
            raise UserError(
                f"num_balls is {config.num_balls}, but the task {type(self.task).__name__} takes "
                f"{takes}; set num_balls to {takes}"
            )
        self.mj_model: mujoco.MjModel = world_model(config)
        self.engine: Engine = make_engine(self.mj_model, config.physics)
        self.layout = config.layout
        self.addresses = robot_model.find_addresses(self.mj_model)
        self._check_start()
        self.task.geometry = read_geometry(self.mj_model, config.default_joint_angles)
        self._check_rest()
        self._actuators = Actuators(config, self.mj_model)
        self._sensors = Sensors(config, self.mj_model, self.engine, self.task)
        self._randomize = randomize
        self.nominals = nominal_values(self.mj_model, config.randomization.terms)
        """Values of the terms of the randomisation in an episode that does not sample them."""
        self._fingerprint = robot_model.fingerprint(self.mj_model)
        self.dt = config.control_dt
        """Time of one control step, s."""
        self.observation_size, self.action_size = self.layout.size, config.num_joints
        """Lengths of the observation vector and of the action vector."""
        self.backend = self.engine.name
        """Name of the physics engine."""
        self.warmup_steps = config.randomization.warmup_steps
        """Environment steps of a training run over which the ranges grow (`ranges`)."""

    def __reduce__(self) -> tuple:
        """Pickled as its settings; a copy is built again."""
        return type(self), (self.config, self._randomize)

    def _check_start(self) -> None:
        """Checks that the joint angles of a reset, and the heights over the paddle, fit the arm."""
        config, model, acting = self.config, self.mj_model, robot_model.joint_names(self.mj_model)
        angles, ranges = config.default_joint_angles, robot_model.joint_ranges(model)
        if len(angles) != len(acting):
            name = f"the MJCF file {config.mjcf}" if config.mjcf else "the model"
            raise UserError(
                f"default_joint_angles has {len(angles)} numbers, but {name} has {len(acting)} "
                f"joints with an actuator ({', '.join(acting)}); give one number for each"
            )
        ranges = np.nan_to_num(ranges, posinf=_MAX_ANGLE, neginf=-_MAX_ANGLE)
        for name, angle, low, high in zip(acting, angles, *ranges, strict=True):
            if not low - _ROUNDING <= angle <= high + _ROUNDING:
                raise UserError(
                    f"default_joint_angles has {angle:g} for {name}, whose range is {low:.4g} to "
                    f"{high:.4g}; give radians, or metres for a slide, within the range"
                )
        paddle = robot_model.data_at(model, angles).geom_xpos[self.addresses.paddle_geom]
        for name, height in config.heights.items():
            if height <= paddle[2]:
                raise UserError(
                    f"{name} has the height {height:g} m, which is not over the paddle at "
                    f"{paddle[2]:.4g} m, where default_joint_angles hold it; change one of the two"
                )
        beside = np.linalg.norm(np.array(config.ball_init_pos)[:2] - paddle[:2])
        if type(self.task).throw is Task.throw and beside > _FARTHEST_BESIDE:
            raise UserError(
                f"ball_init_pos is {beside:.3g} m beside the paddle at ({paddle[0]:.3g}, "
                f"{paddle[1]:.3g}) m, where default_joint_angles hold it; start it over the paddle"
            )

    def _check_rest(self) -> None:
        """Checks that the ball of a task that throws none does not start within the paddle."""
        geometry, start = self.task.geometry, self.config.ball_init_pos[2]
        rest = geometry.paddle_home[2] + geometry.rest_height
        if type(self.task).throw is Task.throw and start < rest - _ROUNDING:
            raise UserError(
                f"ball_init_pos has the height {start:g} m, but a ball of the radius "
                f"{geometry.ball_radius:g} m rests on the paddle at {rest:.4g} m; raise it"
            )

    @property
    def unwrapped(self) -> "Env":
        """The environment itself, as there is no wrapper around it."""
        return self

    def ranges(self, progress: jax.Array | float = 1.0) -> Ranges:
        """The ranges of the randomisation, and of the commands where they grow too; `progress` []
        is the share of the warm-up that has passed."""
        randomization = self.config.randomization
        ranges = randomization.ranges(progress, self.nominals)
        first = randomization.first_command_range
        for name, command in self.config.commands.items() if first < 1.0 else ():
            middle, half = (command.low + command.high) / 2.0, (command.high - command.low) / 2.0
            half *= first + (1.0 - first) * progress
            ends = middle - half, middle + half
            ranges[name] = tuple(jnp.asarray(end, jnp.float32) for end in ends)
        return ranges

    def reset(
        self, rng: jax.Array, ranges: Ranges | None = None, share: float | None = None
    ) -> State:
        """Starts an episode.

        Args:
          rng: key; consumed.
          ranges: ranges for the active terms, within the config's ranges, which are the default.
            The queues of delayed actions and pictures are only as long as the config's ranges need.
          share: probability that each term is sampled; by default, the config's.
        """
        robot_model.check_unedited(self.mj_model, self._fingerprint)
        given = self.ranges() if ranges is None else ranges
        rng, world, clock = self._sample_world(rng, given, share)
        own_parameters = MODEL_PARAMETERS
        if self._randomize is not None:
            rng, own_rng = jax.random.split(rng)
            own_parameters = self._randomize(own_rng)
        # One sample for all numbers: splitting keys for several would cost more than they do.
        commands, size = self.config.commands, 2 * self.action_size + 3 * self.config.num_balls
        count = size + len(commands) + self.task.num_draws
        draws = jax.random.uniform(rng, (count,), minval=-1.0, maxval=1.0)
        noises, command_draws, task_draws = jnp.split(draws, [size, size + len(commands)])
        task_draws = 0.5 * (task_draws + 1.0)
        ends = {name: given.get(name, (c.low, c.high)) for name, c in commands.items()}
        sampled = {
            name: low + (high - low) * 0.5 * (draw + 1.0)
            for draw, (name, (low, high)) in zip(command_draws, ends.items(), strict=True)
        }
        command = self._first_command(sampled)
        redraw = None
        if "command_interval" in world:
            age = jnp.zeros((), draws.dtype)
            redraw = Redraw(age, jax.tree.map(lambda end: jnp.asarray(end, draws.dtype), ends))

        physics = self._first_physics(noises, world, self.task.throw(task_draws, sampled))
        state = EnvState(
            physics=physics,
            command=command,
            last_action=jnp.zeros(self.action_size, draws.dtype),
            parameters=self._parameters(world, own_parameters),
            world=world,
            clock=clock,
            redraw=redraw,
            actuation=self._actuators.first(physics.qpos),
        )
        truth = self.kinematics(state)
        task = self.task.reset(Start(truth, command, task_draws))
        following = self.task.next_command(task, command)
        named = f"next_command of the task {type(self.task).__name__}"
        check_names(named, "command", following, command)
        state = state._replace(task=task, command=following)
        if self._sensors.are_needed:
            state = state._replace(sensing=self._sensors.first(state, truth))
        return State(
            pipeline_state=state,
            obs=self.observe(state, truth),
            reward=jnp.zeros((), draws.dtype),
            done=jnp.zeros((), draws.dtype),
            metrics=self._first_metrics(state, truth),
        )

    def step(self, state: State, action: jax.Array) -> State:
        """Advances one control step under the action [n], clipped to [-1, 1]. A NaN action ends the
        episode and acts as 0."""
        robot_model.check_unedited(self.mj_model, self._fingerprint)
        now = state.pipeline_state
        control, actuation = self.control(now, action)
        physics = self.engine.step(now.parameters, now.physics, control, self.config.num_substeps)
        return self.finish_step(state, action, actuation, physics)

    def control(self, now: EnvState, action: jax.Array) -> tuple[Control, Actuation]:
        """The part of a step before the physics: its inputs under the action [n] of `step`, and
        the memory of the actuation after the step."""
        action, _ = _clip_action(action)
        return self._actuators.next(now.actuation, now.physics.qpos, action, now.world, now.clock)

    def finish_step(
        self, state: State, action: jax.Array, actuation: Actuation, physics: PhysicsState
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
        action = jnp.where(finite, action, before.last_action)
        now = before._replace(physics=physics, last_action=action, actuation=actuation)
        truth = self.kinematics(now)

        done = self.task.step(
            before.task,
            Step(
                truth=truth,
                command=before.command,
                action=action,
                last_action=before.last_action,
                ball_radius=before.parameters.ball_radius,
            ),
        )
        now = self._pass_time(now)
        command = self.task.next_command(done.state, now.command)
        now = now._replace(task=done.state, command=command)
        ends = {
            "non_finite": ~(finite & is_number),
            "too_fast": jnp.any(jnp.abs(truth.joint_velocities) > self.config.max_joint_velocity),
        }
        if now.sensing is not None:
            now = now._replace(sensing=self._sensors.next(now, truth))
        dtype = truth.ball_position.dtype
        metrics = _metrics(done, dtype) | {name: end.astype(dtype) for name, end in ends.items()}
        return state.replace(
            pipeline_state=now,
            obs=self.observe(now, truth),
            reward=sum(done.reward.values()),
            done=(done.ended | ends["non_finite"] | ends["too_fast"]).astype(dtype),
            # Wrappers add their own metrics, which a step must keep.
            metrics=state.metrics | metrics | self._privileged_metrics(now.world, truth),
        )

    def _sample_world(
        self, rng: jax.Array, given: Ranges, share: float | None
    ) -> tuple[jax.Array, World, Clock | None]:
        """An unused key, the world of an episode, and its clock; the arguments are those of
        `reset`."""
        ranges = {name: ends for name, ends in given.items() if name in TERMS}
        if not (ranges or self._sensors.are_needed):
            return rng, {}, None
        terms, dtype = self.config.randomization, jnp.result_type(float)
        rng, world_rng, clock_rng = jax.random.split(rng, 3)
        share, shares = (terms.share, terms.shares or {}) if share is None else (share, {})
        world = sample_world(
            ranges, world_rng, dtype, self.action_size, self.nominals, share, shares
        )
        return rng, world, noise.first_clock(clock_rng, dtype)

    def _first_physics(
        self, draws: jax.Array, world: World, thrown: tuple[jax.Array, jax.Array] | None
    ) -> PhysicsState:
        """The arm and the balls at a reset.

        Args:
          draws: numbers from -1 to 1 for the angle and the velocity of each joint, and for the
            balls' positions [2 n + 3 B].
          thrown: the task's position and velocity of the ball [3], or of the balls [B, 3].
        """
        config, addresses, model = self.config, self.addresses, self.mj_model
        dtype, n, count = draws.dtype, self.action_size, config.num_balls
        if thrown is None:
            above = np.array([[0.0, 0.0, BALLS_APART * i] for i in range(count)])
            thrown = np.array(config.ball_init_pos) + above, np.zeros((count, 3))
        positions, velocities = (jnp.asarray(x, dtype).reshape(count, 3) for x in thrown)
        positions = positions + config.reset.ball_position * draws[2 * n :].reshape(count, 3)
        angles = jnp.asarray(config.default_joint_angles, dtype)
        angles = angles + config.reset.joint_angles * draws[:n] + world.get("joint_start", 0.0)
        positions = positions + world.get("ball_start", 0.0)

        rates = config.reset.joint_velocities * draws[n : 2 * n]
        scatter = robot_model.scatter
        qpos = scatter(model.qpos0, addresses.arm_qpos, angles)
        qvel = scatter(np.zeros(model.nv), addresses.arm_qvel, rates)
        for ball, position, velocity in zip(addresses.balls, positions, velocities, strict=True):
            pose = jnp.concatenate([position, jnp.array([1.0, 0.0, 0.0, 0.0], dtype)])
            qpos, qvel = scatter(qpos, ball.qpos, pose), scatter(qvel, ball.qvel[:3], velocity)
        return PhysicsState(qpos, qvel)

    def _first_metrics(self, state: EnvState, truth: Kinematics) -> dict[str, jax.Array]:
        """The metrics of a reset, which are zero except for the privileged ones."""
        zero = jnp.zeros((), truth.joint_angles.dtype)
        # The names alone: no step is computed.
        step = Step(truth, state.command, state.last_action, state.last_action)
        names = jax.eval_shape(lambda: _metrics(self.task.step(state.task, step), zero.dtype))
        metrics = dict.fromkeys([*names, "non_finite", "too_fast"], zero)
        metrics |= self._privileged_metrics(state.world, truth)
        for curve in self.task.curves:
            shown = {curve.metric, *({curve.over} - {"steps", "episodes"})}
            check_names(f"the curve {curve.tag}", "metric", {*metrics} | shown, metrics)
        return metrics

    def _pass_time(self, state: EnvState) -> EnvState:
        """The state after a control step has passed: the clock, and new commands if their interval
        has passed."""
        if state.clock is None:
            return state
        clock = noise.next_clock(state.clock)
        if state.redraw is None:
            return state._replace(clock=clock)
        age, ranges = state.redraw
        interval, phase = state.world["command_interval"], clock.phases[2]
        is_due = recurs(interval, phase, state.clock.step, self.dt)
        shares = noise.uniform(clock.counter, noise.COMMAND, (len(ranges),), age.dtype)
        sampled = {}
        for i, name in enumerate(self.config.commands):
            low, high = ranges[name]
            sampled[name] = low + (high - low) * shares[i]
        first = self._first_command(sampled)
        command = {
            name: jnp.where(is_due, first[name], value) for name, value in state.command.items()
        }
        redraw = Redraw(jnp.where(is_due, 0.0, age + self.dt), ranges)
        return state._replace(clock=clock, command=command, redraw=redraw)

    def _first_command(self, sampled: dict[str, jax.Array]) -> dict[str, jax.Array]:
        """The task's commands from their samples, each []."""
        command = self.task.first_command(sampled)
        named = f"first_command of the task {type(self.task).__name__}"
        check_names(named, "command", command, sampled)
        return command

    def kinematics(self, state: EnvState) -> Kinematics:
        """True positions and velocities of one environment's state, read from its physics."""
        addresses, (qpos, qvel) = self.addresses, (state.physics.qpos, state.physics.qvel)

        def ball_rows(coordinates: jax.Array, entries: list[tuple[int, ...]]) -> jax.Array:
            rows = [jnp.stack([coordinates[i] for i in row]) for row in entries]
            return rows[0] if len(rows) == 1 else jnp.stack(rows)

        return Kinematics(
            joint_angles=jnp.stack([qpos[i] for i in addresses.arm_qpos]),
            ball_position=ball_rows(qpos, [ball.qpos[:3] for ball in addresses.balls]),
            ball_quaternion=ball_rows(qpos, [ball.qpos[3:] for ball in addresses.balls]),
            joint_velocities=jnp.stack([qvel[i] for i in addresses.arm_qvel]),
            ball_velocity=ball_rows(qvel, [ball.qvel[:3] for ball in addresses.balls]),
            ball_angular_velocity=ball_rows(qvel, [ball.qvel[3:] for ball in addresses.balls]),
            paddle_position=self.engine.paddle_position(state.parameters, qpos),
        )

    def observe(self, state: EnvState, truth: Kinematics | None = None) -> jax.Array:
        """The observation [observation_size] of a state, laid out as `layout`.

        Args:
          truth: `kinematics(state)`, if it has already been computed.
        """
        command = {name: value[None] for name, value in state.command.items()}
        if state.sensing is None:
            truth = self.kinematics(state) if truth is None else truth
            values = truth._asdict() | command
        else:
            values = dict(state.sensing.histories)
            # A command may have been set since the last step.
            for name in command.keys() & values.keys():
                values[name] = jnp.concatenate([command[name][None], values[name][1:]])
        return self.layout.pack({name: jnp.ravel(value) for name, value in values.items()})

    def with_world(self, state: EnvState, world: World) -> EnvState:
        """The state with other values of the terms of its world."""
        own = MODEL_PARAMETERS
        if self._randomize is not None:
            given = jax.eval_shape(self._randomize, jax.random.PRNGKey(0))
            pairs = zip(given, state.parameters, strict=True)
            own = PhysicsParameters(*(None if x is None else value for x, value in pairs))
        return state._replace(world=world, parameters=self._parameters(world, own))

    def _parameters(self, world: World, own: PhysicsParameters) -> PhysicsParameters:
        """The physics of a world, in which the parameters of `randomize` replace its own."""
        pairs = zip(own, physics_parameters(world, self.mj_model), strict=True)
        return PhysicsParameters(*(sampled if x is None else x for x, sampled in pairs))

    def _privileged_metrics(self, world: World, truth: Kinematics) -> dict[str, jax.Array]:
        """Quantities that only a critic may see: `world/<term>` and, where the sensors differ from
        the truth, `true/<quantity>`. Each entry of an array has its own name with an index."""
        named = {f"world/{name}": value for name, value in world.items()}
        if self._sensors.are_needed:
            hidden = ("joint_angles", "ball_position", "joint_velocities", "ball_velocity")
            hidden += ("ball_angular_velocity", "paddle_position")
            named |= {f"true/{name}": getattr(truth, name) for name in hidden}
        return {
            name if value.ndim == 0 else f"{name}_{i}": entry
            for name, value in named.items()
            for i, entry in enumerate(jnp.ravel(value) if value.ndim else (value,))
        }


def world_model(config: WorldConfig, visual: bool = True) -> mujoco.MjModel:
    """Compiles the model of a world; `visual` and the errors are those of `load_model`."""
    mj_model = robot_model.load_model(
        config.mjcf, config.physics_dt, visual, config.robot, num_balls=config.num_balls
    )
    if config.friction is None:
        return mj_model
    return edited_model(mj_model, PhysicsParameters(contact_friction=np.float64(config.friction)))


def _check_seen(config: WorldConfig) -> None:
    """Refuses a command that varies and that the policy does not see."""
    observation = config.observation
    if observation.lengths("task"):
        # The task's own quantities may show any command.
        return
    for name, command in config.commands.items():
        if command.low < command.high and not command.hidden and not getattr(observation, name, 0):
            raise UserError(
                f"the policy does not see the command {name}, which varies from {command.low:g} to "
                f"{command.high:g}; give the observation a quantity {name}, fix the command, or "
                "mark it as hidden if it acts through others"
            )


@functools.lru_cache(maxsize=8)
def model_nominals(config: WorldConfig) -> dict[str, np.ndarray]:
    """The `nominal_values` of all terms for a config, whose model it compiles."""
    return nominal_values(world_model(config, visual=False), TERMS)


def _keep_finite(physics: PhysicsState, before: PhysicsState) -> tuple[PhysicsState, jax.Array]:
    """The physics after a step, or before it if the step diverged; and whether it did not []."""
    finite = jnp.array(True)
    for coordinates in jax.tree.leaves(physics):
        finite &= jnp.all(jnp.abs(coordinates) < _MAX_COORDINATE)

    def kept(new: jax.Array, old: jax.Array) -> jax.Array:
        # The previous state is checked too, in case memory was corrupted.
        old = jnp.where(jnp.abs(old) < _MAX_COORDINATE, old, 0.0)
        return jnp.where(finite, new, old)

    return jax.tree.map(kept, physics, before), finite


def _clip_action(action: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The action [n] that acts, and whether that is the clipped one []: a NaN acts as 0."""
    is_number = ~jnp.any(jnp.isnan(action))
    return jnp.where(is_number, jnp.clip(action, -1.0, 1.0), 0.0), is_number


def _metrics(done: TaskStep, dtype: jnp.dtype) -> dict[str, jax.Array]:
    """The metrics of a task's step, each []."""
    numbers = {name: jnp.asarray(value, dtype) for name, value in done.metrics.items()}
    return {f"reward/{name}": value for name, value in done.reward.items()} | numbers
