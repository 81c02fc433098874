"""Model of the fused engine: constants of a compiled MJCF, and parameters of one environment."""

import dataclasses

import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.physics.fused import chain
from bounce_mjx.physics.fused.contact import ContactModel
from bounce_mjx.physics.fused.scalars import (
    ZERO3,
    Mat3,
    Scalar,
    Vec3,
    mul,
    neg,
    quaternion_matrix,
    scale,
)
from bounce_mjx.physics.fused.support import check_supported
from bounce_mjx.physics.parameters import MIN_FRICTION, PhysicsParameters
from bounce_mjx.robot.model import Addresses, find_addresses

# MuJoCo's mjMINVAL.
_MIN_VALUE = 1e-15


@dataclasses.dataclass(frozen=True)
class Servo:
    """A position servo: torque = gain * ctrl + bias + stiffness * angle + damping * velocity."""

    gain: Scalar
    bias: float
    stiffness: Scalar
    damping: Scalar
    gear: float
    """Length of the actuator per joint angle."""
    ctrl_range: tuple[float, float] | None
    torque_range: tuple[Scalar, Scalar] | None = None


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
    ball_mass: Scalar
    ball_inertia: Scalar
    """Inertia of the homogeneous ball about any axis through its centre, kg m^2."""
    contact: ContactModel
    addresses: Addresses
    nq: int
    nv: int
    ball_force: Vec3 = ZERO3
    """External force on the ball, N."""


def read_model(mj_model: mujoco.MjModel) -> FusedModel:
    """Constants of a compiled model.

    Raises:
      UnsupportedModelError: the fused engine does not support a feature of the model; the text
        names it.
    """
    addresses = find_addresses(mj_model)
    check_supported(mj_model, addresses)
    return FusedModel(
        dt=float(mj_model.opt.timestep),
        gravity=_floats(mj_model.opt.gravity),
        links=tuple(_read_link(mj_model, joint) for joint in addresses.arm_joints),
        servos=tuple(_read_servo(mj_model, actuator) for actuator in addresses.actuators),
        paddle_origin=_floats(mj_model.geom_pos[addresses.paddle_geom]),
        paddle_rotation=_rotation(mj_model.geom_quat[addresses.paddle_geom]),
        ball_mass=float(mj_model.body_mass[addresses.ball_body]),
        ball_inertia=float(mj_model.body_inertia[addresses.ball_body, 0]),
        contact=_read_contact(mj_model, addresses),
        addresses=addresses,
        nq=mj_model.nq,
        nv=mj_model.nv,
    )


def in_world(model: FusedModel, parameters: PhysicsParameters) -> FusedModel:
    """Model with the parameters of one environment.

    Args:
      parameters: scalars, or tuples of scalars; None keeps the model's own value.
    """
    p, contact, ball_inertia = parameters, model.contact, model.ball_inertia
    if p.ball_mass is not None:
        ratio = model.ball_mass / p.ball_mass
        contact = dataclasses.replace(
            contact, ball_inverse_weight=mul(contact.ball_inverse_weight, ratio)
        )
        ball_inertia = mul(p.ball_mass, ball_inertia / model.ball_mass)
    if p.ball_radius is not None:
        ratio = mul(p.ball_radius, 1.0 / contact.radius)
        contact = dataclasses.replace(contact, radius=p.ball_radius)
        ball_inertia = mul(ball_inertia, mul(ratio, ratio))
    if p.contact_friction is not None:
        friction = jnp.maximum(p.contact_friction, MIN_FRICTION)
        contact = dataclasses.replace(contact, friction=(friction, friction))
    # MuJoCo scales the direct format of solref by the largest impedance.
    max_impedance = contact.solimp[1]
    if p.contact_stiffness is not None:
        stiffness = mul(p.contact_stiffness, 1.0 / max_impedance**2)
        contact = dataclasses.replace(contact, stiffness=stiffness)
    if p.contact_damping is not None:
        damping = mul(p.contact_damping, 1.0 / max_impedance)
        contact = dataclasses.replace(contact, damping=damping)
    none = (None,) * len(model.links)
    links = zip(
        model.links, p.link_mass or none, p.armature or none, p.damping or none, strict=True
    )
    servos = zip(
        model.servos,
        p.servo_gain or none,
        p.servo_damping or none,
        p.force_limit or none,
        strict=True,
    )
    rotation = p.paddle_rotation
    return dataclasses.replace(
        model,
        gravity=_given(p.gravity, model.gravity),
        links=tuple(_link_in_world(*link) for link in links),
        servos=tuple(_servo_in_world(*servo) for servo in servos),
        paddle_origin=_given(p.paddle_position, model.paddle_origin),
        paddle_rotation=model.paddle_rotation if rotation is None else quaternion_matrix(rotation),
        ball_mass=_given(p.ball_mass, model.ball_mass),
        ball_inertia=ball_inertia,
        contact=contact,
    )


def _link_in_world(
    link: chain.Link, mass: Scalar | None, armature: Scalar | None, damping: Scalar | None
) -> chain.Link:
    if mass is not None:
        ratio = mul(mass, 1.0 / link.mass)
        link = dataclasses.replace(
            link,
            mass=mass,
            first_moment=scale(link.first_moment, ratio),
            inertia=tuple(scale(row, ratio) for row in link.inertia),
        )
    return dataclasses.replace(
        link, armature=_given(armature, link.armature), damping=_given(damping, link.damping)
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
        servo = dataclasses.replace(servo, torque_range=(neg(limit), limit))
    return servo


def _given(value, default):
    return default if value is None else value


def _floats(values: np.ndarray) -> tuple[float, ...]:
    return tuple(float(v) for v in values)


def _rotation(quaternion: np.ndarray) -> Mat3:
    """Rotation matrix; entries within rounding error of -1, 0 and 1 become exact and fold."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    nearest = np.round(matrix)
    matrix = np.where(np.abs(matrix - nearest) < 1e-12, nearest, matrix).reshape(3, 3)
    return tuple(_floats(row) for row in matrix)


def _read_link(mj_model: mujoco.MjModel, joint: int) -> chain.Link:
    body = mj_model.jnt_bodyid[joint]
    dof = mj_model.jnt_dofadr[joint]
    mass = float(mj_model.body_mass[body])
    centre = mj_model.body_ipos[body]
    principal = np.array(_rotation(mj_model.body_iquat[body]))
    about_centre = principal @ np.diag(mj_model.body_inertia[body]) @ principal.T
    about_origin = about_centre + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return chain.Link(
        offset=_floats(mj_model.body_pos[body]),
        rotation=_rotation(mj_model.body_quat[body]),
        axis=_floats(mj_model.jnt_axis[joint]),
        zero_angle=float(mj_model.qpos0[mj_model.jnt_qposadr[joint]]),
        mass=mass,
        first_moment=_floats(mass * centre),
        inertia=tuple(_floats(row) for row in about_origin),
        armature=float(mj_model.dof_armature[dof]),
        damping=float(mj_model.dof_damping[dof]),
    )


def _read_servo(mj_model: mujoco.MjModel, actuator: int) -> Servo:
    gear = float(mj_model.actuator_gear[actuator, 0])
    bias, stiffness, damping = (float(b) for b in mj_model.actuator_biasprm[actuator, :3])
    limited = bool(mj_model.actuator_ctrllimited[actuator])
    force_limited = bool(mj_model.actuator_forcelimited[actuator])
    torques = np.sort(gear * mj_model.actuator_forcerange[actuator])
    return Servo(
        gain=gear * float(mj_model.actuator_gainprm[actuator, 0]),
        bias=gear * bias,
        stiffness=gear**2 * stiffness,
        damping=gear**2 * damping,
        gear=gear,
        ctrl_range=_floats(mj_model.actuator_ctrlrange[actuator]) if limited else None,
        torque_range=_floats(torques) if force_limited else None,
    )


def _read_contact(mj_model: mujoco.MjModel, addresses: Addresses) -> ContactModel:
    solref, solimp = mj_model.pair_solref[0], mj_model.pair_solimp[0]
    # MuJoCo's limits for solimp (mjMINIMP, mjMAXIMP).
    dmin, dmax, midpoint = np.clip(solimp[[0, 1, 3]], 1e-4, 1.0 - 1e-4)
    if solref[0] > 0.0:
        # solref is (time constant, damping ratio), with a time constant of at least two steps.
        time_constant = max(solref[0], 2.0 * mj_model.opt.timestep)
        stiffness = 1.0 / (dmax * time_constant * solref[1]) ** 2
        damping = 2.0 / (dmax * time_constant)
    else:
        stiffness, damping = -solref[0] / dmax**2, -solref[1] / dmax
    power = max(1.0, float(solimp[4]))
    frictional = mj_model.pair_dim[0] > 1
    friction = np.maximum(mj_model.pair_friction[0, :2], MIN_FRICTION)
    elliptic = mj_model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    paddle_body = mj_model.geom_bodyid[addresses.paddle_geom]
    weights = mj_model.body_invweight0
    return ContactModel(
        radius=float(mj_model.geom_size[addresses.ball_geom, 0]),
        half_size=_floats(mj_model.geom_size[addresses.paddle_geom]),
        stiffness=float(stiffness),
        damping=float(damping),
        solimp=(
            float(dmin),
            float(dmax),
            float(solimp[2]),
            float(midpoint),
            int(power) if power.is_integer() else power,
        ),
        paddle_inverse_weight=float(weights[paddle_body, 0]),
        ball_inverse_weight=float(weights[addresses.ball_body, 0]),
        friction=_floats(friction) if frictional else None,
        elliptic=bool(elliptic),
        impratio=max(_MIN_VALUE, float(mj_model.opt.impratio)),
        tangent_damping=_tangent_damping(mj_model, float(dmax)) if elliptic else None,
    )


def _tangent_damping(mj_model: mujoco.MjModel, max_impedance: float) -> float | None:
    """b of the pair's `solreffriction`; None if the pair's `solref` applies."""
    first, second = (float(x) for x in mj_model.pair_solreffriction[0])
    if (first > 0.0) != (second > 0.0) or (first == 0.0 and second == 0.0):
        return None
    if first > 0.0:
        return 2.0 / (max_impedance * max(first, 2.0 * mj_model.opt.timestep))
    return -second / max_impedance
