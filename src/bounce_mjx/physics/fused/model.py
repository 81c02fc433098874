"""Model of the fused engine, read from an MJCF with the parameters of one environment."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.physics.edited import EditedModel, edited, edits
from bounce_mjx.physics.fused import chain
from bounce_mjx.physics.fused.contact import ContactModel
from bounce_mjx.physics.parameters import MODEL_PARAMETERS, PhysicsParameters
from bounce_mjx.physics.scalars import (
    IDENTITY3,
    ZERO3,
    ZERO_MATRIX3,
    Mat,
    Scalar,
    Vec,
    add,
    congruence,
    diagonal,
    is_constant,
    is_zero,
    mul,
    quaternion_matrix,
    sub,
    symmetric,
)
from bounce_mjx.robot.model import (
    Addresses,
    BallAddresses,
    balls_of_pair,
    find_addresses,
    fingerprint,
    link_bodies,
)


class Frame(NamedTuple):
    """Position (m) and orientation of one frame in another."""

    origin: Vec = ZERO3
    rotation: Mat = IDENTITY3


@dataclasses.dataclass(frozen=True)
class Servo:
    """A servo. On a joint with position q and velocity v it exerts, in N m or N,

    gain * ctrl + bias + force_per_position * q + force_per_velocity * v

    The last two are those of MuJoCo's `biasprm`: -kp and -kv for a servo that holds.
    """

    gain: Scalar
    bias: Scalar
    force_per_position: Scalar
    force_per_velocity: Scalar
    ctrl_range: tuple[Scalar, Scalar] | None
    """Range to which ctrl is clipped; None for none."""
    force_range: tuple[Scalar, Scalar] | None = None
    """Range of the servo's force at the joint (`forcerange`)."""
    joint_range: tuple[float, float] | None = None
    """Range of all forces of actuators at the joint (`actuatorfrcrange`)."""
    carries_weight: bool = False
    """Whether the gravity compensation counts as a force of an actuator (`actuatorgravcomp`)."""


@dataclasses.dataclass(frozen=True)
class BallModel:
    """A homogeneous ball."""

    radius: Scalar
    """Radius, m."""
    mass: Scalar
    """Mass, kg."""
    inertia: Scalar
    """Inertia about any axis through its centre, kg m^2."""
    weight: float = 1.0
    """Share of its weight that acts on it."""


@dataclasses.dataclass(frozen=True)
class FusedModel:
    """Model of the fused engine, in SI units: constants, which fold while tracing, and scalars in
    place of those that the parameters of an environment change. That of `make_engine` is never
    stepped: each program reads the model again, with its parameters."""

    dt: float
    """Physics step, s."""
    gravity: Vec
    """Gravitational acceleration in the world's frame, m/s^2."""
    links: tuple[chain.Link, ...]
    servos: tuple[Servo, ...]
    """In the order of the joints."""
    paddle: Frame
    """Centre and orientation of the paddle in the frame of the last link."""
    paddle_half_size: Vec
    """Half sizes of the paddle, m."""
    balls: tuple[BallModel, ...]
    contacts: tuple[ContactModel, ...]
    """The contact of each ball with the paddle, then those of two balls."""
    addresses: Addresses
    mj_model: mujoco.MjModel = dataclasses.field(repr=False, compare=False)
    """Source of the model, to be read again with each environment's parameters."""
    fingerprint: bytes = b""
    """Hash of the source, so that models of equal sources are equal, as keys of the programs in
    `dynamics.py`; empty with parameters."""
    implicit_servos: bool = True
    """Whether the integrator is implicit in the servos' damping (implicitfast), or not (Euler)."""
    implicit_damping: bool = True
    """Whether the integrator is implicit in the joints' damping."""


def read_model(
    mj_model: mujoco.MjModel,
    parameters: PhysicsParameters = MODEL_PARAMETERS,
    addresses: Addresses | None = None,
) -> FusedModel:
    """Reads a compiled model that the engine supports (`physics/support.py`), with the parameters
    of one environment.

    Args:
      mj_model: the model.
      parameters: numbers, or tuples of numbers: Python floats or scalars.
      addresses: of the model's parts, if they are known.

    Raises:
      UserError: the engine does not read an entry that the parameters change.
    """
    addresses = addresses or find_addresses(mj_model)
    model = edited(mj_model, addresses, parameters)
    _check_entries(model)
    links, frames = _read_links(model)
    servos = []
    for actuator, joint in zip(addresses.actuators, addresses.arm_joints, strict=True):
        servos.append(_read_servo(model, actuator, joint))
    is_implicit = mj_model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    eulerdamp = _is_on(mj_model, mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    has_parameters = bool(jax.tree.leaves(parameters))
    return FusedModel(
        dt=float(mj_model.opt.timestep),
        gravity=model["opt.gravity", :],
        links=tuple(links),
        servos=tuple(servos),
        paddle=_read_paddle(model, frames),
        paddle_half_size=model["geom_size", addresses.paddle_geom],
        balls=tuple(_read_ball(model, ball) for ball in addresses.balls),
        contacts=_read_contacts(model),
        addresses=addresses,
        mj_model=mj_model,
        fingerprint=b"" if has_parameters else fingerprint(mj_model),
        implicit_servos=is_implicit,
        implicit_damping=is_implicit or eulerdamp,
    )


def variable_entries(mj_model: mujoco.MjModel, addresses: Addresses) -> tuple[tuple[str, Any], ...]:
    """What may differ between environments: fields of a model, each with the index of the entries
    that the functions below read. They read the rest of the model as constants.

    An entry that is read but missing here is refused; one that is here but not read would be
    ignored: `test_parameters.py` changes each and looks for its effect.
    """
    balls = [ball.body for ball in addresses.balls]
    bodies = [body for body in range(1, mj_model.nbody) if mj_model.body_weldid[body] not in balls]
    links = list(itertools.chain.from_iterable(link_bodies(mj_model, addresses)))
    joints = list(addresses.arm_joints)
    paddle = addresses.paddle_geom
    paddle_body = int(mj_model.geom_bodyid[paddle])
    positions = list(addresses.arm_qpos)
    servos = list(addresses.actuators)
    limited = [servo for servo in servos if mj_model.actuator_ctrllimited[servo]]
    entries = [(edit.field, edit.index) for edit in edits(mj_model, addresses)]
    entries += [
        ("body_pos", bodies),
        ("body_mass", links),
        ("body_inertia", links),
        ("body_invweight0", ([paddle_body, *balls], 0)),
        ("geom_size", paddle),
        ("qpos0", positions),
        ("actuator_biasprm", (servos, 0)),
        ("actuator_ctrlrange", limited),
    ]
    # Where a flag of the MJCF turns a feature off, its numbers act in no engine. The parameter
    # `frictionloss` may be given all the same, as in MuJoCo.
    if _is_on(mj_model, mujoco.mjtDisableBit.mjDSBL_SPRING):
        entries.append(("jnt_stiffness", joints))
        entries.append(("qpos_spring", positions))
    if mj_model.ngravcomp:
        entries.append(("body_gravcomp", links))
    return tuple(entries)


def _check_entries(model: EditedModel) -> None:
    """Refuses an edit that the engine would ignore."""
    ignored = model.edited_beside(variable_entries(model.mj_model, model.addresses))
    if ignored:
        raise UserError(
            f"the fused physics cannot vary {ignored[0]} between environments, so a change of it "
            "would have no effect; leave it out"
        )


def _is_on(mj_model: mujoco.MjModel, feature: mujoco.mjtDisableBit) -> bool:
    """Whether the MJCF's flags do not disable a feature."""
    return not mj_model.opt.disableflags & feature


def exact(rotation: Sequence[Sequence[Scalar]]) -> Mat:
    """Rotation matrix; entries within rounding error of -1, 0 and 1 become exact and fold."""

    def entry(x: Scalar) -> Scalar:
        return float(round(x)) if is_constant(x) and abs(x - round(x)) < 1e-12 else x

    return Mat(map(entry, row) for row in rotation)


def _rotation_matrix(quaternion: Sequence[Scalar]) -> Mat:
    """Rotation matrix of a unit quaternion [w, x, y, z]."""
    return exact(quaternion_matrix(quaternion))


def _read_links(model: EditedModel) -> tuple[list[chain.Link], dict[int, Frame]]:
    """Links of the chain, and the frame of each body in its link; bodies that do not move are in
    the frame of the world. Welded bodies belong to the link of the last joint above them."""
    # What is read from `model` may be edited, or has the form that the scalars need; `mj_model`
    # here and below is the model without edits.
    mj_model = model.mj_model
    balls = [ball.body for ball in model.addresses.balls]
    links: list[chain.Link] = []
    frames = {0: Frame()}
    # -1 stands for the world.
    link_of_body = {0: -1}
    for body in range(1, mj_model.nbody):  # parents come before their children
        if mj_model.body_weldid[body] in balls:
            continue
        parent_body = int(mj_model.body_parentid[body])
        parent = frames[parent_body]
        link = link_of_body[parent_body]
        frame = Frame(
            origin=parent.origin + parent.rotation @ model["body_pos", body],
            rotation=exact(parent.rotation @ _rotation_matrix(mj_model.body_quat[body].tolist())),
        )
        first_joint = mj_model.body_jntadr[body]
        for joint in range(first_joint, first_joint + mj_model.body_jntnum[body]):
            anchor = ZERO3 if _slides(mj_model, joint) else model["jnt_pos", joint]
            link = len(links)
            origin = frame.origin + frame.rotation @ anchor
            links.append(_read_joint(model, joint, Frame(origin, frame.rotation)))
            # From here on the frame is given in the new link.
            frame = Frame(-anchor)
        frames[body] = frame
        link_of_body[body] = link
        if link >= 0:
            links[link] = _with_body(model, links[link], body, frame)
    return links, frames


def _slides(mj_model: mujoco.MjModel, joint: int) -> bool:
    return bool(mj_model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE)


def _read_joint(model: EditedModel, joint: int, frame: Frame) -> chain.Link:
    """Link without mass behind a joint, whose frame is given in the parent link."""
    mj_model = model.mj_model
    dof = mj_model.jnt_dofadr[joint]
    position = mj_model.jnt_qposadr[joint]
    springs = _is_on(mj_model, mujoco.mjtDisableBit.mjDSBL_SPRING)
    dry_friction = _is_on(mj_model, mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS)
    dmin, dmax = _impedance_limits(mj_model.dof_solimp[dof, :2])
    _, friction_damping = model.stiffness_and_damping("dof", dof)
    return chain.Link(
        offset=frame.origin,
        rotation=frame.rotation,
        axis=model["jnt_axis", joint],
        slides=_slides(mj_model, joint),
        zero_position=model["qpos0", position],
        mass=0.0,
        first_moment=ZERO3,
        inertia=ZERO_MATRIX3,
        armature=model["dof_armature", dof],
        # Whatever the flags: `physics.support` refuses the flag damper.
        damping=model["dof_damping", dof],
        stiffness=model["jnt_stiffness", joint] if springs else 0.0,
        spring_position=model["qpos_spring", position],
        frictionloss=model["dof_frictionloss", dof] if dry_friction else 0.0,
        # At the distance 0, where the impedance is dmin.
        friction_regulariser=float((1.0 - dmin) / dmin * mj_model.dof_invweight0[dof]),
        # As in `_read_contact`.
        friction_damping=float(friction_damping / dmax),
    )


def _with_body(model: EditedModel, link: chain.Link, body: int, frame: Frame) -> chain.Link:
    """Link with the mass of one more body, whose frame is given in the link."""
    mass = model["body_mass", body]
    inertial = _inertial_frame(model, body)
    centre = frame.origin + frame.rotation @ inertial.origin
    principal = frame.rotation @ inertial.rotation
    lever = centre @ centre
    about_centre = congruence(principal, diagonal(model["body_inertia", body]))

    def about_origin(i: int, j: int) -> Scalar:
        shift = sub(lever if i == j else 0.0, mul(centre[i], centre[j]))
        return add(link.inertia[i][j], add(about_centre[i][j], mul(shift, mass)))

    moment = centre * mass
    carried_share = _carried_share(model, body)
    return dataclasses.replace(
        link,
        mass=add(link.mass, mass),
        first_moment=link.first_moment + moment,
        inertia=symmetric(about_origin),
        floating_mass=add(link.floating_mass, mul(mass, carried_share)),
        floating_moment=link.floating_moment + moment * carried_share,
    )


def _carried_share(model: EditedModel, body: int) -> Scalar:
    """Share of a body's weight that `gravcomp` carries. MuJoCo ignores negative shares if none is
    positive, which `ngravcomp` counts."""
    return model["body_gravcomp", body] if model.mj_model.ngravcomp else 0.0


def _inertial_frame(model: EditedModel, body: int) -> Frame:
    """Inertial frame of a body in the body's frame."""
    rotation = _rotation_matrix(model.mj_model.body_iquat[body].tolist())
    frame = Frame(model["body_ipos", body], rotation)
    return _apply_flag(model.mj_model.body_sameframe[body], frame, frame)


def _read_paddle(model: EditedModel, frames: dict[int, Frame]) -> Frame:
    """Frame of the paddle in the last link, from the frames of the bodies."""
    geom = model.addresses.paddle_geom
    body = int(model.mj_model.geom_bodyid[geom])
    in_body = Frame(model["geom_pos", geom], _rotation_matrix(model["geom_quat", geom]))
    same_frame = model["geom_sameframe", geom]
    in_body = _apply_flag(same_frame, in_body, _inertial_frame(model, body))
    body_frame = frames[body]
    return Frame(
        origin=body_frame.origin + body_frame.rotation @ in_body.origin,
        rotation=exact(body_frame.rotation @ in_body.rotation),
    )


def _read_ball(model: EditedModel, ball: BallAddresses) -> BallModel:
    # The inertia follows the mass and the radius (`physics.edited`). An entry of the inertia alone,
    # or of the gravity compensation, is no variable one.
    return BallModel(
        radius=model["geom_size", ball.geom, 0],
        mass=model["body_mass", ball.body],
        inertia=model["body_inertia", ball.body, 0],
        weight=1.0 - _carried_share(model, ball.body),
    )


def _apply_flag(same: int, frame: Frame, inertial: Frame) -> Frame:
    """A frame in its body's frame. Where it is almost the same as that one, or as the body's
    inertial one, MuJoCo has a flag and computes as if they were the same."""
    flag = mujoco.mjtSameFrame(int(same))
    if flag == mujoco.mjtSameFrame.mjSAMEFRAME_BODY:
        return Frame()
    if flag == mujoco.mjtSameFrame.mjSAMEFRAME_BODYROT:
        return Frame(frame.origin)
    if flag == mujoco.mjtSameFrame.mjSAMEFRAME_INERTIA:
        return inertial
    if flag == mujoco.mjtSameFrame.mjSAMEFRAME_INERTIAROT:
        return Frame(frame.origin, inertial.rotation)
    return frame


def _read_servo(model: EditedModel, actuator: int, joint: int) -> Servo:
    mj_model = model.mj_model
    gear = float(mj_model.actuator_gear[actuator, 0])
    bias, per_position, per_velocity = model["actuator_biasprm", actuator, :3]
    ctrl_range = None
    if mj_model.actuator_ctrllimited[actuator]:
        ctrl_range = model["actuator_ctrlrange", actuator]
    force_range = None
    if model["actuator_forcelimited", actuator]:
        low, high = model["actuator_forcerange", actuator] * gear
        force_range = (low, high) if gear > 0.0 else (high, low)
    joint_range = None
    if mj_model.jnt_actfrclimited[joint]:
        joint_range = model["jnt_actfrcrange", joint]
    return Servo(
        gain=mul(model["actuator_gainprm", actuator, 0], gear),
        bias=mul(bias, gear),
        force_per_position=mul(per_position, gear**2),
        force_per_velocity=mul(per_velocity, gear**2),
        ctrl_range=ctrl_range,
        force_range=force_range,
        joint_range=joint_range,
        carries_weight=bool(mj_model.jnt_actgravcomp[joint]),
    )


def _read_contacts(model: EditedModel) -> tuple[ContactModel, ...]:
    """The contacts in the order of `FusedModel.contacts`."""
    mj_model = model.mj_model
    contacts = []
    for pair in range(mj_model.npair):
        balls = balls_of_pair(mj_model, model.addresses, pair)
        contacts.append(_read_contact(model, pair, balls))

    def order(contact: ContactModel) -> tuple:
        # Those of one ball are with the paddle.
        return len(contact.balls), contact.balls

    return tuple(sorted(contacts, key=order))


def _read_contact(model: EditedModel, pair: int, balls: tuple[int, ...]) -> ContactModel:
    """The contact of one ball with the paddle, or of two balls."""
    mj_model = model.mj_model
    stiffness, damping = model.stiffness_and_damping("pair", pair)
    solimp = mj_model.pair_solimp[pair]
    dmin, dmax, midpoint = _impedance_limits(solimp[[0, 1, 3]]).tolist()
    power = max(1.0, float(solimp[4]))
    if power.is_integer():
        power = int(power)
    bodies = [model.addresses.balls[i].body for i in balls]
    if len(balls) == 1:
        bodies.insert(0, mj_model.geom_bodyid[model.addresses.paddle_geom])
    friction = model["pair_friction", pair, 0] if model["pair_dim", pair] > 1 else None
    return ContactModel(
        balls=balls,
        # In both formats of a solref, MuJoCo divides k by dmax^2 and b by dmax.
        stiffness=mul(stiffness, 1.0 / dmax**2),
        damping=mul(damping, 1.0 / dmax),
        solimp=(dmin, dmax, float(solimp[2]), midpoint, power),
        inverse_weights=tuple(model["body_invweight0", body, 0] for body in bodies),
        friction=None if is_zero(friction) else friction,
    )


def _impedance_limits(solimp: np.ndarray) -> np.ndarray:
    """Impedances and midpoint of a `solimp` within MuJoCo's limits (mjMINIMP, mjMAXIMP)."""
    return np.clip(solimp, 1e-4, 1.0 - 1e-4)
