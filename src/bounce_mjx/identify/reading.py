"""Reading of logs: CSV files, as `deploy.recorder.Recorder` writes them, and ROS bags and MCAP
files, by `rosbags` (the extra `identify`)."""

import csv
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from bounce_mjx.deploy.loading import check_names
from bounce_mjx.errors import UserError, needed, reason_of, shorten
from bounce_mjx.identify import Topics
from bounce_mjx.identify.log import Log, Rows, align_clocks, check, make_log
from bounce_mjx.robot.model import find_addresses, joint_names

UNITS = {
    "rad": {"rad": 1.0, "deg": np.pi / 180.0},
    "m": {"m": 1.0, "mm": 1e-3},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
}
"""Units that a column may state in place of the one in SI, and their factors."""
# Time by which stamps and arrivals differ, s, beyond which they are of two clocks.
_TWO_CLOCKS = 1.0
# Of the topics.
_TYPES = "JointState", "JointState or Float64MultiArray", "PointStamped or PoseStamped"


def read_log(path: Path, model: mujoco.MjModel, topics: Topics, names: Sequence[str] = ()) -> Log:
    """Reads and checks the CSV file or the ROS bag of a robot's run; its times are of one clock.

    Args:
      model: the robot.
      names: the log's names of the robot's joints, in the robot's order; by default the model's.

    Raises:
      UserError: as `read_csv`, `read_bag`, `check` and `align_clocks`, or the names do not fit.
    """
    robot_names = joint_names(model)
    names = check_names(names or robot_names, robot_names, "--joint-names")
    is_bag = path.is_dir() or path.suffix.lower() in (".mcap", ".db3", ".bag", ".zstd")
    log = read_bag(path, names, topics) if is_bag else read_csv(path, names)
    check(log, names, model.jnt_range[list(find_addresses(model).arm_joints)])
    return align_clocks(log)


def read_csv(path: Path, joint_names: Sequence[str]) -> Log:
    """Reads a CSV log. Cells are separated by commas, semicolons or tabs, as the header's; beside
    the last two, a decimal comma is read.

    Args:
      joint_names: the robot's joints, in the order of the result.

    Raises:
      UserError: the file cannot be read, a column is missing or states an unknown unit, or as
        `make_log`.
    """
    columns, line_numbers = _read_columns(path)

    def column(name: str, unit: str) -> np.ndarray:
        if name not in columns:
            if (near := name.replace(".", "_")) in columns:
                raise UserError(f"{path} has the column {near}; write {name} for {near}")
            if (other := _foreign(columns, name)) is not None:
                raise UserError(f"{path} has no column {name} [{unit}]; write {name} for {other}")
            raise UserError(
                f"{path} has no column {name} [{unit}]; its columns are "
                f"{', '.join(map(shorten, list(columns)[:30]))}; if the joints have other names, "
                "give the log's robot with --robot, or the names in this order with --joint-names"
            )
        stated_unit, numbers = columns[name]
        if stated_unit not in UNITS[unit]:
            raise UserError(
                f"{path} has the column {name} [{shorten(stated_unit)}], whose unit must be one of "
                f"{', '.join(UNITS[unit])}; write {name} [{unit}]"
            )
        return numbers * UNITS[unit][stated_unit]

    times = column("time", "s")

    def group(what: str, names: Sequence[str], unit: str, stamp: str = "time") -> Rows:
        """The rows with any cell of a measurement."""
        values = np.stack([column(name, unit) for name in names], axis=1)
        rows = Rows(
            name=f"{what} in {path}",
            place="row {}",
            numbers=line_numbers,
            times=column(stamp, "s"),
            arrivals=times,
            values=values,
        )
        return rows.chosen(~np.all(np.isnan(values), axis=1))

    angle_columns = [f"joint_angles.{joint}" for joint in joint_names]
    target_columns = [f"servo_targets.{joint}" for joint in joint_names]
    has_several_balls = "ball_position.1.x" in columns
    ball = "ball_position.1" if has_several_balls else "ball_position"
    ball_columns = [f"{ball}.{axis}" for axis in "xyz"]
    angles = group("joint angles", angle_columns, "rad")
    targets = group("servo targets", target_columns, "rad")
    if any(name in columns for name in (*ball_columns, "ball_time")):
        stamp = "ball_time" if "ball_time" in columns else "time"
        balls = group("pictures of the ball", ball_columns, "m", stamp)
    else:
        balls = Rows(
            name="pictures of the ball",
            place="row {}",
            numbers=np.zeros(0),
            times=np.zeros(0),
            arrivals=np.zeros(0),
            values=np.zeros((0, 3)),
        )
    log = make_log(str(path), angles, targets, balls)
    if has_several_balls:
        note = f"{path} shows several balls; the flights and bounces of the first one count"
        log = log._replace(notes=(*log.notes, note))
    return log


def _foreign(columns: Mapping[str, Any], name: str) -> str | None:
    """The column of a log that is likely one of another name: the first, for the time, and another
    one of the same joint or axis."""
    known = ("time", "joint_angles.", "joint_velocities.", "servo_targets.", "ball_")
    of_part = "." + name.rpartition(".")[2]
    for i, other in enumerate(columns):
        is_alike = i == 0 if name == "time" else other.endswith(of_part)
        if is_alike and not other.startswith(known):
            return shorten(other)
    return None


def _read_columns(path: Path) -> tuple[dict[str, tuple[str, np.ndarray]], np.ndarray]:
    """The stated unit and the numbers [R] of each column of a CSV file, by its name, NaN for a cell
    that holds none; and the line [R] of the file that each row is."""
    try:
        header, *lines = path.read_text("utf-8-sig").splitlines() or [""]
        _check_form(path, header, lines)
        delimiter = max(",;\t", key=header.count)
        titles = next(csv.reader([header], delimiter=delimiter), [])
        lines = [line.replace('"', "") for line in lines]
        if delimiter != ",":
            lines = [line.replace(",", ".") for line in lines]
        # With the header, so that NumPy's errors count the lines of the file.
        options = dict(delimiter=delimiter, comments=None, ndmin=2, skip_header=1)
        cells = np.genfromtxt([header, *lines], **options) if lines else np.zeros((0, 0))
    except (OSError, ValueError) as error:
        remedy = "give a CSV file in UTF-8, or a ROS bag"
        # NumPy's words for lines of another length.
        if "columns instead of" in str(error):
            remedy = "correct these lines, or delete the last one where the recording was cut off"
        raise UserError(
            f"the log {path} cannot be read ({shorten(reason_of(error))}); {remedy}"
        ) from error
    if delimiter == "," and cells.size and cells.shape[1] == 2 * len(titles):
        raise UserError(
            f"the numbers of {path} have decimal commas, and commas between them too; separate "
            "them by semicolons, or write decimal points"
        )
    if cells.shape[1] != len(titles) or not cells.size:
        raise UserError(
            f"the log {path} has {len(cells)} rows of {cells.shape[1]} cells, and its header has "
            f"{len(titles)}; record with bounce_mjx's Recorder"
        )
    columns: dict[str, tuple[str, np.ndarray]] = {}
    for title, numbers in zip(titles, cells.T, strict=True):
        name, unit = re.fullmatch(r"\s*(.*?)\s*(?:\[([^\[\]]*)\])?\s*", title).groups()
        if name in columns:
            raise UserError(f"{path} has two columns {shorten(name)}; leave one")
        columns[name] = (unit or "").strip(), numbers
    # NumPy passes over blank lines.
    is_row = np.array([line.strip(" ") != "" for line in lines])
    return columns, 2 + np.flatnonzero(is_row)


def _check_form(path: Path, header: str, lines: Sequence[str]) -> None:
    """Refuses tables that other programs write in another form.

    Raises:
      UserError: the first line is a comment, cells are separated by spaces, or times are dates.
    """
    if header.lstrip().startswith(("#", "%")):
        raise UserError(
            f"{path} begins with the comment {shorten(header.strip())}; begin with the columns' "
            "titles, without a mark"
        )
    if not any(mark in header for mark in ",;\t") and "joint_angles" in header and " " in header:
        raise UserError(f"the cells of {path} are separated by spaces; separate them by commas")
    first = lines[0].split(",")[0].strip('" ') if lines else ""
    if re.match(r"\d{4}-\d\d-\d\d", first):
        raise UserError(
            f"{path}: the column time holds {shorten(first)}; write it in seconds, such as by "
            "Python's datetime.fromisoformat(text).timestamp()"
        )


def read_bag(path: Path, joint_names: Sequence[str], topics: Topics) -> Log:
    """Reads a bag. Times are the header's stamps, or the bag's where a topic has none. Messages
    without a number for each joint are left out and counted.

    Raises:
      MissingPackage: rosbags is missing.
      UserError: the bag cannot be read, a topic is missing or of another type, no message has a
        joint, the ball is in two frames, or as `make_log`.
    """
    messages = _read_messages(path, topics)
    groups = []
    for name, topic in (("joint angles", topics.joints), ("servo targets", topics.targets)):
        named = {joint for _, message in messages[topic] for joint in getattr(message, "name", ())}
        missing = [joint for joint in joint_names if joint not in named]
        if named and missing:
            raise UserError(
                f"{topic} in {path} has the joints {', '.join(map(shorten, sorted(named)[:20]))}, "
                f"and {missing[0]} is missing; give the log's robot with --robot, or the driver's "
                "names with --joint-names"
            )
        read = partial(_read_angles, joint_names=joint_names)
        source = f"{topic} in {path}"
        groups.append(_make_rows(f"{name} of {source}", messages[topic], len(joint_names), read))
    angles, targets = groups
    name = f"pictures of the ball of {topics.ball} in {path}"
    balls = _make_rows(name, messages[topics.ball], 3, _read_position)
    seen = np.flatnonzero(np.isfinite(balls.values).all(axis=1))
    frames = {messages[topics.ball][i][1].header.frame_id for i in seen}
    if len(frames) > 1:
        raise UserError(
            f"the messages of {topics.ball} in {path} are in the frames "
            f"{', '.join(map(shorten, sorted(frames)))}; record the ball in the robot's base frame"
        )
    is_stamped = np.isfinite(angles.times)
    ages = (angles.arrivals - angles.times)[is_stamped]
    if np.any(is_stamped) and abs(np.median(ages)) > _TWO_CLOCKS:
        # Such as simulated time: a picture arrived when the angles of the same moment did, and
        # beyond them at the age of the nearest.
        age = np.interp(balls.arrivals, angles.arrivals[is_stamped], ages)
        balls = balls._replace(arrivals=balls.arrivals - age)
    return make_log(str(path), angles, targets, balls)


def _read_messages(path: Path, topics: Topics) -> dict[str, list[tuple[float, Any]]]:
    """The messages of each topic, each with its time of arrival, s."""
    with needed("rosbags", "'bounce_mjx[identify]'"):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    wanted = dict(zip(topics.model_dump().values(), _TYPES, strict=True))
    found: dict[str, list[tuple[float, Any]]] = {topic: [] for topic in wanted}
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
            present = {c.topic: c.msgtype.rpartition("/")[2] for c in bag.connections}
            for topic, types in wanted.items():
                if present.get(topic) in types.split(" or "):
                    continue
                # An arm may have been recorded alone.
                if topic in present or topic != topics.ball:
                    listed = (f"{other} ({kind})" for other, kind in sorted(present.items()))
                    raise UserError(
                        f"the bag {path} has no topic {topic} of {types}; it has "
                        f"{', '.join(listed) or 'none'}: name the topics by --topics.joints, "
                        "--topics.targets and --topics.ball"
                    )
            connections = [c for c in bag.connections if c.topic in found]
            for connection, arrival, raw in bag.messages(connections):
                message = bag.deserialize(raw, connection.msgtype)
                found[connection.topic].append((1e-9 * arrival, message))
    except UserError:
        raise
    # rosbags raises exceptions of many types for a damaged file.
    except Exception as error:
        raise UserError(
            f"the bag {path} cannot be read ({shorten(reason_of(error))}); give the folder of a "
            "ROS 2 bag, or a file that ends with .mcap, .db3 or .bag; if its recorder was stopped, "
            "run ros2 bag reindex or mcap recover"
        ) from error
    return found


def _make_rows(
    name: str,
    messages: Sequence[tuple[float, Any]],
    size: int,
    read: Callable[[Any], Sequence[float]],
) -> Rows:
    """The measurements [size] of a topic; NaN where a message holds another number of them, or has
    no time stamp although others have one."""
    arrivals = np.array([arrival for arrival, _ in messages])
    times = np.zeros(len(messages))
    values = np.full((len(messages), size), np.nan)
    for i, (_, message) in enumerate(messages):
        if hasattr(message, "header"):
            times[i] = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        numbers = read(message)
        if len(numbers) == size:
            values[i] = numbers
    # Some programs stamp no message, or 0 before their clock has started.
    times = np.where(times == 0.0, np.nan, times) if np.any(times) else arrivals
    return Rows(
        name=name,
        place="message {}",
        numbers=1 + np.arange(len(times)),
        times=times,
        arrivals=arrivals,
        values=values,
    )


def _read_angles(message: Any, joint_names: Sequence[str]) -> Sequence[float]:
    """Angles in the robot's order; fewer if some are missing."""
    if hasattr(message, "data"):
        return message.data
    angles = dict(zip(message.name, message.position, strict=False))
    return [angles[joint] for joint in joint_names if joint in angles]


def _read_position(message: Any) -> Sequence[float]:
    """Position of the ball; NaN, as trackers publish it, if it was not seen."""
    point = message.point if hasattr(message, "point") else message.pose.position
    return [point.x, point.y, point.z]
