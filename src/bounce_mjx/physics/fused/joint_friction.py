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
    upper_rows,
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
    """J a0 - aref of the contact [c], without dry friction, m/s^2."""


def has_friction(link: chain.Link) -> bool:
    """Whether the joint may have dry friction."""
    return not is_zero(link.frictionloss)


def contact_and_friction(
    links: Sequence[chain.Link],
    factor: chain.Factor,
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
    problem = _problem(
        links,
        joints,
        factor,
        joint_velocity,
        half_applied,
        half_rows,
        contact_matrix,
        contact_offset,
    )
    limits = [links[j].frictionloss for j in joints]

    def one_round(_: int, forces: tuple[Scalars, Scalars]) -> tuple[Scalars, Scalars]:
        contact, joint_forces = forces
        for _ in range(_SWEEPS):
            joint_forces = not_inlined(_sweep(problem, limits, contact, joint_forces))
            if len(contact) == 1:
                # Without sliding friction the contact's force costs next to nothing.
                offset = _contact_offset(problem, joint_forces)
                contact = contact_force(problem.contact_matrix, offset)
        return not_inlined(_eliminate_sticking(problem, limits, joint_forces, contact_force))

    contact = contact_force(problem.contact_matrix, problem.contact_offset)
    no_friction = tuple(zero_like(offset) for offset in problem.offset)
    contact, joint_forces = lax.fori_loop(0, _ROUNDS, one_round, (contact, no_friction))
    for joint, force in zip(joints, joint_forces, strict=True):
        friction[joint] = force
    return contact, friction


def _problem(
    links: Sequence[chain.Link],
    joints: Sequence[int],
    factor: chain.Factor,
    joint_velocity: Scalars,
    half_applied: Scalars,
    half_rows: Sequence[Scalars],
    contact_matrix: tuple[Scalar, ...],
    contact_offset: tuple[Scalar, ...],
) -> DryFrictionProblem:
    """The problem of the joints with dry friction, for the arguments of `contact_and_friction`."""
    half_columns = []
    for joint in joints:
        unit = [0.0] * len(links)
        unit[joint] = 1.0
        half_columns.append(chain.solve_lower(factor, unit))
    half_columns = not_inlined(half_columns)
    matrix = [[dot(a, b) for b in half_columns] for a in half_columns]
    offset = []
    for i, joint in enumerate(joints):
        matrix[i][i] = add(matrix[i][i], links[joint].friction_softness)
        free_acceleration = dot(half_columns[i], half_applied)
        damping = mul(links[joint].friction_damping, joint_velocity[joint])
        offset.append(add(free_acceleration, damping))
    problem = DryFrictionProblem(
        matrix=matrix,
        inverse_diagonal=[1.0 / matrix[i][i] for i in range(len(joints))],
        offset=offset,
        coupling=[[dot(row, column) for column in half_columns] for row in half_rows],
        contact_matrix=contact_matrix,
        contact_offset=contact_offset,
    )
    return not_inlined(problem)


def _sweep(
    problem: DryFrictionProblem, limits: Scalars, contact: Scalars, friction: Scalars
) -> tuple[Scalar, ...]:
    """Dry friction after each joint in turn took its best value for the present ones of the others
    (projected Gauss-Seidel)."""
    swept = list(friction)
    for j, (row, limit) in enumerate(zip(problem.matrix, limits, strict=True)):
        by_contact = dot([coupling[j] for coupling in problem.coupling], contact)
        by_others = dot(row[:j] + row[j + 1 :], swept[:j] + swept[j + 1 :])
        acceleration = add(add(problem.offset[j], by_contact), by_others)
        swept[j] = _clip(neg(mul(acceleration, problem.inverse_diagonal[j])), limit)
    return tuple(swept)


def _eliminate_sticking(
    problem: DryFrictionProblem, limits: Scalars, friction: Scalars, contact_force: ContactForce
) -> tuple[tuple[Scalar, ...], tuple[Scalar, ...]]:
    """Contact force and dry friction that are exact if each joint below its limit sticks, and if
    each other joint keeps its friction."""
    sticks = []
    sliding_friction = []
    for force, limit in zip(friction, limits, strict=True):
        stick = lax.convert_element_type(jnp.abs(force) < limit, force.dtype)
        sticks.append(stick)
        sliding_friction.append(sub(force, mul(force, stick)))
    # A sliding joint keeps only its diagonal entry, and its right-hand side is zero.
    masked = []
    right_hand_side = []
    for i, row in enumerate(problem.matrix):
        masked_row = [mul(entry, mul(sticks[i], sticks[j])) for j, entry in enumerate(row)]
        masked_row[i] = row[i]
        masked.append(masked_row)
        acceleration = add(problem.offset[i], dot(row, sliding_friction))
        right_hand_side.append(mul(sticks[i], acceleration))
    factor = not_inlined(chain.cholesky(masked))
    half = chain.solve_lower(factor, right_hand_side)
    half_rows = []
    for row in problem.coupling:
        masked_row = [mul(entry, stick) for entry, stick in zip(row, sticks, strict=True)]
        half_rows.append(chain.solve_lower(factor, masked_row))
    half, half_rows = not_inlined((half, half_rows))

    contact = contact_force(
        _reduced_matrix(problem, half_rows),
        tuple(
            sub(offset, dot(row, half))
            for offset, row in zip(
                _contact_offset(problem, sliding_friction), half_rows, strict=True
            )
        ),
    )
    for row, force in zip(half_rows, contact, strict=True):
        half = [
            add(entry, mul(row_entry, force)) for entry, row_entry in zip(half, row, strict=True)
        ]
    changes = chain.solve_upper(factor, half)
    solved = []
    for force, change, limit in zip(sliding_friction, changes, limits, strict=True):
        solved.append(_clip(sub(force, change), limit))
    return contact, tuple(solved)


def _reduced_matrix(
    problem: DryFrictionProblem, half_rows: Sequence[Scalars]
) -> tuple[Scalar, ...]:
    """`contact_matrix` without the sticking joints: its Schur complement."""
    upper = upper_rows(problem.contact_matrix, len(half_rows))
    entries = []
    for i in range(len(half_rows)):
        for j in range(i, len(half_rows)):
            entries.append(sub(upper[i][j - i], dot(half_rows[i], half_rows[j])))
    return tuple(entries)


def _contact_offset(problem: DryFrictionProblem, friction: Scalars) -> tuple[Scalar, ...]:
    """`DryFrictionProblem.contact_offset` with dry friction."""
    return tuple(
        add(offset, dot(row, friction))
        for offset, row in zip(problem.contact_offset, problem.coupling, strict=True)
    )


def _clip(force: Scalar, limit: Scalar) -> Scalar:
    return jnp.clip(force, neg(limit), limit)
