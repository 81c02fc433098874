"""Random numbers within a control step, from a counter in the state.

An environment's `step` takes no key, and JAX's generators are not available in a GPU kernel. A few
integer operations give numbers that are random enough for sensor noise.
"""

import enum
import math

import jax
import jax.numpy as jnp

from bounce_mjx.physics.fused.scalars import sine_cosine


class Stream(enum.IntEnum):
    """Independent random numbers of one counter, by their use."""

    BALL = 0
    JOINTS = 1
    FRAME_DROP = 2
    PUSH = 3
    COMMAND = 4


def next_counter(counter: jax.Array) -> jax.Array:
    """Counter [] (int32) of the next control step: a linear congruential generator (the
    constants of PCG, O'Neill 2014)."""
    return counter * jnp.int32(747796405) + jnp.int32(-1403630843)


def uniform(counter: jax.Array, stream: int, shape: tuple[int, ...], dtype: jnp.dtype) -> jax.Array:
    """Uniform numbers in (0, 1) of the given shape; each stream of a counter has its own
    numbers."""
    size = math.prod(shape)
    index = jnp.arange(size, dtype=jnp.int32) + jnp.int32(stream * 1024)
    bits = _mixed(counter + _mixed(index))
    shares = jax.lax.shift_right_logical(bits, jnp.int32(9)).astype(dtype)
    return ((shares + 0.5) * 2.0**-23).reshape(shape)


def normal(counter: jax.Array, stream: int, shape: tuple[int, ...], dtype: jnp.dtype) -> jax.Array:
    """Normally distributed numbers with mean 0 and variance 1 (Box and Muller 1958)."""
    size = math.prod(shape)
    pairs = (size + 1) // 2
    numbers = uniform(counter, stream, (2, pairs), dtype)
    radius = jnp.sqrt(-2.0 * jnp.log(numbers[0]))
    sine, cosine = sine_cosine(2.0 * math.pi * numbers[1])
    both = jnp.concatenate([radius * cosine, radius * sine])
    return both[:size].reshape(shape)


def _mixed(x: jax.Array) -> jax.Array:
    """A bijection of int32 in which every output bit depends on every input bit (lowbias32 of
    Wellons, hash-prospector)."""
    shift = lambda x, n: jax.lax.shift_right_logical(x, jnp.int32(n))  # noqa: E731
    x = (x ^ shift(x, 16)) * jnp.int32(0x7FEB352D)
    x = (x ^ shift(x, 15)) * jnp.int32(0x846CA68B - 2**32)
    return x ^ shift(x, 16)
