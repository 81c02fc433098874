"""From the ranges of the randomisation to an episode's world, and from that to its physics."""

import math
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.physics import PhysicsParameters
from bounce_mjx.physics.edited import INSEPARABLE, NO_PAIR, edits, own_parameters
from bounce_mjx.physics.scalars import Quaternion, quaternion_matrix, quaternion_product
from bounce_mjx.robot.contact import (
    damping_of_restitution,
    duration_of_stiffness,
    restitution_of_damping,
    stiffness_of_duration,
)
from bounce_mjx.robot.model import Addresses, contact_pairs
from bounce_mjx.robot.numbers import field_of
from bounce_mjx.world.randomization import MODEL, TERMS, Operation, Ranges, Term, World

# The fields that the terms of the contact change.
_CONTACT_FIELDS = {
    "restitution": ("pair_solref",),
    "contact_duration": ("pair_solref",),
    "contact_friction": ("pair_friction", "pair_dim"),
}


def check_contacts(mj_model: mujoco.MjModel, terms: Iterable[str], addresses: Addresses) -> None:
    """Refuses terms of the contact in a model whose contacts differ: such a term gives all of them
    one value, which is not each one's own in an episode that does not sample it.

    Raises:
      UserError: the contact pairs of the balls and the paddle differ in what one of the terms
        changes.
    """
    pairs = contact_pairs(mj_model, addresses)
    for term in terms:
        for field in _CONTACT_FIELDS.get(term, ()):
            numbers = getattr(mj_model, field)[pairs]
            if np.any(numbers != numbers[:1]):
                raise UserError(
                    f"the contact pairs of the balls and the paddle differ in {field}, of which "
                    f"randomization.{term} makes one for all; give them the same in the MJCF, or "
                    f"leave {term} out"
                )


def check_overlap(
    mj_model: mujoco.MjModel,
    addresses: Addresses,
    terms: Iterable[str],
    randomize: Callable[[jax.Array], PhysicsParameters],
) -> None:
    """Refuses a `randomize` whose parameters change what a term changes: the world would say one
    value, and the physics have the other.

    Args:
      mj_model: the model.
      addresses: of its parts.
      terms: names of the active terms.
      randomize: key -> parameters; it is traced, and computes nothing.

    Raises:
      UserError: a term and `randomize` change the same number of the model, or it returns something
        else than parameters.
    """
    randomized = jax.eval_shape(randomize, jax.random.PRNGKey(0))
    if not isinstance(randomized, PhysicsParameters):
        returned = "None" if randomized is None else f"a {type(randomized).__name__}"
        raise UserError(f"randomize returns {returned}; return a physics.PhysicsParameters")
    given = {name: value for name, value in randomized._asdict().items() if value is not None}
    places: dict[tuple[str, int], str] = {}
    for name in given:
        places |= dict.fromkeys(_places_of_parameter(mj_model, addresses, name), name)
    for name in given.get("entries", {}):
        places |= dict.fromkeys(_places_of_entry(mj_model, name), name)
    for term in terms:
        parameter = TERMS[term].parameter
        if parameter is None:
            continue
        shared = _places_of_parameter(mj_model, addresses, parameter) & places.keys()
        if parameter in given or shared:
            name = parameter if parameter in given else places[min(shared)]
            raise UserError(
                f"randomize returns {name}, which is sampled by randomization.{term} too, so that "
                "an episode's world would not be its physics; leave one of the two out"
            )


def _places_of_parameter(
    mj_model: mujoco.MjModel, addresses: Addresses, parameter: str
) -> set[tuple[str, int]]:
    """The numbers of the model that a field of `PhysicsParameters` changes."""
    places: set[tuple[str, int]] = set()
    for edit in edits(mj_model, addresses):
        if edit.parameter == parameter:
            places |= _places(mj_model, edit.field, edit.index)
    if parameter == "ball_inertia":
        for ball in addresses.balls:
            places |= _places(mj_model, "body_inertia", ball.body)
    return places


def _places_of_entry(mj_model: mujoco.MjModel, name: str) -> set[tuple[str, int]]:
    """The number of the model with a name of `PhysicsParameters.entries`; none of an unknown name,
    which the physics refuses."""
    field, _, index = name.removesuffix("]").partition("[")
    try:
        return _places(mj_model, field, tuple(int(number) for number in index.split(",")))
    except (AttributeError, ValueError, IndexError):
        return set()


def _places(mj_model: mujoco.MjModel, field: str, index: Any) -> set[tuple[str, int]]:
    """A field's numbers at an index, by their places in the flat field; of a field whose numbers
    change together, its rows."""
    values = field_of(mj_model, field)
    places = np.arange(values.size).reshape(values.shape)
    if field in INSEPARABLE:
        places = np.broadcast_to(np.arange(len(values))[:, None], values.shape)
    return {(field, place) for place in np.ravel(places[index]).tolist()}


def nominal_values(
    mj_model: mujoco.MjModel, terms: Iterable[str], addresses: Addresses | None = None
) -> dict[str, np.ndarray]:
    """Values without randomisation of the terms that have one, each of the term's shape.

    Of a term that replaces a number of the model, it is that number. A model without a contact pair
    has none for `restitution` and `contact_friction`; the first reset refuses these.

    Args:
      mj_model: the model.
      terms: names of the terms.
      addresses: of the model's parts, if they are known.
    """
    own = own_parameters(mj_model, addresses)
    num_joints = len(own.armature)
    nominals = {}
    for name in terms:
        term = TERMS[name]
        value = term.nominal
        if value == MODEL:
            value = _own_nominal(own, term)
        if value is not None:
            nominals[name] = np.broadcast_to(np.float64(value), term.shape(num_joints))
    return nominals


def _own_nominal(own: PhysicsParameters, term: Term) -> Any:
    """The model's own value of a term; None if the model lacks the parameter."""
    if term.operation not in ("restitution", "duration"):
        return getattr(own, term.parameter)
    if own.contact_damping is None:
        return None
    if term.operation == "duration":
        return duration_of_stiffness(own.contact_stiffness)
    return restitution_of_damping(own.contact_damping, own.contact_stiffness)


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
      share: probability [] that each term with a nominal value is sampled, all its entries at once.
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
    physical_terms = [name for name in TERMS if name in world and TERMS[name].parameter]
    if not physical_terms:
        return PhysicsParameters()
    own = own_parameters(mj_model)
    parameters = {}
    if "contact_duration" in world:
        own = _with_duration(own, world["contact_duration"])
        # Without a term of its own, it follows the stiffness.
        parameters["contact_damping"] = own.contact_damping
    for name in physical_terms:
        term = TERMS[name]
        parameters[term.parameter] = apply(term.operation, own, term.parameter, world[name])
    return PhysicsParameters(**parameters)


def _with_duration(own: PhysicsParameters, duration: jax.Array) -> PhysicsParameters:
    """The model's own parameters with a contact that lasts as long (s) and has the same damping
    ratio."""
    if own.contact_stiffness is None:
        raise UserError(NO_PAIR)
    stiffness = stiffness_of_duration(duration)
    faster = jnp.sqrt(stiffness / own.contact_stiffness)
    return own._replace(contact_stiffness=stiffness, contact_damping=own.contact_damping * faster)


def apply(
    operation: Operation, own: PhysicsParameters, parameter: str, sampled: jax.Array
) -> jax.Array:
    """A physical parameter of an episode.

    Args:
      operation: how the sampled value changes the model's own; with "restitution", the sampled
        value is a restitution and the parameter is the contact's damping.
      own: the model's own parameters.
      parameter: name of the field of `PhysicsParameters`.
      sampled: the term's value, of its shape.

    Raises:
      UserError: the term is a restitution, and the model has no contact pair of ball and paddle.
    """
    if operation == "duration":
        return stiffness_of_duration(sampled)
    if operation in ("replace", "limit"):
        # `physics.edited` keeps the model's own limit where that is lower.
        return sampled
    if operation == "restitution":
        if own.contact_stiffness is None:
            raise UserError(NO_PAIR)
        return damping_of_restitution(sampled, own.contact_stiffness)
    value = jnp.asarray(getattr(own, parameter), sampled.dtype)
    if operation == "scale":
        return value * sampled
    if operation == "add":
        return value + sampled
    if operation == "tilt_frame":
        return jnp.stack(quaternion_product(tuple(value), _rotation_xy(sampled)))
    assert operation == "tilt_vector"
    return jnp.stack(quaternion_matrix(_rotation_xy(sampled)) @ tuple(value))


def _rotation_xy(angles: jax.Array) -> Quaternion:
    """Quaternion [w, x, y, z] of a rotation about x by angles[0], then about the new y by
    angles[1]."""
    cosines = jnp.cos(0.5 * angles)
    sines = jnp.sin(0.5 * angles)
    cos_x, cos_y = cosines
    sin_x, sin_y = sines
    return cos_x * cos_y, sin_x * cos_y, cos_x * sin_y, sin_x * sin_y
