"""Running statistics of the networks' inputs, and normalisation with them."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

# A normalised input is clipped to this many standard deviations.
MAX_NORMALIZED = 10.0
# Added to the variance of every input.
MIN_VARIANCE = 1e-6
# A constant input has the standard deviation sqrt(MIN_VARIANCE), up to rounding.
MIN_STD = 1.01 * MIN_VARIANCE**0.5


class Normalizer(NamedTuple):
    """What inputs are normalised with."""

    mean: jax.Array
    """Mean of each input [N]."""
    std: jax.Array
    """Standard deviation of each input [N]."""


class RunningStatistics(NamedTuple):
    """Statistics of all inputs so far."""

    count: jax.Array
    """Number of inputs [], float32: it stays as it is once a batch is less than 2^-24 of it, after
    about 2^24 iterations."""
    mean: jax.Array
    """Mean of the inputs [N]; 0 before the first input."""
    summed_variance: jax.Array
    """Sum of the squared distances of the inputs from their mean [N]: `count` times their
    variance. The name is brax's, and that of stored states."""
    std: jax.Array
    """Standard deviation of the inputs [N], including MIN_VARIANCE; 1 before the first input."""

    @property
    def normalizer(self) -> Normalizer:
        """The normaliser that uses these statistics."""
        return Normalizer(self.mean, self.std)


def init_normalizer(size: int) -> Normalizer:
    """The normaliser [size] that changes nothing but what is clipped."""
    return Normalizer(mean=jnp.zeros(size, jnp.float32), std=jnp.ones(size, jnp.float32))


def init_statistics(size: int) -> RunningStatistics:
    """Statistics of inputs [size] before the first one."""
    mean, std = init_normalizer(size)
    return RunningStatistics(
        count=jnp.zeros((), jnp.float32),
        mean=mean,
        summed_variance=jnp.zeros_like(mean),
        std=std,
    )


def update(statistics: RunningStatistics, batch: jax.Array) -> RunningStatistics:
    """Adds a batch of inputs [..., N] (Welford 1962; for batches, Chan, Golub and LeVeque 1979)."""
    batch_axes = tuple(range(batch.ndim - 1))
    batch_count = batch.size // batch.shape[-1]
    count = statistics.count + batch_count
    from_old_mean = batch - statistics.mean
    mean = statistics.mean + jnp.sum(from_old_mean, axis=batch_axes) / count
    from_new_mean = batch - mean
    added_squares = jnp.sum(from_old_mean * from_new_mean, axis=batch_axes)
    # Rounding may make the sum negative.
    summed_variance = jnp.maximum(statistics.summed_variance + added_squares, 0.0)
    std = jnp.sqrt(summed_variance / count + MIN_VARIANCE)
    return RunningStatistics(count, mean, summed_variance, std)


def normalize(inputs: jax.Array, normalizer: Normalizer) -> jax.Array:
    """Inputs [..., N] in standard deviations from their mean, clipped to +-MAX_NORMALIZED.

    An input that varied by less than about 1.4e-4 (a standard deviation) counts as constant, and
    becomes 0 whatever its value. Such are the ball's quaternion and spin: the fused physics keeps
    them constant, but on other engines they drift by rounding, which must not be magnified into a
    signal.
    """
    standardized = (inputs - normalizer.mean) / normalizer.std
    clipped = jnp.clip(standardized, -MAX_NORMALIZED, MAX_NORMALIZED)
    return jnp.where(normalizer.std > MIN_STD, clipped, 0.0)


def denormalize(normalized: jax.Array, normalizer: Normalizer) -> jax.Array:
    """Inputs [..., N] in their own units, from normalised ones: the inverse of `normalize`. An
    input that was clipped stays so, and a constant one is its mean."""
    return normalizer.mean + normalizer.std * normalized
