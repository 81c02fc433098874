"""What the engines lack of MuJoCo; a refusal names the feature.

MJX itself refuses some features and silently ignores others, which would be computed wrongly.
"""

import itertools
import re
from collections.abc import Iterable, Iterator

import mujoco
import numpy as np

from bounce_mjx.lazy import silence_mjx
from bounce_mjx.physics.parameters import MODEL_PARAMETERS, PhysicsParameters, gives
from bounce_mjx.robot.model import Addresses, BallAddresses, find_addresses

Feature = tuple[str, str, bool]
"""The engines that lack a feature, its name, and whether a model has it."""

_FUSED, _MJX, _BOTH = "fused", "mjx", "fused mjx"
_INTEGRATORS = {"fused": ("implicitfast", "Euler"), "mjx": ("Euler", "RK4", "implicitfast")}
# MJCF flags that `fused.read_model` obeys, or without effect on the supported models.
_HARMLESS_DISABLED = frozenset(
    "equality frictionloss limit spring warmstart filterparent sensor midphase eulerdamp "
    "autoreset nativeccd island multiccd".split()
)
_HARMLESS_ENABLED = frozenset(("energy", "fwdinv", "invdiscrete"))


def unsupported_feature(mj_model: mujoco.MjModel, engine: str) -> str | None:
    """Name of a feature of the model that an engine, "fused" or "mjx", does not support; None if it
    supports them all."""
    addresses = find_addresses(mj_model)
    features = itertools.chain(
        _options(mj_model),
        _bodies(mj_model, addresses),
        _actuators(mj_model, addresses),
        _constraints(mj_model, addresses),
        _friction(mj_model, MODEL_PARAMETERS),
    )
    found = _first_lacking(features, engine)
    return _refused_by_mjx(mj_model) if found is None and engine == "mjx" else found


def unsupported_parameter(
    mj_model: mujoco.MjModel, engine: str, parameters: PhysicsParameters
) -> str | None:
    """Name of a feature that the parameters of an environment bring to a model which an engine
    supports; None if the engine supports them all."""
    return _first_lacking(_friction(mj_model, parameters), engine)


def _first_lacking(features: Iterable[Feature], engine: str) -> str | None:
    lacking = (name for engines, name, present in features if present and engine in engines.split())
    return next(lacking, None)


def _options(m: mujoco.MjModel) -> Iterator[Feature]:
    integrator = mujoco.mjtIntegrator(m.opt.integrator).name.removeprefix("mjINT_").lower()
    for engine, known in _INTEGRATORS.items():
        only = f"only {', '.join(known[:-1])} and {known[-1]}"
        lacking = integrator not in [name.lower() for name in known]
        yield engine, f"the integrator {integrator} ({only})", lacking
    disabled = _flags(m.opt.disableflags, mujoco.mjtDisableBit) - _HARMLESS_DISABLED
    enabled = _flags(m.opt.enableflags, mujoco.mjtEnableBit)
    ignored = enabled - _HARMLESS_ENABLED
    names = ", ".join(sorted(disabled)), ", ".join(sorted(ignored))
    yield _FUSED, f"disabled parts of the engine ({names[0]})", bool(disabled)
    yield _FUSED, f"enabled options of the engine ({names[1]})", bool(ignored)
    yield _MJX, "sleeping bodies (sleep)", "sleep" in enabled
    yield _BOTH, "disabled actuators (actuatorgroupdisable)", m.opt.disableactuator != 0
    medium = np.any([m.opt.density, m.opt.viscosity, *m.opt.wind])
    yield _FUSED, "a medium (density, viscosity or wind)", medium
    yield _BOTH, "plugins", m.nplugin > 0
    yield _BOTH, "flexes (flex, flexcomp)", m.nflex > 0


def _flags(bits: int, kind: type) -> set[str]:
    """Names of the flags set in `bits`, as the MJCF writes them."""
    return {
        name.partition("BL_")[2].lower()  # mjDSBL_GRAVITY, mjENBL_ENERGY; not the count mjNENABLE
        for name, flag in kind.__members__.items()
        if "BL_" in name and bits & int(flag)
    }


def _bodies(m: mujoco.MjModel, addresses: Addresses) -> Iterator[Feature]:
    """Features of bodies and joints."""
    joints, paddle = list(addresses.arm_joints), addresses.paddle_geom
    hinge_or_slide = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    bodies = m.jnt_bodyid[joints]
    before, parents = np.array([0, *bodies[:-1]]), m.body_weldid[m.body_parentid[bodies]]
    others = m.njnt != len(joints) + len(addresses.balls)
    yield _FUSED, "joints other than the acting ones and the ball's", others
    turning = np.all(np.isin(m.jnt_type[joints], hinge_or_slide))
    yield _FUSED, "arm joints that are neither hinges nor slides", not turning
    branches = np.any((bodies != before) & (parents != before))
    yield _FUSED, "an arm that is not one serial chain", branches
    yield _FUSED, "bodies moved from outside (mocap)", np.any(m.body_mocapid >= 0)
    attached = any(np.sum(m.body_weldid == ball.body) != 1 for ball in addresses.balls)
    yield _FUSED, "bodies that are attached to the ball", attached
    elsewhere = m.body_weldid[m.geom_bodyid[paddle]] != bodies[-1]
    yield _FUSED, "a paddle that is not behind the last joint", elsewhere
    shape = m.geom_type[paddle]
    yield _FUSED, "a paddle that is not a box", shape != mujoco.mjtGeom.mjGEOM_BOX
    springs = np.any(m.jnt_stiffnesspoly) or np.any(m.tendon_stiffnesspoly)
    yield _BOTH, "nonlinear springs (stiffness with several numbers)", springs
    dampers = np.any(m.dof_dampingpoly) or np.any(m.tendon_dampingpoly)
    yield _BOTH, "nonlinear damping (damping with several numbers)", dampers
    lost = _loses_passive_forces(m)
    with_flags = "with the flag spring or damper disabled"
    yield _MJX, f"springs, damping or gravity compensation {with_flags}", lost
    yield _FUSED, 'joint limits as constraints (limited="true")', np.any(m.jnt_limited)
    plain = all(_is_plain(m, ball) for ball in addresses.balls)
    yield _FUSED, "a ball that is not one free homogeneous sphere", not plain


def _loses_passive_forces(m: mujoco.MjModel) -> bool:
    """Whether MJX leaves out a force: with one of the two flags disabled, it has no passive force
    at all."""
    springs, dampers = (
        not m.opt.disableflags & flag
        for flag in (mujoco.mjtDisableBit.mjDSBL_SPRING, mujoco.mjtDisableBit.mjDSBL_DAMPER)
    )
    kept = (m.jnt_stiffness, m.tendon_stiffness) if springs else (m.dof_damping, m.tendon_damping)
    return springs != dampers and bool(m.ngravcomp or any(map(np.any, kept)))


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


def _actuators(m: mujoco.MjModel, addresses: Addresses) -> Iterator[Feature]:
    several = m.nu != len(addresses.arm_joints)
    yield _FUSED, "actuators other than one position servo on each joint", several
    affine_gain = (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_AFFINE)
    servos = (
        np.all(m.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
        and np.all(m.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE)
        and np.all(np.isin(m.actuator_gaintype, affine_gain))
        and np.all(m.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE)
    )
    yield _FUSED, "actuators that are not position servos", not servos
    yield _BOTH, "delayed actuators (delay)", np.any(m.actuator_delay)
    yield _MJX, "early activations (actearly)", np.any(m.actuator_actearly)
    own = m.actuator_damping, m.actuator_dampingpoly, m.actuator_armature
    yield _BOTH, "damping or armature given to an actuator", any(map(np.any, own))
    implicit = m.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    limited = implicit and _has_limited_affine_gain(m)
    yield _MJX, "limits of a servo whose gain depends on its state (gaintype affine)", limited


def _has_limited_affine_gain(m: mujoco.MjModel) -> bool:
    """Whether a servo's gain depends on its state, and a limit acts on it.

    MuJoCo's C engine differentiates such a force at the clipped input, and a saturated one not at
    all; MJX's implicitfast integrator does neither.
    """
    affine = m.actuator_gaintype == mujoco.mjtGain.mjGAIN_AFFINE
    by_velocity = affine & (m.actuator_gainprm[:, 2] != 0.0)
    limited_input = by_velocity & m.actuator_ctrllimited.astype(bool)
    return bool(np.any(limited_input | (affine & m.actuator_forcelimited.astype(bool))))


def _constraints(m: mujoco.MjModel, addresses: Addresses) -> Iterator[Feature]:
    """Features of constraints and contacts."""
    balls = [ball.geom for ball in addresses.balls]
    pairs = [frozenset(map(int, pair)) for pair in zip(m.pair_geom1, m.pair_geom2, strict=True)]
    touching = {frozenset((addresses.paddle_geom, ball)) for ball in balls}
    possible = touching | {frozenset(pair) for pair in itertools.combinations(balls, 2)}
    yield _FUSED, "equality constraints", m.neq > 0
    yield _FUSED, "tendons", m.ntendon > 0
    collides = np.any(m.geom_contype | m.geom_conaffinity)
    yield _FUSED, "contacts by contype and conaffinity (only by pairs)", collides
    missing = len(set(pairs)) != m.npair or not touching <= set(pairs)
    yield _FUSED, "other than one contact pair of the paddle and each ball", missing
    others = not set(pairs) <= possible
    yield _FUSED, "a pair other than of a ball and the paddle or another ball", others
    rolling = max(m.pair_dim[~np.isin(m.pair_dim, (1, 3))], default=0)
    only = f"(condim {rolling}; only condim 1 and 3)"
    yield _FUSED, f"torsional or rolling friction {only}", rolling > 0
    yield _FUSED, "a contact margin or gap", np.any(m.pair_margin) or np.any(m.pair_gap)
    yield _FUSED, "adhesion", np.any(m.pair_adhesion)
    yield _MJX, "adhesion", np.any(m.pair_adhesion) or np.any(m.geom_adhesion)
    yield _MJX, "surface velocities (surfacevel)", np.any(m.geom_surfacevel)
    for engine, owners in ((_FUSED, ("pair_{}",)), (_MJX, _WITH_SOLREF)):
        solref, solimp = (
            np.concatenate([getattr(m, owner.format(kind)) for owner in owners])
            for kind in ("solref", "solimp")
        )
        mixed = np.any(np.sum(solref > 0.0, axis=1) == 1)
        yield engine, "a solref with exactly one positive number", mixed
        yield engine, "a solimp without a width", np.any(solimp[:, 2] <= mujoco.mjMINVAL)


_WITH_SOLREF = ("pair_{}", "geom_{}", "jnt_{}", "dof_{}", "eq_{}", "tendon_{}_lim", "tendon_{}_fri")


def _friction(m: mujoco.MjModel, parameters: PhysicsParameters) -> Iterator[Feature]:
    """Features of sliding and dry friction, of the model or of a world."""
    given = (
        gives(parameters, "contact_friction", "pair_friction", "geom_friction"),
        gives(parameters, "frictionloss", "dof_frictionloss"),
    )
    sliding = bool(given[0] or np.any(m.pair_dim > 1))
    dry = bool(given[1] or np.any(m.dof_frictionloss))
    some = sliding and not given[0] and np.any(m.pair_dim == 1)
    yield _FUSED, "sliding friction of some contact pairs only", some
    elliptic = sliding and m.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    yield _FUSED, 'sliding friction (contact_friction) with cone="elliptic"', elliptic
    noslip = m.opt.noslip_iterations > 0
    name = "the noslip solver (noslip_iterations)"
    yield _FUSED, f"{name} with friction", noslip and (sliding or dry)
    yield _MJX, name, noslip
    # After one step from 2 of 24 states with a slow arm, MJX differed from C by up to 0.02 rad/s,
    # whatever the solver's tolerance.
    yield _MJX, "dry friction that differs between environments (frictionloss)", given[1]


def _refused_by_mjx(mj_model: mujoco.MjModel) -> str | None:
    """MJX's own refusal, without its enumerations: "(mjtGeom.mjGEOM_BOX, ...)" becomes
    "box, ..."."""
    silence_mjx()
    from mujoco import mjx

    try:
        mjx.put_model(mj_model)
    except NotImplementedError as error:
        text = re.sub(r"mjt\w+\.mj[A-Z]+_(\w+)(: \d+)?", lambda m: m[1].lower(), str(error))
        return f"a feature of the MJCF ({re.sub(r'[][()<>]', '', text).rstrip('.')})"
    return None
