"""Time and random numbers of an episode in a randomised world, or with sensing.

An environment's `step` takes no key. A few integer operations on a counter in its state give
numbers that are random enough for the noise of sensors.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.physics.scalars import sine_cosine

BALL, JOINTS, FRAME_DROP, PUSH, GOAL = range(5)
"""Streams: independent random numbers of one counter, by their use. A new one goes to the end: a
stream's number decides its random numbers."""

# Numbers of a stream; no use needs more at a time.
_STREAM_SIZE = 1024


class Clock(NamedTuple):
    """What the random events of an episode depend on."""

    counter: jax.Array
    """Counter of the random numbers [], int32."""
    step: jax.Array
    """Control steps since the reset [], int32."""
    phases: jax.Array
    """Phases [3] at the reset, as shares of an interval: of the camera, the time until its first
    picture; of the pushes and of the goals, the time since the last one. The three properties
    have their names."""

    @property
    def camera_phase(self) -> jax.Array:
        """Share of an interval [] from the reset until the first picture is taken."""
        return self.phases[0]

    @property
    def push_phase(self) -> jax.Array:
        """Share of an interval [] that had passed at the reset."""
        return self.phases[1]

    @property
    def goal_phase(self) -> jax.Array:
        """Share of an interval [] that had passed at the reset."""
        return self.phases[2]


def first_clock(key: jax.Array, dtype: jnp.dtype) -> Clock:
    """The clock at a reset: a sampled counter, step 0 and sampled phases; consumes the key."""
    counter = jax.lax.bitcast_convert_type(jax.random.bits(key, dtype=jnp.uint32), jnp.int32)
    # A redraw of the goals takes this stream too, from the next counter.
    phases = uniform(counter, GOAL, (3,), dtype)
    return Clock(counter, jnp.zeros((), jnp.int32), phases)


def next_clock(clock: Clock) -> Clock:
    """The clock of the next control step."""
    return clock._replace(counter=next_counter(clock.counter), step=clock.step + 1)


def next_counter(counter: jax.Array) -> jax.Array:
    """Counter [] (int32) of the next control step: a linear congruential generator (the
    constants of PCG, O'Neill 2014)."""
    return counter * jnp.int32(747796405) + jnp.int32(-1403630843)


def is_due(interval: jax.Array, phase: jax.Array, step: jax.Array, control_dt: float) -> jax.Array:
    """Whether an event that recurs falls into a control step [], bool.

    Args:
      interval: time between two events [], s.
      phase: share of an interval that had passed at the reset [].
      step: control steps since the reset [], int.
      control_dt: time of one control step, s.
    """
    intervals_per_step = control_dt / interval
    passed = phase + step.astype(phase.dtype) * intervals_per_step
    return jnp.floor(passed + intervals_per_step) > jnp.floor(passed)


def uniform(counter: jax.Array, stream: int, shape: tuple[int, ...], dtype: jnp.dtype) -> jax.Array:
    """Uniform numbers in (0, 1).

    Args:
      counter: of a `Clock` [], int32.
      stream: one of the streams above; each has its own numbers.
      shape: of the result.
      dtype: of the result.
    """
    size = math.prod(shape)
    index = jnp.arange(size, dtype=jnp.int32) + jnp.int32(stream * _STREAM_SIZE)
    bits = _mix(counter + _mix(index))
    shares = jax.lax.shift_right_logical(bits, jnp.int32(9)).astype(dtype)
    return ((shares + 0.5) * 2.0**-23).reshape(shape)


def normal(counter: jax.Array, stream: int, shape: tuple[int, ...], dtype: jnp.dtype) -> jax.Array:
    """Normally distributed numbers with mean 0 and variance 1 (Box and Muller 1958).

    Args:
      counter: of a `Clock` [], int32.
      stream: one of the streams above.
      shape: of the result.
      dtype: of the result.
    """
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


def _mix(bits: jax.Array) -> jax.Array:
    """A bijection of int32 in which every output bit depends on every input bit (lowbias32 of
    Wellons, hash-prospector)."""

    def shifted(bits: jax.Array, count: int) -> jax.Array:
        return jax.lax.shift_right_logical(bits, jnp.int32(count))

    bits = (bits ^ shifted(bits, 16)) * jnp.int32(0x7FEB352D)
    bits = (bits ^ shifted(bits, 15)) * jnp.int32(0x846CA68B - 2**32)
    return bits ^ shifted(bits, 16)
