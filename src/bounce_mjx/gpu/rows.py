"""Many arrays of one batch as the rows of one array. On a GPU, each array that a loop carries costs
one kernel per iteration."""

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp

from bounce_mjx.gpu.availability import has_kernels
from bounce_mjx.gpu.elementwise import KERNEL_TYPES, from_float, to_float


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=["rows"],
    meta_fields=["structure", "types", "flat"],
)
@dataclasses.dataclass(frozen=True)
class Rows:
    """A pytree of numbers, or of arrays [..., B], in one array that a loop can carry."""

    rows: jax.Array
    """The numbers [R, B] of the pytree, float32. A number on its own is an array [1]."""
    structure: Any
    types: tuple[tuple[tuple[int, ...], jnp.dtype], ...]
    """Shape and type of each array of the pytree."""
    flat: bool = False
    """Whether the rows are one axis [R * B] (`pack_steps`)."""

    @classmethod
    def of(cls, tree: Any) -> "Rows":
        """Packs a pytree of float32, int32 and bool."""
        leaves, structure = jax.tree.flatten(tree)
        unknown = {x.dtype for x in leaves} - KERNEL_TYPES
        if unknown:
            raise TypeError(f"rows hold {', '.join(map(str, KERNEL_TYPES))}, but not {unknown}")
        rows = [to_float(x).reshape(-1, x.shape[-1] if x.ndim else 1) for x in leaves]
        return cls(jnp.concatenate(rows), structure, tuple((x.shape, x.dtype) for x in leaves))

    def tree(self) -> Any:
        """The pytree. Axes that a loop has added before the rows come first in each array."""
        arrays, start, rows = [], 0, self.rows
        if self.flat:
            first, _ = self.types[0]
            rows = rows.reshape(*rows.shape[:-1], -1, first[-1])
        for shape, dtype in self.types:
            stop = start + math.prod(shape[:-1])
            array = rows[..., start:stop, :].reshape(*rows.shape[:-2], *shape)
            arrays.append(from_float(array, dtype))
            start = stop
        return self.structure.unflatten(arrays)


def pack(tree: Any) -> Any:
    """The pytree as `Rows` where the package's GPU kernels run; elsewhere unchanged."""
    return Rows.of(tree) if has_kernels() else tree


def pack_steps(tree: Any, num_devices: int) -> Any:
    """Packs a pytree of arrays [T, ..., B], whose T parts a loop unpacks one after another.

    The rows of a part are one axis: from [T, R, B], XLA would cut each row in the loop on its own,
    instead of all of them at once. Several devices that share the axis B keep the arrays.
    """
    if not has_kernels() or num_devices > 1:
        return tree
    packed = jax.vmap(Rows.of)(tree)
    return dataclasses.replace(packed, rows=packed.rows.reshape(len(packed.rows), -1), flat=True)


def unpack(packed: Any) -> Any:
    """The pytree that was packed."""
    return packed.tree() if isinstance(packed, Rows) else packed
