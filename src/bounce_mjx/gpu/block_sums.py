"""Sums of the partial results of a kernel's blocks, and their squares, in one kernel.

XLA takes a kernel for each sum and two more for each sum of squares, and each of them waits for the
one before.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from bounce_mjx.gpu.kernel_calls import call_kernel

# Threads of a block, and the numbers that a thread adds at a time.
_THREADS, _VECTOR = 128, 4
# Partial results that are read before the first of them is added.
_AHEAD = 8


def block_sums(
    arrays: Sequence[jax.Array], interpret: Any = None
) -> tuple[list[jax.Array], jax.Array]:
    """Sums arrays [N, B, P] over their second axis, in order.

    Args:
      arrays: float32; each has its own B, and a P that is a multiple of 128.
      interpret: parameters of Pallas' interpreter for GPU kernels, for tests on a processor.

    Returns:
      The sums, each [N, P], and the sums of the squares of their chunks [N, chunks], which come in
      the order of the arrays (`num_chunks`).
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import mosaic_gpu as plgpu

    counts = [num_chunks(x.shape[2]) for x in arrays]
    starts = [sum(counts[:i]) for i in range(len(arrays))]
    rows = arrays[0].shape[0]

    def kernel(*refs: Any) -> None:
        sources, targets, squares = refs[: len(arrays)], refs[len(arrays) : -1], refs[-1]
        row, chunk = jax.lax.axis_index("row"), jax.lax.axis_index("chunk")

        def add(source: Any, target: Any, start: int, count: int) -> None:
            blocks, size = source.shape[1], source.shape[2] // count
            layout = plgpu.Layout.WG_STRIDED((size,), size // _THREADS)
            part = pl.ds((chunk - start) * size, size)
            ahead = next(n for n in range(min(_AHEAD, blocks), 0, -1) if blocks % n == 0)

            def load(block: jax.Array) -> jax.Array:
                if interpret is not None:
                    return source[row, block, part]
                return plgpu.load(source.at[row, block, part], (), layout=layout, optimized=False)

            def add_some(number: jax.Array, total: jax.Array) -> jax.Array:
                parts = [load(number * ahead + i) for i in range(ahead)]
                for x in parts:
                    total += x
                return total

            zeros = jnp.zeros((size,), jnp.float32)
            if interpret is None:
                zeros = plgpu.layout_cast(zeros, layout)
            total = jax.lax.fori_loop(0, blocks // ahead, add_some, zeros)
            target[row, part] = total
            squares[row, chunk] = jnp.sum(total * total)

        for source, target, start, count in zip(sources, targets, starts, counts, strict=True):
            inside = (chunk >= start) & (chunk < start + count)
            pl.when(inside)(lambda a=(source, target, start, count): add(*a))

    results = [
        *(jax.ShapeDtypeStruct((rows, x.shape[2]), jnp.float32) for x in arrays),
        jax.ShapeDtypeStruct((rows, sum(counts)), jnp.float32),
    ]
    run = plgpu.kernel(
        kernel,
        out_type=results,
        grid=(sum(counts), rows),
        grid_names=("chunk", "row"),
        compiler_params=plgpu.CompilerParams(lowering_semantics=plgpu.LoweringSemantics.Lane),
        interpret=interpret,
    )
    if interpret is not None:
        *sums, squares = run(*arrays)
    else:
        *sums, squares = call_kernel(run, results, *arrays, key=("sums",))
    return sums, squares


def num_chunks(size: int) -> int:
    """Number of chunks of a row of this size, of which each block of threads adds one."""
    wide = _THREADS * _VECTOR
    return size // (wide if size % wide == 0 else _THREADS)
