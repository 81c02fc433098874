"""Domain randomisation: each episode samples its own world.

A term is a key of the config with a range (low, high), from which a reset samples every entry of
the term uniformly. Each end of a term of several entries may be one number for all, or one for each
entry. A term that is null is off and costs nothing.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import pydantic
from pydantic import Field

from bounce_mjx.config.settings import Finite, StrictModel, UnitInterval, whole_number
from bounce_mjx.config.validation import unit_of
from bounce_mjx.errors import shorten
from bounce_mjx.lazy import jax, jnp, mujoco, np

if TYPE_CHECKING:
    from bounce_mjx.physics import PhysicsParameters
    from bounce_mjx.physics.scalars import Quaternion


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


def tilt_frame(own: jax.Array, angles: jax.Array) -> jax.Array:
    """The quaternion of a frame that turns about its own x axis, then about its new y axis."""
    from bounce_mjx.physics.scalars import quaternion_product

    return jnp.stack(quaternion_product(tuple(own), _rotation_xy(angles)))


def tilt_vector(own: jax.Array, angles: jax.Array) -> jax.Array:
    """A vector that turns about the x axis, then about the new y axis."""
    from bounce_mjx.physics.scalars import quaternion_matrix

    return jnp.stack(quaternion_matrix(_rotation_xy(angles)) @ tuple(own))


def _rotation_xy(angles: jax.Array) -> Quaternion:
    """Quaternion [w, x, y, z] of a rotation about x by angles[0], then about the new y."""
    (cos_a, cos_b), (sin_a, sin_b) = jnp.cos(0.5 * angles), jnp.sin(0.5 * angles)
    return cos_a * cos_b, sin_a * cos_b, cos_a * sin_b, sin_a * sin_b


# The operations of terms, on the model's own value and the sampled one.
scale, shift = operator.mul, operator.add


def limit(own: jax.Array, most: jax.Array) -> jax.Array:
    return jnp.minimum(own, most)


def replace(_: Any, value: jax.Array) -> jax.Array:
    return value


class Term(NamedTuple):
    """A quantity that may differ between episodes: the metadata of its range."""

    size: tuple[int, ...] | None
    """Shape of one episode's sample; None for one entry for each acting joint."""
    nominal: float | None
    """Value without randomisation, from which the range grows during the warm-up; None for a range
    that does not grow."""
    bounds: tuple[float, float]
    """Smallest and largest sensible value."""
    parameter: str | None = None
    """The field of `PhysicsParameters` that it changes."""
    operation: Callable[[Any, Any], Any] | None = None
    """(the model's own value, sampled value) -> value of the parameter; None for a restitution."""

    def shape(self, num_joints: int) -> tuple[int, ...]:
        """Shape of one episode's sample for an arm with this number of acting joints."""
        return (num_joints,) if self.size is None else self.size


_FACTOR = (1e-3, 1e3)


class RandomizationConfig(StrictModel):
    """The world that each episode samples: a range for each term, null for off. In a file, a term
    of several joints or axes may have a range for each: two lists, of lower and of upper ends."""

    former = {"restitution_slope": None, "air_lift": None}

    restitution: Annotated[Sampled, Term((), 0.85, (0.6, 0.98), "contact_damping")] = None
    """Restitution of the ball on the paddle, 0.6 to 0.98; the model's is 0.85."""
    ball_mass: Annotated[Sampled, Term((), 1.0, _FACTOR, "ball_mass", scale)] = None
    """Factor of the ball's mass."""
    ball_radius: Annotated[Sampled, Term((), 1.0, (0.1, 10.0), "ball_radius", scale)] = None
    """Factor of the ball's radius."""
    air_drag: Annotated[Sampled, Term((), 0.0, (0.0, 10.0))] = None
    """Deceleration of the ball by the air divided by its squared speed, 1/m; about 0.11 for a
    table-tennis ball."""
    contact_friction: Annotated[
        Sampled, Term((), 0.0, (0.0, 10.0), "contact_friction", replace)
    ] = None
    """Coefficient of sliding friction between ball and paddle, in place of the model's."""
    servo_gain: Annotated[Sampled, Term(None, 1.0, _FACTOR, "servo_gain", scale)] = None
    """Factor of each servo's stiffness."""
    servo_damping: Annotated[Sampled, Term(None, 1.0, _FACTOR, "servo_damping", scale)] = None
    """Factor of each servo's damping."""
    servo_lag: Annotated[Sampled, Term((), 0.0, (0.0, 1.0))] = None
    """Time constant of a first-order lag of the servo targets, s."""
    servo_offset: Annotated[Sampled, Term(None, 0.0, (-0.5, 0.5))] = None
    """Constant error of each servo: where it holds its joint, less its target, rad."""
    torque_limit: Annotated[Sampled, Term(None, None, (1e-3, 1e5), "force_limit", limit)] = None
    """Largest torque of each servo, N m; a servo that is weaker keeps its own limit."""
    joint_damping: Annotated[Sampled, Term(None, 0.0, (0.0, 1e4), "damping", shift)] = None
    """Viscous damping added to each joint, N m s/rad."""
    joint_frictionloss: Annotated[Sampled, Term(None, 0.0, (0.0, 1e4), "frictionloss", replace)] = (
        None
    )
    """Dry friction of each joint, N m, in place of the model's."""
    armature: Annotated[Sampled, Term(None, 1.0, _FACTOR, "armature", scale)] = None
    """Factor of each joint's rotor inertia."""
    link_mass: Annotated[Sampled, Term(None, 1.0, _FACTOR, "link_mass", scale)] = None
    """Factor of each link's mass."""
    paddle_offset: Annotated[Sampled, Term((3,), 0.0, (-0.5, 0.5), "paddle_position", shift)] = None
    """Displacement of the paddle along each axis of the last link, m."""
    paddle_tilt: Annotated[Sampled, Term((2,), 0.0, (-1.0, 1.0), "paddle_rotation", tilt_frame)] = (
        None
    )
    """Rotation of the paddle about its own x and y axis, rad."""
    gravity_tilt: Annotated[Sampled, Term((2,), 0.0, (-1.0, 1.0), "gravity", tilt_vector)] = None
    """Rotation of gravity about the world's x and y axis, rad."""
    action_latency: Annotated[Sampled, Term((), 0.0, (0.0, 1.0))] = None
    """Time from an action to its servo targets, s."""
    ball_latency: Annotated[Sampled, Term((), 0.0, (0.0, 1.0))] = None
    """Time from a camera picture of the ball to its use, s."""
    camera_rate: Annotated[Sampled, Term((), None, (1.0, 1e4))] = None
    """Camera pictures of the ball per second, Hz; null for one at every control step."""
    frame_drop: Annotated[Sampled, Term((), 0.0, (0.0, 0.99))] = None
    """Probability that a camera picture is lost."""
    ball_position_noise: Annotated[Sampled, Term((), 0.0, (0.0, 0.5))] = None
    """Standard deviation of the noise of each measured ball coordinate, m."""
    ball_position_bias: Annotated[Sampled, Term((3,), 0.0, (-0.5, 0.5))] = None
    """Error of each measured ball coordinate, constant in an episode, m."""
    ball_velocity_noise: Annotated[Sampled, Term((), 0.0, (0.0, 10.0))] = None
    """Standard deviation of the noise of each component of the measured ball velocity, m/s."""
    ball_velocity_bias: Annotated[Sampled, Term((3,), 0.0, (-10.0, 10.0))] = None
    """Error of each component of the measured ball velocity, constant in an episode, m/s."""
    joint_angle_noise: Annotated[Sampled, Term((), 0.0, (0.0, 0.5))] = None
    """Standard deviation of the noise of each measured joint angle, rad."""
    encoder_bias: Annotated[Sampled, Term(None, 0.0, (-0.5, 0.5))] = None
    """Error of each encoder's zero, which the servo shares, rad."""
    joint_velocity_noise: Annotated[Sampled, Term((), 0.0, (0.0, 10.0))] = None
    """Standard deviation of the noise of each measured joint velocity, rad/s."""
    joint_velocity_bias: Annotated[Sampled, Term(None, 0.0, (-10.0, 10.0))] = None
    """Error of each measured joint velocity, constant in an episode, rad/s."""
    push_speed: Annotated[Sampled, Term((), 0.0, (0.0, 10.0))] = None
    """Horizontal speed that a push adds to the ball, in a random direction, m/s."""
    push_interval: Annotated[Sampled, Term((), None, (0.01, 600.0))] = None
    """Time between two pushes, s; 2 s if only push_speed is given."""
    command_interval: Annotated[Sampled, Term((), None, (0.01, 600.0))] = None
    """Time between two samples of the task's commands within an episode, s."""
    ball_start: Annotated[Sampled, Term((3,), 0.0, (-1.0, 1.0))] = None
    """Displacement of each coordinate of the ball at a reset, in addition to `env.reset`, m."""
    joint_start: Annotated[Sampled, Term(None, 0.0, (-3.0, 3.0))] = None
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
    def _check_ranges(self):
        for name in (self.shares or {}).keys() - TERMS.keys():
            raise ValueError(
                f"shares has a probability for {shorten(name)}, which is not a term; remove it"
            )
        if self.push_interval and not self.push_speed:
            raise ValueError("push_interval is given without push_speed; give both")
        if self.first_command_range < 1.0 and not self.warmup_steps:
            raise ValueError("first_command_range is given without warmup_steps; give both")
        for name in self.terms:
            ends, (size, _, (least, greatest), *_) = getattr(self, name), TERMS[name]
            unit = f" {unit_of(type(self).model_fields[name].description)}".rstrip()
            counts = {len(end) if isinstance(end, tuple) else 0 for end in ends}
            if len(counts) > 1 or (size is not None and not counts <= {0, *size}):
                each = "joint" if size is None else f"of {sum(size)} axes"
                lists = "" if size == () else f", or two lists with one for each {each}"
                raise ValueError(
                    f"{name} {shorten(str(ends))} is not a range; give two numbers{lists}"
                )
            for low, high in entries(ends):
                if not least <= low <= high <= greatest:
                    raise ValueError(
                        f"{name} ({low}, {high}) is not a range within {least:g} to "
                        f"{greatest:g}{unit}; give the lower end first"
                    )
        return self

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the active terms."""
        return tuple(name for name in TERMS if getattr(self, name) is not None)

    def ranges(self, progress: jax.Array | float = 1.0) -> Ranges:
        """Ranges of the active terms.

        Args:
          progress: share of the warm-up that has passed [], from 0 to 1.
        """

        ranges = {}
        for name in self.terms:
            ends, nominal = np.array(getattr(self, name)), TERMS[name].nominal
            start = ends if nominal is None else nominal
            ranges[name] = tuple(jnp.asarray(start + (ends - start) * progress, jnp.float32))
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


def sample_world(
    ranges: Ranges,
    key: jax.Array,
    dtype: jnp.dtype,
    num_joints: int,
    share: float | jax.Array = 1.0,
    shares: Mapping[str, float] = MappingProxyType({}),
) -> World:
    """Samples the world of one episode; consumes the key.

    Args:
      num_joints: number of acting joints.
      share: probability [] that each term with a nominal value is sampled.
      shares: probabilities of single terms, in place of `share`.
    """
    # The order of TERMS, because JAX sorts the keys of a traced dictionary.
    shapes = {name: TERMS[name].shape(num_joints) for name in TERMS if name in ranges}
    sizes = {name: math.prod(shape) for name, shape in shapes.items()}
    # One sample for all numbers, because splitting the key costs more than sampling.
    uniform = jax.random.uniform(key, (sum(sizes.values()) + len(sizes),), dtype)
    world, start = {}, len(sizes)
    for i, (name, size) in enumerate(sizes.items()):
        term, (low, high) = TERMS[name], ranges[name]
        places = uniform[start : start + size].reshape(shapes[name])
        value = jnp.asarray(low, dtype) + jnp.asarray(high - low, dtype) * places
        if term.nominal is not None:
            is_sampled = uniform[i] < shares.get(name, share)
            value = jnp.where(is_sampled, value, jnp.asarray(term.nominal, dtype))
        world[name] = value
        start += size
    return world


def physics_parameters(world: World, mj_model: mujoco.MjModel) -> PhysicsParameters:
    """Parameters of the physics for a sampled world."""
    # The engines are not needed to read a config.
    from bounce_mjx.physics.edited import direct_solref, own_parameters
    from bounce_mjx.physics.parameters import PhysicsParameters

    terms = {name: term for name, term in TERMS.items() if name in world and term.parameter}
    if not terms:
        return PhysicsParameters()
    own, given = own_parameters(mj_model), {}
    for name, (*_, parameter, operation) in terms.items():
        value, own_value = world[name], getattr(own, parameter)
        if operation is None:
            given[parameter] = contact_damping(value, direct_solref(mj_model)[0])
        else:
            if own_value is not None:
                own_value = jnp.asarray(own_value, value.dtype)
            given[parameter] = operation(own_value, value)
    return PhysicsParameters(**given)


# Damping ratios of the contact, and the measured restitution: the mean of the drops on the held
# paddle of tests/test_randomization.py, at 1, 2, 3 and 4 m/s and eight phases of the physics step.
_DROPS = (
    (0.0, 0.993), (0.005, 0.98), (0.01, 0.965), (0.0152, 0.95), (0.032, 0.90), (0.05, 0.85),
    (0.0697, 0.80), (0.0921, 0.75), (0.116, 0.70), (0.13, 0.674), (0.16, 0.622), (0.2, 0.565),
    (0.2455, 0.50), (0.2873, 0.45), (0.3352, 0.40),
)  # fmt: skip


def contact_damping(restitution: jax.Array, stiffness: float) -> jax.Array:
    """Damping [] of the contact, 1/s, that gives a restitution [] at a contact stiffness (1/s^2):
    2 zeta sqrt(stiffness), with the damping ratio zeta interpolated between drop tests."""
    ratio, e = np.array(_DROPS[::-1]).T
    zeta = jnp.interp(restitution, e, ratio)
    return (2.0 * np.sqrt(stiffness) * zeta).astype(jnp.asarray(restitution).dtype)
