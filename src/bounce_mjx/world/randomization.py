"""Domain randomisation: each episode samples its own world.

`RandomizationConfig` is the table of the terms. A term's row says what it is, its shape, its bounds
and its nominal value. Of a physical term (`physical`) it says the field of `PhysicsParameters` that
changes, and the operation by which it does, which also gives the nominal value;
`physics.edited.edits` is the table of that field's entries in the model. The other terms act in
`actuation.py`, `sensing.py` and `env.py`. `sampling.py` samples. Errors and pages show a row's
comment, whose unit, if it has one, stands after a comma and before a full stop or a semicolon.

A term is a key of the config with a range (low, high), from which a reset samples every entry of
the term uniformly. Of a term of several entries, both ends may be one number for all, or both one
for each entry. A term that is null is off and costs nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Annotated, Any, Literal, NamedTuple

import pydantic
from pydantic import Field

from bounce_mjx.config.settings import Finite, StrictModel, UnitInterval, as_given, whole_number
from bounce_mjx.config.validation import unit_of
from bounce_mjx.errors import shorten
from bounce_mjx.lazy import jax, jnp, np


def _entrywise(end: Any, number: Callable[[Any], float]) -> float | tuple[float, ...]:
    """An end of a range: one number, or a tuple of them; `number` validates each."""
    return tuple(map(number, end)) if isinstance(end, list | tuple) else number(end)


# Its type is that of a number, although `_entrywise` takes lists too: a command line and an error
# name the type, and of a union they would name each member.
_End = Annotated[
    Finite, pydantic.WrapValidator(_entrywise), pydantic.PlainSerializer(lambda end: end)
]
Range = tuple[_End, _End]
"""Lower and upper end, each a number, or a tuple with one number for each entry of the term. A
command line takes two numbers."""

Sampled = Range | None
"""The range from which a term is sampled; None for a term that is off."""

World = dict[str, "jax.Array"]
"""Values sampled for one episode, by the names of the active terms."""

Ranges = dict[str, tuple["jax.Array", "jax.Array"]]
"""Lower and upper ends of the active terms' ranges, each a number [] or an array of the term's
shape."""


Operation = Literal[
    "scale", "add", "tilt_frame", "tilt_vector", "replace", "restitution", "duration", "limit"
]
"""How a sampled value and the model's own parameter make the episode's parameter
(`sampling.apply`): the parameter times the value, plus the value, turned by two angles (a frame or
a vector), the value in its place, the damping that has the value as its restitution, the stiffness
with which a contact lasts as long, or the value as a limit that never raises the model's own
limit."""

MODEL = "model"
"""Nominal value that is the model's own."""

NOMINALS: dict[Operation, float | Literal["model"] | None] = {
    "scale": 1.0,
    "add": 0.0,
    "tilt_frame": 0.0,
    "tilt_vector": 0.0,
    "replace": MODEL,
    "restitution": MODEL,
    "duration": MODEL,
    "limit": None,
}
"""The sampled value that changes nothing, by the operation; None where no number does that, as the
model may have no limit."""

NUMBER = ()
"""Size of a term with one number."""
EACH_JOINT = None
"""Size of a term with one number for each acting joint."""


class Term(NamedTuple):
    """A quantity that may differ between episodes: the metadata of its range."""

    size: tuple[int, ...] | None
    """Shape of one episode's sample; None (`EACH_JOINT`) for one entry for each acting joint."""
    bounds: tuple[float, float]
    """Smallest and largest sensible value."""
    nominal: float | Literal["model"] | None = None
    """Value without randomisation, from which the range grows during the warm-up; `MODEL` for the
    model's own. A term without one is sampled in every episode, and its range does not grow."""
    parameter: str | None = None
    """The field of `PhysicsParameters` that it changes; no two terms share one."""
    operation: Operation | None = None
    """How it changes that parameter."""

    @property
    def has_nominal(self) -> bool:
        """Whether it has a value without randomisation."""
        return self.nominal is not None

    def shape(self, num_joints: int) -> tuple[int, ...]:
        """Shape of one episode's sample for an arm with this number of acting joints."""
        return (num_joints,) if self.size is None else self.size


def physical(
    parameter: str,
    operation: Operation,
    size: tuple[int, ...] | None,
    bounds: tuple[float, float],
) -> Term:
    """A term that changes a field of `PhysicsParameters`.

    Args:
      parameter: the field.
      operation: how the sampled value changes it.
      size: of one sample, as `Term.size`.
      bounds: smallest and largest sensible value.
    """
    return Term(size, bounds, NOMINALS[operation], parameter, operation)


# Wide, but narrower than the factor between a unit and a thousandth of it.
_FACTOR = (0.01, 200.0)


class RandomizationConfig(StrictModel):
    """The world that each episode samples: a range for each term, null for off. In a file, a term
    of several joints or axes may have a range for each: two lists, of lower and of upper ends."""

    restitution: Annotated[
        Sampled, physical("contact_damping", "restitution", NUMBER, bounds=(0.4, 0.98))
    ] = None
    """Restitution of the ball on the paddle, in place of the model's, which is 0.85 for the
    project's own robot."""
    contact_duration: Annotated[
        Sampled, physical("contact_stiffness", "duration", NUMBER, bounds=(1e-4, 0.015))
    ] = None
    """Half a period of the contact's spring, which is how long a bounce lasts, in place of the
    model's, which is 10 ms for the project's own robot, s; a real ball's is 1 ms or less. At least
    four physics steps, with which the restitution of a single bounce is up to 0.1 off, by its phase
    within a step; with ten up to 0.03."""
    ball_mass: Annotated[Sampled, physical("ball_mass", "scale", NUMBER, bounds=(0.01, 1e3))] = None
    """Factor of the ball's mass."""
    ball_radius: Annotated[
        Sampled, physical("ball_radius", "scale", NUMBER, bounds=(0.1, 10.0))
    ] = None
    """Factor of the ball's radius."""
    ball_inertia: Annotated[
        Sampled, physical("ball_inertia", "replace", NUMBER, bounds=(0.1, 0.67))
    ] = None
    """Moment of inertia of the ball per mass and squared radius, in place of the config's: 0.4 of a
    solid ball, 0.667 of a hollow one."""
    air_drag: Annotated[Sampled, Term(NUMBER, bounds=(0.0, 10.0), nominal=0.0)] = None
    """Deceleration of the ball by the air divided by its squared speed, 1/m; about 0.11 for a
    table-tennis ball."""
    contact_friction: Annotated[
        Sampled, physical("contact_friction", "replace", NUMBER, bounds=(0.0, 10.0))
    ] = None
    """Coefficient of sliding friction between ball and paddle, in place of the model's; a dry
    rubber grips at 0.5 and more, smooth wood slides at 0.2."""
    servo_gain: Annotated[Sampled, physical("servo_gain", "scale", EACH_JOINT, bounds=_FACTOR)] = (
        None
    )
    """Factor of each servo's stiffness."""
    servo_damping: Annotated[
        Sampled, physical("servo_damping", "scale", EACH_JOINT, bounds=_FACTOR)
    ] = None
    """Factor of each servo's damping."""
    servo_lag: Annotated[Sampled, Term(NUMBER, bounds=(0.0, 1.0), nominal=0.0)] = None
    """Time constant of a first-order lag of the servo targets, s."""
    servo_offset: Annotated[Sampled, Term(EACH_JOINT, bounds=(-0.3, 0.3), nominal=0.0)] = None
    """Constant error of each servo: where it holds its joint, less its target, rad."""
    torque_limit: Annotated[
        Sampled, physical("force_limit", "limit", EACH_JOINT, bounds=(0.01, 1e4))
    ] = None
    """Largest torque of each servo at its joint, N m; a servo that is weaker keeps its own
    limit."""
    joint_damping: Annotated[
        Sampled, physical("damping", "add", EACH_JOINT, bounds=(0.0, 500.0))
    ] = None
    """Viscous damping added to each joint, N m s/rad."""
    joint_frictionloss: Annotated[
        Sampled, physical("frictionloss", "replace", EACH_JOINT, bounds=(0.0, 500.0))
    ] = None
    """Dry friction of each joint in place of the model's, N m."""
    armature: Annotated[Sampled, physical("armature", "scale", EACH_JOINT, bounds=_FACTOR)] = None
    """Factor of each joint's rotor inertia."""
    link_mass: Annotated[
        Sampled, physical("link_mass", "scale", EACH_JOINT, bounds=(0.01, 50.0))
    ] = None
    """Factor of each link's mass."""
    paddle_offset: Annotated[
        Sampled, physical("paddle_position", "add", (3,), bounds=(-0.3, 0.3))
    ] = None
    """Displacement of the paddle along each axis of its body, m."""
    paddle_tilt: Annotated[
        Sampled, physical("paddle_rotation", "tilt_frame", (2,), bounds=(-0.5, 0.5))
    ] = None
    """Rotation of the paddle about its own x and y axis, rad."""
    gravity_tilt: Annotated[
        Sampled, physical("gravity", "tilt_vector", (2,), bounds=(-0.5, 0.5))
    ] = None
    """Rotation of gravity about the world's x and y axis, rad."""
    action_latency: Annotated[Sampled, Term(NUMBER, bounds=(0.0, 1.0), nominal=0.0)] = None
    """Time from an action to its servo targets, s."""
    ball_latency: Annotated[Sampled, Term(NUMBER, bounds=(0.0, 1.0), nominal=0.0)] = None
    """Time from a camera picture of the ball to its use, s."""
    camera_rate: Annotated[Sampled, Term(NUMBER, bounds=(1.0, 1e4))] = None
    """Camera pictures of the ball per second, Hz; null for one at every control step. Of several
    pictures in a control step only the newest counts; if it is lost, so are the others."""
    frame_drop: Annotated[Sampled, Term(NUMBER, bounds=(0.0, 0.99), nominal=0.0)] = None
    """Probability that a camera picture is lost."""
    ball_position_noise: Annotated[Sampled, Term(NUMBER, bounds=(0.0, 0.2), nominal=0.0)] = None
    """Standard deviation of the noise of each measured ball coordinate, m."""
    ball_position_bias: Annotated[Sampled, Term((3,), bounds=(-0.3, 0.3), nominal=0.0)] = None
    """Error of each measured ball coordinate, constant in an episode, m."""
    ball_velocity_noise: Annotated[Sampled, Term(NUMBER, bounds=(0.0, 10.0), nominal=0.0)] = None
    """Standard deviation of the noise of each component of the measured ball velocity, m/s; not
    of a velocity from differences."""
    ball_velocity_bias: Annotated[Sampled, Term((3,), bounds=(-10.0, 10.0), nominal=0.0)] = None
    """Error of each component of the measured ball velocity, constant in an episode, m/s; not of a
    velocity from differences."""
    joint_angle_noise: Annotated[Sampled, Term(NUMBER, bounds=(0.0, 0.05), nominal=0.0)] = None
    """Standard deviation of the noise of each measured joint angle, rad."""
    encoder_bias: Annotated[Sampled, Term(EACH_JOINT, bounds=(-0.3, 0.3), nominal=0.0)] = None
    """Error of each encoder's zero, which the servo shares, rad."""
    joint_velocity_noise: Annotated[Sampled, Term(NUMBER, bounds=(0.0, 2.0), nominal=0.0)] = None
    """Standard deviation of the noise of each measured joint velocity, rad/s."""
    joint_velocity_bias: Annotated[Sampled, Term(EACH_JOINT, bounds=(-2.0, 2.0), nominal=0.0)] = (
        None
    )
    """Error of each measured joint velocity, constant in an episode, rad/s."""
    push_speed: Annotated[Sampled, Term(NUMBER, bounds=(0.0, 10.0), nominal=0.0)] = None
    """Horizontal speed that a push adds to the ball, in a random direction, m/s."""
    push_interval: Annotated[Sampled, Term(NUMBER, bounds=(0.05, 600.0))] = None
    """Time between two pushes, s; 2 s if only push_speed is given."""
    goal_interval: Annotated[Sampled, Term(NUMBER, bounds=(0.05, 600.0))] = None
    """Time between two samples of the task's goals within an episode, s."""
    ball_start: Annotated[Sampled, Term((3,), bounds=(-1.0, 1.0), nominal=0.0)] = None
    """Displacement of each coordinate of the ball at a reset, in addition to `env.reset`, m."""
    joint_start: Annotated[Sampled, Term(EACH_JOINT, bounds=(-3.0, 3.0), nominal=0.0)] = None
    """Displacement of each joint angle at a reset, in addition to `env.reset`, rad."""
    share: UnitInterval = 1.0
    """Probability that a term with a nominal value is sampled in an episode; otherwise it has that
    value."""
    shares: dict[str, UnitInterval] | None = None
    """Probabilities of single terms, by name, in place of `share`."""
    warmup_steps: Annotated[int, pydantic.BeforeValidator(whole_number), Field(ge=0)] = 0
    """Environment steps over which the ranges grow from the nominal values."""
    first_goal_range: UnitInterval = 1.0
    """Range of the goals at the start of a training, around the middle of their whole range and
    as a share of it; it grows to the whole range over warmup_steps."""

    def __hash__(self) -> int:
        """Configs are keys of compiled programs; pydantic's own hash cannot take `shares`."""
        return hash(self.model_dump_json())

    @pydantic.model_validator(mode="after")
    def _check_effects(self):
        """A setting that has no effect is a mistake."""
        for name in sorted(self.shares or {}):
            self._check_share_of(name)
        varies = any(TERMS[name].has_nominal for name in self.terms)
        if self.warmup_steps and not varies and self.first_goal_range == 1.0:
            raise ValueError(
                "warmup_steps is given without a term whose range grows; give both, or neither"
            )
        if self.share < 1.0 and not varies:
            raise ValueError("share is given without a term that it is of; give both, or neither")
        if self.push_interval and not self.push_speed:
            raise ValueError("push_interval is given without push_speed; give both")
        if self.first_goal_range < 1.0 and not self.warmup_steps:
            raise ValueError("first_goal_range is given without warmup_steps; give both")
        return self

    def _check_share_of(self, name: str) -> None:
        """Refuses a probability of a term that has none."""
        if name not in TERMS:
            reason = "which is not a term"
        elif getattr(self, name) is None:
            reason = "a term that is off"
        elif not TERMS[name].has_nominal:
            reason = "a term that is sampled in every episode"
        else:
            return
        raise ValueError(f"shares has a probability for {shorten(name)}, {reason}; remove it")

    @pydantic.field_validator("*", mode="before")
    @classmethod
    def _check_ends(cls, ends: Any, info: pydantic.ValidationInfo) -> Any:
        """A range is two ends, and not one value; that of each joint is two lists, and not a list
        of as many ranges."""
        is_pair = isinstance(ends, list | tuple) and len(ends) == 2
        if info.field_name in TERMS and ends is not None and not is_pair:
            raise ValueError(_is_no_range(info.field_name, ends))
        return ends

    @pydantic.model_validator(mode="after")
    def _check_ranges(self):
        """Each range has the shape and the bounds of its term."""
        for name in self.terms:
            self._check_shape(name)
            check_bounds(name, getattr(self, name))
        return self

    def _check_shape(self, name: str) -> None:
        """Refuses a range whose ends have another number of entries than the term, or than each
        other."""
        ends = getattr(self, name)
        size = TERMS[name].size
        shapes = {(len(end),) if isinstance(end, tuple) else NUMBER for end in ends}
        fits_term = size is EACH_JOINT or shapes <= {NUMBER, size}
        if len(shapes) != 1 or not fits_term or (0,) in shapes:
            raise ValueError(f"{name} {_is_no_range(name, ends)}")

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the active terms."""
        return tuple(name for name in TERMS if getattr(self, name) is not None)

    def ranges(
        self,
        progress: jax.Array | float = 1.0,
        nominals: Mapping[str, Any] = MappingProxyType({}),
    ) -> Ranges:
        """Ranges of the active terms.

        Args:
          progress: share of the warm-up that has passed [], from 0 to 1
            (`env.vector.ranges_after`).
          nominals: `nominal_values` of the terms, from which their ranges grow; a range without one
            does not grow.
        """
        ranges = {}
        for name in self.terms:
            ends = tuple(np.array(end) for end in getattr(self, name))
            if name in nominals:
                start = nominals[name]
                ends = tuple(start + (end - start) * progress for end in ends)
            ranges[name] = tuple(jnp.asarray(end, jnp.float32) for end in ends)
        return ranges


def check_bounds(name: str, ends: Range, nominal: np.ndarray | None = None) -> None:
    """Refuses a range that is empty or not within its term's bounds.

    Args:
      name: of the term.
      ends: of its range.
      nominal: its value without randomisation, from which a range may grow, so that it is within
        the bounds too; None leaves it out.

    Raises:
      ValueError: the range is none of the term.
    """
    least, greatest = TERMS[name].bounds
    if nominal is not None:
        least = min(least, float(np.min(nominal)))
        greatest = max(greatest, float(np.max(nominal)))
    unit = unit_of(RandomizationConfig.model_fields[name].description)
    for low, high in entries(ends):
        if not least <= low <= high <= greatest:
            within = f"{least:g} to {greatest:g} {unit}".rstrip()
            raise ValueError(
                f"{name} ({low}, {high}) is not a range within {within}; give the lower end first"
            )


def _is_no_range(name: str, ends: Any) -> str:
    """What is wrong with the ends of a term's range, and what to give, in words."""
    size = TERMS[name].size
    if size == NUMBER:
        lists = ""
    elif size is EACH_JOINT:
        lists = ", or two lists with one for each joint"
    else:
        (num_axes,) = size
        lists = f", or two lists with one for each of {num_axes} axes"
    return f"{as_given(ends)} is not a range; give two numbers{lists}"


def entries(ends: Range) -> list[tuple[float, float]]:
    """The range of each entry; a single one if the ends are numbers."""
    return list(zip(*ends, strict=True)) if isinstance(ends[0], tuple) else [ends]


TERMS: dict[str, Term] = {
    name: mark
    for name, field in RandomizationConfig.model_fields.items()
    for mark in field.metadata
    if isinstance(mark, Term)
}
"""All terms of `RandomizationConfig`."""
