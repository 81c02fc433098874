"""Metadata of an exported policy, stored in the ONNX file's `metadata_props`.

Every entry is JSON under the name of its field in `Metadata`.
"""

import json
import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

FORMAT = 5
"""Version of the entries; readers refuse other versions."""

UNITS = {
    "joint_angles": "rad",
    "joint_velocities": "rad/s",
    "ball_position": "m",
    "ball_velocity": "m/s",
    "ball_age": "s",
    "ball_quaternion": "w, x, y, z",
    "ball_angular_velocity": "rad/s",
    "time": "s",
    "joint_targets": "rad",
    "tool_position": "m",
    "tool_normal": "unit vector",
}
"""Measurements that every policy accepts, and their units. A task's goals are further ones."""

PER_BALL = {
    "ball_position": 3,
    "ball_velocity": 3,
    "ball_quaternion": 4,
    "ball_angular_velocity": 3,
}
"""Measurements of each ball, and their numbers of entries for one."""

MEASURED_PER_JOINT = ("joint_angles", "joint_velocities", "joint_targets")
"""Measurements with an entry for each joint."""

Vector = tuple[float, float, float]

# Names in the graph of a policy whose task remembers measurements.
IS_FIRST = "step/is_first"
"""The input that is true in the first step."""
NEWEST = "measured/"
"""What precedes the name of a quantity's newest value, an input."""
NEXT = "next/"
"""What precedes the name of an output for the input of the same name in the next step."""


# Fields with a number for each joint, and randomisation terms of which `name[i]` is that of one.
_PER_JOINT = (
    "largest_step",
    "joint_ranges",
    "servo_stiffness",
    "servo_damping",
    "torque_limits",
    "default_joint_angles",
    "joint_damping",
    "sag",
)
TERMS_PER_JOINT = frozenset(
    "servo_gain servo_damping servo_offset torque_limit joint_damping joint_frictionloss armature "
    "link_mass encoder_bias joint_velocity_bias joint_start".split()
)
"""Randomisation terms with a number for each joint (`RandomizationConfig`)."""


class Input(NamedTuple):
    """One input of the network."""

    name: str
    """Name of the quantity; `past_actions` are the network's outputs in the last steps."""
    history: int
    """Number of values, the newest first."""
    size: int
    """Number of entries of one value."""
    unit: str
    """Unit of the entries; empty for a pure number."""


class Hinge(NamedTuple):
    """A hinge between the world and the paddle, in the frame of the previous hinge."""

    joint: int
    """Index of its joint."""
    position: Vector
    """A point on the axis, m."""
    quaternion: tuple[float, float, float, float]
    """Orientation at the angle `reference`: always 1, 0, 0, 0, as every frame then has the axes of
    the world."""
    axis: Vector
    """Unit vector along the axis."""
    reference: float
    """Joint angle of the unturned hinge, rad."""


class GoalRange(NamedTuple):
    """A goal, which is a measurement for the policy."""

    range: tuple[float, float]
    """Its range in the training."""
    unit: str
    """Unit; empty for a pure number."""


class CommandLimits(NamedTuple):
    """The arm's limits of each joint's command."""

    velocity: tuple[float, ...]
    """rad/s."""
    acceleration: tuple[float, ...]
    """rad/s^2."""
    jerk: tuple[float, ...] | None
    """rad/s^3; None for no limit."""


class BallBounds(NamedTuple):
    """Bounds of a ball that the policy can have seen in its training."""

    distance: float
    """Largest distance from the origin of the robot's frame, m."""
    speed: float
    """Largest measured speed, m/s."""


class Metadata(NamedTuple):
    """All information needed to act with the network."""

    format: int
    task: str
    """Name of the task that the policy was trained in."""
    steps: int
    """Number of environment steps in the training."""
    robot: str
    """Name of the arm, as its MJCF file states it."""
    joint_names: tuple[str, ...]
    """Order of the joints in every array of J joints."""
    num_balls: int
    """Number of balls, each of which is measured."""
    ball: BallBounds
    """Bounds of each ball."""
    observation: tuple[Input, ...]
    """The inputs of the network, each [N, history, size]."""
    velocity: Literal["measured", "differences"]
    """Source of ball_velocity: `measured`, or `differences` of the measured positions."""
    control_dt: float
    """Time between two actions, s."""
    action: str
    """Meaning of the output [N, J], in words."""
    action_base: Literal["measured", "target"]
    """What an action adds to: the measured angle, or the last servo target."""
    action_scale: float
    """Change of the servo target at the action 1, rad."""
    max_lead: float | None
    """Largest distance from the measured angle to the last servo target, rad; None if an action
    adds to the measured angle."""
    largest_step: tuple[float, ...]
    """Largest change of each joint's command from one control step to the next, rad."""
    max_joint_velocity: float
    """Speed of a joint at which the training ends an episode, rad/s."""
    limits: CommandLimits | None
    """Limits of the commands, which then move between two actions (`robot.setpoints`); None for a
    servo target that jumps."""
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
    start_noise: float
    """Largest distance of a joint from them at the start of an episode, rad."""
    goals: dict[str, GoalRange]
    """The goals of the policy, by name."""
    randomization: dict[str, tuple[float, float]]
    """Ranges of the training's domain randomisation by the keys of `env.randomization`, which
    documents their units; `paddle_tilt[0]` is the range of one axis alone, and `servo_gain[2]` that
    of the joint `joint_names[2]`. Missing terms were not randomised."""
    chain: tuple[Hinge, ...]
    """The hinges from the world to the paddle."""
    paddle: Vector
    """Centre of the paddle in the frame of the last hinge, m."""
    paddle_normal: Vector
    """Unit normal of the paddle's upper face in the frame of the last hinge."""
    environment: dict[str, Any]
    """Settings of the environment of the training, the `env` of its config."""
    joint_damping: tuple[float, ...]
    """Torque of each joint's own damping per velocity, N m s/rad, which adds to the servo's."""
    sag: tuple[float, ...]
    """How far the arm's weight takes each joint off its command in the start pose, rad."""
    ball_rests: bool
    """Whether the ball may rest on the paddle."""
    ball_thrown: bool
    """Whether the ball is thrown at the arm, and does not start over the paddle."""


def measurement_sizes(metadata: Metadata) -> dict[str, int]:
    """Number of entries of each measurement, in the order of `UNITS`, and of each goal; of
    several balls, one after another."""
    joints = dict.fromkeys(MEASURED_PER_JOINT, len(metadata.joint_names))
    balls = {name: size * metadata.num_balls for name, size in PER_BALL.items()}
    sizes = joints | balls | {"tool_position": 3, "tool_normal": 3}
    return {name: sizes.get(name, 1) for name in (*UNITS, *metadata.goals)}


def joint_ends(metadata: Metadata) -> np.ndarray:
    """Lower and upper ends [2, J] of the joints' ranges, rad; infinite for a joint without one."""
    everywhere = (-math.inf, math.inf)
    ranges = [everywhere if ends is None else ends for ends in metadata.joint_ranges]
    return np.array(ranges).T


def largest_term(metadata: Metadata, term: str, default: float = 0.0) -> float:
    """Largest absolute value of a randomisation term over axes and joints."""
    ranges = _ranges_of(metadata, term)
    return max((max(abs(low), abs(high)) for low, high in ranges), default=default)


def least_term(metadata: Metadata, term: str, default: float) -> float:
    """Lowest end of a randomisation term over axes and joints."""
    return min((low for low, _ in _ranges_of(metadata, term)), default=default)


def _ranges_of(metadata: Metadata, term: str) -> list[tuple[float, float]]:
    """The ranges of a randomisation term, of each axis or joint."""
    ranges = metadata.randomization.items()
    return [ends for name, ends in ranges if name.split("[")[0] == term]


def to_entries(metadata: Metadata) -> dict[str, str]:
    """JSON texts of the metadata by field name."""
    return {name: json.dumps(x, allow_nan=False) for name, x in _plain(metadata).items()}


def from_entries(entries: dict[str, str]) -> Metadata:
    """Metadata from the entries of `to_entries`; ValueError for another format."""
    # A file of another format lacks entries too, but the format is the reason.
    if "format" in entries:
        file_format = json.loads(entries["format"])
        if file_format != FORMAT:
            raise ValueError(f"its format is {file_format}, not {FORMAT}; export the policy again")
    missing = [name for name in Metadata._fields if name not in entries]
    if missing:
        raise ValueError(f"its metadata lacks {missing[0]}; export the policy again")
    values = {name: _with_tuples(json.loads(entries[name])) for name in Metadata._fields}
    limits = values["limits"]
    goals = values["goals"]
    groups = {
        "ball": BallBounds(**values["ball"]),
        "observation": tuple(Input(**part) for part in values["observation"]),
        "limits": None if limits is None else CommandLimits(**limits),
        "goals": {name: GoalRange(**goal) for name, goal in goals.items()},
        "chain": tuple(Hinge(**hinge) for hinge in values["chain"]),
    }
    return Metadata(**values | groups)


def in_driver_order(metadata: Metadata, names: Sequence[str], order: Sequence[int]) -> Metadata:
    """The metadata with the joints in a driver's order.

    Args:
      names: the driver's names of the joints [J], in its order.
      order: index of each of them among the policy's joints [J].
    """

    def ordered(values: Sequence[Any]) -> tuple[Any, ...]:
        return tuple(values[i] for i in order)

    limits = metadata.limits
    if limits is not None:
        limits = CommandLimits._make(None if x is None else ordered(x) for x in limits)
    per_joint = {name: ordered(getattr(metadata, name)) for name in _PER_JOINT}
    chain = tuple(link._replace(joint=list(order).index(link.joint)) for link in metadata.chain)
    return metadata._replace(
        joint_names=tuple(names),
        limits=limits,
        chain=chain,
        randomization=_terms_in_order(metadata.randomization, order),
        **per_joint,
    )


def _terms_in_order(
    ranges: dict[str, tuple[float, float]], order: Sequence[int]
) -> dict[str, tuple[float, float]]:
    """The ranges of the randomisation, of which `name[i]` is that of the joint `order[i]`."""
    ordered = {}
    for name, ends in ranges.items():
        term, bracket, rest = name.partition("[")
        if bracket and term in TERMS_PER_JOINT:
            place = list(order).index(int(rest.removesuffix("]")))
            name = f"{term}[{place}]"
        ordered[name] = ends
    return ordered


def _plain(value: Any) -> Any:
    """A value with groups in place of named tuples."""
    if hasattr(value, "_asdict"):
        return {name: _plain(inner) for name, inner in value._asdict().items()}
    if isinstance(value, dict):
        return {name: _plain(inner) for name, inner in value.items()}
    return [_plain(inner) for inner in value] if isinstance(value, tuple) else value


def _with_tuples(value: Any) -> Any:
    """A value from JSON with tuples in place of lists."""
    if isinstance(value, dict):
        return {name: _with_tuples(inner) for name, inner in value.items()}
    return tuple(map(_with_tuples, value)) if isinstance(value, list) else value
