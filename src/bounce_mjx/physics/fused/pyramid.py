"""Force of one contact with sliding friction (`condim="3"`), as MuJoCo computes it.

Sources: MuJoCo's documentation, "Computation" (constraint model: friction cones, the dual problem,
diagonal regulariser), and its source code for the regulariser. The force f along the normal and the
two tangents minimises

    1/2 f.(J M^-1 J^T + R) f + f.(J a0 - aref)    over the pyramidal friction cone

with a0 the acceleration without the contact. In units of the cone, x = (f_n, f_1 / mu_1,
f_2 / mu_2), it consists of the nonnegative combinations of the four edges (1, +-1, 0), (1, 0, +-1).
Every state runs the same operations, so that the threads of a GPU kernel do not diverge.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax import lax

from bounce_mjx.physics.fused.contact import ContactModel
from bounce_mjx.physics.scalars import Scalar, add, mul

Scalars = tuple[Scalar, ...]


def edge_regulariser(model: ContactModel, softness: Scalar) -> Scalar:
    """Regulariser of the coefficient of a pyramid's edge, 1/kg.

    Args:
      softness: regulariser of the normal force without friction, 1/kg.
    """
    squared = mul(model.friction[0], model.friction[0])
    return 2.0 * (mul(squared, 1.0 / model.impratio) * softness) * add(1.0, squared)


def pyramid_force(
    model: ContactModel, matrix: Sequence[Scalar], offsets: Sequence[Scalar], softness: Scalar
) -> Scalars:
    """Force [normal, first and second tangent] of a contact, N.

    Args:
      matrix: J M^-1 J^T, the upper triangle row by row, 1/kg.
      offsets: J a0 - aref, m/s^2.
      softness: regulariser of the normal force without friction, 1/kg.
    """
    units = (1.0, *model.friction)
    pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    q = [mul(entry, mul(units[i], units[j])) for entry, (i, j) in zip(matrix, pairs, strict=True)]
    x = in_pyramidal_cone(q, list(map(mul, offsets, units)), edge_regulariser(model, softness))
    return tuple(map(mul, x, units))


def in_pyramidal_cone(q: Sequence[Scalar], c: Sequence[Scalar], regulariser: Scalar) -> Scalars:
    """Minimum x of 1/2 x.Q x + c.x over nonnegative combinations of the four edges, each with a
    regulariser; q is the upper triangle of Q, row by row.

    The first tangent's two edges have four active sets. Each is eliminated in turn, and the second
    tangent's pair of edges is solved in closed form; the solution is the active set with the right
    signs. Sums and differences of the coefficients of a pair avoid cancellation at small friction.
    """
    q00, q01, q02, q11, q12, q22 = q
    c0, c1, c2 = c
    h = 0.5 * regulariser

    # Neither edge of the first pair is active.
    s2, t2 = _pair(q00, q02, q22, c0, c2, regulariser)
    push = c0 + q00 * s2 + q02 * t2
    pull = c1 + q01 * s2 + q12 * t2
    none = (s2, jnp.zeros_like(t2), t2), push - jnp.abs(pull)

    # Both edges are active.
    k00, k11 = q00 + h, q11 + h
    i = 1.0 / (k00 * k11 - q01 * q01)
    p00 = h * (q00 * k11 - q01 * q01) * i
    p02 = h * (k11 * q02 - q01 * q12) * i
    p22 = q22 - (k11 * q02 * q02 - 2.0 * q01 * q02 * q12 + k00 * q12 * q12) * i
    g0 = h * (k11 * c0 - q01 * c1) * i
    g2 = c2 - (k11 * q02 * c0 - q01 * (q02 * c1 + q12 * c0) + k00 * q12 * c1) * i
    s2, t2 = _pair(p00, p02, p22, g0, g2, regulariser)
    push = c0 + q00 * s2 + q02 * t2
    pull = c1 + q01 * s2 + q12 * t2
    s1 = (q01 * pull - k11 * push) * i
    t1 = (q01 * push - k00 * pull) * i
    both = (s1 + s2, t1, t2), (s1 - jnp.abs(t1)) * q00

    # One edge is active: the first, or its opposite.
    def one(i: jax.Array, best: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        sign = 1.0 - 2.0 * lax.convert_element_type(i, q01.dtype)
        q_01, q_12, c_1 = sign * q01, sign * q12, sign * c1
        r0, r2, g = q00 + q_01, q02 + q_12, c0 + c_1
        rest = q_01 + q11 + regulariser
        inverse = 1.0 / (r0 + rest)
        s2, t2 = _pair(
            (q00 * (q11 + regulariser) - q01 * q01) * inverse,
            (q02 * rest - q_12 * r0) * inverse,
            q22 - r2 * r2 * inverse,
            (c0 * rest - c_1 * r0) * inverse,
            c2 - r2 * g * inverse,
            regulariser,
        )
        lack = g + r0 * s2 + r2 * t2
        f = -lack * inverse
        n = s2 + f
        other = (c0 + q00 * n + q_01 * f + q02 * t2) - (c_1 + q_01 * n + q11 * f + q_12 * t2)
        return _better(best, ((n, sign * f, t2), jnp.minimum(-lack, other)))

    return lax.fori_loop(0, 2, one, _better(none, both))[0]


def _better(
    a: tuple[Scalars, jax.Array], b: tuple[Scalars, jax.Array]
) -> tuple[Scalars, jax.Array]:
    """The candidate with the higher score."""
    (x, x_score), (y, y_score) = a, b
    chosen = tuple(jnp.where(y_score > x_score, j, i) for i, j in zip(x, y, strict=True))
    return chosen, jnp.maximum(x_score, y_score)


def _pair(p00, p02, p22, g0, g2, regulariser) -> tuple[jax.Array, jax.Array]:
    """Sum s and difference t of the nonnegative coefficients of the edges (1, 1) and (1, -1)."""
    h = 0.5 * regulariser
    k00, k22 = p00 + h, p22 + h
    inverse_determinant = 1.0 / (k00 * k22 - p02 * p02)
    s = (p02 * g2 - k22 * g0) * inverse_determinant
    t = (p02 * g0 - k00 * g2) * inverse_determinant
    both = s >= jnp.abs(t)
    diagonal, off = p00 + p22 + regulariser, p00 - p22
    plus = jnp.maximum(-(g0 + g2) / (diagonal + 2.0 * p02), 0.0)
    minus = jnp.maximum(-(g0 - g2) / (diagonal - 2.0 * p02), 0.0)
    # One edge is active: the one that leaves the larger gradient on the other.
    first = g0 - g2 + off * plus >= g0 + g2 + off * minus
    s_one = jnp.where(first, plus, minus)
    t_one = jnp.where(first, plus, -minus)
    return jnp.where(both, s, s_one), jnp.where(both, t, t_one)
