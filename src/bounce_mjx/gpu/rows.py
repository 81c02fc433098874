"""Many arrays of one batch as the rows of one array, as on a GPU each array that a loop carries
costs a kernel an iteration."""

import math
from typing import Any

import jax
import jax.numpy as jnp

from bounce_mjx.gpu.elementwise import KERNEL_TYPES, from_float, to_float


class Rows:
    """A form of a pytree of arrays [..., B]: an array of rows [R, B], float32."""

    def __init__(self, example: Any):
        """
        Args:
          example: the pytree, or its shapes; float32, int32 and bool.
        """
        self._leaves, self._tree = jax.tree.flatten(example)
        unknown = {x.dtype for x in self._leaves} - KERNEL_TYPES
        if unknown:
            raise TypeError(f"rows hold {', '.join(map(str, KERNEL_TYPES))}, but not {unknown}")

    def pack(self, tree: Any) -> jax.Array:
        """The rows [R, B] of a pytree."""
        leaves = self._tree.flatten_up_to(tree)
        return jnp.concatenate([to_float(x).reshape(-1, x.shape[-1]) for x in leaves])

    def unpack(self, rows: jax.Array) -> Any:
        """The pytree of rows [..., R, B]; further axes come first in each array."""
        arrays, start = [], 0
        for leaf in self._leaves:
            stop = start + math.prod(leaf.shape[:-1])
            shape = (*rows.shape[:-2], *leaf.shape[:-1], rows.shape[-1])
            arrays.append(from_float(rows[..., start:stop, :].reshape(shape), leaf.dtype))
            start = stop
        return self._tree.unflatten(arrays)


class Unpacked:
    """The pytree as it is."""

    def __init__(self, example: Any):
        del example

    def pack(self, tree: Any) -> Any:
        return tree

    def unpack(self, tree: Any) -> Any:
        return tree
