"""Dry friction of the joints (`frictionloss`) together with the contact, as MuJoCo computes them.

Source: MuJoCo's documentation, "Computation" (constraint model: friction loss, the dual problem,
reference acceleration, diagonal regulariser). The joints' friction f and the contact's force p
minimise

    1/2 f.(A + R) f + f.(a0 - aref) + p.J A f + (the contact's objective of p)

over |f_j| <= frictionloss_j and the contact's forces, with the inverse A of the arm's inertia
matrix, the accelerations a0 without both forces, and the contact's Jacobian J.

The solver alternates two steps (Silcowitz, Niebe, Erleben: Projected Gauss-Seidel subspace
minimization method for interactive rigid body dynamics, 2010). Sweeps over the joints find the
sliding ones. Elimination of all others from the contact's problem then is exact, if the sweeps
found the right ones. Every state runs the same operations, so that the threads of a GPU kernel do
not diverge.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from bounce_mjx.physics.fused import chain
from bounce_mjx.physics.scalars import (
    Scalar,
    add,
    dot,
    is_zero,
    mul,
    neg,
    not_inlined,
    sub,
    zero_like,
)

Scalars = Sequence[Scalar]
ContactForce = Callable[[tuple[Scalar, ...], tuple[Scalar, ...]], tuple[Scalar, ...]]

# Rounds, and sweeps in each. In the states of test_friction.py two rounds reach rounding
# error with the shipped ball, and three with a ball as heavy as the arm. Of 50,000 artificial
# problems with most joints at their limits, three rounds miss none with the shipped arm, and 2%
# with an arm of nine joints, by 1e-4 of the largest acceleration at most.
_ROUNDS = 3
_SWEEPS = 5


class DryFrictionProblem(NamedTuple):
    """The problem of k joints with dry friction, and of c components of the contact's force."""

    matrix: list[list[Scalar]]
    """A + R [k, k], 1/(kg m^2)."""
    inverse_diagonal: list[Scalar]
    """Reciprocals [k] of its diagonal."""
    offset: list[Scalar]
    """a0 - aref [k], rad/s^2."""
    coupling: list[list[Scalar]]
    """J A [c, k]."""
    contact_matrix: tuple[Scalar, ...]
    """J A J^T with the ball's share, the upper triangle row by row."""
    contact_offset: tuple[Scalar, ...]
    """J a0 [c], up to a constant."""


def has_friction(link: chain.Link) -> bool:
    """Whether the joint may have dry friction."""
    return not is_zero(link.frictionloss)


def contact_and_friction(
    links: Sequence[chain.Link],
    factor: tuple[chain.SquareMatrix, list[Scalar]],
    joint_velocity: Scalars,
    half_applied: Scalars,
    half_rows: Sequence[Scalars],
    contact_matrix: tuple[Scalar, ...],
    contact_offset: tuple[Scalar, ...],
    contact_force: ContactForce,
) -> tuple[tuple[Scalar, ...], list[Scalar]]:
    """Force of the contact, and dry friction of every joint (N m, N).

    Args:
      factor: Cholesky factor L of the arm's inertia matrix.
      half_applied: L^-1 times the joint forces without contact and dry friction.
      half_rows: L^-1 times each row of the contact's Jacobian.
      contact_matrix: as in `DryFrictionProblem`.
      contact_offset: as in `DryFrictionProblem`, without dry friction.
      contact_force: (contact_matrix, contact_offset) -> force of the contact.
    """
    joints = [i for i, link in enumerate(links) if has_friction(link)]
    friction: list[Scalar] = [0.0] * len(links)
    if not joints:
        return contact_force(contact_matrix, contact_offset), friction
    units = [[1.0 if i == j else 0.0 for i in range(len(links))] for j in joints]
    half = not_inlined([chain.solve_lower(factor, unit) for unit in units])
    matrix = [[dot(a, b) for b in half] for a in half]
    for i, j in enumerate(joints):
        matrix[i][i] = add(matrix[i][i], links[j].friction_softness)
    problem = not_inlined(
        DryFrictionProblem(
            matrix=matrix,
            inverse_diagonal=[1.0 / matrix[i][i] for i in range(len(joints))],
            offset=[
                add(dot(column, half_applied), mul(links[j].friction_damping, joint_velocity[j]))
                for j, column in zip(joints, half, strict=True)
            ],
            coupling=[[dot(row, column) for column in half] for row in half_rows],
            contact_matrix=contact_matrix,
            contact_offset=contact_offset,
        )
    )
    limits = [links[j].frictionloss for j in joints]

    def one_round(_, forces):
        contact, solved = forces
        for _ in range(_SWEEPS):
            solved = not_inlined(_sweep(problem, limits, contact, solved))
            if len(contact) == 1:
                # Without sliding friction the contact's force costs next to nothing.
                contact = contact_force(problem.contact_matrix, _contact_offset(problem, solved))
        return not_inlined(_eliminate_sticking(problem, limits, solved, contact_force))

    none = tuple(map(zero_like, problem.offset))
    start = contact_force(problem.contact_matrix, problem.contact_offset), none
    contact, solved = lax.fori_loop(0, _ROUNDS, one_round, start)
    for j, force in zip(joints, solved, strict=True):
        friction[j] = force
    return contact, friction


def _sweep(
    problem: DryFrictionProblem, limits: Scalars, contact: Scalars, friction: Scalars
) -> tuple[Scalar, ...]:
    """Dry friction after each joint in turn took its best value for the present ones of the others
    (projected Gauss-Seidel)."""
    new = list(friction)
    for j, (row, limit) in enumerate(zip(problem.matrix, limits, strict=True)):
        pull = dot([row[j] for row in problem.coupling], contact)
        pull = add(
            add(problem.offset[j], pull), dot(row[:j] + row[j + 1 :], new[:j] + new[j + 1 :])
        )
        new[j] = _clip(neg(mul(pull, problem.inverse_diagonal[j])), limit)
    return tuple(new)


def _eliminate_sticking(
    problem: DryFrictionProblem, limits: Scalars, friction: Scalars, contact_force: ContactForce
) -> tuple[tuple[Scalar, ...], tuple[Scalar, ...]]:
    """Contact force and dry friction that are exact if each joint below its limit sticks, and if
    each other joint keeps its friction."""
    sticks = [
        lax.convert_element_type(jnp.abs(f) < limit, f.dtype)
        for f, limit in zip(friction, limits, strict=True)
    ]
    kept = [sub(f, mul(f, s)) for f, s in zip(friction, sticks, strict=True)]
    # A sliding joint keeps only its diagonal entry, and its right-hand side is zero.
    masked = [
        [entry if i == j else mul(entry, mul(sticks[i], sticks[j])) for j, entry in enumerate(row)]
        for i, row in enumerate(problem.matrix)
    ]
    factor = not_inlined(chain.cholesky(masked))
    pulls = [
        mul(s, add(x, dot(row, kept)))
        for s, x, row in zip(sticks, problem.offset, problem.matrix, strict=True)
    ]
    half = chain.solve_lower(factor, pulls)
    half_rows = [chain.solve_lower(factor, list(map(mul, row, sticks))) for row in problem.coupling]
    half, half_rows = not_inlined((half, half_rows))
    size = len(half_rows)
    pairs = [(i, j) for i in range(size) for j in range(i, size)]
    contact = contact_force(
        tuple(
            sub(entry, dot(half_rows[i], half_rows[j]))
            for entry, (i, j) in zip(problem.contact_matrix, pairs, strict=True)
        ),
        tuple(
            sub(offset, dot(row, half))
            for offset, row in zip(_contact_offset(problem, kept), half_rows, strict=True)
        ),
    )
    for row, force in zip(half_rows, contact, strict=True):
        half = [add(x, mul(entry, force)) for x, entry in zip(half, row, strict=True)]
    change = chain.solve_upper(factor, half)
    return contact, tuple(
        _clip(sub(f, x), limit) for f, x, limit in zip(kept, change, limits, strict=True)
    )


def _contact_offset(problem: DryFrictionProblem, friction: Scalars) -> tuple[Scalar, ...]:
    """`DryFrictionProblem.contact_offset` with dry friction."""
    return tuple(
        add(offset, dot(row, friction))
        for offset, row in zip(problem.contact_offset, problem.coupling, strict=True)
    )


def _clip(force: Scalar, limit: Scalar) -> Scalar:
    return jnp.clip(force, neg(limit), limit)
