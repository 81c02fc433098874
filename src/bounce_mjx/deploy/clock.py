"""The time of a robot's samples, in control steps: the one clock of a policy and its supervisor."""

import math
from typing import NamedTuple

PAUSE = 1.0
"""Time between two samples that is no step of one clock, s."""

# Times of one clock that are the same sample's, and calls in a row at one time, of which nothing
# can be computed.
_SAME_TIME = 1e-9
MOST_STANDING = 25
MOST_LATE = 10
"""Late samples beyond the timely ones, of a loop that is slower than the control steps."""


class Clock(NamedTuple):
    """The time of the last sample, and the number of its control step."""

    now: float = 0.0
    """Time of the last sample since the first one, s."""
    step: int = -1
    """Number of its control step, from 0; -1 before there is one."""
    time: float | None = None
    """The same by the driver's clock, s; None where it gives none."""
    origin: float = 0.0
    """Driver's time of the step 0, s."""
    standing: int = 0
    """Calls in a row at this time."""
    late: int = 0
    """Samples before which a control step was missed, less the others since then; at least 0."""


def advance(clock: Clock, time: float | None, control_dt: float) -> tuple[Clock, float, int]:
    """The clock at a sample, the time since the last one (s; negative if it went back), and the
    control steps since the last one.

    Args:
      time: of the sample, by the driver's clock, s; None is a control step after the last one.
      control_dt: duration of a control step, s.
    """
    if time is None or clock.time is None:
        # The first time that is given belongs to the step after the last one.
        step = clock.step + 1
        elapsed = control_dt if clock.step >= 0 else 0.0
        origin = 0.0 if time is None else time - step * control_dt
        return Clock(clock.now + elapsed, step, time, origin), elapsed, 1
    elapsed = time - clock.time
    step = max(clock.step, round((time - clock.origin) / control_dt))
    standing = clock.standing + 1 if abs(elapsed) < _SAME_TIME else 0
    steps = step - clock.step
    late = clock.late + 1 if steps > 1 else clock.late - 1
    late = min(max(late, 0), MOST_LATE + 1)
    new = Clock(clock.now + elapsed, step, time, clock.origin, standing, late)
    return new, elapsed, steps


def is_pause(elapsed: float) -> bool:
    """Whether a time between two samples is no step of one clock."""
    return math.fabs(elapsed) > PAUSE - 1e-6
