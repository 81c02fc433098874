"""What the engines lack of MuJoCo, by the names of its fields.

MJX itself refuses some features and silently ignores others, which would be computed wrongly.
"""

import itertools
from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from bounce_mjx.lazy import import_mjx
from bounce_mjx.robot.model import BallAddresses, find_addresses

Feature = tuple[str, bool]
"""The name of a feature that an engine lacks, and whether a model has it."""

_INTEGRATORS = {"fused": ("implicitfast", "Euler"), "mjx": ("Euler", "RK4", "implicitfast")}
# Flags of the MJCF that `fused.read_model` obeys, or without effect on the supported models.
_HARMLESS = frozenset(
    "equality frictionloss limit spring warmstart filterparent sensor midphase eulerdamp "
    "autoreset nativeccd island multiccd energy fwdinv invdiscrete".split()
)
# Fields that must be 0: features that both engines lack, and that one of them lacks.
_BOTH_ZERO = (
    "opt.disableactuator opt.noslip_iterations nplugin jnt_stiffnesspoly dof_dampingpoly "
    "actuator_dyntype actuator_delay actuator_damping actuator_dampingpoly actuator_armature "
    "pair_adhesion"
)
_ZERO = {
    "fused": "opt.density opt.viscosity opt.wind nflex nmocap neq ntendon jnt_limited "
    "geom_contype geom_conaffinity pair_margin pair_gap",
    "mjx": "tendon_stiffnesspoly tendon_dampingpoly actuator_actearly geom_adhesion "
    "geom_surfacevel",
}


def unsupported_feature(mj_model: mujoco.MjModel, engine: str) -> str | None:
    """Name of a feature of the model that an engine, "fused" or "mjx", does not support; None if it
    supports them all."""
    own = _fused(mj_model) if engine == "fused" else _mjx(mj_model)
    features = itertools.chain(_common(mj_model, engine), own)
    return next((name for name, present in features if present), None)


def unsupported_friction(mj_model: mujoco.MjModel, pair_dim: Sequence[int]) -> str | None:
    """Name of a feature of the contacts that the fused engine lacks, if they have these `condim`s;
    None if it has them all."""
    dims = set(map(int, pair_dim))
    if not dims <= {1, 3}:
        return f"torsional or rolling friction (condim {max(dims)}; only condim 1 and 3)"
    if dims == {1, 3}:
        return "sliding friction of some contact pairs only"
    if 3 in dims and mj_model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
        return 'sliding friction (contact_friction) with cone="elliptic"'
    return None


def _flags(m: mujoco.MjModel) -> set[str]:
    """Names of the flags that are not at their defaults, as the MJCF writes them."""
    kinds = (m.opt.disableflags, mujoco.mjtDisableBit), (m.opt.enableflags, mujoco.mjtEnableBit)
    return {
        name.partition("BL_")[2].lower()  # mjDSBL_GRAVITY, mjENBL_ENERGY; not the count mjNENABLE
        for bits, kind in kinds
        for name, flag in kind.__members__.items()
        if "BL_" in name and bits & int(flag)
    }


def _common(m: mujoco.MjModel, engine: str) -> Iterator[Feature]:
    integrator = mujoco.mjtIntegrator(m.opt.integrator).name.removeprefix("mjINT_").lower()
    known = _INTEGRATORS[engine]
    only = f"only {', '.join(known[:-1])} and {known[-1]}"
    lacking = integrator not in [name.lower() for name in known]
    yield f"the integrator {integrator} ({only})", lacking
    for name in f"{_BOTH_ZERO} {_ZERO[engine]}".split():
        value = getattr(m.opt if name.startswith("opt.") else m, name.removeprefix("opt."))
        yield f"{name} (only 0)", bool(np.any(value))
    for part in "pair_{} geom_{} jnt_{} dof_{} eq_{} tendon_{}_lim tendon_{}_fri".split():
        solref, solimp = (getattr(m, part.format(kind)) for kind in ("solref", "solimp"))
        mixed = np.any(np.sum(solref > 0.0, axis=1) == 1)
        yield f"a {part.format('solref')} with exactly one positive number", bool(mixed)
        narrow = np.any(solimp[:, 2] <= mujoco.mjMINVAL)
        yield f"a {part.format('solimp')} without a width", bool(narrow)


def _mjx(m: mujoco.MjModel) -> Iterator[Feature]:
    flags = _flags(m)
    yield "sleeping bodies (sleep)", "sleep" in flags
    # With one of the two disabled, MJX has no passive force at all.
    one = len(flags & {"spring", "damper"}) == 1
    yield "the flag spring or damper disabled alone", one
    try:
        import_mjx().put_model(m)
    except NotImplementedError as error:
        yield f"a feature of the MJCF ({error})".replace(".)", ")"), True


def _fused(m: mujoco.MjModel) -> Iterator[Feature]:
    at = find_addresses(m)
    lacking = ", ".join(sorted(_flags(m) - _HARMLESS))
    yield f"the flags of the engine ({lacking})", bool(lacking)
    joints, paddle, balls = list(at.arm_joints), at.paddle_geom, at.balls
    bodies = m.jnt_bodyid[joints]
    before, parents = np.array([0, *bodies[:-1]]), m.body_weldid[m.body_parentid[bodies]]
    yield "joints other than the acting ones and the ball's", m.njnt != len(joints) + len(balls)
    branches = np.any((bodies != before) & (parents != before))
    yield "an arm that is not one serial chain", branches
    attached = any(np.sum(m.body_weldid == ball.body) != 1 for ball in balls)
    yield "bodies that are attached to the ball", attached
    behind = m.body_weldid[m.geom_bodyid[paddle]] == bodies[-1]
    yield "a paddle that is not behind the last joint", not behind
    yield "a paddle that is not a box", m.geom_type[paddle] != mujoco.mjtGeom.mjGEOM_BOX
    plain = all(_is_plain(m, ball) for ball in balls)
    yield "a ball that is not one free homogeneous sphere", not plain
    yield "actuators other than one position servo on each joint", m.nu != len(joints)
    pairs = [frozenset(map(int, pair)) for pair in zip(m.pair_geom1, m.pair_geom2, strict=True)]
    geoms = [ball.geom for ball in balls]
    with_paddle = {frozenset((paddle, geom)) for geom in geoms}
    between = {frozenset(two) for two in itertools.combinations(geoms, 2)}
    known = len(set(pairs)) == m.npair and with_paddle <= set(pairs) <= with_paddle | between
    yield "contact pairs other than one of the paddle and each ball, and of two balls", not known
    friction = unsupported_friction(m, m.pair_dim)
    yield str(friction), friction is not None


def _is_plain(m: mujoco.MjModel, ball: BallAddresses) -> bool:
    """Whether a ball is one free homogeneous sphere."""
    inertia, dofs = m.body_inertia[ball.body], list(ball.qvel)
    held = [getattr(m, f"dof_{name}")[dofs] for name in ("damping", "armature", "frictionloss")]
    held.append(m.jnt_stiffness[m.body_jntadr[ball.body]])
    moved = m.body_ipos[ball.body], m.geom_pos[ball.geom]
    return bool(
        m.geom_type[ball.geom] == mujoco.mjtGeom.mjGEOM_SPHERE
        and np.allclose(inertia, inertia[0], rtol=1e-9, atol=0.0)
        and not any(map(np.any, (*moved, *held)))
    )
