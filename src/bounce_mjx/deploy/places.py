"""Operations that only move the entries of arrays: where each entry of their results comes from."""

import math
from collections.abc import Mapping

import jax
import numpy as np
from jax.extend.core import JaxprEqn

INDICES = {
    "dynamic_slice": range(1, 9),
    "dynamic_update_slice": range(2, 9),
    "gather": range(1, 2),
    "scatter": range(1, 2),
    "scatter-add": range(1, 2),
}
"""Which operands of an operation are indices; those of others have none."""


def source_places(
    equation: JaxprEqn, indices: Mapping[int, np.ndarray]
) -> tuple[list[np.ndarray], int]:
    """The operation on the places of its operands' entries.

    Args:
      indices: the operands that are indices, by their number.

    Returns:
      For each result, the place of each entry among the entries of all other operands, one after
      another; a place outside of them is that of an index out of bounds. And the number of those
      entries.
    """
    operands, count = [], 0
    for i, atom in enumerate(equation.invars):
        if i in indices:
            operands.append(indices[i])
            continue
        size = math.prod(atom.aval.shape)
        operands.append(np.arange(count, count + size, dtype=np.int32).reshape(atom.aval.shape))
        count += size
    return evaluated(equation, operands), count


def evaluated(equation: JaxprEqn, operands: list[np.ndarray]) -> list[np.ndarray]:
    """The results of an operation on constants, also within a trace."""
    with jax.ensure_compile_time_eval():
        results = equation.primitive.bind(*map(jax.numpy.asarray, operands), **equation.params)
    return [np.asarray(r) for r in (results if equation.primitive.multiple_results else [results])]
