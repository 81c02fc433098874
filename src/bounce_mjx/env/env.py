"""`Env`: one environment, which is a world and a task."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.env.state import State
from bounce_mjx.errors import UserError
from bounce_mjx.physics import (
    Control,
    Engine,
    PhysicsParameters,
    PhysicsState,
    edited_model,
    make_engine,
)
from bounce_mjx.physics.control import Moving
from bounce_mjx.physics.parameters import MODEL_PARAMETERS, direct_solref
from bounce_mjx.robot.balls import BALLS_APART
from bounce_mjx.robot.model import (
    BallAddresses,
    check_unedited,
    command_limits,
    find_addresses,
    fingerprint,
    joint_names,
    load_model,
    resting_activations,
)
from bounce_mjx.robot.setpoints import Setpoint, next_setpoint
from bounce_mjx.task.rewards import check_names
from bounce_mjx.task.task import Start, Step, Task, TaskStep
from bounce_mjx.world import actuation, impact, noise, sensing
from bounce_mjx.world.actuation import Actuation
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.impact import Impact
from bounce_mjx.world.observation import Kinematics
from bounce_mjx.world.randomization import (
    TERMS,
    Ranges,
    World,
    draw_world,
    physics_parameters,
)
from bounce_mjx.world.sensing import Sensing

# MuJoCo's mjMAXVAL: a coordinate beyond it has diverged and counts as non-finite.
_MAX_COORDINATE = 1e10
# Two turns of a joint without a range, rad; or m.
_MAX_ANGLE = 4.0 * np.pi
# Poses in files are rounded, rad or m.
_ROUNDING = 1e-3


class Memory(NamedTuple):
    """State that only a randomised world or an observation with a history needs."""

    counter: jax.Array
    """Counter of the random numbers [], int32."""
    step: jax.Array
    """Control steps since the reset [], int32."""
    phases: jax.Array
    """Share of the current interval that had passed at the reset [3]: camera, pushes, commands."""
    command_age: jax.Array
    """Time since the commands were drawn [], s."""
    command_ranges: dict[str, tuple[jax.Array, jax.Array]] | None
    """Ranges of later commands; None if they do not change."""
    actuation: Actuation | None
    sensing: Sensing | None
    impact: Impact | None = None
    """For a restitution that depends on the speed."""


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
    """The physics of this environment; drawn at its reset."""
    world: World = {}
    """The values that the reset drew for the active randomisation terms."""
    memory: Memory | None = None
    ctrl: jax.Array | None = None
    """Servo targets of the last step [nu], if an action adds to them."""
    setpoint: Setpoint | None = None
    """The commands of the joints at the end of the last step, each entry [n], if they move within
    the arm's limits."""


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
          randomize: key -> the physics parameters of one episode, drawn at each reset; None for the
            model's own parameters.

        Raises:
          UserError: the MJCF file or the engine does not fit the task.
        """
        self.config = config
        self.task: Task = config.task(config)
        if config.num_balls not in self.task.num_balls:
            takes = " or ".join(map(str, self.task.num_balls))
            raise UserError(
                f"num_balls is {config.num_balls}, but the task {type(self.task).__name__} takes "
                f"{takes}; set num_balls to {takes}"
            )
        self.mj_model: mujoco.MjModel = world_model(config)
        self.engine: Engine = make_engine(self.mj_model, self.config.physics)
        self._addresses = find_addresses(self.mj_model)
        self._check_joints()
        self._check_heights()
        self._limits = command_limits(config.robot.limits, self.mj_model, self._addresses)
        self._randomize = randomize
        self.layout = self.config.layout
        self._fingerprint = fingerprint(self.mj_model)

    def __reduce__(self) -> tuple:
        """Pickled as its settings; a copy is built again."""
        return type(self), (self.config, self._randomize)

    def _check_joints(self) -> None:
        given, acting = self.config.num_joints, joint_names(self.mj_model)
        if given != len(acting):
            model = f"the MJCF file {self.config.mjcf}" if self.config.mjcf else "the model"
            raise UserError(
                f"default_joint_angles has {given} numbers, but {model} has {len(acting)} joints "
                f"with an actuator ({', '.join(acting)}); give one number for each"
            )
        ranges = self.mj_model.jnt_range[list(self._addresses.arm_joints)]
        angles = self.config.default_joint_angles
        for name, angle, (low, high) in zip(acting, angles, ranges, strict=True):
            if not low < high:
                low, high = -_MAX_ANGLE, _MAX_ANGLE
            if not low - _ROUNDING <= angle <= high + _ROUNDING:
                raise UserError(
                    f"default_joint_angles has {angle:g} for {name}, whose range is {low:.4g} to "
                    f"{high:.4g}; give radians, or metres for a slide, within the range"
                )

    def _check_heights(self) -> None:
        model, data = self.mj_model, mujoco.MjData(self.mj_model)
        data.qpos[list(self._addresses.arm_qpos)] = self.config.default_joint_angles
        mujoco.mj_kinematics(model, data)
        paddle = data.geom_xpos[self._addresses.paddle_geom, 2]
        for name, height in self.config.heights.items():
            if height <= paddle:
                raise UserError(
                    f"{name} has the height {height:g} m, which is not over the paddle at "
                    f"{paddle:.4g} m, where default_joint_angles hold it; change one of the two"
                )

    @property
    def dt(self) -> float:
        """Time of one control step, s."""
        return self.config.control_dt

    @property
    def observation_size(self) -> int:
        """Length of the observation vector."""
        return self.layout.size

    @property
    def action_size(self) -> int:
        """Length of the action vector."""
        return self.config.num_joints

    @property
    def backend(self) -> str:
        """Name of the physics engine."""
        return self.engine.name

    @property
    def unwrapped(self) -> "Env":
        """The environment itself, as there is no wrapper around it."""
        return self

    @property
    def sys(self) -> None:
        """brax's system, which brax's domain randomisation edits; this environment has none.

        Raises:
          UserError: always.
        """
        raise UserError(
            "this environment has no sys, which brax's randomization_fn changes; use "
            "brax.envs.get_environment('bounce_ball'), or give it a function randomize"
        )

    @property
    def warmup_steps(self) -> int:
        """Environment steps of a training run over which the ranges grow (`ranges`)."""
        return self.config.randomization.warmup_steps

    def ranges(self, progress: jax.Array | float = 1.0) -> Ranges:
        """The ranges of the randomisation; `progress` [] is the share of the warm-up that has
        passed."""
        return self.config.randomization.ranges(progress)

    def reset(
        self, rng: jax.Array, ranges: Ranges | None = None, share: float | None = None
    ) -> State:
        """Starts an episode.

        Args:
          rng: key; consumed.
          ranges: ranges for the active terms, within the config's ranges, which are the default.
            The queues of late actions and pictures are only as long as the config's ranges need.
          share: probability that each term is drawn; by default, the config's.
        """
        check_unedited(self.mj_model, self._fingerprint)
        given = self.ranges() if ranges is None else ranges
        ranges = {name: ends for name, ends in given.items() if name in TERMS}
        world, own_parameters, memory_rng = {}, MODEL_PARAMETERS, None
        if ranges or self._needs_sensing:
            rng, world_rng, memory_rng = jax.random.split(rng, 3)
            own_share, shares = self.config.randomization.share, self.config.randomization.shares
            share, shares = (own_share, shares or {}) if share is None else (share, {})
            dtype = jnp.result_type(float)
            world = draw_world(ranges, world_rng, dtype, self.action_size, share, shares)
        if self._randomize is not None:
            rng, world_rng = jax.random.split(rng)
            own_parameters = self._randomize(world_rng)
        parameters = self._parameters(world, own_parameters)
        commands = self.config.commands
        ends = {name: given.get(name, (c.low, c.high)) for name, c in commands.items()}
        # One draw for all numbers: splitting keys for separate draws would cost more than the
        # draws.
        size = 2 * self.action_size + 3 * self.config.num_balls
        count = size + len(commands) + self.task.num_draws
        draws = jax.random.uniform(rng, (count,), minval=-1.0, maxval=1.0)
        own = 0.5 * (draws[size + len(commands) :] + 1.0)
        command = {
            name: low + (high - low) * 0.5 * (draws[size + i] + 1.0)
            for i, (name, (low, high)) in enumerate(ends.items())
        }
        physics = self._first_physics(draws[:size], world, self.task.throw(own, command))
        no_action = jnp.zeros(self.action_size, draws.dtype)
        state = EnvState(physics, command, no_action, parameters=parameters, world=world)
        if self.config.action.base == "target":
            state = state._replace(ctrl=self.servo_targets(physics, no_action))
        if self._limits is not None:
            position = jnp.stack(self._joint_targets(physics, no_action))
            still = jnp.zeros_like(position)
            state = state._replace(setpoint=Setpoint(position, still, still))
        truth = self.kinematics(state)
        task = self.task.reset(Start(truth, command, own))
        command = self._moved(task, command)
        state = state._replace(task=task, command=command)
        if memory_rng is not None:
            memory = self._first_memory(state, truth, memory_rng)
            if own_parameters.contact_damping is not None:
                memory = memory._replace(impact=None)
            if "command_interval" in world:
                memory = memory._replace(
                    command_ranges=jax.tree.map(lambda end: jnp.asarray(end, draws.dtype), ends)
                )
            state = self._with_impact(state._replace(memory=memory), truth)
        zero = jnp.zeros((), draws.dtype)
        # The names alone: no step is computed.
        step = Step(truth, command, no_action, no_action)
        metrics = jax.eval_shape(lambda: _metrics(self.task.step(state.task, step), zero.dtype))
        metrics = dict.fromkeys([*metrics, "non_finite", "too_fast"], zero)
        metrics |= self._privileged(world, truth)
        for curve in self.task.curves:
            shown = {curve.metric, *({curve.over} - {"steps", "episodes"})}
            check_names(f"the curve {curve.tag}", "metric", {*metrics} | shown, metrics)
        return State(
            pipeline_state=state,
            obs=self.observe(state, truth),
            reward=zero,
            done=zero,
            metrics=metrics,
        )

    def _first_physics(
        self, draws: jax.Array, world: World, thrown: tuple[jax.Array, jax.Array] | None
    ) -> PhysicsState:
        """The arm and the balls at a reset.

        Args:
          draws: numbers from -1 to 1 for the angle and the velocity of each joint, and for the
            balls' positions [2 n + 3 B].
          thrown: the task's position and velocity of the ball [3], or of the balls [B, 3].
        """
        config, addresses, n = self.config, self._addresses, self.action_size
        dtype = draws.dtype
        qpos = [jnp.asarray(q, dtype) for q in self.mj_model.qpos0]
        qvel = [jnp.zeros((), dtype)] * self.mj_model.nv
        for i, angle in enumerate(config.default_joint_angles):
            qpos[addresses.arm_qpos[i]] = angle + config.reset.joint_angles * draws[i]
            qvel[addresses.arm_qvel[i]] = config.reset.joint_velocities * draws[n + i]
        for k, (ball, position, velocity) in enumerate(self._ball_starts(thrown)):
            for i, component in enumerate(velocity):
                qvel[ball.qvel[i]] = component
            for i, coordinate in enumerate(position):
                noise_of_ball = config.reset.ball_position * draws[2 * n + 3 * k + i]
                qpos[ball.qpos[i]] = coordinate + noise_of_ball
            for i, component in enumerate((1.0, 0.0, 0.0, 0.0)):
                qpos[ball.qpos[3 + i]] = jnp.asarray(component, dtype)
        for term, entries in (
            ("joint_start", addresses.arm_qpos),
            *(("ball_start", ball.qpos[:3]) for ball in addresses.balls),
        ):
            for i, entry in enumerate(entries if term in world else ()):
                qpos[entry] = qpos[entry] + world[term][i]
        return PhysicsState(
            jnp.stack(qpos), jnp.stack(qvel), resting_activations(self.mj_model, qpos)
        )

    def _ball_starts(
        self, thrown: tuple[jax.Array, jax.Array] | None
    ) -> list[tuple[BallAddresses, Sequence[Any], Sequence[Any]]]:
        """Each ball with its position (m) and velocity (m/s) at a reset, before noise."""
        balls = self._addresses.balls
        if thrown is None:
            x, y, z = self.config.ball_init_pos
            return [(ball, (x, y, z + BALLS_APART * i), ()) for i, ball in enumerate(balls)]
        if len(balls) == 1:
            return [(balls[0], *thrown)]
        return [(ball, *(x[i] for x in thrown)) for i, ball in enumerate(balls)]

    def step(self, state: State, action: jax.Array) -> State:
        """Advances one control step under the action [n], clipped to [-1, 1]. A NaN action ends the
        episode and acts as 0."""
        check_unedited(self.mj_model, self._fingerprint)
        state, control = self.begin_step(state, action)
        before = state.pipeline_state
        physics = self.engine.step(
            before.parameters, before.physics, control, self.config.num_substeps
        )
        return self.finish_step(state, action, physics)

    def begin_step(self, state: State, action: jax.Array) -> tuple[State, Control]:
        """The part of a step before the physics: the control of the action [n] of `step`."""
        action, _ = _acting(action)
        config, before = self.config, state.pipeline_state
        world, memory = before.world, before.memory
        if memory is None:
            return self._commanded(state, action, None)
        # The same noise as in the observation from which the policy chose the action.
        error = sensing.joint_angle_noise(world, memory.counter, self.action_size, action.dtype)
        state, control = self._commanded(state, action, error)
        control, queue = actuation.delayed(
            world, memory.actuation, control, config.control_dt, config.num_substeps
        )
        memory = memory._replace(counter=noise.next_counter(memory.counter), actuation=queue)
        air = {name: world[name] for name in ("air_drag", "air_lift") if name in world}
        control = control._replace(**air)
        if "push_speed" in world:
            push = actuation.push(
                world,
                memory.counter,
                memory.phases[1],
                memory.step,
                config.control_dt,
                config.num_balls,
            )
            control = control._replace(ball_push=push)
        command = before.command
        if "command_interval" in world:
            command, memory = self._next_command(world, command, memory)
        now = state.pipeline_state._replace(command=command, memory=memory)
        if memory.impact is not None:
            damping = impact.damping(memory.impact)
            now = now._replace(parameters=now.parameters._replace(contact_damping=damping))
        return state.replace(pipeline_state=now), control

    def _commanded(
        self, state: State, action: jax.Array, error: jax.Array | None
    ) -> tuple[State, Control]:
        """The control of a clipped action [n] that arrives at once, and the state that keeps what
        the next action starts from. `error` is that of `servo_targets`."""
        before = state.pipeline_state
        if self._limits is None:
            targets = self.servo_targets(before.physics, action, error, before.ctrl)
            if self.config.action.base == "measured":
                return state, Control(targets)
            return state.replace(pipeline_state=before._replace(ctrl=targets)), Control(targets)
        wished = self._joint_targets(before.physics, action, error, before.ctrl)
        starts = [Setpoint(*(x[i] for x in before.setpoint)) for i in range(len(wished))]
        dt, substep = self.config.control_dt, self.config.physics_dt
        after = [
            next_setpoint(limits, start, target, dt, jnp)
            for limits, start, target in zip(self._limits, starts, wished, strict=True)
        ]
        moving = Moving(
            velocity=self._ctrl([start.velocity * substep for start in starts]),
            acceleration=self._ctrl([x.acceleration * substep**2 for x in after]),
            before=self._ctrl([start.acceleration * substep**2 for start in starts]),
            smoothing=self._smoothing(action.dtype),
        )
        control = Control(self._ctrl([start.position for start in starts]), moving)
        setpoint = Setpoint(*map(jnp.stack, zip(*after, strict=True)))
        # Limits need the base target (`WorldConfig`), so the next action adds to the targets.
        kept = before._replace(setpoint=setpoint, ctrl=self._ctrl([x.position for x in after]))
        return state.replace(pipeline_state=kept), control

    def _smoothing(self, dtype: jnp.dtype) -> jax.Array | None:
        """Physics steps [nu] of the mean that limits the jerk of each servo target."""
        if self._limits[0].smoothing is None:
            return None
        # An actuator of no joint has a target of zero, whatever the time.
        times = np.ones(self.mj_model.nu)
        for actuator, limits in zip(self._addresses.actuators, self._limits, strict=True):
            times[actuator] = limits.smoothing / self.config.physics_dt
        return jnp.asarray(times, dtype)

    def _next_command(
        self, world: World, command: dict[str, jax.Array], memory: Memory
    ) -> tuple[dict[str, jax.Array], Memory]:
        """Draws new commands if their interval has passed."""
        now = actuation.passes(
            world["command_interval"], memory.phases[2], memory.step, self.config.control_dt
        )
        dtype = memory.command_age.dtype
        shares = noise.uniform(memory.counter, noise.Stream.COMMAND, (len(command),), dtype)
        drawn = {}
        for i, name in enumerate(self.config.commands):
            low, high = memory.command_ranges[name]
            drawn[name] = jnp.where(now, low + (high - low) * shares[i], command[name])
        return drawn, memory._replace(command_age=jnp.where(now, 0.0, memory.command_age))

    def servo_targets(
        self,
        physics: PhysicsState,
        action: jax.Array,
        error: jax.Array | None = None,
        last: jax.Array | None = None,
    ) -> jax.Array:
        """Servo targets ctrl [nu] of a clipped action [n]: the measured joint angles plus the
        scaled action (rad), clipped to the range of each joint that has one, times the gear.

        Args:
          error: error of the measured angles [n], rad, without the offset of the encoders' zeros,
            which the servo shares.
          last: servo targets of the last step [nu], to which the action adds instead, within
            `max_lead` of the measured angles.
        """
        return self._ctrl(self._joint_targets(physics, action, error, last))

    def _joint_targets(
        self,
        physics: PhysicsState,
        action: jax.Array,
        error: jax.Array | None = None,
        last: jax.Array | None = None,
    ) -> list[jax.Array]:
        """`servo_targets` as the angle [] of each joint, rad: one scalar per joint, which XLA fuses
        with the physics; it would not fuse an indexed update."""
        model, addresses = self.mj_model, self._addresses
        targets = []
        for i, actuator in enumerate(addresses.actuators):
            angle = physics.qpos[addresses.arm_qpos[i]]
            if error is not None:
                angle = angle + error[i]
            if last is not None:
                lead, gear = self.config.action.max_lead, self._gear(actuator)
                sent = last[actuator] if gear == 1.0 else last[actuator] / gear
                angle = jnp.clip(sent, angle - lead, angle + lead)
            target = angle + self.config.action_scale * action[i]
            low, high = (float(limit) for limit in model.jnt_range[addresses.arm_joints[i]])
            if low < high:
                target = jnp.clip(target, low, high)
            targets.append(target)
        return targets

    def _ctrl(self, values: Sequence[jax.Array]) -> jax.Array:
        """Inputs of the actuators [nu] from a value [] of each joint's angle."""
        ctrl = [jnp.zeros_like(values[0])] * self.mj_model.nu
        for actuator, value in zip(self._addresses.actuators, values, strict=True):
            gear = self._gear(actuator)
            ctrl[actuator] = value if gear == 1.0 else gear * value
        return jnp.stack(ctrl)

    def _gear(self, actuator: int) -> float:
        return float(self.mj_model.actuator_gear[actuator, 0])

    def finish_step(self, state: State, action: jax.Array, physics: PhysicsState) -> State:
        """The part of a step after the physics: the task's, and the observation.

        A non-finite physics state ends the episode and is replaced by the previous one, so that
        nothing non-finite leaves the environment. A NaN action ends it too.

        Args:
          state: before the step.
          action: [n], as `step` takes it.
          physics: after the step, from any engine.
        """
        before = state.pipeline_state
        finite = jnp.array(True)
        for coordinates in jax.tree.leaves(physics):
            finite &= jnp.all(jnp.abs(coordinates) < _MAX_COORDINATE)
        # The previous state is checked too, in case memory was corrupted.
        physics = jax.tree.map(
            lambda new, old: jnp.where(
                finite, new, jnp.where(jnp.abs(old) < _MAX_COORDINATE, old, 0.0)
            ),
            physics,
            before.physics,
        )
        action, is_number = _acting(action)
        action = jnp.where(finite, action, before.last_action)
        finite &= is_number

        truth = self.kinematics(before._replace(physics=physics))
        done = self.task.step(before.task, Step(truth, before.command, action, before.last_action))
        too_fast = jnp.any(jnp.abs(truth.joint_velocities) > self.config.max_joint_velocity)

        dtype = truth.ball_position.dtype
        ends = {"non_finite": ~finite, "too_fast": too_fast}
        metrics = _metrics(done, dtype) | {name: end.astype(dtype) for name, end in ends.items()}
        after = before._replace(
            physics=physics,
            command=self._moved(done.state, before.command),
            task=done.state,
            last_action=action,
        )
        if before.memory is not None:
            after = after._replace(memory=self._next_memory(after, truth))
            after = self._with_impact(after, truth)
        return state.replace(
            pipeline_state=after,
            obs=self.observe(after, truth),
            reward=sum(done.reward.values()),
            done=(~finite | done.ended | too_fast).astype(dtype),
            # Wrappers add their own metrics, which a step must keep.
            metrics=state.metrics | metrics | self._privileged(before.world, truth),
        )

    def _moved(self, state: Any, command: dict[str, jax.Array]) -> dict[str, jax.Array]:
        """The commands that the task moves on, with a sentence for a name that it mistypes."""
        named = f"next_command of the task {type(self.task).__name__}"
        try:
            following = self.task.next_command(state, command)
        except KeyError as error:
            check_names(named, "command", {*command, str(error.args[0])}, command)
            raise
        check_names(named, "command", following, command)
        return following

    def kinematics(self, state: EnvState) -> Kinematics:
        """True positions and velocities of one environment's state, read from its physics."""
        addresses, (qpos, qvel) = self._addresses, (state.physics.qpos, state.physics.qvel)

        def of_balls(coordinates: jax.Array, entries: list[tuple[int, ...]]) -> jax.Array:
            rows = [jnp.stack([coordinates[i] for i in row]) for row in entries]
            return rows[0] if len(rows) == 1 else jnp.stack(rows)

        return Kinematics(
            joint_angles=jnp.stack([qpos[i] for i in addresses.arm_qpos]),
            ball_position=of_balls(qpos, [ball.qpos[:3] for ball in addresses.balls]),
            ball_quaternion=of_balls(qpos, [ball.qpos[3:] for ball in addresses.balls]),
            joint_velocities=jnp.stack([qvel[i] for i in addresses.arm_qvel]),
            ball_velocity=of_balls(qvel, [ball.qvel[:3] for ball in addresses.balls]),
            ball_angular_velocity=of_balls(qvel, [ball.qvel[3:] for ball in addresses.balls]),
            paddle_position=self.engine.paddle_position(state.parameters, qpos),
        )

    def observe(self, state: EnvState, truth: Kinematics | None = None) -> jax.Array:
        """The observation [observation_size] of a state, laid out as `layout`.

        Args:
          truth: `kinematics(state)`, if it has already been computed.
        """
        command = _entries(state.command)
        if state.memory is None or state.memory.sensing is None:
            truth = self.kinematics(state) if truth is None else truth
            values = truth._asdict() | command
            if self.config.num_balls > 1:
                values = {name: _flat(value) for name, value in values.items()}
            return self.layout.pack(values)
        seen = dict(state.memory.sensing.seen)
        # A command may have been set since the last step.
        for name in command.keys() & seen.keys():
            seen[name] = jnp.concatenate([command[name][None], seen[name][1:]])
        return self.layout.pack({name: values.reshape(-1) for name, values in seen.items()})

    @property
    def _needs_sensing(self) -> bool:
        return sensing.is_needed(self.config.randomization, self.config.observation)

    def _first_memory(self, state: EnvState, truth: Kinematics, rng: jax.Array) -> Memory:
        config, dtype = self.config, truth.ball_position.dtype
        counter = jax.lax.bitcast_convert_type(jax.random.bits(rng, dtype=jnp.uint32), jnp.int32)
        memory = Memory(
            counter=counter,
            step=jnp.zeros((), jnp.int32),
            phases=noise.uniform(counter, noise.Stream.COMMAND, (3,), dtype),
            command_age=jnp.zeros((), dtype),
            command_ranges=None,
            actuation=actuation.start_actuation(
                config.randomization,
                config.control_dt,
                self.servo_targets(state.physics, jnp.zeros(self.action_size, dtype)),
                moving=self._limits is not None,
            ),
            sensing=None,
            impact=self._first_impact(state.world),
        )
        return self._first_measurements(state, truth, memory) if self._needs_sensing else memory

    def _first_measurements(self, state: EnvState, truth: Kinematics, memory: Memory) -> Memory:
        """The memory with the measurements of a reset, which the histories repeat. The ball has
        rested until then."""
        config = self.config
        balls = sensing.resting_ball(config.randomization, config.control_dt, truth)
        picture = self._picture(state.world, balls, sensing.picture_long_ago(truth), memory)
        measured = self._measured(state, truth, memory, picture)
        task, own = self.task.first_quantities(measured)
        values = measured | own
        seen = {
            name: jnp.broadcast_to(values[name], (count, *values[name].shape))
            for name, count in config.observation.seen().items()
        }
        return memory._replace(sensing=Sensing(balls, picture, seen, task))

    def _next_memory(self, state: EnvState, truth: Kinematics) -> Memory:
        """The memory after a control step: time, and the measurements of the new state."""
        memory, config = state.memory, self.config
        memory = memory._replace(
            step=memory.step + 1, command_age=memory.command_age + config.control_dt
        )
        past = memory.sensing
        if past is None:
            return memory
        ball = sensing.position_and_velocity(truth)
        balls = jnp.concatenate([ball[None], past.balls[:-1]])
        picture = self._picture(state.world, balls, past.picture, memory)
        measured = self._measured(state, truth, memory, picture)
        seen = sensing.remember(config.observation, past.seen, measured)
        own = {name: past.seen[name] for name in config.observation.seen("task")}
        task, own = self.task.next_quantities(past.task, own, measured)
        return memory._replace(sensing=Sensing(balls, picture, seen | own, task))

    def _with_impact(self, state: EnvState, truth: Kinematics) -> EnvState:
        """The state that knows the speed of the next impact."""
        if state.memory.impact is None:
            return state
        qpos, addresses, parameters = state.physics.qpos, self._addresses, state.parameters
        moving = [jnp.zeros_like(qpos[0])] * self.mj_model.nq
        for i, address in enumerate(addresses.arm_qpos):
            moving[address] = truth.joint_velocities[i]
        _, velocity = jax.jvp(
            lambda qpos: self.engine.paddle_position(parameters, qpos),
            (qpos,),
            (jnp.stack(moving),),
        )
        radius = parameters.ball_radius
        if radius is None:
            radius = self.mj_model.geom_size[addresses.ball_geom, 0]
        height = radius + np.min(self.mj_model.geom_size[addresses.paddle_geom])
        following = impact.next_impact(
            state.memory.impact,
            gap=truth.ball_position[..., 2] - truth.paddle_position[2] - height,
            speed=velocity[2] - truth.ball_velocity[..., 2],
        )
        return state._replace(memory=state.memory._replace(impact=following))

    def in_world(self, state: EnvState, world: World) -> EnvState:
        """The state with other values of the terms of its world."""
        memory, own = state.memory, MODEL_PARAMETERS
        if memory is not None and memory.impact is not None:
            damping = self._first_impact(world).damping
            memory = memory._replace(impact=memory.impact._replace(damping=damping))
        if self._randomize is not None:
            given = jax.eval_shape(self._randomize, jax.random.PRNGKey(0))
            pairs = zip(given, state.parameters, strict=True)
            own = PhysicsParameters(*(None if x is None else value for x, value in pairs))
        parameters = self._parameters(world, own)
        return state._replace(world=world, parameters=parameters, memory=memory)

    def _parameters(self, world: World, own: PhysicsParameters) -> PhysicsParameters:
        """The physics of a drawn world, in which the parameters of `randomize` replace its own."""
        drawn = physics_parameters(world, self.mj_model)
        pairs = zip(own, drawn, strict=True)
        return PhysicsParameters(*(value if x is None else x for x, value in pairs))

    def _first_impact(self, world: World) -> Impact | None:
        if "restitution_slope" not in world:
            return None
        return impact.first_impact(world, direct_solref(self.mj_model)[0])

    def _picture(
        self, world: World, balls: jax.Array, last: sensing.Picture, memory: Memory
    ) -> sensing.Picture:
        """The last picture of the ball that has arrived at a control step."""
        return sensing.take_picture(
            self.config.observation,
            world,
            balls,
            last,
            memory.counter,
            memory.phases[0],
            memory.step,
            self.config.control_dt,
        )

    def _measured(
        self, state: EnvState, truth: Kinematics, memory: Memory, picture: sensing.Picture
    ) -> dict[str, jax.Array]:
        """The measured value [size] of each quantity of the world and of each command."""
        angles, velocities = sensing.measured_joints(state.world, memory.counter, truth)
        paddle = truth.paddle_position
        if self._misjudges_paddle:
            paddle = self.engine.paddle_position(
                MODEL_PARAMETERS, self._measured_qpos(state.physics, angles)
            )
        return truth._asdict() | {
            "joint_angles": angles,
            "joint_velocities": velocities,
            "ball_position": picture.position,
            "ball_velocity": picture.velocity,
            "paddle_position": paddle,
            **_entries(state.command),
            "action": state.last_action,
            **self._servo_lead(state, angles),
            "ball_age": picture.age[None],
            "ball_picture": picture.position,
        }

    def _servo_lead(self, state: EnvState, angles: jax.Array) -> dict[str, jax.Array]:
        """Distances of the last servo targets from the measured joint angles [n], rad; nothing if
        an action does not add to them."""
        if state.ctrl is None:
            return {}
        # The servo shares the offset of the encoder's zero.
        angles = angles - state.world.get("encoder_bias", 0.0)
        sent = [state.ctrl[i] / self._gear(i) for i in self._addresses.actuators]
        return {"servo_lead": jnp.stack(sent) - angles}

    def _measured_qpos(self, physics: PhysicsState, joint_angles: jax.Array) -> jax.Array:
        """qpos [nq] with measured joint angles [n]."""
        qpos = [physics.qpos[i] for i in range(self.mj_model.nq)]
        for i, address in enumerate(self._addresses.arm_qpos):
            qpos[address] = joint_angles[i]
        return jnp.stack(qpos)

    @property
    def _misjudges_paddle(self) -> bool:
        """Whether the measured paddle position differs from the true one, and matters."""
        observation = self.config.observation
        wrong = {"encoder_bias", "joint_angle_noise", "paddle_offset", "paddle_tilt"}
        matters = observation.paddle_position or observation.seen("task")
        return bool(matters and wrong & set(self.config.randomization.terms))

    def _privileged(self, world: World, truth: Kinematics) -> dict[str, jax.Array]:
        """Quantities that only a critic may see: `world/<term>` and, where the sensors differ from
        the truth, `true/<quantity>`. Each entry of an array has its own name with an index."""
        named = {f"world/{name}": value for name, value in world.items()}
        if self._needs_sensing:
            hidden = ("joint_angles", "ball_position", "joint_velocities", "ball_velocity")
            named |= {f"true/{name}": getattr(truth, name) for name in hidden}
            named["true/ball_angular_velocity"] = truth.ball_angular_velocity
            named["true/paddle_position"] = truth.paddle_position
        return {
            name if value.ndim == 0 else f"{name}_{i}": entry
            for name, value in named.items()
            for i, entry in enumerate(_flat(value) if value.ndim else (value,))
        }


def world_model(config: WorldConfig, visual: bool = True) -> mujoco.MjModel:
    """Compiles the model of a world; `visual` and the errors are those of `load_model`."""
    mj_model = load_model(
        config.mjcf, config.physics_dt, visual, config.robot, num_balls=config.num_balls
    )
    if config.friction is None:
        return mj_model
    return edited_model(mj_model, PhysicsParameters(contact_friction=np.float64(config.friction)))


def _acting(action: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The action [n] that acts, and whether that is the clipped one []: a NaN acts as 0."""
    is_number = ~jnp.any(jnp.isnan(action))
    return jnp.where(is_number, jnp.clip(action, -1.0, 1.0), 0.0), is_number


def _metrics(done: TaskStep, dtype: jnp.dtype) -> dict[str, jax.Array]:
    """The metrics of a task's step, each []."""
    numbers = {name: jnp.asarray(value, dtype) for name, value in done.metrics.items()}
    return {f"reward/{name}": value for name, value in done.reward.items()} | numbers


def _flat(value: jax.Array) -> jax.Array:
    """The entries of a value in one axis."""
    return jnp.ravel(value) if value.ndim > 1 else value


def _entries(command: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Commands as quantities of the observation, each [1]."""
    return {name: value[None] for name, value in command.items()}
