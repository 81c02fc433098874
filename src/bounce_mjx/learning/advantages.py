"""Generalised advantage estimation."""

import jax
import jax.numpy as jnp

# Number of steps of the recursion that are unrolled into one kernel on a GPU. For each result XLA
# writes out all steps before it, so the kernel's code grows with the square of this number.
_UNROLL = 16


def generalized_advantages(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    truncated: jax.Array,
    discount: float,
    gae_lambda: float,
) -> jax.Array:
    """Advantages [T, B] of T steps of B environments (Schulman et al. 2016, equation 16).

    Args:
      reward, value: reward of each step, and value of the state before it [T, B].
      next_value: value of the state after the step [T, B]; at a time-out, the value of the old
        episode's last state, not of the new episode's first one.
      terminated: steps without a following value [T, B], bool.
      truncated: steps whose following value counts, but across which no advantage is propagated
        back [T, B], bool.
    """
    delta = reward + discount * jnp.where(terminated, 0.0, next_value) - value
    carried = discount * gae_lambda * (~(terminated | truncated))

    def backward(advantage, step):
        delta, carried = step
        advantage = delta + carried * advantage
        return advantage, advantage

    _, advantages = jax.lax.scan(
        backward, jnp.zeros_like(delta[0]), (delta, carried), reverse=True, unroll=_UNROLL
    )
    return advantages
