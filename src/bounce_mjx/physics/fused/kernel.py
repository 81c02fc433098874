"""A long elementwise function as one GPU kernel.

XLA turns a loop of physics steps into one kernel per step, copies every coordinate before the first
one, and takes seconds to fuse each kernel. This module compiles the whole function, loops included,
into one Triton kernel (through Pallas) in which a thread keeps one environment in its registers.

XLA still compiles the function on a CPU, on GPUs older than NVIDIA's Ampere, where Pallas has no
Triton, for types other than float32, and with `BOUNCE_MJX_GPU_KERNEL=off`.
"""

import math
import os
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.experimental.custom_partitioning import custom_partitioning

Arrays = tuple[jax.Array, ...]
ElementwiseFunction = Callable[..., Arrays]

_SWITCH = "BOUNCE_MJX_GPU_KERNEL"
# Triton needs NVIDIA's Ampere.
_MIN_COMPUTE_CAPABILITY = 8.0
# Environments in a block, and warps (of 32 threads) that share them.
_BLOCK, _NUM_WARPS = 64, 2


def elementwise(
    function: ElementwiseFunction, num_results: int, interpret: bool = False
) -> ElementwiseFunction:
    """The same function of K arrays of one shape, with a GPU kernel for its batches.

    Args:
      function: K arrays of one shape and type -> a tuple of arrays of that shape and type, by
        elementwise operations alone.
      num_results: number of results; counting them would take another trace of the function.
      interpret: run the kernel in Pallas' interpreter on any device, for tests.
    """

    @jax.custom_batching.custom_vmap
    def call(*args: jax.Array) -> Arrays:
        if args[0].ndim == 0:
            return function(*args)
        if interpret:
            return in_kernel(function, num_results, args, interpret)
        return jax.lax.platform_dependent(
            *args, cuda=lambda *args: in_kernel(function, num_results, args), default=function
        )

    @call.def_vmap
    def batched(axis_size: int, in_batched: list[bool], *args: jax.Array):
        args = [
            x if is_batched else jnp.broadcast_to(x, (axis_size, *x.shape))
            for x, is_batched in zip(args, in_batched, strict=True)
        ]
        results = call(*args)
        return results, (True,) * len(results)

    def chosen(*args: jax.Array) -> Arrays:
        float32 = all(x.dtype == jnp.float32 for x in args)
        return (call if float32 and (interpret or has_kernels()) else function)(*args)

    return chosen


def has_kernels() -> bool:
    """Whether JAX's default device runs these kernels."""
    if jax.default_backend() != "gpu" or os.environ.get(_SWITCH) == "off":
        return False
    try:
        from jax.experimental.pallas import triton  # noqa: F401
    except ImportError:
        return False
    # AMD's GPUs report a name instead of a number; the kernels are untested there.
    capabilities = [str(device.compute_capability) for device in jax.local_devices(backend="gpu")]
    return all(
        c.replace(".", "").isdigit() and float(c) >= _MIN_COMPUTE_CAPABILITY for c in capabilities
    )


def in_kernel(
    function: ElementwiseFunction, num_results: int, args: Arrays, interpret: bool = False
) -> Arrays:
    """Runs `function` on arrays [...] in one kernel; each device computes its own shard."""
    shape = args[0].shape

    @custom_partitioning
    def run(packed: jax.Array) -> jax.Array:
        rows, *batch = packed.shape
        flat = packed.reshape(rows, math.prod(batch))
        results = _run_packed(function, flat, len(args), num_results, interpret)
        return results.reshape(-1, *batch)

    def partition(mesh, arg_shapes, result_shape):
        del result_shape
        sharding = arg_shapes[0].sharding
        spec = jax.sharding.PartitionSpec(None, *sharding.spec[1:])
        kept = jax.sharding.NamedSharding(mesh, spec)
        return mesh, run.fun, kept, (kept,)

    axes = " ".join(f"b{i}" for i in range(len(shape)))
    run.def_partition(
        partition=partition,
        infer_sharding_from_operands=lambda mesh, args, _: args[0].sharding,
        sharding_rule=f"rows {axes} -> results {axes}",
        need_replication_factors=("rows", "results"),
    )

    # Triton loads only blocks with a power of two of rows.
    unused = [jnp.zeros_like(args[0])] * (_power_of_two(len(args)) - len(args))
    packed = run(jnp.stack([*args, *unused]))
    return tuple(packed[i] for i in range(num_results))


def _run_packed(
    function: ElementwiseFunction,
    packed: jax.Array,
    num_args: int,
    num_results: int,
    interpret: bool,
) -> jax.Array:
    """Arguments [rows, N] -> results [rows, N]; both numbers of rows are powers of two."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    num_rows, size = packed.shape
    num_result_rows = _power_of_two(num_results)

    def kernel(args_ref, results_ref):
        # One load and one store: Triton's time for each grows with the length of the kernel.
        args = _unstack(args_ref[...])[:num_args]
        results = function(*args)
        unused = [jnp.zeros_like(args[0])] * (num_result_rows - num_results)
        results_ref[...] = _stack([*results, *unused])

    whole = -(-size // _BLOCK) * _BLOCK
    results = pl.pallas_call(
        kernel,
        grid=(whole // _BLOCK,),
        in_specs=[pl.BlockSpec((num_rows, _BLOCK), lambda i: (0, i))],
        out_specs=pl.BlockSpec((num_result_rows, _BLOCK), lambda i: (0, i)),
        out_shape=jax.ShapeDtypeStruct((num_result_rows, whole), packed.dtype),
        compiler_params=triton.CompilerParams(num_warps=_NUM_WARPS, num_stages=1),
        interpret=interpret,
    )(jnp.pad(packed, ((0, 0), (0, whole - size))))
    return results[:, :size]


def _unstack(x: jax.Array) -> list[jax.Array]:
    """Rows [N] of an array [rows, N], by operations that Triton supports."""
    return [row.reshape(row.shape[1]) for row in jnp.split(x, x.shape[0])]


def _stack(rows: list[jax.Array]) -> jax.Array:
    """An array [rows, N] of a power of two of rows [N], by operations that Triton supports."""

    def joined(rows: list[jax.Array]) -> jax.Array:
        if len(rows) == 1:
            return rows[0]
        even, odd = joined(rows[0::2]), joined(rows[1::2])
        return jnp.concatenate([even[..., None], odd[..., None]], axis=-1)

    return jnp.transpose(joined(rows).reshape(rows[0].shape[0], len(rows)))


def _power_of_two(number: int) -> int:
    """The smallest power of two that is not below the number."""
    return 1 << (number - 1).bit_length()
