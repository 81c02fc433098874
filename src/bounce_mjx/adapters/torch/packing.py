"""Many arrays in one block of memory.

Each array that passes from one call of a program to the next costs a microsecond or more of Python,
and each array that passes from JAX to PyTorch tens of microseconds on CUDA. Therefore a step takes
and returns its state as one block, and returns its results as another block, of which PyTorch's
tensors are views.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import torch

from bounce_mjx.errors import UserError


class _Place(NamedTuple):
    """Position of one array in the block."""

    shape: tuple[int, ...]
    dtype: jnp.dtype
    start: int
    """First word."""
    stop: int
    """Word after the last."""


class _View(NamedTuple):
    """The same position for PyTorch."""

    dtype: torch.dtype
    shape: tuple[int, ...]
    stride: tuple[int, ...]
    start: int
    """First element, counted in elements of this type."""


class Layout:
    """The positions of a pytree's arrays in a block of words, int32 [W]. A four-byte number takes a
    word, a bool takes a byte; every array starts at a new word."""

    def __init__(self, shapes: Any):
        """Lays out a pytree of shapes and types, as `jax.eval_shape` gives it.

        Raises:
          UserError: an array is neither of four-byte numbers nor of bools.
        """
        leaves, self._tree = jax.tree.flatten(shapes)
        self._places: list[_Place] = []
        # Made in advance, because each step makes the tensors anew.
        self._views: list[_View] = []
        start = 0
        for leaf in leaves:
            shape = tuple(leaf.shape)
            dtype = jnp.dtype(leaf.dtype)
            if dtype.itemsize != 4 and dtype != jnp.bool_:
                raise UserError(
                    f"the environment's state has an array of {dtype.name}, and TorchVectorEnv "
                    "takes four-byte numbers and bools; convert it in the task, or switch JAX's "
                    "64-bit mode off"
                )
            stop = start + math.ceil(leaf.size * dtype.itemsize / 4)
            self._places.append(_Place(shape, dtype, start, stop))
            stride = torch.empty(shape, device="meta").stride()
            first = 4 * start // dtype.itemsize
            self._views.append(_View(getattr(torch, dtype.name), shape, stride, first))
            start = stop
        self._types = {view.dtype for view in self._views}

    def pack(self, arrays: Any) -> jax.Array:
        """The block [W] of a pytree of such arrays."""
        return jnp.concatenate([_to_words(x) for x in self._tree.flatten_up_to(arrays)])

    def unpack(self, block: jax.Array) -> Any:
        """The pytree of arrays of a block [W]."""
        arrays = [_from_words(block[place.start : place.stop], place) for place in self._places]
        return self._tree.unflatten(arrays)

    def views(self, block: torch.Tensor) -> Any:
        """The pytree of a block [W], as tensors that are views of it; the block must be a tensor
        with memory of its own."""
        typed = {dtype: block.view(dtype) for dtype in self._types}
        return self._tree.unflatten(
            [typed[x.dtype].as_strided(x.shape, x.stride, x.start) for x in self._views]
        )


def _to_words(x: jax.Array) -> jax.Array:
    flat = x.reshape(-1)
    if flat.dtype == jnp.bool_:
        quads = jnp.pad(flat.astype(jnp.uint8), (0, -flat.size % 4)).reshape(-1, 4)
        return jax.lax.bitcast_convert_type(quads, jnp.int32)
    return jax.lax.bitcast_convert_type(flat, jnp.int32)


def _from_words(words: jax.Array, place: _Place) -> jax.Array:
    if place.dtype == jnp.bool_:
        flat = jax.lax.bitcast_convert_type(words, jnp.uint8).reshape(-1)
        return flat[: math.prod(place.shape)].reshape(place.shape) != 0
    return jax.lax.bitcast_convert_type(words, place.dtype).reshape(place.shape)
