"""What the engines lack of MuJoCo; a refusal names the feature.

MJX itself refuses some features and silently ignores others, which would be computed wrongly.
"""

import itertools
from collections.abc import Iterable, Iterator
from typing import Any

import mujoco
import numpy as np

from bounce_mjx.lazy import import_mjx
from bounce_mjx.physics.parameters import MODEL_PARAMETERS, PhysicsParameters, gives
from bounce_mjx.robot.model import Addresses, BallAddresses, find_addresses

Feature = tuple[str, str, Any]
"""The engines that lack a feature, its name, and whether a model has it."""

_FUSED, _MJX, _BOTH = "fused", "mjx", "fused mjx"
_INTEGRATORS = {"fused": ("implicitfast", "Euler"), "mjx": ("Euler", "RK4", "implicitfast")}
# Flags of the MJCF that `fused.read_model` obeys, or without effect on the supported models.
_HARMLESS = frozenset(
    "equality frictionloss limit spring warmstart filterparent sensor midphase eulerdamp "
    "autoreset nativeccd island multiccd energy fwdinv invdiscrete".split()
)
_NONZERO = (
    (_BOTH, "disabled actuators (actuatorgroupdisable)", "opt.disableactuator"),
    (_FUSED, "a medium (density, viscosity or wind)", "opt.density opt.viscosity opt.wind"),
    (_BOTH, "plugins", "nplugin"),
    (_BOTH, "flexes (flex, flexcomp)", "nflex"),
    (_FUSED, "bodies moved from outside (mocap)", "nmocap"),
    (_BOTH, "a stiffness of several numbers", "jnt_stiffnesspoly tendon_stiffnesspoly"),
    (_BOTH, "a damping of several numbers", "dof_dampingpoly tendon_dampingpoly"),
    (_FUSED, 'joint limits as constraints (limited="true")', "jnt_limited"),
    (_BOTH, "delayed actuators (delay)", "actuator_delay"),
    (_MJX, "early activations (actearly)", "actuator_actearly"),
    (_BOTH, "damping of an actuator", "actuator_damping actuator_dampingpoly"),
    (_BOTH, "armature of an actuator", "actuator_armature"),
    (_FUSED, "equality constraints", "neq"),
    (_FUSED, "tendons", "ntendon"),
    (_FUSED, "contacts by contype (only by pairs)", "geom_contype geom_conaffinity"),
    (_FUSED, "a contact margin or gap", "pair_margin pair_gap"),
    (_FUSED, "adhesion", "pair_adhesion"),
    (_MJX, "adhesion", "pair_adhesion geom_adhesion"),
    (_MJX, "surface velocities (surfacevel)", "geom_surfacevel"),
    (_MJX, "the noslip solver (noslip_iterations)", "opt.noslip_iterations"),
)
"""Features of a model in which one of these fields is not 0."""


def unsupported_feature(mj_model: mujoco.MjModel, engine: str) -> str | None:
    """Name of a feature of the model that an engine, "fused" or "mjx", does not support; None if it
    supports them all."""
    addresses = find_addresses(mj_model)
    nonzero = (
        (engines, name, any(np.any(_value(mj_model, field)) for field in fields.split()))
        for engines, name, fields in _NONZERO
    )
    features = itertools.chain(
        _options(mj_model),
        nonzero,
        _parts(mj_model, addresses),
        _contacts(mj_model, addresses),
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


def _value(m: mujoco.MjModel, name: str) -> Any:
    return getattr(m.opt, name[4:]) if name.startswith("opt.") else getattr(m, name)


def _options(m: mujoco.MjModel) -> Iterator[Feature]:
    integrator = mujoco.mjtIntegrator(m.opt.integrator).name.removeprefix("mjINT_").lower()
    for engine, known in _INTEGRATORS.items():
        only = f"only {', '.join(known[:-1])} and {known[-1]}"
        lacking = integrator not in [name.lower() for name in known]
        yield engine, f"the integrator {integrator} ({only})", lacking
    disabled = _flags(m.opt.disableflags, mujoco.mjtDisableBit)
    enabled = _flags(m.opt.enableflags, mujoco.mjtEnableBit)
    for words, flags in (("disabled parts", disabled), ("enabled options", enabled)):
        lacking = sorted(flags - _HARMLESS)
        yield _FUSED, f"{words} of the engine ({', '.join(lacking)})", lacking
    yield _MJX, "sleeping bodies (sleep)", "sleep" in enabled
    # With one of the two flags disabled, MJX has no passive force at all.
    kept = (m.dof_damping, m.tendon_damping)
    if "damper" in disabled:
        kept = (m.jnt_stiffness, m.tendon_stiffness)
    lost = len(disabled & {"spring", "damper"}) == 1 and (m.ngravcomp or any(map(np.any, kept)))
    with_flags = "with the flag spring or damper disabled"
    yield _MJX, f"springs, damping or gravity compensation {with_flags}", lost


def _flags(bits: int, kind: type) -> set[str]:
    """Names of the flags set in `bits`, as the MJCF writes them."""
    return {
        name.partition("BL_")[2].lower()  # mjDSBL_GRAVITY, mjENBL_ENERGY; not the count mjNENABLE
        for name, flag in kind.__members__.items()
        if "BL_" in name and bits & int(flag)
    }


def _parts(m: mujoco.MjModel, addresses: Addresses) -> Iterator[Feature]:
    """Features of bodies, joints and actuators."""
    joints, paddle = list(addresses.arm_joints), addresses.paddle_geom
    bodies = m.jnt_bodyid[joints]
    before, parents = np.array([0, *bodies[:-1]]), m.body_weldid[m.body_parentid[bodies]]
    others = m.njnt != len(joints) + len(addresses.balls)
    yield _FUSED, "joints other than the acting ones and the ball's", others
    branches = np.any((bodies != before) & (parents != before))
    yield _FUSED, "an arm that is not one serial chain", branches
    attached = any(np.sum(m.body_weldid == ball.body) != 1 for ball in addresses.balls)
    yield _FUSED, "bodies that are attached to the ball", attached
    elsewhere = m.body_weldid[m.geom_bodyid[paddle]] != bodies[-1]
    yield _FUSED, "a paddle that is not behind the last joint", elsewhere
    shape = m.geom_type[paddle]
    yield _FUSED, "a paddle that is not a box", shape != mujoco.mjtGeom.mjGEOM_BOX
    plain = all(_is_plain(m, ball) for ball in addresses.balls)
    yield _FUSED, "a ball that is not one free homogeneous sphere", not plain
    several = m.nu != len(joints)
    yield _FUSED, "actuators other than one position servo on each joint", several
    affine_gain = (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_AFFINE)
    servos = (
        np.all(m.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE)
        and np.all(np.isin(m.actuator_gaintype, affine_gain))
        and np.all(m.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE)
    )
    yield _FUSED, "actuators that are not position servos", not servos
    # MuJoCo's C engine differentiates the force of such a servo at the clipped input, MJX does not.
    affine = (m.actuator_gaintype == mujoco.mjtGain.mjGAIN_AFFINE) & (m.actuator_gainprm[:, 2] != 0)
    implicit = m.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    clipped = implicit and np.any(affine & m.actuator_ctrllimited.astype(bool))
    yield _MJX, "a limited input of a servo with a velocity gain (gaintype affine)", clipped


def _is_plain(m: mujoco.MjModel, ball: BallAddresses) -> bool:
    """Whether a ball is one free homogeneous sphere."""
    inertia, dofs = m.body_inertia[ball.body], list(ball.qvel)
    moved_or_held = (
        m.body_ipos[ball.body],
        m.geom_pos[ball.geom],
        m.dof_damping[dofs],
        m.dof_armature[dofs],
        m.dof_frictionloss[dofs],
        m.jnt_stiffness[m.body_jntadr[ball.body]],
    )
    return bool(
        m.geom_type[ball.geom] == mujoco.mjtGeom.mjGEOM_SPHERE
        and np.allclose(inertia, inertia[0], rtol=1e-9, atol=0.0)
        and not any(map(np.any, moved_or_held))
    )


def _contacts(m: mujoco.MjModel, addresses: Addresses) -> Iterator[Feature]:
    balls = [ball.geom for ball in addresses.balls]
    pairs = [frozenset(map(int, pair)) for pair in zip(m.pair_geom1, m.pair_geom2, strict=True)]
    touching = {frozenset((addresses.paddle_geom, ball)) for ball in balls}
    possible = touching | {frozenset(pair) for pair in itertools.combinations(balls, 2)}
    missing = len(set(pairs)) != m.npair or not touching <= set(pairs)
    yield _FUSED, "other than one contact pair of the paddle and each ball", missing
    others = not set(pairs) <= possible
    yield _FUSED, "a pair other than of a ball and the paddle or another ball", others
    rolling = max(m.pair_dim[~np.isin(m.pair_dim, (1, 3))], default=0)
    only = f"(condim {rolling}; only condim 1 and 3)"
    yield _FUSED, f"torsional or rolling friction {only}", rolling
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
    slides = gives(parameters, "contact_friction", "pair_friction")
    rubs = gives(parameters, "frictionloss", "dof_frictionloss")
    sliding = slides or np.any(m.pair_dim > 1)
    some = sliding and not slides and np.any(m.pair_dim == 1)
    yield _FUSED, "sliding friction of some contact pairs only", some
    elliptic = sliding and m.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    yield _FUSED, 'sliding friction (contact_friction) with cone="elliptic"', elliptic
    frictional = sliding or rubs or np.any(m.dof_frictionloss)
    noslip = m.opt.noslip_iterations and frictional
    yield _FUSED, "the noslip solver (noslip_iterations) with friction", noslip
    # After one step from 2 of 24 states with a slow arm, MJX differed from C by up to 0.02 rad/s,
    # whatever the solver's tolerance.
    yield _MJX, "dry friction that differs between environments (frictionloss)", rubs


def _refused_by_mjx(mj_model: mujoco.MjModel) -> str | None:
    """MJX's own refusal."""
    try:
        import_mjx().put_model(mj_model)
    except NotImplementedError as error:
        return f"a feature of the MJCF ({error})".replace(".)", ")")
    return None
