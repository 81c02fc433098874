"""A physical parameter is an edit of a MuJoCo model.

`edits` is the table of the parameters' entries in the model's fields, and `EditedModel` the model
with new numbers in some entries. The C engine and MJX get its fields; the fused engine reads it in
place of the compiled model, so that an edited number is an input of the program, and each other one
a constant that folds.
"""

import copy
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.physics.parameters import Array, PhysicsParameters, check_shapes
from bounce_mjx.physics.scalars import Scalar, add, maximum, mul, scale
from bounce_mjx.robot.arm import raise_solver_limits
from bounce_mjx.robot.model import find_addresses, to_direct_solref

# MuJoCo's mjMINMU: its C engine computes with no smaller coefficient of friction.
MIN_FRICTION = 1e-5


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
    of: Any = None
    """Which of the parameter's numbers each entry has; by default, each has its own."""


def edits(mj_model: mujoco.MjModel) -> tuple[Edit, ...]:
    """The table of the parameters' entries."""
    addresses = find_addresses(mj_model)
    dofs, servos = np.array(addresses.arm_qvel), np.array(addresses.actuators)
    bodies, geoms = ([getattr(b, kind) for b in addresses.balls] for kind in ("body", "geom"))
    pairs = _own_pairs(mj_model)
    # A body with several joints is the link of the last one; the others have no mass.
    links = link_bodies(mj_model)
    link = np.concatenate(links)
    joint = np.repeat(np.arange(len(links)), [len(x) for x in links])
    heavy = mj_model.body_mass[link] > 0.0
    link, joint = link[heavy], joint[heavy]
    share = mj_model.body_mass[link] / link_masses(mj_model)[joint]
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
        Edit("link_mass", "body_mass", link, share, joint),
        Edit("paddle_position", "geom_pos", addresses.paddle_geom),
        Edit("paddle_rotation", "geom_quat", addresses.paddle_geom),
        Edit("gravity", "opt.gravity", slice(None)),
    )


class EditedModel:
    """A compiled model with new numbers in some entries.

    `model["dof_damping", 2]` is a number, `model["geom_pos", 3]` a tuple of numbers: Python floats,
    or scalars where they were edited. Reading is recorded.
    """

    def __init__(self, mj_model: mujoco.MjModel):
        self.model, self.addresses = mj_model, find_addresses(mj_model)
        self.fields: dict[str, list[Scalar]] = {}
        """All entries, in C order, of each field that is edited or follows from edited ones."""
        self._edited: dict[str, set[int]] = {}
        self._read: dict[str, set[int]] = {}

    def __getitem__(self, key: tuple) -> Any:
        field, *index = key
        if field not in self.fields:
            found = self._own(field)[tuple(index)].tolist()
            return tuple(found) if isinstance(found, list) else found
        places = self.places(field, tuple(index))
        self._read.setdefault(field, set()).update(places.ravel().tolist())
        values = tuple(self.fields[field][place] for place in places.ravel())
        return values if places.ndim else values[0]

    def put(self, field: str, index: Any, values: Sequence[Scalar]) -> None:
        """Edits entries."""
        places = self.places(field, index).ravel().tolist()
        self._set(field, dict(zip(places, values, strict=True)))
        self._edited.setdefault(field, set()).update(places)

    def follow(self, field: str, index: Any, values: Sequence[Scalar]) -> None:
        """Sets entries that follow from edited ones, where they are not edited themselves."""
        given = dict(zip(self.places(field, index).ravel().tolist(), values, strict=True))
        own = self._edited.get(field, set())
        self._set(field, {place: value for place, value in given.items() if place not in own})

    def places(self, field: str, index: Any) -> np.ndarray:
        """Positions of entries in the field's C order."""
        own = self._own(field)
        return np.asarray(np.arange(own.size).reshape(own.shape)[index])

    def rows(self, field: str) -> list[int]:
        """First indices of the edited entries of a field."""
        length = max(1, math.prod(self._own(field).shape[1:]))
        return sorted({place // length for place in self._edited.get(field, ())})

    def unread(self) -> list[str]:
        """Names of the edited entries that nothing has read."""
        return [
            f"{field}[{', '.join(map(str, np.unravel_index(place, self._own(field).shape)))}]"
            for field, places in self._edited.items()
            for place in sorted(places - self._read.get(field, set()))
        ]

    def array(self, field: str) -> Array:
        """The field's array; a NumPy array without traced entries."""
        own, values = self._own(field), self.fields[field]
        if not any(isinstance(value, jax.Array) for value in values):
            return np.reshape(np.array(values, own.dtype), own.shape)
        dtype = jnp.result_type(float)
        return jnp.stack([jnp.asarray(x, dtype) for x in values]).reshape(own.shape)

    def inertia(self, body: int) -> tuple[Scalar, Scalar, Scalar]:
        """Principal inertia of a body that follows its mass and, of a ball, its radius."""
        ratio: Scalar = 1.0
        if self.inertia_follows(body):
            ratio = mul(self["body_mass", body], 1.0 / self.model.body_mass[body].item())
        for ball in self.addresses.balls:
            if ball.body == body and ball.geom in self.rows("geom_size"):
                radius = self.model.geom_size[ball.geom, 0].item()
                growth = mul(self["geom_size", ball.geom, 0], 1.0 / radius)
                ratio = mul(ratio, mul(growth, growth))
        return scale(tuple(self.model.body_inertia[body].tolist()), ratio)

    def inertia_follows(self, body: int) -> bool:
        """Whether the inertia of a body is in proportion to an edited mass."""
        follows = body in self.rows("body_mass") and body not in self.rows("body_inertia")
        return follows and self.model.body_mass[body] > 0.0

    def inverse_weight(self, body: int) -> Scalar:
        """Translational inverse inertia of a body at the reference pose, 1/kg; that of a ball
        follows its mass."""
        own = self["body_invweight0", body, 0]
        if body not in [ball.body for ball in self.addresses.balls]:
            return own
        if body in self.rows("body_invweight0") or body not in self.rows("body_mass"):
            return own
        return own * self.model.body_mass[body].item() / self["body_mass", body]

    def derive(self) -> "EditedModel":
        """The model, with the fields that MuJoCo's compiler derives from edited ones and that the
        fused engine does without."""
        masses, sizes = self.rows("body_mass"), self.rows("geom_size")
        for body in masses:
            self.follow("body_inertia", body, self.inertia(body))
        for ball in self.addresses.balls:
            inertia = self.inertia(ball.body)
            if ball.geom in sizes:
                radius = self["geom_size", ball.geom, 0]
                self.follow("geom_rbound", ball.geom, [radius])
                self.follow("geom_aabb", (ball.geom, slice(3, 6)), [radius] * 3)
            if ball.geom in sizes or ball.body in masses:
                self.follow("body_inertia", ball.body, inertia)
                weight = self.model.body_invweight0[ball.body, 1].item()
                turning = weight * self.model.body_inertia[ball.body, 0].item() / inertia[0]
                self.follow("body_invweight0", ball.body, (self.inverse_weight(ball.body), turning))
                # MuJoCo stores the constant inertia matrix of a free body in the model.
                mass = self["body_mass", ball.body]
                self.follow("dof_M0", np.array(ball.qvel), (mass,) * 3 + inertia)
        if masses:
            # MuJoCo numbers parents before children.
            total = list(self["body_mass", slice(None)])
            for body in range(self.model.nbody - 1, 0, -1):
                parent = self.model.body_parentid[body]
                total[parent] = add(total[parent], total[body])
            self.follow("body_subtreemass", slice(None), total)
        return self

    def _own(self, field: str) -> np.ndarray:
        return _field(self.model, field)

    def _set(self, field: str, values: dict[int, Scalar]) -> None:
        entries = self.fields.setdefault(field, self._own(field).ravel().tolist())
        for place, value in values.items():
            entries[place] = value


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
    if p.contact_friction is not None:
        contact_pairs(mj_model)
    for edit in edits(mj_model):
        value = getattr(p, edit.parameter)
        if value is None:
            continue
        numbers = value if isinstance(value, tuple | list) else (value,)
        count = m.places(edit.field, edit.index).size
        of = range(count) if edit.of is None else edit.of
        scales = np.broadcast_to(edit.scale, count).tolist()
        each = [numbers[i if len(numbers) > 1 else 0] for i in of]
        m.put(edit.field, edit.index, list(map(mul, each, scales)))
    for name, value in (p.entries or {}).items():
        m.put(*_entry(m, name), [value])
    _set_flags(m)
    return m


def _entry(m: EditedModel, name: str) -> tuple[str, tuple[int, ...]]:
    """Field and index of a name like `geom_size[3, 0]`.

    Raises:
      UserError: the model has no such entry.
    """
    field, _, inner = name.removesuffix("]").partition("[")
    try:
        index = tuple(int(number) for number in inner.split(",") if number)
        if m.places(field, index).ndim == 0:
            return field, index
    except (AttributeError, ValueError, IndexError):
        pass
    raise UserError(
        f"{name} is no entry of an MjModel; give a field with the index of one number, such as "
        "dof_damping[2]"
    )


def _set_flags(m: EditedModel) -> None:
    """Sets what an edit needs in order to act. The friction of geoms acts as in a contact without a
    pair, and of other geoms than a pair's, only that of those that collide would."""
    rough, pairs = set(m.rows("geom_friction")), set(m.rows("pair_friction"))
    for pair in _own_pairs(m.model):
        geoms = [int(m.model.pair_geom1[pair]), int(m.model.pair_geom2[pair])]
        if pair in pairs or not rough.intersection(geoms):
            continue
        first, second = (m["geom_friction", geom][0] for geom in geoms)
        ranks = m.model.geom_priority[geoms]
        larger = first if ranks[0] > ranks[1] else second
        if ranks[0] == ranks[1]:
            larger = maximum(first, second)
        m.follow("pair_friction", (pair, slice(0, 2)), [larger] * 2)
        pairs.add(pair)
        for geom in rough:
            if not m.model.geom_contype[geom] and not m.model.geom_conaffinity[geom]:
                m["geom_friction", geom]
    for pair in pairs:
        m.follow("pair_dim", pair, [max(3, int(m.model.pair_dim[pair]))])
    for servo in m.rows("actuator_forcerange"):
        m.follow("actuator_forcelimited", servo, [True])
    # MuJoCo skips the transformation of a geom flagged as sharing its body's frame.
    for geom in {*m.rows("geom_pos"), *m.rows("geom_quat")}:
        m.follow("geom_sameframe", geom, [int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)])


def edited_model(mj_model: mujoco.MjModel, parameters: PhysicsParameters) -> mujoco.MjModel:
    """Copy of the model with the parameters of one environment, for MuJoCo's C engine.

    Raises:
      UserError: an array does not have the shape of its field.
    """
    check_shapes(parameters, len(find_addresses(mj_model).arm_joints))
    numbers = jax.tree.map(lambda x: np.asarray(x, np.float64).tolist(), parameters)
    m, model = edited(mj_model, numbers).derive(), copy.copy(mj_model)
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
        values = _field(m, edit.field)[edit.index] / edit.scale
        own.setdefault(edit.parameter, np.array(values))
    servos = list(find_addresses(m).actuators)
    least = np.min(np.abs(m.actuator_forcerange[servos]), axis=1)
    own["force_limit"] = np.where(m.actuator_forcelimited[servos], least, np.inf)
    own["link_mass"] = link_masses(m)
    own |= {name: own[name][0] for name in ("ball_mass", "ball_radius")}
    own |= dict.fromkeys(("contact_stiffness", "contact_damping", "contact_friction"))
    return PhysicsParameters(**own)


def ball_radius(mj_model: mujoco.MjModel, parameters: PhysicsParameters) -> Scalar:
    """Radius of the first ball in the world of one environment, m."""
    geom, given = find_addresses(mj_model).ball_geom, parameters.ball_radius
    own = mj_model.geom_size[geom, 0] if given is None else given
    return (parameters.entries or {}).get(f"geom_size[{geom}, 0]", own)


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
    """k and b of the contact pair's `solref` in MuJoCo's direct format."""
    solref = mj_model.pair_solref[contact_pairs(mj_model)[0]]
    stiffness, damping = to_direct_solref(solref, mj_model.opt.timestep)
    return float(stiffness), float(damping)


def contact_pairs(mj_model: mujoco.MjModel) -> list[int]:
    """Indices of the contact pairs of balls and the paddle, the first ball's with the paddle first.

    Raises:
      UserError: it has no pair.
    """
    pairs = _own_pairs(mj_model)
    if not pairs:
        raise UserError(
            "the MJCF has no contact pair of the ball and the paddle, which contact_stiffness, "
            "contact_damping and contact_friction change; add <pair> to <contact>"
        )
    return pairs


def _own_pairs(mj_model: mujoco.MjModel) -> list[int]:
    """`contact_pairs`; none if the first ball's with the paddle is missing."""
    addresses = find_addresses(mj_model)
    geoms = {addresses.paddle_geom, *(ball.geom for ball in addresses.balls)}
    both = zip(mj_model.pair_geom1.tolist(), mj_model.pair_geom2.tolist(), strict=True)
    pairs = [set(pair) for pair in both]
    first = {addresses.paddle_geom, addresses.ball_geom}
    own = [i for i, pair in enumerate(pairs) if pair <= geoms] if first in pairs else []
    return sorted(own, key=lambda i: pairs[i] != first)
