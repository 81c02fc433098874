"""The policy and the value network: multilayer perceptrons with orthogonal weights.

A policy's file stores the parameters under the names of these modules, so the names must not
change.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

_GAIN = math.sqrt(2.0)
# A small gain, so that the first mean actions are near 0.
_MEAN_GAIN = 0.01


def orthogonal(gain: float) -> Callable[..., jax.Array]:
    """An initialiser (key, shape [N, M], type) -> weights [N, M] with orthogonal columns (rows if
    M > N), all of the norm `gain` (Saxe et al. 2014).

    The weights are those of `jax.nn.initializers.orthogonal` up to rounding, but come from Gram and
    Schmidt's method, applied twice (Giraud et al. 2005), instead of LAPACK or cuSOLVER: these
    libraries take longer to load than the weights to compute, and batched calls of jaxlib's LAPACK
    may wait for each other for ever.
    """

    def init(key: jax.Array, shape: tuple[int, int], dtype: Any = jnp.float32) -> jax.Array:
        size = max(shape), min(shape)
        numbers = jax.random.normal(key, size, dtype)

        def add_column(index: jax.Array, columns: jax.Array) -> jax.Array:
            column = numbers[:, index]
            for _ in range(2):
                parts = jnp.sum(columns * column[:, None], axis=0)
                column = column - jnp.sum(columns * parts, axis=1)
            return columns.at[:, index].set(column / jnp.linalg.norm(column))

        columns = jax.lax.fori_loop(0, size[1], add_column, jnp.zeros(size, dtype))
        return gain * (columns if shape == size else columns.T)

    return init


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


class MLP(nn.Module):
    """Dense layers hidden_0, hidden_1, ... with an activation between them."""

    widths: tuple[int, ...]
    """Width of each layer."""
    activate_final: bool
    """Whether the activation follows the last layer too."""
    dtype: Any = None
    """Type in which hidden layers are computed; None for that of inputs and parameters."""
    activation: str = "silu"
    """Name of the activation in `flax.linen`."""

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Outputs [..., widths[-1]] for inputs [..., N]."""
        for i, width in enumerate(self.widths):
            is_hidden = self.activate_final or i + 1 < len(self.widths)
            dtype = self.dtype if is_hidden else None
            init, name = orthogonal(_GAIN), f"hidden_{i}"
            dense = nn.Dense(width, dtype=dtype, kernel_init=init, name=name)
            x = getattr(nn, self.activation)(dense(x)) if is_hidden else dense(x)
        return x


class PolicyNetwork(nn.Module):
    """A Gaussian over actions: its mean depends on the input, its standard deviation does not."""

    hidden_layers: tuple[int, ...]
    action_size: int
    init_noise_std: float
    dtype: Any = None
    """Type in which the hidden layers are computed; None for that of inputs and parameters."""
    activation: str = "silu"

    @nn.compact
    def __call__(self, observation: jax.Array) -> Gaussian:
        """Distribution of the action [..., A] for normalised observations [..., N]."""
        hidden = MLP(self.hidden_layers, True, self.dtype, self.activation)(observation)
        mean_init = orthogonal(_MEAN_GAIN)
        mean = nn.Dense(self.action_size, kernel_init=mean_init)(hidden)
        first = jnp.full(self.action_size, jnp.log(jnp.float32(self.init_noise_std)))
        log_std = self.param("std_logparam", lambda _: {"log_value": first})["log_value"]
        return Gaussian(mean, jnp.broadcast_to(jnp.exp(log_std), mean.shape))
