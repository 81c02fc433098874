"""Forces of contacts without friction: the exact solution of MuJoCo's constraint problem with one
inequality for each contact (documentation, "Computation", the dual problem)."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from bounce_mjx.physics.scalars import Scalar, dot, neg, not_inlined, upper_rows


def normal_forces(
    is_touching: Sequence[jax.Array],
    matrix: Sequence[Scalar],
    offsets: Sequence[Scalar],
    regularisers: Sequence[Scalar],
) -> tuple[jax.Array, ...]:
    """Forces (N) along the normals.

    Args:
      is_touching: whether each contact exists.
      matrix: J M^-1 J^T, the upper triangle row by row, 1/kg.
      offsets: J a0 - aref, m/s^2.
      regularisers: R of each force, 1/kg.
    """
    rows = upper_rows(matrix, len(is_touching))
    for row, regulariser in zip(rows, regularisers, strict=True):
        row[0] = row[0] + regulariser
    linear = [neg(offset) for offset in offsets]
    if len(is_touching) == 1:
        # The mask of the result is enough.
        forces = nonnegative(rows, linear)
    else:
        rows, linear = not_inlined(_with_touching_alone(rows, linear, is_touching))
        forces = not_inlined(nonnegative(rows, linear))
    return tuple(_of_touching(is_touching, forces))


def _with_touching_alone(
    rows: list[list[Scalar]], linear: list[Scalar], is_touching: Sequence[jax.Array]
) -> tuple[list[list[Scalar]], list[Scalar]]:
    """The problem in which a contact that does not touch has no force and no effect."""
    masked_rows = []
    for i, (diagonal, *off_diagonal) in enumerate(rows):
        masked_row = [diagonal]
        for entry, other_touches in zip(off_diagonal, is_touching[i + 1 :], strict=True):
            masked_row.append(jnp.where(is_touching[i] & other_touches, entry, 0.0))
        masked_rows.append(masked_row)
    return masked_rows, _of_touching(is_touching, linear)


def _of_touching(is_touching: Sequence[jax.Array], values: Sequence[Scalar]) -> list[Scalar]:
    """A value of each contact, 0 for those that do not touch."""
    return [jnp.where(touches, x, 0.0) for touches, x in zip(is_touching, values, strict=True)]


def nonnegative(rows: list[list[Scalar]], linear: list[Scalar]) -> list[Scalar]:
    """Minimum of 1/2 x.Q x - linear.x over x >= 0 for a positive definite Q, given by `upper_rows`.

    Without the first entry, the others have their minimum. If the first entry's gradient does not
    pull it from zero there, this is the solution. Otherwise, the first entry is positive, and its
    elimination (the Schur complement) leaves a problem of the others.
    """
    (pivot, *first_row), *other_rows = rows
    first_linear, *other_linear = linear
    if not other_rows:
        return [jnp.maximum(first_linear / pivot, 0.0)]
    without_first = nonnegative(other_rows, other_linear)

    ratios = [entry / pivot for entry in first_row]
    reduced_rows = []
    reduced_linear = []
    for i, ratio in enumerate(ratios):
        pairs = zip(other_rows[i], first_row[i:], strict=True)
        reduced_rows.append([entry - ratio * first_entry for entry, first_entry in pairs])
        reduced_linear.append(other_linear[i] - ratio * first_linear)
    with_first = nonnegative(reduced_rows, reduced_linear)

    is_pulled = first_linear - dot(first_row, without_first) > 0.0
    others = [jnp.where(is_pulled, a, b) for a, b in zip(with_first, without_first, strict=True)]
    first = jnp.where(is_pulled, first_linear / pivot - dot(ratios, with_first), 0.0)
    return [first, *others]
