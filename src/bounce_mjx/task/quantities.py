"""Histories of a task's own quantities in the observation."""

from __future__ import annotations

from bounce_mjx.lazy import jax, jnp


def latest(past: jax.Array, starts: jax.Array, changes: jax.Array, value: jax.Array) -> jax.Array:
    """A history [H, size], the newest first, that moves on only where an event starts.

    Args:
      starts: whether a new event starts [], bool: the older values move on by one.
      changes: whether the newest value changes [], bool.
      value: the newest value then [size].
    """
    shifted = jnp.where(starts, jnp.concatenate([past[:1], past[:-1]]), past)
    newest = jnp.where(changes, value, shifted[0])
    return jnp.concatenate([newest[None], shifted[1:]])
