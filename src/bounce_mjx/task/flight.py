"""The free flight of the ball."""

from __future__ import annotations

import itertools
from typing import NamedTuple

from bounce_mjx.lazy import jax, jnp
from bounce_mjx.task.rewards import length, safe_sqrt

GRAVITY = 9.81
"""m/s^2."""


class Flight(NamedTuple):
    """A free flight without air, from the past to the height of its end."""

    top: jax.Array
    """Highest position [..., 3], m."""
    end: jax.Array
    """Position at the end [..., 3], m."""
    rise: jax.Array
    """Time until the highest position [...], s; negative after it."""
    fall: jax.Array
    """Time until the end [...], s."""


def flight(ball: jax.Array, velocity: jax.Array, ground: float) -> Flight:
    """The flight of a ball at a position [..., 3] (m) with a velocity [..., 3] (m/s), down to the
    height `ground` (m); it ends at the highest position if that is lower."""

    def after(seconds: jax.Array) -> jax.Array:
        drop = 0.5 * GRAVITY * jnp.square(seconds)
        drops = jnp.stack([0.0 * drop, 0.0 * drop, drop], axis=-1)
        return ball + seconds[..., None] * velocity - drops

    rise = velocity[..., 2] / GRAVITY
    top = after(rise)
    fall = rise + safe_sqrt(2.0 * (top[..., 2] - ground) / GRAVITY)
    return Flight(top, after(fall), rise, fall)


def closest(balls: jax.Array, velocities: jax.Array, seconds: float) -> jax.Array:
    """Smallest distance of two balls in the last `seconds` [], m. Balls in free flight see each
    other move straight on; they can pass within a control step.

    Args:
      balls: present positions [B, 3], m.
      velocities: present velocities [B, 3], m/s.
    """
    distances = []
    for i, j in itertools.combinations(range(len(balls)), 2):
        way, speed = balls[i] - balls[j], velocities[i] - velocities[j]
        ago = jnp.sum(way * speed) / jnp.maximum(jnp.sum(jnp.square(speed)), 1e-6)
        distances.append(length(way - jnp.clip(ago, 0.0, seconds) * speed))
    return jnp.min(jnp.stack(distances))
