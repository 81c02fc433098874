"""Dry friction of the joints (`frictionloss`) together with the contacts: what MuJoCo's solver
converges to, up to the rare misses at `_ROUNDS`.

Source: MuJoCo's documentation, "Computation" (constraint model: friction loss, the dual problem,
reference acceleration, diagonal regulariser). The joints' friction f and the contacts' forces p
minimise

    1/2 f.(M^-1 + R) f + f.(a0 - aref) + p.J M^-1 f + (the contacts' objective of p)

over |f_j| <= frictionloss_j and the contacts' forces, with the arm's mass matrix M, the
accelerations a0 without both forces, and the contacts' Jacobian J.

The solver alternates two steps (Silcowitz, Niebe, Erleben: Projected Gauss-Seidel subspace
minimization method for interactive rigid body dynamics, 2010). Sweeps over the joints find the
sliding ones. Elimination of all others from the contacts' problem then is exact, if the sweeps
found the right ones. Every state runs the same operations, so that the threads of a GPU kernel do
not diverge.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
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
ContactForces = Callable[[tuple[Scalar, ...], tuple[Scalar, ...]], tuple[Scalar, ...]]

# Rounds, and sweeps in each. In the states of test_friction.py two rounds reach rounding
# error with the shipped ball, and three with a ball as heavy as the arm. Of 50,000 artificial
# problems with most joints at their limits, three rounds miss none with the shipped arm, and 2%
# with an arm of nine joints, by 1e-4 of the largest acceleration at most.
_ROUNDS = 3
_SWEEPS = 5


class DryFrictionProblem(NamedTuple):
    """The problem of k joints with dry friction, and of c components of the contacts' forces."""

    matrix: list[list[Scalar]]
    """M^-1 + R of these joints [k, k], 1/(kg m^2) or 1/kg."""
    inverse_diagonal: list[Scalar]
    """Reciprocals [k] of its diagonal."""
    offsets: list[Scalar]
    """a0 - aref [k], rad/s^2 or m/s^2."""
    coupling: list[list[Scalar]]
    """J M^-1 [c, k]."""
    contact_matrix: tuple[Scalar, ...]
    """J M^-1 J^T with the balls' share, the upper triangle row by row, 1/kg."""
    contact_offsets: tuple[Scalar, ...]
    """J a0 - aref of the contacts [c], without dry friction, m/s^2."""


def has_friction(link: chain.Link) -> bool:
    """Whether the joint may have dry friction."""
    return not is_zero(link.frictionloss)


def contact_and_dry_friction(
    links: Sequence[chain.Link],
    mass_factor: chain.Factor,
    joint_velocity: Scalars,
    half_acceleration: Scalars,
    half_rows: Sequence[Scalars],
    contact_matrix: tuple[Scalar, ...],
    contact_offsets: tuple[Scalar, ...],
    contact_forces: ContactForces,
) -> tuple[tuple[Scalar, ...], list[Scalar]]:
    """Forces of the contacts [c] (N), and dry friction of every joint [n] (N m, N).

    Args:
      links: of the arm.
      mass_factor: Cholesky factor L of the arm's mass matrix.
      joint_velocity: velocities [n] of the joints, rad/s or m/s.
      half_acceleration: L^-1 times the joint forces [n] without contacts and dry friction.
      half_rows: L^-1 times each row of the contacts' Jacobian.
      contact_matrix: as in `DryFrictionProblem`.
      contact_offsets: as in `DryFrictionProblem`.
      contact_forces: (contact_matrix, contact_offsets) -> forces of the contacts [c].
    """
    joints = [i for i, link in enumerate(links) if has_friction(link)]
    dry_friction: list[Scalar] = [0.0] * len(links)
    if not joints:
        return contact_forces(contact_matrix, contact_offsets), dry_friction
    problem = _problem(
        links,
        joints,
        mass_factor,
        joint_velocity,
        half_acceleration,
        half_rows,
        contact_matrix,
        contact_offsets,
    )
    limits = [links[joint].frictionloss for joint in joints]

    def one_round(_round: jax.Array, forces: tuple[Scalars, Scalars]) -> tuple[Scalars, Scalars]:
        contact, friction = forces
        for _ in range(_SWEEPS):
            friction = not_inlined(_sweep(problem, limits, contact, friction))
            if len(contact) == 1:
                # A single force along a normal costs next to nothing. Those of several contacts or
                # with sliding friction are only renewed at the end of a round.
                offsets = _contact_offsets(problem, friction)
                contact = contact_forces(problem.contact_matrix, offsets)
        # The contacts' forces serve the sweeps alone: the elimination finds them anew.
        return not_inlined(_eliminate_sticking(problem, limits, friction, contact_forces))

    contact = contact_forces(problem.contact_matrix, problem.contact_offsets)
    no_friction = tuple(zero_like(offset) for offset in problem.offsets)
    contact, friction = lax.fori_loop(0, _ROUNDS, one_round, (contact, no_friction))
    for joint, force in zip(joints, friction, strict=True):
        dry_friction[joint] = force
    return contact, dry_friction


def _problem(
    links: Sequence[chain.Link],
    joints: Sequence[int],
    mass_factor: chain.Factor,
    joint_velocity: Scalars,
    half_acceleration: Scalars,
    half_rows: Sequence[Scalars],
    contact_matrix: tuple[Scalar, ...],
    contact_offsets: tuple[Scalar, ...],
) -> DryFrictionProblem:
    """The problem of the joints with dry friction, for the arguments of
    `contact_and_dry_friction`."""
    half_columns = []
    for joint in joints:
        unit = [0.0] * len(links)
        unit[joint] = 1.0
        half_columns.append(chain.solve_lower(mass_factor, unit))
    half_columns = not_inlined(half_columns)
    matrix = _products(half_columns, half_columns)
    inverse_diagonal = []
    offsets = []
    for i, joint in enumerate(joints):
        matrix[i][i] = add(matrix[i][i], links[joint].friction_regulariser)
        inverse_diagonal.append(1.0 / matrix[i][i])
        free_acceleration = dot(half_columns[i], half_acceleration)
        damping = mul(links[joint].friction_damping, joint_velocity[joint])
        offsets.append(add(free_acceleration, damping))
    problem = DryFrictionProblem(
        matrix=matrix,
        inverse_diagonal=inverse_diagonal,
        offsets=offsets,
        coupling=_products(half_rows, half_columns),
        contact_matrix=contact_matrix,
        contact_offsets=contact_offsets,
    )
    return not_inlined(problem)


def _products(rows: Sequence[Scalars], columns: Sequence[Scalars]) -> list[list[Scalar]]:
    """Inner product of each row with each column."""
    return [[dot(row, column) for column in columns] for row in rows]


def _sweep(
    problem: DryFrictionProblem, limits: Scalars, contact: Scalars, friction: Scalars
) -> tuple[Scalar, ...]:
    """Dry friction after each joint in turn took its best value for the present ones of the others
    (projected Gauss-Seidel)."""
    swept = list(friction)
    for j, row in enumerate(problem.matrix):
        by_contact = dot([coupling[j] for coupling in problem.coupling], contact)
        by_others = dot(row[:j] + row[j + 1 :], swept[:j] + swept[j + 1 :])
        acceleration = add(add(problem.offsets[j], by_contact), by_others)
        best = neg(mul(acceleration, problem.inverse_diagonal[j]))
        swept[j] = _clip(best, limits[j])
    return tuple(swept)


def _eliminate_sticking(
    problem: DryFrictionProblem, limits: Scalars, friction: Scalars, contact_forces: ContactForces
) -> tuple[tuple[Scalar, ...], tuple[Scalar, ...]]:
    """Contact forces and dry friction that are exact if each joint below its limit sticks, and if
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
        acceleration = add(problem.offsets[i], dot(row, sliding_friction))
        right_hand_side.append(mul(sticks[i], acceleration))
    factor = not_inlined(chain.cholesky(masked))
    half = chain.solve_lower(factor, right_hand_side)
    half_rows = []
    for row in problem.coupling:
        masked_row = list(map(mul, row, sticks))
        half_rows.append(chain.solve_lower(factor, masked_row))
    half, half_rows = not_inlined((half, half_rows))

    reduced_offsets = []
    for i, offset in enumerate(_contact_offsets(problem, sliding_friction)):
        reduced_offsets.append(sub(offset, dot(half_rows[i], half)))
    contact = contact_forces(_reduced_matrix(problem, half_rows), tuple(reduced_offsets))
    for row, force in zip(half_rows, contact, strict=True):
        half = [add(entry, mul(row[i], force)) for i, entry in enumerate(half)]
    changes = chain.solve_upper(factor, half)
    solved = []
    for i, change in enumerate(changes):
        solved.append(_clip(sub(sliding_friction[i], change), limits[i]))
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


def _contact_offsets(problem: DryFrictionProblem, friction: Scalars) -> tuple[Scalar, ...]:
    """`DryFrictionProblem.contact_offsets` with dry friction."""
    offsets = []
    for offset, row in zip(problem.contact_offsets, problem.coupling, strict=True):
        offsets.append(add(offset, dot(row, friction)))
    return tuple(offsets)


def _clip(force: Scalar, limit: Scalar) -> Scalar:
    return jnp.clip(force, neg(limit), limit)
