"""Three-dimensional algebra on scalars, folded at trace time.

A scalar is a Python float (known while tracing) or a JAX array (known when running). Products with
the entries 0 and 1 of a robot's fixed rotations vanish here, before XLA sees them. A physics step
has thousands of operations: `jax.lax` traces them in a fraction of the time of `jax.numpy`.

The rule for its users, stated here alone (a test looks for operations that it would have folded):

- Where an operand may be a constant, write `add`, `sub`, `mul` and `neg`, or `Vec` and `Mat`, which
  use them: a sum with 0 and a product with 0, 1 or -1 fold.
- `+`, `-` and `*` compute the same, but fold nothing: they stand where an operand is surely an
  array, or where both are surely constants.
- `/` stands anywhere: two constants give a constant; a numerator 0 or a divisor 1 does not fold.
- A constant is a float, never an int: 0.0, not 0.
"""

import functools
import math
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata

Scalar = float | jax.Array
Tree = Any
Quaternion = tuple[Scalar, Scalar, Scalar, Scalar]


def is_constant(a: Scalar) -> bool:
    """Whether the scalar is known while tracing."""
    return isinstance(a, float)


def is_zero(a: Scalar) -> bool:
    """Whether the scalar is known to be 0 while tracing."""
    return is_constant(a) and a == 0.0


def neg(a: Scalar) -> Scalar:
    """-a."""
    return -a if is_constant(a) else lax.neg(a)


def add(a: Scalar, b: Scalar) -> Scalar:
    """a + b."""
    if is_zero(a):
        return b
    if is_zero(b):
        return a
    return a + b if is_constant(a) and is_constant(b) else lax.add(a, b)


def sub(a: Scalar, b: Scalar) -> Scalar:
    """a - b."""
    if is_zero(a):
        return neg(b)
    if is_zero(b):
        return a
    return a - b if is_constant(a) and is_constant(b) else lax.sub(a, b)


def mul(a: Scalar, b: Scalar) -> Scalar:
    """a * b."""
    if is_constant(a) and not is_constant(b):
        a, b = b, a
    if is_constant(b) and not is_constant(a):
        if b == 0.0:
            return 0.0
        if b == 1.0:
            return a
        if b == -1.0:
            return neg(a)
    return a * b if is_constant(a) and is_constant(b) else lax.mul(a, b)


def maximum(a: Scalar, b: Scalar) -> Scalar:
    """The larger one."""
    return max(a, b) if is_constant(a) and is_constant(b) else jnp.maximum(a, b)


def minimum(a: Scalar, b: Scalar) -> Scalar:
    """The smaller one."""
    return min(a, b) if is_constant(a) and is_constant(b) else jnp.minimum(a, b)


def select(condition: bool | jax.Array, a: Scalar, b: Scalar) -> Scalar:
    """a where the condition holds, else b."""
    if isinstance(condition, bool | np.bool_):
        return a if condition else b
    return jnp.where(condition, a, b)


def inverse_root(a: Scalar) -> Scalar:
    """1 / sqrt(a) of a positive number."""
    return 1.0 / math.sqrt(a) if is_constant(a) else lax.rsqrt(a)


def dot(a: Sequence[Scalar], b: Sequence[Scalar]) -> Scalar:
    """Inner product of two sequences of one length; 0 if they are empty."""
    return functools.reduce(add, map(mul, a, b), 0.0)


@jax.tree_util.register_pytree_node_class
class Vec(tuple):
    """A vector of scalars, mostly of three. `a + b`, `a - b`, -a; `a @ b` is the inner product,
    `a * s` a multiple."""

    def __add__(self, other: "Vec") -> "Vec":
        return Vec(map(add, self, other))

    def __sub__(self, other: "Vec") -> "Vec":
        return Vec(map(sub, self, other))

    def __neg__(self) -> "Vec":
        return Vec(map(neg, self))

    def __mul__(self, factor: Scalar) -> "Vec":
        return Vec(mul(x, factor) for x in self)

    def __matmul__(self, other: Sequence[Scalar]) -> Scalar:
        return dot(self, other)

    def tree_flatten(self) -> tuple:
        return tuple(self), None

    @classmethod
    def tree_unflatten(cls, _: None, leaves: Sequence) -> Any:
        return tuple.__new__(cls, leaves)


@jax.tree_util.register_pytree_node_class
class Mat(Vec):
    """A matrix of scalars, as its rows: `A + B`, `A @ B`, `A @ v` and `A.T`, no other operator."""

    def __new__(cls, rows: Iterable[Sequence[Scalar]]) -> "Mat":
        return super().__new__(cls, map(Vec, rows))

    @property
    def T(self) -> "Mat":  # noqa: N802
        """The transposed matrix."""
        return Mat(zip(*self, strict=True))

    def __add__(self, other: "Mat") -> "Mat":
        return Mat(map(operator.add, self, other))

    def __matmul__(self, other: Any) -> Any:
        if isinstance(other, Mat):
            columns = other.T
            return Mat([row @ column for column in columns] for row in self)
        return Vec(row @ other for row in self)


ZERO3 = Vec((0.0, 0.0, 0.0))
ZERO_MATRIX3 = Mat((ZERO3, ZERO3, ZERO3))
IDENTITY3 = Mat(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))


def cross(a: Vec, b: Vec) -> Vec:
    """Cross product."""
    return Vec(sub(mul(a[i - 2], b[i - 1]), mul(a[i - 1], b[i - 2])) for i in range(3))


def diagonal(v: Vec) -> Mat:
    """Diagonal matrix."""
    return Mat(((v[0], 0.0, 0.0), (0.0, v[1], 0.0), (0.0, 0.0, v[2])))


def symmetric(entry: Callable[[int, int], Scalar]) -> Mat:
    """Symmetric matrix, each entry computed once."""
    xx = entry(0, 0)
    xy = entry(0, 1)
    xz = entry(0, 2)
    yy = entry(1, 1)
    yz = entry(1, 2)
    zz = entry(2, 2)
    return Mat(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))


def congruence(r: Mat, s: Mat) -> Mat:
    """r @ s @ r.T for a symmetric s."""
    rs = r @ s
    return symmetric(lambda i, j: rs[i] @ r[j])


def axis_rotation(axis: tuple[float, float, float], cos: Scalar, sin: Scalar) -> Mat:
    """Rotation about a constant unit axis by an angle given as its cosine and sine (Rodrigues)."""
    x, y, z = axis
    one_minus_cos = sub(1.0, cos)

    def entry(i: int, j: int, skew: float) -> Scalar:
        product = axis[i] * axis[j]
        if i != j:
            return add(mul(one_minus_cos, product), mul(sin, skew))
        if product == 0.0:
            return cos
        if product == 1.0:
            return 1.0
        return add(cos, mul(one_minus_cos, product))

    rows = ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))
    return Mat([entry(i, j, skew) for j, skew in enumerate(row)] for i, row in enumerate(rows))


def quaternion_product(p: Quaternion, q: Quaternion) -> Quaternion:
    """Product of two quaternions [w, x, y, z]: the rotation q, then the rotation p."""
    w, x, y, z = p
    a, b, c, d = q
    return (
        sub(sub(sub(mul(w, a), mul(x, b)), mul(y, c)), mul(z, d)),
        sub(add(add(mul(w, b), mul(x, a)), mul(y, d)), mul(z, c)),
        add(add(sub(mul(w, c), mul(x, d)), mul(y, a)), mul(z, b)),
        add(sub(add(mul(w, d), mul(x, c)), mul(y, b)), mul(z, a)),
    )


def quaternion_matrix(quaternion: Quaternion) -> Mat:
    """Rotation matrix of a unit quaternion [w, x, y, z]."""
    w, x, y, z = quaternion

    def on_diagonal(a: Scalar, b: Scalar) -> Scalar:
        return sub(1.0, mul(2.0, add(mul(a, a), mul(b, b))))

    def off_diagonal(product: Scalar, product_with_w: Scalar) -> Scalar:
        return mul(2.0, add(product, product_with_w))

    xy = mul(x, y)
    xz = mul(x, z)
    yz = mul(y, z)
    wx = mul(w, x)
    wy = mul(w, y)
    wz = mul(w, z)
    return Mat(
        (
            (on_diagonal(y, z), off_diagonal(xy, neg(wz)), off_diagonal(xz, wy)),
            (off_diagonal(xy, wz), on_diagonal(x, z), off_diagonal(yz, neg(wx))),
            (off_diagonal(xz, neg(wy)), off_diagonal(yz, wx), on_diagonal(x, y)),
        )
    )


# Half of pi as a sum of three parts. The first two have few digits, so that their products with a
# small whole number are exact.
_HALF_PI = (1.5703125, 4.837512969970703125e-4, 7.54978995489188216e-8)
# Minimax polynomials for an angle x in [-pi/4, pi/4], in powers of x^2: sine / x - 1 starts at the
# first power, cosine - 1 + x^2 / 2 at the second.
_SINE = (-1.6666654611e-1, 8.3321608736e-3, -1.9515295891e-4)
_COSINE = (4.166664568298827e-2, -1.388731625493765e-3, 2.443315711809948e-5)


def sine_cosine(angle: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Sine and cosine of an angle (rad).

    In float32 by the method of sinf and cosf in Moshier's Cephes library: accurate to 1e-7 up to
    1000 rad. XLA's own functions make one call per element on a CPU and have a slow path for
    large angles on a GPU; they would take two thirds of the time of a physics step.
    """
    if angle.dtype != jnp.float32:
        return jnp.sin(angle), jnp.cos(angle)
    quarters = lax.round(mul(angle, 2.0 / math.pi), lax.RoundingMethod.TO_NEAREST_EVEN)
    # The rest of the angle, within an eighth of a turn of 0.
    for part in _HALF_PI:
        angle = sub(angle, mul(quarters, part))
    square = mul(angle, angle)
    sine = add(angle, mul(mul(angle, square), polynomial(_SINE, square)))
    cosine = sub(1.0, mul(0.5, square))
    cosine = add(cosine, mul(mul(square, square), polynomial(_COSINE, square)))
    quadrant = lax.convert_element_type(quarters, jnp.int32)
    # A quarter turn exchanges the two; half a turn changes both signs.
    is_odd = lax.ne(lax.bitwise_and(quadrant, 1), 0)
    turned_sine = lax.select(is_odd, cosine, sine)
    turned_cosine = lax.select(is_odd, sine, cosine)
    in_lower_half = lax.ne(lax.bitwise_and(quadrant, 2), 0)
    in_left_half = lax.ne(lax.bitwise_and(lax.add(quadrant, 1), 2), 0)
    return (
        lax.select(in_lower_half, neg(turned_sine), turned_sine),
        lax.select(in_left_half, neg(turned_cosine), turned_cosine),
    )


def polynomial(coefficients: tuple[float, ...], x: Scalar) -> Scalar:
    """Value at x of the polynomial with these coefficients, lowest power first (Horner)."""
    value: Scalar = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        value = add(coefficient, mul(x, value))
    return value


def upper_rows(triangle: Sequence[Scalar], size: int) -> list[list[Scalar]]:
    """Rows of a symmetric matrix from its diagonal on, given one after another."""
    entries = iter(triangle)
    return [[next(entries) for _ in range(i, size)] for i in range(size)]


def scalars_of(arrays: Any, dtype: jnp.dtype) -> Any:
    """Arrays of one environment as scalars, or tuples of scalars, of one dtype."""

    def scalars(array: jax.Array) -> Scalar | tuple[Scalar, ...]:
        array = jnp.asarray(array, dtype)
        return array if array.ndim == 0 else tuple(array[i] for i in range(len(array)))

    return jax.tree.map(scalars, arrays)


def zero_like(x: jax.Array) -> jax.Array:
    """0, computed from x: where a loop starts with it, a constant would have another layout in a
    GPU kernel than the loop's results."""
    return lax.sub(x, x)


def not_inlined(values: Tree) -> Tree:
    """The same scalars, each computed only once.

    On a CPU, XLA emits one loop per result and recomputes cheap intermediate values in each loop.
    A call that XLA may not inline separates the loops and prevents this. A GPU kernel is one loop,
    and computes each value once anyway.
    """
    leaves, tree = jax.tree.flatten(values)
    arrays = [leaf for leaf in leaves if not is_constant(leaf)]
    with set_xla_metadata(inlineable="false"):
        computed = iter(_same(*arrays))
    kept = [leaf if is_constant(leaf) else next(computed) for leaf in leaves]
    return tree.unflatten(kept)


@jax.jit
def _same(*arrays: jax.Array) -> tuple[jax.Array, ...]:
    # The product with 1 keeps the call: JAX removes a function that only returns its arguments.
    return tuple(lax.mul(array, jnp.ones_like(array)) for array in arrays)
