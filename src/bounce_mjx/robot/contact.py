"""The contact of a ball: a spring and a damper, and the restitution that follows from them.

MuJoCo's `solref` holds both numbers in one of two formats. In the direct one, `solref="-k -b"`, k
is the stiffness, 1/s^2, and b the damping, 1/s; the other one has a time constant and a damping
ratio. `world.sampling` computes the damping of a restitution, and `physics.edited` writes -k and
-b.
"""

import math
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.errors import UserError

PAIR_SETTINGS = "condim solref solreffriction solimp margin gap adhesion friction".split()
"""Attributes of a contact pair in an `MjSpec` that say how its geoms touch."""

_STEPS_OF_A_CONTACT = 4
# Damping ratios of the contact, and the measured restitution: the mean of the drops on the held
# paddle of tests/test_randomization.py, at 1, 2, 3 and 4 m/s and eight phases of the physics step.
# The last entry is not measured: it makes each ratio beyond 1.6 have a restitution of its own, from
# which the ratio follows again.
_DROPS = (
    (0.0, 0.993), (0.005, 0.98), (0.01, 0.965), (0.0152, 0.95), (0.032, 0.90), (0.05, 0.85),
    (0.0697, 0.80), (0.0921, 0.75), (0.116, 0.70), (0.13, 0.674), (0.16, 0.622), (0.2, 0.565),
    (0.2455, 0.50), (0.2873, 0.45), (0.3352, 0.40),
    (0.4, 0.344), (0.5, 0.275), (0.6, 0.222), (0.8, 0.150), (1.0, 0.104), (1.3, 0.063),
    (1.6, 0.043), (100.0, 0.0),
)  # fmt: skip


def damping_of_restitution(restitution: jax.Array, stiffness: float | jax.Array) -> jax.Array:
    """Damping [] of a contact, 1/s, that gives a restitution [] at a stiffness (1/s^2):
    2 zeta sqrt(stiffness), with the damping ratio zeta interpolated between drop tests. The
    restitution is clipped to those of the table, 0 to 0.993."""
    ratios, restitutions = np.array(_DROPS[::-1]).T
    zeta = jnp.interp(restitution, restitutions, ratios)
    return (2.0 * jnp.sqrt(stiffness) * zeta).astype(jnp.asarray(restitution).dtype)


def restitution_of_damping(damping: float, stiffness: float) -> np.ndarray:
    """Restitution [] of a contact with a damping (1/s) at a stiffness (1/s^2): the inverse of
    `damping_of_restitution`, clipped to the same."""
    ratios, restitutions = np.array(_DROPS).T
    return np.interp(damping / (2.0 * np.sqrt(stiffness)), ratios, restitutions)


def stiffness_of_duration(duration: jax.Array) -> jax.Array:
    """Stiffness [] of a contact, 1/s^2, with which a bounce lasts as long (s): half a period of its
    spring."""
    return (math.pi / duration) ** 2


def duration_of_stiffness(stiffness: float) -> float:
    """How long a bounce lasts, s: the inverse of `stiffness_of_duration`."""
    return math.pi / math.sqrt(max(stiffness, 1e-9))


def least_duration(timestep: float) -> float:
    """Shortest contact, s, that physics steps of a length (s) can simulate: with fewer of them, the
    ball can gain energy in a rebound."""
    return _STEPS_OF_A_CONTACT * timestep


def stiffness_and_damping(solref: Any, timestep: float) -> tuple[Any, Any]:
    """Stiffness k, 1/s^2, and damping b, 1/s, of a `solref` [2] in either format (MuJoCo's
    documentation, "Modeling", solver parameters; without the dmax there, which scales the numbers
    of both formats alike).

    Args:
      solref: two floats, or scalars of JAX.
      timestep: of the physics, s.
    """
    first, second = solref
    # MuJoCo's lower limit for the time constant is two steps.
    least_time_constant = 2.0 * timestep
    if isinstance(first, float):
        if first <= 0.0:
            return -first, -second
        time_constant = max(first, least_time_constant)
        return 1.0 / (time_constant * second) ** 2, 2.0 / time_constant
    is_direct = first <= 0.0
    time_constant = jnp.maximum(first, least_time_constant)
    # A stand-in for the direct format's damping, by which one must not divide.
    damping_ratio = jnp.where(is_direct, 1.0, second)
    stiffness = jnp.where(is_direct, -first, 1.0 / (time_constant * damping_ratio) ** 2)
    damping = jnp.where(is_direct, -second, 2.0 / time_constant)
    return stiffness, damping


def check_step(mj_model: mujoco.MjModel) -> None:
    """Refuses a physics step that is too long for a contact pair: its ball would gain energy.

    Raises:
      UserError: half a period of a contact pair has fewer than four physics steps.
    """
    step = mj_model.opt.timestep
    # The engines refuse a mixed format (`unsupported_constraints`).
    for solref in mj_model.pair_solref[~_is_mixed(mj_model.pair_solref)]:
        if least_duration(step) <= _half_period(solref, step) * (1.0 + 1e-3):
            continue
        # A long step lengthens the half period, as it limits the time constant; a short one does
        # not.
        half_period = _half_period(solref, 0.0)
        raise UserError(
            f"physics_dt {step:g} s is too long for a contact whose half period is "
            f"{half_period:.3g} s, and the ball would gain energy; set physics_dt to "
            f"{half_period / _STEPS_OF_A_CONTACT:.4g} s or less"
        )


def _half_period(solref: np.ndarray, timestep: float) -> float:
    """Half a period of a contact's undamped oscillation, s."""
    stiffness, _ = stiffness_and_damping(solref, timestep)
    return duration_of_stiffness(stiffness)


def unsupported_constraints(mj_model: mujoco.MjModel) -> Iterator[tuple[str, bool]]:
    """Settings of constraints that MuJoCo takes with a warning, and that `physics.support` refuses
    for every engine: the name of each, and whether a model has it on a constraint that can act."""
    m = mj_model
    # Dry friction may be sampled in any joint.
    acting = {
        "pair_{}": ("a contact pair's {}", np.ones(m.npair, bool)),
        "geom_{}": ("the {} of a geom that touches", (m.geom_contype | m.geom_conaffinity) != 0),
        "jnt_{}": ("the {}limit of a joint with limits", m.jnt_limited != 0),
        "dof_{}": ("a joint's {}friction", np.ones(m.nv, bool)),
        "eq_{}": ("an equality's {}", m.eq_active0 != 0),
        "tendon_{}_lim": ("the {}limit of a tendon with limits", m.tendon_limited != 0),
        "tendon_{}_fri": ("a tendon's {}friction", m.tendon_frictionloss > 0.0),
    }
    for field, (words, acts) in acting.items():
        is_mixed = _is_mixed(getattr(m, field.format("solref")))
        mixed = f"{words.format('solref')} with exactly one positive number"
        yield mixed, bool(np.any(is_mixed & acts))
        widths = getattr(m, field.format("solimp"))[:, 2]
        no_width = f"{words.format('solimp')} without a width"
        yield no_width, bool(np.any((widths <= mujoco.mjMINVAL) & acts))


def _is_mixed(solrefs: np.ndarray) -> np.ndarray:
    """Whether each solref [k, 2] has one number of each format [k]."""
    return np.sum(solrefs > 0.0, axis=1) == 1
