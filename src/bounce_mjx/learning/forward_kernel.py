"""Outputs of one of PPO's networks as one GPU kernel.

XLA takes a kernel for each layer and one for each activation, and tries several for each matrix
product when it compiles. Here a warpgroup takes 64 samples through the whole network; activations
stay in its registers. The parameters come in the form of the minibatch's kernel.
"""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec

from bounce_mjx.gpu.batches import batch_by, partition_by
from bounce_mjx.gpu.kernel_calls import call_kernel
from bounce_mjx.learning.gaussian import Gaussian
from bounce_mjx.learning.minibatch_kernel import (
    MULTIPROCESSORS,
    NUM_INPUTS,
    NUM_OUTPUTS,
    PackedParams,
    Sizes,
    copy_weights,
    log_std,
    low_precision,
    pack,
    pad_inputs,
)
from bounce_mjx.learning.policy import Memory, Outputs

# Samples that a block takes at a time: the rows of a tensor core instruction.
TILE = 64
# Blocks whose weights fit into the shared memory of one multiprocessor.
_BLOCKS_EACH = 2


def supports(num_envs: int) -> bool:
    """Whether the kernel supports this many environments, if the minibatch's kernel supports the
    networks."""
    return num_envs % (TILE * jax.device_count()) == 0


def kernel_outputs(sizes: Sizes, params: tuple[Any, Any]) -> Outputs:
    """The networks with these parameters, by this kernel.

    Args:
      params: of the policy and of the value network.
    """
    packed = pack(params)
    low, std = low_precision(packed), jnp.exp(log_std(packed, sizes))

    def distribution(inputs: jax.Array, memory: Memory) -> tuple[Gaussian, Memory]:
        (mean,) = forward(packed, low, 0, inputs[None], sizes.action)
        return Gaussian(mean, jnp.broadcast_to(std, mean.shape)), memory

    def values(inputs: jax.Array) -> jax.Array:
        return forward(packed, low, 1, inputs, 1)[..., 0]

    return Outputs(distribution, values)


def forward(
    params: PackedParams,
    low: PackedParams,
    network: int,
    inputs: jax.Array,
    num_outputs: int,
    interpret: Any = None,
) -> jax.Array:
    """Outputs [T, B, num_outputs] of a network, float32.

    Args:
      low: the same parameters as `minibatch_kernel.low_precision` returns them.
      network: 0 for the policy, 1 for the value.
      inputs: normalised inputs of both networks [T, B, N]; B is a multiple of `TILE` on each
        device.
      interpret: parameters of Pallas' interpreter for GPU kernels, for tests on a processor.
    """
    # The environments' numbers have the batch last.
    rows = jnp.swapaxes(pad_inputs(inputs).astype(jnp.bfloat16), -1, -2)
    call = _batched_call(network, num_outputs, interpret)
    return jnp.swapaxes(call(rows, *low, params.output)[0], -1, -2)


@functools.lru_cache
def _batched_call(network: int, num_outputs: int, interpret: Any):
    def batched(*args: jax.Array) -> tuple[jax.Array]:
        return (_call(network, num_outputs, interpret, args),)

    return batch_by(lambda *args: (batched(*(x[None] for x in args))[0][0],), batched)


def _call(network: int, num_outputs: int, interpret: Any, args: Sequence[jax.Array]) -> jax.Array:
    """The kernel on several devices, each with its samples."""

    def specs(inputs: PartitionSpec) -> tuple[tuple[PartitionSpec, ...], PartitionSpec]:
        axis = inputs[3] if len(inputs) > 3 else None
        samples, whole = PartitionSpec(None, None, None, axis), PartitionSpec()
        return (samples, whole, whole, whole), samples

    run = functools.partial(_run, network, num_outputs, interpret)
    rule = "s t d b, s k h w, s k o a, s k o a -> s t n b"
    return partition_by(run, specs, rule, tuple("stdkhwoan"))(*args)


def _run(
    network: int,
    num_outputs: int,
    interpret: Any,
    inputs: jax.Array,
    hidden: jax.Array,
    output: jax.Array,
    exact_output: jax.Array,
) -> jax.Array:
    """Runs the kernel for S seeds.

    Args:
      inputs: [S, T, 64, B], bfloat16; the last row is 1.
      hidden, output: bfloat16 parameters [S, 2, ...].
      exact_output: the same as `output`, float32.

    Returns:
      Outputs [S, T, num_outputs, B].
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import mosaic_gpu as plgpu

    num_seeds, length, _, batch = inputs.shape
    tiles, width = length * batch // TILE, hidden.shape[-1]
    tiles_per_block = _tiles_per_block(tiles, num_seeds)
    hidden_bias, output_bias = NUM_INPUTS + width, width
    float32, bfloat16 = jnp.float32, jnp.bfloat16
    layout = plgpu.Layout.WGMMA

    def kernel(
        inputs_ref, hidden_ref, output_ref, exact_ref, result_ref,
        x, w1, w2, w3, weights_ready, inputs_ready,
    ):  # fmt: skip
        seed, block = (jax.lax.axis_index(name) for name in ("seed", "block"))

        def place(number: jax.Array) -> tuple[jax.Array, Any]:
            """Step and samples of a tile."""
            tile, row_tiles = block * tiles_per_block + number, batch // TILE
            return jax.lax.div(tile, row_tiles), pl.ds(jax.lax.rem(tile, row_tiles) * TILE, TILE)

        def fetch_inputs(number: jax.Array) -> None:
            step, samples = place(number)
            source = inputs_ref.at[seed, step, :, samples]
            plgpu.copy_gmem_to_smem(source, x.at[jax.lax.rem(number, 2)], inputs_ready)

        copy_weights(hidden_ref, output_ref, (seed, network), (w1, w2, w3), weights_ready)
        fetch_inputs(jnp.int32(0))

        def product(a: Any, b: Any, flip_a: bool = False) -> jax.Array:
            """The product of an array, or of the transpose of one in shared memory, and an array
            in shared memory."""
            shape = (TILE, b.shape[1])
            if interpret is not None:
                a = a[...].T if flip_a else a
                return jnp.dot(a, b[...], preferred_element_type=float32)
            a = plgpu.transpose_ref(a, (1, 0)) if flip_a else a
            zeros = plgpu.layout_cast(jnp.zeros(shape, float32), layout)
            return pl.run_state(lambda sum_ref: plgpu.wgmma(sum_ref, a, b))(plgpu.ACC.init(zeros))

        def each_row(ref: Any, columns: int) -> jax.Array:
            if interpret is not None:
                vector = ref[...]
            else:
                vector = plgpu.load(ref, (), layout=layout.reduce(0), optimized=False)
            return jax.lax.broadcast_in_dim(vector.astype(float32), (TILE, columns), [1])

        def silu(z: jax.Array) -> jax.Array:
            # The tensor cores' bfloat16 is less precise than this instruction of the GPU.
            return (z * (0.5 + 0.5 * jnp.tanh(0.5 * z))).astype(bfloat16)

        if interpret is not None:
            column = jax.lax.broadcasted_iota(jnp.int32, (TILE, NUM_OUTPUTS), 1)
        else:
            shape = (TILE, NUM_OUTPUTS)
            column = plgpu.broadcasted_iota(jnp.int32, shape, 1, layout=layout)
        plgpu.barrier_wait(weights_ready)

        def one_tile(number: jax.Array, _: None) -> None:
            plgpu.barrier_wait(inputs_ready)
            pl.when(number + 1 < tiles_per_block)(lambda: fetch_inputs(number + 1))
            values = silu(product(x.at[jax.lax.rem(number, 2)], w1, flip_a=True))
            bias = each_row(hidden_ref.at[seed, network, hidden_bias], width)
            values = silu(product(values, w2) + bias)
            bias = each_row(exact_ref.at[seed, network, output_bias], NUM_OUTPUTS)
            result = product(values, w3) + bias
            step, samples = place(number)

            def one_output(i: jax.Array, _: None) -> None:
                chosen = jnp.where(column == i, result, jnp.zeros_like(result))
                result_ref[seed, step, i, samples] = jnp.sum(chosen, axis=1)

            # A loop, because Python lowers every store of an unrolled one.
            jax.lax.fori_loop(0, num_outputs, one_output, None)

        jax.lax.fori_loop(0, tiles_per_block, one_tile, None)

    # Operands of one product need the same swizzle, which their narrowest dimension bounds.
    wide = (plgpu.TilingTransform((8, 64)), plgpu.SwizzleTransform(128))
    narrow = (plgpu.TilingTransform((8, 16)), plgpu.SwizzleTransform(32))

    def shared(*shape: int, transforms: tuple = wide) -> plgpu.SMEM:
        return plgpu.SMEM(shape, bfloat16, transforms=transforms)

    results = jax.ShapeDtypeStruct((num_seeds, length, num_outputs, batch), float32)
    run = plgpu.kernel(
        kernel,
        out_type=results,
        scratch_types=[
            shared(2, NUM_INPUTS, TILE),
            shared(NUM_INPUTS, width),
            shared(width, width),
            shared(width, NUM_OUTPUTS, transforms=narrow),
            plgpu.Barrier(num_arrivals=3),
            plgpu.Barrier(),
        ],
        grid=(tiles // tiles_per_block, num_seeds),
        grid_names=("block", "seed"),
        compiler_params=plgpu.CompilerParams(
            approx_math=True,
            lowering_semantics=plgpu.LoweringSemantics.Lane,
        ),
        interpret=interpret,
    )
    args = inputs, hidden, output, exact_output
    if interpret is not None:
        return run(*args)
    return call_kernel(run, results, *args, key=("outputs", network, num_outputs))


def _tiles_per_block(tiles: int, num_seeds: int) -> int:
    """Number of tiles that a block takes one after another: as few as fill the multiprocessors
    once, because every block reads the weights."""
    divisors = (n for n in range(1, tiles + 1) if tiles % n == 0)
    blocks = _BLOCKS_EACH * MULTIPROCESSORS
    return next((n for n in divisors if tiles // n * num_seeds <= blocks), tiles)
