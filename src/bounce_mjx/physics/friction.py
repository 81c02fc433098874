"""Sliding friction of a ball on the paddle and on another ball: Coulomb's impulse.

A ball that slips over what it touches is stopped by an impulse against its slip, of at most the
coefficient of friction times the normal impulse:

    J = -min(m_t |u|, mu f_n dt) u / |u|

u is the slip, the relative velocity of the two surfaces along the contact (m/s); m_t the mass that
the contact feels along it (kg), for a ball on what does not yield 1/m_t = 1/m + r^2/I; f_n the
normal force of the physics step (N). Source: Coulomb's law for the impulse of a time step, e.g.
Stronge, Impact Mechanics (2000), section 5.1.

Each of the three engines (fused, MJX, MuJoCo's C) lets its solver compute the normal forces alone,
as if the contacts had no friction, and gives the impulse after each physics step, with the normals,
the levers and the mass matrix of the step's start. Several contacts follow in the order of the
pairs, each from the slip that the last one left. J is never larger than what stops the slip, so
that friction never adds energy.

MuJoCo's own friction is another law: physics.md compares the two.
"""

import copy
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import mujoco
import numpy as np

from bounce_mjx.physics.scalars import (
    Scalar,
    inverse_root,
    minimum,
    mul,
    quaternion_matrix,
    select,
)
from bounce_mjx.robot.model import Addresses, balls_of_pair, contact_pairs

# Square of a slip that counts as none, m^2/s^2: that of 10 nm/s. The derivative of the impulse has
# the inverse square of the compliance, which float32 must hold.
_NO_SLIP = 1e-16

Array = Any
"""An array of NumPy or of JAX."""


class Grip(NamedTuple):
    """A contact pair with sliding friction."""

    pair: int
    """Index among the model's contact pairs."""
    balls: tuple[int, ...]
    """The ball on the paddle, or the two balls."""


def grips(mj_model: mujoco.MjModel, addresses: Addresses) -> tuple[Grip, ...]:
    """The contact pairs among the balls and the paddle that have sliding friction (`condim` over
    1), in the order of their impulses: each ball with the paddle, then those of two balls."""
    with_friction = []
    for pair in contact_pairs(mj_model, addresses):
        if mj_model.pair_dim[pair] > 1:
            with_friction.append(Grip(pair, balls_of_pair(mj_model, addresses, pair)))
    return tuple(sorted(with_friction, key=lambda grip: (len(grip.balls), grip.balls)))


def solver_model(mj_model: mujoco.MjModel, addresses: Addresses) -> mujoco.MjModel:
    """Copy of a model for a solver: its contacts of the balls and the paddle have no friction."""
    copied = copy.copy(mj_model)
    for grip in grips(mj_model, addresses):
        copied.pair_dim[grip.pair] = 1
    return copied


def unsupported_friction(m: mujoco.MjModel, addresses: Addresses) -> Iterator[tuple[str, bool]]:
    """What this law lacks of MuJoCo's friction: the name of each, and whether a model has it."""
    for pair in contact_pairs(m, addresses):
        dim = int(m.pair_dim[pair])
        yield f"torsional or rolling friction of the ball (condim {dim}; only 1 and 3)", dim > 3
        first, second = m.pair_friction[pair, :2]
        yield (
            f"two coefficients of friction between ball and paddle (friction {first:g} "
            f"{second:g}; only equal ones)",
            dim > 1 and first != second,
        )
    # Its forces are those of the last of four evaluations.
    is_rk4 = m.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    yield "friction of a ball with the integrator RK4", is_rk4 and bool(grips(m, addresses))
    by_type = _touch_by_type(m, addresses)
    yield (
        "friction of a ball and a paddle that touch without a <pair> in <contact> (condim "
        f"{by_type}; only 1)",
        by_type > 1,
    )


def _touch_by_type(m: mujoco.MjModel, addresses: Addresses) -> int:
    """`condim` of a ball's contact with the paddle by the geoms' own types (`contype`); 0 where
    they touch as a pair alone."""
    paired = set()
    for pair in contact_pairs(m, addresses):
        paired.add(frozenset((int(m.pair_geom1[pair]), int(m.pair_geom2[pair]))))
    largest = 0
    for ball in addresses.balls:
        two = [ball.geom, addresses.paddle_geom]
        types = m.geom_contype[two] & m.geom_conaffinity[two[::-1]]
        if np.any(types) and frozenset(two) not in paired:
            largest = max(largest, *m.geom_condim[two].tolist())
    return largest


def impulse_per_slip(squared_slip: Scalar, compliance: Scalar, largest: Scalar) -> Scalar:
    """|J| / |u|, kg: what stops the slip, or the largest impulse of friction, if that is less.

    Args:
      squared_slip: |u|^2, m^2/s^2.
      compliance: |u|^2 / m_t, (m/s)^2/kg: the product of the slip and of what it changes by, if the
        impulse is u.
      largest: mu f_n dt, N s.
    """
    has_none = squared_slip < _NO_SLIP
    squared = select(has_none, 1.0, squared_slip)
    to_stop = squared / select(has_none, 1.0, compliance)
    to_slide = mul(largest, inverse_root(squared))
    return select(has_none, 0.0, minimum(to_stop, to_slide))


def ball_jacobian(quaternion: Array, lever: Array, xp: Any) -> Array:
    """Velocity [3, 6] of a point of a ball per velocity of its free joint: linear in the world,
    and the spin in the ball's frame.

    Args:
      quaternion: orientation [4] of the ball, w, x, y, z, with which the spin is given.
      lever: the point [3] from the ball's centre, in the world, m.
      xp: `numpy` or `jax.numpy`.
    """
    rotation = xp.array(quaternion_matrix(tuple(quaternion)))
    a, b, c = lever
    spin_to_velocity = xp.array([[0.0, c, -b], [-c, 0.0, a], [b, -a, 0.0]])
    return xp.concatenate([np.eye(3), spin_to_velocity @ rotation], axis=1)


def after_friction(
    qvel: Array,
    jacobian: Array,
    normal: Array,
    largest: Scalar,
    solve: Callable[[Array], Array],
) -> Array:
    """Velocities [nv] after the impulse of one contact.

    Args:
      qvel: velocities [nv] after the physics step.
      jacobian: relative velocity [3, nv] of the two surfaces at the contact per velocity.
      normal: unit normal [3].
      largest: mu f_n dt, N s.
      solve: the product of the inverse mass matrix with a vector [nv].
    """
    relative_velocity = jacobian @ qvel
    slip = relative_velocity - normal * (normal @ relative_velocity)
    generalised = jacobian.T @ slip
    change = solve(generalised)
    scale = impulse_per_slip(slip @ slip, generalised @ change, largest)
    return qvel - change * scale
