"""A log of a robot's run, as `deploy.recorder.Recorder` writes it, and its checks."""

import bisect
import csv
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bounce_mjx.errors import UserError, reason_of, shorten

MAX_BYTES = 256 * 2**20
"""A larger file is refused; an hour at 100 Hz has about 150 MB."""

UNITS = {
    "rad": {"rad": 1.0, "deg": np.pi / 180.0},
    "m": {"m": 1.0, "mm": 1e-3},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
}
"""Units that a column may state in place of the one in SI, and their factors."""

# A joint angle this far beyond the joint's range is not a measurement of it, rad.
_BEYOND_RANGE = 0.5
_LARGEST_ANGLE = 4.0 * np.pi
_FARTHEST_BALL = 20.0
_LONGEST_STEP = 0.2
_MIN_ROWS = 100
# Share of a measurement's rows from which their times, or balls far away, are no slips; and time
# from the log's middle beyond which one is wrong, s.
_WRONG_ROWS = 0.05
_FAR_IN_TIME = 3600.0
# Acceleration of a joint, rad/s^2, beyond which an angle is wrong, and the smallest such error that
# matters, rad.
_FASTEST_ACCELERATION = 600.0
_SMALLEST_SPIKE = 0.02
# Two pictures closer than this are one, s.
_SAME_PICTURE = 1e-4
# Stretches of a log in which the youngest picture is looked for; drift (s) over the log below which
# the clocks count as one, and age of a picture (s) beyond which they do not.
_STRETCHES = 12
_DRIFT = 1e-3
_LARGEST_AGE = 1.0
# Two quartz clocks drift by less; a stamp that drifts by more, s over the log, has another unit.
_FASTEST_DRIFT = 2e-4
_NO_CLOCK = 0.1


class Log(NamedTuple):
    """What a robot measured and was sent; all times (s) are of one clock, but for a constant."""

    source: str
    """Its file, for messages."""
    times: np.ndarray
    """Times [T] of the measured joint angles."""
    joint_angles: np.ndarray
    """Measured joint angles [T, n], rad."""
    target_times: np.ndarray
    """Times [U] at which servo targets were sent."""
    servo_targets: np.ndarray
    """Servo targets [U, n], rad."""
    picture_times: np.ndarray
    """Time stamps [P] of the pictures of the ball."""
    ball_positions: np.ndarray
    """The ball in each picture [P, 3], m."""
    arrivals: np.ndarray
    """Time [P] of the row in which each picture arrived."""
    notes: tuple[str, ...] = ()
    """What was left out or corrected in reading, a sentence each."""

    @property
    def seconds(self) -> float:
        """Length, s."""
        return float(self.times[-1] - self.times[0])


class Rows(NamedTuple):
    """Rows of one measurement, in the order of the file."""

    name: str
    """What they are, for messages."""
    place: str
    """Place of a row in the file, with {} for its number."""
    numbers: np.ndarray
    """[R]."""
    times: np.ndarray
    """When each was measured [R], s."""
    arrivals: np.ndarray
    """When each arrived [R], s."""
    values: np.ndarray
    """[R, k]."""
    faults: np.ndarray
    """Why each holds no measurement [R]; empty if it holds one."""

    def some(self, kept: np.ndarray) -> "Rows":
        """The rows of a mask [R], or at indices."""
        return Rows(*self[:2], *(array[kept] for array in self[2:]))


def make_log(
    source: str, angles: Rows, targets: Rows, balls: Rows, notes: Sequence[str] = ()
) -> Log:
    """The log of three measurements, without the rows that are faulty, repeat others or have wrong
    times, which its notes count.

    Raises:
      UserError: no joint angle or target is left, or a twentieth of the times or of the balls
        cannot be.
    """
    said = list(notes)
    in_order = balls.some(np.argsort(balls.times, kind="stable"))
    angles, targets, balls = (
        _without(source, rows, rules, said)
        for rows, rules in (
            (angles, _RULES_OF_ANGLES),
            (targets, _RULES_OF_TARGETS),
            (in_order, _RULES_OF_PICTURES),
        )
    )
    return Log(
        source, angles.times, angles.values, targets.times, targets.values,
        balls.times, balls.values, balls.arrivals, tuple(said),
    )  # fmt: skip


class _Rule(NamedTuple):
    """What leaves out rows of a measurement."""

    found: Callable[[Rows], np.ndarray]
    """Which rows [R] it leaves out."""
    why: str = ""
    """What is wrong with them; by default, their fault."""
    refused: float = np.inf
    """Share of the rows from which the log is refused, if there are two."""
    remedy: str = ""
    """What to do then."""


def _without(source: str, rows: Rows, rules: Sequence[_Rule], said: list[str]) -> Rows:
    """The rows that no rule leaves out; the others are counted in `said`."""
    for rule in rules:
        wrong = rule.found(rows)
        if not np.any(wrong):
            continue
        first, count = int(np.argmax(wrong)), int(np.sum(wrong))
        sentence = (
            f"{count} of the {len(wrong)} {rows.name} in {source} do not count: "
            f"{rows.place.format(rows.numbers[first])} {rule.why or rows.faults[first]}"
        )
        if count >= max(rule.refused * len(wrong), 2.0):
            raise UserError(sentence + rule.remedy)
        said.append(sentence)
        rows = rows.some(~wrong)
    return rows


def _repeated(rows: np.ndarray) -> np.ndarray:
    """Which rows [R] of [R, k] are equal to the one before."""
    return np.all(np.diff(rows, axis=0, prepend=np.nan) == 0.0, axis=1)


def _far_in_time(rows: Rows) -> np.ndarray:
    middle = np.median(rows.times) if len(rows.times) else 0.0
    return np.abs(rows.times - middle) > _FAR_IN_TIME


def _spikes(rows: Rows) -> np.ndarray:
    """Which angles [R] are off a line through their neighbours as no arm can be."""
    found, q = np.zeros(len(rows.times), bool), rows.values
    if len(found) < 5:
        return found
    before, after = np.diff(rows.times)[:-1, None], np.diff(rows.times)[1:, None]
    line = (after * q[:-2] + before * q[2:]) / (before + after)
    off = np.max(np.abs(q[1:-1] - line), axis=1)
    possible = 0.5 * _FASTEST_ACCELERATION * (before * after)[:, 0]
    large = off > np.maximum(possible, max(_SMALLEST_SPIKE, 30.0 * np.median(off)))
    # The line through a spike is off at its neighbours, by half as much.
    beside = np.convolve(off, [0.5, 0.0, 0.5], "same")
    found[1:-1] = large & (off > 1.5 * beside)
    return found


def _out_of_order(rows: Rows) -> np.ndarray:
    """Which rows [R] are not of the longest part with increasing times (patience sorting)."""
    ends: list[float] = []
    last: list[int] = []
    before = np.full(len(rows.times), -1)
    for i, time in enumerate(rows.times.tolist()):
        k = bisect.bisect_left(ends, time)
        ends[k : k + 1], last[k : k + 1] = [time], [i]
        before[i] = last[k - 1] if k else -1
    found, i = np.ones(len(rows.times), bool), last[-1] if last else -1
    while i >= 0:
        found[i], i = False, before[i]
    return found


_ONE_CLOCK = _WRONG_ROWS, "; give each its own time, of one clock"
_FAR = _Rule(_far_in_time, "has a time far from the others", *_ONE_CLOCK)
_RULES_OF_TARGETS = (
    _Rule(lambda rows: rows.faults != "", refused=1.0),
    _Rule(
        lambda rows: _repeated(np.column_stack([rows.times, rows.values])),
        "repeats the one before",
    ),
    _FAR,
    _Rule(_out_of_order, "has a time out of order", *_ONE_CLOCK),
)
_RULES_OF_ANGLES = (*_RULES_OF_TARGETS, _Rule(_spikes, "is a jump there and back"))
_RULES_OF_PICTURES = (
    # An arm may have been recorded alone, with a tracker that saw no ball.
    _Rule(lambda rows: rows.faults != ""),
    # Trackers, and logs of control steps, hold the last picture until the next.
    _Rule(lambda rows: _repeated(rows.values), "repeats the one before"),
    _FAR,
    _Rule(
        lambda rows: np.any(np.abs(rows.values) > _FARTHEST_BALL, axis=1),
        f"is farther away than {_FARTHEST_BALL:g} m",
        _WRONG_ROWS,
        "; if these are millimetres, write ball_position.x [mm]",
    ),
    _Rule(
        lambda rows: np.diff(rows.times, prepend=-np.inf) < _SAME_PICTURE,
        "has the time stamp of another",
    ),
)


def read_csv(path: Path, joint_names: Sequence[str]) -> Log:
    """Reads a CSV log; nothing but the file is touched. Cells are separated by commas, semicolons
    or tabs, as the header's; beside the last two, a decimal comma is read.

    Args:
      joint_names: the robot's joints, in the order of the result.

    Raises:
      UserError: the file cannot be read, a column is missing or states an unknown unit, or as
        `make_log`.
    """
    header, lines, rows = _cells(path)
    found = _columns(path, header)

    def column(name: str, unit: str) -> np.ndarray:
        if name not in found:
            raise UserError(
                f"{path} has no column {name} [{unit}]; its columns are "
                f"{', '.join(map(shorten, list(found)[:30]))}; if the joints have other names, "
                "give the log's robot with --robot, or the names in this order with --joint-names"
            )
        index, given = found[name]
        if given not in UNITS[unit]:
            raise UserError(
                f"{path} has the column {shorten(header[index])}, whose unit must be one of "
                f"{', '.join(UNITS[unit])}; write {name} [{unit}]"
            )
        return np.array([_number(row[index]) for row in rows]) * UNITS[unit][given]

    times = column("time", "s")

    def group(what: str, names: Sequence[str], unit: str, stamp: str = "time") -> Rows:
        """The rows with any cell of a measurement; those that lack another are faulty."""
        values = np.stack([column(name, unit) for name in names], axis=1)
        stamps = column(stamp, "s")
        empty = np.isnan(np.column_stack([values, times, stamps]))
        why = np.array([f"has no number in the column {x}" for x in (*names, "time", stamp)])
        faults = np.where(np.any(empty, axis=1), why[np.argmax(empty, axis=1)], "")
        measured = ~np.all(np.isnan(values), axis=1)
        return Rows(what, "row {}", lines, stamps, times, values, faults).some(measured)

    angles, targets = (
        group(what, [f"{what.replace(' ', '_')}.{joint}" for joint in joint_names], "rad")
        for what in ("joint angles", "servo targets")
    )
    what, ball = "pictures of the ball", [f"ball_position.{axis}" for axis in "xyz"]
    if any(name in found for name in (*ball, "ball_time")):
        balls = group(what, ball, "m", "ball_time" if "ball_time" in found else "time")
    else:
        balls = Rows(what, "row {}", *np.zeros((3, 0)), np.zeros((0, 3)), np.zeros(0, str))
    return make_log(str(path), angles, targets, balls)


def clock_drift(log: Log) -> tuple[float, float]:
    """By how much the age of the pictures grows each second, and the age (s) of the youngest ones
    at the first arrival: a line (Theil 1950 and Sen 1968, which no fourth of its points can bend)
    through the shortest time from a stamp to its arrival in each stretch of the log."""
    ages = log.arrivals - log.picture_times
    parts = np.array_split(np.arange(len(ages)), _STRETCHES)
    youngest = np.array([part[np.argmin(ages[part])] for part in parts])
    times, least = log.arrivals[youngest] - log.arrivals[0], ages[youngest]
    one, other = np.triu_indices(_STRETCHES, 1)
    apart = times[other] - times[one]
    slopes = (least[other] - least[one])[apart > 0.0] / apart[apart > 0.0]
    slope = float(np.median(slopes)) if len(slopes) else 0.0
    return slope, float(np.median(least - slope * times))


def in_one_clock(log: Log) -> Log:
    """The log with the pictures' time stamps in the clock of their arrivals.

    A camera with its own clock is off by a constant and drifts by some parts in 1e5. A drift of
    less than a millisecond, and an offset of less than a second, count as none; so does one that is
    faster than any clock's.

    Raises:
      UserError: the stamps are no seconds.
    """
    if len(log.picture_times) < _STRETCHES * 20:
        return log
    slope, youngest = clock_drift(log)
    since = log.arrivals - log.arrivals[0]
    total, notes = abs(slope) * float(np.max(since)), list(log.notes)
    if abs(slope) > _FASTEST_DRIFT and total > _NO_CLOCK:
        raise UserError(
            f"the time stamps of the pictures in {log.source} advance by {1.0 - slope:.4g} s each "
            "second, and those of a clock by 1 s; if they are milliseconds, write ball_time [ms]"
        )
    if total < _DRIFT or abs(slope) > _FASTEST_DRIFT:
        if total > 5.0 * _DRIFT:
            notes.append(
                f"the pictures in {log.source} grow older by {1e3 * total:.1f} ms over the log, "
                "faster than clocks drift; it is taken for a part of their latency"
            )
        slope = 0.0
    else:
        notes.append(
            f"the camera's clock drifts by {1e6 * slope:.0f} parts in 1e6 in {log.source}, "
            f"{1e3 * total:.1f} ms over the log; the pictures' time stamps are corrected"
        )
    offset = youngest if abs(youngest) > _LARGEST_AGE else 0.0
    if offset:
        notes.append(
            f"the camera's clock is {offset:.6g} s behind the robot's in {log.source}; the "
            "pictures' time stamps are corrected, and the youngest counts as of no age"
        )
    return log._replace(
        picture_times=log.picture_times + slope * since + offset, notes=tuple(notes)
    )


def least_age(log: Log) -> float:
    """Time from a picture's stamp to its arrival, s: 0 if the stamp is that of the arrival. Of the
    youngest pictures, as the others wait for the next control step."""
    if not len(log.arrivals):
        return 0.0
    return max(0.0, float(np.quantile(log.arrivals - log.picture_times, 0.02)))


def check(log: Log, joint_names: Sequence[str], joint_ranges: np.ndarray) -> list[str]:
    """Checks that a log can be the robot's.

    Args:
      joint_ranges: lower and upper limit [n, 2] of each joint, rad; both 0 for none.

    Returns:
      Warnings, a sentence each.

    Raises:
      UserError: it is too short, its times are not seconds or of two clocks, or a joint is far
        outside its range.
    """
    limited = joint_ranges[:, :1] < joint_ranges[:, 1:]
    ends = [-_BEYOND_RANGE, _BEYOND_RANGE], [-_LARGEST_ANGLE, _LARGEST_ANGLE]
    low, high = np.where(limited, joint_ranges + ends[0], ends[1]).T
    for name, times, values in (
        ("joint angles", log.times, log.joint_angles),
        ("servo targets", log.target_times, log.servo_targets),
    ):
        if len(times) < _MIN_ROWS:
            raise UserError(
                f"{log.source} has {len(times)} {name}; record at least {_MIN_ROWS} control steps"
            )
        if (typical := float(np.median(np.diff(times)))) > _LONGEST_STEP:
            raise UserError(
                f"the {name} in {log.source} are {typical:.3g} s apart, and at most "
                f"{_LONGEST_STEP:g} s is expected; if the times are milliseconds, write time [ms]"
            )
        if np.any(outside := (values < low) | (values > high)):
            row, joint = np.argwhere(outside)[0]
            column = f"{name.replace(' ', '_')}.{joint_names[joint]}"
            raise UserError(
                f"{column} in {log.source} is {values[row, joint]:.4g} rad at the time "
                f"{times[row]:.6g} s, and {low[joint]:.3g} to {high[joint]:.3g} rad is expected; "
                f"if these are degrees, write {column} [deg]"
            )
    begins, ends = (log.times[0], log.target_times[0]), (log.times[-1], log.target_times[-1])
    if max(begins) > min(ends):
        raise UserError(
            f"the joint angles in {log.source} begin at {begins[0]:.6g} s and end at {ends[0]:.6g} "
            f"s, and the servo targets at {begins[1]:.6g} and {ends[1]:.6g} s: they have two "
            "clocks, such as simulated time and that of the computer; give stamps of one clock"
        )
    unseen = log.times[-1] - log.arrivals[-1] if len(log.arrivals) else 0.0
    return [f"{log.source} shows no ball in its last {unseen:.1f} s"] if unseen > 2.0 else []


def unshown(log: Log, joint_names: Sequence[str]) -> list[str]:
    """What all logs of a robot together lack, a sentence each."""
    said = []
    if not len(log.picture_times):
        said.append(
            f"{log.source} has no picture of the ball; only the arm is identified, and the ball's "
            "and the camera's terms keep their prior ranges"
        )
    moved = np.ptp(log.servo_targets, axis=0)
    if np.any(moved < 0.01):
        said.append(
            f"in {log.source}, {joint_names[int(np.argmin(moved))]} moves by less than 0.01 rad; "
            "record bounce-mjx excite too"
        )
    return said


def _cells(path: Path) -> tuple[list[str], np.ndarray, Sequence[list[str]]]:
    """Header, and line number [R] and cells of each row, of a CSV file."""
    try:
        if not os.path.isfile(path):
            raise UserError(f"the log {path} is not a file; give a CSV file or a ROS bag")
        if (size := os.path.getsize(path)) > MAX_BYTES:
            raise UserError(
                f"the log {path} has {size / 2**20:.0f} MiB, and at most {MAX_BYTES // 2**20} MiB "
                "are read; cut out the minutes that matter"
            )
        with path.open(newline="", encoding="utf-8-sig") as file:
            head = file.readline()
            delimiter = max(",;\t", key=head.count)
            file.seek(0)
            reader = csv.reader(file, delimiter=delimiter)
            header = [name.strip() for name in next(reader, [])]
            numbered = [(reader.line_num, row) for row in reader if any(row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(
            f"the log {path} cannot be read ({shorten(reason_of(error))}); give a CSV file in UTF-8"
        ) from error
    if not numbered:
        raise UserError(f"the log {path} is empty; record with bounce_mjx's Recorder")
    for line, row in numbered:
        if len(row) != len(header):
            raise UserError(
                f"{path} has {len(row)} cells in row {line}, and its header has {len(header)}; "
                "give each row a cell for each column"
            )
        if delimiter != ",":
            row[:] = [cell.replace(",", ".") for cell in row]
    lines, rows = zip(*numbered, strict=True)
    return header, np.array(lines), rows


def _number(text: str) -> float:
    """A cell's number; NaN if it holds none, or one that is not finite."""
    try:
        return float(text) if np.isfinite(float(text)) else np.nan
    except ValueError:
        return np.nan


def _columns(path: Path, header: Sequence[str]) -> dict[str, tuple[int, str]]:
    """Index and stated unit of each column by its name."""
    found: dict[str, tuple[int, str]] = {}
    for i, title in enumerate(header):
        match = re.fullmatch(r"(.*?)\s*(?:\[([^\[\]]*)\])?", title)
        name, unit = match.groups()
        if name in found:
            raise UserError(f"{path} has two columns {shorten(name)}; leave one")
        found[name] = i, (unit or "").strip()
    return found
