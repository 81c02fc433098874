"""Flights of the ball: what the tasks share in which it flies from bounce to bounce."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from bounce_mjx.lazy import jax, jnp
from bounce_mjx.task.rewards import length, safe_sqrt

if TYPE_CHECKING:
    from bounce_mjx.robot.model import Geometry

GRAVITY = 9.81
"""Gravity in the tasks' ballistic formulas, m/s^2 (the simulated gravity is the MJCF's)."""
SETTLING_SECONDS = 2.0
"""Time since a reset or a sample of the goals after which apexes count, s."""
MAX_HEIGHT_ERROR = 0.1
"""Largest distance of an accurate apex from the target height, m."""
MIN_APEX_HEIGHT = 0.1
"""Height over home above which a ball that turns has an apex, m; a lower one rolls or dribbles."""
MIN_TARGET_HEIGHT = 0.1
"""Least target height over home, m: a lower flight has no time."""
APEX_FACTORS = (1.0, 1.0, 0.3)
"""Factors of an apex's error along x, y and z: 0.1 m of height count as 0.03 m."""


class Flight(NamedTuple):
    """A free flight without air, down to the height of its end. Its highest position may be in the
    past."""

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


def closest(
    balls: jax.Array,
    velocities: jax.Array,
    seconds: float,
    radii: Sequence[jax.Array | float] | None = None,
) -> jax.Array:
    """Smallest distance of two balls in the last `seconds` [], m. Balls in free flight see each
    other move straight on; they can pass within a control step.

    Args:
      balls: present positions [B, 3], m.
      velocities: present velocities [B, 3], m/s.
      radii: of each ball, m, for the distance of their surfaces, negative where they overlap; None
        for that of their centres.
    """
    distances = []
    for i, j in itertools.combinations(range(len(balls)), 2):
        offset = balls[i] - balls[j]
        velocity = velocities[i] - velocities[j]
        # Where the distance |offset - ago velocity| is smallest; 1e-6 for balls that move alike.
        ago = jnp.sum(offset * velocity) / jnp.maximum(jnp.sum(jnp.square(velocity)), 1e-6)
        distance = length(offset - jnp.clip(ago, 0.0, seconds) * velocity)
        if radii is not None:
            distance -= radii[i] + radii[j]
        distances.append(distance)
    return jnp.min(jnp.stack(distances))


def ground(home: Sequence[float], geometry: Geometry) -> float:
    """Height of a ball that touches the paddle at home, m.

    Args:
      home: centre of the paddle at home [3], m.
      geometry: of ball and paddle.
    """
    return home[2] + geometry.rest_height


def is_apex(
    rose: jax.Array, rises: jax.Array, height: jax.Array, home: Sequence[float]
) -> jax.Array:
    """Whether balls turn at the top of a flight [...], bool.

    Args:
      rose: whether they rose after the last step [...], bool.
      rises: whether they rise now [...], bool.
      height: of the balls [...], m.
      home: centre of the paddle at home [3], m.
    """
    return rose & ~rises & (height > home[2] + MIN_APEX_HEIGHT)


def apex_error(flight: Flight, target: jax.Array) -> jax.Array:
    """From a target to a flight's apex [..., 3], m, where 0.1 m of height count as 0.03 m.

    Args:
      target: position [..., 3], m.
    """
    return (flight.top - target) * jnp.array(APEX_FACTORS)


def landing_error(flight: Flight, target: jax.Array) -> jax.Array:
    """From a target to a flight's end, along x and y [..., 2], m.

    Args:
      target: position [..., 3], m.
    """
    return (flight.end - target)[..., :2]
