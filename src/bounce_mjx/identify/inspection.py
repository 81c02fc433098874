"""A look at a log before any fit: does each joint follow its own command, and can the ball be one?

The findings are the rows of `RULES`: what it is called, whether a fit would blame the robot for it,
the test that finds it in the joints' response, and the sentence with its remedy. A joint is blamed
once, by the first row whose test it fails; what is wrong with all joints is not looked for in one.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyfit
from scipy.optimize import linear_sum_assignment

from bounce_mjx.identify.flight import GRAVITY
from bounce_mjx.identify.following import SETTLING, find_settled
from bounce_mjx.identify.log import Log, find_gaps, turns_off
from bounce_mjx.identify.response import (
    EARLY,
    FOLLOWS,
    LATE,
    LITTLE,
    Joint,
    Response,
    measure_response,
    smoothed,
)

# A joint whose angle or command changes by less does not move, rad.
_STILL = 5e-3
# Largest difference between the delays of two joints, s.
_APART = 0.05
# Correlations: with the own command below which a joint may belong to another, and with that one.
_OWN = 0.9
_OTHER = 0.95
_SLOPES = 0.85, 1.18
_DEGREES = 180.0 / np.pi
# Constant difference between angle and command that is a wrong zero, rad.
_ZERO = 0.02
_TURN = 2.0 * np.pi
# Speed that no joint of an arm has, rad/s, and the time over which it is measured, s.
_TOO_FAST = 2.0 * np.pi
_SPEED_TIME = 0.04
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


class Checkup(NamedTuple):
    """A log, looked at."""

    response: Response
    findings: tuple[Finding, ...]

    @property
    def joints(self) -> tuple[Joint, ...]:
        """How each joint follows its command."""
        return self.response.joints

    @property
    def delay(self) -> float | None:
        """The common delay, s; None if no joint follows its command."""
        return self.response.delay

    @property
    def faults(self) -> list[Finding]:
        return [finding for finding in self.findings if finding.is_fault]


class _Case(NamedTuple):
    """What the tests look at."""

    log: Log
    rows: np.ndarray
    """Indices of the joint angles that count."""
    response: Response

    def pair(self, j: int) -> tuple[np.ndarray, np.ndarray]:
        """The angle of a joint and its late command [T], without fast motions, rad."""
        late = self.response.late_command(self.log, j, self.log.times[self.rows])
        return smoothed(self.log, self.rows, j, late)


Facts = dict[str, Any]
"""The numbers of a rule's sentence, by name."""


class Rule(NamedTuple):
    """A row of the table of what may be wrong with a log."""

    kind: str
    is_fault: bool
    where: str
    """All joints, the stamps or the ball; or joint, for a test of each joint."""
    test: Callable[..., Facts | None]
    """(case), or (case, joint's index) -> the facts of the sentence; None where it is in order."""
    sentence: str
    """What is wrong and what to do, with the facts in braces."""

    def find(self, case: _Case, j: int | None = None) -> Finding | None:
        """The finding in a log, or in one of its joints."""
        facts = self.test(case) if j is None else self.test(case, j)
        if facts is None:
            return None
        where = self.where if j is None else case.response.joints[j].name
        return Finding(self.kind, where, self.sentence.format(**facts), self.is_fault)


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
    response = measure_response(log, rows, tuple(joint_names))
    case = _Case(log, rows, response)
    found: list[Finding] = []
    blamed: set[int] = set()
    every = range(len(response.joints))
    for rule in RULES:
        if rule.where == "joint":
            for j in every:
                if j not in blamed and (finding := rule.find(case, j)) is not None:
                    found.append(finding)
                    blamed.add(j)
        elif not (rule.where == "all joints" and len(blamed) == len(every)):
            if (finding := rule.find(case)) is not None:
                found.append(finding)
                if rule.kind in _OF_ALL_JOINTS:
                    blamed.update(every)
    return Checkup(response, tuple(found))


def _no_motion(case: _Case) -> Facts | None:
    joints = case.response.joints
    moves = max(max(joint.commanded, joint.measured) for joint in joints) >= _STILL
    return None if moves or len(case.log.picture_times) else {}


def _no_motion_with_a_ball(case: _Case) -> Facts | None:
    joints = case.response.joints
    moves = max(max(joint.commanded, joint.measured) for joint in joints) >= _STILL
    return {} if not moves and len(case.log.picture_times) else None


def _hand_guided(case: _Case) -> Facts | None:
    joints = case.response.joints
    commanded_ = max(joint.commanded for joint in joints)
    return {} if commanded_ < _STILL <= max(joint.measured for joint in joints) else None


def _targets_are_angles(case: _Case) -> Facts | None:
    log = case.log
    count = len(log.joint_angles)
    same = np.mean(np.isin(log.target_times, log.times))
    if same <= _EXACT or count != len(log.servo_targets):
        return None
    is_moving = np.any(np.diff(log.joint_angles, axis=0, prepend=np.nan) != 0.0, axis=1)
    for shift, what in ((0, "of the same row"), (1, "of the next row")):
        equal = log.servo_targets[: count - shift] == log.joint_angles[shift:]
        moving = is_moving[: count - shift]
        if np.sum(moving) > 50 and np.mean(np.all(equal, axis=1)[moving]) > _EXACT:
            return {"what": what}
    return None


def _step(case: _Case) -> Facts | None:
    steps = [change for change in case.response.changes if change.kind == "step"]
    if not steps:
        return None
    first = steps[0]
    way = "later" if first.size > 0.0 else "earlier"
    more = f", and {len(steps) - 1} more times" if len(steps) > 1 else ""
    return {"ms": 1e3 * abs(first.size), "way": way, "time": first.begin, "more": more}


def _drift(case: _Case) -> Facts | None:
    drifts = [change for change in case.response.changes if change.kind == "drift"]
    if not drifts or case.response.delay is None:
        return None
    before = case.response.delay
    return {"before": 1e3 * before, "after": 1e3 * (before + drifts[0].size)}


def _swapped(case: _Case, j: int) -> Facts | None:
    strength = np.abs(case.response.correlations)
    sent, shown = linear_sum_assignment(-strength)
    other = int(sent[np.flatnonzero(shown == j)[0]])
    if other == j or strength[other, other] >= _OWN or strength[other, j] <= _OTHER:
        return None
    joints = case.response.joints
    return {"angle": joints[j].name, "target": joints[other].name}


def _still(case: _Case, j: int) -> Facts | None:
    joint = case.response.joints[j]
    return {} if joint.commanded < LITTLE and joint.measured < LITTLE else None


def _unit(case: _Case, j: int) -> Facts | None:
    """Of an angle whose command is in degrees, the range is a 57th, as little as that of a frozen
    encoder's noise."""
    joint = case.response.joints[j]
    if abs(joint.correlation) < FOLLOWS:
        return None
    size = abs(joint.slope)
    for factor, degrees, radians in (
        (_DEGREES, "joint_angles", "servo_targets"),
        (1.0 / _DEGREES, "servo_targets", "joint_angles"),
    ):
        if abs(size / factor - 1.0) < 0.15:
            return {"size": size, "degrees": degrees, "radians": radians, "name": joint.name}
    return None


def _too_fast(case: _Case, j: int) -> Facts | None:
    times = case.log.times[case.rows]
    angles = case.log.joint_angles[case.rows, j]
    reach = max(round(_SPEED_TIME / float(np.median(np.diff(times)))), 1)
    elapsed = times[reach:] - times[:-reach]
    near = elapsed < 2.0 * _SPEED_TIME
    if np.sum(near) < 50:
        return None
    speed = np.abs(angles[reach:] - angles[:-reach])[near] / elapsed[near]
    fastest = float(np.quantile(speed, 0.99))
    wraps = np.any(np.abs(np.diff(angles)) > np.pi) and np.max(np.abs(angles)) < 1.01 * _TURN
    if fastest < _TOO_FAST or wraps:
        return None
    return {"speed": fastest, "name": case.response.joints[j].name}


def _frozen_joint(case: _Case, j: int) -> Facts | None:
    joint = case.response.joints[j]
    if joint.measured >= max(0.02 * joint.commanded, _STILL):
        return None
    return {"measured": joint.measured, "commanded": joint.commanded}


def _wrapped(case: _Case, j: int) -> Facts | None:
    log = case.log
    # In a gap, a joint may have turned as far as it likes.
    is_gap = np.isin(log.times[:-1], [last for last, _ in find_gaps(log.times)])
    steps = np.diff(log.joint_angles[:, j])
    jumps = np.flatnonzero((np.abs(steps) > np.pi) & ~is_gap)
    if not len(jumps):
        return None
    return {"jump": steps[jumps[0]], "time": log.times[jumps[0] + 1], "count": len(jumps)}


def _not_commanded(case: _Case, j: int) -> Facts | None:
    joint = case.response.joints[j]
    return {"measured": joint.measured} if joint.commanded < LITTLE else None


def _saturated(case: _Case, j: int) -> Facts | None:
    """A joint that rests at an end of its motion while its command goes on."""
    times = case.log.times[case.rows]
    angles = case.log.joint_angles[case.rows, j]
    late = case.response.late_command(case.log, j, times)
    for side, end in ((1.0, np.max(angles)), (-1.0, np.min(angles))):
        rests = np.abs(angles - end) < _REST
        beyond = side * (late - angles)
        stopped = rests & (beyond - np.median(beyond) > _BEYOND)
        if np.mean(stopped) > _SATURATED and np.mean(stopped[rests]) > 0.3:
            return {
                "end": end,
                "share": 100.0 * np.mean(stopped),
                "time": times[np.argmax(stopped)],
                "command": late[stopped][np.argmax(beyond[stopped])],
            }
    return None


def _does_not_follow(case: _Case, j: int) -> Facts | None:
    correlation = case.response.joints[j].correlation
    return {"correlation": correlation} if abs(correlation) < FOLLOWS else None


def _mirrored(case: _Case, j: int) -> Facts | None:
    slope = case.response.joints[j].slope
    return {"slope": slope} if slope < 0.0 else None


def _scale(case: _Case, j: int) -> Facts | None:
    slope = case.response.joints[j].slope
    return None if _SLOPES[0] < slope < _SLOPES[1] else {"slope": slope}


def _offset(case: _Case, j: int) -> str | None:
    """What an angle that is away from its command in the mean shows: turns, one way, zero or
    sag."""
    offset = case.response.joints[j].offset
    if abs(offset) <= _ZERO:
        return None
    angles, targets = case.pair(j)
    turns = round(offset / _TURN)
    if turns and abs(offset - turns * _TURN) < 0.1:
        return "turns"
    if abs(angles[-1] - angles[0]) > 0.7 * np.sum(np.abs(np.diff(angles))):
        return "one way"
    around = np.median(np.abs(angles - targets - offset))
    return "zero" if around < 0.3 * abs(offset) else "sag"


def _offset_rule(which: str) -> Callable[[_Case, int], Facts | None]:
    def test(case: _Case, j: int) -> Facts | None:
        if _offset(case, j) != which:
            return None
        offset = case.response.joints[j].offset
        column = f"joint_angles.{case.response.joints[j].name}"
        return {"offset": offset, "turns": turns_off(round(offset / _TURN), column)}

    return test


def _own_delay(case: _Case, j: int) -> Facts | None:
    late = case.response.delay
    joint = case.response.joints[j]
    is_shown = abs(joint.correlation) > _OTHER and min(joint.commanded, joint.measured) > LITTLE
    if late is None or not is_shown or abs(joint.delay - late) <= _APART:
        return None
    return {"own": 1e3 * joint.delay, "others": 1e3 * late}


def _late(case: _Case) -> Facts | None:
    delay = case.response.delay
    return {"delay": delay} if delay is not None and delay > LATE else None


def _early(case: _Case) -> Facts | None:
    delay = case.response.delay
    return {"lead": -delay} if delay is not None and delay < EARLY else None


def _no_latency(case: _Case) -> Facts | None:
    delay = case.response.delay
    if delay is None or delay < EARLY:
        return None
    held = 0.5 * float(np.median(np.diff(case.log.target_times)))
    return {} if delay < held + 1e-3 else None


def _frozen_all(case: _Case) -> Facts | None:
    """Stretches in which all joints that move repeat their angles to the last digit."""
    log = case.log
    joints = case.response.joints
    moving = [j for j, x in enumerate(joints) if x.measured > _STILL and x.commanded > _STILL]
    if not moving:
        return None
    same = np.all(np.diff(log.joint_angles[:, moving], axis=0) == 0.0, axis=1)
    for first, last in _runs(same):
        begin = log.times[first]
        end = log.times[last + 1]
        sent = (log.target_times >= begin) & (log.target_times <= end)
        if end - begin > _FROZEN and np.any(sent):
            travelled = np.sum(np.abs(np.diff(log.servo_targets[sent][:, moving], axis=0)))
            if travelled > _FROZEN_SPEED * (end - begin):
                return {"begin": begin, "end": end}
    return None


def _runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """First and last index of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _gaps_of(what: str) -> Callable[[_Case], Facts | None]:
    def test(case: _Case) -> Facts | None:
        times = case.log.times if what == "joint angles" else case.log.target_times
        if not (gaps := find_gaps(times)):
            return None
        longest = max(first - last for last, first in gaps)
        return {"what": what, "count": len(gaps), "longest": longest, "first": gaps[0][0]}

    return test


def _pictures_alone(case: _Case) -> Facts | None:
    log = case.log
    first = max(log.times[0], log.target_times[0])
    last = min(log.times[-1], log.target_times[-1])
    is_alone = (log.picture_times < first) | (log.picture_times > last)
    if np.sum(is_alone) <= max(_ALONE * len(is_alone), 1.0):
        return None
    return {"count": np.sum(is_alone), "all": len(is_alone), "first": first, "last": last}


def _pull(case: _Case) -> np.ndarray | None:
    """The median acceleration [3] of a ball that never falls, m/s^2; None of one that does, or of
    too few pictures."""
    log = case.log
    if len(log.picture_times) < 30:
        return None
    pulls = _accelerations(log.picture_times, log.ball_positions)
    falls = np.linalg.norm(pulls - GRAVITY, axis=1) < _NEAR_GRAVITY * _FALLING
    # A hand may carry it in between, for most of the log.
    if len(pulls) < _FEWEST_PIECES or np.sum(falls) >= _FEWEST_PIECES:
        return None
    return np.median(pulls, axis=0)


def _shown(pull: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:.1f}" for x in pull) + ") m/s^2"


def _is_of_size(pull: np.ndarray) -> bool:
    return 0.5 * _FALLING < np.linalg.norm(pull) < 2.0 * _FALLING


def _ball_unit(case: _Case) -> Facts | None:
    pull = _pull(case)
    return None if pull is None or _is_of_size(pull) else {"pull": _shown(pull)}


def _ball_axes(case: _Case) -> Facts | None:
    pull = _pull(case)
    if pull is None or not _is_of_size(pull) or (axis := int(np.argmax(np.abs(pull)))) == 2:
        return None
    return {"axis": "xyz"[axis], "pull": _shown(pull)}


def _ball_upwards(case: _Case) -> Facts | None:
    pull = _pull(case)
    if pull is None or not _is_of_size(pull) or np.argmax(np.abs(pull)) != 2 or pull[2] < 0.0:
        return None
    return {"pull": _shown(pull)}


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


_GAPS = (
    "the {what} have {count} gaps of up to {longest:.2f} s, the first at {first:.3f} s; what "
    f"follows a gap counts from {SETTLING:g} s on"
)
_OF_ALL_JOINTS = ("no motion", "hand guided", "targets are angles", "step", "drift")
"""Kinds that explain whatever is wrong with a single joint."""
RULES = (
    Rule(
        "no motion", True, "all joints", _no_motion,
        "neither angles nor targets move; replay bounce-mjx excite while recording",
    ),
    Rule(
        "no motion", False, "all joints", _no_motion_with_a_ball,
        "neither angles nor targets move; replay bounce-mjx excite while recording",
    ),
    Rule(
        "hand guided", True, "all joints", _hand_guided,
        "the targets are constant and the arm moves, as when a hand guides it; record the targets "
        "that were sent while the servos follow them",
    ),
    Rule(
        "targets are angles", True, "all joints", _targets_are_angles,
        "the targets are the measured angles {what}, and show nothing about the servos; record "
        "what was sent to them",
    ),
    Rule(
        "step", True, "the stamps", _step,
        "from about {time:.1f} s on, all joints follow {ms:.0f} ms {way} than before{more}: rows "
        "of the angles or of the targets were lost or held up while the others went on; cut the "
        "log there and give its longest part, and stamp both when they are measured and sent",
    ),
    Rule(
        "drift", True, "the stamps", _drift,
        "the delay goes from {before:.0f} to {after:.0f} ms over the log, in all joints: the "
        "clocks of angles and targets drift apart; stamp both with one",
    ),
    Rule(
        "swapped", True, "joint", _swapped,
        "joint_angles.{angle} follows servo_targets.{target}, as if columns were swapped; correct "
        "the titles of one of both, or where messages are numbers without names, give the names in "
        "their order (--joint-names)",
    ),
    Rule("still", False, "joint", _still, "it hardly moves, and the log shows little about it"),
    Rule(
        "unit", True, "joint", _unit,
        "its angle changes by {size:.3g} times its command, as one of both is in degrees; write "
        "{degrees}.{name} [deg], or, if {radians}.{name} says [deg], [rad] there",
    ),
    Rule(
        "frozen", True, "joint", _frozen_joint,
        "its angle stays within {measured:.2g} rad although its command moves by {commanded:.2g} "
        "rad: an encoder that is not read, or a servo that is off; a joint without an encoder "
        "cannot be identified: write its command as its angle, and leave its world as it is",
    ),
    Rule(
        "wrapped", True, "joint", _wrapped,
        "its angle jumps by {jump:.2f} rad at {time:.3f} s ({count} such jumps), as an encoder "
        "that wraps at pi; unwrap it (numpy.unwrap), and begin at the robot's own turn",
    ),
    Rule(
        "too fast", True, "joint", _too_fast,
        "it moves at up to {speed:.0f} rad/s, faster than a joint of an arm; if its angle and its "
        "target are in degrees, write joint_angles.{name} [deg] and servo_targets.{name} [deg]",
    ),
    Rule(
        "not commanded", True, "joint", _not_commanded,
        "its command is constant and its angle moves by {measured:.2g} rad: another thing moves "
        "it, or the target's column is not what was sent",
    ),
    Rule(
        "saturated", True, "joint", _saturated,
        "its angle rests at {end:.3f} rad in {share:.0f}% of the rows (first at {time:.3f} s) "
        "while its command goes to {command:.3f} rad: a stop or a limit of its own; record motions "
        "that do not reach it",
    ),
    Rule(
        "does not follow", True, "joint", _does_not_follow,
        "its angle does not follow its command (correlation {correlation:.2f}); look at the order "
        "of the columns, and whether the servo was on",
    ),
    Rule(
        "mirrored", True, "joint", _mirrored,
        "its angle goes against its command (slope {slope:.2f}); change the sign of one of both "
        "columns",
    ),
    Rule(
        "scale", True, "joint", _scale,
        "its angle changes by {slope:.3g} times its command, also in slow motions: a wrong gear "
        "ratio or unit, or a servo that cannot follow; compare both columns with the driver's "
        "documentation",
    ),
    Rule(
        "zero", True, "joint", _offset_rule("turns"),
        "its angle is away from its command by {turns}",
    ),
    Rule(
        "one way", False, "joint", _offset_rule("one way"),
        "its angle is {offset:.3f} rad from its command, but it moves one way alone, which cannot "
        "tell an offset from a delay",
    ),
    Rule(
        "zero", True, "joint", _offset_rule("zero"),
        "its angle is {offset:.3f} rad from its command, in all postures: its zero differs from "
        "the driver's; subtract the difference from one of both",
    ),
    Rule(
        "sag", False, "joint", _offset_rule("sag"),
        "its angle is {offset:.3f} rad from its command, by posture: a weak servo sags, or its "
        "zero is off",
    ),
    Rule(
        "own delay", True, "joint", _own_delay,
        "its delay is {own:.0f} ms, and that of the others {others:.0f} ms; look at its bus and "
        "the order of its rows",
    ),
    Rule(
        "late", True, "all joints", _late,
        "the angles follow the targets {delay:.2f} s later: the targets are a trajectory's that "
        "was sent ahead, or the stamps are of two clocks; record the controller's own set points, "
        "with stamps of one clock",
    ),
    Rule(
        "early", True, "all joints", _early,
        "the angles are {lead:.3f} s ahead of the targets: stamps of two clocks, or a controller "
        "that knows where the path goes (feed-forward), which no training simulates; give both "
        "stamps of one clock, those of the sending and of the measurement",
    ),
    Rule(
        "no latency", False, "all joints", _no_latency,
        "the angles follow the targets at once, as a controller's own set points (target_q) do; "
        "the latency of your commands to it is not in this log",
    ),
    Rule(
        "frozen", True, "all joints", _frozen_all,
        "all angles repeat from {begin:.3f} to {end:.3f} s while the targets move; leave these "
        "rows out, and look at the driver's connection",
    ),
    Rule("gaps", False, "the stamps", _gaps_of("joint angles"), _GAPS),
    Rule("gaps", False, "the stamps", _gaps_of("servo targets"), _GAPS),
    Rule(
        "pictures alone", False, "the stamps", _pictures_alone,
        "{count} of {all} pictures of the ball have stamps before {first:.3f} s or after "
        "{last:.3f} s, without joint angles and servo targets; their bounces do not count",
    ),
    Rule(
        "ball unit", True, "the ball", _ball_unit,
        f"in flight it accelerates by {{pull}}, and {_FALLING:.2f} m/s^2 is expected; look at the "
        "units of its position and of ball_time",
    ),
    Rule(
        "ball axes", True, "the ball", _ball_axes,
        "it falls along {axis} ({pull}); give its position with z up",
    ),
    Rule(
        "ball axes", True, "the ball", _ball_upwards,
        "it falls upwards ({pull}); change the sign of z, and of x or y with it",
    ),
)  # fmt: skip
