"""Spin and orientation of a ball."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from bounce_mjx.physics.scalars import (
    Quaternion,
    Vec,
    quaternion_matrix,
    quaternion_product,
    sine_cosine,
)


class Turning(NamedTuple):
    """Spin and orientation of the ball."""

    spin: Vec
    """Angular velocity in the world, rad/s. Without a torque it is constant for a sphere, both in
    the world and in the ball's frame."""
    orientation: Quaternion
    """Unit quaternion w, x, y, z."""


def read_turning(quaternion: Quaternion, spin: Vec) -> Turning:
    """Spin in the world and normalised orientation from MuJoCo's coordinates."""
    orientation = _normalise(quaternion)
    return Turning(quaternion_matrix(orientation) @ spin, orientation)


def spin_in_ball(turning: Turning) -> Vec:
    """Spin in the ball's frame, MuJoCo's coordinates."""
    return quaternion_matrix(turning.orientation).T @ turning.spin


def advance_turning(turning: Turning, acceleration: Vec, dt: float) -> Turning:
    """Spin and orientation after a time dt, in which the new spin turns the orientation."""
    spin = turning.spin + acceleration * dt
    squared = spin @ spin
    still = squared < float(jnp.finfo(squared.dtype).tiny)
    inverse_speed = lax.rsqrt(jnp.where(still, 1.0, squared))
    sine, cosine = sine_cosine(0.5 * dt * (squared * inverse_speed))
    rotation = (cosine, *(spin * (sine * inverse_speed)))
    return Turning(spin, quaternion_product(rotation, turning.orientation))


def _normalise(quaternion: Quaternion) -> Quaternion:
    w, x, y, z = quaternion
    inverse_norm = lax.rsqrt(w * w + x * x + y * y + z * z)
    return w * inverse_norm, x * inverse_norm, y * inverse_norm, z * inverse_norm
