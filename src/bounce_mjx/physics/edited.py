"""A physical parameter is an edit of a MuJoCo model.

`edits` is the table of the parameters' entries in the model's fields, and `EditedModel` the model
with new numbers in some entries. The C engine and MJX get its fields; the fused engine reads it in
place of the compiled model, so that an edited number is an input of the program, and each other one
a constant that folds.
"""

import copy
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.physics.parameters import Array, PhysicsParameters
from bounce_mjx.physics.scalars import Scalar, Vec, add, maximum, minimum, mul
from bounce_mjx.robot.actuators import force_ranges, torque_ranges
from bounce_mjx.robot.arm import raise_solver_limits
from bounce_mjx.robot.contact import stiffness_and_damping
from bounce_mjx.robot.model import (
    Addresses,
    BallAddresses,
    contact_pairs,
    find_addresses,
    link_bodies,
)
from bounce_mjx.robot.numbers import field_of

NO_PAIR = (
    "the MJCF has no contact pair of the ball and the paddle, which contact_stiffness, "
    "contact_damping and contact_friction change; add <pair> to <contact>"
)


INSEPARABLE = ("pair_solref",)
"""Fields in whose rows one number tells the meaning of another: they change together
(`adapters.randomization` varies such a row as a whole)."""


class Edit(NamedTuple):
    """The entries of a model's field that hold a parameter."""

    parameter: str
    """Name in `PhysicsParameters`."""
    field: str
    """Name in `MjModel`; of one in its options, with `opt.`."""
    index: Any
    """Index of the entries in the field."""
    scale: Any = 1.0
    """Value of the entries, or of each, per value of the parameter."""
    number: Any = None
    """Which of the parameter's numbers each entry has; by default, each its own, or all the only
    one."""
    least: Any = None
    """The model's own value of each entry, below which a parameter that is a limit does not go."""
    greatest: Any = None
    """The model's own value of each entry, above which a parameter that is a limit does not go."""


class Entry(NamedTuple):
    """One number of a model."""

    field: str
    """Name in `MjModel`; of one in its options, with `opt.`."""
    place: int
    """Index in the flat field."""


class EditedModel:
    """A compiled model with new numbers in some entries.

    `model["dof_damping", 2]` is a number, `model["geom_pos", 3]` a vector of numbers: Python
    floats, or scalars where they were edited.
    """

    def __init__(self, mj_model: mujoco.MjModel, addresses: Addresses):
        self.mj_model = mj_model
        self.addresses = addresses
        self._edited: dict[Entry, Scalar] = {}
        self._derived: dict[Entry, Scalar] = {}

    @property
    def fields(self) -> set[str]:
        """Names of the fields in which entries are edited or follow from edited ones."""
        return {entry.field for entry in self._derived | self._edited}

    def __getitem__(self, key: tuple) -> Any:
        """A number, or a vector of numbers, at a field's name and an index."""
        field, *index = key
        model_values = field_of(self.mj_model, field)
        new_values = self._derived | self._edited
        numbers = []
        for entry in _entries_at(model_values, field, tuple(index)):
            numbers.append(new_values.get(entry, model_values.flat[entry.place].item()))
        return Vec(numbers) if np.ndim(model_values[tuple(index)]) else numbers[0]

    def put(self, field: str, index: Any, values: Iterable[Scalar]) -> None:
        """Edits entries."""
        entries = _entries_at(field_of(self.mj_model, field), field, index)
        self._edited |= zip(entries, values, strict=True)

    def follow(self, field: str, index: Any, values: Iterable[Scalar]) -> None:
        """Sets entries that follow from edited ones, where they are not edited themselves."""
        entries = _entries_at(field_of(self.mj_model, field), field, index)
        self._derived |= zip(entries, values, strict=True)

    def rows(self, field: str) -> list[int]:
        """First indices of the edited entries of a field."""
        return sorted({self._index(entry)[0] for entry in self._edited if entry.field == field})

    def _index(self, entry: Entry) -> list[int]:
        shape = field_of(self.mj_model, entry.field).shape
        return [int(number) for number in np.unravel_index(entry.place, shape)]

    def edited_beside(self, indices: Iterable[tuple[str, Any]]) -> list[str]:
        """Names of the edited entries that are in none of some places: fields with an index."""
        places: set[Entry] = set()
        for field, index in indices:
            places.update(_entries_at(field_of(self.mj_model, field), field, index))
        names = []
        for entry in sorted(self._edited.keys() - places):
            index_words = ", ".join(map(str, self._index(entry)))
            names.append(f"{entry.field}[{index_words}]")
        return names

    def stiffness_and_damping(self, kind: str, row: int) -> tuple[Scalar, Scalar]:
        """Stiffness, 1/s^2, and damping, 1/s, of a constraint of one kind, "pair" or "dof"."""
        return stiffness_and_damping(self[f"{kind}_solref", row], float(self.mj_model.opt.timestep))

    def array(self, field: str) -> Array:
        """The field's array; a NumPy array without traced entries."""
        model_values = field_of(self.mj_model, field)
        numbers = self[field, ...]
        if not any(isinstance(number, jax.Array) for number in numbers):
            return np.reshape(np.array(numbers, model_values.dtype), model_values.shape)
        dtype = jnp.result_type(float)
        scalars = [jnp.asarray(number, dtype) for number in numbers]
        return jnp.stack(scalars).reshape(model_values.shape)


def _entries_at(model_values: np.ndarray, field: str, index: Any) -> list[Entry]:
    """The entries of a field at an index, as NumPy orders them."""
    all_places = np.arange(model_values.size).reshape(model_values.shape)
    return [Entry(field, place) for place in np.ravel(all_places[index]).tolist()]


def edits(mj_model: mujoco.MjModel, addresses: Addresses) -> tuple[Edit, ...]:
    """The table of the parameters' entries."""
    paddle = addresses.paddle_geom
    ball_bodies = [ball.body for ball in addresses.balls]
    ball_geoms = [ball.geom for ball in addresses.balls]
    # The parameter is the first ball's, and the others stay in proportion to it.
    masses = mj_model.body_mass[ball_bodies]
    radii = mj_model.geom_size[ball_geoms, 0]
    pairs = contact_pairs(mj_model, addresses)
    dofs = list(addresses.arm_qvel)
    servos = list(addresses.actuators)
    per_torque = 1.0 / np.abs(mj_model.actuator_gear[servos, 0])
    least, greatest = force_ranges(mj_model, servos)
    bodies, links = _massive_bodies(mj_model, addresses)
    share = mj_model.body_mass[bodies] / _link_masses(mj_model, addresses)[links]
    return (
        Edit("ball_mass", "body_mass", ball_bodies, masses / masses[0]),
        Edit("ball_radius", "geom_size", (ball_geoms, 0), radii / radii[0]),
        Edit("contact_stiffness", "pair_solref", (pairs, 0), -1.0),
        Edit("contact_damping", "pair_solref", (pairs, 1), -1.0),
        Edit("contact_friction", "pair_friction", (pairs, 0)),
        Edit("servo_gain", "actuator_gainprm", (servos, 0)),
        Edit("servo_gain", "actuator_biasprm", (servos, 1), -1.0),
        Edit("servo_damping", "actuator_biasprm", (servos, 2), -1.0),
        Edit("force_limit", "actuator_forcerange", (servos, 0), -per_torque, least=least),
        Edit("force_limit", "actuator_forcerange", (servos, 1), per_torque, greatest=greatest),
        Edit("armature", "dof_armature", dofs),
        Edit("damping", "dof_damping", dofs),
        Edit("frictionloss", "dof_frictionloss", dofs),
        Edit("link_mass", "body_mass", bodies, share, links),
        Edit("paddle_position", "geom_pos", paddle),
        Edit("paddle_rotation", "geom_quat", paddle),
        Edit("gravity", "opt.gravity", slice(None)),
    )


def _massive_bodies(mj_model: mujoco.MjModel, addresses: Addresses) -> tuple[list[int], list[int]]:
    """The links' bodies that have a mass, and the link to which each belongs."""
    bodies = []
    links = []
    for link, bodies_of_link in enumerate(link_bodies(mj_model, addresses)):
        for body in bodies_of_link:
            if mj_model.body_mass[body] > 0.0:
                bodies.append(body)
                links.append(link)
    return bodies, links


def _link_masses(mj_model: mujoco.MjModel, addresses: Addresses) -> np.ndarray:
    """Masses [n] of the acting joints' links, kg."""
    bodies_of_links = link_bodies(mj_model, addresses)
    return np.array([np.sum(mj_model.body_mass[bodies]) for bodies in bodies_of_links])


def edited(
    mj_model: mujoco.MjModel, addresses: Addresses, parameters: PhysicsParameters
) -> EditedModel:
    """The model in the world of one environment.

    Args:
      mj_model: the model.
      addresses: of its parts.
      parameters: numbers, or sequences of numbers: Python floats or scalars.

    Raises:
      UserError: an entry is not one of the model's, or the model lacks a contact pair.
    """
    model = EditedModel(mj_model, addresses)
    if parameters.contact_stiffness is not None or parameters.contact_damping is not None:
        # Stiffness and damping are entries of the direct format, so a solref in the other format is
        # first written as -k, -b.
        for pair in contact_pairs(mj_model, addresses):
            stiffness, damping = model.stiffness_and_damping("pair", pair)
            model.put("pair_solref", pair, [-float(stiffness), -float(damping)])
    for edit in edits(mj_model, addresses):
        value = getattr(parameters, edit.parameter)
        if value is not None:
            model.put(edit.field, edit.index, _values(mj_model, edit, value))
    for name, value in (parameters.entries or {}).items():
        _put_entry(model, name, value)
    _set_flags(model)
    _derive(model, parameters.ball_inertia)
    return model


def _values(mj_model: mujoco.MjModel, edit: Edit, value: Scalar | Sequence[Scalar]) -> list[Scalar]:
    """The numbers of an edit's entries for a value of its parameter."""
    count = field_of(mj_model, edit.field)[edit.index].size
    if count == 0:
        # The contact's parameters alone have entries that a model may lack.
        raise UserError(NO_PAIR)
    numbers = value if isinstance(value, tuple | list) else (value,) * count
    if edit.number is not None:
        numbers = [numbers[i] for i in edit.number]
    scales = np.broadcast_to(edit.scale, count).tolist()
    values = list(map(mul, numbers, scales))
    if edit.least is not None:
        values = list(map(maximum, values, edit.least.tolist()))
    if edit.greatest is not None:
        values = list(map(minimum, values, edit.greatest.tolist()))
    return values


def _put_entry(model: EditedModel, name: str, value: Scalar) -> None:
    """Edits the entry with a name such as `dof_damping[2]`."""
    field, _, index = name.removesuffix("]").partition("[")
    try:
        # An empty index would be the whole field; a number of the options alone has no entries.
        place = tuple(int(number) for number in index.split(","))
        model.put(field, place, [value])
    except (AttributeError, ValueError, IndexError):
        raise UserError(
            f"{name} is no entry of an MjModel; give a field with the index of one number, "
            "such as dof_damping[2]"
        ) from None


def _set_flags(model: EditedModel) -> None:
    """Sets what an edit needs in order to act, also one of `PhysicsParameters.entries`: a friction
    makes its pair frictional, and a force limit its servo limited."""
    for pair in model.rows("pair_friction"):
        model.follow("pair_dim", pair, [max(3, int(model.mj_model.pair_dim[pair]))])
        # One coefficient for both tangents.
        model.follow("pair_friction", (pair, 1), [model["pair_friction", pair, 0]])
    for name in model.edited_beside([("pair_friction", (slice(None), 0))]):
        if name.startswith("pair_friction["):
            raise UserError(
                f"{name} would be another friction than the one of its pair, which has one along "
                "both tangents; give the entry with the index 0"
            )
    for servo in model.rows("actuator_forcerange"):
        model.follow("actuator_forcelimited", servo, [True])
    # MuJoCo skips the transformation of a geom flagged as sharing its body's frame.
    for geom in {*model.rows("geom_pos"), *model.rows("geom_quat")}:
        model.follow("geom_sameframe", geom, [int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)])


def _derive(model: EditedModel, ball_inertia: Scalar | None) -> None:
    """Sets the entries that MuJoCo's compiler derives from edited ones, except the arm's inverse
    weights (`body_invweight0`, `dof_invweight0`). An inertia follows the mass, and a ball's also
    the square of the radius, with `PhysicsParameters.ball_inertia` as the factor if it is given."""
    ball_of_body = {ball.body: ball for ball in model.addresses.balls}
    edited_sizes = model.rows("geom_size")
    edited_masses = model.rows("body_mass")
    resized = [body for body, ball in ball_of_body.items() if ball.geom in edited_sizes]
    for body in {*edited_masses, *resized}:
        if body in ball_of_body:
            _derive_ball(model, ball_of_body[body], body in resized)
        else:
            _scale_inertia(model, body, _mass_factor(model, body))
    if ball_inertia is not None:
        for ball in model.addresses.balls:
            _derive_ball_inertia(model, ball, ball_inertia)
    if edited_masses:
        _derive_subtree_masses(model)
    for dof in model.addresses.arm_qvel:
        body = int(model.mj_model.dof_bodyid[dof])
        is_edited = body in edited_masses or dof in model.rows("dof_armature")
        if is_edited and model.mj_model.dof_simplenum[dof]:
            _derive_simple_inertia(model, dof)


def _mass_factor(model: EditedModel, body: int) -> Scalar:
    """Mass of a body divided by the model's own."""
    model_mass = model.mj_model.body_mass[body].item()
    return mul(model["body_mass", body], 1.0 / model_mass) if model_mass else 1.0


def _scale_inertia(model: EditedModel, body: int, factor: Scalar) -> None:
    """Sets the inertia of a body to a multiple of the model's own."""
    model.follow("body_inertia", body, Vec(model.mj_model.body_inertia[body].tolist()) * factor)


def _derive_ball(model: EditedModel, ball: BallAddresses, is_resized: bool) -> None:
    """Sets what follows from the mass and the radius of a ball."""
    factor = _mass_factor(model, ball.body)
    if is_resized:
        radius = model["geom_size", ball.geom, 0]
        growth = mul(radius, 1.0 / model.mj_model.geom_size[ball.geom, 0].item())
        factor = mul(factor, mul(growth, growth))
        model.follow("geom_rbound", ball.geom, [radius])
        model.follow("geom_aabb", (ball.geom, slice(3, 6)), [radius] * 3)
    _scale_inertia(model, ball.body, factor)
    _derive_ball_weights(model, ball)


def _derive_ball_inertia(model: EditedModel, ball: BallAddresses, per_mass: Scalar) -> None:
    """Sets the inertia of a ball from `PhysicsParameters.ball_inertia`."""
    radius = model["geom_size", ball.geom, 0]
    inertia = mul(per_mass, mul(model["body_mass", ball.body], mul(radius, radius)))
    model.follow("body_inertia", ball.body, [inertia] * 3)
    _derive_ball_weights(model, ball)


def _derive_ball_weights(model: EditedModel, ball: BallAddresses) -> None:
    """Sets what MuJoCo stores of the mass and the inertia of a ball beside them."""
    mj_model = model.mj_model
    mass = model["body_mass", ball.body]
    inertia = model["body_inertia", ball.body]
    # Inverses of the mass and of the inertia.
    inverse_mass, inverse_inertia = mj_model.body_invweight0[ball.body].tolist()
    moving = inverse_mass * mj_model.body_mass[ball.body].item() / mass
    turning = inverse_inertia * mj_model.body_inertia[ball.body, 0].item() / inertia[0]
    model.follow("body_invweight0", ball.body, [moving, turning])
    # MuJoCo stores the constant inertia matrix of a free body in the model.
    model.follow("dof_M0", np.array(ball.qvel), (mass, mass, mass, *inertia))


def _derive_simple_inertia(model: EditedModel, dof: int) -> None:
    """Sets the inertia of a joint that moves one body alone, such as a slide that carries the
    paddle: MuJoCo stores the constant diagonal of its inertia matrix in the model."""
    mj_model = model.mj_model
    body = int(mj_model.dof_bodyid[dof])
    factor = mul(model["body_mass", body], 1.0 / mj_model.body_mass[body].item())
    of_body = (mj_model.dof_M0[dof] - mj_model.dof_armature[dof]).item()
    model.follow("dof_M0", dof, [add(mul(factor, of_body), model["dof_armature", dof])])


def _derive_subtree_masses(model: EditedModel) -> None:
    """Sets the mass of each body together with its descendants."""
    # MuJoCo numbers parents before children.
    masses = list(model["body_mass", ...])
    for body in range(model.mj_model.nbody - 1, 0, -1):
        parent = model.mj_model.body_parentid[body]
        masses[parent] = add(masses[parent], masses[body])
    model.follow("body_subtreemass", ..., masses)


def edited_model(mj_model: mujoco.MjModel, parameters: PhysicsParameters) -> mujoco.MjModel:
    """Copy of the model with the parameters of one environment, for MuJoCo's C engine. With a new
    dry friction, it also has the iterations that its solver needs then (`raise_solver_limits`).

    Raises:
      UserError: an array does not have the shape of its field.
    """
    addresses = find_addresses(mj_model)
    check_shapes(own_parameters(mj_model, addresses), parameters)
    numbers = jax.tree.map(_as_floats, parameters)
    model = edited(mj_model, addresses, numbers)
    copied = copy.copy(mj_model)
    for field in model.fields:
        field_of(copied, field)[...] = model.array(field)
    if model.rows("dof_frictionloss"):
        raise_solver_limits(copied.opt)
    return copied


def _as_floats(array: Array) -> Any:
    return np.asarray(array, np.float64).tolist()


def own_parameters(
    mj_model: mujoco.MjModel, addresses: Addresses | None = None
) -> PhysicsParameters:
    """The model's own numbers, as NumPy arrays; of balls and of contacts, those of the first. A
    servo without a limit has an infinite one, and a model without a contact pair of ball and paddle
    has None for the parameters of the contact.

    Args:
      addresses: of its parts, if they are known.
    """
    if addresses is None:
        addresses = find_addresses(mj_model)
    numbers = {}
    for edit in edits(mj_model, addresses):
        # Where a parameter has several entries, the first one's number.
        entries = field_of(mj_model, edit.field)[edit.index] / edit.scale
        numbers.setdefault(edit.parameter, entries)
    numbers["ball_mass"] = numbers["ball_mass"][0]
    numbers["ball_radius"] = numbers["ball_radius"][0]
    first_ball = mj_model.body_inertia[addresses.balls[0].body, 0]
    numbers["ball_inertia"] = first_ball / (numbers["ball_mass"] * numbers["ball_radius"] ** 2)
    torques = torque_ranges(mj_model, addresses.arm_joints, addresses.actuators)
    numbers["force_limit"] = np.max(np.abs(torques), axis=0)
    numbers["link_mass"] = _link_masses(mj_model, addresses)
    numbers |= _contact_numbers(mj_model, addresses)
    return PhysicsParameters(**numbers)


def _contact_numbers(
    mj_model: mujoco.MjModel, addresses: Addresses
) -> dict[str, np.float64 | None]:
    """The model's own parameters of the contact of ball and paddle; None without a pair."""
    pairs = contact_pairs(mj_model, addresses)
    if not pairs:
        return {"contact_stiffness": None, "contact_damping": None, "contact_friction": None}
    solref = mj_model.pair_solref[pairs[0]]
    stiffness, damping = stiffness_and_damping(solref, mj_model.opt.timestep)
    # MuJoCo keeps a coefficient for a frictionless pair too.
    is_frictional = mj_model.pair_dim[pairs[0]] > 1
    friction = mj_model.pair_friction[pairs[0], 0] if is_frictional else 0.0
    return {
        "contact_stiffness": np.float64(stiffness),
        "contact_damping": np.float64(damping),
        "contact_friction": np.float64(friction),
    }


def check_shapes(model_parameters: PhysicsParameters, parameters: PhysicsParameters) -> None:
    """Checks the shapes of one environment's parameters.

    Args:
      model_parameters: `own_parameters` of its model.
      parameters: to check.

    Raises:
      UserError: an array does not have the shape of the model's own.
    """
    for name, value in parameters._asdict().items():
        if value is not None and name != "entries":
            _check_shape(name, value, np.shape(getattr(model_parameters, name)))
    for name, value in (parameters.entries or {}).items():
        _check_shape(name, value, ())


def _check_shape(name: str, value: Array, shape: tuple[int, ...]) -> None:
    if jnp.shape(value) != shape:
        raise UserError(
            f"the physics parameter {name} has the shape {jnp.shape(value)}; give an array of the "
            f"shape {shape} for one environment, and batch environments with jax.vmap"
        )
