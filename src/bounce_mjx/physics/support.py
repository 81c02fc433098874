"""What the engines lack of MuJoCo, by the names of its fields.

MJX itself refuses some features and silently ignores others, which would be computed wrongly.
"""

import itertools
from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from bounce_mjx.lazy import import_mjx
from bounce_mjx.physics.friction import unsupported_friction
from bounce_mjx.robot.contact import unsupported_constraints
from bounce_mjx.robot.model import Addresses, BallAddresses, find_addresses
from bounce_mjx.robot.numbers import field_of

Feature = tuple[str, bool]
"""The name of a feature that an engine lacks, and whether a model has it."""

_INTEGRATORS = {"fused": ("implicitfast", "Euler"), "mjx": ("Euler", "RK4", "implicitfast")}
# Flags of the MJCF that `fused.model.read_model` obeys.
_OBEYED = frozenset(("frictionloss", "spring", "eulerdamp"))
# Flags without effect on the supported models.
_WITHOUT_EFFECT = frozenset(
    "equality limit warmstart filterparent sensor midphase autoreset nativeccd island multiccd "
    "energy fwdinv invdiscrete".split()
)
# Fields that must be 0, for features that both engines lack.
_BOTH_ZERO = (
    "opt.disableactuator opt.noslip_iterations nplugin jnt_stiffnesspoly dof_dampingpoly "
    "actuator_dyntype actuator_delay actuator_damping actuator_dampingpoly actuator_armature "
    "pair_adhesion geom_surfacevel"
)
# Further ones, for features that this engine lacks. (The fused engine's contacts come from pairs
# alone, so geoms may not touch by their own types.)
_ZERO = {
    "fused": "opt.density opt.viscosity opt.wind nflex nmocap neq ntendon jnt_limited "
    "geom_contype geom_conaffinity pair_margin pair_gap",
    "mjx": "tendon_stiffnesspoly tendon_dampingpoly actuator_actearly geom_adhesion",
}


def unsupported_feature(
    mj_model: mujoco.MjModel, engine: str, addresses: Addresses | None = None
) -> str | None:
    """Name of a feature of the model that an engine does not support; None if it supports them all.
    `engine.make_engine` refuses the model by this name, or chooses the other engine.

    Args:
      mj_model: the model.
      engine: "fused" or "mjx".
      addresses: of the model's parts, if they are known.
    """
    for name, is_present in _features(mj_model, engine, addresses):
        if is_present:
            return name
    return None


def _features(
    mj_model: mujoco.MjModel, engine: str, addresses: Addresses | None
) -> Iterator[Feature]:
    addresses = addresses or find_addresses(mj_model)
    yield from _common(mj_model, engine)
    yield from unsupported_friction(mj_model, addresses)
    if engine == "fused":
        yield from _fused(mj_model, addresses)
    else:
        yield from _mjx(mj_model)


def _flags(m: mujoco.MjModel) -> set[str]:
    """Names of the flags that are not at their defaults, as the MJCF writes them."""
    names = set()
    bits_of_kind = {
        mujoco.mjtDisableBit: m.opt.disableflags,
        mujoco.mjtEnableBit: m.opt.enableflags,
    }
    for kind, bits in bits_of_kind.items():
        for constant, flag in kind.__members__.items():
            # mjDSBL_GRAVITY, mjENBL_ENERGY; not the count mjNENABLE
            _, is_flag, name = constant.partition("BL_")
            if is_flag and bits & int(flag):
                names.add(name.lower())
    return names


def _common(m: mujoco.MjModel, engine: str) -> Iterator[Feature]:
    integrator = mujoco.mjtIntegrator(m.opt.integrator).name.removeprefix("mjINT_").lower()
    known = _INTEGRATORS[engine]
    only = f"only {', '.join(known[:-1])} and {known[-1]}"
    is_known = integrator in [name.lower() for name in known]
    yield f"the integrator {integrator} ({only})", not is_known
    for name in f"{_BOTH_ZERO} {_ZERO[engine]}".split():
        yield f"{name} (only 0)", bool(np.any(field_of(m, name)))
    yield from unsupported_constraints(m)


def _mjx(m: mujoco.MjModel) -> Iterator[Feature]:
    flags = _flags(m)
    yield "sleeping bodies (sleep)", "sleep" in flags
    # With one of the two disabled, MJX has no passive force at all.
    alone = len(flags & {"spring", "damper"}) == 1
    yield "the flag spring or damper disabled alone", alone
    try:
        import_mjx().put_model(m)
    except NotImplementedError as error:
        yield f"a feature of the MJCF ({error})".replace(".)", ")"), True


def _fused(m: mujoco.MjModel, addresses: Addresses) -> Iterator[Feature]:
    joints = list(addresses.arm_joints)
    paddle = addresses.paddle_geom
    balls = addresses.balls
    lacking = ", ".join(sorted(_flags(m) - _OBEYED - _WITHOUT_EFFECT))
    yield f"the flags of the engine ({lacking})", bool(lacking)
    has_others = m.njnt != len(joints) + len(balls)
    yield "joints other than the acting ones and the ball's", has_others
    yield "an arm that is not one serial chain", _is_branched(m, joints)
    attached = any(np.sum(m.body_weldid == ball.body) != 1 for ball in balls)
    yield "bodies that are attached to the ball", attached
    holder = m.body_weldid[m.geom_bodyid[paddle]]
    yield "a paddle that is not behind the last joint", holder != m.jnt_bodyid[joints[-1]]
    yield "a paddle that is not a box", m.geom_type[paddle] != mujoco.mjtGeom.mjGEOM_BOX
    are_plain = all(_is_plain(m, ball) for ball in balls)
    yield "a ball that is not one free homogeneous sphere", not are_plain
    # `check_servos` has seen that each joint has a position servo.
    yield "actuators other than one position servo on each joint", m.nu != len(joints)
    yield (
        "contact pairs other than one of the paddle and each ball, and of two balls",
        not _has_known_pairs(m, addresses),
    )


def _is_branched(m: mujoco.MjModel, joints: Sequence[int]) -> bool:
    """Whether a joint's body neither is the body of the joint before nor hangs on it."""
    bodies = m.jnt_bodyid[list(joints)]
    bodies_before = np.array([0, *bodies[:-1]])
    parents = m.body_weldid[m.body_parentid[bodies]]
    return bool(np.any((bodies != bodies_before) & (parents != bodies_before)))


def _has_known_pairs(m: mujoco.MjModel, addresses: Addresses) -> bool:
    """Whether there is one contact pair of the paddle and each ball, and at most one of each two
    balls."""
    balls = [ball.geom for ball in addresses.balls]
    with_paddle = {frozenset((addresses.paddle_geom, ball)) for ball in balls}
    of_balls = {frozenset(two) for two in itertools.combinations(balls, 2)}
    pairs = set()
    for geoms in zip(m.pair_geom1.tolist(), m.pair_geom2.tolist(), strict=True):
        pairs.add(frozenset(geoms))
    has_each_once = len(pairs) == m.npair
    return has_each_once and with_paddle <= pairs <= with_paddle | of_balls


def _is_plain(m: mujoco.MjModel, ball: BallAddresses) -> bool:
    """Whether a ball is one free homogeneous sphere."""
    inertia = m.body_inertia[ball.body]
    dofs = list(ball.qvel)
    must_be_zero = (
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
        and not any(np.any(numbers) for numbers in must_be_zero)
    )
