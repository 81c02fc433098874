"""A long elementwise function as one GPU kernel.

XLA turns a loop of physics steps into one kernel per step, with a copy of every coordinate before
the first one, and takes seconds to fuse one of these kernels. Here the whole function, including
its loops, becomes one kernel of Pallas' Mosaic GPU backend, in which each thread keeps one
environment in its registers.

XLA compiles the function everywhere else: on a CPU, on GPUs before NVIDIA's Hopper, for other types
than float32, and with `BOUNCE_MJX_GPU_KERNEL=off`. It also compiles derivatives on a GPU.
"""

import functools
import math
import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.experimental.custom_partitioning import custom_partitioning
from jax.extend.core import Primitive
from jax.interpreters import mlir
from jax.sharding import NamedSharding, PartitionSpec

from bounce_mjx.gpu.availability import has_kernels
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

    def chosen(*args: jax.Array) -> Arrays:
        if not (interpret or has_kernels()) or any(x.dtype != jnp.float32 for x in args):
            return function(*args)
        layout = RowLayout(
            used=(np.array(True),) * len(args),
            results=tuple(np.arange(num_results)),
            dtypes=(jnp.dtype(jnp.float32),) * num_results,
        )
        return _in_kernel_for_batches(function, function, layout, interpret)(*args)

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
        except UnsupportedOperation as error:
            _say_once(str(error))
            return function(*args)
        if not set(scalar_function.dtypes) <= KERNEL_TYPES:
            return function(*args)

        # Jitted inline, so that JAX traces it only once, whatever the batch size.
        call = jax.jit(scalar_function.call, inline=True)
        scalar_types = [x.dtype for x in leaves for _ in range(x.size)]

        def on_floats(*floats: jax.Array) -> Arrays:
            given = iter(floats)
            every = [
                from_float(next(given), dtype) if needed else jnp.zeros(floats[0].shape, dtype)
                for dtype, needed in zip(scalar_types, scalar_function.used, strict=True)
            ]
            batched = call
            for _ in range(floats[0].ndim):
                batched = jax.vmap(batched)
            return tuple(map(to_float, batched(*every)))

        used, ends = np.array(scalar_function.used), np.cumsum([x.size for x in leaves])
        layout = RowLayout(
            used=tuple(
                part.reshape(x.shape)
                for part, x in zip(np.split(used, ends[:-1]), leaves, strict=True)
            ),
            results=tuple(scalar_function.positions),
            dtypes=tuple(scalar_function.dtypes),
        )
        run = _in_kernel_for_batches(flat_function, on_floats, layout, interpret)
        return result_tree[-1].unflatten(run(*leaves))

    return wrapped


@functools.cache
def _say_once(operation: str) -> None:
    """Says that a function is not compiled as one kernel."""
    print(
        f"warning: the kernel of a control step cannot have the operation {operation}, so XLA "
        "compiles all of the step but the physics, and the training is slower, by 8% where it was "
        "measured (docs/physics.md)",
        file=sys.stderr,
    )


class RowLayout(NamedTuple):
    """How small arrays lie in the rows of a kernel, which are float32."""

    used: tuple[np.ndarray, ...]
    """For each argument, which of its entries are rows, bool."""
    results: tuple[np.ndarray, ...]
    """For each result, the rows of its entries, int."""
    dtypes: tuple[jnp.dtype, ...]
    """Type of each row of the results."""

    def pack(self, args: Arrays) -> jax.Array:
        """Arguments [..., *shape] -> rows [R, ...]."""
        rows = []
        for x, used in zip(args, self.used, strict=True):
            x = _last_axes_first(to_float(x), used.ndim)
            x = x.reshape(used.size, *x.shape[used.ndim :])
            rows += [x[start:stop] for start, stop in _runs(np.flatnonzero(used))]
        return jnp.concatenate(rows)

    def unpack(self, rows: jax.Array) -> Arrays:
        """Rows [R, ...] -> results [..., *shape]."""
        results = []
        for positions in self.results:
            parts = [rows[start:stop] for start, stop in _runs(positions.ravel())]
            x = jnp.concatenate(parts) if len(parts) > 1 else parts[0]
            x = _last_axes_first(x.reshape(positions.shape + rows.shape[1:]), rows.ndim - 1)
            results.append(from_float(x, self.dtypes[positions.flat[0]]))
        return tuple(results)


def _last_axes_first(x: jax.Array, count: int) -> jax.Array:
    """[..., *last] -> [*last, ...]."""
    others = x.ndim - count
    return x.transpose(*range(others, x.ndim), *range(others))


def _runs(numbers: np.ndarray) -> list[tuple[int, int]]:
    """Ranges (start, stop) that follow each other, for slices instead of single numbers: 3 4 5 9 ->
    (3, 6), (9, 10)."""
    parts = np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1)
    return [(int(part[0]), int(part[-1]) + 1) for part in parts if part.size]


def _in_kernel_for_batches(
    function: Callable[..., Sequence[jax.Array]],
    on_rows: ElementwiseFunction,
    layout: RowLayout,
    interpret: bool,
) -> Callable[..., Arrays]:
    """`function` of small arrays, with a GPU kernel for its batches.

    Args:
      on_rows: computes it for rows: the used entries of the arguments -> the rows of the results.
    """

    @jax.custom_batching.custom_vmap
    def call(*args: jax.Array) -> Arrays:
        if args[0].ndim == layout.used[0].ndim:
            return tuple(function(*args))
        rows = layout.pack(args)
        return layout.unpack(in_kernel(on_rows, len(layout.dtypes), rows, interpret))

    @call.def_vmap
    def batch(axis_size: int, in_batched: list[bool], *args: jax.Array):
        args = [
            x if is_batched else jnp.broadcast_to(x, (axis_size, *x.shape))
            for x, is_batched in zip(args, in_batched, strict=True)
        ]
        results = call(*args)
        return results, (True,) * len(results)

    @jax.custom_jvp
    def differentiable(*args: jax.Array) -> Arrays:
        return tuple(call(*args))

    @differentiable.defjvp
    def derivative(args: Arrays, tangents: Arrays) -> tuple[Arrays, Arrays]:
        # A kernel has no derivative, so XLA compiles the function and its derivative.
        return jax.jvp(lambda *args: tuple(function(*args)), args, tangents)

    return differentiable


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
    function: ElementwiseFunction, num_results: int, rows: jax.Array, interpret: bool = False
) -> jax.Array:
    """Runs `function` of rows [R, ...] in one kernel, and returns its results as rows; with several
    devices, each computes its shard."""

    def run(rows: jax.Array) -> jax.Array:
        if interpret:
            return _run_in_kernel(rows, function, num_results, interpret)
        # `jax.jit`, because the primitive has no implementation outside compiled programs.
        bind = functools.partial(_elementwise.bind, function=function, num_results=num_results)
        return jax.jit(bind)(rows)

    def partition(mesh, arg_shapes, result_shape):
        kept = NamedSharding(mesh, PartitionSpec(None, *arg_shapes[0].sharding.spec[1:]))
        return mesh, run, kept, (kept,)

    axes = " ".join(f"b{i}" for i in range(rows.ndim - 1))
    partitioned = custom_partitioning(run)
    partitioned.def_partition(
        partition=partition,
        sharding_rule=f"rows {axes} -> results {axes}",
        need_replication_factors=("rows", "results"),
    )
    return partitioned(rows)


# `jax.lax.platform_dependent` would trace the kernel and the function at once, and again for each
# `jax.vmap` around the batch, which takes tenths of a second of a training's start. A primitive is
# traced when a program that contains it is lowered, and only for the program's platform.
_elementwise = Primitive("elementwise")


@_elementwise.def_abstract_eval
def _result_type(packed: ShapedArray, *, num_results: int, **_: object) -> ShapedArray:
    return ShapedArray((num_results, *packed.shape[1:]), packed.dtype)


def _run_by_xla(packed: jax.Array, function: ElementwiseFunction, **_: object) -> jax.Array:
    return jnp.stack(function(*packed))


def _run_in_kernel(
    packed: jax.Array, function: ElementwiseFunction, num_results: int, interpret: bool = False
) -> jax.Array:
    """Arguments [rows, ...] -> results [num_results, ...]."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import mosaic_gpu as plgpu

    num_rows, *batch = packed.shape
    size = math.prod(batch)
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
            # warpgroup, the kernel takes ten times as long to compile and runs no faster. No thread
            # reads what another one stores, so none waits at a barrier around each store.
            compiler_params=plgpu.CompilerParams(
                lowering_semantics=plgpu.LoweringSemantics.Lane, unsafe_no_auto_barriers=True
            ),
        )
    flat = packed.reshape(num_rows, size)
    padded = jnp.pad(flat, ((0, 0), (0, num_blocks * _BLOCK - size)))
    results = run(padded) if interpret else call_kernel(run, out_type, padded)
    return results[:, :size].reshape(num_results, *batch)


mlir.register_lowering(_elementwise, mlir.lower_fun(_run_by_xla, multiple_results=False))
mlir.register_lowering(
    _elementwise, mlir.lower_fun(_run_in_kernel, multiple_results=False), platform="cuda"
)
