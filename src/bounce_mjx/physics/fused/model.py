"""Model of the fused engine: constants of a compiled MJCF, and parameters of one environment."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.physics.fused import chain
from bounce_mjx.physics.fused.contact import ContactModel
from bounce_mjx.physics.fused.frames import Frame, cheapest, exact, floats
from bounce_mjx.physics.fused.scalars import (
    ZERO3,
    Mat3,
    Scalar,
    Vec3,
    matmul,
    matvec,
    mul,
    neg,
    quaternion_matrix,
    scale,
    vadd,
)
from bounce_mjx.physics.parameters import MIN_FRICTION, PhysicsParameters
from bounce_mjx.robot.model import Addresses, BallAddresses, find_addresses

# MuJoCo's mjMINVAL.
_MIN_VALUE = 1e-15


@dataclasses.dataclass(frozen=True)
class Servo:
    """An affine servo. On a joint with position q and velocity v it exerts, in N m or N,

    (gain + gain_stiffness * q + gain_damping * v) * ctrl
    + bias + stiffness * q + damping * v
    """

    gain: Scalar
    bias: float
    stiffness: Scalar
    damping: Scalar
    gear: float
    """Length of the actuator per joint position."""
    ctrl_range: tuple[float, float] | None
    force_range: tuple[Scalar, Scalar] | None = None
    """Range of the servo's force at the joint (`forcerange`)."""
    gain_stiffness: float = 0.0
    gain_damping: float = 0.0
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
    """Model of the fused engine, in SI units.

    `read_model` returns constants, which fold while tracing; `in_world` replaces some of them by
    the scalars of one environment.
    """

    dt: float
    gravity: Vec3
    links: tuple[chain.Link, ...]
    servos: tuple[Servo, ...]
    """In the order of the joints."""
    paddle_origin: Vec3
    """Centre of the paddle in the frame of the last link."""
    paddle_rotation: Mat3
    """Orientation of the paddle in the frame of the last link."""
    paddle_body: Frame
    """The paddle's body in the frame of the last link."""
    paddle_half_size: tuple[float, float, float]
    """Half sizes of the paddle, m."""
    balls: tuple[BallModel, ...]
    contacts: tuple[ContactModel, ...]
    """The contact of each ball with the paddle, then those of two balls."""
    addresses: Addresses
    nq: int
    nv: int
    weight: float = 1.0
    """Share of the links' weight that acts on the arm."""
    implicit_servos: bool = True
    """Whether the integrator is implicit in the servos' damping (implicitfast), or not (Euler)."""
    implicit_damping: bool = True
    """Whether the integrator is implicit in the joints' damping."""
    dry_friction: bool = True
    """Whether the joints' dry friction acts (the flag `frictionloss`)."""
    air_drag: Scalar = 0.0
    """Deceleration of a ball by the air divided by its squared speed, 1/m."""
    air_lift: Scalar = 0.0
    """Acceleration of a ball by the Magnus force divided by the cross product of its spin and
    velocity."""


def read_model(mj_model: mujoco.MjModel) -> FusedModel:
    """Constants of a compiled model that the engine supports (`physics/support.py`)."""
    m, addresses = mj_model, find_addresses(mj_model)
    links, frames = _read_links(m, addresses)
    compensated = _compensated_share(m, addresses)
    if compensated is not None:
        links = [dataclasses.replace(x, floating_mass=0.0, floating_moment=ZERO3) for x in links]
    links, paddle_body = cheapest(links, frames[int(m.geom_bodyid[addresses.paddle_geom])])
    paddle = _geom_frame(m, addresses.paddle_geom)
    implicit = m.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    explicit_damping = m.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    return FusedModel(
        dt=float(m.opt.timestep),
        gravity=floats(m.opt.gravity),
        links=tuple(links),
        servos=tuple(
            _read_servo(m, actuator, joint)
            for actuator, joint in zip(addresses.actuators, addresses.arm_joints, strict=True)
        ),
        paddle_origin=vadd(paddle_body.origin, matvec(paddle_body.rotation, paddle.origin)),
        paddle_rotation=exact(matmul(paddle_body.rotation, paddle.rotation)),
        paddle_body=paddle_body,
        paddle_half_size=floats(m.geom_size[addresses.paddle_geom]),
        balls=tuple(_read_ball(m, ball) for ball in addresses.balls),
        contacts=_read_contacts(m, addresses),
        addresses=addresses,
        nq=m.nq,
        nv=m.nv,
        weight=1.0 - (compensated or 0.0),
        implicit_servos=implicit,
        implicit_damping=implicit or not explicit_damping,
        dry_friction=_has_dry_friction(m),
    )


def in_world(model: FusedModel, parameters: PhysicsParameters) -> FusedModel:
    """Model with the parameters of one environment.

    Args:
      parameters: scalars, or tuples of scalars; None keeps the model's own value.
    """
    p = parameters
    none = (None,) * len(model.links)
    links = zip(
        model.links,
        p.link_mass or none,
        p.armature or none,
        p.damping or none,
        (p.frictionloss if model.dry_friction else None) or none,
        strict=True,
    )
    servos = zip(
        model.servos,
        p.servo_gain or none,
        p.servo_damping or none,
        p.force_limit or none,
        strict=True,
    )
    body, origin, rotation = model.paddle_body, p.paddle_position, p.paddle_rotation
    return dataclasses.replace(
        model,
        gravity=_given(p.gravity, model.gravity),
        links=tuple(_link_in_world(*link) for link in links),
        servos=tuple(_servo_in_world(*servo) for servo in servos),
        paddle_origin=model.paddle_origin
        if origin is None
        else vadd(body.origin, matvec(body.rotation, origin)),
        paddle_rotation=model.paddle_rotation
        if rotation is None
        else matmul(body.rotation, quaternion_matrix(rotation)),
        balls=tuple(_ball_in_world(ball, p) for ball in model.balls),
        contacts=tuple(_contact_in_world(contact, model.balls, p) for contact in model.contacts),
    )


def _ball_in_world(ball: BallModel, p: PhysicsParameters) -> BallModel:
    inertia = ball.inertia
    if p.ball_mass is not None:
        inertia = mul(p.ball_mass, inertia / ball.mass)
    if p.ball_radius is not None:
        ratio = mul(p.ball_radius, 1.0 / ball.radius)
        inertia = mul(inertia, mul(ratio, ratio))
    return dataclasses.replace(
        ball,
        radius=_given(p.ball_radius, ball.radius),
        mass=_given(p.ball_mass, ball.mass),
        inertia=inertia,
    )


def _contact_in_world(
    contact: ContactModel, balls: Sequence[BallModel], p: PhysicsParameters
) -> ContactModel:
    """Contact with the parameters of one environment; `balls` are the model's own."""
    changes: dict[str, Any] = {}
    if p.ball_mass is not None:
        paddle = contact.inverse_weights[: 2 - len(contact.balls)]
        moved = zip(contact.inverse_weights[len(paddle) :], contact.balls, strict=True)
        weights = [mul(weight, balls[i].mass / p.ball_mass) for weight, i in moved]
        changes["inverse_weights"] = (*paddle, *weights)
    if p.contact_friction is not None:
        changes["friction"] = (jnp.maximum(p.contact_friction, MIN_FRICTION),) * 2
    # MuJoCo scales the direct format of solref by the largest impedance.
    max_impedance = contact.solimp[1]
    if p.contact_stiffness is not None:
        changes["stiffness"] = mul(p.contact_stiffness, 1.0 / max_impedance**2)
    if p.contact_damping is not None:
        changes["damping"] = mul(p.contact_damping, 1.0 / max_impedance)
    return dataclasses.replace(contact, **changes)


def _link_in_world(
    link: chain.Link,
    mass: Scalar | None,
    armature: Scalar | None,
    damping: Scalar | None,
    frictionloss: Scalar | None,
) -> chain.Link:
    # A body with several joints is the link of the last one; the others have no mass.
    if mass is not None and link.mass != 0.0:
        ratio = mul(mass, 1.0 / link.mass)
        link = dataclasses.replace(
            link,
            mass=mass,
            first_moment=scale(link.first_moment, ratio),
            inertia=tuple(scale(row, ratio) for row in link.inertia),
            floating_mass=mul(link.floating_mass, ratio),
            floating_moment=scale(link.floating_moment, ratio),
        )
    return dataclasses.replace(
        link,
        armature=_given(armature, link.armature),
        damping=_given(damping, link.damping),
        frictionloss=_given(frictionloss, link.frictionloss),
    )


def _servo_in_world(
    servo: Servo, gain: Scalar | None, damping: Scalar | None, force_limit: Scalar | None
) -> Servo:
    if gain is not None:
        gain = mul(gain, servo.gear)
        servo = dataclasses.replace(servo, gain=gain, stiffness=mul(gain, -servo.gear))
    if damping is not None:
        servo = dataclasses.replace(servo, damping=mul(damping, -(servo.gear**2)))
    if force_limit is not None:
        limit = mul(force_limit, abs(servo.gear))
        servo = dataclasses.replace(servo, force_range=(neg(limit), limit))
    return servo


def _given(value, default):
    return default if value is None else value


def _rotation(quaternion: np.ndarray) -> Mat3:
    """Rotation matrix of a unit quaternion [w, x, y, z]."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return exact(matrix.reshape(3, 3))


def _read_links(
    mj_model: mujoco.MjModel, addresses: Addresses
) -> tuple[list[chain.Link], dict[int, Frame]]:
    """Links of the chain, and the frame of each body in its link; bodies that do not move are in
    the frame of the world. Welded bodies belong to the link of the last joint above them."""
    m = mj_model
    links: list[chain.Link] = []
    frames, link_of = {0: Frame()}, {0: -1}
    for body in range(1, m.nbody):  # parents come before their children
        if m.body_weldid[body] in [ball.body for ball in addresses.balls]:
            continue
        parent, link_of[body] = (x[int(m.body_parentid[body])] for x in (frames, link_of))
        origin = vadd(parent.origin, matvec(parent.rotation, floats(m.body_pos[body])))
        rotation = exact(matmul(parent.rotation, _rotation(m.body_quat[body])))
        frame = Frame(origin, rotation)
        for joint in range(m.body_jntadr[body], m.body_jntadr[body] + m.body_jntnum[body]):
            slides = m.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
            anchor = ZERO3 if slides else floats(m.jnt_pos[joint])
            origin = vadd(frame.origin, matvec(frame.rotation, anchor))
            link_of[body] = len(links)
            links.append(_read_joint(m, joint, Frame(origin, frame.rotation)))
            frame = Frame(scale(anchor, -1.0))
        frames[body] = frame
        if link_of[body] >= 0:
            links[link_of[body]] = _with_body(m, links[link_of[body]], body, frame)
    return links, frames


def _read_joint(mj_model: mujoco.MjModel, joint: int, frame: Frame) -> chain.Link:
    """Link without mass behind a joint, whose frame is given in the parent link."""
    m = mj_model
    dof, at = m.jnt_dofadr[joint], m.jnt_qposadr[joint]
    springs = not m.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_SPRING
    dmin, dmax = _impedance_limits(m.dof_solimp[dof, :2])
    d = dmin if m.dof_solimp[dof, 2] > _MIN_VALUE else 0.5 * (dmin + dmax)
    return chain.Link(
        offset=frame.origin,
        rotation=frame.rotation,
        axis=floats(m.jnt_axis[joint]),
        slides=bool(m.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE),
        zero_position=float(m.qpos0[at]),
        mass=0.0,
        first_moment=ZERO3,
        inertia=(ZERO3,) * 3,
        armature=float(m.dof_armature[dof]),
        damping=float(m.dof_damping[dof]),
        stiffness=float(m.jnt_stiffness[joint]) if springs else 0.0,
        spring_position=float(m.qpos_spring[at]),
        frictionloss=float(m.dof_frictionloss[dof]) if _has_dry_friction(m) else 0.0,
        friction_softness=float((1.0 - d) / d * m.dof_invweight0[dof]),
        friction_damping=_reference_damping(m, m.dof_solref[dof], dmax),
    )


def _with_body(mj_model: mujoco.MjModel, link: chain.Link, body: int, frame: Frame) -> chain.Link:
    """Link with the mass of one more body, whose frame is given in the link."""
    mass = float(mj_model.body_mass[body])
    inertial = _inertial_frame(mj_model, body)
    rotation = np.array(frame.rotation)
    centre = np.array(frame.origin) + rotation @ np.array(inertial.origin)
    principal = rotation @ np.array(inertial.rotation)
    about_centre = principal @ np.diag(mj_model.body_inertia[body]) @ principal.T
    about_origin = about_centre + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    floating = float(_gravity_compensation(mj_model)[body])
    return dataclasses.replace(
        link,
        mass=link.mass + mass,
        first_moment=floats(link.first_moment + mass * centre),
        inertia=tuple(floats(row) for row in link.inertia + about_origin),
        floating_mass=link.floating_mass + floating * mass,
        floating_moment=floats(link.floating_moment + floating * mass * centre),
    )


def _inertial_frame(mj_model: mujoco.MjModel, body: int) -> Frame:
    """Inertial frame of a body in the body's frame."""
    m = mj_model
    frame = Frame(floats(m.body_ipos[body]), _rotation(m.body_iquat[body]))
    return _as_flagged(m.body_sameframe[body], frame, frame)


def _geom_frame(mj_model: mujoco.MjModel, geom: int) -> Frame:
    """Frame of a geom in its body's frame."""
    m = mj_model
    frame = Frame(floats(m.geom_pos[geom]), _rotation(m.geom_quat[geom]))
    inertial = _inertial_frame(m, int(m.geom_bodyid[geom]))
    return _as_flagged(m.geom_sameframe[geom], frame, inertial)


def _as_flagged(same: int, frame: Frame, inertial: Frame) -> Frame:
    """A frame in its body's frame. Where it is almost the same as that one, or as the body's
    inertial one, MuJoCo has a flag and computes as if they were the same."""
    flags = mujoco.mjtSameFrame
    return {
        flags.mjSAMEFRAME_BODY: Frame(),
        flags.mjSAMEFRAME_BODYROT: Frame(frame.origin),
        flags.mjSAMEFRAME_INERTIA: inertial,
        flags.mjSAMEFRAME_INERTIAROT: Frame(frame.origin, inertial.rotation),
    }.get(flags(int(same)), frame)


def _gravity_compensation(mj_model: mujoco.MjModel) -> np.ndarray:
    """Compensated share [nbody] of each body's weight. MuJoCo ignores negative shares if none is
    positive, which `ngravcomp` counts."""
    return mj_model.body_gravcomp if mj_model.ngravcomp else np.zeros(mj_model.nbody)


def _compensated_share(mj_model: mujoco.MjModel, addresses: Addresses) -> float | None:
    """Share of the arm's weight that gravity compensation carries; None if it differs between
    bodies or counts for a joint's `actuatorfrcrange`. A common share costs no operation."""
    m = mj_model
    joints = list(addresses.arm_joints)
    counts = m.jnt_actgravcomp[joints].astype(bool) & m.jnt_actfrclimited[joints].astype(bool)
    moving = np.isin(m.body_weldid, m.jnt_bodyid[joints])
    shares = np.unique(_gravity_compensation(m)[moving & (m.body_mass > 0.0)])
    return float(shares[0]) if len(shares) == 1 and not (np.any(counts) and shares[0]) else None


def _read_servo(mj_model: mujoco.MjModel, actuator: int, joint: int) -> Servo:
    m = mj_model
    gear = float(m.actuator_gear[actuator, 0])
    gain, gain_stiffness, gain_damping = (float(g) for g in m.actuator_gainprm[actuator, :3])
    if m.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED:
        gain_stiffness = gain_damping = 0.0
    bias, stiffness, damping = (float(b) for b in m.actuator_biasprm[actuator, :3])
    limited = bool(m.actuator_ctrllimited[actuator])
    force_limited = bool(m.actuator_forcelimited[actuator])
    joint_limited = bool(m.jnt_actfrclimited[joint])
    forces = np.sort(gear * m.actuator_forcerange[actuator])
    return Servo(
        gain=gear * gain,
        bias=gear * bias,
        stiffness=gear**2 * stiffness,
        damping=gear**2 * damping,
        gear=gear,
        ctrl_range=floats(m.actuator_ctrlrange[actuator]) if limited else None,
        force_range=floats(forces) if force_limited else None,
        gain_stiffness=gear**2 * gain_stiffness,
        gain_damping=gear**2 * gain_damping,
        joint_range=floats(m.jnt_actfrcrange[joint]) if joint_limited else None,
        carries_weight=bool(m.jnt_actgravcomp[joint]),
    )


def _read_ball(mj_model: mujoco.MjModel, ball: BallAddresses) -> BallModel:
    return BallModel(
        radius=float(mj_model.geom_size[ball.geom, 0]),
        mass=float(mj_model.body_mass[ball.body]),
        inertia=float(mj_model.body_inertia[ball.body, 0]),
        weight=1.0 - float(_gravity_compensation(mj_model)[ball.body]),
    )


def _read_contacts(mj_model: mujoco.MjModel, addresses: Addresses) -> tuple[ContactModel, ...]:
    """The contacts in the order of `FusedModel.contacts`."""
    m, balls = mj_model, {ball.geom: i for i, ball in enumerate(addresses.balls)}
    contacts = [
        _read_contact(m, pair, tuple(sorted(balls[g] for g in map(int, geoms) if g in balls)))
        for pair, geoms in enumerate(zip(m.pair_geom1, m.pair_geom2, strict=True))
    ]
    return tuple(sorted(contacts, key=lambda contact: (len(contact.balls), contact.balls)))


def _read_contact(mj_model: mujoco.MjModel, pair: int, balls: tuple[int, ...]) -> ContactModel:
    m, addresses = mj_model, find_addresses(mj_model)
    solref, solimp = m.pair_solref[pair], m.pair_solimp[pair]
    dmin, dmax, midpoint = _impedance_limits(solimp[[0, 1, 3]])
    if solref[0] > 0.0:
        time_constant = _time_constant(m, solref)
        stiffness = 1.0 / (dmax * time_constant * solref[1]) ** 2
    else:
        stiffness = -solref[0] / dmax**2
    power = max(1.0, float(solimp[4]))
    frictional = m.pair_dim[pair] > 1
    friction = np.maximum(m.pair_friction[pair, :2], MIN_FRICTION)
    bodies = [addresses.balls[i].body for i in balls]
    bodies = [m.geom_bodyid[addresses.paddle_geom], *bodies][-2:]
    return ContactModel(
        balls=balls,
        stiffness=float(stiffness),
        damping=_reference_damping(m, solref, dmax),
        solimp=(
            float(dmin),
            float(dmax),
            float(solimp[2]),
            float(midpoint),
            int(power) if power.is_integer() else power,
        ),
        inverse_weights=floats(m.body_invweight0[bodies, 0]),
        friction=floats(friction) if frictional else None,
        impratio=max(_MIN_VALUE, float(m.opt.impratio)),
    )


def _impedance_limits(solimp: np.ndarray) -> np.ndarray:
    """Impedances of a `solimp` within MuJoCo's limits (mjMINIMP, mjMAXIMP)."""
    return np.clip(solimp, 1e-4, 1.0 - 1e-4)


def _reference_damping(mj_model: mujoco.MjModel, solref: np.ndarray, max_impedance: float) -> float:
    """b of the reference acceleration: `solref` is (time constant, damping ratio) or (-k, -b); a
    time constant of 0.02 s, MuJoCo's default, replaces one of mixed signs."""
    if (solref[0] > 0.0) != (solref[1] > 0.0):
        solref = np.array([0.02, 1.0])
    if solref[0] > 0.0:
        return float(2.0 / (max_impedance * _time_constant(mj_model, solref)))
    return float(-solref[1] / max_impedance)


def _time_constant(mj_model: mujoco.MjModel, solref: np.ndarray) -> float:
    """Time constant of a `solref`, at least two steps, s."""
    return max(solref[0], 2.0 * mj_model.opt.timestep)


def _has_dry_friction(mj_model: mujoco.MjModel) -> bool:
    """Whether the flag `frictionloss` lets the joints' dry friction act."""
    return not mj_model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
