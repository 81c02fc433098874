"""The free flight of the ball."""

from __future__ import annotations

import itertools
from typing import NamedTuple

from bounce_mjx.lazy import jax, jnp
from bounce_mjx.task.rewards import length, safe_sqrt

GRAVITY = 9.81
"""Gravity in the tasks' ballistic formulas, m/s^2 (the simulated gravity is the MJCF's)."""


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
    """The flight of a ball down to a height; it ends at the highest position if that is lower.

    Args:
      ball: present position [..., 3], m.
      velocity: present velocity [..., 3], m/s.
      ground: height of the end, m.
    """
    rise = velocity[..., 2] / GRAVITY
    top = _position_after(rise, ball, velocity)
    fall_from_top = safe_sqrt(2.0 * (top[..., 2] - ground) / GRAVITY)
    fall = rise + fall_from_top
    return Flight(top=top, end=_position_after(fall, ball, velocity), rise=rise, fall=fall)


def _position_after(seconds: jax.Array, ball: jax.Array, velocity: jax.Array) -> jax.Array:
    """Position [..., 3] in some seconds [...] of a ball in free flight, m: p + v t - g t^2 / 2."""
    drop = 0.5 * GRAVITY * jnp.square(seconds)
    drops = jnp.stack([0.0 * drop, 0.0 * drop, drop], axis=-1)
    return ball + seconds[..., None] * velocity - drops


def closest(balls: jax.Array, velocities: jax.Array, seconds: float) -> jax.Array:
    """Smallest distance of two balls in the last `seconds` [], m. Balls in free flight see each
    other move straight on; they can pass within a control step.

    Args:
      balls: present positions [B, 3], m.
      velocities: present velocities [B, 3], m/s.
    """
    distances = []
    for i, j in itertools.combinations(range(len(balls)), 2):
        offset = balls[i] - balls[j]
        velocity = velocities[i] - velocities[j]
        # Where the distance |offset - ago velocity| is smallest; 1e-6 for balls that move alike.
        ago = jnp.sum(offset * velocity) / jnp.maximum(jnp.sum(jnp.square(velocity)), 1e-6)
        distances.append(length(offset - jnp.clip(ago, 0.0, seconds) * velocity))
    return jnp.min(jnp.stack(distances))
