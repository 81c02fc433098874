"""The simplest model of an arm: every joint follows its command, late by the same time, with a
constant offset of its own.

It needs no simulation. A fit of the robot's physics has to explain a log at least as well.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from bounce_mjx.identify.log import Log, find_gaps
from bounce_mjx.identify.response import commanded

SETTLING = 0.3
"""Time after the start of a log, or a gap, until the arm has forgotten the unknown commands before
it, s: longer than latencies are, and a few of most lags. `follow` tries delays beyond it, up to
0.4 s, whose first rows after a gap are compared with commands interpolated through it."""
_STEP = 2e-3
# Commands that change by less show no delay, rad.
_STILL = 5e-3
# Rows that a search over delays looks at; the best one is refined on all.
_ROWS = 2000
# Largest residual that counts whole in the size of the error, in medians of the absolute ones.
_OUTLIER = 6.0


class Following(NamedTuple):
    """How the joints follow their commands."""

    delay: float
    """Time from a command to the angle, of all joints, s."""
    offsets: np.ndarray
    """Measured less commanded angle [n], rad."""
    errors: np.ndarray
    """Root mean square [n] of what is left, without outliers, rad."""


def find_unknown(log: Log) -> list[tuple[float, float]]:
    """Begin and end (s) of each stretch in which the arm is not measured, or may still follow
    targets that the log lacks: around the log, and from each gap of the joint angles or the servo
    targets until the arm has settled after it."""
    begin = max(log.times[0], log.target_times[0])
    stretches = [(-np.inf, begin + SETTLING), (float(log.times[-1]), np.inf)]
    for times in (log.times, np.append(log.target_times, max(log.times[-1], log.target_times[-1]))):
        stretches += [(last, first + SETTLING) for last, first in find_gaps(times)]
    return stretches


def is_known(log: Log, times: np.ndarray) -> np.ndarray:
    """Which times [T] are in no stretch of `find_unknown`."""
    begins, ends = np.sort(np.array(find_unknown(log)).T)
    begun = np.searchsorted(begins, times, side="left")
    ended = np.searchsorted(ends, times, side="right")
    return begun == ended


def find_settled(log: Log) -> np.ndarray:
    """Which joint angles [T] depend on no targets that the log lacks."""
    return is_known(log, log.times)


def does_move(log: Log) -> bool:
    """Whether any command of a log changes, within a stretch without gaps: the arm was also moved
    between two logs that are joined."""
    begins = [first for _, first in find_gaps(log.target_times)]
    stretches = np.split(log.servo_targets, np.searchsorted(log.target_times, begins))
    return any(np.max(np.ptp(targets, axis=0)) > _STILL for targets in stretches)


def follow(log: Log, rows: np.ndarray, shortest: float = -0.05, longest: float = 0.4) -> Following:
    """Fits the common delay and each joint's offset by least squares.

    Args:
      rows: which joint angles [T] count.
      shortest: smallest delay that is tried, s.
      longest: largest one, s.
    """
    chosen = np.flatnonzero(rows)
    if not does_move(log):
        # All delays explain it equally.
        shortest = 0.0
        longest = _STEP
    few = chosen[:: max(len(chosen) // _ROWS, 1)]

    def spread(delay: float, at: np.ndarray) -> float:
        residuals = log.joint_angles[at] - commanded(log, log.times[at] - delay)
        return float(np.sum(np.abs(residuals - np.median(residuals, axis=0))))

    tried = np.arange(shortest, longest, _STEP)
    best = tried[np.argmin([spread(delay, few) for delay in tried])]
    ends = max(best - _STEP, shortest), best + _STEP
    delay = float(minimize_scalar(spread, bounds=ends, args=(chosen,), method="bounded").x)
    residuals = log.joint_angles[chosen] - commanded(log, log.times[chosen] - delay)
    offsets = np.median(residuals, axis=0)
    return Following(delay, offsets, error_size(residuals - offsets))


def shows_set_points(log: Log, following: Following) -> bool:
    """Whether the joints follow too early for commands that are held until the next: the commands
    of the log are then a controller's own set points, recorded now and then. Those of an arm that
    is still show nothing."""
    return does_move(log) and following.delay < _hold(log)


def command_delay(log: Log, following: Following) -> float:
    """The delay from a command to the angle, s, without the half step for which a command, if it is
    no set point, is held until the next."""
    if shows_set_points(log, following):
        return following.delay
    return following.delay - _hold(log)


def set_points(log: Log, following: Following, dt: float) -> Log:
    """The log with a command for each physics step of `dt` (s), between those of the log, if these
    are set points."""
    if not shows_set_points(log, following):
        return log
    times = np.arange(log.target_times[0], log.target_times[-1], dt)
    # In the middle of the step for which it is held: otherwise it would be late by half of it.
    return log._replace(target_times=times, servo_targets=commanded(log, times + 0.5 * dt))


def _hold(log: Log) -> float:
    """Mean time for which a command has been held when it acts, s: half of a control step."""
    return 0.5 * float(np.median(np.diff(log.target_times)))


def error_size(residuals: np.ndarray) -> np.ndarray:
    """Root mean square [n] of residuals [T, n], of which outliers count no more than at their
    bound."""
    size = np.abs(residuals)
    most = np.maximum(_OUTLIER * np.median(size, axis=0), 1e-9)
    return np.sqrt(np.mean(np.minimum(size, most) ** 2, axis=0))


def held_out_error(log: Log, following: Following, rows: np.ndarray) -> np.ndarray:
    """Root mean square [n] of what the model leaves in other rows [T] of a log, rad."""
    expected = commanded(log, log.times[rows] - following.delay) + following.offsets
    return error_size(log.joint_angles[rows] - expected)
