"""Metadata of an exported policy, stored in the ONNX file's `metadata_props`.

Every entry is JSON under the name of its field in `Metadata`.
"""

import json
import math
from typing import Any, NamedTuple

from bounce_mjx.task.ball_filter import Constants

FORMAT = 2
"""Version of the entries; readers refuse other versions."""


class Part(NamedTuple):
    """One input of the network."""

    name: str
    """Name of the quantity; `past_actions` are the network's outputs in the last steps."""
    history: int
    """Number of values, the newest first."""
    size: int
    """Number of entries of one value."""
    unit: str
    """Unit of the entries; empty for a pure number."""


class Link(NamedTuple):
    """A hinge between the world and the paddle, in the frame of the previous hinge."""

    joint: int
    """Index of its joint."""
    position: tuple[float, float, float]
    """A point on the axis, m."""
    quaternion: tuple[float, float, float, float]
    """Orientation at the angle `reference`, in the order w, x, y, z."""
    axis: tuple[float, float, float]
    """Unit vector along the axis."""
    reference: float
    """Joint angle of the unturned hinge, rad."""


class Metadata(NamedTuple):
    """All information needed to act with the network."""

    format: int
    steps: int
    """Number of environment steps in the training."""
    joint_names: tuple[str, ...]
    """Order of the joints in every array of J joints."""
    observation: tuple[Part, ...]
    """The inputs of the network, each [N, history, size]."""
    position: str
    """Source of ball_position: `measured`, or `filter` for the estimate of the Kalman filter."""
    velocity: str
    """Source of ball_velocity: `measured`, `differences` of the measured positions, or `filter`."""
    estimator: dict[str, Any] | None
    """Constants of the Kalman filter by the names in `ball_filter.Constants`; None without one."""
    control_dt: float
    """Time between two actions, s."""
    action: str
    """Meaning of the output [N, J], in words."""
    action_scale: float
    """Change of the servo target at the action 1, rad."""
    joint_ranges: tuple[tuple[float, float] | None, ...]
    """Range of each servo target, rad; None for a joint without one."""
    servo_stiffness: tuple[float, ...]
    """Torque of each servo per position error, N m/rad."""
    servo_damping: tuple[float, ...]
    """Torque of each servo per joint velocity, N m s/rad."""
    torque_limits: tuple[float | None, ...]
    """Largest torque of each servo, N m; None for a servo without a limit."""
    default_joint_angles: tuple[float, ...]
    """Joint angles at the start of an episode, rad."""
    target_height_range: tuple[float, float]
    """Range of target heights in the training, m."""
    randomization: dict[str, tuple[float, float]]
    """Ranges of the training's domain randomisation by the keys of `env.randomization`, which
    documents their units; missing terms were not randomised."""
    bounce_max_distance: float
    """Largest height above the paddle at which the ball counts as near it, m."""
    chain: tuple[Link, ...]
    """The hinges from the world to the paddle."""
    paddle: tuple[float, float, float]
    """Centre of the paddle in the frame of the last hinge, m."""
    paddle_normal: tuple[float, float, float]
    """Unit normal of the paddle's upper face in the frame of the last hinge."""


def to_entries(metadata: Metadata) -> dict[str, str]:
    """JSON texts of the metadata by field name."""
    plain = metadata._asdict() | {
        "observation": [part._asdict() for part in metadata.observation],
        "chain": [link._asdict() for link in metadata.chain],
    }
    return {name: json.dumps(value, allow_nan=False) for name, value in plain.items()}


def from_entries(entries: dict[str, str]) -> Metadata:
    """Metadata from the entries of `to_entries`; ValueError for anything else."""
    missing = [name for name in Metadata._fields if name not in entries]
    # A file of another format lacks entries too, but the format is the reason.
    if "format" in entries and (given := json.loads(entries["format"])) != FORMAT:
        raise ValueError(f"its format is {given}, not {FORMAT}")
    # An entry of older versions.
    if json.loads(entries.get("memory_size", "0")):
        raise ValueError("its network has a memory, which this version does not run")
    if missing:
        raise ValueError(f"its metadata lacks {missing[0]}")
    plain = {name: json.loads(entries[name]) for name in Metadata._fields}
    try:
        plain["observation"] = tuple(Part(**part) for part in plain["observation"])
        plain["chain"] = tuple(Link(**link) for link in plain["chain"])
        metadata = Metadata(**plain)
        if metadata.estimator is not None:
            Constants(**metadata.estimator)
        _check(metadata)
    except (TypeError, AttributeError, IndexError) as error:
        raise ValueError(f"its metadata is malformed: {error}") from error
    return metadata


def _check(metadata: Metadata) -> None:
    count = len(metadata.joint_names)
    numbers: list[Any] = [metadata.control_dt, metadata.action_scale, *metadata.paddle]
    numbers += metadata.paddle_normal
    numbers += [n for link in metadata.chain for n in (*link.position, *link.quaternion)]
    if not all(math.isfinite(number) for number in numbers) or not metadata.control_dt > 0.0:
        raise ValueError("its metadata holds a number that is not finite or not positive")
    if len(metadata.joint_ranges) != count or any(n.joint >= count for n in metadata.chain):
        raise ValueError(f"its metadata is not of {count} joints")
