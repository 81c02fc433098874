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
from bounce_mjx.physics.parameters import Array, PhysicsParameters, check_shapes
from bounce_mjx.physics.scalars import Scalar, add, mul, scale
from bounce_mjx.robot.arm import raise_solver_limits
from bounce_mjx.robot.model import find_addresses, to_direct_solref

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


def edits(mj_model: mujoco.MjModel) -> tuple[Edit, ...]:
    """The table of the parameters' entries."""
    m, at = mj_model, find_addresses(mj_model)
    dofs, servos = list(at.arm_qvel), list(at.actuators)
    bodies, geoms = [ball.body for ball in at.balls], [ball.geom for ball in at.balls]
    pairs = contact_pairs(m)
    links = enumerate(link_bodies(m))
    joint = {body: i for i, link in links for body in link.tolist() if m.body_mass[body] > 0.0}
    heavy, joints = list(joint), list(joint.values())
    return (
        Edit("ball_mass", "body_mass", bodies),
        Edit("ball_radius", "geom_size", (geoms, 0)),
        Edit("contact_stiffness", "pair_solref", (pairs, 0), -1.0),
        Edit("contact_damping", "pair_solref", (pairs, 1), -1.0),
        Edit("contact_friction", "pair_friction", (pairs, slice(0, 2))),
        Edit("servo_gain", "actuator_gainprm", (servos, 0)),
        Edit("servo_gain", "actuator_biasprm", (servos, 1), -1.0),
        Edit("servo_damping", "actuator_biasprm", (servos, 2), -1.0),
        Edit("force_limit", "actuator_forcerange", (servos, 1)),
        Edit("force_limit", "actuator_forcerange", (servos, 0), -1.0),
        Edit("armature", "dof_armature", dofs),
        Edit("damping", "dof_damping", dofs),
        Edit("frictionloss", "dof_frictionloss", dofs),
        Edit("link_mass", "body_mass", heavy, m.body_mass[heavy] / link_masses(m)[joints], joints),
        Edit("paddle_position", "geom_pos", at.paddle_geom),
        Edit("paddle_rotation", "geom_quat", at.paddle_geom),
        Edit("gravity", "opt.gravity", slice(None)),
    )


class EditedModel:
    """A compiled model with new numbers in some entries.

    `model["dof_damping", 2]` is a number, `model["geom_pos", 3]` a tuple of numbers: Python floats,
    or scalars where they were edited. Reading is recorded.
    """

    def __init__(self, mj_model: mujoco.MjModel):
        self.model, self.addresses = mj_model, find_addresses(mj_model)
        self.fields: dict[str, np.ndarray] = {}
        """The entries, as Python objects, of each field in which some are edited or follow."""
        self._edited: dict[str, np.ndarray] = {}
        self._unread: dict[str, np.ndarray] = {}

    def __getitem__(self, key: tuple) -> Any:
        field, *index = key
        if field in self._unread:
            self._unread[field][tuple(index)] = False
        return self.peek(*key)

    def peek(self, field: str, *index: Any) -> Any:
        """A number, or a tuple of numbers, without a record."""
        found = self.fields.get(field, _field(self.model, field))[index]
        if isinstance(found, np.ndarray):
            return tuple(found.tolist())
        return found.item() if isinstance(found, np.generic) else found

    def put(self, field: str, index: Any, values: Iterable[Scalar]) -> None:
        """Edits entries."""
        self._set(field, index, values, follows=False)
        self._edited[field][index] = True
        self._unread.setdefault(field, np.zeros_like(self._edited[field]))[index] = True

    def follow(self, field: str, index: Any, values: Iterable[Scalar]) -> None:
        """Sets entries that follow from edited ones, where they are not edited themselves."""
        self._set(field, index, values, follows=True)

    def _set(self, field: str, index: Any, values: Iterable[Scalar], follows: bool) -> None:
        own = _field(self.model, field)
        entries = self.fields.setdefault(field, own.astype(object)).reshape(-1)
        edited = self._edited.setdefault(field, np.zeros(own.shape, bool)).reshape(-1)
        places = np.arange(own.size).reshape(own.shape)[index]
        for place, value in zip(places.ravel().tolist(), values, strict=True):
            if not (follows and edited[place]):
                entries[place] = value

    def rows(self, field: str) -> list[int]:
        """First indices of the edited entries of a field."""
        return np.unique(np.argwhere(self._edited.get(field, []))[:, :1]).tolist()

    def unread(self) -> list[str]:
        """Names of the edited entries that nothing has read."""
        return [
            f"{field}[{', '.join(map(str, index))}]"
            for field, unread in self._unread.items()
            for index in np.argwhere(unread).tolist()
        ]

    def array(self, field: str) -> Array:
        """The field's array; a NumPy array without traced entries."""
        own, values = _field(self.model, field), self.fields[field].ravel().tolist()
        if not any(isinstance(value, jax.Array) for value in values):
            return np.reshape(np.array(values, own.dtype), own.shape)
        dtype = jnp.result_type(float)
        return jnp.stack([jnp.asarray(x, dtype) for x in values]).reshape(own.shape)


def _field(mj_model: mujoco.MjModel, name: str) -> np.ndarray:
    """A view of a model's field, or of one in its options."""
    owner, _, name = name.rpartition(".")
    return np.asarray(getattr(mj_model.opt if owner == "opt" else mj_model, name))


def edited(mj_model: mujoco.MjModel, parameters: PhysicsParameters) -> EditedModel:
    """The model in the world of one environment.

    Args:
      parameters: numbers, or sequences of numbers: Python floats or scalars.

    Raises:
      UserError: an entry is not one of the model's, or the model lacks a contact pair.
    """
    m, p = EditedModel(mj_model), parameters
    if p.contact_stiffness is not None or p.contact_damping is not None:
        for pair in contact_pairs(mj_model):
            direct = to_direct_solref(mj_model.pair_solref[pair], mj_model.opt.timestep)
            m.put("pair_solref", pair, [-float(x) for x in direct])
    for edit in edits(mj_model):
        value = getattr(p, edit.parameter)
        if value is None:
            continue
        count = _field(mj_model, edit.field)[edit.index].size
        if not count:
            raise UserError(_NO_PAIR)
        numbers = value if isinstance(value, tuple | list) else (value,) * count
        each = numbers if edit.number is None else [numbers[i] for i in edit.number]
        m.put(edit.field, edit.index, map(mul, each, np.broadcast_to(edit.scale, count).tolist()))
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

    def growth(field: str, *index: int) -> Scalar:
        own = _field(m.model, field)[index].item()
        return mul(m.peek(field, *index), 1.0 / own) if own else 1.0

    def follow_inertia(body: int, factor: Scalar) -> None:
        m.follow("body_inertia", body, scale(tuple(m.model.body_inertia[body].tolist()), factor))

    masses, sizes = m.rows("body_mass"), m.rows("geom_size")
    for body in masses:
        follow_inertia(body, growth("body_mass", body))
    for ball in m.addresses.balls:
        if ball.geom in sizes:
            radius, factor = m.peek("geom_size", ball.geom, 0), growth("geom_size", ball.geom, 0)
            follow_inertia(ball.body, mul(growth("body_mass", ball.body), mul(factor, factor)))
            m.follow("geom_rbound", ball.geom, [radius])
            m.follow("geom_aabb", (ball.geom, slice(3, 6)), [radius] * 3)
        if ball.geom in sizes or ball.body in masses:
            mass, inertia = m.peek("body_mass", ball.body), m.peek("body_inertia", ball.body)
            # Inverses of the mass and of the inertia.
            moving, turning = m.model.body_invweight0[ball.body].tolist()
            moving *= m.model.body_mass[ball.body].item()
            turning *= m.model.body_inertia[ball.body, 0].item()
            m.follow("body_invweight0", ball.body, [moving / mass, turning / inertia[0]])
            # MuJoCo stores the constant inertia matrix of a free body in the model.
            m.follow("dof_M0", np.array(ball.qvel), (mass,) * 3 + inertia)
    if masses:
        # MuJoCo numbers parents before children.
        total = list(m.peek("body_mass", slice(None)))
        for body in range(m.model.nbody - 1, 0, -1):
            parent = m.model.body_parentid[body]
            total[parent] = add(total[parent], total[body])
        m.follow("body_subtreemass", slice(None), total)


def edited_model(mj_model: mujoco.MjModel, parameters: PhysicsParameters) -> mujoco.MjModel:
    """Copy of the model with the parameters of one environment, for MuJoCo's C engine.

    Raises:
      UserError: an array does not have the shape of its field.
    """
    check_shapes(parameters, len(find_addresses(mj_model).arm_joints))
    numbers = jax.tree.map(lambda x: np.asarray(x, np.float64).tolist(), parameters)
    m, model = edited(mj_model, numbers), copy.copy(mj_model)
    for field in m.fields:
        _field(model, field)[...] = m.array(field)
    if m.rows("dof_frictionloss"):
        raise_solver_limits(model.opt)
    return model


def own_parameters(mj_model: mujoco.MjModel) -> PhysicsParameters:
    """The model's own numbers, as NumPy arrays, except for the contact's. A servo without a limit
    has an infinite one."""
    m, own = mj_model, {}
    for edit in edits(m):
        own.setdefault(edit.parameter, _field(m, edit.field)[edit.index] / edit.scale)
    servos = list(find_addresses(m).actuators)
    least = np.min(np.abs(m.actuator_forcerange[servos]), axis=1)
    own["force_limit"] = np.where(m.actuator_forcelimited[servos], least, np.inf)
    own["link_mass"] = link_masses(m)
    own |= {name: own[name][0] for name in ("ball_mass", "ball_radius")}
    own |= dict.fromkeys(("contact_stiffness", "contact_damping", "contact_friction"))
    return PhysicsParameters(**own)


def link_bodies(mj_model: mujoco.MjModel) -> tuple[np.ndarray, ...]:
    """Bodies of each acting joint's link: the joint's body and the bodies welded to it. A body with
    several joints belongs to the last one, and the others have no bodies."""
    m, joints = mj_model, find_addresses(mj_model).arm_joints
    last_joint = (m.body_jntadr + m.body_jntnum - 1)[m.body_weldid]
    return tuple(np.flatnonzero(last_joint == j) for j in joints)


def link_masses(mj_model: mujoco.MjModel) -> np.ndarray:
    """Masses [n] of the acting joints' links, kg."""
    return np.array([np.sum(mj_model.body_mass[bodies]) for bodies in link_bodies(mj_model)])


def direct_solref(mj_model: mujoco.MjModel) -> tuple[float, float]:
    """k and b of the first ball's contact with the paddle, `solref` in MuJoCo's direct format.

    Raises:
      UserError: they have no contact pair.
    """
    pairs = contact_pairs(mj_model)
    if not pairs:
        raise UserError(_NO_PAIR)
    stiffness, damping = to_direct_solref(mj_model.pair_solref[pairs[0]], mj_model.opt.timestep)
    return float(stiffness), float(damping)


def contact_pairs(mj_model: mujoco.MjModel) -> list[int]:
    """Indices of the contact pairs of balls and the paddle, the first ball's with the paddle first;
    none if that one is missing."""
    at = find_addresses(mj_model)
    geoms = {at.paddle_geom, *(ball.geom for ball in at.balls)}
    both = zip(mj_model.pair_geom1.tolist(), mj_model.pair_geom2.tolist(), strict=True)
    pairs = {i: set(pair) for i, pair in enumerate(both) if geoms.issuperset(pair)}
    first = {at.paddle_geom, at.ball_geom}
    own = sorted(pairs, key=lambda i: pairs[i] != first)
    return own if own and pairs[own[0]] == first else []
