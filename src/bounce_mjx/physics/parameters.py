"""Physics parameters: the numbers of a model that may differ between environments."""

import copy
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.robot.arm import raise_solver_limits
from bounce_mjx.robot.model import Addresses, find_addresses, to_direct_solref

Array = np.ndarray | jax.Array
# MuJoCo's mjMINMU: its C engine computes with no smaller coefficient of friction.
MIN_FRICTION = 1e-5


class PhysicsParameters(NamedTuple):
    """Physics parameters of one environment; None keeps the model's own value.

    Every engine replaces the model's value by the given one; the reference is `mj_step` on the
    model returned by `edited_model`. Quantities of the n acting joints and their links are in the
    order of `Addresses.arm_joints`. `jax.vmap` batches the arrays.
    """

    ball_mass: Array | None = None
    """Mass [] of each ball, kg; its inertia scales in proportion."""
    ball_radius: Array | None = None
    """Radius [] of each ball, m; its mass stays the same, its inertia scales with the square."""
    contact_stiffness: Array | None = None
    """Stiffness [] of the contacts, 1/s^2: k of MuJoCo's direct `solref="-k -b"`."""
    contact_damping: Array | None = None
    """Damping [] of the contacts, 1/s: b of `solref="-k -b"`."""
    contact_friction: Array | None = None
    """Coefficient [] of sliding friction between ball and paddle, and between balls; it turns a
    frictionless pair into one with `condim="3"`."""
    servo_gain: Array | None = None
    """Stiffness [n] of the position servos, N m/rad: `kp`."""
    servo_damping: Array | None = None
    """Damping [n] of the position servos, N m s/rad: `kv`."""
    force_limit: Array | None = None
    """Force limits [n] of the position servos, N m: a symmetric `forcerange`."""
    armature: Array | None = None
    """Rotor inertia [n] at the joints, kg m^2."""
    damping: Array | None = None
    """Viscous damping [n] of the joints, N m s/rad."""
    frictionloss: Array | None = None
    """Dry friction [n] of the joints, N m; the mjx engine refuses it."""
    link_mass: Array | None = None
    """Masses [n] of the links, kg; first moment and inertia scale in proportion, the centre of mass
    stays in place."""
    paddle_position: Array | None = None
    """Centre [3] of the paddle in the frame of its body, m."""
    paddle_rotation: Array | None = None
    """Orientation [4] of the paddle in the frame of its body: a unit quaternion w, x, y, z."""
    gravity: Array | None = None
    """Gravitational acceleration [3] in the world, m/s^2."""


MODEL_PARAMETERS = PhysicsParameters()
"""The model's own parameters: no value is replaced."""


def shapes(num_joints: int) -> PhysicsParameters:
    """Shape of each parameter for one environment."""
    per_joint = "servo_gain servo_damping force_limit armature damping frictionloss link_mass"
    sizes = dict.fromkeys(per_joint.split(), num_joints)
    sizes |= {"paddle_position": 3, "paddle_rotation": 4, "gravity": 3}
    names = PhysicsParameters._fields
    return PhysicsParameters(*((sizes[name],) if name in sizes else () for name in names))


def check_shapes(parameters: PhysicsParameters, num_joints: int) -> None:
    """Checks the shapes of one environment's parameters.

    Raises:
      UserError: an array does not have the shape of its field.
    """
    for name, value, shape in zip(parameters._fields, parameters, shapes(num_joints), strict=True):
        if value is not None and jnp.shape(value) != shape:
            raise UserError(
                f"the physics parameter {name} has the shape {jnp.shape(value)}; give an array of "
                f"the shape {shape} for one environment, and batch environments with jax.vmap"
            )


def edited_fields(
    mj_model: mujoco.MjModel, parameters: PhysicsParameters
) -> tuple[dict[str, Array], dict[str, Array]]:
    """New arrays for the fields of a `MjModel` and of its `opt`.

    NumPy parameters give NumPy arrays, for MuJoCo's C engine; traced ones give JAX arrays, for MJX.

    `body_invweight0` scales the softness of the contact and follows the ball's mass. The last
    link's share of the softness, a thousandth of the sum, keeps its value of the unedited model. So
    does `dof_invweight0`, which scales the softness of dry friction.
    """
    edited = _Fields(mj_model)
    _edit_balls(edited, parameters)
    _edit_contacts(edited, parameters)
    _edit_links(edited, parameters)
    p, addresses = parameters, edited.addresses
    for name, field, index, sign in entries(addresses):
        if (value := getattr(p, name)) is not None:
            edited.put(field, index, sign * value)
    if p.force_limit is not None:
        edited.put("actuator_forcelimited", np.array(addresses.actuators), True)
    if p.ball_mass is not None or p.link_mass is not None:
        mass = edited.current("body_mass")
        edited.fields["body_subtreemass"] = _subtree_masses(mj_model, mass)
    if p.paddle_position is not None or p.paddle_rotation is not None:
        # MuJoCo skips the transformation of a geom flagged as sharing its body's frame.
        without = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)
        edited.put("geom_sameframe", addresses.paddle_geom, without)
    return edited.fields, {} if p.gravity is None else {"gravity": p.gravity}


class _Fields:
    """New arrays for some fields of a model."""

    def __init__(self, mj_model: mujoco.MjModel):
        self.model, self.addresses = mj_model, find_addresses(mj_model)
        self.fields: dict[str, Array] = {}

    def current(self, field: str) -> Array:
        return self.fields.get(field, getattr(self.model, field))

    def put(self, field: str, index, value) -> None:
        self.fields[field] = _replaced(self.current(field), index, value)

    def scale(self, field: str, index, factor) -> None:
        self.put(field, index, self.current(field)[index] * factor)


def _edit_balls(edited: _Fields, p: PhysicsParameters) -> None:
    m = edited.model
    for ball in edited.addresses.balls:
        if p.ball_mass is not None:
            ratio = p.ball_mass / m.body_mass[ball.body]
            edited.put("body_mass", ball.body, p.ball_mass)
            edited.scale("body_inertia", ball.body, ratio)
            edited.scale("body_invweight0", ball.body, 1.0 / ratio)
        if p.ball_radius is not None:
            ratio = (p.ball_radius / m.geom_size[ball.geom, 0]) ** 2
            edited.put("geom_size", (ball.geom, 0), p.ball_radius)
            edited.put("geom_rbound", ball.geom, p.ball_radius)
            edited.put("geom_aabb", (ball.geom, slice(3, 6)), p.ball_radius)
            edited.scale("body_inertia", ball.body, ratio)
            edited.scale("body_invweight0", (ball.body, 1), 1.0 / ratio)
        if p.ball_mass is not None or p.ball_radius is not None:
            # MuJoCo stores the constant inertia matrix of a free body, here the ball, in the model.
            mass, inertia = (edited.current(x)[ball.body] for x in ("body_mass", "body_inertia"))
            edited.put("dof_M0", np.array(ball.qvel[:3]), mass)
            edited.put("dof_M0", np.array(ball.qvel[3:]), inertia)


def _edit_contacts(edited: _Fields, p: PhysicsParameters) -> None:
    if p.contact_stiffness is None and p.contact_damping is None and p.contact_friction is None:
        return
    m = edited.model
    for pair in contact_pairs(m):
        if p.contact_stiffness is not None or p.contact_damping is not None:
            stiffness, damping = to_direct_solref(m.pair_solref[pair], m.opt.timestep)
            edited.put("pair_solref", (pair, 0), -_given(p.contact_stiffness, float(stiffness)))
            edited.put("pair_solref", (pair, 1), -_given(p.contact_damping, float(damping)))
        if p.contact_friction is not None:
            edited.put("pair_dim", pair, max(3, int(m.pair_dim[pair])))
            numpy = jnp if isinstance(p.contact_friction, jax.Array) else np
            friction = numpy.maximum(p.contact_friction, MIN_FRICTION)
            edited.put("pair_friction", (pair, slice(0, 2)), friction)


def _edit_links(edited: _Fields, p: PhysicsParameters) -> None:
    if p.link_mass is None:
        return
    m, links = edited.model, link_bodies(edited.model)
    bodies = np.concatenate(links)
    joints = np.repeat(np.arange(len(links)), [len(link) for link in links])
    moved = m.body_mass[bodies] > 0.0
    bodies, joints = bodies[moved], joints[moved]
    mass, old_mass = p.link_mass[joints], link_masses(m)[joints]
    edited.put("body_mass", bodies, mass * (m.body_mass[bodies] / old_mass))
    edited.scale("body_inertia", bodies, (mass / old_mass)[:, None])


def entries(addresses: Addresses) -> tuple[tuple[str, str, Any, float], ...]:
    """The entries of a model that hold a parameter as it is, up to its sign: the parameter, the
    model's field, the index in it and the sign. Where several hold one, the first is read."""
    dofs, servos = np.array(addresses.arm_qvel), np.array(addresses.actuators)
    return (
        ("servo_gain", "actuator_gainprm", (servos, 0), 1.0),
        ("servo_gain", "actuator_biasprm", (servos, 1), -1.0),
        ("servo_damping", "actuator_biasprm", (servos, 2), -1.0),
        ("force_limit", "actuator_forcerange", (servos, 1), 1.0),
        ("force_limit", "actuator_forcerange", (servos, 0), -1.0),
        ("armature", "dof_armature", dofs, 1.0),
        ("damping", "dof_damping", dofs, 1.0),
        ("frictionloss", "dof_frictionloss", dofs, 1.0),
        ("paddle_position", "geom_pos", addresses.paddle_geom, 1.0),
        ("paddle_rotation", "geom_quat", addresses.paddle_geom, 1.0),
    )


def edited_model(mj_model: mujoco.MjModel, parameters: PhysicsParameters) -> mujoco.MjModel:
    """Copy of the model with the parameters of one environment.

    Raises:
      UserError: an array does not have the shape of its field.
    """
    check_shapes(parameters, len(find_addresses(mj_model).arm_joints))
    numbers = jax.tree.map(lambda x: np.asarray(x, np.float64), parameters)
    fields, options = edited_fields(mj_model, numbers)
    model = copy.copy(mj_model)
    _assign(model, fields)
    _assign(model.opt, options)
    if parameters.frictionloss is not None:
        raise_solver_limits(model.opt)
    return model


def link_bodies(mj_model: mujoco.MjModel) -> tuple[np.ndarray, ...]:
    """Bodies of each acting joint's link: the joint's body and the bodies welded to it. A body with
    several joints belongs to the last one, and the others have no bodies."""
    m = mj_model
    last_joint = (m.body_jntadr + m.body_jntnum - 1)[m.body_weldid]
    return tuple(np.flatnonzero(last_joint == j) for j in find_addresses(m).arm_joints)


def link_masses(mj_model: mujoco.MjModel) -> np.ndarray:
    """Masses [n] of the acting joints' links, kg."""
    return np.array([np.sum(mj_model.body_mass[bodies]) for bodies in link_bodies(mj_model)])


def direct_solref(mj_model: mujoco.MjModel) -> tuple[float, float]:
    """k and b of the contact pair's `solref` in MuJoCo's direct format."""
    solref = mj_model.pair_solref[contact_pair(mj_model)]
    stiffness, damping = to_direct_solref(solref, mj_model.opt.timestep)
    return float(stiffness), float(damping)


def contact_pair(mj_model: mujoco.MjModel) -> int:
    """Index of the contact pair of the first ball and the paddle."""
    return contact_pairs(mj_model)[0]


def contact_pairs(mj_model: mujoco.MjModel) -> list[int]:
    """Indices of the contact pairs of balls and the paddle, the first ball's with the paddle first.

    Raises:
      UserError: it has no pair.
    """
    addresses = find_addresses(mj_model)
    geoms = {addresses.paddle_geom, *(ball.geom for ball in addresses.balls)}
    both = zip(mj_model.pair_geom1.tolist(), mj_model.pair_geom2.tolist(), strict=True)
    pairs = [set(pair) for pair in both]
    first = {addresses.paddle_geom, addresses.ball_geom}
    if first not in pairs:
        raise UserError(
            "the MJCF has no contact pair of the ball and the paddle, which contact_stiffness, "
            "contact_damping and contact_friction change; add <pair> to <contact>"
        )
    own = [i for i, pair in enumerate(pairs) if pair <= geoms]
    return sorted(own, key=lambda i: pairs[i] != first)


def _given(value: Array | None, default: float) -> Array | float:
    return default if value is None else value


def _replaced(array: Array, index, value) -> Array:
    """Copy of the array with new entries at an index."""
    if isinstance(array, jax.Array) or isinstance(value, jax.Array):
        return jnp.asarray(array).at[index].set(value)
    array = np.array(array)
    array[index] = value
    return array


def _subtree_masses(mj_model: mujoco.MjModel, mass: Array) -> Array:
    """Mass of each body's subtree; MuJoCo numbers parents before children."""
    total = list(mass)
    for body in range(mj_model.nbody - 1, 0, -1):
        parent = mj_model.body_parentid[body]
        total[parent] = total[parent] + total[body]
    return (jnp if isinstance(mass, jax.Array) else np).stack(total)


def _assign(target: object, fields: Mapping[str, Array]) -> None:
    for name, value in fields.items():
        getattr(target, name)[...] = value
