"""Restitution that falls with the speed of an impact.

The damping of the contact is constant in a control step: that of the speed with which the ball and
the paddle approached each other at the last control step before they touched.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.world.randomization import IMPACT_SPEED, World, contact_damping

# Impact speeds between which the damping is linear, m/s.
_SLOW, _MIDDLE, _FAST = 1.0, IMPACT_SPEED, 4.0
# A ball whose gap to the paddle is smaller may touch it: the gap is that of a level paddle, m.
_NEAR = 0.01


class Impact(NamedTuple):
    """What the damping of the next contact depends on."""

    speed: jax.Array
    """Speed of approach [] at the last control step before a contact, m/s."""
    damping: jax.Array
    """Damping [3] of the contact in a slow, a medium and a fast impact, 1/s."""


def first_impact(world: World, stiffness: float) -> Impact:
    """The impact of a reset, with a drawn restitution and its slope.

    Args:
      stiffness: of the contact, 1/s^2.
    """
    speeds = jnp.array([_SLOW, _MIDDLE, _FAST], world["restitution"].dtype)
    restitution = world["restitution"] - world["restitution_slope"] * (speeds - IMPACT_SPEED)
    return Impact(jnp.zeros_like(restitution[0]), contact_damping(restitution, stiffness))


def next_impact(impact: Impact, gap: jax.Array, speed: jax.Array) -> Impact:
    """The impact after a control step.

    Args:
      gap: height of each ball's lowest point over the paddle, m [] or [B]; the lowest ball counts.
      speed: speed with which each approaches the paddle, m/s.
    """
    lowest = jnp.min(gap)
    speed = jnp.max(jnp.where(gap <= lowest, speed, 0.0))
    return impact._replace(speed=jnp.where(lowest > _NEAR, speed, impact.speed))


def damping(impact: Impact) -> jax.Array:
    """Damping [] of the contact, 1/s."""
    slow, middle, fast = (impact.damping[i] for i in range(3))
    faster = impact.speed - _MIDDLE
    rise = jnp.where(
        faster < 0.0, (middle - slow) / (_MIDDLE - _SLOW), (fast - middle) / (_FAST - _MIDDLE)
    )
    return jnp.maximum(middle + faster * rise, 0.0)
