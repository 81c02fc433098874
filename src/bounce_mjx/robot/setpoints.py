"""Setpoints between two actions, within an arm's limits of velocity, acceleration and jerk.

The simulation computes them with JAX's arrays (`world.actuation`, and `position_at` within a step
in `physics.control`), and a deployed policy with NumPy's (`deploy.motion`).

**Velocity and acceleration.** An action asks for a position. The command's velocity changes
linearly from v0 to v1 within the control step, of the duration T. v1 is the distance divided by T,
clipped to the limit of velocity, then to v0 -/+ a T. At the end of the step the command is thus
where the action asks only if v0 = v1; from rest, it has covered half of the distance.

**Range.** The command must be able to stop in the `room` between its position and the end of the
joint's range. The step itself takes (v0 + v1) T / 2 of it; `left = room - v0 T / 2`. A stop from v1
brakes with a in each step and with less in the last one, from r <= a T to 0 over r T / 2 instead of
r^2 / 2a. The excess r T / 2 - r^2 / 2a is at most a T^2 / 8. A stop of several steps thus fits if

    v1 T / 2 + v1^2 / 2a + a T^2 / 8 = (v1 + a T / 2)^2 / 2a <= left

so v1 <= sqrt(2 a left) - a T / 2. A stop of one step (v1 <= a T) takes v1 T / 2 more, v1 T
together, so v1 <= left / T. Each bound suffices, so the larger one holds.

**Jerk.** A jump of the acceleration is at most 2 a. The mean of the command over the last
s = 2 a / j seconds turns it into a ramp of the slope j, the jerk's limit. A mean keeps all limits
(Biagiotti and Melchiorri 2012, "FIR filters for online trajectory planning"). s is at most T, as
otherwise two jumps would add up.

**Mean and lag of a parabola.** In a step the command is a parabola p of the acceleration a. A mean
over s weights the past evenly: its delay has the expectation s / 2 and the variance s^2 / 12. A
first-order lag of the time constant l weights it by exp(-t / l) / l: l and l^2. Both together have
the sums d and w of these, and average the parabola to

    p(t - d) + a w / 2

A jump b of the acceleration at the time 0 adds b times the averaged and lagged t^2 / 2 (`_kink`).
"""

from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

Number = Any
"""A float, or an array of NumPy or JAX with an entry for each joint."""


class JointLimits(NamedTuple):
    """Limits of the commands of several joints; each a number for all, or an array [n]."""

    velocity: Number
    """rad/s."""
    acceleration: Number
    """rad/s^2."""
    smoothing: Number | None = None
    """Time of the mean that limits the jerk, s: twice the acceleration over the jerk; None without
    such a limit. At most a control step (`WorldConfig` refuses others)."""
    range: tuple[Number, Number] = (-np.inf, np.inf)
    """Lowest and highest command, rad; infinite for a joint without a range."""


class Setpoint(NamedTuple):
    """The command at the end of a control step, which is the start of the next one, before the
    mean."""

    position: Number
    """rad."""
    velocity: Number
    """rad/s."""
    acceleration: Number
    """During the whole step that ends here, rad/s^2."""


def joint_limits(limits: Any, low: Number = -np.inf, high: Number = np.inf) -> JointLimits | None:
    """The limits of an arm's commands; None if they have none.

    Args:
      limits: velocity, acceleration and jerk of the joints, such as `LimitsConfig`.
      low: lower ends of the joints' ranges [n], rad.
      high: upper ends [n], rad.
    """
    if limits is None or limits.velocity is None:
        return None
    acceleration = np.array(limits.acceleration)
    smoothing = None if limits.jerk is None else 2.0 * acceleration / np.array(limits.jerk)
    return JointLimits(np.array(limits.velocity), acceleration, smoothing, range=(low, high))


def next_setpoint(
    limits: JointLimits, start: Setpoint, target: Number, duration: float, xp: ModuleType
) -> Setpoint:
    """The setpoint at the end of a control step.

    Args:
      limits: of the commands.
      start: that at the end of the step before.
      target: the position that the action asks for, rad.
      duration: of a control step, s.
      xp: `numpy` or `jax.numpy`.
    """
    position, velocity, _ = start
    asked = (target - position) / duration
    low, high = limits.range
    up = _stopping_velocity(high - position, velocity, limits, duration, xp)
    down = _stopping_velocity(position - low, -velocity, limits, duration, xp)
    least = xp.maximum(-limits.velocity, -down)
    most = xp.minimum(limits.velocity, up)
    largest_change = limits.acceleration * duration
    # The limit of the acceleration comes last: a command that is too fast for its range brakes.
    new_velocity = xp.clip(asked, least, most)
    new_velocity = xp.clip(new_velocity, velocity - largest_change, velocity + largest_change)
    return Setpoint(
        position=position + 0.5 * (velocity + new_velocity) * duration,
        velocity=new_velocity,
        acceleration=(new_velocity - velocity) / duration,
    )


def _stopping_velocity(
    room: Number, velocity: Number, limits: JointLimits, duration: float, xp: ModuleType
) -> Number:
    """Highest velocity at the end of a step from which a command can stop within the `room` (rad)
    from its position at the step's start."""
    change = limits.acceleration * duration
    left = room - 0.5 * velocity * duration
    in_one = xp.minimum(left / duration, change)
    in_several = xp.sqrt(xp.maximum(2.0 * limits.acceleration * left, 0.0)) - 0.5 * change
    return xp.maximum(in_one, in_several)


def position_at(
    start: Setpoint,
    acceleration: Number,
    time: Number,
    xp: ModuleType,
    smoothing: Number | None = None,
    lag: Number | None = None,
    earlier: tuple[Number, Number] | None = None,
) -> Number:
    """The position of a setpoint that moves in a control step, rad. Its times, velocities and
    accelerations may be in seconds or in another unit of time, such as the physics step, if all are
    in the same one.

    Args:
      start: the setpoint at the step's start.
      acceleration: in the step.
      time: since the step's start; negative for the step before.
      smoothing: as `JointLimits.smoothing`.
      lag: time constant of a first-order lag behind the command, whose transient is over.
      earlier: duration of a step, and the acceleration of the step before that of
        `start.acceleration`; needed for a negative time with a smoothing.
    """
    half = 0.0
    variance = 0.0
    if smoothing is not None:
        half = 0.5 * smoothing
        variance = smoothing**2 / 12.0
    delay = 0.0 if lag is None else lag
    spread = variance + delay * delay
    delayed = time - half - delay
    squared = delayed * delayed + spread
    position = start.position + start.velocity * delayed + 0.5 * start.acceleration * squared
    position = position + (acceleration - start.acceleration) * _kink(time, smoothing, lag, xp)
    if earlier is not None:
        duration, earlier_acceleration = earlier
        delayed = delayed + duration
        squared = delayed * delayed + spread
        kink = 0.5 * squared - _kink(time + duration, smoothing, lag, xp)
        position = position + (earlier_acceleration - start.acceleration) * kink
    return position


def _kink(time: Number, smoothing: Number | None, lag: Number | None, xp: ModuleType) -> Number:
    """The function that is t^2 / 2 from the time 0 on and 0 before, averaged and lagged.

    The lag's y solves l y' = t^2 / 2 - y with y(0) = 0; the mean is a difference of integrals.
    """
    if smoothing is None:
        since = xp.maximum(time, 0.0)
        square = 0.5 * since * since
        if lag is None:
            return square
        return square - lag * (since - lag * (1.0 - xp.exp(-since / lag)))

    def integral(time: Number) -> Number:
        since = xp.maximum(time, 0.0)
        square = 0.5 * since * since
        cube = since * since * since / 6.0
        if lag is None:
            return cube
        return cube - lag * (square - lag * (since - lag * (1.0 - xp.exp(-since / lag))))

    return (integral(time) - integral(time - smoothing)) / smoothing
