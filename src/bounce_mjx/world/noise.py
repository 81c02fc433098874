"""Time and random numbers of an episode in a randomised world.

An environment's `step` takes no key. A few integer operations on a counter in its state give
numbers that are random enough for the noise of sensors.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.physics.scalars import sine_cosine

BALL, JOINTS, FRAME_DROP, PUSH, COMMAND = range(5)
"""Streams: independent random numbers of one counter, by their use."""


class Clock(NamedTuple):
    """What the random events of an episode depend on."""

    counter: jax.Array
    """Counter of the random numbers [], int32."""
    step: jax.Array
    """Control steps since the reset [], int32."""
    phases: jax.Array
    """Share of the current interval that had passed at the reset [3]: camera, pushes, commands."""


def first_clock(key: jax.Array, dtype: jnp.dtype) -> Clock:
    """The clock at a reset; consumes the key."""
    counter = jax.lax.bitcast_convert_type(jax.random.bits(key, dtype=jnp.uint32), jnp.int32)
    phases = uniform(counter, COMMAND, (3,), dtype)
    return Clock(counter, jnp.zeros((), jnp.int32), phases)


def next_clock(clock: Clock) -> Clock:
    """The clock of the next control step."""
    return clock._replace(counter=next_counter(clock.counter), step=clock.step + 1)


def next_counter(counter: jax.Array) -> jax.Array:
    """Counter [] (int32) of the next control step: a linear congruential generator (the
    constants of PCG, O'Neill 2014)."""
    return counter * jnp.int32(747796405) + jnp.int32(-1403630843)


def uniform(counter: jax.Array, stream: int, shape: tuple[int, ...], dtype: jnp.dtype) -> jax.Array:
    """Uniform numbers in (0, 1) of the given shape; each stream of a counter has its own
    numbers."""
    size = math.prod(shape)
    index = jnp.arange(size, dtype=jnp.int32) + jnp.int32(stream * 1024)
    bits = _mix(counter + _mix(index))
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


def joints(counter: jax.Array, num_joints: int, dtype: jnp.dtype) -> tuple[jax.Array, jax.Array]:
    """Normally distributed numbers for the measured angle and velocity of each joint, both [n]."""
    numbers = normal(counter, JOINTS, (2 * num_joints,), dtype)
    return numbers[:num_joints], numbers[num_joints:]


def _mix(x: jax.Array) -> jax.Array:
    """A bijection of int32 in which every output bit depends on every input bit (lowbias32 of
    Wellons, hash-prospector)."""
    shift = lambda x, n: jax.lax.shift_right_logical(x, jnp.int32(n))  # noqa: E731
    x = (x ^ shift(x, 16)) * jnp.int32(0x7FEB352D)
    x = (x ^ shift(x, 15)) * jnp.int32(0x846CA68B - 2**32)
    return x ^ shift(x, 16)
