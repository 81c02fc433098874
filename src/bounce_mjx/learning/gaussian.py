"""The distribution of the actions."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp


class Gaussian(NamedTuple):
    """Independent normal distributions of A variables."""

    mean: jax.Array
    """Means [..., A], which are also the mode."""
    std: jax.Array
    """Standard deviations [..., A]."""

    def log_prob(self, value: jax.Array) -> jax.Array:
        """Logarithm [...] of the joint density at a value [..., A]."""
        deviation = (value - self.mean) / self.std
        log_density = (
            -0.5 * jnp.square(deviation) - jnp.log(self.std) - 0.5 * math.log(2.0 * math.pi)
        )
        return jnp.sum(log_density, axis=-1)

    def entropy(self) -> jax.Array:
        """Differential entropy [...], nats: sum of log(std) + log(2 pi e) / 2."""
        return jnp.sum(jnp.log(self.std) + 0.5 * math.log(2.0 * math.pi * math.e), axis=-1)
