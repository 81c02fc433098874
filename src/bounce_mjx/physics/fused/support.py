"""What the fused engine does not support of a model; a refusal names the feature."""

import itertools

import mujoco
import numpy as np

from bounce_mjx.robot.model import Addresses, BallAddresses, find_addresses

_INTEGRATORS = (mujoco.mjtIntegrator.mjINT_IMPLICITFAST, mujoco.mjtIntegrator.mjINT_EULER)
# MJCF flags that `read_model` obeys, or without effect on the supported models.
_HARMLESS_DISABLED = frozenset(
    "equality frictionloss limit spring warmstart filterparent sensor midphase eulerdamp "
    "autoreset nativeccd island multiccd".split()
)
_HARMLESS_ENABLED = frozenset(("energy", "fwdinv", "invdiscrete"))
# MuJoCo's mjMINVAL: up to this width, the impedance is the mean of dmin and dmax.
_MIN_WIDTH = 1e-15


def unsupported_feature(mj_model: mujoco.MjModel) -> str | None:
    """Name of a feature that the fused engine does not support; None if it supports the model."""
    addresses = find_addresses(mj_model)
    features = {
        **_options(mj_model),
        **_bodies(mj_model, addresses),
        **_constraints(mj_model, addresses),
        **_actuators(mj_model, addresses),
    }
    return next((feature for feature, present in features.items() if present), None)


def _options(m: mujoco.MjModel) -> dict[str, bool]:
    """Options that are not supported, and whether the model has each."""
    integrator = mujoco.mjtIntegrator(m.opt.integrator)
    disabled = _flags(m.opt.disableflags, mujoco.mjtDisableBit) - _HARMLESS_DISABLED
    enabled = _flags(m.opt.enableflags, mujoco.mjtEnableBit) - _HARMLESS_ENABLED
    return {
        f"the integrator {integrator.name.removeprefix('mjINT_').lower()} "
        "(only implicitfast and Euler)": integrator not in _INTEGRATORS,
        f"disabled parts of the engine ({', '.join(sorted(disabled))})": bool(disabled),
        f"enabled options of the engine ({', '.join(sorted(enabled))})": bool(enabled),
        "disabled actuators (actuatorgroupdisable)": m.opt.disableactuator != 0,
        "a medium (density, viscosity or wind)": np.any(
            [m.opt.density, m.opt.viscosity, *m.opt.wind]
        ),
        "plugins": m.nplugin > 0,
        "flexes (flex, flexcomp)": m.nflex > 0,
    }


def is_elliptic(m: mujoco.MjModel) -> bool:
    """Whether the model's friction cone is elliptic."""
    return m.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC


def _flags(bits: int, kind: type) -> set[str]:
    """Names of the flags set in `bits`, as the MJCF writes them."""
    return {
        name.partition("BL_")[2].lower()  # mjDSBL_GRAVITY, mjENBL_ENERGY; not the count mjNENABLE
        for name, flag in kind.__members__.items()
        if "BL_" in name and bits & int(flag)
    }


def _bodies(m: mujoco.MjModel, addresses: Addresses) -> dict[str, bool]:
    """Features of bodies and joints, as `_options`."""
    joints, paddle = list(addresses.arm_joints), addresses.paddle_geom
    hinge_or_slide = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    bodies = m.jnt_bodyid[joints]
    before, parents = np.array([0, *bodies[:-1]]), m.body_weldid[m.body_parentid[bodies]]
    return {
        "joints other than the acting ones and the ball's": (
            m.njnt != len(joints) + len(addresses.balls)
        ),
        "arm joints that are neither hinges nor slides": not np.all(
            np.isin(m.jnt_type[joints], hinge_or_slide)
        ),
        "an arm that is not one serial chain": np.any((bodies != before) & (parents != before)),
        "bodies moved from outside (mocap)": np.any(m.body_mocapid >= 0),
        "bodies that are attached to the ball": any(
            np.sum(m.body_weldid == ball.body) != 1 for ball in addresses.balls
        ),
        "a paddle that is not behind the last joint": (
            m.body_weldid[m.geom_bodyid[paddle]] != bodies[-1]
        ),
        "a paddle that is not a box": m.geom_type[paddle] != mujoco.mjtGeom.mjGEOM_BOX,
        "nonlinear springs (stiffness with several numbers)": np.any(m.jnt_stiffnesspoly),
        "nonlinear damping (damping with several numbers)": np.any(m.dof_dampingpoly),
        'joint limits as constraints (limited="true")': np.any(m.jnt_limited),
        "a ball that is not one free homogeneous sphere": not all(
            _is_plain(m, ball) for ball in addresses.balls
        ),
    }


def _is_plain(m: mujoco.MjModel, ball: BallAddresses) -> bool:
    """Whether a ball is one free homogeneous sphere."""
    inertia = m.body_inertia[ball.body]
    return bool(
        m.geom_type[ball.geom] == mujoco.mjtGeom.mjGEOM_SPHERE
        and np.allclose(inertia, inertia[0], rtol=1e-9, atol=0.0)
        and not np.any(m.body_ipos[ball.body])
        and not np.any(m.geom_pos[ball.geom])
        and not np.any(m.dof_damping[ball.qvel,])
        and not np.any(m.dof_armature[ball.qvel,])
        and not np.any(m.dof_frictionloss[ball.qvel,])
        and not m.jnt_stiffness[m.body_jntadr[ball.body]]
    )


def _constraints(m: mujoco.MjModel, addresses: Addresses) -> dict[str, bool]:
    """Features of constraints and contacts, as `_options`."""
    balls = [ball.geom for ball in addresses.balls]
    pairs = [frozenset(map(int, pair)) for pair in zip(m.pair_geom1, m.pair_geom2, strict=True)]
    touching = {frozenset((addresses.paddle_geom, ball)) for ball in balls}
    possible = touching | {frozenset(pair) for pair in itertools.combinations(balls, 2)}
    frictional = bool(np.any(m.pair_dim > 1))
    friction = frictional or np.any(m.dof_frictionloss)
    others = m.pair_dim[~np.isin(m.pair_dim, (1, 3))]
    return {
        "equality constraints": m.neq > 0,
        "tendons": m.ntendon > 0,
        "contacts by contype and conaffinity (only by pairs)": np.any(
            m.geom_contype | m.geom_conaffinity
        ),
        "other than one contact pair of the paddle and each ball": (
            len(set(pairs)) != m.npair or not touching <= set(pairs)
        ),
        "a pair other than of a ball and the paddle or another ball": not set(pairs) <= possible,
        f"torsional or rolling friction (condim {max(others, default=0)}; only condim 1 and 3)": (
            len(others) > 0
        ),
        "a contact margin or gap": np.any(m.pair_margin) or np.any(m.pair_gap),
        "adhesion": np.any(m.pair_adhesion),
        "a solref with exactly one positive number": np.any(
            np.sum(m.pair_solref > 0.0, axis=1) == 1
        ),
        "a solimp without a width": np.any(m.pair_solimp[:, 2] <= _MIN_WIDTH),
        "sliding friction of some contact pairs only": frictional and np.any(m.pair_dim == 1),
        'sliding friction with the elliptic cone (cone="elliptic")': frictional and is_elliptic(m),
        "the noslip solver (noslip_iterations)": friction and m.opt.noslip_iterations > 0,
    }


def _actuators(m: mujoco.MjModel, addresses: Addresses) -> dict[str, bool]:
    """Features of actuators, as `_options`."""
    affine_gain = (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_AFFINE)
    return {
        "actuators other than one position servo on each joint": (
            m.nu != len(addresses.arm_joints)
        ),
        "actuators that are not position servos": (
            np.any(m.actuator_trntype != mujoco.mjtTrn.mjTRN_JOINT)
            or np.any(m.actuator_dyntype != mujoco.mjtDyn.mjDYN_NONE)
            or not np.all(np.isin(m.actuator_gaintype, affine_gain))
            or np.any(m.actuator_biastype != mujoco.mjtBias.mjBIAS_AFFINE)
        ),
        "delayed actuators (delay)": np.any(m.actuator_delay),
        "damping or armature given to an actuator": (
            np.any(m.actuator_damping)
            or np.any(m.actuator_dampingpoly)
            or np.any(m.actuator_armature)
        ),
    }
