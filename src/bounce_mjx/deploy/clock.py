"""The time of a robot's samples, in control steps: the one clock of a policy and its supervisor.

A supervisor has two clocks, the driver's and the monotonic one of its own computer. Where they have
agreed for half a second, neither is believed against the other: a time of the driver that the
computer's clock contradicts is replaced by the computer's, and how long the robot has waited for
commands is told by the computer's. In a simulation that is faster or slower than its own time they
do not agree, and the driver's is the only one.
"""

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
# Time after the commands of a control step, as a share of it, from which the robot has waited.
_WAITED = 0.5
# A loop of about a step, as shares of it, whose phase is followed, and the share of it that each
# step takes back: a loop up to 5% slower or faster stays at one step each.
_LOOP = (0.85, 1.15)
_FOLLOWED = 0.1
# Time for which two clocks have to agree, s, and by how much they may differ meanwhile: the
# computer reads its own later, by what else it does. Share of a difference that is a drift.
_AGREED = 0.5
_APART = 0.015
_DRIFT = 0.01


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
    step_time: float = 0.0
    """Of the last sample that was a new control step, since the first one, s."""
    has_waited: bool = False
    """Whether the robot had come to the end of its commands when that step began, and waited."""


def advance(
    clock: Clock, time: float | None, control_dt: float, waited: float | None = None
) -> tuple[Clock, float, int]:
    """The clock at a sample, the time since the last one (s; negative if it went back), and the
    control steps since the last one.

    Args:
      time: of the sample, by the driver's clock, s; None is a control step after the last one.
      control_dt: duration of a control step, s.
      waited: time since the last new control step by another clock, s; None for this one's.
    """
    if time is None or clock.time is None:
        # The first time that is given belongs to the step after the last one.
        step = clock.step + 1
        elapsed = control_dt if clock.step >= 0 else 0.0
        origin = 0.0 if time is None else time - step * control_dt
        now = clock.now + elapsed
        return Clock(now, step, time, origin, step_time=now), elapsed, 1
    elapsed = time - clock.time
    now = clock.now + elapsed
    place = (time - clock.origin) / control_dt
    step = max(clock.step, round(place))
    steps = step - clock.step
    standing = clock.standing + 1 if abs(elapsed) < _SAME_TIME else 0
    late = clock.late + 1 if steps > 1 else clock.late - 1
    late = min(max(late, 0), MOST_LATE + 1)
    if steps == 0:
        new = clock._replace(now=now, time=time, standing=standing, late=late)
        return new, elapsed, 0
    origin = clock.origin
    low, high = _LOOP
    if low * control_dt < elapsed < high * control_dt:
        origin += _FOLLOWED * (place - step) * control_dt
    if waited is None:
        waited = now - clock.step_time
    has_waited = waited > (1.0 + _WAITED) * control_dt - _SAME_TIME
    return Clock(now, step, time, origin, standing, late, now, has_waited), elapsed, steps


def begin_anew(clock: Clock, time: float | None, control_dt: float) -> Clock:
    """The clock a control step later, of a driver whose clock begins anew at a time (s), or gives
    none."""
    step = clock.step + 1
    now = clock.now + control_dt
    origin = 0.0 if time is None else time - step * control_dt
    # Calls before this one whose time was no later had no commands, and the robot waited.
    has_waited = clock.standing > 0
    return Clock(now, step, time, origin, step_time=now, has_waited=has_waited)


class Witness(NamedTuple):
    """The driver's clock beside that of the computer (the host), which always goes on."""

    has_time: bool = False
    """Whether the driver has a clock."""
    host: float | None = None
    """The host's time at the last sample, s; None before the first one."""
    time: float = 0.0
    """Of the last sample, as it is believed: the driver's, or that since the first one, s."""
    ahead: float = 0.0
    """The host's time less the driver's, s."""
    agreed_since: float = 0.0
    """The host's time since which they agree, s."""
    stepped: float = 0.0
    """The host's time at the last new control step, s."""

    @property
    def is_agreed(self) -> bool:
        """Whether the host's clock tells how long something took."""
        if self.host is None:
            return False
        return not self.has_time or self.host - self.agreed_since > _AGREED

    def waited(self, host: float) -> float | None:
        """Time since the last new control step by the host's clock, s; None if it does not tell."""
        return host - self.stepped if self.is_agreed else None

    def at_host(self, host: float) -> "Witness":
        """The clocks at a time of the host (s) alone."""
        return self._replace(host=host, time=self.time + host - self.host)


def look(witness: Witness, time: float | None, host: float) -> tuple[Witness, bool]:
    """The clocks at a sample, and whether the driver's time is believed; if not, the host's time
    has taken its place.

    Args:
      witness: at the last sample.
      time: of the driver, s; None where it gives none.
      host: monotonic time of the computer, s.
    """
    if witness.host is None:
        first = 0.0 if time is None else time
        return Witness(time is not None, host, first, host - first, host, host), True
    if time is None:
        return witness.at_host(host), True
    late = host - time - witness.ahead
    if abs(late) <= _APART:
        ahead = witness.ahead + _DRIFT * late
        return witness._replace(host=host, time=time, ahead=ahead), True
    elapsed = time - witness.time
    # A computer may be late, and then the driver's time went on no farther than its own did.
    has_jumped = elapsed < -_APART or elapsed > host - witness.host + _APART
    if witness.is_agreed and has_jumped:
        return witness.at_host(host), False
    return witness._replace(host=host, time=time, ahead=host - time, agreed_since=host), True


def is_pause(elapsed: float) -> bool:
    """Whether a time between two samples is no step of one clock."""
    return math.fabs(elapsed) > PAUSE - 1e-6
