"""From the policy's action to the inputs of the physics: servo targets with limits, latency and
lag, pushes, and the air."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.physics import Control
from bounce_mjx.physics.control import Moving, servo_target
from bounce_mjx.robot.model import Addresses, find_addresses, joint_ranges, scatter
from bounce_mjx.robot.setpoints import Setpoint, joint_limits, next_setpoint
from bounce_mjx.world import noise
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.noise import Clock
from bounce_mjx.world.randomization import RandomizationConfig, World

# Time between pushes if only their speed is given, s.
DEFAULT_PUSH_INTERVAL = 2.0


class ActuationMemory(NamedTuple):
    """Memory of the actuation; a field is None if no setting needs it."""

    setpoint: Setpoint | None = None
    """The joints' setpoints at the end of the last step, each entry [n], to which an action adds;
    the position alone in an arm without limits, whose setpoints jump. None if an action adds to the
    measured angles."""
    queue: Control | None = None
    """Controls of the last control steps, each entry [K, nu], the newest first."""
    filtered: jax.Array | None = None
    """Outputs of the servos' lags [nu]."""


class Actuators:
    """The actuators of a world.

    An action goes through `Actuators.next` from top to bottom. It asks for a target of each joint;
    with the base "target", the next setpoint is as near to the targets as the arm's limits allow.
    The targets, or the setpoint's motion in an arm with limits, are the physics' `Control`; latency
    and lag delay it, and `physics.control.servo_target` gives its value in each physics step.
    """

    def __init__(
        self, config: WorldConfig, mj_model: mujoco.MjModel, addresses: Addresses | None = None
    ):
        self._config = config
        self._nu = mj_model.nu
        self._addresses = addresses or find_addresses(mj_model)
        self._range = joint_ranges(mj_model, self._addresses)
        self._limits = joint_limits(config.robot.limits, *self._range)
        self._gears = mj_model.actuator_gear[list(self._addresses.actuators), 0]

    def first(self, qpos: jax.Array) -> ActuationMemory:
        """Memory at a reset, with the servos at rest at qpos [nq]: the controls before the first
        action are without `servo_offset`."""
        zeros = jnp.zeros(self._config.num_joints, qpos.dtype)
        targets = self._joint_targets(self._joint_angles(qpos), zeros, None)
        setpoint = None
        if self._config.action.base == "target":
            setpoint = Setpoint(targets, zeros, zeros)
        # Taken as a step at rest, so that its pytree has the structure of a later one's.
        after = self._next_setpoint(setpoint, targets)
        control = self._control(targets, setpoint, after)
        memory = start_actuation(self._config.randomization, self._config.control_dt, control)
        return memory._replace(setpoint=after)

    def next(
        self,
        before: ActuationMemory,
        qpos: jax.Array,
        action: jax.Array,
        world: World,
        clock: Clock | None,
    ) -> tuple[Control, ActuationMemory]:
        """The inputs of the physics over a control step, and the memory after it.

        Args:
          before: the memory before the step.
          qpos: true positions before the step [nq].
          action: clipped [n].
          world: the values that the episode sampled.
          clock: before the step; None for a world that is not randomised and has no sensing.
        """
        angles = self._joint_angles(qpos)
        if "joint_angle_noise" in world:
            # The same noise as in the observation from which the policy chose the action: the clock
            # moves on before the sensors measure.
            angle_noise, _ = noise.joints(clock.counter, self._config.num_joints, action.dtype)
            angles = angles + world["joint_angle_noise"] * angle_noise
        targets = self._joint_targets(angles, action, before.setpoint)
        setpoint = self._next_setpoint(before.setpoint, targets)
        control = self._control(targets, before.setpoint, setpoint)
        if "servo_offset" in world:
            control = control._replace(ctrl=control.ctrl + self._ctrl(world["servo_offset"]))
        control, memory = add_delay(
            world, before, control, self._config.control_dt, self._config.num_substeps
        )
        control = control._replace(air_drag=world.get("air_drag"))
        if "push_speed" in world:
            control = control._replace(ball_push=self._ball_push(world, clock))
        return control, memory._replace(setpoint=setpoint)

    def _joint_angles(self, qpos: jax.Array) -> jax.Array:
        """Positions of the acting joints [n], rad."""
        return jnp.stack([qpos[i] for i in self._addresses.arm_qpos])

    def _joint_targets(
        self, angles: jax.Array, action: jax.Array, setpoint: Setpoint | None
    ) -> jax.Array:
        """The target of each joint [n], rad: an angle plus the scaled action, clipped to the range.

        Args:
          angles: measured [n], rad, without the offset of the encoders' zeros, which the servo
            shares.
          action: clipped [n].
          setpoint: the last setpoint, to which the action adds after it is clipped to `max_lead`
            of the measured angles; None if the action adds to these.
        """
        base = angles
        if setpoint is not None:
            max_lead = self._config.action.max_lead
            base = jnp.clip(setpoint.position, angles - max_lead, angles + max_lead)
        targets = base + self._config.action_scale * action
        return jnp.clip(targets, *jnp.asarray(self._range, targets.dtype))

    def _next_setpoint(self, setpoint: Setpoint | None, targets: jax.Array) -> Setpoint | None:
        """The setpoint at the end of a control step: as near to the targets [n] as the limits
        allow. None if the actions add to the measured angles, as nothing has to be remembered."""
        if setpoint is None:
            return None
        if self._limits is None:
            return Setpoint(targets, None, None)
        return next_setpoint(self._limits, setpoint, targets, self._config.control_dt, jnp)

    def _control(
        self, targets: jax.Array, before: Setpoint | None, after: Setpoint | None
    ) -> Control:
        """The control that takes the joints to the end of a control step, without delays.

        Args:
          targets: of the joints [n], rad; in an arm without limits.
          before: the setpoint at the start of the step, in an arm with limits.
          after: the setpoint at the end of the step, in an arm with limits.
        """
        if self._limits is None:
            return Control(self._ctrl(targets))
        # Times in seconds end here: the physics counts physics steps.
        physics_dt = self._config.physics_dt
        moving = Moving(
            velocity=self._ctrl(before.velocity * physics_dt),
            acceleration=self._ctrl(after.acceleration * physics_dt**2),
            last_acceleration=self._ctrl(before.acceleration * physics_dt**2),
            smoothing=self._smoothing_steps(targets.dtype),
        )
        return Control(self._ctrl(before.position), moving)

    def _smoothing_steps(self, dtype: jnp.dtype) -> jax.Array | None:
        """Time [nu] of the mean that limits the jerk, in physics steps; None without such a
        limit."""
        if self._limits.smoothing is None:
            return None
        steps = jnp.asarray(self._limits.smoothing / self._config.physics_dt, dtype)
        # An actuator of no joint has a target of zero, whatever the time.
        return scatter(np.ones(self._nu), self._addresses.actuators, steps)

    def _ctrl(self, values: jax.Array) -> jax.Array:
        """Inputs of the actuators [nu] from a value of each joint's angle [n]."""
        gears = jnp.asarray(self._gears, values.dtype)
        return scatter(np.zeros(self._nu), self._addresses.actuators, gears * values)

    def _ball_push(self, world: World, clock: Clock) -> jax.Array:
        """Velocity [3] that a push adds to the ball at the start of a control step, m/s; 0 at most
        steps. Several balls are pushed at one time, each in its direction [B, 3]."""
        phase = clock.push_phase
        interval = world.get("push_interval", jnp.full_like(phase, DEFAULT_PUSH_INTERVAL))
        is_due = noise.is_due(interval, phase, clock.step, self._config.control_dt)
        num_balls = self._config.num_balls
        shape = () if num_balls == 1 else (num_balls,)
        # Any counter of the step would do; with this one the pushes are those of earlier versions.
        counter = noise.next_counter(clock.counter)
        angle = 2.0 * math.pi * noise.uniform(counter, noise.PUSH, shape, phase.dtype)
        speed = jnp.where(is_due, world["push_speed"], 0.0)
        x = speed * jnp.cos(angle)
        y = speed * jnp.sin(angle)
        return jnp.stack([x, y, jnp.zeros_like(x)], axis=-1)


def start_actuation(
    config: RandomizationConfig, control_dt: float, control: Control
) -> ActuationMemory:
    """Memory of latency and lag at a reset.

    Args:
      config: the terms of the world.
      control_dt: time of one control step, s.
      control: under which the servos rest.
    """
    queue = None
    if config.action_latency is not None:
        # If the floor rounds a whole number of steps down, the entry that is missing is not used.
        length = math.floor(config.action_latency[1] / control_dt) + 2
        queue = jax.tree.map(
            lambda value: jnp.broadcast_to(value, (length, *value.shape)), _varying(control)
        )
    filtered = None
    if config.servo_lag is not None:
        filtered = control.ctrl
    return ActuationMemory(queue=queue, filtered=filtered)


def _varying(control: Control) -> Control:
    """The control without what is the same in each step."""
    if control.moving is None:
        return control
    return control._replace(moving=control.moving._replace(smoothing=None))


def add_delay(
    world: World, memory: ActuationMemory, control: Control, control_dt: float, num_substeps: int
) -> tuple[Control, ActuationMemory]:
    """The control of a control step with latency and lag, and the memory after the step.

    The targets arrive late by any number of physics steps, and the servos' first-order lag filters
    them.

    Args:
      world: the values that the episode sampled.
      memory: before the step.
      control: of the step's action, without drag and push, which are never late.
      control_dt: time of one control step, s.
      num_substeps: physics steps in a control step.
    """
    queue = memory.queue
    if queue is not None:
        queue = jax.tree.map(with_newest, queue, _varying(control))
        latency = world["action_latency"] / control_dt
        control = _late_control(queue, control, latency, num_substeps)
    filtered = memory.filtered
    if filtered is not None:
        lag_steps = world["servo_lag"] / (control_dt / num_substeps)
        control = control._replace(filtered=filtered, lag=lag_steps)
        last_step = jnp.asarray(num_substeps - 1, filtered.dtype)
        filtered = servo_target(control, last_step)
    return control, memory._replace(queue=queue, filtered=filtered)


def _late_control(
    queue: Control, control: Control, latency: jax.Array, num_substeps: int
) -> Control:
    """The control that acts in a control step: an older one until the physics step `switch`, and
    the one after it from then on.

    Args:
      queue: controls of the last control steps, each entry [K, nu], that of this step's action
        first.
      control: of this step's action.
      latency: in control steps [].
      num_substeps: physics steps in a control step.
    """
    # Without the 1e-4, rounding could turn a latency of one 10 ms step into zero whole steps
    # and a switch at the end of the step.
    whole = jnp.floor(latency + 1e-4)
    newer = jax.tree.map(lambda entries: entry_at(entries, whole), queue)
    older = jax.tree.map(lambda entries: entry_at(entries[1:], whole), queue)
    switch = jnp.round((latency - whole) * num_substeps)
    if control.moving is None:
        return newer._replace(previous=older.ctrl, switch=switch)
    if control.moving.smoothing is None:
        # The motion of the newer one reaches back into the older one's step.
        return newer._replace(switch=switch)
    moving = newer.moving._replace(
        smoothing=control.moving.smoothing,
        older_acceleration=older.moving.last_acceleration,
        num_substeps=jnp.asarray(num_substeps, control.ctrl.dtype),
    )
    return newer._replace(moving=moving, switch=switch)


def with_newest(queue: jax.Array, newest: jax.Array) -> jax.Array:
    """A queue [K, ...] with a new value [...] in front, without its oldest one."""
    return jnp.concatenate([newest[None], queue[:-1]])


def entry_at(queue: jax.Array, index: jax.Array) -> jax.Array:
    """Entry of a queue [K, ...] at a whole-number index []; beyond the end, the last entry."""
    # XLA fuses a chain of selections with what follows; it does not fuse indexing.
    entry = queue[0]
    for i in range(1, len(queue)):
        entry = jnp.where(index >= i, queue[i], entry)
    return entry
