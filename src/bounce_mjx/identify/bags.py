"""Logs in ROS bags and MCAP files, read by `rosbags` (the extra `identify`)."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bounce_mjx.errors import UserError, needed, reason_of, shorten
from bounce_mjx.identify.log import Log, Rows, make_log

# Time by which stamps and arrivals differ, s, beyond which they are of two clocks.
_TWO_CLOCKS = 1.0
# What to do about a bag that cannot be read, by its ending; a folder has none.
_REMEDIES = {
    "": "if it has no metadata.yaml, as its recorder was stopped, run ros2 bag reindex {}, or give "
    "the file in it",
    ".mcap": "if its recorder was stopped before the end, run mcap recover {}",
    ".zstd": "unpack it by zstd -d {}",
}


class Topics(NamedTuple):
    """Topics of a bag."""

    joints: str
    """sensor_msgs/JointState with the measured joint angles."""
    targets: str
    """sensor_msgs/JointState with the servo targets, or std_msgs/Float64MultiArray with those of
    all joints in the robot's order."""
    ball: str
    """geometry_msgs/PointStamped or PoseStamped with the ball's position."""


_TYPES = Topics("JointState", "JointState or Float64MultiArray", "PointStamped or PoseStamped")


def is_bag(path: Path) -> bool:
    """Whether a log is a ROS bag: a folder, or a file of one of their types."""
    return path.is_dir() or path.suffix.lower() in (".mcap", ".db3", ".bag", ".zstd")


def read_bag(path: Path, joint_names: Sequence[str], topics: Topics) -> Log:
    """Reads a bag. Times are the header's stamps, or the bag's where a topic has none. Messages
    that hold no measurement are left out and counted.

    Raises:
      MissingPackage: rosbags is missing.
      UserError: the bag cannot be read, a topic is missing or of another type, the ball is in two
        frames, or as `make_log`.
    """
    found, num_joints = _messages(path, topics), len(joint_names)
    angles, targets = (
        _rows(f"{name} of {topic}", found[topic], num_joints, lambda m: _angles(m, joint_names))
        for name, topic in (("joint angles", topics.joints), ("servo targets", topics.targets))
    )
    balls = _rows(f"pictures of the ball of {topics.ball}", found[topics.ball], 3, _position)
    seen = zip(found[topics.ball], balls.faults, strict=True)
    frames = sorted({message.header.frame_id for (_, message), fault in seen if not fault})
    notes: list[str] = []
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


def _messages(path: Path, topics: Topics) -> dict[str, list[tuple[float, Any]]]:
    """The messages of each topic, each with its time of arrival, s."""
    with needed("rosbags", "'bounce_mjx[identify]'"):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    found: dict[str, list[tuple[float, Any]]] = {topic: [] for topic in topics}
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
            present = {c.topic: c.msgtype.rpartition("/")[2] for c in bag.connections}
            for topic, types in zip(topics, _TYPES, strict=True):
                if present.get(topic) in types.split(" or "):
                    continue
                # An arm may have been recorded alone.
                if topic in present or topic != topics.ball:
                    listed = (f"{name} ({kind})" for name, kind in sorted(present.items()))
                    raise UserError(
                        f"the bag {path} has no topic {topic} of {types}; it has "
                        f"{', '.join(listed) or 'none'}: name the topics by --topics.joints, "
                        "--topics.targets and --topics.ball"
                    )
            wanted = [c for c in bag.connections if c.topic in found]
            for connection, arrival, raw in bag.messages(connections=wanted):
                message = bag.deserialize(raw, connection.msgtype)
                found[connection.topic].append((1e-9 * arrival, message))
    except UserError:
        raise
    # rosbags raises exceptions of many types for a damaged file.
    except Exception as error:
        remedy = _REMEDIES.get(
            path.suffix,
            "give the folder of a ROS 2 bag, or a file that ends with .mcap, .db3, .bag or .csv",
        )
        raise UserError(
            f"the bag {path} cannot be read ({shorten(reason_of(error))}); {remedy.format(path)}"
        ) from error
    return found


def _rows(
    name: str,
    messages: Sequence[tuple[float, Any]],
    size: int,
    measured: Callable[[Any], tuple[Any, str]],
) -> Rows:
    """The measurements [size] of a topic, or why a message holds none."""
    arrivals, times = np.array([arrival for arrival, _ in messages]), np.zeros(len(messages))
    values, faults = np.full((len(messages), size), np.nan), []
    for i, (_, message) in enumerate(messages):
        if hasattr(message, "header"):
            times[i] = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        given, fault = measured(message)
        if not fault:
            values[i] = given
            fault = "" if np.all(np.isfinite(values[i])) else f"holds {values[i]}"
        faults.append(fault)
    # Drivers that start before the clock, of a simulation say, stamp 0.
    if np.any(times) and np.median(times) > 0.0:
        why = np.where(times == 0.0, "has no time stamp", faults)
    else:
        times, why = arrivals, np.array(faults, str)
    return Rows(name, "message {}", 1 + np.arange(len(why)), times, arrivals, values, why)


def _angles(message: Any, joint_names: Sequence[str]) -> tuple[Any, str]:
    """Angles in the robot's order, or why there are none."""
    if hasattr(message, "data"):
        wrong = len(message.data) != len(joint_names)
        fault = f"has {len(message.data)} numbers for {len(joint_names)} joints" if wrong else ""
        return message.data, fault
    given = dict(zip(message.name, message.position, strict=False))
    missing = [joint for joint in joint_names if joint not in given]
    if not missing:
        return [given[joint] for joint in joint_names], ""
    return None, (
        f"has positions of the joints {', '.join(map(shorten, list(given)[:20])) or 'none'}, "
        f"and {missing[0]} is missing; give a message with all joints, the log's robot with "
        "--robot, or the driver's names with --joint-names"
    )


def _position(message: Any) -> tuple[Any, str]:
    """Position of the ball; NaN, as trackers publish it, if it was not seen."""
    point = message.point if hasattr(message, "point") else message.pose.position
    return [point.x, point.y, point.z], ""
