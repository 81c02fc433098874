"""Forces of contacts without friction: the exact solution of MuJoCo's constraint problem with one
inequality for each contact (documentation, "Computation", the dual problem)."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from bounce_mjx.physics.scalars import Scalar, dot, neg, not_inlined, upper_rows


def normal_forces(
    touching: Sequence[jax.Array],
    matrix: Sequence[Scalar],
    offsets: Sequence[Scalar],
    softnesses: Sequence[Scalar],
) -> tuple[jax.Array, ...]:
    """Forces (N) along the normals.

    Args:
      touching: whether each contact exists.
      matrix: J M^-1 J^T, the upper triangle row by row, 1/kg.
      offsets: J a0 - aref, m/s^2.
      softnesses: regularisers, 1/kg.
    """
    rows = upper_rows(matrix, len(touching))
    for row, softness in zip(rows, softnesses, strict=True):
        row[0] = row[0] + softness
    pushes = list(map(neg, offsets))
    if len(touching) == 1:
        forces = nonnegative(rows, pushes)
    else:
        problem = not_inlined(_with_touching_alone(rows, pushes, touching))
        forces = not_inlined(nonnegative(*problem))
    return tuple(jnp.where(t, force, 0.0) for t, force in zip(touching, forces, strict=True))


def _with_touching_alone(
    rows: list[list[Scalar]], pushes: list[Scalar], touches: Sequence[jax.Array]
) -> tuple[list[list[Scalar]], list[Scalar]]:
    """The problem in which a contact that does not touch has no force and no effect."""
    masked = [
        [
            row[0],
            *(jnp.where(t & u, x, 0.0) for u, x in zip(touches[i + 1 :], row[1:], strict=True)),
        ]
        for i, (t, row) in enumerate(zip(touches, rows, strict=True))
    ]
    return masked, [jnp.where(t, x, 0.0) for t, x in zip(touches, pushes, strict=True)]


def nonnegative(rows: list[list[Scalar]], push: list[Scalar]) -> list[Scalar]:
    """Minimum of 1/2 x.Q x - push.x over x >= 0 for a positive definite Q, given by `upper_rows`.

    Without the first entry, the others have their minimum. If the first entry's gradient does not
    pull it from zero there, this is the solution. Otherwise, the first entry is positive, and its
    elimination leaves a problem of the others.
    """
    (pivot, *row), *rest = rows
    first, *others = push
    if not rest:
        return [jnp.maximum(first / pivot, 0.0)]
    without = nonnegative(rest, others)
    ratios = [x / pivot for x in row]
    left = [
        [x - ratio * y for x, y in zip(entries, row[i:], strict=True)]
        for i, (entries, ratio) in enumerate(zip(rest, ratios, strict=True))
    ]
    with_first = nonnegative(left, [x - r * first for x, r in zip(others, ratios, strict=True)])
    pushed = first - dot(row, without) > 0.0
    solved = [jnp.where(pushed, x, y) for x, y in zip(with_first, without, strict=True)]
    return [jnp.where(pushed, first / pivot - dot(ratios, with_first), 0.0), *solved]
