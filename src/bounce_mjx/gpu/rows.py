"""Many arrays of one batch as the rows of one array. On a GPU, each array that a loop carries costs
one kernel per iteration."""

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bounce_mjx.gpu.elementwise import has_kernels

# Rows are float32; another number of 32 bits keeps its bits.
_TYPES = (jnp.float32, jnp.int32, jnp.uint32, jnp.bool_)


@functools.partial(
    jax.tree_util.register_dataclass, data_fields=["rows"], meta_fields=["structure", "arrays"]
)
@dataclasses.dataclass(frozen=True)
class Rows:
    """A pytree of numbers, or of arrays [..., B], in one array that a loop can carry."""

    rows: jax.Array
    """The numbers [R, B] of the pytree, float32. A number on its own is an array [1]."""
    structure: Any
    arrays: tuple[jax.ShapeDtypeStruct, ...]
    """Shape and type of each array of the pytree."""


def pack(tree: Any) -> Any:
    """The pytree as `Rows` where the package's GPU kernels run and rows can hold it; elsewhere
    unchanged."""
    leaves, structure = jax.tree.flatten(tree)
    if not has_kernels() or any(x.dtype not in _TYPES for x in leaves):
        return tree
    rows = []
    arrays = []
    for leaf in leaves:
        batch_size = leaf.shape[-1] if leaf.ndim else 1
        rows.append(to_float(leaf).reshape(-1, batch_size))
        arrays.append(jax.ShapeDtypeStruct(leaf.shape, leaf.dtype))
    return Rows(jnp.concatenate(rows), structure, tuple(arrays))


def unpack(packed: Any) -> Any:
    """The pytree that was packed. Axes that a loop has added come first in each array."""
    if not isinstance(packed, Rows):
        return packed
    num_rows = [math.prod(array.shape[:-1]) for array in packed.arrays]
    parts = jnp.split(packed.rows, np.cumsum(num_rows)[:-1], axis=-2)
    added_axes = packed.rows.shape[:-2]
    leaves = []
    for part, array in zip(parts, packed.arrays, strict=True):
        leaves.append(from_float(part.reshape(added_axes + array.shape), array.dtype))
    return packed.structure.unflatten(leaves)


def to_float(x: jax.Array) -> jax.Array:
    """A number of at most 32 bits as float32; an integer keeps its bits."""
    if x.dtype == jnp.bool_:
        return x.astype(jnp.float32)
    return jax.lax.bitcast_convert_type(x, jnp.float32)


def from_float(x: jax.Array, dtype: jnp.dtype) -> jax.Array:
    """The inverse of `to_float`."""
    return x > 0.5 if dtype == jnp.bool_ else jax.lax.bitcast_convert_type(x, dtype)
