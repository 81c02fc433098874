"""Logs in ROS bags and MCAP files, read by `rosbags` (the extra `identify`)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bounce_mjx.errors import UserError, needed, reason_of, shorten
from bounce_mjx.identify.log import Log, Rows, make_log

# Time by which stamps and arrivals differ, s, beyond which they are of two clocks.
_TWO_CLOCKS = 1.0
_BALL = "pictures of the ball"


class Topics(NamedTuple):
    """Topics of a bag."""

    joints: str
    """sensor_msgs/JointState with the measured joint angles."""
    targets: str
    """sensor_msgs/JointState with the servo targets, or std_msgs/Float64MultiArray with those of
    all joints in the robot's order."""
    ball: str
    """geometry_msgs/PointStamped or PoseStamped with the ball's position."""


class _Message(NamedTuple):
    number: int
    """Place in its topic, from 1."""
    time: float
    """The header's stamp, s; 0 without one."""
    arrival: float
    """The bag's time, s."""
    frame: str
    values: np.ndarray | None
    """The measurement; None if it holds none."""
    why: str
    """Why it holds none."""


def is_bag(path: Path) -> bool:
    """Whether a log is a ROS bag: a folder, or a file of one of their types."""
    return path.is_dir() or path.suffix.lower() in (".mcap", ".db3", ".bag", ".zstd")


def read_bag(path: Path, joint_names: Sequence[str], topics: Topics) -> Log:
    """Reads a bag. Times are the header's stamps, or the bag's where a topic has none. Messages
    that hold no measurement are left out and counted.

    Raises:
      MissingPackage: rosbags is missing.
      UserError: the bag cannot be read, lacks a topic, no message of a topic fits, the ball's are
        in two frames, or as `make_log`.
    """
    found = _messages(path, joint_names, topics)
    notes: list[str] = []
    names = ("joint angles", "servo targets", _BALL)
    angles, targets, balls = (
        _rows(path, topic, f"{name} of {topic}", found[topic], size, notes)
        for topic, name, size in zip(
            topics, names, (len(joint_names), len(joint_names), 3), strict=True
        )
    )
    frames = sorted({m.frame for m in found[topics.ball] if m.values is not None})
    if len(frames) > 1:
        named = ", ".join(shorten(frame) or "none" for frame in frames)
        raise UserError(
            f"the messages of {topics.ball} in {path} are in the frames {named}; record the ball "
            "in one, that of the robot's base"
        )
    if any(word in frame for frame in frames for word in ("camera", "optical")):
        notes.append(
            f"the messages of {topics.ball} in {path} are in the frame {shorten(frames[0])}; the "
            "ball's position must be in that of the robot's base, with z up"
        )
    if len(angles.times) > 1 and abs(np.median(angles.arrivals - angles.times)) > _TWO_CLOCKS:
        # Such as simulated time: pictures arrived when the angles of the same moment did.
        arrivals = np.interp(balls.arrivals, angles.arrivals, angles.times)
        balls = balls._replace(arrivals=arrivals)
    return make_log(str(path), angles, targets, balls, notes)


def _messages(path: Path, joint_names: Sequence[str], topics: Topics) -> dict[str, list[_Message]]:
    """The messages of each topic."""
    with needed("rosbags", "'bounce_mjx[identify]'"):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    found: dict[str, list[_Message]] = {topic: [] for topic in topics}
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
            present = {connection.topic for connection in bag.connections}
            for topic in (topics.joints, topics.targets):
                if topic not in present:
                    raise UserError(
                        f"the bag {path} has no topic {topic}; it has "
                        f"{', '.join(sorted(present)) or 'none'}: name the topics by "
                        "--topics.joints, --topics.targets and --topics.ball"
                    )
            wanted = [c for c in bag.connections if c.topic in found]
            for connection, arrival, raw in bag.messages(connections=wanted):
                message = bag.deserialize(raw, connection.msgtype)
                of_topic = found[connection.topic]
                number = len(of_topic) + 1
                place = f"message {number} of {connection.topic} in {path}"
                if connection.topic == topics.ball:
                    values, why = _position(message, place), ""
                else:
                    values, why = _joints(message, joint_names)
                if values is not None and not np.all(np.isfinite(values)):
                    values, why = None, f"holds {values}"
                header = getattr(message, "header", None)
                stamp = getattr(header, "stamp", None)
                time = 0.0 if stamp is None else stamp.sec + 1e-9 * stamp.nanosec
                frame = getattr(header, "frame_id", "")
                of_topic.append(_Message(number, time, 1e-9 * arrival, frame, values, why))
    except UserError:
        raise
    # rosbags raises exceptions of many types for a damaged file.
    except Exception as error:
        raise UserError(
            f"the bag {path} cannot be read ({shorten(reason_of(error))}); {_hint(path)}"
        ) from error
    return found


def _hint(path: Path) -> str:
    """What to do about a bag that cannot be read."""
    files = [*path.glob("*.mcap"), *path.glob("*.db3")] if path.is_dir() else []
    if files and not (path / "metadata.yaml").exists():
        return (
            f"its recorder was stopped before it wrote metadata.yaml: give the file {files[0]}, or "
            f"write it by ros2 bag reindex {path}"
        )
    if path.suffix == ".mcap":
        return f"if its recorder was stopped before the end, mend it by mcap recover {path}"
    if path.suffix in (".zstd", ".zst"):
        return f"unpack it by zstd -d {path}"
    if path.suffix.lower() in (".mcap", ".db3", ".bag") and path.suffix != path.suffix.lower():
        return f"rename it to end with {path.suffix.lower()}"
    return "give the folder of a ROS 2 bag, an .mcap, .db3 or .bag file, or a CSV file"


def _rows(
    path: Path, topic: str, name: str, messages: Sequence[_Message], size: int, notes: list[str]
) -> Rows:
    """The messages with a measurement; the others are counted in `notes`."""
    if stamped := bool(messages) and np.median([m.time for m in messages]) > 0.0:
        # Drivers that start before the clock, of a simulation say, stamp 0.
        messages = [
            m if m.time else m._replace(values=None, why="has no time stamp") for m in messages
        ]
    good = [m for m in messages if m.values is not None]
    if len(good) < len(messages):
        first = next(m for m in messages if m.values is None)
        said = f"message {first.number} of {topic} in {path} {first.why}"
        # An arm may have been recorded alone, with a tracker that saw no ball.
        if not good and not name.startswith(_BALL):
            raise UserError(said)
        notes.append(
            f"{len(messages) - len(good)} of the {len(messages)} {name} do not count: {said}"
        )
    numbers, stamps, arrivals = (np.array([m[i] for m in good]) for i in range(3))
    times = stamps if stamped else arrivals
    values = np.array([m.values for m in good], float).reshape(-1, size)
    return Rows(name, "message {}", numbers, times, arrivals, values)


def _joints(message: Any, joint_names: Sequence[str]) -> tuple[np.ndarray | None, str]:
    """Angles [n] in the robot's order, or why there are none."""
    if hasattr(message, "position"):
        given = dict(zip(message.name, message.position, strict=False))
        missing = [joint for joint in joint_names if joint not in given]
        if not missing:
            return np.array([given[joint] for joint in joint_names], float), ""
        return None, (
            f"has positions of the joints {', '.join(map(shorten, list(given)[:20])) or 'none'}, "
            f"and {missing[0]} is missing; give a message with all joints, the log's robot with "
            "--robot, or the driver's names with --joint-names"
        )
    if hasattr(message, "data") and np.size(message.data) == len(joint_names):
        return np.array(message.data, float), ""
    return None, (
        f"is neither a JointState nor an array of {len(joint_names)} numbers; name another topic"
    )


def _position(message: Any, place: str) -> np.ndarray:
    """Position [3]; NaN, as trackers publish it, if the ball was not seen."""
    point = getattr(message, "point", None)
    if point is None:
        point = getattr(getattr(message, "pose", None), "position", None)
    if point is None:
        raise UserError(
            f"{place} is neither a PointStamped nor a PoseStamped; name another topic by "
            "--topics.ball"
        )
    return np.array([point.x, point.y, point.z], float)
