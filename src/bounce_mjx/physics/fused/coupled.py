"""Forces of several contacts with sliding friction at one instant, as MuJoCo computes them.

In the units of the cones (`pyramid.py`), the forces x minimise

    1/2 x.(Q + R) x + x.c    over the product of the pyramidal cones

with Q = J M^-1 J^T, which couples the contacts, and the regulariser R. Under an acceleration y,
each contact has the force f(y) that minimises 1/2 f.R f + f.y over its cone, so the solution is
x = f(c + Q x). MuJoCo's Newton method finds it: -f is the gradient of a convex function of y, which
is smooth between the zones in which the contact is open, sticks or slips, and a line search keeps
the steps across zones short enough. Every state runs the same operations, so that the threads of a
GPU kernel do not diverge.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax import lax

from bounce_mjx.physics.fused import chain
from bounce_mjx.physics.fused.contact import ContactModel
from bounce_mjx.physics.fused.pyramid import edge_regulariser
from bounce_mjx.physics.scalars import (
    ZERO3,
    Scalar,
    Vec,
    add,
    dot,
    mul,
    not_inlined,
    sub,
    upper_rows,
    zero_like,
)

# Steps, and steps of the line search in each. Of 180,000 problems of three contacts with the
# pyramidal cone, with friction from 0.01 to 3 that differs between the tangents and impedances up
# to 0.99999, all reach rounding error; with 16 and 6 steps, 373 do not.
_NEWTON_STEPS = 24
_SEARCH_STEPS = 10
_EDGES = tuple(map(Vec, ((1.0, 1.0, 0.0), (1.0, -1.0, 0.0), (1.0, 0.0, 1.0), (1.0, 0.0, -1.0))))


Cone = tuple[jax.Array, Scalar]
"""Whether a contact exists, and the regulariser of each edge of its pyramid, 1/kg."""


def coupled_forces(
    models: Sequence[ContactModel],
    touching: Sequence[jax.Array],
    matrix: Sequence[Scalar],
    offsets: Sequence[Scalar],
    softnesses: Sequence[Scalar],
) -> tuple[Scalar, ...]:
    """Forces [3 k] of k contacts (N): normal, first and second tangent of each.

    Args:
      touching: whether each contact exists.
      matrix: J M^-1 J^T, the upper triangle row by row, 1/kg.
      offsets: J a0 - aref, m/s^2.
      softnesses: regularisers of the normal forces without friction, 1/kg.
    """
    units = [unit for model in models for unit in (1.0, *model.friction)]
    size = len(units)
    upper = upper_rows(matrix, size)
    q = [
        [mul(upper[min(i, j)][abs(i - j)], mul(units[i], units[j])) for j in range(size)]
        for i in range(size)
    ]
    c = list(map(mul, offsets, units))
    cones = [
        (touches, edge_regulariser(model, softness))
        for model, touches, softness in zip(models, touching, softnesses, strict=True)
    ]
    q, c = not_inlined((q, c))

    def newton_step(_, x: tuple[Scalar, ...]) -> tuple[Scalar, ...]:
        return _newton_step(cones, q, c, x)

    start = tuple(map(zero_like, c))
    x = lax.fori_loop(0, _NEWTON_STEPS, newton_step, start)
    return tuple(map(mul, x, units))


def _newton_step(
    cones: Sequence[Cone], q: list[list[Scalar]], c: list[Scalar], x: Sequence[Scalar]
) -> tuple[Scalar, ...]:
    """Forces after one step of Newton's method with a line search.

    With the derivative -L L^T of f, the step s solves s + L L^T Q s = f - x.
    """
    y = [add(entry, dot(row, x)) for entry, row in zip(c, q, strict=True)]
    forces, factors = _response(cones, y)
    lack = [sub(f, entry) for f, entry in zip(forces, x, strict=True)]
    q_lack = [dot(row, lack) for row in q]
    # Columns of L with the first entry's row, and Q L.
    columns = [(3 * k, column) for k, factor in enumerate(factors) for column in factor]
    q_columns = [[dot(row[k : k + 3], column) for row in q] for k, column in columns]
    system = [[dot(column, q_column[k : k + 3]) for q_column in q_columns] for k, column in columns]
    for i, row in enumerate(system):
        row[i] = add(row[i], 1.0)
    factor = not_inlined(chain.cholesky(system))
    pulls = [dot(column, q_lack[k : k + 3]) for k, column in columns]
    z = chain.solve_upper(factor, chain.solve_lower(factor, pulls))
    step, y_step = list(lack), list(q_lack)
    for (k, column), q_column, size in zip(columns, q_columns, z, strict=True):
        for i in range(3):
            step[k + i] = sub(step[k + i], mul(column[i], size))
        y_step = [sub(a, mul(b, size)) for a, b in zip(y_step, q_column, strict=True)]
    x, y, step, y_step = not_inlined((list(x), y, step, y_step))
    return tuple(_ahead(x, _line_search(cones, (x, y), (step, y_step)), step))


def _line_search(
    cones: Sequence[Cone],
    start: tuple[list[Scalar], list[Scalar]],
    step: tuple[list[Scalar], list[Scalar]],
) -> Scalar:
    """Length, from 0 to 2, of a step of the forces x and the accelerations y to the minimum of
    MuJoCo's primal objective along it, where its increasing slope is 0.

    Between its kinks the slope is straight, so Newton's method within a bracket finds its zero
    exactly.
    """
    (x, y), (x_step, y_step) = start, step

    def slope(length: Scalar) -> tuple[Scalar, Scalar]:
        """The slope, and its derivative."""
        forces, factors = _response(cones, _ahead(y, length, y_step))
        lack = [sub(a, f) for a, f in zip(_ahead(x, length, x_step), forces, strict=True)]
        rise = dot(y_step, x_step)
        for k, factor in enumerate(factors):
            for column in factor:
                pull = dot(column, y_step[3 * k : 3 * k + 3])
                rise = add(rise, mul(pull, pull))
        return dot(y_step, lack), rise

    def newton(_, bracket: tuple[Scalar, Scalar, Scalar]) -> tuple[Scalar, Scalar, Scalar]:
        low, high, length = bracket
        here, rise = slope(length)
        low, high = jnp.where(here < 0.0, length, low), jnp.where(here < 0.0, high, length)
        length = length - here / jnp.maximum(rise, float(jnp.finfo(rise.dtype).tiny))
        inside = (length > low) & (length < high)
        return low, high, jnp.where(inside, length, 0.5 * (low + high))

    zero = zero_like(y_step[0])
    return lax.fori_loop(0, _SEARCH_STEPS, newton, (zero, zero + 2.0, zero + 1.0))[2]


def _ahead(start: list[Scalar], length: Scalar, step: list[Scalar]) -> list[Scalar]:
    return [add(a, mul(length, b)) for a, b in zip(start, step, strict=True)]


def _response(
    cones: Sequence[Cone], y: Sequence[Scalar]
) -> tuple[list[Scalar], list[tuple[Vec, ...]]]:
    """f(y) [3 k], and for each contact the columns of L, one for each edge of its pyramid."""
    forces, factors = [], []
    for k, (touches, regulariser) in enumerate(cones):
        own, columns, root = Vec(y[3 * k : 3 * k + 3]), [], lax.rsqrt(regulariser)
        force = ZERO3
        for edge in _EDGES:
            pull = edge @ own
            column = edge * jnp.where(touches & (pull < 0.0), root, 0.0)
            force = force - column * (pull * root)
            columns.append(column)
        forces += force
        factors.append(tuple(columns))
    return forces, factors
