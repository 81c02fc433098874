"""Inputs of the physics from the policy's action: servo targets with latency and lag; pushes."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.physics import Control
from bounce_mjx.physics.control import Moving, servo_target
from bounce_mjx.robot.setpoints import Setpoint
from bounce_mjx.world import noise
from bounce_mjx.world.randomization import RandomizationConfig, World

# Time between pushes if only their speed is given, s.
DEFAULT_PUSH_INTERVAL = 2.0


class Actuation(NamedTuple):
    """Memory of the actuation; a field is None if no term needs it."""

    targets: jax.Array | Setpoint | None
    """Servo targets of the last control steps [K, nu], the newest first; of targets that move,
    position and velocity at the start of each step and the acceleration in it."""
    filtered: jax.Array | None
    """Outputs of the servos' lags [nu]."""


def start_actuation(
    config: RandomizationConfig, control_dt: float, targets: jax.Array, moving: bool = False
) -> Actuation | None:
    """Memory at a reset, with the servos at rest at the targets [nu].

    Args:
      moving: whether the targets move within an arm's limits.
    """
    queue = filtered = None
    if config.action_latency is not None:
        length = math.floor(config.action_latency[1] / control_dt) + 2
        queue = jnp.broadcast_to(targets, (length, *targets.shape))
        if moving:
            # Smoothing needs the acceleration one step further back.
            still = jnp.zeros((length + 1, *targets.shape), targets.dtype)
            queue = Setpoint(queue, still[1:], still)
    if config.servo_lag is not None:
        filtered = targets
    return None if queue is None and filtered is None else Actuation(queue, filtered)


def delayed(
    world: World,
    actuation: Actuation | None,
    control: Control,
    control_dt: float,
    num_substeps: int,
) -> tuple[Control, Actuation | None]:
    """Control of a control step from that of its action, which has targets alone.

    The targets arrive late by any number of physics steps, and the servos' first-order lag filters
    them.
    """
    if actuation is None:
        return control, None
    queue, targets, moving = actuation.targets, control.ctrl, control.moving
    if queue is not None:
        newest = targets
        if moving is not None:
            newest = Setpoint(targets, moving.velocity, moving.acceleration)
        queue = jax.tree.map(lambda new, q: jnp.concatenate([new[None], q[:-1]]), newest, queue)
        latency = world["action_latency"] / control_dt
        # Without the 1e-4, rounding could turn a latency of one 10 ms step into zero whole steps
        # and a switch at the end of the step.
        whole = jnp.floor(latency + 1e-4)
        if moving is None:
            control = Control(taken(queue, whole), previous=taken(queue[1:], whole))
        else:
            control = _late(queue, whole, moving, num_substeps)
        control = control._replace(switch=jnp.round((latency - whole) * num_substeps))
    filtered = actuation.filtered
    if filtered is not None:
        steps = world["servo_lag"] / (control_dt / num_substeps)
        control = control._replace(filtered=filtered, lag=steps)
        filtered = servo_target(control, jnp.asarray(num_substeps - 1, targets.dtype))
    return control, Actuation(queue, filtered)


def _late(queue: Setpoint, whole: jax.Array, moving: Moving, num_substeps: int) -> Control:
    """Control of moving targets that are late by a whole number of control steps []."""
    accelerations = queue.acceleration
    smoothed = moving.smoothing is not None
    late = Moving(
        velocity=taken(queue.velocity, whole),
        acceleration=taken(accelerations[:-1], whole),
        before=taken(accelerations[1:], whole),
        smoothing=moving.smoothing,
        earlier=taken(accelerations[2:], whole) if smoothed else None,
        duration=jnp.asarray(num_substeps, accelerations.dtype) if smoothed else None,
    )
    return Control(taken(queue.position, whole), late)


def taken(queue: jax.Array, index: jax.Array) -> jax.Array:
    """Entry of a queue [K, ...] at a whole-number index []; beyond the end, the last entry.

    The chain of selections replaces indexing, which the GPU kernel lacks.
    """
    entry = queue[0]
    for i in range(1, len(queue)):
        entry = jnp.where(index >= i, queue[i], entry)
    return entry


def push(
    world: World,
    counter: jax.Array,
    phase: jax.Array,
    step: jax.Array,
    control_dt: float,
    num_balls: int = 1,
) -> jax.Array:
    """Velocity [3] that a push adds to the ball at the start of a control step, m/s; 0 at most
    steps. Several balls are pushed at one time, each in its direction [B, 3].

    Args:
      counter: counter of the random numbers.
      phase: share of an interval that had passed at the reset [].
      step: control steps since the reset [].
    """
    interval = world.get("push_interval", jnp.full_like(phase, DEFAULT_PUSH_INTERVAL))
    now = passes(interval, phase, step, control_dt)
    each = () if num_balls == 1 else (num_balls,)
    angle = 2.0 * math.pi * noise.uniform(counter, noise.Stream.PUSH, each, phase.dtype)
    speed = jnp.where(now, world["push_speed"], 0.0)
    x, y = speed * jnp.cos(angle), speed * jnp.sin(angle)
    return jnp.stack([x, y, jnp.zeros_like(x)], axis=-1)


def passes(interval: jax.Array, phase: jax.Array, step: jax.Array, control_dt: float) -> jax.Array:
    """Whether an event that recurs every interval (s) falls into the control step [], bool."""
    per_step = control_dt / interval
    time = phase + step.astype(phase.dtype) * per_step
    return jnp.floor(time + per_step) > jnp.floor(time)
