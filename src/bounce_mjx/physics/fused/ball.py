"""Motion of the balls: homogeneous spheres, which fly freely between their contacts."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.physics.control import drag
from bounce_mjx.physics.fused.model import BallModel
from bounce_mjx.physics.scalars import (
    Quaternion,
    Scalar,
    Vec,
    quaternion_matrix,
    quaternion_product,
    sine_cosine,
)


class Turning(NamedTuple):
    """Spin and orientation of a ball."""

    spin: Vec
    """Angular velocity in the world, rad/s. Without a torque it is constant for a sphere, both in
    the world and in the ball's frame."""
    orientation: Quaternion
    """Unit quaternion w, x, y, z."""


class Ball(NamedTuple):
    """State of one ball."""

    position: Vec
    """Centre in the world, m."""
    velocity: Vec
    """In the world, m/s."""
    turning: Turning | None
    """None where no contact can change the spin; `dynamics.step` then turns the ball once in each
    control step."""


def read_ball(qpos: Sequence[Scalar], qvel: Sequence[Scalar]) -> Ball:
    """A ball from the entries of its free joint: qpos [7] and qvel [6], MuJoCo's coordinates."""
    quaternion = Vec(qpos[3:])
    orientation = tuple(quaternion * jax.lax.rsqrt(quaternion @ quaternion))
    spin = quaternion_matrix(orientation) @ Vec(qvel[3:])
    return Ball(Vec(qpos[:3]), Vec(qvel[:3]), Turning(spin, orientation))


def spin_in_ball(turning: Turning) -> Vec:
    """The spin in the ball's frame, as MuJoCo's qvel holds it, rad/s."""
    return quaternion_matrix(turning.orientation).T @ turning.spin


def free_acceleration(model: BallModel, ball: Ball, gravity: Vec, air_drag: Scalar | None) -> Vec:
    """Acceleration of a ball without contacts, m/s^2.

    Args:
      air_drag: as in `Control`; None for no air.
    """
    acceleration = gravity * model.weight
    if air_drag is None:
        return acceleration
    return acceleration + Vec(drag(air_drag, ball.velocity))


def move_ball(ball: Ball, acceleration: Vec, dt: float) -> Ball:
    """A ball after a time dt (s) with an acceleration (m/s^2, in the world), by semi-implicit
    Euler: the new velocity moves the ball, and its spin turns it."""
    velocity = ball.velocity + acceleration * dt
    position = ball.position + velocity * dt
    turning = ball.turning
    if turning is not None:
        turning = turn(turning, dt)
    return Ball(position, velocity, turning)


def turn(turning: Turning, dt: float) -> Turning:
    """Spin and orientation after a time dt (s)."""
    spin = turning.spin
    squared_speed = spin @ spin
    is_still = squared_speed < float(jnp.finfo(squared_speed.dtype).tiny)
    inverse_speed = jax.lax.rsqrt(jnp.where(is_still, 1.0, squared_speed))
    half_angle = 0.5 * dt * (squared_speed * inverse_speed)
    sine, cosine = sine_cosine(half_angle)
    rotation = (cosine, *(spin * (sine * inverse_speed)))
    return Turning(spin, quaternion_product(rotation, turning.orientation))
