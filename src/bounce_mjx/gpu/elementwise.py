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
import os
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.experimental.custom_partitioning import custom_partitioning
from jax.extend.core import Primitive
from jax.interpreters import mlir
from jax.sharding import NamedSharding, PartitionSpec

Arrays = tuple[jax.Array, ...]
ElementwiseFunction = Callable[..., Arrays]

# Environments in a block: the 128 threads of a warpgroup, with which Mosaic GPU computes.
_BLOCK = 128
_SWITCH = "BOUNCE_MJX_GPU_KERNEL"
# Of NVIDIA's Hopper.
_MIN_COMPUTE_CAPABILITY = 9.0


def has_kernels() -> bool:
    """Whether JAX's default device runs the package's own GPU kernels."""
    if jax.default_backend() != "gpu" or os.environ.get(_SWITCH) == "off":
        return False
    # For AMD's GPUs this is a name, such as gfx90a.
    capabilities = [str(device.compute_capability) for device in jax.local_devices(backend="gpu")]
    return all(
        c.replace(".", "").isdigit() and float(c) >= _MIN_COMPUTE_CAPABILITY for c in capabilities
    )


def elementwise(
    function: ElementwiseFunction, num_results: int, interpret: bool = False
) -> ElementwiseFunction:
    """The same function of K scalars, with a GPU kernel for the batches that `jax.vmap` makes.

    Args:
      function: K scalars of one type -> a tuple of scalars of that type. It may use only
        elementwise operations.
      num_results: length of that tuple; counting the results here would need another trace.
      interpret: runs the kernel in Pallas' interpreter on any device, for tests.
    """

    @jax.custom_batching.custom_vmap
    def call(*args: jax.Array) -> Arrays:
        if args[0].ndim == 0:
            return function(*args)
        return tuple(in_kernel(function, num_results, jnp.stack(args), interpret))

    @call.def_vmap
    def batch(axis_size: int, in_batched: list[bool], *args: jax.Array):
        args = [
            x if is_batched else jnp.broadcast_to(x, (axis_size, *x.shape))
            for x, is_batched in zip(args, in_batched, strict=True)
        ]
        return call(*args), (True,) * num_results

    @jax.custom_jvp
    def differentiable(*args: jax.Array) -> Arrays:
        return call(*args)

    @differentiable.defjvp
    def derivative(args: Arrays, tangents: Arrays) -> tuple[Arrays, Arrays]:
        # A kernel has no derivative, so XLA compiles the function and its derivative.
        return jax.jvp(function, args, tangents)

    def chosen(*args: jax.Array) -> Arrays:
        in_float32 = all(x.dtype == jnp.float32 for x in args)
        use_kernel = in_float32 and (interpret or has_kernels())
        return (differentiable if use_kernel else function)(*args)

    return chosen


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
    return run(padded)[:, :size].reshape(num_results, *batch)


mlir.register_lowering(_elementwise, mlir.lower_fun(_run_by_xla, multiple_results=False))
mlir.register_lowering(
    _elementwise, mlir.lower_fun(_run_in_kernel, multiple_results=False), platform="cuda"
)
