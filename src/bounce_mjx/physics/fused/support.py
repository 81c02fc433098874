"""Check that the fused engine supports a model; a refusal names the unsupported feature."""

import itertools

import mujoco
import numpy as np

from bounce_mjx.robot.model import Addresses, BallAddresses, find_addresses


class UnsupportedModelError(ValueError):
    """The fused engine does not support a feature of the model; the text names it."""


def unsupported_feature(mj_model: mujoco.MjModel) -> str | None:
    """Name of a feature that the fused engine does not support; None if it supports the model."""
    try:
        check_supported(mj_model, find_addresses(mj_model))
    except UnsupportedModelError as error:
        return str(error)
    return None


def check_supported(mj_model: mujoco.MjModel, addresses: Addresses) -> None:
    """Checks that the fused engine supports every feature of a model.

    Raises:
      UnsupportedModelError: a feature is not supported; the text names it.
    """
    _check_options(mj_model)
    _check_bodies(mj_model, addresses)
    _check_constraints(mj_model, addresses)
    _check_actuators(mj_model, addresses)


def _require(condition: bool, feature: str) -> None:
    if not condition:
        raise UnsupportedModelError(feature)


_INTEGRATORS = (mujoco.mjtIntegrator.mjINT_IMPLICITFAST, mujoco.mjtIntegrator.mjINT_EULER)
# MJCF flags that `read_model` obeys, or without effect on the supported models.
_HARMLESS_DISABLED = frozenset(
    "equality frictionloss limit spring warmstart filterparent sensor midphase eulerdamp "
    "autoreset nativeccd island multiccd".split()
)
_HARMLESS_ENABLED = frozenset(("energy", "fwdinv", "invdiscrete"))
# MuJoCo's mjMINVAL: up to this width, the impedance is the mean of dmin and dmax.
_MIN_WIDTH = 1e-15


def _check_options(m: mujoco.MjModel) -> None:
    integrator = mujoco.mjtIntegrator(m.opt.integrator)
    _require(
        integrator in _INTEGRATORS,
        f"the integrator {integrator.name.removeprefix('mjINT_').lower()} "
        "(only implicitfast and Euler)",
    )
    disabled = _flags(m.opt.disableflags, mujoco.mjtDisableBit) - _HARMLESS_DISABLED
    _require(not disabled, f"disabled parts of the engine ({', '.join(sorted(disabled))})")
    enabled = _flags(m.opt.enableflags, mujoco.mjtEnableBit) - _HARMLESS_ENABLED
    _require(not enabled, f"enabled options of the engine ({', '.join(sorted(enabled))})")
    _require(m.opt.disableactuator == 0, "disabled actuators (actuatorgroupdisable)")
    fluid = m.opt.density or m.opt.viscosity or np.any(m.opt.wind)
    _require(not fluid, "a medium (density, viscosity or wind)")
    _require(m.nplugin == 0, "plugins")
    _require(m.nflex == 0, "flexes (flex, flexcomp)")


def _flags(bits: int, kind: type) -> set[str]:
    """Names of the flags set in `bits`, as the MJCF writes them."""
    return {
        name.partition("BL_")[2].lower()  # mjDSBL_GRAVITY, mjENBL_ENERGY; not the count mjNENABLE
        for name, flag in kind.__members__.items()
        if "BL_" in name and bits & int(flag)
    }


def _check_bodies(m: mujoco.MjModel, addresses: Addresses) -> None:
    bodies = [int(m.jnt_bodyid[joint]) for joint in addresses.arm_joints]
    _require(
        m.njnt == len(addresses.arm_joints) + len(addresses.balls),
        "joints other than the acting ones and the ball's",
    )
    hinge_or_slide = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    _require(
        all(int(m.jnt_type[j]) in hinge_or_slide for j in addresses.arm_joints),
        "arm joints that are neither hinges nor slides",
    )
    parents = [m.body_weldid[m.body_parentid[body]] for body in bodies]
    _require(
        all(
            body == before or parent == before
            for before, body, parent in zip([0, *bodies[:-1]], bodies, parents, strict=True)
        ),
        "an arm that is not one serial chain",
    )
    _require(not np.any(m.body_mocapid >= 0), "bodies moved from outside (mocap)")
    _require(
        all(np.sum(m.body_weldid == ball.body) == 1 for ball in addresses.balls),
        "bodies that are attached to the ball",
    )
    _require(
        m.body_weldid[m.geom_bodyid[addresses.paddle_geom]] == bodies[-1],
        "a paddle that is not behind the last joint",
    )
    box = mujoco.mjtGeom.mjGEOM_BOX
    _require(m.geom_type[addresses.paddle_geom] == box, "a paddle that is not a box")
    nonlinear = np.any(m.jnt_stiffnesspoly)
    _require(not nonlinear, "nonlinear springs (stiffness with several numbers)")
    _require(not np.any(m.dof_dampingpoly), "nonlinear damping (damping with several numbers)")
    _require(not np.any(m.jnt_limited), 'joint limits as constraints (limited="true")')
    plain = all(_is_plain(m, ball) for ball in addresses.balls)
    _require(plain, "a ball that is not one free homogeneous sphere")


def _is_plain(m: mujoco.MjModel, ball: BallAddresses) -> bool:
    """Whether a ball is one free homogeneous sphere."""
    inertia = m.body_inertia[ball.body]
    return bool(
        m.geom_type[ball.geom] == mujoco.mjtGeom.mjGEOM_SPHERE
        and np.allclose(inertia, inertia[0], rtol=1e-9, atol=0.0)
        and not np.any(m.body_ipos[ball.body])
        and not np.any(m.geom_pos[ball.geom])
        and not np.any(m.dof_damping.reshape(m.nv, -1)[ball.qvel,])
        and not np.any(m.dof_armature[ball.qvel,])
        and not np.any(m.dof_frictionloss[ball.qvel,])
        and not m.jnt_stiffness[m.body_jntadr[ball.body]]
    )


def _check_constraints(m: mujoco.MjModel, addresses: Addresses) -> None:
    _require(m.neq == 0, "equality constraints")
    _require(m.ntendon == 0, "tendons")
    colliding = (m.geom_contype != 0) | (m.geom_conaffinity != 0)
    _require(not np.any(colliding), "contacts by contype and conaffinity (only by pairs)")
    _check_pairs(m, addresses)
    frictional = np.any(m.pair_dim > 1)
    _require(
        not frictional or np.all(m.pair_dim > 1), "sliding friction of some contact pairs only"
    )
    friction = frictional or np.any(m.dof_frictionloss)
    _require(not (friction and m.opt.noslip_iterations), "the noslip solver (noslip_iterations)")


def _check_pairs(m: mujoco.MjModel, addresses: Addresses) -> None:
    balls = {ball.geom for ball in addresses.balls}
    geoms = [frozenset(map(int, pair)) for pair in zip(m.pair_geom1, m.pair_geom2, strict=True)]
    touching = {frozenset((addresses.paddle_geom, ball)) for ball in balls}
    possible = touching | {frozenset(pair) for pair in itertools.combinations(balls, 2)}
    _require(
        m.npair > 0 and len(set(geoms)) == m.npair and touching <= set(geoms),
        "other than one contact pair of the paddle and each ball",
    )
    _require(set(geoms) <= possible, "a pair other than of a ball and the paddle or another ball")
    for pair in range(m.npair):
        _require(
            m.pair_dim[pair] in (1, 3),
            f"torsional or rolling friction (condim {m.pair_dim[pair]}; only condim 1 and 3)",
        )
        gap = m.pair_margin[pair] or m.pair_gap[pair]
        _require(not gap, "a contact margin or gap")
        _require(m.pair_adhesion[pair] == 0.0, "adhesion")
        solref, width = m.pair_solref[pair], m.pair_solimp[pair, 2]
        same_sign = (solref[0] > 0.0) == (solref[1] > 0.0)
        _require(same_sign, "a solref with exactly one positive number")
        _require(width > _MIN_WIDTH, "a solimp without a width")


def _check_actuators(m: mujoco.MjModel, addresses: Addresses) -> None:
    _require(
        m.nu == len(addresses.arm_joints), "actuators other than one position servo on each joint"
    )
    affine_gain = (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_AFFINE)
    servos = (
        np.all(m.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
        and np.all(m.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE)
        and all(int(gain) in affine_gain for gain in m.actuator_gaintype)
        and np.all(m.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE)
    )
    _require(bool(servos), "actuators that are not position servos")
    _require(not np.any(m.actuator_delay), "delayed actuators (delay)")
    rotor = (m.actuator_damping, m.actuator_dampingpoly, m.actuator_armature)
    _require(not any(map(np.any, rotor)), "damping or armature given to an actuator")
