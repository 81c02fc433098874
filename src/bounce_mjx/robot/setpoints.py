"""Setpoints between two actions, within an arm's limits of velocity, acceleration and jerk.

The simulation and a deployed policy compute them with these functions, one with JAX's arrays and
the other with NumPy's. An action wishes a velocity for the end of its control step. The velocity
changes linearly until then, as far as the limits allow; and the command is never so fast that it
could not stop within the joint's range. The mean of these commands over the last `smoothing`
seconds has a limited jerk too; a mean keeps all other limits.
"""

from types import ModuleType
from typing import Any, NamedTuple

Number = Any
"""A float, or an array of NumPy or JAX with an entry for each joint."""


class JointLimits(NamedTuple):
    """Limits of one joint's command, or of several."""

    velocity: Number
    """rad/s."""
    acceleration: Number
    """rad/s^2."""
    smoothing: Number | None = None
    """Time of the mean that limits the jerk, s: twice the acceleration over the jerk; None for a
    joint without such a limit. At most a control step."""
    range: tuple[Number, Number] | None = None
    """Lowest and highest command, rad; infinite or None for a joint without a range."""


class Setpoint(NamedTuple):
    """The command at the end of a control step, before the mean."""

    position: Number
    """rad."""
    velocity: Number
    """rad/s."""
    acceleration: Number
    """During the whole step, rad/s^2."""


def next_setpoint(
    limits: JointLimits, start: Setpoint, target: Number, duration: float, xp: ModuleType
) -> Setpoint:
    """The setpoint at the end of a control step.

    Args:
      start: that at the step's start.
      target: where the joint is wished at the step's end, rad.
      duration: of a control step, s.
      xp: `numpy` or `jax.numpy`.
    """
    position, velocity, _ = start
    wished = (target - position) / duration
    least, most = -limits.velocity, limits.velocity
    if limits.range is not None:
        low, high = limits.range
        most = xp.minimum(most, _stoppable(high - position, velocity, limits, duration, xp))
        least = xp.maximum(least, -_stoppable(position - low, -velocity, limits, duration, xp))
    change = limits.acceleration * duration
    after = xp.clip(wished, least, most)
    after = xp.clip(after, velocity - change, velocity + change)
    return Setpoint(
        position + 0.5 * (velocity + after) * duration, after, (after - velocity) / duration
    )


def _stoppable(
    room: Number, velocity: Number, limits: JointLimits, duration: float, xp: ModuleType
) -> Number:
    """Highest velocity at the end of a step from which a command can stop within some room (rad)
    from its present position.

    A stop from v takes v / (a T) steps, of which the last brakes with less than a. It needs at most
    v^2 / 2a + a T^2 / 8, and v T / 2 if it takes one step.
    """
    change = limits.acceleration * duration
    left = room - 0.5 * velocity * duration
    in_one = xp.minimum(left / duration, change)
    in_several = xp.sqrt(xp.maximum(2.0 * limits.acceleration * left, 0.0)) - 0.5 * change
    return xp.maximum(in_one, in_several)


def command(
    start: Setpoint,
    acceleration: Number,
    time: Number,
    xp: ModuleType,
    smoothing: Number | None = None,
    lag: Number | None = None,
    earlier: tuple[Number, Number] | None = None,
) -> Number:
    """The command of a control step, rad; in any unit of time.

    Args:
      start: the setpoint at the step's start.
      acceleration: in the step.
      time: since the step's start; negative for the step before.
      smoothing: as `JointLimits.smoothing`.
      lag: time constant of a first-order lag that follows the command; it has done so forever.
      earlier: duration of a step, and the acceleration two steps before `acceleration`; needed for
        a negative time with a smoothing.
    """
    half, variance = (0.0, 0.0) if smoothing is None else (0.5 * smoothing, smoothing**2 / 12.0)
    delay = 0.0 if lag is None else lag
    # A parabola, averaged and delayed, is one again; an acceleration that changes at a time adds
    # the response to a kink.
    spread = variance + delay * delay
    x = time - half - delay
    result = start.position + start.velocity * x + 0.5 * start.acceleration * (x * x + spread)
    result = result + (acceleration - start.acceleration) * _kink(time, smoothing, lag, xp)
    if earlier is not None:
        duration, before = earlier
        x = x + duration
        kink = 0.5 * (x * x + spread) - _kink(time + duration, smoothing, lag, xp)
        result = result + (before - start.acceleration) * kink
    return result


def _kink(time: Number, smoothing: Number | None, lag: Number | None, xp: ModuleType) -> Number:
    """Averaged and delayed t^2 / 2 from the time 0 on, and 0 before."""
    if smoothing is None:
        x = xp.maximum(time, 0.0)
        square = 0.5 * x * x
        return square if lag is None else square - lag * (x - lag * (1.0 - xp.exp(-x / lag)))

    def integral(time: Number) -> Number:
        x = xp.maximum(time, 0.0)
        cube = x * x * x / 6.0
        if lag is None:
            return cube
        return cube - lag * (0.5 * x * x - lag * (x - lag * (1.0 - xp.exp(-x / lag))))

    return (integral(time) - integral(time - smoothing)) / smoothing
