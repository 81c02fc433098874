"""A function of small arrays as the same function of scalars.

If each thread of a kernel computes one environment, the kernel has no small arrays, only scalars in
registers. `as_scalars` traces a function of small arrays, such as an environment's step, and
evaluates the trace with an array of Python objects for each small array: indexing, stacking and
reshaping vanish, sums over an axis become sums of scalars, and every other operation acts on
scalars alone.
"""

import functools
import math
import operator
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun

from bounce_mjx.gpu.places import INDICES, evaluated, source_places

Scalar = jax.Array | np.generic
# An array of scalars, of dtype object.
Scalars = np.ndarray

# Operations that Mosaic GPU compiles; they are applied to each element.
_ELEMENTWISE = frozenset(
    "abs add and bitcast_convert_type cos div eq erf exp exp2 ge gt integer_pow le log lt max min "
    "mul ne neg not or round rsqrt select_n sign sin sub square tanh xor convert_element_type "
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
    )


def _needed(jaxpr: Jaxpr) -> set:
    """The variables that the results depend on."""
    needed = {v for v in jaxpr.outvars if not isinstance(v, Literal)}
    for equation in reversed(jaxpr.eqns):
        if any(v in needed for v in equation.outvars):
            needed |= {v for v in equation.invars if not isinstance(v, Literal)}
    return needed


def _filled(shape: tuple[int, ...], values: Iterator[Scalar]) -> Scalars:
    """An array of the next values."""
    array = np.empty(shape, object)
    for index in np.ndindex(*shape):
        array[index] = next(values)
    return array


def _constant(value: Any) -> Scalars:
    value = np.asarray(value)
    return _filled(value.shape, iter(value.flat))


def _each(operation: Callable[..., Scalar], *arrays: Scalars) -> Scalars:
    """Applies an operation of scalars to arrays of one shape."""
    return _filled(arrays[0].shape, map(operation, *(a.flat for a in arrays)))


def _each_row(operation: Callable[[Scalars], Scalar], rows: Scalars) -> Scalars:
    """Applies an operation to each row [n] of an array [..., n]."""
    shape = rows.shape[:-1]
    return _filled(shape, (operation(rows[index]) for index in np.ndindex(*shape)))


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
        return [_each(_folding(bind), *_same_rank(args))]
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
    if name in INDICES:
        return [(_scatter_add if name == "scatter-add" else _moved)(equation, args)]
    if name == "sort":
        return _sort(args, **params)
    if name == "cond":
        return _cond(args, **params)
    if name in _CALLS and _CALLS[name] in params:
        inner = params[_CALLS[name]]
        closed = inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())
        return _evaluate(closed.jaxpr, [_constant(c) for c in closed.consts], args)
    if name == "scan":
        return _scan(equation, args)
    raise UnsupportedOperation(name)


def _folding(operation: Callable[..., Scalar]) -> Callable[..., Scalar]:
    """An operation that is carried out at once on constant whole numbers: they may be indices."""

    def folded(*args: Scalar) -> Scalar:
        if not all(isinstance(x, np.integer | np.bool_) for x in args):
            return operation(*args)
        with jax.ensure_compile_time_eval():
            return np.asarray(operation(*args))[()]

    return folded


def _same_rank(args: list[Scalars]) -> list[Scalars]:
    """Operands such as the limits of `clamp` may have no axes where others have some."""
    shape = np.broadcast_shapes(*(a.shape for a in args))
    return [np.broadcast_to(a, shape) for a in args]


def _reduce(operation: Callable[..., Scalar], array: Scalars, axes: Sequence[int]) -> Scalars:
    kept = [i for i in range(array.ndim) if i not in axes]
    rows = array.transpose(*kept, *axes).reshape([array.shape[i] for i in kept] + [-1])
    return _each_row(functools.partial(functools.reduce, operation), rows)


def _dot(a: Scalars, b: Scalars, *, dimension_numbers, **_) -> Scalars:
    (contracted_a, contracted_b), (batch_a, batch_b) = dimension_numbers
    letters_a, letters_b = list(range(a.ndim)), list(range(a.ndim, a.ndim + b.ndim))
    for i, j in zip((*contracted_a, *batch_a), (*contracted_b, *batch_b), strict=True):
        letters_b[j] = letters_a[i]
    batch = [letters_a[i] for i in batch_a]
    free = [x for x in letters_a if x not in letters_b]
    free += [x for x in letters_b if x not in letters_a]
    result = np.einsum(a, letters_a, b, letters_b, batch + free)
    return result if isinstance(result, np.ndarray) else _filled((), iter([result]))


def _cumulative(operation: Callable[..., Scalar]) -> Callable[..., Scalars]:
    def accumulate(x: Scalars, *, axis: int, reverse: bool) -> Scalars:
        rows = np.moveaxis(x, axis, 0)
        rows = rows[::-1] if reverse else rows
        result = rows.copy()
        for place in np.ndindex(*rows.shape):
            if place[0]:
                before = (place[0] - 1, *place[1:])
                result[place] = operation(result[before], rows[place])
        return np.moveaxis(result[::-1] if reverse else result, 0, axis)

    return accumulate


def _arg_extreme(is_better: Callable[..., Scalar]) -> Callable[..., Scalars]:
    def index_of_extreme(x: Scalars, *, axes, index_dtype) -> Scalars:
        (axis,) = axes

        def first(row: Scalars) -> Scalar:
            best, index = row[0], index_dtype.type(0)
            for i, value in enumerate(row[1:], 1):
                # The first NaN counts as the extreme.
                wins = (is_better(value, best) | (value != value)) & (best == best)
                best = jnp.where(wins, value, best)
                index = jnp.where(wins, index_dtype.type(i), index)
            return index

        return _each_row(first, np.moveaxis(x, axis, -1))

    return index_of_extreme


def _sort(args: list[Scalars], *, dimension: int, is_stable: bool, num_keys: int) -> list[Scalars]:
    """Odd-even transposition, which is stable and has no branches."""
    del is_stable
    if num_keys != 1:
        raise UnsupportedOperation("sort by several keys")
    columns = [np.moveaxis(a, dimension, 0).copy() for a in args]
    length = len(columns[0])
    for step in range(length):
        for i in range(step % 2, length - 1, 2):
            for place in np.ndindex(*columns[0].shape[1:]):
                low, high = (i, *place), (i + 1, *place)
                a, b = columns[0][low], columns[0][high]
                # NaN comes last.
                swap = (a > b) | ((a != a) & (b == b))
                for column in columns:
                    a, b = column[low], column[high]
                    column[low], column[high] = jnp.where(swap, b, a), jnp.where(swap, a, b)
    return [np.moveaxis(column, 0, dimension) for column in columns]


def _cond(args: list[Scalars], *, branches: Sequence[ClosedJaxpr], **_) -> list[Scalars]:
    """All branches, of which the results are selected."""
    index, *operands = args
    chosen = jnp.clip(lax.convert_element_type(index[()], jnp.int32), 0, len(branches) - 1)
    outs = [_evaluate(b.jaxpr, [_constant(c) for c in b.consts], operands) for b in branches]
    result = outs[0]
    for i, others in enumerate(outs[1:], 1):
        select = functools.partial(jnp.where, chosen >= i)
        result = [_each(select, new, old) for new, old in zip(others, result, strict=True)]
    return result


def _constant_indices(equation, args: list[Scalars]) -> dict[int, np.ndarray]:
    """The operands that are indices, by their number."""
    name, found = equation.primitive.name, {}
    for i in INDICES[name]:
        if i < len(args):
            if not all(isinstance(x, np.generic) for x in args[i].flat):
                raise UnsupportedOperation(f"{name} at an index that is computed")
            found[i] = np.array(args[i].tolist(), np.int32).reshape(args[i].shape)
    return found


def _moved(equation, args: list[Scalars]) -> Scalars:
    """An operation that moves entries of arrays."""
    indices = _constant_indices(equation, args)
    (places,), count = source_places(equation, indices)
    if np.any((places < 0) | (places >= count)):
        raise UnsupportedOperation(f"{equation.primitive.name} outside of its array")
    arrays = [a.reshape(-1) for i, a in enumerate(args) if i not in indices]
    return np.concatenate(arrays)[places]


def _scatter_add(equation, args: list[Scalars]) -> Scalars:
    indices = _constant_indices(equation, args)
    x, _, updates = args
    result, zeros = x.copy(), np.zeros(x.shape, np.float32)
    for index in np.ndindex(*updates.shape):
        # Which entry this update alone would change.
        alone = np.zeros(updates.shape, np.float32)
        alone[index] = 1.0
        (changed,) = evaluated(equation, [zeros, indices[1], alone])
        for place in zip(*np.nonzero(changed), strict=True):
            result[place] = result[place] + updates[index]
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


def _rem(x: Scalar, y: Scalar) -> Scalar:
    if not jnp.issubdtype(x.dtype, jnp.floating):
        return lax.rem(x, y)
    ratio = jnp.abs(x / y)
    rest = jnp.abs(x) - _floor(ratio) * jnp.abs(y)
    # The ratio may round up to a whole number.
    rest = jnp.where(rest < 0.0, rest + jnp.abs(y), rest)
    rest = jnp.where(jnp.abs(y) == jnp.inf, jnp.abs(x), rest)
    rest = jnp.where(jnp.abs(x) == jnp.inf, jnp.nan, rest)
    return jnp.where((x < 0.0) | (1.0 / x < 0.0), -rest, rest)


def _expm1(x: Scalar) -> Scalar:
    series = x * (1.0 + x * (0.5 + x * (1.0 / 6.0 + x * (1.0 / 24.0))))
    return jnp.where(jnp.abs(x) < 0.03, series, jnp.exp(x) - 1.0)


def _atan(x: Scalar) -> Scalar:
    """The arc tangent to the last digits of float32 (Moshier's Cephes library, `atanf`)."""
    size = jnp.abs(x)
    far, middle = size > 2.414213562373095, size > 0.4142135623730950
    reduced = jnp.where(
        far,
        -1.0 / jnp.where(far, size, 1.0),
        jnp.where(middle, (size - 1.0) / (size + 1.0), size),
    )
    start = jnp.where(far, math.pi / 2, jnp.where(middle, math.pi / 4, 0.0))
    z = reduced * reduced
    series = ((8.05374449538e-2 * z - 1.38776856032e-1) * z + 1.99777106478e-1) * z
    angle = start + ((series - 3.33329491539e-1) * z * reduced + reduced)
    angle = jnp.where(size == jnp.inf, math.pi / 2, angle)
    return jnp.where((x < 0.0) | (1.0 / x < 0.0), -angle, angle)


def _atan2(y: Scalar, x: Scalar) -> Scalar:
    both = (jnp.abs(x) == jnp.inf) & (jnp.abs(y) == jnp.inf)
    ratio = jnp.where(both, 1.0, jnp.abs(y) / jnp.where(x == 0.0, 1.0, jnp.abs(x)))
    angle = jnp.where(x == 0.0, jnp.where(y == 0.0, 0.0, math.pi / 2), _atan(ratio))
    angle = jnp.where((x < 0.0) | (1.0 / x < 0.0), math.pi - angle, angle)
    angle = jnp.where((y < 0.0) | (1.0 / y < 0.0), -angle, angle)
    return jnp.where((x != x) | (y != y), jnp.nan, angle)


# Operations that Mosaic GPU does not compile, expressed with operations that it does.
_REWRITTEN: dict[str, Callable[..., Scalar]] = {
    # The sum of a derivative's parts.
    "add_any": lax.add,
    "acos": lambda x: _atan2(_sqrt((1.0 - x) * (1.0 + x)), x),
    "asin": lambda x: _atan2(x, _sqrt((1.0 - x) * (1.0 + x))),
    "atan": _atan,
    "atan2": _atan2,
    "ceil": lambda x: -_floor(-x),
    "clamp": lambda low, x, high: jnp.minimum(jnp.maximum(x, low), high),
    "copy": lambda x: x,
    "cosh": lambda x: 0.5 * (jnp.exp(x) + jnp.exp(-x)),
    "expm1": _expm1,
    "floor": _floor,
    "is_finite": lambda x: jnp.abs(x) < jnp.inf,
    "log1p": _log1p,
    "logistic": lambda x: 1.0 / (1.0 + jnp.exp(-x)),
    "pow": _pow,
    "rem": _rem,
    "sinh": lambda x: 0.5 * (_expm1(x) - _expm1(-x)),
    "sqrt": _sqrt,
    "stop_gradient": lambda x: x,
    "tan": lambda x: jnp.sin(x) / jnp.cos(x),
}


def _broadcast(x: Scalars, *, shape, broadcast_dimensions, **_) -> Scalars:
    expanded = np.ones(len(shape), int)
    expanded[list(broadcast_dimensions)] = x.shape
    return np.broadcast_to(x.reshape(expanded), shape)


def _slice(x: Scalars, *, start_indices, limit_indices, strides, **_) -> Scalars:
    strides = strides or (1,) * x.ndim
    return x[tuple(map(slice, start_indices, limit_indices, strides))]


_SHAPES: dict[str, Callable[..., Scalars]] = {
    "argmax": _arg_extreme(operator.gt),
    "argmin": _arg_extreme(operator.lt),
    "broadcast_in_dim": _broadcast,
    "cummax": _cumulative(lax.max),
    "cummin": _cumulative(lax.min),
    "cumprod": _cumulative(lax.mul),
    "cumsum": _cumulative(lax.add),
    "dot_general": _dot,
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
