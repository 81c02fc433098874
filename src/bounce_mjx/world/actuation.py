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
from bounce_mjx.robot.model import find_addresses, joint_ranges, scatter
from bounce_mjx.robot.setpoints import Setpoint, joint_limits, next_setpoint
from bounce_mjx.world import noise
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.noise import Clock
from bounce_mjx.world.randomization import RandomizationConfig, World

# Time between pushes if only their speed is given, s.
DEFAULT_PUSH_INTERVAL = 2.0


class Actuation(NamedTuple):
    """Memory of the actuation; a field is None if no setting needs it."""

    setpoint: Setpoint | None = None
    """The joints' commands at the end of the last step, each entry [n], to which an action adds;
    the position alone if the commands jump."""
    queue: Control | None = None
    """Controls of the last control steps, each entry [K, nu], the newest first."""
    filtered: jax.Array | None = None
    """Outputs of the servos' lags [nu]."""


class Actuators:
    """The actuators of a world."""

    def __init__(self, config: WorldConfig, mj_model: mujoco.MjModel):
        self._config, self._nu, self._addresses = config, mj_model.nu, find_addresses(mj_model)
        self._range = joint_ranges(mj_model)
        self._limits = joint_limits(config.robot.limits, *self._range)
        self._gears = mj_model.actuator_gear[list(self._addresses.actuators), 0]

    def first(self, qpos: jax.Array) -> Actuation:
        """Memory at a reset, with the servos at rest at qpos [nq]."""
        config, still = self._config, jnp.zeros(self._config.num_joints, qpos.dtype)
        wanted, last = self._joint_targets(self._angles(qpos), still), None
        if config.action.base == "target":
            last = Setpoint(wanted, still, still)
        control, setpoint = self._command(wanted, last)
        memory = start_actuation(config.randomization, config.control_dt, control)
        return memory._replace(setpoint=setpoint)

    def next(
        self,
        before: Actuation,
        qpos: jax.Array,
        action: jax.Array,
        world: World,
        clock: Clock | None,
    ) -> tuple[Control, Actuation]:
        """The inputs of the physics over a control step, and the memory after it.

        Args:
          qpos: true positions before the step [nq].
          action: clipped [n].
          clock: before the step; None for a world that is not randomised.
        """
        config, angles = self._config, self._angles(qpos)
        if "joint_angle_noise" in world:
            # The same noise as in the observation from which the policy chose the action.
            numbers, _ = noise.joints(clock.counter, config.num_joints, action.dtype)
            angles = angles + world["joint_angle_noise"] * numbers
        wanted = self._joint_targets(angles, action, before.setpoint)
        control, setpoint = self._command(wanted, before.setpoint)
        if "servo_offset" in world:
            control = control._replace(ctrl=control.ctrl + self._ctrl(world["servo_offset"]))
        control, memory = add_delay(world, before, control, config.control_dt, config.num_substeps)
        control = control._replace(air_drag=world.get("air_drag"))
        if "push_speed" in world:
            control = control._replace(ball_push=self._push(world, clock))
        return control, memory._replace(setpoint=setpoint)

    def _angles(self, qpos: jax.Array) -> jax.Array:
        return jnp.stack([qpos[i] for i in self._addresses.arm_qpos])

    def _joint_targets(
        self, angles: jax.Array, action: jax.Array, last: Setpoint | None = None
    ) -> jax.Array:
        """The target of each joint [n], rad: an angle plus the scaled action, clipped to the range.

        Args:
          angles: measured [n], rad, without the offset of the encoders' zeros, which the servo
            shares.
          last: the last commands, to which the action adds, within `max_lead` of the measured
            angles; None if it adds to these.
        """
        if last is not None:
            lead = self._config.action.max_lead
            angles = jnp.clip(last.position, angles - lead, angles + lead)
        targets = angles + self._config.action_scale * action
        return jnp.clip(targets, *jnp.asarray(self._range, targets.dtype))

    def _command(self, wanted: jax.Array, last: Setpoint | None) -> tuple[Control, Setpoint | None]:
        """The control that takes the joints to their targets [n], as far as the limits allow, and
        the command at the end of the step."""
        if self._limits is None:
            after = None if last is None else Setpoint(wanted, None, None)
            return Control(self._ctrl(wanted)), after
        substep, smoothing = self._config.physics_dt, self._limits.smoothing
        after = next_setpoint(self._limits, last, wanted, self._config.control_dt, jnp)
        if smoothing is not None:
            # An actuator of no joint has a target of zero, whatever the time.
            times = jnp.asarray(smoothing / substep, wanted.dtype)
            smoothing = scatter(np.ones(self._nu), self._addresses.actuators, times)
        moving = Moving(
            velocity=self._ctrl(last.velocity * substep),
            acceleration=self._ctrl(after.acceleration * substep**2),
            before=self._ctrl(last.acceleration * substep**2),
            smoothing=smoothing,
        )
        return Control(self._ctrl(last.position), moving), after

    def _ctrl(self, values: jax.Array) -> jax.Array:
        """Inputs of the actuators [nu] from a value of each joint's angle [n]."""
        gears = jnp.asarray(self._gears, values.dtype)
        return scatter(np.zeros(self._nu), self._addresses.actuators, gears * values)

    def _push(self, world: World, clock: Clock) -> jax.Array:
        """Velocity [3] that a push adds to the ball at the start of a control step, m/s; 0 at most
        steps. Several balls are pushed at one time, each in its direction [B, 3]."""
        config, phase = self._config, clock.phases[1]
        interval = world.get("push_interval", jnp.full_like(phase, DEFAULT_PUSH_INTERVAL))
        now = recurs(interval, phase, clock.step, config.control_dt)
        each = () if config.num_balls == 1 else (config.num_balls,)
        counter = noise.next_counter(clock.counter)
        angle = 2.0 * math.pi * noise.uniform(counter, noise.PUSH, each, phase.dtype)
        speed = jnp.where(now, world["push_speed"], 0.0)
        x, y = speed * jnp.cos(angle), speed * jnp.sin(angle)
        return jnp.stack([x, y, jnp.zeros_like(x)], axis=-1)


def start_actuation(config: RandomizationConfig, control_dt: float, rest: Control) -> Actuation:
    """Memory of latency and lag at a reset, with the servos at rest under a control."""
    queue = None
    if config.action_latency is not None:
        length = math.floor(config.action_latency[1] / control_dt) + 2
        queue = jax.tree.map(lambda x: jnp.broadcast_to(x, (length, *x.shape)), _varying(rest))
    return Actuation(queue=queue, filtered=None if config.servo_lag is None else rest.ctrl)


def _varying(control: Control) -> Control:
    """The control without what is the same in each step."""
    moving = control.moving
    return control._replace(moving=moving and moving._replace(smoothing=None))


def add_delay(
    world: World, memory: Actuation, control: Control, control_dt: float, num_substeps: int
) -> tuple[Control, Actuation]:
    """Control of a control step from that of its action, which has targets alone.

    The targets arrive late by any number of physics steps, and the servos' first-order lag filters
    them.
    """
    queue, filtered, moving = memory.queue, memory.filtered, control.moving
    if queue is not None:
        shift = lambda new, q: jnp.concatenate([new[None], q[:-1]])  # noqa: E731
        queue = jax.tree.map(shift, _varying(control), queue)
        latency = world["action_latency"] / control_dt
        # Without the 1e-4, rounding could turn a latency of one 10 ms step into zero whole steps
        # and a switch at the end of the step.
        whole = jnp.floor(latency + 1e-4)
        control, older = (
            jax.tree.map(lambda q, age=age: entry_at(q[age:], whole), queue) for age in (0, 1)
        )
        if moving is None:
            control = control._replace(previous=older.ctrl)
        elif moving.smoothing is not None:
            late = control.moving._replace(
                smoothing=moving.smoothing,
                earlier=older.moving.before,
                duration=jnp.asarray(num_substeps, control.ctrl.dtype),
            )
            control = control._replace(moving=late)
        control = control._replace(switch=jnp.round((latency - whole) * num_substeps))
    if filtered is not None:
        steps = world["servo_lag"] / (control_dt / num_substeps)
        control = control._replace(filtered=filtered, lag=steps)
        filtered = servo_target(control, jnp.asarray(num_substeps - 1, filtered.dtype))
    return control, memory._replace(queue=queue, filtered=filtered)


def entry_at(queue: jax.Array, index: jax.Array) -> jax.Array:
    """Entry of a queue [K, ...] at a whole-number index []; beyond the end, the last entry."""
    # XLA fuses a chain of selections with what follows; it does not fuse indexing.
    entry = queue[0]
    for i in range(1, len(queue)):
        entry = jnp.where(index >= i, queue[i], entry)
    return entry


def recurs(interval: jax.Array, phase: jax.Array, step: jax.Array, control_dt: float) -> jax.Array:
    """Whether an event that recurs every interval (s) falls into the control step [], bool."""
    per_step = control_dt / interval
    time = phase + step.astype(phase.dtype) * per_step
    return jnp.floor(time + per_step) > jnp.floor(time)
