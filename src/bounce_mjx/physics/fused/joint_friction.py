"""Dry friction of the joints (`frictionloss`) together with the contact, as MuJoCo computes them.

Sources: MuJoCo's documentation, "Computation" (constraint model: friction loss, the dual problem,
reference acceleration, diagonal regulariser), and Silcowitz, Niebe and Erleben, "A nonsmooth
nonlinear conjugate gradient method for interactive contact force problems" and "Projected
Gauss-Seidel subspace minimization method" (2010), for the solver. The forces f of the joints and
the force l of the contact minimise

    1/2 f.(A + R) f + f.c + l.B f + (the contact's objective)    over |f_j| <= frictionloss_j

and the contact's forces, with the inverse A of the arm's inertia matrix, the coupling B = J A of
the contact, and c = a0 - aref. Sweeps over the joints (projected Gauss-Seidel) find the joints that
slide. Newton's method on the others, with the contact eliminated, is then exact. Every state runs
the same operations, so that the threads of a GPU kernel do not diverge.
"""

import functools
from collections.abc import Callable, Iterable, Sequence

import jax.numpy as jnp
from jax import lax

from bounce_mjx.physics.fused import chain
from bounce_mjx.physics.fused.scalars import Scalar, add, is_constant, mul, neg, stored, sub

Scalars = tuple[Scalar, ...]
ContactForce = Callable[[Scalars, Scalars], Scalars]

_ROUNDS = 3
_SWEEPS = 5


def has_friction(link: chain.Link) -> bool:
    """Whether the joint may have dry friction."""
    return not (is_constant(link.frictionloss) and link.frictionloss == 0.0)


def contact_and_friction(
    links: Sequence[chain.Link],
    factor: tuple[chain.SquareMatrix, list[Scalar]],
    joint_velocity: Sequence[Scalar],
    half_applied: Sequence[Scalar],
    half_rows: Sequence[Sequence[Scalar]],
    matrix: Scalars,
    offsets: Scalars,
    contact_force: ContactForce,
) -> tuple[Scalars, list[Scalar]]:
    """Force of the contact and force of dry friction on each joint (N m, N).

    Args:
      factor: Cholesky factor L of the arm's inertia matrix.
      half_applied: L^-1 times the joint forces without contact and dry friction.
      half_rows: L^-1 times each row of the contact's Jacobian J.
      matrix: J M^-1 J^T with the ball's share, the upper triangle row by row.
      offsets: J a0 without dry friction, minus any constant.
      contact_force: (matrix, offsets) -> force of the contact.
    """
    joints = [i for i, link in enumerate(links) if has_friction(link)]
    torques: list[Scalar] = [0.0] * len(links)
    if not joints:
        return contact_force(matrix, offsets), torques
    units = [[1.0 if i == j else 0.0 for i in range(len(links))] for j in joints]
    half = stored([chain.solve_lower(factor, unit) for unit in units])
    limits = [links[j].frictionloss for j in joints]
    g = [[_dot(a, b) for b in half] for a in half]
    for k, j in enumerate(joints):
        g[k][k] = add(g[k][k], links[j].friction_softness)
    b = [[_dot(row, unit) for unit in half] for row in half_rows]
    c = [
        add(_dot(unit, half_applied), mul(links[j].friction_damping, joint_velocity[j]))
        for j, unit in zip(joints, half, strict=True)
    ]
    inverse = [1.0 / g[k][k] for k in range(len(joints))]
    g, b, c, inverse, matrix, offsets = stored((g, b, c, inverse, matrix, offsets))

    def one_round(_, forces: tuple[Scalars, Scalars]) -> tuple[Scalars, Scalars]:
        friction, contact = forces
        for _ in range(_SWEEPS):
            friction = stored(_sweep(g, inverse, _pulled(c, b, contact), limits, friction))
            if len(b) == 1:  # a contact without friction is cheap
                contact = contact_force(matrix, _pulled(offsets, zip(*b, strict=True), friction))
        return stored(_on_free_joints(g, b, c, limits, friction, matrix, offsets, contact_force))

    start = tuple(jnp.zeros_like(x) for x in c), contact_force(matrix, offsets)
    friction, contact = lax.fori_loop(0, _ROUNDS, one_round, start)
    for j, force in zip(joints, friction, strict=True):
        torques[j] = force
    return contact, torques


def _sweep(
    g: chain.SquareMatrix,
    inverse: Sequence[Scalar],
    pulled: Sequence[Scalar],
    limits: Sequence[Scalar],
    friction: Scalars,
) -> Scalars:
    """Sets the friction of each joint in turn to its best value for the others' present ones."""
    new = list(friction)
    for j, row in enumerate(g):
        others = _dot(row[:j] + row[j + 1 :], new[:j] + new[j + 1 :])
        new[j] = _limited(neg(mul(add(pulled[j], others), inverse[j])), limits[j])
    return tuple(new)


def _on_free_joints(
    g: chain.SquareMatrix,
    b: Sequence[Sequence[Scalar]],
    c: Sequence[Scalar],
    limits: Sequence[Scalar],
    friction: Scalars,
    matrix: Scalars,
    offsets: Scalars,
    contact_force: ContactForce,
) -> tuple[Scalars, Scalars]:
    """Friction and contact force that are exact if no joint starts or stops sliding: the joints at
    their limits keep their friction, and the others are eliminated from the contact's problem."""
    n = len(friction)
    free = [
        lax.convert_element_type(jnp.abs(f) < limit, f.dtype)
        for f, limit in zip(friction, limits, strict=True)
    ]
    kept = [sub(f, mul(f, w)) for f, w in zip(friction, free, strict=True)]
    masked = [
        [g[i][j] if i == j else mul(g[i][j], mul(free[i], free[j])) for j in range(n)]
        for i in range(n)
    ]
    factor = stored(chain.cholesky(masked))
    half = chain.solve_lower(
        factor, [mul(w, add(x, _dot(row, kept))) for w, x, row in zip(free, c, g, strict=True)]
    )
    half_b = [chain.solve_lower(factor, list(map(mul, row, free))) for row in b]
    half, half_b = stored((half, half_b))
    pairs = [(i, j) for i in range(len(b)) for j in range(i, len(b))]
    contact = contact_force(
        tuple(
            sub(entry, _dot(half_b[i], half_b[j]))
            for entry, (i, j) in zip(matrix, pairs, strict=True)
        ),
        tuple(
            add(offset, sub(_dot(row, kept), _dot(half_row, half)))
            for offset, row, half_row in zip(offsets, b, half_b, strict=True)
        ),
    )
    pushed = [add(x, _dot(column, contact)) for x, column in zip(half, zip(*half_b), strict=True)]
    eliminated = chain.solve_upper(factor, pushed)
    return tuple(
        _limited(sub(f, x), limit) for f, x, limit in zip(kept, eliminated, limits, strict=True)
    ), contact


def _pulled(constant: Sequence[Scalar], b: Iterable[Sequence[Scalar]], forces: Scalars) -> Scalars:
    """constant + B^T forces, or with the rows of B^T, constant + B forces."""
    columns = zip(*b, strict=True)
    return tuple(add(x, _dot(column, forces)) for x, column in zip(constant, columns, strict=True))


def _limited(force: Scalar, limit: Scalar) -> Scalar:
    return jnp.clip(force, neg(limit), limit)


def _dot(a: Sequence[Scalar], b: Sequence[Scalar]) -> Scalar:
    return functools.reduce(add, map(mul, a, b), 0.0)
