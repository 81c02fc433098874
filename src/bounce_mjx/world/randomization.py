"""Domain randomisation: each episode samples its own world.

`RandomizationConfig` is the table of the terms. A term's row says what it is (its comment, with the
unit), its shape, its bounds and its nominal value; and, if it is physical, the field of
`PhysicsParameters` that it changes, and the operation by which it does. `physics.edited.edits` is
the table of that field's entries in the model.

A term is a key of the config with a range (low, high), from which a reset samples every entry of
the term uniformly. Each end of a term of several entries may be one number for all, or one for each
entry. A term that is null is off and costs nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import pydantic
from pydantic import Field

from bounce_mjx.config.settings import Finite, StrictModel, UnitInterval, whole_number
from bounce_mjx.config.validation import unit_of
from bounce_mjx.errors import UserError, shorten
from bounce_mjx.lazy import jax, jnp, mujoco, np

if TYPE_CHECKING:
    from bounce_mjx.physics import PhysicsParameters
    from bounce_mjx.physics.scalars import Quaternion
    from bounce_mjx.robot.model import Addresses


def _entrywise(end: Any, number: Callable[[Any], float]) -> float | tuple[float, ...]:
    return tuple(map(number, end)) if isinstance(end, list | tuple) else number(end)


# Not a union of types, for which neither the command line nor an error has a short form.
_End = Annotated[
    Finite, pydantic.WrapValidator(_entrywise), pydantic.PlainSerializer(lambda end: end)
]
Range = tuple[_End, _End]
"""Lower and upper end, each a number, or a tuple with one number for each entry of the term. A
command line takes two numbers."""

Sampled = Range | None
"""A term's range; None for a term that is off."""

World = dict[str, "jax.Array"]
"""Values sampled for one episode, by the names of the active terms."""

Ranges = dict[str, tuple["jax.Array", "jax.Array"]]
"""Lower and upper ends of the active terms' ranges, each a number [] or an array of the term's
shape."""


class Operation(NamedTuple):
    """How a sampled value and the model's own parameters make a physical parameter."""

    apply: Callable[[PhysicsParameters, str, jax.Array], jax.Array]
    """(the model's own parameters, the parameter's name, sampled value) -> the parameter."""
    nominal: float | None = None
    """The sampled value that changes nothing, if it is the same for all models."""
    model_nominal: Callable[[PhysicsParameters, str], Any] | None = None
    """(the model's own parameters, the parameter's name) -> the sampled value that changes nothing,
    if it depends on the model; None for a model that lacks the parameter."""


def scale(model: PhysicsParameters, parameter: str, factor: jax.Array) -> jax.Array:
    """The model's own value times a factor."""
    return jnp.asarray(getattr(model, parameter), factor.dtype) * factor


def shift(model: PhysicsParameters, parameter: str, difference: jax.Array) -> jax.Array:
    """The model's own value plus a difference."""
    return jnp.asarray(getattr(model, parameter), difference.dtype) + difference


def replace(model: PhysicsParameters, parameter: str, value: jax.Array) -> jax.Array:
    """The sampled value itself."""
    return value


def tilt_frame(model: PhysicsParameters, parameter: str, angles: jax.Array) -> jax.Array:
    """The quaternion [4] of a frame that turns by angles [2] about its own x axis, then about its
    new y axis."""
    from bounce_mjx.physics.scalars import quaternion_product

    quaternion = jnp.asarray(getattr(model, parameter), angles.dtype)
    return jnp.stack(quaternion_product(tuple(quaternion), _rotation_xy(angles)))


def tilt_vector(model: PhysicsParameters, parameter: str, angles: jax.Array) -> jax.Array:
    """A vector [3] that turns by angles [2] about the x axis, then about the new y axis."""
    from bounce_mjx.physics.scalars import quaternion_matrix

    vector = jnp.asarray(getattr(model, parameter), angles.dtype)
    return jnp.stack(quaternion_matrix(_rotation_xy(angles)) @ tuple(vector))


def _rotation_xy(angles: jax.Array) -> Quaternion:
    """Quaternion [w, x, y, z] of a rotation about x by angles[0], then about the new y."""
    (cos_a, cos_b), (sin_a, sin_b) = jnp.cos(0.5 * angles), jnp.sin(0.5 * angles)
    return cos_a * cos_b, sin_a * cos_b, cos_a * sin_b, sin_a * sin_b


def restitution_to_damping(
    model: PhysicsParameters, parameter: str, restitution: jax.Array
) -> jax.Array:
    """The damping [] of the contact, 1/s, with a restitution [] at the model's own stiffness.

    Raises:
      UserError: the model has no contact pair of ball and paddle.
    """
    from bounce_mjx.physics.edited import NO_PAIR
    from bounce_mjx.robot.contact import damping_of_restitution

    if model.contact_stiffness is None:
        raise UserError(NO_PAIR)
    return damping_of_restitution(restitution, model.contact_stiffness)


def _model_restitution(model: PhysicsParameters, parameter: str) -> Any:
    """The restitution [] of the model's own contact; None without a contact pair."""
    from bounce_mjx.robot.contact import restitution_of_damping

    if model.contact_damping is None:
        return None
    return restitution_of_damping(model.contact_damping, model.contact_stiffness)


SCALE = Operation(scale, nominal=1.0)
ADD = Operation(shift, nominal=0.0)
TILT_FRAME = Operation(tilt_frame, nominal=0.0)
TILT_VECTOR = Operation(tilt_vector, nominal=0.0)
REPLACE = Operation(replace, model_nominal=getattr)
"""The nominal value is the model's own number, which `nominal_values` reads from the MjModel."""
RESTITUTION = Operation(restitution_to_damping, model_nominal=_model_restitution)
LIMIT = Operation(replace)
"""For a parameter that limits the model's own value, which may have no limit: no nominal value."""

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
    nominal: float | None = None
    """Value without randomisation, from which the range grows during the warm-up, if it is the same
    for all models; otherwise the operation's `model_nominal`. A term with neither is sampled in
    every episode, and its range does not grow."""
    parameter: str | None = None
    """The field of `PhysicsParameters` that it changes."""
    operation: Operation | None = None
    """How it changes that parameter."""

    @property
    def has_nominal(self) -> bool:
        """Whether it has a value without randomisation."""
        if self.nominal is not None:
            return True
        return self.operation is not None and self.operation.model_nominal is not None

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
    return Term(size, bounds, operation.nominal, parameter, operation)


# Wide, but narrower than the factor between a unit and a thousandth of it.
_FACTOR = (0.01, 200.0)


class RandomizationConfig(StrictModel):
    """The world that each episode samples: a range for each term, null for off. In a file, a term
    of several joints or axes may have a range for each: two lists, of lower and of upper ends."""

    restitution: Annotated[
        Sampled, physical("contact_damping", RESTITUTION, NUMBER, bounds=(0.4, 0.98))
    ] = None
    """Restitution of the ball on the paddle, in place of the model's, which is 0.85 for the
    project's own robot."""
    ball_mass: Annotated[Sampled, physical("ball_mass", SCALE, NUMBER, bounds=(0.01, 1e3))] = None
    """Factor of the ball's mass."""
    ball_radius: Annotated[Sampled, physical("ball_radius", SCALE, NUMBER, bounds=(0.1, 10.0))] = (
        None
    )
    """Factor of the ball's radius."""
    air_drag: Annotated[Sampled, Term(NUMBER, bounds=(0.0, 10.0), nominal=0.0)] = None
    """Deceleration of the ball by the air divided by its squared speed, 1/m; about 0.11 for a
    table-tennis ball."""
    contact_friction: Annotated[
        Sampled, physical("contact_friction", REPLACE, NUMBER, bounds=(0.0, 10.0))
    ] = None
    """Coefficient of sliding friction between ball and paddle, in place of the model's."""
    servo_gain: Annotated[Sampled, physical("servo_gain", SCALE, EACH_JOINT, bounds=_FACTOR)] = None
    """Factor of each servo's stiffness."""
    servo_damping: Annotated[
        Sampled, physical("servo_damping", SCALE, EACH_JOINT, bounds=_FACTOR)
    ] = None
    """Factor of each servo's damping."""
    servo_lag: Annotated[Sampled, Term(NUMBER, bounds=(0.0, 1.0), nominal=0.0)] = None
    """Time constant of a first-order lag of the servo targets, s."""
    servo_offset: Annotated[Sampled, Term(EACH_JOINT, bounds=(-0.5, 0.5), nominal=0.0)] = None
    """Constant error of each servo: where it holds its joint, less its target, rad."""
    torque_limit: Annotated[
        Sampled, physical("force_limit", LIMIT, EACH_JOINT, bounds=(0.01, 1e4))
    ] = None
    """Largest torque of each servo at its joint, N m; a servo that is weaker keeps its own
    limit."""
    joint_damping: Annotated[Sampled, physical("damping", ADD, EACH_JOINT, bounds=(0.0, 500.0))] = (
        None
    )
    """Viscous damping added to each joint, N m s/rad."""
    joint_frictionloss: Annotated[
        Sampled, physical("frictionloss", REPLACE, EACH_JOINT, bounds=(0.0, 500.0))
    ] = None
    """Dry friction of each joint, N m, in place of the model's."""
    armature: Annotated[Sampled, physical("armature", SCALE, EACH_JOINT, bounds=_FACTOR)] = None
    """Factor of each joint's rotor inertia."""
    link_mass: Annotated[Sampled, physical("link_mass", SCALE, EACH_JOINT, bounds=_FACTOR)] = None
    """Factor of each link's mass."""
    paddle_offset: Annotated[
        Sampled, physical("paddle_position", ADD, (3,), bounds=(-0.5, 0.5))
    ] = None
    """Displacement of the paddle along each axis of the last link, m."""
    paddle_tilt: Annotated[
        Sampled, physical("paddle_rotation", TILT_FRAME, (2,), bounds=(-0.5, 0.5))
    ] = None
    """Rotation of the paddle about its own x and y axis, rad."""
    gravity_tilt: Annotated[Sampled, physical("gravity", TILT_VECTOR, (2,), bounds=(-0.5, 0.5))] = (
        None
    )
    """Rotation of gravity about the world's x and y axis, rad."""
    action_latency: Annotated[Sampled, Term(NUMBER, bounds=(0.0, 1.0), nominal=0.0)] = None
    """Time from an action to its servo targets, s."""
    ball_latency: Annotated[Sampled, Term(NUMBER, bounds=(0.0, 1.0), nominal=0.0)] = None
    """Time from a camera picture of the ball to its use, s."""
    camera_rate: Annotated[Sampled, Term(NUMBER, bounds=(1.0, 1e4))] = None
    """Camera pictures of the ball per second, Hz; null for one at every control step."""
    frame_drop: Annotated[Sampled, Term(NUMBER, bounds=(0.0, 0.99), nominal=0.0)] = None
    """Probability that a camera picture is lost."""
    ball_position_noise: Annotated[Sampled, Term(NUMBER, bounds=(0.0, 0.5), nominal=0.0)] = None
    """Standard deviation of the noise of each measured ball coordinate, m."""
    ball_position_bias: Annotated[Sampled, Term((3,), bounds=(-0.5, 0.5), nominal=0.0)] = None
    """Error of each measured ball coordinate, constant in an episode, m."""
    ball_velocity_noise: Annotated[Sampled, Term(NUMBER, bounds=(0.0, 10.0), nominal=0.0)] = None
    """Standard deviation of the noise of each component of the measured ball velocity, m/s."""
    ball_velocity_bias: Annotated[Sampled, Term((3,), bounds=(-10.0, 10.0), nominal=0.0)] = None
    """Error of each component of the measured ball velocity, constant in an episode, m/s."""
    joint_angle_noise: Annotated[Sampled, Term(NUMBER, bounds=(0.0, 0.5), nominal=0.0)] = None
    """Standard deviation of the noise of each measured joint angle, rad."""
    encoder_bias: Annotated[Sampled, Term(EACH_JOINT, bounds=(-0.5, 0.5), nominal=0.0)] = None
    """Error of each encoder's zero, which the servo shares, rad."""
    joint_velocity_noise: Annotated[Sampled, Term(NUMBER, bounds=(0.0, 10.0), nominal=0.0)] = None
    """Standard deviation of the noise of each measured joint velocity, rad/s."""
    joint_velocity_bias: Annotated[Sampled, Term(EACH_JOINT, bounds=(-10.0, 10.0), nominal=0.0)] = (
        None
    )
    """Error of each measured joint velocity, constant in an episode, rad/s."""
    push_speed: Annotated[Sampled, Term(NUMBER, bounds=(0.0, 10.0), nominal=0.0)] = None
    """Horizontal speed that a push adds to the ball, in a random direction, m/s."""
    push_interval: Annotated[Sampled, Term(NUMBER, bounds=(0.05, 600.0))] = None
    """Time between two pushes, s; 2 s if only push_speed is given."""
    command_interval: Annotated[Sampled, Term(NUMBER, bounds=(0.05, 600.0))] = None
    """Time between two samples of the task's commands within an episode, s."""
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
    first_command_range: UnitInterval = 1.0
    """Range of the commands at the start of a training, around the middle of their whole range and
    as a share of it; it grows to the whole range over warmup_steps."""

    def __hash__(self) -> int:
        """Configs are keys of compiled programs; pydantic's own hash cannot take `shares`."""
        return hash(self.model_dump_json())

    @pydantic.model_validator(mode="after")
    def _check_effects(self):
        for name in sorted(self.shares or {}):
            self._check_share_of(name)
        varies = any(TERMS[name].has_nominal for name in self.terms)
        if self.warmup_steps and not varies and self.first_command_range == 1.0:
            raise ValueError(
                "warmup_steps is given without a term whose range grows; give both, or neither"
            )
        if self.share < 1.0 and not varies:
            raise ValueError("share is given without a term that it is of; give both, or neither")
        if self.push_interval and not self.push_speed:
            raise ValueError("push_interval is given without push_speed; give both")
        if self.first_command_range < 1.0 and not self.warmup_steps:
            raise ValueError("first_command_range is given without warmup_steps; give both")
        return self

    def _check_share_of(self, name: str) -> None:
        """Refuses a probability of a term that does not use it."""
        if name not in TERMS:
            reason = "which is not a term"
        elif getattr(self, name) is None:
            reason = "a term that is off"
        elif not TERMS[name].has_nominal:
            reason = "a term that is sampled in every episode"
        else:
            return
        raise ValueError(f"shares has a probability for {shorten(name)}, {reason}; remove it")

    @pydantic.model_validator(mode="after")
    def _check_ranges(self):
        for name in self.terms:
            self._check_shape(name)
            self._check_bounds(name)
        return self

    def _check_shape(self, name: str) -> None:
        """Refuses a range whose ends have another number of entries than the term, or than each
        other."""
        ends = getattr(self, name)
        size = TERMS[name].size
        counts = {len(end) if isinstance(end, tuple) else 0 for end in ends}
        fits_term = size is EACH_JOINT or counts <= {0, *size}
        if len(counts) == 1 and fits_term:
            return
        if size == NUMBER:
            lists = ""
        elif size is EACH_JOINT:
            lists = ", or two lists with one for each joint"
        else:
            lists = f", or two lists with one for each of {sum(size)} axes"
        raise ValueError(f"{name} {shorten(str(ends))} is not a range; give two numbers{lists}")

    def _check_bounds(self, name: str) -> None:
        """Refuses a range that is empty or not within the term's bounds."""
        least, greatest = TERMS[name].bounds
        unit = unit_of(type(self).model_fields[name].description)
        for low, high in entries(getattr(self, name)):
            if not least <= low <= high <= greatest:
                within = f"{least:g} to {greatest:g} {unit}".rstrip()
                raise ValueError(
                    f"{name} ({low}, {high}) is not a range within {within}; give the lower end "
                    "first"
                )

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
          progress: share of the warm-up that has passed [], from 0 to 1.
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


def nominal_values(
    mj_model: mujoco.MjModel, terms: Iterable[str], addresses: Addresses | None = None
) -> dict[str, np.ndarray]:
    """Values without randomisation of the terms that have one, each of the term's shape.

    Of a term that replaces a number of the model, it is that number; a model without a contact pair
    has none of the contact.

    Args:
      mj_model: the model.
      terms: names of the terms.
      addresses: of the model's parts, if they are known.
    """
    # The engines are not needed to read a config.
    from bounce_mjx.physics.edited import own_parameters

    model = own_parameters(mj_model, addresses)
    num_joints = len(model.armature)
    nominals = {}
    for name in terms:
        term = TERMS[name]
        value = term.nominal
        if value is None and term.has_nominal:
            value = term.operation.model_nominal(model, term.parameter)
        if value is not None:
            nominals[name] = np.broadcast_to(np.float64(value), term.shape(num_joints))
    return nominals


def sample_world(
    ranges: Ranges,
    key: jax.Array,
    dtype: jnp.dtype,
    num_joints: int,
    nominals: Mapping[str, Any] = MappingProxyType({}),
    share: float | jax.Array = 1.0,
    shares: Mapping[str, float] = MappingProxyType({}),
) -> World:
    """Samples the world of one episode; consumes the key.

    Args:
      ranges: of the active terms.
      key: consumed.
      dtype: of the values.
      num_joints: number of acting joints.
      nominals: `nominal_values`, which the terms have that are not sampled; a term without one is
        sampled in every episode.
      share: probability [] that each term is sampled.
      shares: probabilities of single terms, in place of `share`.
    """
    # The order of TERMS, because JAX sorts the keys of a traced dictionary.
    shapes = {name: TERMS[name].shape(num_joints) for name in TERMS if name in ranges}
    sizes = {name: math.prod(shape) for name, shape in shapes.items()}
    # One sample for all numbers, because splitting the key costs more than sampling.
    uniform = jax.random.uniform(key, (sum(sizes.values()) + len(sizes),), dtype)
    world = {}
    # The first numbers decide which terms are sampled.
    start = len(sizes)
    for i, (name, size) in enumerate(sizes.items()):
        low, high = ranges[name]
        places = uniform[start : start + size].reshape(shapes[name])
        value = jnp.asarray(low, dtype) + jnp.asarray(high - low, dtype) * places
        if name in nominals:
            is_sampled = uniform[i] < shares.get(name, share)
            value = jnp.where(is_sampled, value, jnp.asarray(nominals[name], dtype))
        world[name] = value
        start += size
    return world


def physics_parameters(world: World, mj_model: mujoco.MjModel) -> PhysicsParameters:
    """Parameters of the physics for a sampled world."""
    # The engines are not needed to read a config.
    from bounce_mjx.physics.edited import own_parameters
    from bounce_mjx.physics.parameters import PhysicsParameters

    terms = {name: term for name, term in TERMS.items() if name in world and term.parameter}
    if not terms:
        return PhysicsParameters()
    model = own_parameters(mj_model)
    parameters = {}
    for name, term in terms.items():
        parameters[term.parameter] = term.operation.apply(model, term.parameter, world[name])
    return PhysicsParameters(**parameters)
