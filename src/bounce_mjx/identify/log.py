"""A log of a robot's run, as `deploy.recorder.Recorder` writes it, and its checks."""

import bisect
import csv
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bounce_mjx.errors import UserError, reason_of, shorten

MAX_BYTES = 256 * 2**20
"""A larger file is refused; an hour at 100 Hz has about 150 MB."""

UNITS = {
    "rad": {"rad": 1.0, "deg": np.pi / 180.0},
    "rad/s": {"rad/s": 1.0, "deg/s": np.pi / 180.0},
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
# Largest share of a measurement's rows whose times may be wrong, and time from the log's middle
# beyond which one is, s.
_WRONG_TIMES = 0.05
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

    def some(self, kept: np.ndarray) -> "Rows":
        """The rows of a mask [R], or at indices."""
        return Rows(*self[:2], *(array[kept] for array in self[2:]))

    def at(self, row: int) -> str:
        """Place of a row, for messages."""
        return self.place.format(self.numbers[row])


def make_log(
    source: str, angles: Rows, targets: Rows, balls: Rows, notes: Sequence[str] = ()
) -> Log:
    """The log of three measurements, without the rows that repeat others or have wrong times.

    Raises:
      UserError: more than a twentieth of the times are wrong, or angles and targets have two
        clocks.
    """
    said = list(notes)
    angles, targets = (_in_order(source, rows, said) for rows in (angles, targets))
    angles = _without(source, angles, _spikes(angles), "is a jump there and back", said)
    for one, other in ((angles, targets), (targets, angles)):
        if len(one.times) and len(other.times) and one.times[0] > other.times[-1]:
            raise UserError(
                f"the {one.name} in {source} begin at {one.times[0]:.6g} s and the {other.name} "
                f"end at {other.times[-1]:.6g} s: they have two clocks, such as simulated time and "
                "that of the computer; give both time stamps of one clock"
            )
    pictures = _new_pictures(source, balls, said)
    return Log(
        source, angles.times, angles.values, targets.times, targets.values,
        pictures.times, pictures.values, pictures.arrivals, tuple(said),
    )  # fmt: skip


def _in_order(source: str, rows: Rows, said: list[str]) -> Rows:
    """The rows with increasing times; the others are counted in `said`."""
    if len(rows.times) < 2:
        return rows
    same = (np.diff(rows.times) == 0.0) & np.all(np.diff(rows.values, axis=0) == 0.0, axis=1)
    rows = _without(source, rows, np.append(False, same), "repeats the one before", said)
    near = np.abs(rows.times - np.median(rows.times)) < _FAR_IN_TIME
    kept = near.copy()
    kept[near] = _longest_increase(rows.times[near])
    wrong = int(np.sum(~kept))
    if wrong > max(_WRONG_TIMES * len(kept), 1.0):
        raise UserError(
            f"{wrong} of the {len(kept)} times of the {rows.name} in {source} do not increase, "
            f"that of {rows.at(int(np.argmin(kept)))} first; give each its own time, of one clock"
        )
    return _without(source, rows, ~kept, "has a time out of order", said)


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


def _new_pictures(source: str, rows: Rows, said: list[str]) -> Rows:
    """The pictures in the order of their stamps, without those that repeat one: trackers, and logs
    of control steps, hold the last picture until the next. The others are counted in `said`."""
    if len(rows.times) < 2:
        return rows
    same = np.append(False, np.all(np.diff(rows.values, axis=0) == 0.0, axis=1))
    rows = _without(source, rows, same, "repeats the one before", said)
    far = np.abs(rows.times - np.median(rows.times)) > _FAR_IN_TIME
    rows = _without(source, rows, far, "has a time far from the others", said)
    far = np.any(np.abs(rows.values) > _FARTHEST_BALL, axis=1)
    far &= np.mean(far) < _WRONG_TIMES
    rows = _without(source, rows, far, f"is farther away than {_FARTHEST_BALL:g} m", said)
    rows = rows.some(np.argsort(rows.times, kind="stable"))
    same = np.diff(rows.times, prepend=-np.inf) < _SAME_PICTURE
    return _without(source, rows, same, "has the time stamp of another", said)


def _without(source: str, rows: Rows, dropped: np.ndarray, why: str, said: list[str]) -> Rows:
    """The rows that are not dropped; the others are counted in `said`."""
    if np.any(dropped):
        said.append(
            f"{int(np.sum(dropped))} of the {len(dropped)} {rows.name} in {source} do not count: "
            f"{rows.at(int(np.argmax(dropped)))} {why}"
        )
    return rows.some(~dropped)


def _longest_increase(values: np.ndarray) -> np.ndarray:
    """Which values [T] are of the longest increasing part of a sequence (patience sorting)."""
    ends: list[float] = []
    last: list[int] = []
    before = np.full(len(values), -1)
    for i, value in enumerate(values.tolist()):
        k = bisect.bisect_left(ends, value)
        ends[k : k + 1], last[k : k + 1] = [value], [i]
        before[i] = last[k - 1] if k else -1
    kept, i = np.zeros(len(values), bool), last[-1] if last else -1
    while i >= 0:
        kept[i], i = True, before[i]
    return kept


def read_csv(path: Path, joint_names: Sequence[str]) -> Log:
    """Reads a CSV log; nothing but the file is touched. Cells are separated by commas, semicolons
    or tabs, as the header's; beside the last two, a decimal comma is read.

    Args:
      joint_names: the robot's joints, in the order of the result.

    Raises:
      UserError: the file cannot be read, a column is missing or states an unknown unit, a cell is
        no number, a measurement is never whole, or as `make_log`.
    """
    header, rows, lines = _cells(path)
    found = _columns(path, header)

    def column(name: str, unit: str) -> np.ndarray:
        if name not in found:
            raise UserError(_missing(path, name, unit, list(found), joint_names))
        index, given = found[name]
        if given not in UNITS[unit]:
            raise UserError(
                f"{path} has the column {shorten(header[index])}, whose unit must be one of "
                f"{', '.join(UNITS[unit])}; write {name} [{unit}]"
            )
        values = _numbers(path, header[index], index, rows, lines)
        return values * UNITS[unit][given]

    times = column("time", "s")
    numbers, notes = np.array(lines), []

    def group(what: str, names: Sequence[str], unit: str, stamps: np.ndarray | None) -> Rows:
        values = np.stack([column(name, unit) for name in names], axis=1)
        stamp = times if stamps is None else stamps
        of_rows = Rows(what, "row {}", numbers, stamp, times, values)
        titles = [*names, "time", "ball_time"]
        return _whole(path, of_rows, titles, notes)

    angles, targets = (
        group(what, [f"{name}.{joint}" for joint in joint_names], "rad", None)
        for what, name in (("joint angles", "joint_angles"), ("servo targets", "servo_targets"))
    )
    ball = [f"ball_position.{axis}" for axis in "xyz"]
    if any(name in found for name in (*ball, "ball_time")):
        stamps = column("ball_time", "s") if "ball_time" in found else None
        balls = group("pictures of the ball", ball, "m", stamps)
    else:
        nothing = np.zeros(0)
        balls = Rows("pictures of the ball", "row {}", *3 * [nothing], np.zeros((0, 3)))
    return make_log(str(path), angles, targets, balls, notes)


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
      UserError: it is too short, its times are not seconds, a joint is far outside its range, or
        the ball is far away.
    """
    if len(log.times) < _MIN_ROWS or len(log.target_times) < _MIN_ROWS:
        raise UserError(
            f"{log.source} has {len(log.times)} rows with joint angles and "
            f"{len(log.target_times)} with servo targets; record at least {_MIN_ROWS} of each"
        )
    for name, times in (("joint angles", log.times), ("servo targets", log.target_times)):
        if (typical := float(np.median(np.diff(times)))) > _LONGEST_STEP:
            raise UserError(
                f"the {name} in {log.source} are {typical:.3g} s apart, and at most "
                f"{_LONGEST_STEP:g} s is expected; if the times are milliseconds, write time [ms]"
            )
    for name, values in (("joint_angles", log.joint_angles), ("servo_targets", log.servo_targets)):
        _check_ranges(log, name, values, joint_names, joint_ranges)
    far = np.any(np.abs(log.ball_positions) > _FARTHEST_BALL, axis=1)
    if np.any(far):
        i = int(np.argmax(far))
        raise UserError(
            f"the ball in {log.source} is at {log.ball_positions[i]} m at the time "
            f"{log.picture_times[i]:.6g} s; if these are millimetres, write ball_position.x [mm]"
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


def _check_ranges(
    log: Log, name: str, values: np.ndarray, joint_names: Sequence[str], ranges: np.ndarray
) -> None:
    limited = ranges[:, 0] < ranges[:, 1]
    low = np.where(limited, ranges[:, 0] - _BEYOND_RANGE, -_LARGEST_ANGLE)
    high = np.where(limited, ranges[:, 1] + _BEYOND_RANGE, _LARGEST_ANGLE)
    outside = (values < low) | (values > high)
    if not np.any(outside):
        return
    row, joint = (int(i[0]) for i in np.nonzero(outside))
    times = log.times if name == "joint_angles" else log.target_times
    raise UserError(
        f"{name}.{joint_names[joint]} in {log.source} is {values[row, joint]:.4g} rad at the time "
        f"{times[row]:.6g} s, and {low[joint]:.3g} to {high[joint]:.3g} rad is expected; if these "
        f"are degrees, write {name}.{joint_names[joint]} [deg]"
    )


def _cells(path: Path) -> tuple[list[str], list[list[str]], list[int]]:
    """Header, cells, and line number of each row of a CSV file."""
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
            rows, lines = [], []
            for row in reader:
                if not any(row):
                    continue
                if len(row) != len(header):
                    raise UserError(
                        f"{path} has {len(row)} cells in row {reader.line_num}, and its header "
                        f"has {len(header)}; give each row a cell for each column"
                    )
                rows.append(row if delimiter == "," else [c.replace(",", ".") for c in row])
                lines.append(reader.line_num)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(
            f"the log {path} cannot be read ({shorten(reason_of(error))}); give a CSV file in UTF-8"
        ) from error
    if not rows:
        raise UserError(f"the log {path} is empty; record with bounce_mjx's Recorder")
    return header, rows, lines


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


def _missing(
    path: Path, name: str, unit: str, found: Sequence[str], joint_names: Sequence[str]
) -> str:
    present = [c.partition(".")[2] for c in found if c.startswith("joint_angles.")]
    others = [joint for joint in present if joint not in joint_names]
    if others:
        return (
            f"{path} is of a robot with the joints {', '.join(map(shorten, present[:20]))}, and "
            f"this one has {', '.join(joint_names)}; give the log's robot with --robot, or the "
            "log's names in this order with --joint-names"
        )
    known = ", ".join(map(shorten, found[:30])) or "nothing"
    return f"{path} has no column {name} [{unit}]; its columns are {known}"


def _numbers(
    path: Path, title: str, index: int, rows: Sequence[Sequence[str]], lines: Sequence[int]
) -> np.ndarray:
    """Numbers of a column [R]; NaN for an empty cell, or one that says so."""
    values = np.full(len(rows), np.nan)
    for i, row in enumerate(rows):
        text = row[index].strip()
        if not text:
            continue
        try:
            values[i] = float(text)
        except ValueError:
            values[i] = np.inf
        if np.isinf(values[i]):
            raise UserError(
                f"{path} has {shorten(repr(text))} in the column {shorten(title)}, row {lines[i]}; "
                "give a finite number, or leave the cells of the measurement empty"
            )
    return values


def _whole(path: Path, rows: Rows, titles: Sequence[str], notes: list[str]) -> Rows:
    """The rows that hold the measurement; those that hold a part of it are counted in `notes`.

    Args:
      titles: names of the columns, then those of the row's time and of the measurement's.
    """
    rows = rows.some(~np.all(np.isnan(rows.values), axis=1))
    empty = np.isnan(np.column_stack([rows.values, rows.arrivals, rows.times]))
    partly = np.any(empty, axis=1)
    if not np.any(partly):
        return rows
    i = int(np.argmax(partly))
    why = f"has no number in the column {titles[int(np.argmax(empty[i]))]}"
    if np.all(partly):
        raise UserError(f"{path} {why}, {rows.at(i)}; fill all cells of a measurement, or none")
    return _without(str(path), rows, partly, why, notes)
