"""A physical parameter is an edit of a MuJoCo model.

`edits` is the table of the parameters' entries in the model's fields, and `EditedModel` the model
with new numbers in some entries. The C engine and MJX get its fields; the fused engine reads it in
place of the compiled model, so that an edited number is an input of the program, and each other one
a constant that folds.
"""

import copy
import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.physics.parameters import Array, PhysicsParameters
from bounce_mjx.physics.scalars import Scalar, Vec, add, maximum, minimum, mul
from bounce_mjx.robot.arm import raise_solver_limits
from bounce_mjx.robot.model import BallAddresses, find_addresses, to_direct_solref
from bounce_mjx.robot.torques import force_ranges, torque_ranges

# MuJoCo's mjMINMU: its C engine computes with no smaller coefficient of friction.
MIN_FRICTION = 1e-5
NO_PAIR = (
    "the MJCF has no contact pair of the ball and the paddle, which contact_stiffness, "
    "contact_damping and contact_friction change; add <pair> to <contact>"
)


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
    """Which of the parameter's numbers each entry has; by default, each has its own."""
    least: Any = None
    """Least value of each entry, for a parameter that limits the model's own values."""
    greatest: Any = None
    """Greatest value of each entry, for a parameter that limits the model's own values."""


class EditedModel:
    """A compiled model with new numbers in some entries.

    `model["dof_damping", 2]` is a number, `model["geom_pos", 3]` a tuple of numbers: Python floats,
    or scalars where they were edited. The brackets mark the entries as used by an engine, and
    `unread` names the edited entries that no brackets have read; `peek` reads without a mark.
    """

    def __init__(self, mj_model: mujoco.MjModel):
        self.model = mj_model
        self.addresses = find_addresses(mj_model)
        self._edited: dict[tuple[str, int], Scalar] = {}
        self._derived: dict[tuple[str, int], Scalar] = {}
        self._read: set[tuple[str, int]] = set()

    @property
    def fields(self) -> set[str]:
        """Names of the fields in which entries are edited or follow from edited ones."""
        return {field for field, _ in self._derived | self._edited}

    def __getitem__(self, key: tuple) -> Any:
        field, *index = key
        self._read.update(self._keys(field, tuple(index)))
        return self.peek(*key)

    def peek(self, field: str, *index: Any) -> Any:
        """A number, or a tuple of numbers, without a mark."""
        model_values = _field(self.model, field)
        new_values = self._derived | self._edited
        numbers = []
        for key in self._keys(field, index):
            _, place = key
            numbers.append(new_values.get(key, model_values.flat[place].item()))
        return Vec(numbers) if np.ndim(model_values[index]) else numbers[0]

    def put(self, field: str, index: Any, values: Iterable[Scalar]) -> None:
        """Edits entries."""
        self._edited |= zip(self._keys(field, index), values, strict=True)

    def follow(self, field: str, index: Any, values: Iterable[Scalar]) -> None:
        """Sets entries that follow from edited ones, where they are not edited themselves."""
        self._derived |= zip(self._keys(field, index), values, strict=True)

    def _keys(self, field: str, index: Any) -> list[tuple[str, int]]:
        """Keys of entries: the field, and the place in it."""
        shape = _field(self.model, field).shape
        places = np.arange(math.prod(shape)).reshape(shape)[index]
        return [(field, place) for place in np.ravel(places).tolist()]

    def rows(self, field: str) -> list[int]:
        """First indices of the edited entries of a field."""
        return sorted({self._index(key)[0] for key in self._edited if key[0] == field})

    def _index(self, key: tuple[str, int]) -> list[int]:
        return np.stack(np.unravel_index(key[1], _field(self.model, key[0]).shape)).tolist()

    def unread(self) -> list[str]:
        """Names of the edited entries that nothing has read."""
        unread = sorted(self._edited.keys() - self._read)
        return [f"{key[0]}[{', '.join(map(str, self._index(key)))}]" for key in unread]

    def link_bodies(self) -> tuple[np.ndarray, ...]:
        """Bodies of each acting joint's link: the joint's body and the bodies welded to it. A body
        with several joints belongs to the last one, and the others have no bodies."""
        m = self.model
        last_joint = (m.body_jntadr + m.body_jntnum - 1)[m.body_weldid]
        return tuple(np.flatnonzero(last_joint == j) for j in self.addresses.arm_joints)

    def link_masses(self) -> np.ndarray:
        """Masses [n] of the acting joints' links without edits, kg."""
        return np.array([np.sum(self.model.body_mass[bodies]) for bodies in self.link_bodies()])

    def contact_pairs(self) -> list[int]:
        """Indices of the contact pairs of balls and the paddle, the first ball's with the paddle
        first; none if that one is missing."""
        paddle = self.addresses.paddle_geom
        balls = [ball.geom for ball in self.addresses.balls]
        geoms1 = self.model.pair_geom1.tolist()
        geoms2 = self.model.pair_geom2.tolist()
        first = None
        others = []
        for i, pair in enumerate(zip(geoms1, geoms2, strict=True)):
            if set(pair) == {paddle, balls[0]} and first is None:
                first = i
            elif {paddle, *balls}.issuperset(pair):
                others.append(i)
        return [] if first is None else [first, *others]

    def array(self, field: str) -> Array:
        """The field's array; a NumPy array without traced entries."""
        model_values = _field(self.model, field)
        values = self.peek(field, ...)
        if not any(isinstance(value, jax.Array) for value in values):
            return np.reshape(np.array(values, model_values.dtype), model_values.shape)
        dtype = jnp.result_type(float)
        scalars = [jnp.asarray(value, dtype) for value in values]
        return jnp.stack(scalars).reshape(model_values.shape)


def _field(mj_model: mujoco.MjModel, name: str) -> np.ndarray:
    """A view of a model's field, or of one in its options."""
    owner, _, name = name.rpartition(".")
    return np.asarray(getattr(mj_model.opt if owner == "opt" else mj_model, name))


def edits(m: EditedModel) -> tuple[Edit, ...]:
    """The table of the parameters' entries."""
    paddle = m.addresses.paddle_geom
    ball_bodies = [ball.body for ball in m.addresses.balls]
    ball_geoms = [ball.geom for ball in m.addresses.balls]
    pairs = m.contact_pairs()
    dofs = list(m.addresses.arm_qvel)
    servos = list(m.addresses.actuators)
    per_torque = 1.0 / np.abs(m.model.actuator_gear[servos, 0])
    least, greatest = force_ranges(m.model, servos)
    # The bodies with a mass, and the link to which each belongs.
    bodies = []
    links = []
    for link, link_bodies in enumerate(m.link_bodies()):
        for body in link_bodies.tolist():
            if m.model.body_mass[body] > 0.0:
                bodies.append(body)
                links.append(link)
    share = m.model.body_mass[bodies] / m.link_masses()[links]
    return (
        Edit("ball_mass", "body_mass", ball_bodies),
        Edit("ball_radius", "geom_size", (ball_geoms, 0)),
        Edit("contact_stiffness", "pair_solref", (pairs, 0), -1.0),
        Edit("contact_damping", "pair_solref", (pairs, 1), -1.0),
        Edit("contact_friction", "pair_friction", (pairs, slice(0, 2))),
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


def edited(mj_model: mujoco.MjModel, parameters: PhysicsParameters) -> EditedModel:
    """The model in the world of one environment.

    Args:
      parameters: numbers, or sequences of numbers: Python floats or scalars.

    Raises:
      UserError: an entry is not one of the model's, or the model lacks a contact pair.
    """
    m = EditedModel(mj_model)
    if parameters.contact_stiffness is not None or parameters.contact_damping is not None:
        # Both numbers of a solref have one format.
        for pair in m.contact_pairs():
            direct = to_direct_solref(mj_model.pair_solref[pair], mj_model.opt.timestep)
            m.put("pair_solref", pair, [-float(number) for number in direct])
    for edit in edits(m):
        value = getattr(parameters, edit.parameter)
        if value is not None:
            m.put(edit.field, edit.index, _entries(m, edit, value))
    for name, value in (parameters.entries or {}).items():
        _put_entry(m, name, value)
    _set_flags(m)
    _derive(m)
    return m


def _entries(m: EditedModel, edit: Edit, value: Scalar | Sequence[Scalar]) -> list[Scalar]:
    """The numbers of an edit's entries for a value of its parameter."""
    count = _field(m.model, edit.field)[edit.index].size
    if not count:
        raise UserError(NO_PAIR)
    numbers = value if isinstance(value, tuple | list) else (value,) * count
    if edit.number is not None:
        numbers = [numbers[i] for i in edit.number]
    scales = np.broadcast_to(edit.scale, count).tolist()
    entries = list(map(mul, numbers, scales))
    if edit.least is not None:
        entries = list(map(maximum, entries, edit.least.tolist()))
    if edit.greatest is not None:
        entries = list(map(minimum, entries, edit.greatest.tolist()))
    return entries


def _put_entry(m: EditedModel, name: str, value: Scalar) -> None:
    """Edits the entry with a name such as `dof_damping[2]`."""
    field, _, index = name.removesuffix("]").partition("[")
    try:
        place = tuple(int(number) for number in index.split(",") if number)
        m.put(field, place, [value])
    except (AttributeError, ValueError, IndexError):
        raise UserError(
            f"{name} is no entry of an MjModel; give a field with the index of one number, "
            "such as dof_damping[2]"
        ) from None


def _set_flags(m: EditedModel) -> None:
    """Sets what an edit needs in order to act."""
    for pair in m.rows("pair_friction"):
        m.follow("pair_dim", pair, [max(3, int(m.model.pair_dim[pair]))])
    for servo in m.rows("actuator_forcerange"):
        m.follow("actuator_forcelimited", servo, [True])
    # MuJoCo skips the transformation of a geom flagged as sharing its body's frame.
    for geom in {*m.rows("geom_pos"), *m.rows("geom_quat")}:
        m.follow("geom_sameframe", geom, [int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)])


def _derive(m: EditedModel) -> None:
    """Sets the entries that MuJoCo's compiler derives from edited ones. An inertia follows the
    mass, and a ball's also the square of the radius."""
    balls = {ball.body: ball for ball in m.addresses.balls}
    edited_sizes = m.rows("geom_size")
    edited_masses = m.rows("body_mass")
    resized = [body for body, ball in balls.items() if ball.geom in edited_sizes]
    for body in {*edited_masses, *resized}:
        _derive_inertia(m, body, balls.get(body), body in resized)
    if edited_masses:
        _derive_subtree_masses(m)


def _derive_inertia(
    m: EditedModel, body: int, ball: BallAddresses | None, is_resized: bool
) -> None:
    """Sets what follows from the mass of a body and from the radius of a ball.

    Args:
      m: the model with its edits.
      body: index of the body.
      ball: the ball that it is; None for another body.
      is_resized: whether it is a ball with an edited radius.
    """
    c = m.model
    mass = m.peek("body_mass", body)
    model_mass = c.body_mass[body].item()
    factor = mul(mass, 1.0 / model_mass) if model_mass else 1.0
    if is_resized:
        radius = m.peek("geom_size", ball.geom, 0)
        growth = mul(radius, 1.0 / c.geom_size[ball.geom, 0].item())
        factor = mul(factor, mul(growth, growth))
        m.follow("geom_rbound", ball.geom, [radius])
        m.follow("geom_aabb", (ball.geom, slice(3, 6)), [radius] * 3)
    m.follow("body_inertia", body, Vec(c.body_inertia[body].tolist()) * factor)
    if ball is not None:
        inertia = m.peek("body_inertia", body)
        # Inverses of the mass and of the inertia.
        inverse_mass, inverse_inertia = c.body_invweight0[body].tolist()
        moving = inverse_mass * model_mass / mass
        turning = inverse_inertia * c.body_inertia[body, 0].item() / inertia[0]
        m.follow("body_invweight0", body, [moving, turning])
        # MuJoCo stores the constant inertia matrix of a free body in the model.
        m.follow("dof_M0", np.array(ball.qvel), (mass,) * 3 + inertia)


def _derive_subtree_masses(m: EditedModel) -> None:
    # MuJoCo numbers parents before children.
    masses = list(m.peek("body_mass", ...))
    for body in range(m.model.nbody - 1, 0, -1):
        parent = m.model.body_parentid[body]
        masses[parent] = add(masses[parent], masses[body])
    m.follow("body_subtreemass", ..., masses)


def edited_model(mj_model: mujoco.MjModel, parameters: PhysicsParameters) -> mujoco.MjModel:
    """Copy of the model with the parameters of one environment, for MuJoCo's C engine.

    Raises:
      UserError: an array does not have the shape of its field.
    """
    check_shapes(mj_model, parameters)
    numbers = jax.tree.map(lambda x: np.asarray(x, np.float64).tolist(), parameters)
    m, model = edited(mj_model, numbers), copy.copy(mj_model)
    for field in m.fields:
        _field(model, field)[...] = m.array(field)
    if m.rows("dof_frictionloss"):
        raise_solver_limits(model.opt)
    return model


def own_parameters(mj_model: mujoco.MjModel) -> PhysicsParameters:
    """The model's own numbers, as NumPy arrays. A servo without a limit has an infinite one, and a
    model without a contact pair of ball and paddle has None for the parameters of the contact."""
    m = EditedModel(mj_model)
    numbers = {}
    for edit in edits(m):
        # Where a parameter has several entries, the first one's number.
        entries = _field(mj_model, edit.field)[edit.index] / edit.scale
        numbers.setdefault(edit.parameter, entries)
    numbers["ball_mass"] = numbers["ball_mass"][0]
    numbers["ball_radius"] = numbers["ball_radius"][0]
    torques = torque_ranges(mj_model, m.addresses.arm_joints, m.addresses.actuators)
    numbers["force_limit"] = np.max(np.abs(torques), axis=0)
    numbers["link_mass"] = m.link_masses()
    numbers |= _contact_numbers(m)
    return PhysicsParameters(**numbers)


def _contact_numbers(m: EditedModel) -> dict[str, np.float64 | None]:
    """The model's own parameters of the contact of ball and paddle; None without a pair."""
    pairs = m.contact_pairs()
    if not pairs:
        return {"contact_stiffness": None, "contact_damping": None, "contact_friction": None}
    stiffness, damping = direct_solref(m.model)
    # MuJoCo keeps a coefficient for a frictionless pair too.
    is_frictional = m.model.pair_dim[pairs[0]] > 1
    friction = m.model.pair_friction[pairs[0], 0] if is_frictional else 0.0
    return {
        "contact_stiffness": np.float64(stiffness),
        "contact_damping": np.float64(damping),
        "contact_friction": np.float64(friction),
    }


def check_shapes(mj_model: mujoco.MjModel, parameters: PhysicsParameters) -> None:
    """Checks the shapes of one environment's parameters.

    Raises:
      UserError: an array does not have the shape of the model's own.
    """
    shapes = {name: np.shape(value) for name, value in own_parameters(mj_model)._asdict().items()}
    values = parameters._asdict()
    # Each other entry of the model is a number.
    entries = values.pop("entries") or {}
    for name, value in (values | dict(entries)).items():
        shape = shapes.get(name, ())
        if value is not None and jnp.shape(value) != shape:
            raise UserError(
                f"the physics parameter {name} has the shape {jnp.shape(value)}; give an array of "
                f"the shape {shape} for one environment, and batch environments with jax.vmap"
            )


def direct_solref(mj_model: mujoco.MjModel) -> tuple[float, float]:
    """k and b of the first ball's contact with the paddle, `solref` in MuJoCo's direct format.

    Raises:
      UserError: they have no contact pair.
    """
    pairs = EditedModel(mj_model).contact_pairs()
    if not pairs:
        raise UserError(NO_PAIR)
    stiffness, damping = to_direct_solref(mj_model.pair_solref[pairs[0]], mj_model.opt.timestep)
    return float(stiffness), float(damping)
