"""A long elementwise function as one GPU kernel.

XLA turns a loop of physics steps into one kernel per step, with a copy of every coordinate before
the first one, and takes seconds to fuse one of these kernels. Here the whole function, including
its loops, becomes one kernel of Pallas' Mosaic GPU backend, in which each thread keeps one
environment in its registers.

XLA compiles the function everywhere else: on a CPU, on GPUs before NVIDIA's Hopper, for other types
than float32, and with `BOUNCE_MJX_GPU_KERNEL=off`. It also compiles derivatives on a GPU.
"""

import functools
import itertools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec

from bounce_mjx.gpu.availability import has_kernels
from bounce_mjx.gpu.batches import batch_by, partition_by
from bounce_mjx.gpu.kernel_calls import call_kernel
from bounce_mjx.gpu.scalars import UnsupportedOperation, as_scalars

Arrays = tuple[jax.Array, ...]
ElementwiseFunction = Callable[..., Arrays]
Tree = Any

# Environments in a block: the 128 threads of a warpgroup, with which Mosaic GPU computes.
_BLOCK = 128


def elementwise(
    function: ElementwiseFunction, num_results: int, interpret: bool = False
) -> ElementwiseFunction:
    """The same function of K arrays of one shape, with a GPU kernel for its batches.

    Args:
      function: K arrays of one shape and type -> a tuple of arrays of that shape and type. It may
        use only elementwise operations.
      num_results: length of that tuple; counting the results here would need another trace.
      interpret: runs the kernel in Pallas' interpreter on any device, for tests.
    """

    def on_batch(*args: jax.Array) -> Arrays:
        if args[0].ndim == 0:
            return function(*args)
        if interpret:
            return in_kernel(function, num_results, args, interpret)
        return jax.lax.platform_dependent(
            *args, cuda=lambda *args: in_kernel(function, num_results, args), default=function
        )

    call = batch_by(on_batch, lambda *args: call(*args))

    @jax.custom_jvp
    def differentiable(*args: jax.Array) -> Arrays:
        return tuple(call(*args))

    @differentiable.defjvp
    def derivative(args: Arrays, tangents: Arrays) -> tuple[Arrays, Arrays]:
        # A kernel has no derivative, so XLA compiles the function and its derivative.
        return jax.jvp(lambda *args: tuple(function(*args)), args, tangents)

    def chosen(*args: jax.Array) -> Arrays:
        float32 = all(x.dtype == jnp.float32 for x in args)
        return (differentiable if float32 and (interpret or has_kernels()) else function)(*args)

    return chosen


def in_one_kernel(function: Callable[..., Tree], interpret: bool = False) -> Callable[..., Tree]:
    """The same function of pytrees of small arrays, with one GPU kernel for its batches.

    On a GPU, each thread computes one element of a batch that `jax.vmap` makes. The function is
    unchanged on devices without kernels, for float64, and if it contains an operation that cannot
    be expressed with scalars (`scalars.as_scalars`).

    Args:
      interpret: runs the kernel in Pallas' interpreter on any device, for tests.
    """

    def wrapped(*args: Tree) -> Tree:
        leaves, tree = jax.tree.flatten(args)
        types = {x.dtype for x in leaves}
        if not (interpret or has_kernels()) or not types <= KERNEL_TYPES:
            return function(*args)
        shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves]
        result_tree = []

        def flat_function(*leaves: jax.Array) -> list[jax.Array]:
            results, structure = jax.tree.flatten(function(*tree.unflatten(leaves)))
            result_tree.append(structure)
            return results

        try:
            scalar_function = as_scalars(flat_function, shapes)
        except UnsupportedOperation:
            return function(*args)
        if not set(scalar_function.dtypes) <= KERNEL_TYPES:
            return function(*args)

        scalars = [x[index] for x in leaves for index in np.ndindex(*x.shape)]
        used = list(itertools.compress(scalars, scalar_function.used))

        # Jitted inline, so that JAX traces it only once, whatever the batch size.
        call = jax.jit(scalar_function.call, inline=True)

        def on_floats(*floats: jax.Array) -> Arrays:
            given = iter(floats)
            every = [
                from_float(next(given), x.dtype) if needed else jnp.zeros(floats[0].shape, x.dtype)
                for x, needed in zip(scalars, scalar_function.used, strict=True)
            ]
            batched = call
            for _ in range(floats[0].ndim):
                batched = jax.vmap(batched)
            return tuple(map(to_float, batched(*every)))

        num_results = len(scalar_function.dtypes)
        floats = elementwise(on_floats, num_results, interpret)(*map(to_float, used))
        results = [
            from_float(x, dtype) for x, dtype in zip(floats, scalar_function.dtypes, strict=True)
        ]
        arrays = [
            jnp.stack([results[i] for i in positions.flat]).reshape(positions.shape)
            if positions.ndim
            else results[int(positions)]
            for positions in scalar_function.positions
        ]
        return result_tree[-1].unflatten(arrays)

    return wrapped


KERNEL_TYPES = {jnp.dtype(jnp.float32), jnp.dtype(jnp.int32), jnp.dtype(jnp.bool_)}


def to_float(x: jax.Array) -> jax.Array:
    """A number of a kernel's type as float32; an integer keeps its bits."""
    x = jnp.asarray(x)
    if x.dtype == jnp.int32:
        return jax.lax.bitcast_convert_type(x, jnp.float32)
    return x.astype(jnp.float32)


def from_float(x: jax.Array, dtype: jnp.dtype) -> jax.Array:
    """The inverse of `to_float`."""
    if dtype == jnp.int32:
        return jax.lax.bitcast_convert_type(x, jnp.int32)
    return x > 0.5 if dtype == jnp.bool_ else x


def in_kernel(
    function: ElementwiseFunction, num_results: int, args: Arrays, interpret: bool = False
) -> Arrays:
    """Runs `function` on arrays [...] in one kernel; with several devices, each computes its
    shard."""

    def run(packed: jax.Array) -> jax.Array:
        rows, *batch = packed.shape
        flat = packed.reshape(rows, math.prod(batch))
        return _run_packed(function, flat, num_results, interpret).reshape(num_results, *batch)

    def specs(packed: PartitionSpec) -> tuple[tuple[PartitionSpec], PartitionSpec]:
        kept = PartitionSpec(None, *packed[1:])
        return (kept,), kept

    axes = " ".join(f"b{i}" for i in range(args[0].ndim))
    rule = f"rows {axes} -> results {axes}"
    results = partition_by(run, specs, rule, ("rows", "results"))(jnp.stack(args))
    return tuple(results[i] for i in range(num_results))


def _run_packed(
    function: ElementwiseFunction, packed: jax.Array, num_results: int, interpret: bool
) -> jax.Array:
    """Arguments [rows, N] -> results [num_results, N]."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import mosaic_gpu as plgpu

    num_rows, size = packed.shape
    num_blocks = -(-size // _BLOCK)
    out_type = jax.ShapeDtypeStruct((num_results, num_blocks * _BLOCK), packed.dtype)

    def kernel(block: jax.Array, load: Callable, args_ref, results_ref) -> None:
        columns = pl.ds(block * _BLOCK, _BLOCK)
        args = [load(args_ref.at[row, columns]) for row in range(num_rows)]
        for row, result in enumerate(function(*args)):
            results_ref[row, columns] = result

    if interpret:
        run = pl.pallas_call(
            lambda *refs: kernel(pl.program_id(0), lambda ref: ref[...], *refs),
            grid=(num_blocks,),
            out_shape=out_type,
            interpret=True,
        )
    else:
        load = functools.partial(
            plgpu.load, idx=(), layout=plgpu.Layout.WG_STRIDED((_BLOCK,), 1), optimized=False
        )
        run = plgpu.kernel(
            lambda *refs: kernel(jax.lax.axis_index("block"), load, *refs),
            out_type=out_type,
            grid=(num_blocks,),
            grid_names=("block",),
            # Each thread computes environments of its own. With the other semantics, vectors of a
            # warpgroup, the kernel takes ten times as long to compile and runs no faster.
            compiler_params=plgpu.CompilerParams(lowering_semantics=plgpu.LoweringSemantics.Lane),
        )
    padded = jnp.pad(packed, ((0, 0), (0, num_blocks * _BLOCK - size)))
    return (run(padded) if interpret else call_kernel(run, padded))[:, :size]
