"""A look at a log before any fit: does each joint follow its own command, and can the ball be one?

Each joint's measured angles are compared with its command, shifted by the delay that fits best:
measured = slope * commanded + offset + remainder. A sound log has a slope near 1, a small offset,
and one delay for all joints.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyfit
from scipy.ndimage import uniform_filter1d
from scipy.optimize import linear_sum_assignment

from bounce_mjx.identify.flight import GRAVITY
from bounce_mjx.identify.following import SETTLING, commanded, find_settled
from bounce_mjx.identify.log import Log, find_gaps

# Delays that are searched, s: a trajectory server gets its targets seconds ahead.
_SHORTEST = -0.5
_LONGEST = 3.0
_COARSE = 0.02
_FINE = 1e-3
_ROWS = 2500
# Time over which both signals are averaged for slope and offset, s: a servo damps fast motions.
_SMOOTH = 0.25
# A joint whose angle or command changes by less does not move, and one that moves by less is too
# little to judge, rad.
_STILL = 5e-3
_LITTLE = 0.05
# Delays count as equally good up to this loss of correlation, and this multiple of the least.
_TIED = 1e-8
_TIE = 1.1
# Largest delay of a servo, and largest lead that rounded stamps explain, s; and the largest
# difference between the delays of two joints or of two parts of a log.
_LATE = 0.3
_EARLY = -0.02
_APART = 0.05
# Correlations: with the own command below which a joint may belong to another, and with that one.
_OWN = 0.9
_OTHER = 0.95
_FOLLOWS = 0.7
_SLOPES = 0.85, 1.18
_DEGREES = 180.0 / np.pi
# Constant difference between angle and command that is a wrong zero, rad.
_ZERO = 0.02
_TURN = 2.0 * np.pi
# A joint that repeats its angle to the last digit for longer while its command moves faster is
# frozen, s and rad/s.
_FROZEN = 0.3
_FROZEN_SPEED = 0.05
# Share of its rows in which a joint rests, within a distance, at an end of its motion although its
# command goes beyond it, rad.
_SATURATED = 0.02
_REST = 3e-3
_BEYOND = 0.02
_EXACT = 0.9
_FALLING = float(np.linalg.norm(GRAVITY))
# Time of a piece of flight that shows the ball's acceleration, s.
_PIECE = 0.12
_FEWEST_PIECES = 10
# Distance of a piece's acceleration from gravity, in its size, up to which the ball falls.
_NEAR_GRAVITY = 0.3
# Share of the pictures without angles and targets beside them that is worth a note.
_ALONE = 0.05
_PIECES = 300


class Finding(NamedTuple):
    """What is wrong with a log."""

    kind: str
    """A word or two, such as mirrored or zero."""
    where: str
    """A joint, all joints, the stamps or the ball."""
    text: str
    """One sentence: what is wrong, in which rows or at which time, and what to do."""
    is_fault: bool = True
    """Whether a fit would blame the robot for it; otherwise it is a caution."""

    def __str__(self) -> str:
        return f"{'fault' if self.is_fault else 'note'}: {self.where}: {self.text}"


class Joint(NamedTuple):
    """How one joint follows its command."""

    name: str
    commanded: float
    """Range of the command, rad."""
    measured: float
    """Range of the angle, rad."""
    slope: float
    offset: float
    """rad"""
    delay: float
    """s"""
    correlation: float
    """Of angle and late command; its sign is the slope's."""
    remainder: float
    """Root mean square of what slope and offset leave, rad."""


class Checkup(NamedTuple):
    """A log, looked at."""

    joints: tuple[Joint, ...]
    delay: float | None
    """The common delay, s: the median of the joints that follow their commands; None if none
    does."""
    findings: tuple[Finding, ...]

    @property
    def faults(self) -> list[Finding]:
        return [finding for finding in self.findings if finding.is_fault]


def examine(logs: Sequence[Log], joint_names: Sequence[str]) -> list[Checkup]:
    """Looks at each of several logs of one robot."""
    checkups = []
    for i, log in enumerate(logs):
        checkup = _examine_one(log, joint_names)
        twins = [other.source for other in logs[:i] if _is_same(log, other)]
        if twins:
            text = f"{log.source} has the same angles as {twins[0]}; give each log once"
            finding = Finding("repeated log", "all joints", text)
            checkup = checkup._replace(findings=(finding, *checkup.findings))
        checkups.append(checkup)
    return checkups


def describe(logs: Sequence[Log], checkups: Sequence[Checkup]) -> list[str]:
    """What was seen in each log, a line each."""
    lines = []
    for log, checkup in zip(logs, checkups, strict=True):
        late = "none of its joints follows its command"
        if checkup.delay is not None:
            late = f"its joints follow their commands {1e3 * checkup.delay:.0f} ms later"
        lines.append(f"{log.source}: {len(checkup.faults)} faults; {late}")
        lines += [f"  {finding}" for finding in checkup.findings]
    return lines


def _is_same(log: Log, other: Log) -> bool:
    count = min(len(log.joint_angles), len(other.joint_angles), 1000)
    moves = np.ptp(log.joint_angles[:count], axis=0).max() > _STILL
    return bool(moves and np.array_equal(log.joint_angles[:count], other.joint_angles[:count]))


def _examine_one(log: Log, joint_names: Sequence[str]) -> Checkup:
    rows = np.flatnonzero(find_settled(log))
    rows = rows if len(rows) > 50 else np.arange(len(log.times))
    correlations, delays = _correlate(log, rows[:: max(len(rows) // _ROWS, 1)])
    of_own = np.abs(np.diagonal(correlations, axis1=1, axis2=2))
    best = np.array([_least_of_best(delays, column) for column in of_own.T])
    sent = commanded(log, log.times[rows])
    shown = log.joint_angles[rows]
    moves = np.minimum(np.ptp(sent, axis=0), np.ptp(shown, axis=0)) > _LITTLE
    strong = moves & (np.max(of_own, axis=0) > _FOLLOWS)
    # A joint that does not follow its command is compared at the delay of the others.
    others = float(np.median(delays[best[strong]])) if np.any(strong) else 0.0
    joints = tuple(
        _compare(log, rows, j, name, float(delays[best[j]]) if strong[j] else others)
        for j, name in enumerate(joint_names)
    )
    late = None
    if np.any(strong):
        late = float(np.median([joints[j].delay for j in np.flatnonzero(strong)]))
    checkup = Checkup(joints, late, ())
    if (command := _find_wrong_command(log, joints)) is not None:
        found = [command]
    else:
        swapped = _find_order(joints, correlations)
        elsewhere = {finding.where for finding in swapped}
        alone = _find_joint_faults(log, rows, joints)
        found = [
            *swapped,
            *(finding for finding in alone if finding.where not in elsewhere),
            *_find_delays(log, rows, checkup),
        ]
    found += [*_find_frozen(log, joints), *_find_stamps(log), *_find_ball(log)]
    return checkup._replace(findings=tuple(found))


def _correlate(log: Log, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Correlations [D, n, n] of each joint's command, late by each delay [D], and each joint's
    angle."""
    delays = np.arange(_SHORTEST, _LONGEST, _COARSE)
    measured = _normalise(log.joint_angles[rows])
    return (
        np.stack(
            [_normalise(commanded(log, log.times[rows] - delay)).T @ measured for delay in delays]
        ),
        delays,
    )


def _least_of_best(delays: np.ndarray, correlations: np.ndarray) -> int:
    """Index of the least delay [D] among those that correlate as well as the best: a steady motion
    looks the same at every delay."""
    loss = 1.0 - np.abs(correlations)
    tied = loss <= max(_TIE * np.min(loss), np.min(loss) + _TIED)
    return int(np.argmin(np.where(tied, np.abs(delays), np.inf)))


def _normalise(values: np.ndarray) -> np.ndarray:
    """Columns [T, n] with the mean 0 and the length 1; 0 where nothing moves."""
    centred = values - np.mean(values, axis=0)
    length = np.linalg.norm(centred, axis=0)
    return centred / np.where(length > 1e-9, length, np.inf)


def _compare(log: Log, rows: np.ndarray, j: int, name: str, guess: float) -> Joint:
    """How joint j follows its command, near a guess of its delay."""
    few = rows[:: max(len(rows) // (2 * _ROWS), 1)]
    measured = _normalise(log.joint_angles[few, j : j + 1])[:, 0]

    def correlation(delay: float) -> float:
        targets = np.interp(log.times[few] - delay, log.target_times, log.servo_targets[:, j])
        return float(_normalise(targets[:, None])[:, 0] @ measured)

    near = np.arange(guess - 1.5 * _COARSE, guess + 1.5 * _COARSE, _FINE)
    values = [correlation(delay) for delay in near]
    best = _least_of_best(near, np.array(values))
    delay = float(near[best])
    strength = values[best]
    angles, targets = _smoothed(log, rows, j, delay)
    if _ZERO < abs(np.median(angles - targets)) < _TURN / 4.0:
        # A motion that goes one way shows an offset as well as a delay.
        tried = np.arange(_EARLY, _LATE, 2.0 * _FINE)
        sizes = [_distance(log, few, j, other) for other in tried]
        if min(sizes) < 0.2 * abs(np.median(angles - targets)):
            delay = float(tried[np.argmin(sizes)])
            angles, targets = _smoothed(log, rows, j, delay)
    spread = np.var(targets, ddof=1)
    slope = float(np.cov(targets, angles)[0, 1] / spread) if spread > 1e-10 else 0.0
    offset = float(np.median(angles - targets))
    late = np.interp(log.times[rows] - delay, log.target_times, log.servo_targets[:, j])
    left = log.joint_angles[rows, j] - slope * late
    return Joint(
        name=name,
        commanded=float(np.ptp(late)),
        measured=float(np.ptp(log.joint_angles[rows, j])),
        slope=slope,
        offset=offset,
        delay=delay,
        correlation=strength,
        remainder=float(np.std(left)),
    )


def _distance(log: Log, rows: np.ndarray, j: int, delay: float) -> float:
    """Root mean square of the angle of joint j less its late command, rad."""
    late = np.interp(log.times[rows] - delay, log.target_times, log.servo_targets[:, j])
    return float(np.sqrt(np.mean((log.joint_angles[rows, j] - late) ** 2)))


def _smoothed(log: Log, rows: np.ndarray, j: int, delay: float) -> tuple[np.ndarray, np.ndarray]:
    """The angle and the late command [T] of a joint, without fast motions."""
    size = max(round(_SMOOTH / float(np.median(np.diff(log.times)))), 1)
    targets = np.interp(log.times[rows] - delay, log.target_times, log.servo_targets[:, j])
    pair = log.joint_angles[rows, j], targets
    return tuple(uniform_filter1d(x, size, mode="nearest") for x in pair)


def _find_wrong_command(log: Log, joints: Sequence[Joint]) -> Finding | None:
    """Commands that are none."""
    if max(joint.commanded for joint in joints) < _STILL:
        if max(joint.measured for joint in joints) < _STILL:
            text = "neither angles nor targets move; replay bounce-mjx excite while recording"
            return Finding("no motion", "all joints", text, is_fault=not len(log.picture_times))
        text = (
            "the targets are constant and the arm moves, as when a hand guides it; record the "
            "targets that were sent while the servos follow them"
        )
        return Finding("hand guided", "all joints", text)
    same = np.mean(np.isin(log.target_times, log.times))
    count = min(len(log.joint_angles), len(log.servo_targets))
    if same > _EXACT and count == len(log.joint_angles) == len(log.servo_targets):
        for shift, what in ((0, "of the same row"), (1, "of the next row")):
            equal = log.servo_targets[: count - shift] == log.joint_angles[shift:]
            moving = np.any(np.diff(log.joint_angles, axis=0, prepend=np.nan) != 0.0, axis=1)
            rows = moving[: count - shift]
            if np.sum(rows) > 50 and np.mean(np.all(equal, axis=1)[rows]) > _EXACT:
                text = (
                    f"the targets are the measured angles {what}, and show nothing about the "
                    "servos; record what was sent to them"
                )
                return Finding("targets are angles", "all joints", text)
    return None


def _find_order(joints: Sequence[Joint], correlations: np.ndarray) -> list[Finding]:
    """Columns of angles that follow another joint's command."""
    strength = np.max(np.abs(correlations), axis=0)
    sent, shown = linear_sum_assignment(-strength)
    found = []
    for j, k in zip(sent, shown, strict=True):
        if j != k and strength[j, j] < _OWN and strength[j, k] > _OTHER:
            text = (
                f"joint_angles.{joints[k].name} follows servo_targets.{joints[j].name}, as if "
                "columns were swapped; correct the titles of one of both, or where messages are "
                "numbers without names, give the names in their order (--joint-names)"
            )
            found.append(Finding("swapped", joints[k].name, text))
    return found


def _find_joint_faults(log: Log, rows: np.ndarray, joints: Sequence[Joint]) -> list[Finding]:
    """What is wrong with one joint alone."""
    found = []
    # In a gap, a joint may have turned as far as it likes.
    is_gap = np.isin(log.times[:-1], [last for last, _ in find_gaps(log.times)])
    for j, joint in enumerate(joints):
        unit = _find_unit(joint)
        is_jump = np.abs(np.diff(log.joint_angles[:, j])) > np.pi
        jumps = np.flatnonzero(is_jump & ~is_gap)
        if joint.commanded < _LITTLE and joint.measured < _LITTLE:
            text = "it hardly moves, and the log shows little about it"
            found.append(Finding("still", joint.name, text, is_fault=False))
        elif unit is not None:
            found.append(unit)
        elif joint.measured < max(0.02 * joint.commanded, _STILL):
            text = (
                f"its angle stays within {joint.measured:.2g} rad although its command moves by "
                f"{joint.commanded:.2g} rad: an encoder that is not read, or a servo that is off"
            )
            found.append(Finding("frozen", joint.name, text))
        elif len(jumps):
            text = (
                f"its angle jumps by {np.diff(log.joint_angles[:, j])[jumps[0]]:.2f} rad at "
                f"{log.times[jumps[0] + 1]:.3f} s ({len(jumps)} such jumps), as an encoder that "
                "wraps at pi; unwrap it (numpy.unwrap), and begin at the robot's own turn"
            )
            found.append(Finding("wrapped", joint.name, text))
        elif joint.commanded < _LITTLE:
            text = (
                f"its command is constant and its angle moves by {joint.measured:.2g} rad: "
                "another thing moves it, or the target's column is not what was sent"
            )
            found.append(Finding("not commanded", joint.name, text))
        else:
            found += _find_gain(log, rows, j, joint)
    return found


def _find_unit(joint: Joint) -> Finding | None:
    """A joint that follows its command, but in another unit: of an angle whose command is in
    degrees, the range is a 57th, as little as that of a frozen encoder's noise."""
    if abs(joint.correlation) < _FOLLOWS:
        return None
    size = abs(joint.slope)
    for factor, degrees, radians in (
        (_DEGREES, "joint_angles", "servo_targets"),
        (1.0 / _DEGREES, "servo_targets", "joint_angles"),
    ):
        if abs(size / factor - 1.0) < 0.15:
            text = (
                f"its angle changes by {size:.3g} times its command, as one of both is in degrees; "
                f"write {degrees}.{joint.name} [deg], or, if {radians}.{joint.name} says [deg], "
                "[rad] there"
            )
            return Finding("unit", joint.name, text)
    return None


def _find_gain(log: Log, rows: np.ndarray, j: int, joint: Joint) -> list[Finding]:
    """A slope or an offset that no servo has."""
    size = abs(joint.slope)
    name = joint.name
    if (end := _find_saturation(log, rows, j, joint)) is not None:
        return [end]
    if abs(joint.correlation) < _FOLLOWS:
        text = (
            f"its angle does not follow its command (correlation {joint.correlation:.2f}); look "
            "at the order of the columns, and whether the servo was on"
        )
        return [Finding("does not follow", name, text)]
    if joint.slope < 0.0:
        text = (
            f"its angle goes against its command (slope {joint.slope:.2f}); change the sign of "
            "one of both columns"
        )
        return [Finding("mirrored", name, text)]
    if not _SLOPES[0] < size < _SLOPES[1]:
        text = (
            f"its angle changes by {size:.3g} times its command, also in slow motions: a wrong "
            "gear ratio or unit, or a servo that cannot follow; compare both columns with the "
            "driver's documentation"
        )
        return [Finding("scale", name, text)]
    angles, targets = _smoothed(log, rows, j, joint.delay)
    around = np.median(np.abs(angles - targets - joint.offset))
    if abs(joint.offset) > _ZERO:
        path = np.sum(np.abs(np.diff(angles)))
        turns = round(joint.offset / _TURN)
        if turns and abs(joint.offset - turns * _TURN) < 0.1:
            text = f"its angle is {turns} whole turns from its command; subtract them"
        elif abs(angles[-1] - angles[0]) > 0.7 * path:
            text = (
                f"its angle is {joint.offset:.3f} rad from its command, but it moves one way "
                "alone, which cannot tell an offset from a delay"
            )
            return [Finding("one way", name, text, is_fault=False)]
        elif around < 0.3 * abs(joint.offset):
            text = (
                f"its angle is {joint.offset:.3f} rad from its command, in all postures: its zero "
                "differs from the driver's; subtract the difference from one of both"
            )
        else:
            text = (
                f"its angle is {joint.offset:.3f} rad from its command, by posture: a weak servo "
                "sags, or its zero is off"
            )
            return [Finding("sag", name, text, is_fault=False)]
        return [Finding("zero", name, text)]
    return []


def _find_saturation(log: Log, rows: np.ndarray, j: int, joint: Joint) -> Finding | None:
    """A joint that rests at an end of its motion while its command goes on."""
    angles = log.joint_angles[rows, j]
    late = np.interp(log.times[rows] - joint.delay, log.target_times, log.servo_targets[:, j])
    for side, end in ((1.0, np.max(angles)), (-1.0, np.min(angles))):
        rests = np.abs(angles - end) < _REST
        beyond = side * (late - angles)
        stopped = rests & (beyond - np.median(beyond) > _BEYOND)
        if np.mean(stopped) > _SATURATED and np.mean(stopped[rests]) > 0.3:
            first = rows[np.argmax(stopped)]
            text = (
                f"its angle rests at {end:.3f} rad in {100 * np.mean(stopped):.0f}% of the rows "
                f"(first at {log.times[first]:.3f} s) while its command goes to "
                f"{late[stopped][np.argmax(beyond[stopped])]:.3f} rad: a stop or a limit of its "
                "own; record motions that do not reach it"
            )
            return Finding("saturated", joint.name, text)
    return None


def _find_delays(log: Log, rows: np.ndarray, checkup: Checkup) -> list[Finding]:
    """Delays that no servo has, differ between joints, or change over the log."""
    moving = [
        j
        for j, joint in enumerate(checkup.joints)
        if abs(joint.correlation) > _OTHER and min(joint.commanded, joint.measured) > _LITTLE
    ]
    if not moving or checkup.delay is None:
        return []
    late = checkup.delay
    thirds = [part for part in np.array_split(rows, 3) if len(part) > 100]
    delays = [_delay_of_part(log, part, moving, late) for part in thirds]
    if len(delays) == 3 and None not in delays:
        first, middle, last = delays
        if abs(last - first) > _APART and min(first, last) < middle < max(first, last):
            text = (
                f"the delay goes from {1e3 * first:.0f} to {1e3 * last:.0f} ms over the log: the "
                "clocks of angles and targets drift apart; stamp both with one"
            )
            return [Finding("drift", "the stamps", text)]
    if late > _LATE:
        text = (
            f"the angles follow the targets {late:.2f} s later: the targets are a trajectory's "
            "that was sent ahead, or the stamps are of two clocks; record the controller's own set "
            "points, with stamps of one clock"
        )
        return [Finding("late", "all joints", text)]
    if late < _EARLY:
        text = (
            f"the angles are {-late:.3f} s ahead of the targets, which nothing can be; give both "
            "stamps of one clock, those of the sending and of the measurement"
        )
        return [Finding("early", "all joints", text)]
    found = []
    if late < 0.5 * float(np.median(np.diff(log.target_times))) + _FINE:
        text = (
            "the angles follow the targets at once, as a controller's own set points (target_q) "
            "do; the latency of your commands to it is not in this log"
        )
        found.append(Finding("no latency", "all joints", text, is_fault=False))
    for j in moving:
        joint = checkup.joints[j]
        if abs(joint.delay - late) > _APART:
            text = (
                f"its delay is {1e3 * joint.delay:.0f} ms, and that of the others "
                f"{1e3 * late:.0f} ms; look at its bus and the order of its rows"
            )
            found.append(Finding("own delay", joint.name, text))
    return found


def _delay_of_part(log: Log, rows: np.ndarray, moving: Sequence[int], near: float) -> float | None:
    """The delay in a part of a log, s, of the joint that moves most there; None if it shows
    none."""
    j = moving[int(np.argmax(np.std(log.joint_angles[rows][:, moving], axis=0)))]
    few = rows[:: max(len(rows) // _ROWS, 1)]
    measured = _normalise(log.joint_angles[few, j : j + 1])[:, 0]
    tried = np.arange(near - 0.5, near + 0.5, 5e-3)

    def target(delay: float) -> np.ndarray:
        return np.interp(log.times[few] - delay, log.target_times, log.servo_targets[:, j])

    fits = np.array([abs(_normalise(target(d)[:, None])[:, 0] @ measured) for d in tried])
    # A steady motion shows no delay.
    shows = fits.max() > _OTHER and np.mean(fits > fits.max() - 1e-3) < 0.2
    return float(tried[np.argmax(fits)]) if shows else None


def _find_frozen(log: Log, joints: Sequence[Joint]) -> list[Finding]:
    """Stretches in which all joints that move repeat their angles to the last digit."""
    moving = [j for j, x in enumerate(joints) if x.measured > _STILL and x.commanded > _STILL]
    if not moving:
        return []
    same = np.all(np.diff(log.joint_angles[:, moving], axis=0) == 0.0, axis=1)
    for first, last in _runs(same):
        begin = log.times[first]
        end = log.times[last + 1]
        sent = (log.target_times >= begin) & (log.target_times <= end)
        if end - begin > _FROZEN and np.any(sent):
            travelled = np.sum(np.abs(np.diff(log.servo_targets[sent][:, moving], axis=0)))
            if travelled > _FROZEN_SPEED * (end - begin):
                text = (
                    f"all angles repeat from {begin:.3f} to {end:.3f} s while the targets move; "
                    "leave these rows out, and look at the driver's connection"
                )
                return [Finding("frozen", "all joints", text)]
    return []


def _runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """First and last index of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _find_stamps(log: Log) -> list[Finding]:
    found = []
    for name, times in (("joint angles", log.times), ("servo targets", log.target_times)):
        if gaps := find_gaps(times):
            longest = max(first - last for last, first in gaps)
            text = (
                f"the {name} have {len(gaps)} gaps of up to {longest:.2f} s, the first at "
                f"{gaps[0][0]:.3f} s; what follows a gap counts from {SETTLING:g} s on"
            )
            found.append(Finding("gaps", "the stamps", text, is_fault=False))
    first = max(log.times[0], log.target_times[0])
    last = min(log.times[-1], log.target_times[-1])
    is_alone = (log.picture_times < first) | (log.picture_times > last)
    if np.sum(is_alone) > max(_ALONE * len(is_alone), 1.0):
        text = (
            f"{np.sum(is_alone)} of {len(is_alone)} pictures of the ball have stamps before "
            f"{first:.3f} s or after {last:.3f} s, without joint angles and servo targets; their "
            "bounces do not count"
        )
        found.append(Finding("pictures alone", "the stamps", text, is_fault=False))
    return found


def _find_ball(log: Log) -> list[Finding]:
    """A ball that never falls."""
    if len(log.picture_times) < 30:
        return []
    pulls = _accelerations(log.picture_times, log.ball_positions)
    if len(pulls) < _FEWEST_PIECES:
        return []
    found = []
    falls = np.linalg.norm(pulls - GRAVITY, axis=1) < _NEAR_GRAVITY * _FALLING
    if np.sum(falls) >= _FEWEST_PIECES:
        # A hand may carry it in between, for most of the log.
        return []
    pull = np.median(pulls, axis=0)
    size = float(np.linalg.norm(pull))
    axis = int(np.argmax(np.abs(pull)))
    shown = "(" + ", ".join(f"{x:.1f}" for x in pull) + ") m/s^2"
    if not 0.5 * _FALLING < size < 2.0 * _FALLING:
        text = (
            f"in flight it accelerates by {shown}, and {_FALLING:.2f} m/s^2 is expected; look at "
            "the units of its position and of ball_time"
        )
        found.append(Finding("ball unit", "the ball", text))
    elif axis != 2:
        text = f"it falls along {'xyz'[axis]} ({shown}); give its position with z up"
        found.append(Finding("ball axes", "the ball", text))
    elif pull[2] > 0.0:
        text = f"it falls upwards ({shown}); change the sign of z, and of x or y with it"
        found.append(Finding("ball axes", "the ball", text))
    return found


def _accelerations(times: np.ndarray, balls: np.ndarray) -> np.ndarray:
    """Accelerations [F, 3] of pieces of flight, by parabolas that fit."""
    step = float(np.median(np.diff(times)))
    count = max(round(_PIECE / step), 5)
    pulls = []
    for i in range(0, len(times) - count, max(count, len(times) // _PIECES)):
        piece = slice(i, i + count)
        t = times[piece] - times[i]
        if t[-1] > 2.0 * count * step:
            continue
        coefficients, (rests, *_) = polyfit(t, balls[piece], 2, full=True)
        travelled = np.linalg.norm(np.ptp(balls[piece], axis=0))
        if len(rests) and np.sqrt(np.sum(rests) / count) < 0.05 * travelled:
            pulls.append(2.0 * coefficients[2])
    return np.array(pulls).reshape(-1, 3)
