"""A function of small arrays as the same function of scalars.

If each thread of a kernel computes one environment, the kernel has no small arrays, only scalars in
registers. `as_scalars` traces a function of small arrays, such as an environment's step, and
evaluates the trace with an array of Python objects for each small array: indexing, stacking and
reshaping vanish, sums over an axis become sums of scalars, and every other operation acts on
scalars alone.
"""

import functools
import hashlib
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun

Scalar = jax.Array | np.generic
# An array of scalars, of dtype object.
Scalars = np.ndarray

# Operations that Mosaic GPU compiles; they are applied to each element.
_ELEMENTWISE = frozenset(
    "abs add and bitcast_convert_type cos div eq erf exp exp2 ge gt integer_pow le log lt max min "
    "mul ne neg not or rem round rsqrt select_n sign sin sub square tanh xor convert_element_type "
    "shift_right_logical shift_left".split()
)
# Primitives that call a function, with the parameter that holds it.
_CALLS = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "custom_vmap_call": "call",
    "remat2": "jaxpr",
    "checkpoint": "jaxpr",
}
_REDUCTIONS = {
    "reduce_sum": lax.add,
    "reduce_prod": lax.mul,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_and": lax.bitwise_and,
    "reduce_or": lax.bitwise_or,
}


class UnsupportedOperation(Exception):
    """An operation that cannot be expressed with scalars."""


class ScalarFunction(NamedTuple):
    """A function of scalars."""

    call: Callable[..., list[Scalar]]
    """Scalars of the arguments, in order, -> the distinct scalars of the results."""
    positions: list[np.ndarray]
    """For each result array, the position of each of its entries among those scalars."""
    dtypes: list[jnp.dtype]
    """Type of each of those scalars."""
    used: list[bool]
    """For each scalar of the arguments, whether it influences a result."""
    digest: str
    """The same for functions of the same operations, also in another process."""


def as_scalars(
    function: Callable[..., Any], args: Sequence[jax.ShapeDtypeStruct]
) -> ScalarFunction:
    """Traces a function of arrays, which returns a list of arrays.

    Raises:
      UnsupportedOperation: the function contains an operation that cannot be expressed with
        scalars.
    """
    closed = jax.make_jaxpr(function)(*args)
    consts = [_constant(c) for c in closed.consts]
    positions = []

    def on_scalars(*scalars: jax.Array) -> list[jax.Array]:
        remaining = iter(scalars)
        results = _evaluate(closed.jaxpr, consts, [_filled(a.shape, remaining) for a in args])
        distinct = {id(x): x for result in results for x in result.flat}
        order = {key: i for i, key in enumerate(distinct)}
        for result in results:
            flat = [order[id(x)] for x in result.flat]
            positions.append(np.array(flat, int).reshape(result.shape))
        return [jnp.asarray(x) for x in distinct.values()]

    one_each = [jax.ShapeDtypeStruct((), a.dtype) for a in args for _ in range(math.prod(a.shape))]
    trace = jax.make_jaxpr(on_scalars)(*one_each)
    needed = _needed(trace.jaxpr)
    return ScalarFunction(
        call=jaxpr_as_fun(trace),
        positions=positions,
        dtypes=[v.aval.dtype for v in trace.jaxpr.outvars],
        used=[v in needed for v in trace.jaxpr.invars],
        digest=_digest(trace),
    )


def _digest(trace: ClosedJaxpr) -> str:
    """A hash of all operations of a trace, and of their operands."""
    text = hashlib.sha256()

    def add(jaxpr: Jaxpr, consts: Sequence[Any]) -> None:
        numbers: dict[Any, int] = {}

        def of(v: Any) -> tuple:
            if isinstance(v, Literal):
                return v.aval.dtype.name, np.asarray(v.val).tobytes()
            return numbers.setdefault(v, len(numbers)), v.aval.dtype.name, v.aval.shape

        given = [np.asarray(c) for c in consts]
        parts = [[of(v) for v in jaxpr.invars + jaxpr.constvars], [x.tobytes() for x in given]]
        for equation in jaxpr.eqns:
            plain = {}
            for name, value in sorted(equation.params.items()):
                inner = value if isinstance(value, tuple) else (value,)
                if any(isinstance(x, Jaxpr | ClosedJaxpr) for x in inner):
                    for x in inner:
                        closed = isinstance(x, ClosedJaxpr)
                        add(x.jaxpr if closed else x, x.consts if closed else ())
                else:
                    plain[name] = value
            operands = [of(v) for v in equation.invars], [of(v) for v in equation.outvars]
            parts.append((equation.primitive.name, plain, operands))
        text.update(repr((parts, [of(v) for v in jaxpr.outvars])).encode())

    add(trace.jaxpr, trace.consts)
    return text.hexdigest()


def _needed(jaxpr: Jaxpr) -> set:
    """The variables that the results depend on."""
    needed = {v for v in jaxpr.outvars if not isinstance(v, Literal)}
    for equation in reversed(jaxpr.eqns):
        if any(v in needed for v in equation.outvars):
            needed |= {v for v in equation.invars if not isinstance(v, Literal)}
    return needed


def _filled(shape: tuple[int, ...], values) -> Scalars:
    array = np.empty(shape, object)
    for index in np.ndindex(*shape):
        array[index] = next(values)
    return array


def _constant(value: Any) -> Scalars:
    value = np.asarray(value)
    array = np.empty(value.shape, object)
    for index in np.ndindex(*value.shape):
        array[index] = value[index]
    return array


def _each(operation: Callable[..., Scalar], *arrays: Scalars) -> Scalars:
    """Applies an operation of scalars to arrays of one shape."""
    result = np.empty(arrays[0].shape, object)
    for index in np.ndindex(*result.shape):
        result[index] = operation(*(a[index] for a in arrays))
    return result


def _evaluate(jaxpr: Jaxpr, consts: Sequence[Scalars], args: Sequence[Scalars]) -> list[Scalars]:
    values: dict[Any, Scalars] = {}

    def read(v) -> Scalars:
        return _constant(v.val) if isinstance(v, Literal) else values[v]

    values |= zip(jaxpr.constvars, consts, strict=True)
    values |= zip(jaxpr.invars, args, strict=True)
    for equation in jaxpr.eqns:
        outs = _apply(equation, [read(v) for v in equation.invars])
        values |= zip(equation.outvars, outs, strict=True)
    return [read(v) for v in jaxpr.outvars]


def _apply(equation, args: list[Scalars]) -> list[Scalars]:
    """One operation of a trace."""
    name, params = equation.primitive.name, equation.params
    if name in _ELEMENTWISE:
        bind = functools.partial(equation.primitive.bind, **params)
        return [_each(bind, *_same_rank(args))]
    if name in _REWRITTEN:
        return [_each(_REWRITTEN[name], *_same_rank(args))]
    if name in _REDUCTIONS:
        return [_reduce(_REDUCTIONS[name], args[0], params["axes"])]
    if name == "unstack":
        entries = np.moveaxis(args[0], params["axis"], 0)
        # A slice remains an array even where an index would give a bare scalar.
        return [entries[i : i + 1].reshape(entries.shape[1:]) for i in range(len(entries))]
    if name in _SHAPES:
        return [_SHAPES[name](*args, **params)]
    if name in _CALLS and _CALLS[name] in params:
        inner = params[_CALLS[name]]
        closed = inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())
        return _evaluate(closed.jaxpr, [_constant(c) for c in closed.consts], args)
    if name == "scan":
        return _scan(equation, args)
    raise UnsupportedOperation(name)


def _same_rank(args: list[Scalars]) -> list[Scalars]:
    """Operands such as the limits of `clamp` may have no axes where others have some."""
    shape = np.broadcast_shapes(*(a.shape for a in args))
    return [np.broadcast_to(a, shape) for a in args]


def _reduce(operation: Callable[..., Scalar], array: Scalars, axes: Sequence[int]) -> Scalars:
    kept = [i for i in range(array.ndim) if i not in axes]
    rows = array.transpose(*kept, *axes).reshape([array.shape[i] for i in kept] + [-1])
    result = np.empty(rows.shape[:-1], object)
    for index in np.ndindex(*result.shape):
        result[index] = functools.reduce(operation, rows[index])
    return result


def _scan(equation, args: list[Scalars]) -> list[Scalars]:
    """A loop that carries scalars and neither reads nor writes a slice of an array per step."""
    inner, num_carry = equation.params["jaxpr"], len(equation.outvars)
    outside = [v.aval.shape for v in (*equation.invars, *equation.outvars)]
    if outside != [a.shape for a in (*inner.in_avals, *inner.out_avals)]:
        raise UnsupportedOperation("scan over arrays")
    num_consts = len(args) - num_carry
    consts, carry = args[:num_consts], args[num_consts:]
    flat = [x for a in carry for x in a.flat]

    def body(_, scalars):
        remaining = iter(scalars)
        arrays = [_filled(a.shape, remaining) for a in carry]
        outs = _evaluate(inner.jaxpr, [_constant(c) for c in inner.consts], [*consts, *arrays])
        return tuple(jnp.asarray(x) for out in outs for x in out.flat)

    start = tuple(map(jnp.asarray, flat))
    end = iter(lax.fori_loop(0, equation.params["length"], body, start))
    return [_filled(a.shape, end) for a in carry]


def _logistic(x: Scalar) -> Scalar:
    return 1.0 / (1.0 + jnp.exp(-x))


def _sqrt(x: Scalar) -> Scalar:
    regular = (x > 0.0) & (x < jnp.inf)
    root = x * lax.rsqrt(jnp.where(regular, x, 1.0))
    return jnp.where(regular, root, jnp.where(x < 0.0, jnp.nan, x))


def _floor(x: Scalar) -> Scalar:
    nearest = lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN)
    return jnp.where(nearest > x, nearest - 1.0, nearest)


def _log1p(x: Scalar) -> Scalar:
    # The sum 1 + x loses the digits of a small x, but not the Taylor series.
    series = x * (1.0 - x * (0.5 - x * (1.0 / 3.0 - 0.25 * x)))
    return jnp.where(jnp.abs(x) < 0.03, series, jnp.log(1.0 + x))


def _pow(x: Scalar, y: Scalar) -> Scalar:
    y = lax.convert_element_type(y, x.dtype)
    whole = _floor(y) == y
    odd = whole & (2.0 * _floor(0.5 * y) != y)
    power = jnp.exp(y * jnp.log(jnp.abs(x)))
    # The product is NaN for 0^0, inf^0 and (+-1)^inf.
    is_one = (y == 0.0) | (x == 1.0) | ((x == -1.0) & whole)
    power = jnp.where(is_one, 1.0, power)
    power = jnp.where((x < 0.0) & (x > -jnp.inf) & ~whole, jnp.nan, power)
    is_negative = (x < 0.0) | (1.0 / x < 0.0)
    return jnp.where(odd & is_negative, -power, power)


# Operations that Mosaic GPU does not compile, expressed with operations that it does.
_REWRITTEN: dict[str, Callable[..., Scalar]] = {
    "clamp": lambda low, x, high: jnp.minimum(jnp.maximum(x, low), high),
    "copy": lambda x: x,
    "floor": _floor,
    "is_finite": lambda x: jnp.abs(x) < jnp.inf,
    "log1p": _log1p,
    "logistic": _logistic,
    "pow": _pow,
    "sqrt": _sqrt,
    "stop_gradient": lambda x: x,
}


def _broadcast(x: Scalars, *, shape, broadcast_dimensions, **_) -> Scalars:
    expanded = np.ones(len(shape), int)
    expanded[list(broadcast_dimensions)] = x.shape
    return np.broadcast_to(x.reshape(expanded), shape)


def _slice(x: Scalars, *, start_indices, limit_indices, strides, **_) -> Scalars:
    strides = strides or (1,) * x.ndim
    return x[tuple(map(slice, start_indices, limit_indices, strides))]


_SHAPES: dict[str, Callable[..., Scalars]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda *xs, dimension, **_: np.concatenate(xs, axis=dimension),
    "expand_dims": lambda x, *, dimensions, **_: np.expand_dims(x, dimensions),
    "iota": lambda *, dtype, shape, dimension, **_: _constant(
        np.broadcast_to(
            np.arange(shape[dimension], dtype=dtype).reshape(
                [-1 if i == dimension else 1 for i in range(len(shape))]
            ),
            shape,
        )
    ),
    "reshape": lambda x, *, new_sizes, **_: x.reshape(new_sizes),
    "rev": lambda x, *, dimensions, **_: np.flip(x, dimensions),
    "slice": _slice,
    "stack": lambda *xs, axis: np.stack(xs, axis),
    "squeeze": lambda x, *, dimensions, **_: x.squeeze(tuple(dimensions)),
    "transpose": lambda x, *, permutation, **_: x.transpose(permutation),
}
