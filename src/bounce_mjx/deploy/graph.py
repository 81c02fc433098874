"""A JAX function as an ONNX graph, so that a robot computes what the training computed.

The function is traced for one row. In the graph each value has a leading axis of N rows; constants
have none, and what depends on constants alone is computed here.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import Jaxpr, JaxprEqn, Literal, Var
from jax.interpreters.partial_eval import dce_jaxpr

from bounce_mjx.errors import UserError

Value = str | np.ndarray
"""A value of the graph by its name, or a constant."""

_INLINED = {"jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr"}
_INLINED |= {"custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr"}
# Operations that only move numbers, and which of their operands are indices.
_MOVES = frozenset(
    "broadcast_in_dim concatenate copy dynamic_slice dynamic_update_slice gather pad reshape rev "
    "scatter slice split squeeze stack stop_gradient tile transpose unstack".split()
)
_INDICES = {
    "dynamic_slice": range(1, 9),
    "dynamic_update_slice": range(2, 9),
    "gather": range(1, 2),
    "scatter": range(1, 2),
}
_TYPES = {"f": np.dtype(np.float32), "i": np.dtype(np.int32), "b": np.dtype(bool)}
# Operations, the types of operands for which they have a counterpart, and this counterpart: a node,
# or a function (graph, equation, operands).
_OF_ONE_NAME = {
    "fi": "abs add max min mul neg sign sub",
    "f": "ceil cos div exp floor log pow sin sqrt tan tanh",
    "b": "and not or xor",
}
_OPERATIONS = {
    name: (types, name.capitalize())
    for types, names in _OF_ONE_NAME.items()
    for name in names.split()
} | {
    "clamp": ("fi", lambda g, e, low, x, high: g.node("Min", g.node("Max", x, low), high)),
    "convert_element_type": ("fib", lambda g, e, x: g.cast(x, e.params["new_dtype"])),
    "dot_general": ("f", lambda g, e, x, y: g.product(e, x, y)),
    "eq": ("fib", "Equal"),
    # Of the activation elu.
    "expm1": ("f", lambda g, e, x: g.node("Sub", g.node("Exp", x), np.float32(1.0))),
    "ge": ("fi", "GreaterOrEqual"),
    "gt": ("fi", "Greater"),
    "integer_pow": ("f", lambda g, e, x: g.node("Pow", x, np.float32(e.params["y"]))),
    "le": ("fi", "LessOrEqual"),
    "logistic": ("f", "Sigmoid"),
    "lt": ("fi", "Less"),
    "ne": ("fib", lambda g, e, x, y: g.node("Not", g.node("Equal", x, y))),
    "reduce_and": ("b", lambda g, e, x: g.cast(g.reduce("Min", e, g.cast(x, np.int32)), bool)),
    "reduce_max": ("fi", lambda g, e, x: g.reduce("Max", e, x)),
    "reduce_min": ("fi", lambda g, e, x: g.reduce("Min", e, x)),
    "reduce_or": ("b", lambda g, e, x: g.cast(g.reduce("Max", e, g.cast(x, np.int32)), bool)),
    "reduce_sum": ("fi", lambda g, e, x: g.node("ReduceSum", x, np.array(_axes(e)), keepdims=0)),
    "rem": ("f", lambda g, e, x, y: g.node("Mod", x, y, fmod=1)),
    "select_n": ("fib", lambda g, e, *operands: g.select(e, *operands)),
    "square": ("fi", lambda g, e, x: g.node("Mul", x, x)),
}


def onnx_graph(
    function: Callable[[dict], dict], inputs: dict[str, jax.ShapeDtypeStruct], owner: str
) -> Any:
    """ONNX graph (`onnx.GraphProto`) of a function of named arrays.

    Args:
      function: each of its named outputs depends on an input.
      inputs: one row of each input; the graph has those on which an output depends.
      owner: whose function it is, for the error.

    Raises:
      UserError: the function uses an operation without a counterpart.
    """
    graph = _Graph(owner)
    closed, outputs = jax.make_jaxpr(function, return_shape=True)(inputs)
    # JAX sorts the names of a dict.
    results = graph.run(closed.jaxpr, closed.consts, sorted(inputs))
    for name, result in zip(sorted(outputs), results, strict=True):
        graph.node("Identity", result, output=name)
    used: set[str] = set()
    for node in graph.nodes:
        used.update(node.input)
    return graph.helper.make_graph(
        graph.nodes,
        "policy",
        inputs=[graph.tensor(name, row) for name, row in inputs.items() if name in used],
        outputs=[graph.tensor(name, row) for name, row in outputs.items()],
        initializer=list(graph.constants.values()),
    )


def _axes(equation: JaxprEqn) -> list[int]:
    """Axes of a reduction, in all rows."""
    return [axis + 1 for axis in equation.params["axes"]]


def _sources(equation: JaxprEqn, indices: Mapping[int, np.ndarray]) -> tuple[list[np.ndarray], int]:
    """The operation on the places of its operands' entries.

    Args:
      indices: the operands that are indices, by their number.

    Returns:
      For each result, the place of each entry among the entries of all other operands, one after
      another; a place outside of them is that of an index out of bounds. And the number of those
      entries.
    """
    operands = []
    count = 0
    for i, atom in enumerate(equation.invars):
        if i in indices:
            operands.append(indices[i])
            continue
        size = math.prod(atom.aval.shape)
        operands.append(np.arange(count, count + size, dtype=np.int32).reshape(atom.aval.shape))
        count += size
    return _evaluate(equation, operands), count


def _evaluate(equation: JaxprEqn, operands: list[np.ndarray]) -> list[np.ndarray]:
    """The results of an operation on constants, also within a trace."""
    with jax.ensure_compile_time_eval():
        arrays = map(jax.numpy.asarray, operands)
        results = equation.primitive.bind(*arrays, **equation.params)
    if not equation.primitive.multiple_results:
        return [np.asarray(results)]
    return list(map(np.asarray, results))


class _Graph:
    def __init__(self, owner: str):
        from onnx import helper, numpy_helper

        self.helper = helper
        self._from_array = numpy_helper.from_array
        self._owner = owner
        self.nodes: list[Any] = []
        self.constants: dict[tuple, Any] = {}

    def run(self, jaxpr: Jaxpr, consts: Sequence[Any], arguments: Sequence[Value]) -> list[Value]:
        """Values of the outputs, after nodes that compute them."""
        known = dict(zip(jaxpr.constvars, map(np.asarray, consts), strict=True))
        known |= dict(zip(jaxpr.invars, arguments, strict=True))

        def value(atom: Var | Literal) -> Value:
            is_literal = isinstance(atom, Literal)
            return np.asarray(atom.val, atom.aval.dtype) if is_literal else known[atom]

        # Without equations on which no output depends.
        jaxpr, _ = dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars), instantiate=True)
        for equation in jaxpr.eqns:
            results = self._results(equation, [value(atom) for atom in equation.invars])
            known |= dict(zip(equation.outvars, results, strict=True))
        return [value(atom) for atom in jaxpr.outvars]

    def _results(self, equation: JaxprEqn, operands: list[Value]) -> list[Value]:
        name = equation.primitive.name
        atoms = equation.invars
        if name in _INLINED:
            inner = equation.params[_INLINED[name]]
            return self.run(inner.jaxpr, inner.consts, operands)
        if not any(isinstance(value, str) for value in operands):
            return _evaluate(equation, operands)
        if name in _MOVES:
            return self._move(equation, operands)
        types, counterpart = _OPERATIONS.get(name, ("", ""))
        if not {atom.aval.dtype for atom in atoms} <= {_TYPES[letter] for letter in types}:
            self._refuse(equation)
        aligned = []
        for operand, atom in zip(operands, atoms, strict=True):
            aligned.append(self._align(operand, atom, equation))
        if isinstance(counterpart, str):
            return [self.node(counterpart, *aligned)]
        return [counterpart(self, equation, *aligned)]

    def _refuse(self, equation: JaxprEqn) -> None:
        raise UserError(
            f"{self._owner} uses the operation {equation.primitive.name} of "
            f"{equation.invars[-1].aval.dtype}, which an exported policy cannot compute; use "
            "arithmetic, sums, comparisons, jnp.where and fixed indices"
        )

    def _align(self, value: Value, atom: Var | Literal, equation: JaxprEqn) -> Value:
        """An operand, with further axes if it is one number for a whole array."""
        ndim = equation.outvars[0].aval.ndim
        if isinstance(value, np.ndarray) or atom.aval.ndim or not ndim:
            return value
        return self.node("Reshape", value, np.array([-1] + [1] * ndim))

    def _move(self, equation: JaxprEqn, operands: list[Value]) -> list[Value]:
        """Results that hold the operands' numbers at other places."""
        indices = {}
        numbers = []
        for i, (value, atom) in enumerate(zip(operands, equation.invars, strict=True)):
            if i not in _INDICES.get(equation.primitive.name, ()):
                size = math.prod(atom.aval.shape)
                numbers += [self._flatten(value, size, operands)] if size else []
            elif isinstance(value, str):
                self._refuse(equation)
            else:
                indices[i] = value
        joined = self.node("Concat", *numbers, axis=1) if len(numbers) > 1 else numbers[0]
        sources, count = _sources(equation, indices)
        results: list[Value] = []
        for source, atom in zip(sources, equation.outvars, strict=True):
            if not source.size:
                results.append(np.zeros(source.shape, atom.aval.dtype))
            elif source.min() < 0 or source.max() >= count:
                self._refuse(equation)
            elif np.array_equal(source.ravel(), range(count)):
                results.append(self.node("Reshape", joined, np.array([-1, *source.shape])))
            else:
                results.append(self.node("Gather", joined, source.astype(np.int64), axis=1))
        return results

    def _flatten(self, value: Value, size: int, operands: list[Value]) -> str:
        """The numbers of one of the operands [N, size]."""
        if isinstance(value, str):
            return self.node("Reshape", value, np.array([-1, size]))
        rows = self.node("Shape", next(v for v in operands if isinstance(v, str)), end=1)
        shape = self.node("Concat", rows, np.array([size]), axis=0)
        return self.node("Expand", value.reshape(1, size), shape)

    def node(self, kind: str, *inputs: Value, output: str = "", **attributes: Any) -> str:
        """Name of a node's output."""
        output = output or f"{kind}_{len(self.nodes)}"
        names = [value if isinstance(value, str) else self._constant(value) for value in inputs]
        node = self.helper.make_node(kind, names, [output], name=output, **attributes)
        self.nodes.append(node)
        return output

    def _constant(self, value: np.ndarray) -> str:
        key = value.dtype, value.shape, value.tobytes()
        if key not in self.constants:
            name = f"constant_{len(self.constants)}"
            self.constants[key] = self._from_array(np.array(value), name)
        return self.constants[key].name

    def tensor(self, name: str, row: jax.ShapeDtypeStruct) -> Any:
        """ONNX's description of an input or an output: any number of rows."""
        return self.helper.make_tensor_value_info(name, self.code(row.dtype), ["N", *row.shape])

    def cast(self, x: Value, dtype: Any) -> str:
        """An array as another type."""
        return self.node("Cast", x, to=self.code(dtype))

    def code(self, dtype: Any) -> int:
        """ONNX's number of a type."""
        return self.helper.np_dtype_to_tensor_dtype(np.dtype(dtype))

    def reduce(self, kind: str, equation: JaxprEqn, x: Value) -> str:
        """Least (Min) or greatest (Max) entries."""
        return self.node(f"Reduce{kind}", x, axes=_axes(equation), keepdims=0)

    def select(self, equation: JaxprEqn, condition: Value, *cases: Value) -> str:
        """The second case where the condition holds, else the first."""
        if len(cases) != 2 or equation.invars[0].aval.dtype != bool:
            self._refuse(equation)
        if equation.invars[1].aval.dtype != bool:
            return self.node("Where", condition, *cases[::-1])
        # onnxruntime selects no booleans.
        first = self.node("And", self.node("Not", condition), cases[0])
        return self.node("Or", first, self.node("And", condition, cases[1]))

    def product(self, equation: JaxprEqn, x: Value, y: Value) -> str:
        """A vector times a constant matrix (`jax.lax.dot_general`)."""
        is_layer = equation.params["dimension_numbers"] == (((0,), (0,)), ((), ()))
        ndims = [atom.aval.ndim for atom in equation.invars]
        if not is_layer or ndims != [1, 2] or isinstance(y, str):
            self._refuse(equation)
        return self.node("MatMul", x, y)
