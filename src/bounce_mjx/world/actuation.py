"""Inputs of the physics from the policy's action: servo targets with latency and lag; pushes."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.physics import Control
from bounce_mjx.physics.control import servo_target
from bounce_mjx.world import noise
from bounce_mjx.world.randomization import RandomizationConfig, World

# Time between pushes if only their speed is given, s.
DEFAULT_PUSH_INTERVAL = 2.0


class Actuation(NamedTuple):
    """Memory of the actuation; a field is None if no term needs it."""

    targets: jax.Array | None
    """Servo targets of the last control steps [K, nu], the newest first."""
    filtered: jax.Array | None
    """Outputs of the servos' lags [nu]."""


def start_actuation(
    config: RandomizationConfig, control_dt: float, targets: jax.Array
) -> Actuation | None:
    """Memory at a reset, with the servos at rest at the targets [nu]."""
    queue = filtered = None
    if config.action_latency is not None:
        length = math.floor(config.action_latency[1] / control_dt) + 2
        queue = jnp.broadcast_to(targets, (length, *targets.shape))
    if config.servo_lag is not None:
        filtered = targets
    return None if queue is None and filtered is None else Actuation(queue, filtered)


def delayed(
    world: World,
    actuation: Actuation | None,
    targets: jax.Array,
    control_dt: float,
    num_substeps: int,
) -> tuple[Control, Actuation | None]:
    """Control of a control step from the targets [nu] of its action.

    The targets arrive late by any number of physics steps, and the servos' first-order lag filters
    them.
    """
    control = Control(targets)
    if actuation is None:
        return control, None
    queue = actuation.targets
    if queue is not None:
        queue = jnp.concatenate([targets[None], queue[:-1]])
        latency = world["action_latency"] / control_dt
        # Without the 1e-4, rounding could turn a latency of one 10 ms step into zero whole steps
        # and a switch at the end of the step.
        whole = jnp.floor(latency + 1e-4)
        control = Control(
            ctrl=taken(queue, whole),
            previous=taken(queue[1:], whole),
            switch=jnp.round((latency - whole) * num_substeps),
        )
    filtered = actuation.filtered
    if filtered is not None:
        steps = world["servo_lag"] / (control_dt / num_substeps)
        control = control._replace(filtered=filtered, lag=steps)
        filtered = servo_target(control, jnp.asarray(num_substeps - 1, targets.dtype))
    return control, Actuation(queue, filtered)


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
