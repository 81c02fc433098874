"""A log of a robot's run, as `deploy.recorder.Recorder` writes it, and its checks."""

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
# Stretches of a log in which the youngest picture is looked for; drift (s) over the log below which
# the clocks count as one, and age of a picture (s) beyond which they do not.
_STRETCHES = 12
_DRIFT = 1e-3
_LARGEST_AGE = 1.0


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

    @property
    def seconds(self) -> float:
        """Length, s."""
        return float(self.times[-1] - self.times[0])


def read_csv(path: Path, joint_names: Sequence[str]) -> Log:
    """Reads a CSV log; nothing but the file is touched.

    Args:
      joint_names: the robot's joints, in the order of the result.

    Raises:
      UserError: the file cannot be read, a column is missing or states an unknown unit, or a cell
        is not a finite number.
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
    if np.any(empty := np.isnan(times)):
        raise UserError(f"{path} has no time in row {lines[int(np.argmax(empty))]}; give seconds")
    angles, targets = (
        np.stack([column(f"{name}.{joint}", "rad") for joint in joint_names], axis=1)
        for name in ("joint_angles", "servo_targets")
    )
    ball_columns = [f"ball_position.{axis}" for axis in "xyz"]
    if any(name in found for name in (*ball_columns, "ball_time")):
        balls = np.stack([column(name, "m") for name in ball_columns], axis=1)
        stamps = column("ball_time", "s") if "ball_time" in found else times
    else:
        balls, stamps = np.full((len(times), 3), np.nan), times
    of_angles, of_targets = (
        _filled(path, group, names, lines)
        for group, names in (
            (angles, [f"joint_angles.{joint}" for joint in joint_names]),
            (targets, [f"servo_targets.{joint}" for joint in joint_names]),
        )
    )
    of_pictures = _filled(
        path, np.column_stack([balls, stamps[:, None]]) if "ball_time" in found else balls,
        [*ball_columns, "ball_time"], lines,
    )  # fmt: skip
    log = Log(
        source=str(path),
        times=times[of_angles],
        joint_angles=angles[of_angles],
        target_times=times[of_targets],
        servo_targets=targets[of_targets],
        picture_times=stamps[of_pictures],
        ball_positions=balls[of_pictures],
        arrivals=times[of_pictures],
    )
    back = np.flatnonzero(np.diff(times) < 0.0)
    if back.size:
        i = int(back[0]) + 1
        raise UserError(
            f"{path} goes back in time in row {lines[i]}, from {times[i - 1]:.6g} to "
            f"{times[i]:.6g} s; give rows in the order of one clock"
        )
    return log


def in_one_clock(log: Log) -> Log:
    """The log with the pictures' time stamps in the clock of their arrivals.

    A camera with its own clock is off by a constant and drifts by some parts in 1e5. The shortest
    times from a stamp to its arrival show it: a line through those of each stretch. A drift of less
    than a millisecond, and an offset of less than a second, count as none.
    """
    if len(log.picture_times) < _STRETCHES * 20:
        return log
    ages = log.arrivals - log.picture_times
    parts = np.array_split(np.arange(len(ages)), _STRETCHES)
    youngest = np.array([part[np.argmin(ages[part])] for part in parts])
    times, least = log.arrivals[youngest], ages[youngest]
    slope, constant = np.polyfit(times - times[0], least, 1)
    drift = slope * (log.arrivals - times[0])
    if np.ptp(drift) < _DRIFT:
        drift = np.zeros_like(ages)
    offset = constant if abs(constant) > _LARGEST_AGE else 0.0
    return log._replace(picture_times=log.picture_times + drift + offset)


def check(log: Log, joint_names: Sequence[str], joint_ranges: np.ndarray) -> list[str]:
    """Checks that a log can be the robot's.

    Args:
      joint_ranges: lower and upper limit [n, 2] of each joint, rad; both 0 for none.

    Returns:
      Warnings, a sentence each.

    Raises:
      UserError: it is too short, its times are not seconds of one clock, a joint is far outside
        its range, or the ball is far away.
    """
    if len(log.times) < _MIN_ROWS or len(log.target_times) < _MIN_ROWS:
        raise UserError(
            f"{log.source} has {len(log.times)} rows with joint angles and "
            f"{len(log.target_times)} with servo targets; record at least {_MIN_ROWS} of each"
        )
    for name, times in (("joint angles", log.times), ("servo targets", log.target_times)):
        steps = np.diff(times)
        if np.any(steps <= 0.0):
            i = int(np.argmax(steps <= 0.0)) + 1
            raise UserError(
                f"the time of the {name} in {log.source} does not increase at {times[i]:.6g} s; "
                "give each row its own time, of one clock"
            )
        if (typical := float(np.median(steps))) > _LONGEST_STEP:
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
    return _warnings(log)


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


def _warnings(log: Log) -> list[str]:
    warnings = []
    if not len(log.picture_times):
        warnings.append(
            f"{log.source} has no picture of the ball; only the arm is identified, and the ball's "
            "and the camera's terms keep their prior ranges"
        )
    elif (unseen := log.times[-1] - log.arrivals[-1]) > 2.0:
        warnings.append(f"{log.source} shows no ball in its last {unseen:.1f} s")
    moved = np.ptp(log.servo_targets, axis=0)
    if np.any(moved < 0.01):
        warnings.append(
            f"in {log.source}, joint number {int(np.argmin(moved)) + 1} moves by less than 0.01 "
            "rad; record bounce-mjx excite too"
        )
    return warnings


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
            reader = csv.reader(file)
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
                rows.append(row)
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
        match = re.fullmatch(r"(\S+)\s*(?:\[(.*)\])?", title)
        name, unit = match.groups() if match else (title, None)
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
            f"this one has {', '.join(joint_names)}; give the log's robot with --robot"
        )
    known = ", ".join(map(shorten, found[:30])) or "nothing"
    return f"{path} has no column {name} [{unit}]; its columns are {known}"


def _numbers(
    path: Path, title: str, index: int, rows: Sequence[Sequence[str]], lines: Sequence[int]
) -> np.ndarray:
    """Numbers of a column [R]; NaN for an empty cell."""
    values = np.full(len(rows), np.nan)
    for i, row in enumerate(rows):
        text = row[index].strip()
        if not text:
            continue
        try:
            values[i] = float(text)
        except ValueError:
            values[i] = np.inf
        if not np.isfinite(values[i]):
            raise UserError(
                f"{path} has {shorten(repr(text))} in the column {shorten(title)}, row {lines[i]}; "
                "give a finite number, or leave the cells of the measurement empty"
            )
    return values


def _filled(
    path: Path, group: np.ndarray, names: Sequence[str], lines: Sequence[int]
) -> np.ndarray:
    """Rows [R] in which all cells of a measurement are filled; UserError if some are not."""
    empty = np.isnan(group)
    partly = np.any(empty, axis=1) & ~np.all(empty, axis=1)
    if names[-1] == "ball_time" and group.shape[1] == 4:
        # Without a ball, the time of the picture may be filled.
        partly &= ~np.all(empty[:, :3], axis=1)
    if np.any(partly):
        row = int(np.argmax(partly))
        name = names[int(np.argmax(empty[row]))]
        raise UserError(
            f"{path} has no number in the column {name}, row {lines[row]}; fill all cells of a "
            "measurement, or none"
        )
    return ~np.any(empty, axis=1)
