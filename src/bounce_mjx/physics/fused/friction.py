"""Forces of contacts with sliding friction (`condim="3"`) at one instant, as MuJoCo computes them.

The force of a contact, f_n along the normal and f_1, f_2 along the tangents, stays in the pyramid
|f_1| / mu_1 + |f_2| / mu_2 <= f_n. In units of the cone, x = (f_n, f_1 / mu_1, f_2 / mu_2), these
are the sums a_1 e_1 + ... + a_4 e_4 of the edges e = (1, +-1, 0), (1, 0, +-1) with coefficients
a >= 0. In these units, which `pyramid_force` and `coupled_forces` convert from and into N and all
other functions here have, the forces x of all contacts minimise

    1/2 x.Q x + c.x + (for each contact, R / 2 times the sum of its squared coefficients)

with Q = D J M^-1 J^T D, which couples the contacts, c = D (J a0 - aref), D the diagonal matrix of
(1, mu_1, mu_2) for each contact, and a0 the acceleration without the contacts. R regularises the
coefficients of a contact's edges; it is no matrix on x.

One contact alone has a closed form (`pyramid_force`). Of several, each has under an acceleration y
the force x(y) that minimises x.y + R / 2 (a_1^2 + ... + a_4^2): each edge has the coefficient
a = max(0, -e.y) / R. The solution is x = x(c + Q x). MuJoCo's Newton method finds it
(`coupled_forces`): -x(y) is the gradient of a convex function s(y), which is smooth between the
zones in which the contact is open, sticks or slips, and a line search keeps the steps across zones
short enough. It minimises MuJoCo's primal objective 1/2 x.Q x + s(c + Q x), whose slope along a
step d is (Q d).(x - x(y)).

Every state runs the same operations, so that the threads of a GPU kernel do not diverge.

Sources: MuJoCo's documentation, "Computation" (constraint model: friction cones, the dual problem,
diagonal regulariser), and its source code for the regulariser.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from bounce_mjx.physics.fused import chain
from bounce_mjx.physics.fused.contact import ContactModel
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

# Steps, and steps of the line search in each. No number is proven to suffice: of 180,000 problems
# of three contacts, with friction from 0.01 to 3 that differs between the tangents and impedances
# up to 0.99999, all reach rounding error with these; with 16 and 6 steps, 373 do not.
_NEWTON_STEPS = 24
_SEARCH_STEPS = 10
_EDGES = (
    Vec((1.0, 1.0, 0.0)),
    Vec((1.0, -1.0, 0.0)),
    Vec((1.0, 0.0, 1.0)),
    Vec((1.0, 0.0, -1.0)),
)
Scalars = tuple[Scalar, ...]


class Cone(NamedTuple):
    """The pyramid of one of several contacts (`coupled_forces`); of a single one, `_Pyramid`."""

    is_touching: jax.Array
    """Whether the contact exists."""
    regulariser: Scalar
    """R, 1/kg."""


class Column(NamedTuple):
    """A column of the matrix L of `_newton_step`, of which three entries are not 0."""

    start: int
    """Row of the first entry."""
    entries: Vec
    """The edge of a pyramid over the root of R; 0 where its coefficient is 0."""

    def dot(self, vector: Sequence[Scalar]) -> Scalar:
        """Inner product with a vector [3 k]."""
        return dot(self.entries, vector[self.start : self.start + 3])


def edge_regulariser(model: ContactModel, normal_regulariser: Scalar) -> Scalar:
    """R of the coefficients of a contact's edges, 1/kg; MuJoCo takes the friction along the first
    tangent for all four.

    Args:
      normal_regulariser: that of the normal force without friction, 1/kg.
    """
    squared = mul(model.friction[0], model.friction[0])
    factor = mul(mul(2.0 / model.impratio, squared), add(1.0, squared))
    return mul(factor, normal_regulariser)


class _Pyramid(NamedTuple):
    """The problem of one contact in units of the cone (`pyramid_force`), from its symmetric matrix
    Q and its offsets c."""

    q00: Scalar
    q01: Scalar
    q02: Scalar
    q11: Scalar
    q12: Scalar
    q22: Scalar
    c0: Scalar
    c1: Scalar
    c2: Scalar
    regulariser: Scalar
    """R, 1/kg."""


class _Candidate(NamedTuple):
    """The solution of `pyramid_force` if one set of edges is active."""

    force: Scalars
    """x [3] in units of the cone."""
    score: jax.Array
    """Least slack of the conditions that make it the solution: negative where one is broken."""


def pyramid_force(
    model: ContactModel,
    matrix: Sequence[Scalar],
    offsets: Sequence[Scalar],
    normal_regulariser: Scalar,
) -> Scalars:
    """Force [normal, first and second tangent] of a contact, N, in closed form.

    With the coefficients a_i >= 0 of the four edges, x = (s1 + s2, t1, t2), where s1 = a_1 + a_2
    and t1 = a_1 - a_2 belong to the edges (1, +-1, 0), s2 and t2 to (1, 0, +-1). Since
    a_1^2 + a_2^2 = (s1^2 + t1^2) / 2, the objective is, with h = R / 2,

        1/2 x.Q x + c.x + h/2 (s1^2 + t1^2 + s2^2 + t2^2),    s1 >= |t1|, s2 >= |t2|

    The first pair of edges has four active sets: none, both, the first or the second edge. Each
    function below assumes one of them (`_with_one_edge` either edge), eliminates s1 and t1, which
    gives a problem of the same form for s2 and t2 alone (`_pair_minimum`), and scores the result.
    The problem is strictly convex, so exactly one set fits, up to rounding: the one with the
    highest score. Sums and differences of the coefficients avoid cancellation at small friction,
    and so do the products that are written out where a difference of two large ones is expected.

    Args:
      matrix: J M^-1 J^T, the upper triangle row by row, 1/kg.
      offsets: J a0 - aref, m/s^2.
      normal_regulariser: that of the normal force without friction, 1/kg.
    """
    units = (1.0, *model.friction)
    places = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    q = []
    for entry, (i, j) in zip(matrix, places, strict=True):
        q.append(mul(entry, mul(units[i], units[j])))
    c = map(mul, offsets, units)
    problem = _Pyramid(*q, *c, edge_regulariser(model, normal_regulariser))

    best = _better(_without_first_pair(problem), _with_first_pair(problem))

    def try_edge(edge: jax.Array, best: _Candidate) -> _Candidate:
        sign = 1.0 - 2.0 * lax.convert_element_type(edge, problem.q01.dtype)
        return _better(best, _with_one_edge(problem, sign))

    best = lax.fori_loop(0, 2, try_edge, best)
    return tuple(map(mul, best.force, units))


def _better(a: _Candidate, b: _Candidate) -> _Candidate:
    """The candidate with the higher score."""
    is_better = b.score > a.score
    force = tuple(jnp.where(is_better, y, x) for x, y in zip(a.force, b.force, strict=True))
    return _Candidate(force, jnp.maximum(a.score, b.score))


def _without_first_pair(problem: _Pyramid) -> _Candidate:
    """Neither edge of the first pair is active: s1 = t1 = 0. The gradients along them,
    normal +- tangent, must not be negative."""
    q00, q01, q02, _, q12, q22, c0, c1, c2, regulariser = problem
    s2, t2 = _pair_minimum(q00, q02, q22, c0, c2, regulariser)
    normal_gradient = c0 + q00 * s2 + q02 * t2
    tangent_gradient = c1 + q01 * s2 + q12 * t2
    force = (s2, jnp.zeros_like(t2), t2)
    return _Candidate(force, normal_gradient - jnp.abs(tangent_gradient))


def _with_first_pair(problem: _Pyramid) -> _Candidate:
    """Both edges of the first pair are active, so s1 and t1 make their gradients 0:

        [q00 + h, q01; q01, q11 + h] (s1, t1) = -(normal_gradient, tangent_gradient)

    Both coefficients must be positive: s1 > |t1|.
    """
    q00, q01, q02, q11, q12, q22, c0, c1, c2, regulariser = problem
    h = 0.5 * regulariser
    k00 = q00 + h
    k11 = q11 + h
    inverse_determinant = 1.0 / (k00 * k11 - q01 * q01)
    # The Schur complement in s2 and t2; with k00 = q00 + h, its first row has the factor h.
    p00 = h * (q00 * k11 - q01 * q01) * inverse_determinant
    p02 = h * (k11 * q02 - q01 * q12) * inverse_determinant
    eliminated = k11 * q02 * q02 - 2.0 * q01 * q02 * q12 + k00 * q12 * q12
    p22 = q22 - eliminated * inverse_determinant
    g0 = h * (k11 * c0 - q01 * c1) * inverse_determinant
    eliminated = k11 * q02 * c0 - q01 * (q02 * c1 + q12 * c0) + k00 * q12 * c1
    g2 = c2 - eliminated * inverse_determinant
    s2, t2 = _pair_minimum(p00, p02, p22, g0, g2, regulariser)

    normal_gradient = c0 + q00 * s2 + q02 * t2
    tangent_gradient = c1 + q01 * s2 + q12 * t2
    s1 = (q01 * tangent_gradient - k11 * normal_gradient) * inverse_determinant
    t1 = (q01 * normal_gradient - k00 * tangent_gradient) * inverse_determinant
    # In the unit of a gradient, as the other scores.
    return _Candidate((s1 + s2, t1, t2), (s1 - jnp.abs(t1)) * q00)


def _with_one_edge(problem: _Pyramid, sign: jax.Array) -> _Candidate:
    """One edge of the first pair, e = (1, sign, 0), is active with the coefficient a, which makes
    its gradient 0:

        (e.Q e + R) a = -(g + r0 s2 + r2 t2)

    with r0 = e.Q (1, 0, 0), r2 = e.Q (0, 0, 1), g = e.c, and e.Q e + R = r0 + rest. The coefficient
    must be positive, and the gradient along the other edge must not be negative.
    """
    q00, q01, q02, q11, q12, q22, c0, c1, c2, regulariser = problem
    # The tangent's sign turned, so that the edge is (1, 1, 0).
    signed_q01 = sign * q01
    signed_q12 = sign * q12
    signed_c1 = sign * c1
    r0 = q00 + signed_q01
    r2 = q02 + signed_q12
    g = c0 + signed_c1
    rest = signed_q01 + q11 + regulariser
    inverse = 1.0 / (r0 + rest)
    # The Schur complement in s2 and t2, with q00 = r0 - signed_q01 inserted against cancellation.
    s2, t2 = _pair_minimum(
        (q00 * (q11 + regulariser) - q01 * q01) * inverse,
        (q02 * rest - signed_q12 * r0) * inverse,
        q22 - r2 * r2 * inverse,
        (c0 * rest - signed_c1 * r0) * inverse,
        c2 - r2 * g * inverse,
        regulariser,
    )
    edge_gradient = g + r0 * s2 + r2 * t2
    coefficient = -edge_gradient * inverse
    normal = s2 + coefficient
    normal_gradient = c0 + q00 * normal + signed_q01 * coefficient + q02 * t2
    tangent_gradient = signed_c1 + signed_q01 * normal + q11 * coefficient + signed_q12 * t2
    other_edge_gradient = normal_gradient - tangent_gradient
    score = jnp.minimum(-edge_gradient, other_edge_gradient)
    return _Candidate((normal, sign * coefficient, t2), score)


def _pair_minimum(
    p00: Scalar, p02: Scalar, p22: Scalar, g0: Scalar, g2: Scalar, regulariser: Scalar
) -> tuple[jax.Array, jax.Array]:
    """Sum s and difference t of the coefficients of the edges (1, 0, +-1) at the minimum of

    1/2 (p00 s^2 + 2 p02 s t + p22 t^2) + g0 s + g2 t + h/2 (s^2 + t^2),    s >= |t|
    """
    h = 0.5 * regulariser
    k00 = p00 + h
    k22 = p22 + h
    inverse_determinant = 1.0 / (k00 * k22 - p02 * p02)
    s_both = (p02 * g2 - k22 * g0) * inverse_determinant
    t_both = (p02 * g0 - k00 * g2) * inverse_determinant
    both_active = s_both >= jnp.abs(t_both)
    # At most one edge is active: the one that leaves the larger gradient on the other.
    diagonal = p00 + p22 + regulariser
    off_diagonal = p00 - p22
    plus = jnp.maximum(-(g0 + g2) / (diagonal + 2.0 * p02), 0.0)
    minus = jnp.maximum(-(g0 - g2) / (diagonal - 2.0 * p02), 0.0)
    plus_active = g0 - g2 + off_diagonal * plus >= g0 + g2 + off_diagonal * minus
    s_one = jnp.where(plus_active, plus, minus)
    t_one = jnp.where(plus_active, plus, -minus)
    return jnp.where(both_active, s_both, s_one), jnp.where(both_active, t_both, t_one)


def coupled_forces(
    models: Sequence[ContactModel],
    is_touching: Sequence[jax.Array],
    matrix: Sequence[Scalar],
    offsets: Sequence[Scalar],
    normal_regularisers: Sequence[Scalar],
) -> Scalars:
    """Forces [3 k] of k contacts (N): normal, first and second tangent of each.

    Args:
      is_touching: whether each contact exists.
      matrix: J M^-1 J^T, the upper triangle row by row, 1/kg.
      offsets: J a0 - aref, m/s^2.
      normal_regularisers: those of the normal forces without friction, 1/kg.
    """
    units: list[Scalar] = []
    for model in models:
        units.extend((1.0, *model.friction))
    size = len(units)
    upper = upper_rows(matrix, size)
    q: list[list[Scalar]] = []
    for i in range(size):
        row = []
        for j in range(size):
            entry = upper[min(i, j)][abs(i - j)]
            row.append(mul(entry, mul(units[i], units[j])))
        q.append(row)
    c = list(map(mul, offsets, units))
    cones = []
    for k, model in enumerate(models):
        cones.append(Cone(is_touching[k], edge_regulariser(model, normal_regularisers[k])))
    q, c = not_inlined((q, c))

    def newton_step(_: jax.Array, x: Scalars) -> Scalars:
        return _newton_step(cones, q, c, x)

    start = tuple(zero_like(entry) for entry in c)
    x = lax.fori_loop(0, _NEWTON_STEPS, newton_step, start)
    return tuple(map(mul, x, units))


def _newton_step(
    cones: Sequence[Cone], q: list[list[Scalar]], c: list[Scalar], x: Scalars
) -> Scalars:
    """Forces after one step of Newton's method with a line search.

    The residual is x(y) - x at the acceleration y = c + Q x. With the derivative -L L^T of x(y),
    the step d solves (I + L L^T Q) d = residual. Woodbury's formula leaves a symmetric system in as
    many unknowns z as L has columns:

        (I + L^T Q L) z = L^T Q residual,    d = residual - L z
    """
    y = [add(entry, dot(row, x)) for entry, row in zip(c, q, strict=True)]
    forces, columns = _response(cones, y)
    residual = list(map(sub, forces, x))
    q_residual = [dot(row, residual) for row in q]

    system = []
    right_hand_side = []
    q_columns = []
    for column in columns:
        q_columns.append([column.dot(row) for row in q])
    for i, column in enumerate(columns):
        system_row = [column.dot(q_column) for q_column in q_columns]
        system_row[i] = add(system_row[i], 1.0)
        system.append(system_row)
        right_hand_side.append(column.dot(q_residual))
    factor = not_inlined(chain.cholesky(system))
    z = chain.solve_upper(factor, chain.solve_lower(factor, right_hand_side))

    step = list(residual)
    y_step = list(q_residual)
    for column, q_column, unknown in zip(columns, q_columns, z, strict=True):
        for i, entry in enumerate(column.entries, start=column.start):
            step[i] = sub(step[i], mul(entry, unknown))
        y_step = [sub(a, mul(b, unknown)) for a, b in zip(y_step, q_column, strict=True)]
    x, y, step, y_step = not_inlined((list(x), y, step, y_step))
    length = _line_search(cones, x, y, step, y_step)
    return tuple(_ahead(x, length, step))


def _line_search(
    cones: Sequence[Cone],
    x: list[Scalar],
    y: list[Scalar],
    step: list[Scalar],
    y_step: list[Scalar],
) -> Scalar:
    """Length of a step of the forces x and the accelerations y to the minimum of MuJoCo's primal
    objective along it, where its increasing slope is 0; 2 where the minimum is further ahead, and
    the next step goes on from there. Where no zone changes, Newton's own step of 1 is the minimum.

    Between its kinks the slope is straight, so Newton's method within a bracket finds its zero
    exactly.
    """

    def slope(length: Scalar) -> tuple[Scalar, Scalar]:
        """The slope, and its derivative."""
        forces, columns = _response(cones, _ahead(y, length, y_step))
        difference = list(map(sub, _ahead(x, length, step), forces))
        derivative = dot(y_step, step)
        for column in columns:
            along = column.dot(y_step)
            derivative = add(derivative, mul(along, along))
        return dot(y_step, difference), derivative

    def newton(_: jax.Array, bracket: tuple[Scalar, Scalar, Scalar]) -> tuple[Scalar, ...]:
        low, high, length = bracket
        value, derivative = slope(length)
        is_before_zero = value < 0.0
        low = jnp.where(is_before_zero, length, low)
        high = jnp.where(is_before_zero, high, length)
        smallest = float(jnp.finfo(derivative.dtype).tiny)
        length = length - value / jnp.maximum(derivative, smallest)
        is_inside = (length > low) & (length < high)
        return low, high, jnp.where(is_inside, length, 0.5 * (low + high))

    zero = zero_like(y_step[0])
    _, _, length = lax.fori_loop(0, _SEARCH_STEPS, newton, (zero, zero + 2.0, zero + 1.0))
    return length


def _ahead(start: list[Scalar], length: Scalar, step: list[Scalar]) -> list[Scalar]:
    return [add(a, mul(length, b)) for a, b in zip(start, step, strict=True)]


def _response(cones: Sequence[Cone], y: Sequence[Scalar]) -> tuple[list[Scalar], list[Column]]:
    """x(y) [3 k], and the columns of L: one for each edge of each contact's pyramid."""
    forces: list[Scalar] = []
    columns = []
    for contact, cone in enumerate(cones):
        start = 3 * contact
        acceleration = Vec(y[start : start + 3])
        inverse_root = lax.rsqrt(cone.regulariser)
        force = ZERO3
        for edge in _EDGES:
            along_edge = edge @ acceleration
            is_active = cone.is_touching & (along_edge < 0.0)
            entries = edge * jnp.where(is_active, inverse_root, 0.0)
            force = force - entries * (along_edge * inverse_root)
            columns.append(Column(start, entries))
        forces.extend(force)
    return forces, columns
