"""A physical parameter is an edit of a MuJoCo model.

`edits` is the table of the parameters' entries in the model's fields, and `EditedModel` the model
with new numbers in some entries. The C engine and MJX get its fields; the fused engine reads it in
place of the compiled model, so that an edited number is an input of the program, and each other one
a constant that folds.
"""

import copy
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.physics.parameters import Array, PhysicsParameters
from bounce_mjx.physics.scalars import Scalar, Vec, add, maximum, minimum, mul
from bounce_mjx.robot.arm import raise_solver_limits
from bounce_mjx.robot.model import find_addresses, to_direct_solref
from bounce_mjx.robot.torques import force_ranges, torque_ranges

# MuJoCo's mjMINMU: its C engine computes with no smaller coefficient of friction.
MIN_FRICTION = 1e-5
_NO_PAIR = (
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
    or scalars where they were edited. Reading is recorded.
    """

    def __init__(self, mj_model: mujoco.MjModel):
        self.model, self.addresses = mj_model, find_addresses(mj_model)
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
        """A number, or a tuple of numbers, without a record."""
        own, values = _field(self.model, field), self._derived | self._edited
        numbers = [values.get(x, own.flat[x[1]].item()) for x in self._keys(field, index)]
        return Vec(numbers) if np.ndim(own[index]) else numbers[0]

    def put(self, field: str, index: Any, values: Iterable[Scalar]) -> None:
        """Edits entries."""
        self._edited |= zip(self._keys(field, index), values, strict=True)

    def follow(self, field: str, index: Any, values: Iterable[Scalar]) -> None:
        """Sets entries that follow from edited ones, where they are not edited themselves."""
        self._derived |= zip(self._keys(field, index), values, strict=True)

    def _keys(self, field: str, index: Any) -> list[tuple[str, int]]:
        """Keys of entries: the field, and the place in it."""
        own = _field(self.model, field)
        places = np.arange(own.size).reshape(own.shape)[index]
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
        m, at = self.model, self.addresses
        geoms = {at.paddle_geom, *(ball.geom for ball in at.balls)}
        both = zip(m.pair_geom1.tolist(), m.pair_geom2.tolist(), strict=True)
        pairs = {i: set(pair) for i, pair in enumerate(both) if geoms.issuperset(pair)}
        first = {at.paddle_geom, at.balls[0].geom}
        own = sorted(pairs, key=lambda i: pairs[i] != first)
        return own if own and pairs[own[0]] == first else []

    def array(self, field: str) -> Array:
        """The field's array; a NumPy array without traced entries."""
        own = _field(self.model, field)
        values = self.peek(field, ...)
        if not any(isinstance(value, jax.Array) for value in values):
            return np.reshape(np.array(values, own.dtype), own.shape)
        dtype = jnp.result_type(float)
        return jnp.stack([jnp.asarray(x, dtype) for x in values]).reshape(own.shape)


def _field(mj_model: mujoco.MjModel, name: str) -> np.ndarray:
    """A view of a model's field, or of one in its options."""
    owner, _, name = name.rpartition(".")
    return np.asarray(getattr(mj_model.opt if owner == "opt" else mj_model, name))


def edits(m: EditedModel) -> tuple[Edit, ...]:
    """The table of the parameters' entries."""
    at, masses = m.addresses, m.model.body_mass
    dofs, servos = list(at.arm_qvel), list(at.actuators)
    per_torque = 1.0 / np.abs(m.model.actuator_gear[servos, 0])
    least, greatest = force_ranges(m.model, servos)
    bodies, geoms = [ball.body for ball in at.balls], [ball.geom for ball in at.balls]
    pairs = m.contact_pairs()
    links = enumerate(m.link_bodies())
    joint = {body: i for i, link in links for body in link.tolist() if masses[body] > 0.0}
    heavy, joints = list(joint), list(joint.values())
    share = masses[heavy] / m.link_masses()[joints]
    return (
        Edit("ball_mass", "body_mass", bodies),
        Edit("ball_radius", "geom_size", (geoms, 0)),
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
        Edit("link_mass", "body_mass", heavy, share, joints),
        Edit("paddle_position", "geom_pos", at.paddle_geom),
        Edit("paddle_rotation", "geom_quat", at.paddle_geom),
        Edit("gravity", "opt.gravity", slice(None)),
    )


def edited(mj_model: mujoco.MjModel, parameters: PhysicsParameters) -> EditedModel:
    """The model in the world of one environment.

    Args:
      parameters: numbers, or sequences of numbers: Python floats or scalars.

    Raises:
      UserError: an entry is not one of the model's, or the model lacks a contact pair.
    """
    m, p = EditedModel(mj_model), parameters
    if p.contact_stiffness is not None or p.contact_damping is not None:
        for pair in m.contact_pairs():
            direct = to_direct_solref(mj_model.pair_solref[pair], mj_model.opt.timestep)
            m.put("pair_solref", pair, [-float(x) for x in direct])
    for edit in edits(m):
        value = getattr(p, edit.parameter)
        if value is None:
            continue
        count = _field(mj_model, edit.field)[edit.index].size
        if not count:
            raise UserError(_NO_PAIR)
        numbers = value if isinstance(value, tuple | list) else (value,) * count
        if edit.number is not None:
            numbers = [numbers[i] for i in edit.number]
        values = map(mul, numbers, np.broadcast_to(edit.scale, count).tolist())
        if edit.least is not None:
            values = map(maximum, values, edit.least.tolist())
        if edit.greatest is not None:
            values = map(minimum, values, edit.greatest.tolist())
        m.put(edit.field, edit.index, values)
    for name, value in (p.entries or {}).items():
        field, _, inner = name.removesuffix("]").partition("[")
        try:
            m.put(field, tuple(int(number) for number in inner.split(",") if number), [value])
        except (AttributeError, ValueError, IndexError):
            raise UserError(
                f"{name} is no entry of an MjModel; give a field with the index of one number, "
                "such as dof_damping[2]"
            ) from None
    _set_flags(m)
    _derive(m)
    return m


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
    c, balls, sizes = m.model, {x.body: x for x in m.addresses.balls}, m.rows("geom_size")
    heavy = m.rows("body_mass")
    for body in {*heavy, *(x.body for x in balls.values() if x.geom in sizes)}:
        ball, mass, own = balls.get(body), m.peek("body_mass", body), c.body_mass[body].item()
        factor = mul(mass, 1.0 / own) if own else 1.0
        if ball and ball.geom in sizes:
            radius = m.peek("geom_size", ball.geom, 0)
            growth = mul(radius, 1.0 / c.geom_size[ball.geom, 0].item())
            factor = mul(factor, mul(growth, growth))
            m.follow("geom_rbound", ball.geom, [radius])
            m.follow("geom_aabb", (ball.geom, slice(3, 6)), [radius] * 3)
        m.follow("body_inertia", body, Vec(c.body_inertia[body].tolist()) * factor)
        if ball:
            inertia = m.peek("body_inertia", body)
            # Inverses of the mass and of the inertia.
            moving, turning = c.body_invweight0[body].tolist()
            moving, turning = moving * own, turning * c.body_inertia[body, 0].item()
            m.follow("body_invweight0", body, [moving / mass, turning / inertia[0]])
            # MuJoCo stores the constant inertia matrix of a free body in the model.
            m.follow("dof_M0", np.array(ball.qvel), (mass,) * 3 + inertia)
    if heavy:
        # MuJoCo numbers parents before children.
        total = list(m.peek("body_mass", ...))
        for body in range(c.nbody - 1, 0, -1):
            parent = c.body_parentid[body]
            total[parent] = add(total[parent], total[body])
        m.follow("body_subtreemass", ..., total)


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
    model without a contact pair of ball and paddle no numbers of the contact."""
    m, own = EditedModel(mj_model), {}
    at = m.addresses
    for edit in edits(m):
        own.setdefault(edit.parameter, _field(mj_model, edit.field)[edit.index] / edit.scale)
    torques = torque_ranges(mj_model, at.arm_joints, at.actuators)
    own["force_limit"] = np.max(np.abs(torques), axis=0)
    own["link_mass"] = m.link_masses()
    own |= {name: own[name][0] for name in ("ball_mass", "ball_radius")}
    own |= dict.fromkeys(("contact_stiffness", "contact_damping", "contact_friction"))
    if pairs := m.contact_pairs():
        stiffness, damping = direct_solref(mj_model)
        # MuJoCo keeps a coefficient for a frictionless pair too.
        friction = mj_model.pair_friction[pairs[0], 0] if mj_model.pair_dim[pairs[0]] > 1 else 0.0
        own["contact_stiffness"] = np.float64(stiffness)
        own["contact_damping"] = np.float64(damping)
        own["contact_friction"] = np.float64(friction)
    return PhysicsParameters(**own)


def check_shapes(mj_model: mujoco.MjModel, parameters: PhysicsParameters) -> None:
    """Checks the shapes of one environment's parameters.

    Raises:
      UserError: an array does not have the shape of the model's own.
    """
    own, entries = own_parameters(mj_model)._asdict(), dict(parameters.entries or {})
    given = parameters._asdict() | entries | {"entries": None}
    for name, value in given.items():
        if value is not None and jnp.shape(value) != np.shape(own.get(name)):
            raise UserError(
                f"the physics parameter {name} has the shape {jnp.shape(value)}; give an array of "
                f"the shape {np.shape(own.get(name))} for one environment, and batch environments "
                "with jax.vmap"
            )


def direct_solref(mj_model: mujoco.MjModel) -> tuple[float, float]:
    """k and b of the first ball's contact with the paddle, `solref` in MuJoCo's direct format.

    Raises:
      UserError: they have no contact pair.
    """
    pairs = EditedModel(mj_model).contact_pairs()
    if not pairs:
        raise UserError(_NO_PAIR)
    stiffness, damping = to_direct_solref(mj_model.pair_solref[pairs[0]], mj_model.opt.timestep)
    return float(stiffness), float(damping)
