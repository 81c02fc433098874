"""The fused engine: MuJoCo's equations for one kind of model, as straight-line scalar arithmetic.

The kind: a serial chain of hinges with position servos, a free ball, one frictionless pair of the
ball (sphere) and the paddle (box), the implicitfast integrator. `read_model` takes the constants
from a compiled `mujoco.MjModel` and refuses any other kind. `step` unrolls the equations while
tracing; under `jax.vmap` each scalar becomes one array over the batch. XLA fuses a substep into a
few loops; on a GPU all substeps are one kernel (`kernel.py`).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.physics import chain
from bounce_mjx.physics.contact import ContactModel, normal_force, sphere_box
from bounce_mjx.physics.kernel import elementwise
from bounce_mjx.physics.scalars import Mat3, Scalar, Vec3, add, dot, matmul, matvec, scale, vadd
from bounce_mjx.physics.state import PhysicsState
from bounce_mjx.robot.model import Addresses, find_addresses


class UnsupportedModelError(ValueError):
    """The model has a feature that the fused engine does not compute."""


@dataclasses.dataclass(frozen=True)
class Servo:
    """A position servo: torque = gain * ctrl + bias + stiffness * angle + damping * velocity."""

    gain: float
    bias: float
    stiffness: float
    damping: float
    ctrl_range: tuple[float, float] | None


@dataclasses.dataclass(frozen=True)
class FusedModel:
    """Constants of the fused engine, in SI units."""

    dt: float
    gravity: tuple[float, float, float]
    links: tuple[chain.Link, ...]
    servos: tuple[Servo, ...]
    """In the order of the joints."""
    paddle_origin: tuple[float, float, float]
    """Centre of the paddle in the frame of the last link."""
    paddle_rotation: tuple[tuple[float, float, float], ...]
    """Orientation of the paddle in the frame of the last link."""
    ball_mass: float
    contact: ContactModel
    addresses: Addresses
    nq: int
    nv: int


class Motion(NamedTuple):
    """What a substep changes, one scalar a coordinate."""

    q: tuple[Scalar, ...]
    v: tuple[Scalar, ...]
    ball_position: Vec3
    ball_velocity: Vec3


def step(
    model: FusedModel, state: PhysicsState, ctrl: jax.Array, num_substeps: int = 1
) -> PhysicsState:
    """Advances one environment by `num_substeps` physics steps under a constant `ctrl` [nu].

    The coordinates go through the loop as scalars. The ball's spin is constant, as the only
    contact is frictionless and goes through its centre; so its orientation turns once, by the
    angle of the whole interval.
    """
    at = model.addresses
    motion = Motion(
        q=tuple(state.qpos[i] for i in at.arm_qpos),
        v=tuple(state.qvel[i] for i in at.arm_qvel),
        ball_position=tuple(state.qpos[i] for i in at.ball_qpos[:3]),
        ball_velocity=tuple(state.qvel[i] for i in at.ball_qvel[:3]),
    )
    leaves, tree = jax.tree.flatten(motion)
    advance = elementwise(_substeps(model, num_substeps), num_results=len(leaves))
    motion = tree.unflatten(advance(*leaves, *(ctrl[i] for i in at.actuators)))
    quaternion = turn(
        tuple(state.qpos[i] for i in at.ball_qpos[3:]),
        tuple(state.qvel[i] for i in at.ball_qvel[3:]),
        num_substeps * model.dt,
    )

    qpos = [state.qpos[i] for i in range(model.nq)]
    qvel = [state.qvel[i] for i in range(model.nv)]
    positions = (*motion.q, *motion.ball_position, *quaternion)
    for i, value in zip(at.arm_qpos + at.ball_qpos, positions, strict=True):
        qpos[i] = value
    for i, value in zip(
        at.arm_qvel + at.ball_qvel[:3], (*motion.v, *motion.ball_velocity), strict=True
    ):
        qvel[i] = value
    return PhysicsState(jnp.stack(qpos), jnp.stack(qvel))


def paddle_position(model: FusedModel, qpos: jax.Array) -> jax.Array:
    """World position [3] (m) of the paddle's centre at qpos [nq]."""
    # A kernel of its own, so that XLA need not fuse so long a chain with what surrounds it.
    in_one = elementwise(_paddle_position(model), num_results=3)
    return jnp.stack(in_one(*(qpos[i] for i in model.addresses.arm_qpos)))


@functools.lru_cache
def _substeps(model: FusedModel, num_substeps: int) -> Callable[..., tuple[Scalar, ...]]:
    """Physics steps as a function of scalars: those of a `Motion`, then the servo targets.

    Cached, and jitted inline, so that JAX traces so long a function once for all the programs that
    have it: each time takes some tenths of a second.
    """

    def substeps(*scalars: Scalar) -> tuple[Scalar, ...]:
        n = len(model.links)
        q, v, ball, targets = scalars[:n], scalars[n : 2 * n], scalars[2 * n : -n], scalars[-n:]
        motion = jax.lax.fori_loop(
            0,
            num_substeps,
            lambda _, motion: substep(model, motion, targets),
            Motion(q, v, ball[:3], ball[3:]),
        )
        return tuple(jax.tree.leaves(motion))

    return jax.jit(substeps, inline=True)


@functools.lru_cache
def _paddle_position(model: FusedModel) -> Callable[..., Vec3]:
    """`paddle_position` as a function of the joint angles; cached as `_substeps` is."""

    def position(*q: Scalar) -> Vec3:
        return _paddle_origin(model, chain.forward_kinematics(model.links, q))

    return jax.jit(position, inline=True)


def substep(model: FusedModel, motion: Motion, targets: tuple[Scalar, ...]) -> Motion:
    """One physics step: mj_step of this kind of model."""
    pose = chain.forward_kinematics(model.links, motion.q)
    bias = chain.bias_force(model.links, pose, motion.v, model.gravity)
    inertia = chain.mass_matrix(model.links, pose)
    applied = [
        servo_torque(servo, target, q, v) - link.damping * v - b
        for link, servo, target, q, v, b in zip(
            model.links, model.servos, targets, motion.q, motion.v, bias, strict=True
        )
    ]
    contact_torque, ball_acceleration = contact_response(model, motion, pose, inertia, applied)
    return integrate(
        model,
        motion,
        inertia,
        [add(a, c) for a, c in zip(applied, contact_torque, strict=True)],
        ball_acceleration,
    )


def servo_torque(servo: Servo, target: Scalar, q: Scalar, v: Scalar) -> Scalar:
    """Torque (N m) of MuJoCo's affine actuator for the servo target (rad)."""
    if servo.ctrl_range is not None:
        target = jnp.clip(target, *servo.ctrl_range)
    return servo.gain * target + servo.stiffness * q + servo.damping * v + servo.bias


def contact_response(
    model: FusedModel,
    motion: Motion,
    pose: chain.Pose,
    inertia: chain.SquareMatrix,
    applied: list[Scalar],
) -> tuple[list[Scalar], Vec3]:
    """Joint torques (N m) of the contact, and the ball's acceleration (m/s^2) with it."""
    contact = sphere_box(
        model.contact,
        motion.ball_position,
        _paddle_origin(model, pose),
        matmul(pose.world_rotation[-1], model.paddle_rotation),
    )
    # The torque of a force along the normal is the same at the contact as at the ball's centre.
    jacobian = [
        -entry
        for entry in chain.point_jacobian(model.links, pose, motion.ball_position, contact.normal)
    ]
    factor = chain.cholesky(inertia)
    half_jacobian = chain.solve_lower(factor, jacobian)
    half_applied = chain.solve_lower(factor, applied)

    normal_velocity = dot(contact.normal, motion.ball_velocity)
    free_acceleration = dot(contact.normal, model.gravity)
    inverse_inertia = 1.0 / model.ball_mass
    for j, v, half_j, half_a in zip(jacobian, motion.v, half_jacobian, half_applied, strict=True):
        normal_velocity = normal_velocity + j * v
        free_acceleration = free_acceleration + half_j * half_a
        inverse_inertia = inverse_inertia + half_j * half_j
    force = normal_force(
        model.contact, contact, normal_velocity, free_acceleration, inverse_inertia
    )
    ball_acceleration = vadd(model.gravity, scale(contact.normal, force / model.ball_mass))
    return [j * force for j in jacobian], ball_acceleration


def integrate(
    model: FusedModel,
    motion: Motion,
    inertia: chain.SquareMatrix,
    torque: list[Scalar],
    ball_acceleration: Vec3,
) -> Motion:
    """MuJoCo's implicitfast integrator: semi-implicit Euler, implicit in the velocity-dependent
    torques of servos and joint damping (documentation, "Computation", numerical integration)."""
    dt = model.dt
    implicit = [list(row) for row in inertia]
    for i, (link, servo) in enumerate(zip(model.links, model.servos, strict=True)):
        implicit[i][i] = add(implicit[i][i], dt * (link.damping - servo.damping))
    factor = chain.cholesky(implicit)
    acceleration = chain.solve_upper(factor, chain.solve_lower(factor, torque))
    v = tuple(a + dt * b for a, b in zip(motion.v, acceleration, strict=True))
    q = tuple(a + dt * b for a, b in zip(motion.q, v, strict=True))
    ball_velocity = vadd(motion.ball_velocity, scale(ball_acceleration, dt))
    ball_position = vadd(motion.ball_position, scale(ball_velocity, dt))
    return Motion(q, v, ball_position, ball_velocity)


def turn(quaternion: tuple[Scalar, ...], spin: Vec3, duration: float) -> tuple[Scalar, ...]:
    """Quaternion [w, x, y, z] after turning at a constant spin (rad/s, body frame): the axis-angle
    product of MuJoCo's mju_quatIntegrate."""
    w, x, y, z = quaternion
    inverse_norm = jax.lax.rsqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = (c * inverse_norm for c in quaternion)
    squared_speed = dot(spin, spin)
    still = squared_speed == 0.0
    speed = jnp.sqrt(jnp.where(still, 1.0, squared_speed))
    half_angle = 0.5 * duration * speed
    sine = jnp.where(still, 0.0, jnp.sin(half_angle) / speed)
    c = jnp.where(still, 1.0, jnp.cos(half_angle))
    a, b, d = scale(spin, sine)
    return (
        w * c - x * a - y * b - z * d,
        w * a + x * c + y * d - z * b,
        w * b - x * d + y * c + z * a,
        w * d + x * b - y * a + z * c,
    )


def read_model(mj_model: mujoco.MjModel) -> FusedModel:
    """Constants of a compiled model.

    Raises:
      UnsupportedModelError: the model has a feature outside the fused engine's kind; the text
        names it.
    """
    at = find_addresses(mj_model)
    _check_options(mj_model)
    _check_bodies(mj_model, at)
    _check_constraints(mj_model, at)
    _check_actuators(mj_model)
    joints = at.arm_joints
    return FusedModel(
        dt=float(mj_model.opt.timestep),
        gravity=_floats(mj_model.opt.gravity),
        links=tuple(_read_link(mj_model, joint) for joint in joints),
        servos=tuple(_read_servo(mj_model, actuator) for actuator in at.actuators),
        paddle_origin=_floats(mj_model.geom_pos[at.paddle_geom]),
        paddle_rotation=_rotation(mj_model.geom_quat[at.paddle_geom]),
        ball_mass=float(mj_model.body_mass[at.ball_body]),
        contact=_read_contact(mj_model, at),
        addresses=at,
        nq=mj_model.nq,
        nv=mj_model.nv,
    )


def _paddle_origin(model: FusedModel, pose: chain.Pose) -> Vec3:
    return vadd(pose.world_origin[-1], matvec(pose.world_rotation[-1], model.paddle_origin))


def _floats(values: np.ndarray) -> tuple[float, ...]:
    return tuple(float(v) for v in values)


def _rotation(quaternion: np.ndarray) -> Mat3:
    """Rotation matrix, its entries within rounding of -1, 0 and 1 made exact so that they fold."""
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
        damping=float(mj_model.dof_damping.reshape(mj_model.nv, -1)[dof, 0]),
    )


def _read_servo(mj_model: mujoco.MjModel, actuator: int) -> Servo:
    gear = float(mj_model.actuator_gear[actuator, 0])
    bias, stiffness, damping = (float(b) for b in mj_model.actuator_biasprm[actuator, :3])
    limited = bool(mj_model.actuator_ctrllimited[actuator])
    return Servo(
        gain=gear * float(mj_model.actuator_gainprm[actuator, 0]),
        bias=gear * bias,
        stiffness=gear**2 * stiffness,
        damping=gear**2 * damping,
        ctrl_range=_floats(mj_model.actuator_ctrlrange[actuator]) if limited else None,
    )


def _read_contact(mj_model: mujoco.MjModel, at: Addresses) -> ContactModel:
    solref, solimp = mj_model.pair_solref[0], mj_model.pair_solimp[0]
    # The limits that MuJoCo's engine puts on solimp (mjMINIMP, mjMAXIMP).
    dmin, dmax, midpoint = np.clip(solimp[[0, 1, 3]], 1e-4, 1.0 - 1e-4)
    if solref[0] > 0.0:
        # solref is (time constant, damping ratio); the time constant spans two steps at least.
        time_constant = max(solref[0], 2.0 * mj_model.opt.timestep)
        stiffness = 1.0 / (dmax * time_constant * solref[1]) ** 2
        damping = 2.0 / (dmax * time_constant)
    else:
        stiffness, damping = -solref[0] / dmax**2, -solref[1] / dmax
    power = max(1.0, float(solimp[4]))
    paddle_body = mj_model.geom_bodyid[at.paddle_geom]
    weights = mj_model.body_invweight0[[paddle_body, at.ball_body], 0]
    return ContactModel(
        radius=float(mj_model.geom_size[at.ball_geom, 0]),
        half_size=_floats(mj_model.geom_size[at.paddle_geom]),
        stiffness=float(stiffness),
        damping=float(damping),
        solimp=(
            float(dmin),
            float(dmax),
            float(solimp[2]),
            float(midpoint),
            int(power) if power.is_integer() else power,
        ),
        inverse_weight=float(weights.sum()),
    )


def _require(condition: bool, feature: str) -> None:
    if not condition:
        raise UnsupportedModelError(
            f"the fused physics does not support {feature}; use --physics mjx"
        )


# Flags of the MJCF that change nothing in a model of the fused engine's kind.
_HARMLESS_DISABLED = frozenset(
    "equality frictionloss limit spring warmstart filterparent sensor midphase eulerdamp "
    "autoreset nativeccd island multiccd".split()
)
_HARMLESS_ENABLED = frozenset(("energy", "fwdinv", "invdiscrete"))
# MuJoCo's mjMINVAL: an impedance of no greater width is the mean of dmin and dmax.
_MIN_WIDTH = 1e-15


def _check_options(m: mujoco.MjModel) -> None:
    integrator = mujoco.mjtIntegrator(m.opt.integrator)
    _require(
        integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
        f"the integrator {integrator.name} (only implicitfast)",
    )
    disabled = _flags(m.opt.disableflags, mujoco.mjtDisableBit) - _HARMLESS_DISABLED
    _require(not disabled, f"disabled parts of the engine ({', '.join(sorted(disabled))})")
    enabled = _flags(m.opt.enableflags, mujoco.mjtEnableBit) - _HARMLESS_ENABLED
    _require(not enabled, f"enabled options of the engine ({', '.join(sorted(enabled))})")
    _require(m.opt.disableactuator == 0, "disabled actuators (actuatorgroupdisable)")
    fluid = m.opt.density or m.opt.viscosity or np.any(m.opt.wind)
    _require(not fluid, "a medium (density, viscosity or wind)")
    _require(m.nplugin == 0, "plugins")


def _flags(bits: int, kind: type) -> set[str]:
    """Names of the flags set in `bits`, as the MJCF writes them."""
    return {
        name.partition("BL_")[2].lower()  # mjDSBL_GRAVITY, mjENBL_ENERGY; not the count mjNENABLE
        for name, flag in kind.__members__.items()
        if "BL_" in name and bits & int(flag)
    }


def _check_bodies(m: mujoco.MjModel, at: Addresses) -> None:
    bodies = [int(m.jnt_bodyid[joint]) for joint in at.arm_joints]
    _require(m.njnt == len(at.arm_joints) + 1, "joints other than Joint1..Joint6 and the ball's")
    _require(m.nbody == len(bodies) + 2, "bodies other than the six links and the ball")
    hinge = mujoco.mjtJoint.mjJNT_HINGE
    _require(all(m.jnt_type[j] == hinge for j in at.arm_joints), "arm joints that are not hinges")
    _require(not np.any(m.jnt_pos[at.arm_joints,]), "a joint away from its body's origin (pos)")
    parents = [0, *bodies[:-1]]
    _require(
        all(m.body_parentid[b] == p for b, p in zip(bodies, parents, strict=True)),
        "an arm that is not one serial chain of Joint1..Joint6",
    )
    _require(m.geom_bodyid[at.paddle_geom] == bodies[-1], "a paddle that is not on the last link")
    box = mujoco.mjtGeom.mjGEOM_BOX
    _require(m.geom_type[at.paddle_geom] == box, "a paddle that is not a box")
    _require(not np.any(m.body_gravcomp), "gravity compensation (gravcomp)")
    springs = np.any(m.jnt_stiffness) or np.any(m.jnt_stiffnesspoly)
    _require(not springs, "joint springs (stiffness)")
    _require(not np.any(m.dof_dampingpoly), "nonlinear joint damping")
    _require(not np.any(m.dof_frictionloss), "joint friction (frictionloss)")
    _require(not np.any(m.jnt_limited), 'joint limits as constraints (limited="true")')
    inertia = m.body_inertia[at.ball_body]
    plain_ball = (
        m.geom_type[at.ball_geom] == mujoco.mjtGeom.mjGEOM_SPHERE
        and np.allclose(inertia, inertia[0], rtol=1e-9, atol=0.0)
        and not np.any(m.body_ipos[at.ball_body])
        and not np.any(m.geom_pos[at.ball_geom])
        and not np.any(m.dof_damping.reshape(m.nv, -1)[at.ball_qvel,])
        and not np.any(m.dof_armature[at.ball_qvel,])
    )
    _require(plain_ball, "a ball that is not one undamped homogeneous sphere")


def _check_constraints(m: mujoco.MjModel, at: Addresses) -> None:
    _require(m.neq == 0, "equality constraints")
    _require(m.ntendon == 0, "tendons")
    colliding = (m.geom_contype != 0) | (m.geom_conaffinity != 0)
    _require(not np.any(colliding), "contacts by contype and conaffinity (only the one pair)")
    _require(m.npair == 1, "other than one contact pair")
    pair = {int(m.pair_geom1[0]), int(m.pair_geom2[0])}
    _require(pair == {at.paddle_geom, at.ball_geom}, "a pair other than of the ball and the paddle")
    _require(m.pair_dim[0] == 1, f"a pair with friction (condim {m.pair_dim[0]}; only condim 1)")
    _require(m.pair_margin[0] == 0.0 and m.pair_gap[0] == 0.0, "a contact margin or gap")
    _require(m.pair_adhesion[0] == 0.0, "adhesion")
    solref, width = m.pair_solref[0], m.pair_solimp[0, 2]
    _require((solref[0] > 0.0) == (solref[1] > 0.0), "a solref of mixed signs")
    _require(width > _MIN_WIDTH, "a solimp without a width")


def _check_actuators(m: mujoco.MjModel) -> None:
    _require(m.nu == m.njnt - 1, "actuators other than one position servo on each joint")
    plain = (
        np.all(m.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
        and np.all(m.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE)
        and np.all(m.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED)
        and np.all(m.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE)
    )
    _require(bool(plain), "actuators that are not position servos")
    limited = np.any(m.actuator_forcelimited) or np.any(m.jnt_actfrclimited)
    _require(not limited, "force limits (forcerange)")
    _require(not np.any(m.actuator_delay), "delayed actuators (delay)")
    rotor = (m.actuator_damping, m.actuator_dampingpoly, m.actuator_armature)
    _require(not any(map(np.any, rotor)), "damping or armature given to an actuator")
