"""Logs in ROS 2 bags and MCAP files, read by `rosbags` (the extra `identify`)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bounce_mjx.errors import UserError, needed, reason_of, shorten
from bounce_mjx.identify.log import Log


class Topics(NamedTuple):
    """Topics of a bag."""

    joints: str
    """sensor_msgs/JointState with the measured joint angles."""
    targets: str
    """sensor_msgs/JointState with the servo targets, or std_msgs/Float64MultiArray with those of
    all joints in the robot's order."""
    ball: str
    """geometry_msgs/PointStamped or PoseStamped with the ball's position."""


def is_bag(path: Path) -> bool:
    """Whether a log is a ROS bag: a folder, an MCAP file or a SQLite database."""
    return path.is_dir() or path.suffix in (".mcap", ".db3")


def read_bag(path: Path, joint_names: Sequence[str], topics: Topics) -> Log:
    """Reads a bag. Times are the header's stamps, or the bag's where a message has none.

    Raises:
      MissingPackage: rosbags is missing.
      UserError: the bag cannot be read, lacks a topic, or a message does not fit.
    """
    with needed("rosbags", "'bounce_mjx[identify]'"):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    found: dict[str, list[tuple[float, float, np.ndarray]]] = {topic: [] for topic in topics}
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
            for connection, stamp, raw in bag.messages(connections=wanted):
                message = bag.deserialize(raw, connection.msgtype)
                arrival, topic = 1e-9 * stamp, connection.topic
                if topic == topics.ball:
                    values = _position(message, path, topic, len(found[topic]))
                else:
                    values = _joints(message, joint_names, path, topic, len(found[topic]))
                if values is not None:
                    found[topic].append((_time(message, arrival), arrival, values))
    except UserError:
        raise
    # rosbags raises exceptions of many types for a damaged file.
    except Exception as error:
        raise UserError(
            f"the bag {path} cannot be read ({shorten(reason_of(error))}); give the folder of a "
            "ROS 2 bag, an .mcap file or a CSV file"
        ) from error
    (times, _, angles), (target_times, _, targets), (stamps, arrivals, balls) = (
        _columns(found[topic], size)
        for topic, size in zip(topics, (len(joint_names), len(joint_names), 3), strict=True)
    )
    return Log(str(path), times, angles, target_times, targets, stamps, balls, arrivals)


def _columns(
    rows: Sequence[tuple[float, float, np.ndarray]], size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    times, arrivals = (np.array([row[i] for row in rows], float) for i in (0, 1))
    return times, arrivals, np.array([row[2] for row in rows], float).reshape(-1, size)


def _time(message: Any, arrival: float) -> float:
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    time = 0.0 if stamp is None else stamp.sec + 1e-9 * stamp.nanosec
    return time or arrival


def _joints(
    message: Any, joint_names: Sequence[str], path: Path, topic: str, number: int
) -> np.ndarray | None:
    """Angles [n] in the robot's order; None for a message of other joints alone."""
    if hasattr(message, "position"):
        given = dict(zip(message.name, message.position, strict=False))
        missing = [joint for joint in joint_names if joint not in given]
        if len(missing) == len(joint_names) and number:
            return None
        if missing:
            raise UserError(
                f"message {number + 1} of {topic} in {path} has the joints "
                f"{', '.join(map(shorten, message.name[:20])) or 'none'}, and {missing[0]} is "
                "missing; give a message with all joints, or the log's robot with --robot"
            )
        values = np.array([given[joint] for joint in joint_names], float)
    elif hasattr(message, "data") and np.size(message.data) == len(joint_names):
        values = np.array(message.data, float)
    else:
        raise UserError(
            f"message {number + 1} of {topic} in {path} is neither a JointState nor an array of "
            f"{len(joint_names)} numbers; name another topic"
        )
    return _finite(values, path, topic, number)


def _position(message: Any, path: Path, topic: str, number: int) -> np.ndarray | None:
    """Position [3]; None if the ball was not seen."""
    point = getattr(message, "point", None)
    if point is None:
        point = getattr(getattr(message, "pose", None), "position", None)
    if point is None:
        raise UserError(
            f"message {number + 1} of {topic} in {path} is neither a PointStamped nor a "
            "PoseStamped; name another topic by --topics.ball"
        )
    position = np.array([point.x, point.y, point.z], float)
    # Trackers publish NaN for a ball that they do not see.
    return position if np.all(np.isfinite(position)) else None


def _finite(values: np.ndarray, path: Path, topic: str, number: int) -> np.ndarray:
    if not np.all(np.isfinite(values)):
        raise UserError(
            f"message {number + 1} of {topic} in {path} holds {values}; give finite numbers"
        )
    return values
