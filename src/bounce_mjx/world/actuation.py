"""From the policy's action to the inputs of the physics: servo targets with limits, latency and
lag, pushes, and the air."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.physics import Control
from bounce_mjx.physics.control import Moving, servo_target
from bounce_mjx.robot.model import command_limits, find_addresses
from bounce_mjx.robot.setpoints import Setpoint, next_setpoint
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
        self._config, self._model = config, mj_model
        self._addresses = find_addresses(mj_model)
        self._motion = command_limits(config.robot.limits, mj_model, self._addresses)
        self._gears = mj_model.actuator_gear[list(self._addresses.actuators), 0].tolist()

    def first(self, qpos: jax.Array) -> Actuation:
        """Memory at a reset, with the servos at rest at qpos [nq]."""
        config, still = self._config, jnp.zeros(self._config.num_joints, qpos.dtype)
        joints, last = self._joint_targets(qpos, still), None
        if config.action.base == "target":
            last = Setpoint(jnp.stack(joints), still, still)
        control, setpoint = self._command(joints, last)
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
        config, error = self._config, None
        if "joint_angle_noise" in world:
            # The same noise as in the observation from which the policy chose the action.
            numbers, _ = noise.joints(clock.counter, config.num_joints, action.dtype)
            error = world["joint_angle_noise"] * numbers
        wanted = self._joint_targets(qpos, action, error, before.setpoint)
        control, setpoint = self._command(wanted, before.setpoint)
        control, memory = add_delay(world, before, control, config.control_dt, config.num_substeps)
        control = control._replace(air_drag=world.get("air_drag"), air_lift=world.get("air_lift"))
        if "push_speed" in world:
            control = control._replace(ball_push=self._push(world, clock))
        return control, memory._replace(setpoint=setpoint)

    def servo_targets(
        self, qpos: jax.Array, action: jax.Array, last: Setpoint | None = None
    ) -> jax.Array:
        """`Env.servo_targets`, at the joint angles in qpos [nq]."""
        return self._ctrl(self._joint_targets(qpos, action, None, last))

    def _joint_targets(
        self,
        qpos: jax.Array,
        action: jax.Array,
        error: jax.Array | None = None,
        last: Setpoint | None = None,
    ) -> list[jax.Array]:
        """The target [] of each joint, rad: one scalar per joint, which XLA fuses with the physics;
        it would not fuse an indexed update.

        Args:
          error: error of the measured angles [n], rad, without the offset of the encoders' zeros,
            which the servo shares.
          last: the last commands, to which the action adds, within `max_lead` of the measured
            angles; None if it adds to these.
        """
        config, targets = self._config, []
        for i, joint in enumerate(self._addresses.arm_joints):
            angle = qpos[self._addresses.arm_qpos[i]]
            if error is not None:
                angle = angle + error[i]
            if last is not None:
                lead = config.action.max_lead
                angle = jnp.clip(last.position[i], angle - lead, angle + lead)
            target = angle + config.action_scale * action[i]
            low, high = (float(limit) for limit in self._model.jnt_range[joint])
            targets.append(jnp.clip(target, low, high) if low < high else target)
        return targets

    def _command(
        self, wanted: list[jax.Array], last: Setpoint | None
    ) -> tuple[Control, Setpoint | None]:
        """The control that takes each joint to a target [], as far as its limits allow, and the
        command at the end of the step."""
        if self._motion is None:
            after = None if last is None else Setpoint(jnp.stack(wanted), None, None)
            return Control(self._ctrl(wanted)), after
        dt, substep = self._config.control_dt, self._config.physics_dt
        starts = [Setpoint(*(x[i] for x in last)) for i in range(len(wanted))]
        ends = [
            next_setpoint(limits, start, target, dt, jnp)
            for limits, start, target in zip(self._motion, starts, wanted, strict=True)
        ]
        moving = Moving(
            velocity=self._ctrl([start.velocity * substep for start in starts]),
            acceleration=self._ctrl([end.acceleration * substep**2 for end in ends]),
            before=self._ctrl([start.acceleration * substep**2 for start in starts]),
            smoothing=self._smoothing(wanted[0].dtype),
        )
        control = Control(self._ctrl([start.position for start in starts]), moving)
        return control, Setpoint(*map(jnp.stack, zip(*ends, strict=True)))

    def _smoothing(self, dtype: jnp.dtype) -> jax.Array | None:
        """Physics steps [nu] of the mean that limits the jerk of each servo target."""
        if self._motion[0].smoothing is None:
            return None
        # An actuator of no joint has a target of zero, whatever the time.
        times, dt = np.ones(self._model.nu), self._config.physics_dt
        times[[*self._addresses.actuators]] = [limits.smoothing / dt for limits in self._motion]
        return jnp.asarray(times, dtype)

    def _ctrl(self, values: Sequence[jax.Array]) -> jax.Array:
        """Inputs of the actuators [nu] from a value [] of each joint's angle."""
        ctrl = [jnp.zeros_like(values[0])] * self._model.nu
        for actuator, gear, value in zip(
            self._addresses.actuators, self._gears, values, strict=True
        ):
            ctrl[actuator] = value if gear == 1.0 else gear * value
        return jnp.stack(ctrl)

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
        queue = jax.tree.map(
            lambda x: jnp.broadcast_to(x, (length, *x.shape)), _with_past(rest, rest)
        )
    return Actuation(queue=queue, filtered=None if config.servo_lag is None else rest.ctrl)


def _with_past(control: Control, before: Control) -> Control:
    """A control for the queue, with what its targets did in the step before the one before."""
    moving = control.moving
    if moving is None:
        return control
    earlier = None if moving.smoothing is None else before.moving.before
    return control._replace(moving=moving._replace(smoothing=None, earlier=earlier))


def add_delay(
    world: World, memory: Actuation, control: Control, control_dt: float, num_substeps: int
) -> tuple[Control, Actuation]:
    """Control of a control step from that of its action, which has targets alone.

    The targets arrive late by any number of physics steps, and the servos' first-order lag filters
    them.
    """
    queue, filtered, moving = memory.queue, memory.filtered, control.moving
    if queue is not None:
        newest = _with_past(control, jax.tree.map(lambda q: q[0], queue))
        queue = jax.tree.map(lambda new, q: jnp.concatenate([new[None], q[:-1]]), newest, queue)
        latency = world["action_latency"] / control_dt
        # Without the 1e-4, rounding could turn a latency of one 10 ms step into zero whole steps
        # and a switch at the end of the step.
        whole = jnp.floor(latency + 1e-4)
        control = jax.tree.map(lambda q: entry_at(q, whole), queue)
        if moving is None:
            control = control._replace(previous=entry_at(queue.ctrl[1:], whole))
        elif moving.smoothing is not None:
            duration = jnp.asarray(num_substeps, control.ctrl.dtype)
            late = control.moving._replace(smoothing=moving.smoothing, duration=duration)
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
