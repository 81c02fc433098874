"""Model of the fused engine, read from an MJCF in the world of one environment."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import mujoco
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.physics.edited import MIN_FRICTION, EditedModel, edited
from bounce_mjx.physics.fused import chain
from bounce_mjx.physics.fused.contact import ContactModel
from bounce_mjx.physics.parameters import MODEL_PARAMETERS, PhysicsParameters
from bounce_mjx.physics.scalars import (
    IDENTITY3,
    ZERO3,
    Mat,
    Scalar,
    Vec,
    add,
    congruence,
    diagonal,
    is_constant,
    maximum,
    mul,
    quaternion_matrix,
    sub,
    symmetric,
)
from bounce_mjx.physics.support import unsupported_friction
from bounce_mjx.robot.model import Addresses, fingerprint, to_direct_solref


class Frame(NamedTuple):
    """Position (m) and orientation of a body in the frame of its link."""

    origin: Vec = ZERO3
    rotation: Mat = IDENTITY3


@dataclasses.dataclass(frozen=True)
class Servo:
    """A servo. On a joint with position q and velocity v it exerts, in N m or N,

    gain * ctrl + bias + stiffness * q + damping * v
    """

    gain: Scalar
    bias: Scalar
    stiffness: Scalar
    damping: Scalar
    ctrl_range: tuple[Scalar, Scalar] | None
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
    place of those that the parameters of an environment change."""

    dt: float
    gravity: Vec
    links: tuple[chain.Link, ...]
    servos: tuple[Servo, ...]
    """In the order of the joints."""
    paddle_origin: Vec
    """Centre of the paddle in the frame of the last link."""
    paddle_rotation: Mat
    """Orientation of the paddle in the frame of the last link."""
    paddle_half_size: Vec
    """Half sizes of the paddle, m."""
    balls: tuple[BallModel, ...]
    contacts: tuple[ContactModel, ...]
    """The contact of each ball with the paddle, then those of two balls."""
    addresses: Addresses
    mj_model: mujoco.MjModel = dataclasses.field(repr=False, compare=False)
    """Source of the model, to be read again in each world."""
    fingerprint: bytes = b""
    """Hash of the source, so that models of equal sources are equal; empty in a world."""
    implicit_servos: bool = True
    """Whether the integrator is implicit in the servos' damping (implicitfast), or not (Euler)."""
    implicit_damping: bool = True
    """Whether the integrator is implicit in the joints' damping."""


def read_model(
    mj_model: mujoco.MjModel, parameters: PhysicsParameters = MODEL_PARAMETERS
) -> FusedModel:
    """Reads a compiled model that the engine supports (`physics/support.py`), in the world of one
    environment.

    Args:
      parameters: numbers, or tuples of numbers: Python floats or scalars.

    Raises:
      UserError: the engine does not read an entry that the parameters change, or lacks the
        friction that they bring.
    """
    m = edited(mj_model, parameters)
    c, addresses = m.model, m.addresses
    links, frames = _read_links(m)
    geom, holder = addresses.paddle_geom, int(c.geom_bodyid[addresses.paddle_geom])
    body, paddle = frames[holder], Frame(m["geom_pos", geom], _rotation(m["geom_quat", geom]))
    paddle = _apply_flag(m["geom_sameframe", geom], paddle, _inertial_frame(m, holder))
    implicit = c.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    explicit_damping = c.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    model = FusedModel(
        dt=float(c.opt.timestep),
        gravity=m["opt.gravity", :],
        links=tuple(links),
        servos=tuple(
            _read_servo(m, actuator, joint)
            for actuator, joint in zip(addresses.actuators, addresses.arm_joints, strict=True)
        ),
        paddle_origin=body.origin + body.rotation @ paddle.origin,
        paddle_rotation=exact(body.rotation @ paddle.rotation),
        paddle_half_size=m["geom_size", geom],
        balls=tuple(
            BallModel(
                radius=m["geom_size", ball.geom, 0],
                mass=m["body_mass", ball.body],
                # Not recorded: a ball stays homogeneous, so that its inertia is not edited alone.
                inertia=m.peek("body_inertia", ball.body, 0),
                weight=1.0 - _gravity_compensation(c)[ball.body].item(),
            )
            for ball in addresses.balls
        ),
        contacts=_read_contacts(m),
        addresses=addresses,
        mj_model=c,
        fingerprint=b"" if jax.tree.leaves(parameters) else fingerprint(c),
        implicit_servos=implicit,
        implicit_damping=implicit or not explicit_damping,
    )
    friction = unsupported_friction(c, m.peek("pair_dim", slice(None)))
    if friction is not None:
        raise UserError(f"the fused physics does not support {friction}; use --physics mjx")
    for name in m.unread():
        raise UserError(
            f"the fused physics cannot vary {name} between environments, so a change of it would "
            "have no effect; leave it out"
        )
    return model


def exact(rotation: Sequence[Sequence[Scalar]]) -> Mat:
    """Rotation matrix; entries within rounding error of -1, 0 and 1 become exact and fold."""

    def entry(x: Scalar) -> Scalar:
        return float(round(x)) if is_constant(x) and abs(x - round(x)) < 1e-12 else x

    return Mat(map(entry, row) for row in rotation)


def _rotation(quaternion: Sequence[Scalar]) -> Mat:
    """Rotation matrix of a unit quaternion [w, x, y, z]."""
    return exact(quaternion_matrix(quaternion))


def _read_links(m: EditedModel) -> tuple[list[chain.Link], dict[int, Frame]]:
    """Links of the chain, and the frame of each body in its link; bodies that do not move are in
    the frame of the world. Welded bodies belong to the link of the last joint above them."""
    c = m.model
    links: list[chain.Link] = []
    frames, link_of = {0: Frame()}, {0: -1}
    for body in range(1, c.nbody):  # parents come before their children
        if c.body_weldid[body] in [ball.body for ball in m.addresses.balls]:
            continue
        parent, link_of[body] = (x[int(c.body_parentid[body])] for x in (frames, link_of))
        origin = parent.origin + parent.rotation @ m["body_pos", body]
        rotation = exact(parent.rotation @ _rotation(c.body_quat[body].tolist()))
        frame = Frame(origin, rotation)
        for joint in range(c.body_jntadr[body], c.body_jntadr[body] + c.body_jntnum[body]):
            slides = c.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
            anchor = ZERO3 if slides else m.peek("jnt_pos", joint)
            origin = frame.origin + frame.rotation @ anchor
            link_of[body] = len(links)
            links.append(_read_joint(m, joint, Frame(origin, frame.rotation)))
            frame = Frame(-anchor)
        frames[body] = frame
        if link_of[body] >= 0:
            links[link_of[body]] = _with_body(m, links[link_of[body]], body, frame)
    return links, frames


def _read_joint(m: EditedModel, joint: int, frame: Frame) -> chain.Link:
    """Link without mass behind a joint, whose frame is given in the parent link."""
    c = m.model
    dof, at = c.jnt_dofadr[joint], c.jnt_qposadr[joint]
    springs = not c.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_SPRING
    dry = not c.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
    dmin, dmax = _impedance_limits(c.dof_solimp[dof, :2])
    frictionloss = m["dof_frictionloss", dof]
    return chain.Link(
        offset=frame.origin,
        rotation=frame.rotation,
        axis=m.peek("jnt_axis", joint),
        slides=bool(c.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE),
        zero_position=m["qpos0", at],
        mass=0.0,
        first_moment=ZERO3,
        inertia=Mat((ZERO3,) * 3),
        armature=m["dof_armature", dof],
        damping=m["dof_damping", dof],
        stiffness=m["jnt_stiffness", joint] if springs else 0.0,
        spring_position=m["qpos_spring", at],
        frictionloss=frictionloss if dry else 0.0,
        friction_softness=float((1.0 - dmin) / dmin * c.dof_invweight0[dof]),
        friction_damping=float(to_direct_solref(c.dof_solref[dof], c.opt.timestep)[1] / dmax),
    )


def _with_body(m: EditedModel, link: chain.Link, body: int, frame: Frame) -> chain.Link:
    """Link with the mass of one more body, whose frame is given in the link."""
    mass, inertial = m["body_mass", body], _inertial_frame(m, body)
    centre = frame.origin + frame.rotation @ inertial.origin
    principal = frame.rotation @ inertial.rotation
    lever = centre @ centre
    about_centre = congruence(principal, diagonal(m["body_inertia", body]))

    def entry(i: int, j: int) -> Scalar:
        shift = sub(lever if i == j else 0.0, mul(centre[i], centre[j]))
        return add(link.inertia[i][j], add(about_centre[i][j], mul(shift, mass)))

    moment = centre * mass
    floating = m["body_gravcomp", body] if m.model.ngravcomp else 0.0
    return dataclasses.replace(
        link,
        mass=add(link.mass, mass),
        first_moment=link.first_moment + moment,
        inertia=symmetric(entry),
        floating_mass=add(link.floating_mass, mul(mass, floating)),
        floating_moment=link.floating_moment + moment * floating,
    )


def _inertial_frame(m: EditedModel, body: int) -> Frame:
    """Inertial frame of a body in the body's frame."""
    frame = Frame(m.peek("body_ipos", body), _rotation(m.model.body_iquat[body].tolist()))
    return _apply_flag(m.model.body_sameframe[body], frame, frame)


def _apply_flag(same: int, frame: Frame, inertial: Frame) -> Frame:
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


def _read_servo(m: EditedModel, actuator: int, joint: int) -> Servo:
    c = m.model
    gear = float(c.actuator_gear[actuator, 0])
    bias, stiffness, damping = m["actuator_biasprm", actuator, :3]
    forces = tuple(mul(limit, gear) for limit in m["actuator_forcerange", actuator])
    joint_limited = bool(c.jnt_actfrclimited[joint])
    return Servo(
        gain=mul(m["actuator_gainprm", actuator, 0], gear),
        bias=mul(bias, gear),
        stiffness=mul(stiffness, gear**2),
        damping=mul(damping, gear**2),
        ctrl_range=m["actuator_ctrlrange", actuator] if c.actuator_ctrllimited[actuator] else None,
        force_range=forces[:: 1 if gear > 0.0 else -1]
        if m["actuator_forcelimited", actuator]
        else None,
        joint_range=m.peek("jnt_actfrcrange", joint) if joint_limited else None,
        carries_weight=bool(c.jnt_actgravcomp[joint]),
    )


def _read_contacts(m: EditedModel) -> tuple[ContactModel, ...]:
    """The contacts in the order of `FusedModel.contacts`."""
    balls = {ball.geom: i for i, ball in enumerate(m.addresses.balls)}
    contacts = [
        _read_contact(m, pair, tuple(sorted(balls[g] for g in map(int, geoms) if g in balls)))
        for pair, geoms in enumerate(zip(m.model.pair_geom1, m.model.pair_geom2, strict=True))
    ]
    return tuple(sorted(contacts, key=lambda contact: (len(contact.balls), contact.balls)))


def _read_contact(m: EditedModel, pair: int, balls: tuple[int, ...]) -> ContactModel:
    c, addresses, solimp = m.model, m.addresses, m.model.pair_solimp[pair]
    dmin, dmax, midpoint = _impedance_limits(solimp[[0, 1, 3]]).tolist()
    stiffness, damping = to_direct_solref(m["pair_solref", pair], c.opt.timestep)
    power = max(1.0, float(solimp[4]))
    bodies = [addresses.balls[i].body for i in balls]
    bodies = [c.geom_bodyid[addresses.paddle_geom], *bodies][-2:]
    frictional = m["pair_dim", pair] > 1
    return ContactModel(
        balls=balls,
        # MuJoCo scales the direct format of solref by the largest impedance.
        stiffness=mul(stiffness, 1.0 / dmax**2),
        damping=mul(damping, 1.0 / dmax),
        solimp=(
            dmin,
            dmax,
            float(solimp[2]),
            midpoint,
            int(power) if power.is_integer() else power,
        ),
        inverse_weights=tuple(m["body_invweight0", body, 0] for body in bodies),
        friction=tuple(maximum(x, MIN_FRICTION) for x in m["pair_friction", pair][:2])
        if frictional
        else None,
        impratio=max(mujoco.mjMINVAL, float(c.opt.impratio)),
    )


def _impedance_limits(solimp: np.ndarray) -> np.ndarray:
    """Impedances of a `solimp` within MuJoCo's limits (mjMINIMP, mjMAXIMP)."""
    return np.clip(solimp, 1e-4, 1.0 - 1e-4)
