"""Measured quantities from the true state: a camera with latency, noisy sensors, and their
history."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.world import noise
from bounce_mjx.world.actuation import taken
from bounce_mjx.world.observation import Kinematics, ObservationConfig
from bounce_mjx.world.randomization import RandomizationConfig, World

SENSOR_TERMS = frozenset(
    "ball_latency camera_rate frame_drop ball_position_noise ball_position_bias "
    "ball_velocity_noise ball_velocity_bias joint_angle_noise encoder_bias joint_velocity_noise "
    "joint_velocity_bias paddle_offset paddle_tilt".split()
)
"""Terms that make measurements differ from the truth."""


# Age, s, and number of pictures, that no control step has.
_LONG_AGO = 1e6


class Picture(NamedTuple):
    """Last picture of the ball that arrived and was not lost; it shows all balls ([B, 3])."""

    position: jax.Array
    """Measured position [3], m."""
    velocity: jax.Array
    """Measured velocity or difference quotient of the last two pictures [3], m/s."""
    age: jax.Array
    """Time since the picture was taken [], s."""
    number: jax.Array
    """Number of the last picture due since the reset []; negative for those taken before it."""


class Sensing(NamedTuple):
    """Memory of the sensors."""

    balls: jax.Array
    """True position and velocity of the ball in the last control steps [K, 6], the newest first;
    [K, B, 6] with several balls."""
    picture: Picture
    seen: dict[str, jax.Array]
    """Last values of each observed quantity [H, size], the newest first."""
    task: Any
    """What the task remembers of the measurements."""


def is_needed(randomization: RandomizationConfig, observation: ObservationConfig) -> bool:
    """Whether the observation differs from the true state of a single instant."""
    return bool(SENSOR_TERMS & set(randomization.terms)) or not observation.is_momentary


def resting_ball(
    randomization: RandomizationConfig, control_dt: float, truth: Kinematics
) -> jax.Array:
    """`Sensing.balls` at a reset, before which the ball rested."""
    length = math.ceil(oldest_picture(randomization) / control_dt - 1e-6) + 1
    ball = position_and_velocity(truth)
    return jnp.broadcast_to(ball, (length, *ball.shape))


def position_and_velocity(truth: Kinematics) -> jax.Array:
    """Position and velocity of the ball [6], or of each ball [B, 6]."""
    return jnp.concatenate([truth.ball_position, truth.ball_velocity], axis=-1)


def picture_long_ago(truth: Kinematics) -> Picture:
    """The picture before the first one, so long ago that their difference is not a velocity."""
    zero = jnp.zeros((), truth.ball_position.dtype)
    return Picture(truth.ball_position, truth.ball_velocity, zero + _LONG_AGO, zero - _LONG_AGO)


def oldest_picture(randomization: RandomizationConfig) -> float:
    """Greatest age of the last picture if none is lost, s."""
    latency = (randomization.ball_latency or (0.0, 0.0))[1]
    rate = randomization.camera_rate
    return latency if rate is None else latency + 1.0 / rate[0]


def joint_angle_noise(
    world: World, counter: jax.Array, num_joints: int, dtype: jnp.dtype
) -> jax.Array | None:
    """Noise [n] of the measured joint angles of a control step, rad; None if there is no noise."""
    if "joint_angle_noise" not in world:
        return None
    noises = noise.normal(counter, noise.Stream.JOINTS, (2 * num_joints,), dtype)
    return world["joint_angle_noise"] * noises[:num_joints]


def take_picture(
    observation: ObservationConfig,
    world: World,
    balls: jax.Array,
    last: Picture,
    counter: jax.Array,
    phase: jax.Array,
    step: jax.Array,
    control_dt: float,
) -> Picture:
    """Last picture that has arrived at a control step.

    A camera takes pictures at its own rate, independent of the control steps. Between two control
    steps, the ball's path is the cubic with the true positions and velocities at both, which is
    exact in free flight; the velocity is interpolated linearly. Each picture arrives after the
    latency or is lost; the first one is not lost.

    Args:
      balls: `Sensing.balls`, including the ball of this control step.
      last: the last picture at the control step before.
      phase: share of a picture interval that had passed at the reset [].
      step: control steps since the reset [].
    """
    dtype = balls.dtype
    steps = step.astype(dtype)
    latency = world.get("ball_latency", jnp.zeros((), dtype)) / control_dt
    if "camera_rate" in world:
        interval = 1.0 / (world["camera_rate"] * control_dt)
        # The 1e-4 lets a picture that is due at exactly this instant arrive despite rounding.
        number = jnp.floor((steps - latency) / interval - phase + 1e-4)
        age = steps - (number + phase) * interval
    else:
        number, age = steps, latency
    age = jnp.maximum(age, 0.0)
    whole = jnp.floor(age)
    newer, older = taken(balls, whole), taken(balls, whole + 1.0)
    share = age - whole
    position, velocity = _between(newer, older, share, control_dt)

    noises = noise.normal(counter, noise.Stream.BALL, balls.shape[1:], dtype)
    position = _disturbed(world, "ball_position", position, noises[..., :3])
    due = number > last.number
    arrived = due
    if "frame_drop" in world:
        lost = noise.uniform(counter, noise.Stream.FRAME_DROP, (), dtype) < world["frame_drop"]
        arrived = due & (~lost | (step == 0))
    held_age = last.age + control_dt
    if observation.velocity == "differences":
        elapsed = jnp.maximum(held_age - age * control_dt, 1e-3)
        velocity = (position - last.position) / elapsed
    velocity = _disturbed(world, "ball_velocity", velocity, noises[..., 3:])
    fresh = Picture(position, velocity, age * control_dt, number)
    # A lost picture stays lost.
    held = last._replace(age=held_age, number=jnp.where(due, number, last.number))
    return jax.tree.map(lambda new, old: jnp.where(arrived, new, old), fresh, held)


def _between(
    newer: jax.Array, older: jax.Array, share: jax.Array, control_dt: float
) -> tuple[jax.Array, jax.Array]:
    """Position [..., 3] and velocity [..., 3] between two control steps (cubic Hermite
    interpolation).

    Args:
      newer, older: position and velocity [..., 6] at each.
      share: time before the newer one as a share of the control step [].
    """
    now, before, velocity, velocity_before = (
        x[..., part] for part in (slice(3), slice(3, 6)) for x in (newer, older)
    )
    change = before - now
    start, end = -control_dt * velocity, -control_dt * velocity_before
    curve = (1.0 - share) * (start - change) - share * (end - change)
    position = now + share * (change + (1.0 - share) * curve)
    return position, velocity + share * (velocity_before - velocity)


def _disturbed(world: World, name: str, value: jax.Array, noises: jax.Array) -> jax.Array:
    if f"{name}_bias" in world:
        value = value + world[f"{name}_bias"]
    if f"{name}_noise" in world:
        value = value + world[f"{name}_noise"] * noises
    return value


def measured_joints(
    world: World, counter: jax.Array, truth: Kinematics
) -> tuple[jax.Array, jax.Array]:
    """Measured joint angles [n] (rad) and joint velocities [n] (rad/s)."""
    dtype, num_joints = truth.joint_angles.dtype, len(truth.joint_angles)
    angles, error = truth.joint_angles, joint_angle_noise(world, counter, num_joints, dtype)
    if error is not None:
        angles = angles + error
    if "encoder_bias" in world:
        angles = angles + world["encoder_bias"]
    noises = noise.normal(counter, noise.Stream.JOINTS, (2 * num_joints,), dtype)[num_joints:]
    return angles, _disturbed(world, "joint_velocity", truth.joint_velocities, noises)


def remember(
    observation: ObservationConfig,
    seen: dict[str, jax.Array],
    measured: dict[str, jax.Array],
) -> dict[str, jax.Array]:
    """Histories after the measurements of a control step; those of the task's own quantities stay.

    Args:
      seen: last values of each observed quantity [H, size].
      measured: value [size] of each quantity except the task's own.
    """
    own = observation.seen("task")
    return {
        name: past if name in own else jnp.concatenate([measured[name][None], past[:-1]])
        for name, past in seen.items()
    }
