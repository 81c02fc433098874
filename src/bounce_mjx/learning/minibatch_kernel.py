"""Loss and gradient of a PPO minibatch as one GPU kernel, and the sum of its parts as another.

XLA computes a minibatch step in about 50 kernels of two microseconds each, most of which wait for
memory. Here a block of two warpgroups takes 128 samples at a time and one of the two networks
through forward pass, loss and backward pass; activations stay in shared memory, sums of gradients
in registers, and the tensor cores multiply bfloat16 numbers and add float32 ones. Written for
Pallas' Mosaic GPU backend (NVIDIA's Hopper).

The two networks have the same shape here: weights, inputs and outputs are padded with zeros to the
sizes that tensor cores take, and the bias of the first layer belongs to an input that is always 1.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec

from bounce_mjx.gpu.batches import batch_by, partition_by
from bounce_mjx.gpu.block_sums import block_sums, num_chunks
from bounce_mjx.gpu.kernel_calls import call_kernel
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.gradients import MinibatchGradients

# Samples that a block computes at a time, and those of each of its two warpgroups: the rows of a
# tensor core instruction.
TILE, _ROWS = 128, 64
# Width of the padded inputs, of which the last is 1, and of the padded outputs.
NUM_INPUTS, NUM_OUTPUTS = 64, 16
HIDDEN_WIDTHS = (64, 128)
# Rows of a packed array behind its weights: the biases, the noise and zeros. Copies into shared
# memory need a multiple of 8.
_EXTRA_ROWS = 8
# Multiprocessors of NVIDIA's H100 and H200; one holds a block.
MULTIPROCESSORS = 132


class PackedParams(NamedTuple):
    """Parameters of both networks, the policy first, each with hidden layers of width H."""

    hidden: jax.Array
    """[2, 64 + H + 8, H]: first layer with its bias in row 63, second layer, its bias, zeros."""
    output: jax.Array
    """[2, H + 8, 16]: last layer, its bias, the logarithm of the action noise, zeros."""


class Batch(NamedTuple):
    """M minibatches of N samples."""

    inputs: jax.Array
    """Inputs of both networks [M, N, 64], bfloat16; the last is 1."""
    action: jax.Array
    """[M, N, 16], zeros behind the action."""
    scalars: jax.Array
    """Logarithm of the action's probability, normalised advantage, value target [M, 3, N]."""


class Sizes(NamedTuple):
    """Sizes of the policy network."""

    observation: int
    action: int


def supports(config: PPOConfig, num_inputs: int, num_actions: int) -> bool:
    """Whether the kernel supports networks and minibatches of these sizes."""
    widths = config.hidden_layers
    return (
        config.network == "mlp"
        and config.compute_dtype == "bfloat16"
        and len(widths) == 2
        and widths[0] == widths[1]
        and widths[0] in HIDDEN_WIDTHS
        and num_inputs < NUM_INPUTS
        and num_actions <= NUM_OUTPUTS
        and config.batch_steps // config.num_minibatches % TILE == 0
    )


def pack(params: tuple[Any, Any]) -> PackedParams:
    """Packs the parameters of the policy and of the value network of `make_networks`."""
    policy, value = (network["params"] for network in params)
    log_std = policy["std_logparam"]["log_value"]
    networks = (
        (*(policy["MLP_0"][f"hidden_{i}"] for i in range(2)), policy["Dense_0"], log_std),
        (*(value[f"hidden_{i}"] for i in range(3)), jnp.zeros_like(log_std)),
    )
    packed = [_pack_network(*network) for network in networks]
    return PackedParams(*(jnp.stack(parts) for parts in zip(*packed, strict=True)))


def _pack_network(first: Any, second: Any, last: Any, log_std: jax.Array):
    def rows(*vectors: jax.Array, width: int) -> jax.Array:
        padded = [jnp.pad(v, (0, width - len(v))) for v in vectors]
        return jnp.pad(jnp.stack(padded), ((0, _EXTRA_ROWS - len(vectors)), (0, 0)))

    num_inputs, width = first["kernel"].shape
    kernel = jnp.pad(first["kernel"], ((0, NUM_INPUTS - 1 - num_inputs), (0, 0)))
    hidden = [kernel, first["bias"][None], second["kernel"], rows(second["bias"], width=width)]
    last_kernel = _pad_last(last["kernel"], NUM_OUTPUTS)
    output = [last_kernel, rows(last["bias"], log_std, width=NUM_OUTPUTS)]
    return jnp.concatenate(hidden), jnp.concatenate(output)


def kernel_gradients(
    config: PPOConfig, sizes: Sizes, shapes: tuple[Any, Any]
) -> MinibatchGradients:
    """The implementation of minibatch gradients by this kernel.

    Args:
      shapes: shapes of the parameters of the policy and of the value network.
    """

    def unpack(packed: PackedParams) -> tuple[Any, Any]:
        # Packing moves each number to one place, so its transpose moves it back.
        return jax.linear_transpose(pack, shapes)(packed)[0]

    def shuffle(samples: Any, order: jax.Array, mean: jax.Array, deviation: jax.Array):
        num_minibatches = order.shape[1]

        def gather(x: jax.Array) -> jax.Array:
            """[G, samples, ...] -> [M, N, ...]."""
            chosen = jax.vmap(lambda x, i: x[i])(x, order)
            return jnp.moveaxis(chosen, 1, 0).reshape(num_minibatches, -1, *x.shape[2:])

        scalars = jnp.stack([samples.log_prob, samples.advantage, samples.value_target], axis=-1)
        log_prob, advantage, target = jnp.moveaxis(gather(scalars), -1, 0)
        advantage = (advantage - mean[:, None]) / (deviation[:, None] + 1e-8)
        batch = Batch(
            inputs=gather(pad_inputs(samples.inputs).astype(jnp.bfloat16)),
            action=gather(_pad_last(samples.action, NUM_OUTPUTS)),
            scalars=jnp.stack([log_prob, advantage, target], axis=1),
        )
        return batch

    def gradient(params: PackedParams, low: PackedParams, batch: Batch, index: jax.Array):
        gradient, metrics = loss_gradient(config, sizes, params, low, batch, index)
        log_noise = log_std(params, sizes)
        metrics["policy/entropy"] = jnp.sum(log_noise + 0.5 * math.log(2.0 * math.pi * math.e))
        metrics["policy/action_std"] = jnp.mean(jnp.exp(log_noise))
        return gradient, metrics

    return MinibatchGradients(pack, unpack, low_precision, shuffle, gradient)


def low_precision(params: PackedParams) -> PackedParams:
    """The parameters in the type that the tensor cores take."""
    return PackedParams(*(x.astype(jnp.bfloat16) for x in params))


def log_std(params: PackedParams, sizes: Sizes) -> jax.Array:
    """Logarithm of the action noise [A]."""
    return params.output[0, params.output.shape[1] - _EXTRA_ROWS + 1, : sizes.action]


def copy_weights(
    hidden_ref: Any, output_ref: Any, network: tuple, targets: Sequence[Any], ready: Any
) -> None:
    """In a kernel, starts to copy the weights of one network's three layers into shared memory;
    each copy arrives at the barrier.

    Args:
      network: index of the network in the parameters [S, 2, ...].
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import mosaic_gpu as plgpu

    width = hidden_ref.shape[-1]
    sources = (
        hidden_ref.at[*network, pl.ds(0, NUM_INPUTS)],
        hidden_ref.at[*network, pl.ds(NUM_INPUTS, width)],
        output_ref.at[*network, pl.ds(0, width)],
    )
    for source, target in zip(sources, targets, strict=True):
        plgpu.copy_gmem_to_smem(source, target, ready)


def pad_inputs(inputs: jax.Array) -> jax.Array:
    """Inputs of both networks [..., N] -> [..., 64], with zeros, and 1 at the end."""
    return _pad_last(_pad_last(inputs, NUM_INPUTS - 1), NUM_INPUTS, 1.0)


def _pad_last(x: jax.Array, size: int, value: float = 0.0) -> jax.Array:
    padding = [(0, 0)] * (x.ndim - 1) + [(0, size - x.shape[-1])]
    return jnp.pad(x, padding, constant_values=value)


def compile_ahead(config: PPOConfig, sizes: Sizes, index: jax.Array) -> None:
    """Starts to compile the kernels, which take the longest, before the trace comes to them.

    Args:
      index: any number [], int32; with a batch axis of seeds if the kernels will have one.
    """
    # `call_kernel` leaves the kernels of several devices to XLA.
    if jax.device_count() > 1:
        return
    width = config.hidden_layers[0]
    num_samples = config.batch_steps // config.num_minibatches
    shape = (config.num_minibatches, num_samples)
    params = PackedParams(
        jnp.zeros((2, NUM_INPUTS + width + _EXTRA_ROWS, width)),
        jnp.zeros((2, width + _EXTRA_ROWS, NUM_OUTPUTS)),
    )
    batch = Batch(
        jnp.zeros((*shape, NUM_INPUTS), jnp.bfloat16),
        jnp.zeros((*shape, NUM_OUTPUTS)),
        jnp.zeros((config.num_minibatches, 3, num_samples)),
    )
    loss_gradient(config, sizes, params, low_precision(params), batch, index)


def loss_gradient(
    config: PPOConfig,
    sizes: Sizes,
    params: PackedParams,
    low: PackedParams,
    batch: Batch,
    index: jax.Array,
    interpret: Any = None,
) -> tuple[PackedParams, dict[str, jax.Array]]:
    """Gradient of the loss of one minibatch, and its metrics.

    Args:
      low: the same parameters as `low_precision` returns them.
      index: index of the minibatch [], int32.
      interpret: parameters of Pallas' interpreter for GPU kernels, for tests on a processor.

    Returns:
      The gradient, 0 in the padding, the means "loss/policy", "loss/value" and "policy/kl" [], and
      the norm of the gradient "loss/gradient_norm" [].
    """
    hidden, output, squares, losses = _batched_call(config, sizes, interpret)(
        *batch, *low, params.output, index.astype(jnp.int32)
    )
    gradient = PackedParams(
        hidden.reshape(params.hidden.shape), output.reshape(params.output.shape)
    )
    policy_loss, kl, value_loss, _ = jnp.sum(losses, axis=-1).ravel()
    return gradient, {
        "loss/policy": policy_loss,
        "loss/value": value_loss,
        "policy/kl": kl,
        "loss/gradient_norm": jnp.sqrt(jnp.sum(squares)),
    }


@functools.lru_cache
def _batched_call(config: PPOConfig, sizes: Sizes, interpret: Any):
    """The kernel as a function that `jax.vmap` can batch, for example over several seeds."""

    def batched(*args: jax.Array) -> tuple[jax.Array, ...]:
        return _call(config, sizes, interpret, args)

    return batch_by(lambda *args: tuple(x[0] for x in batched(*(x[None] for x in args))), batched)


def _call(
    config: PPOConfig, sizes: Sizes, interpret: Any, args: Sequence[jax.Array]
) -> tuple[jax.Array, ...]:
    """The kernel on several devices, each with its samples of every minibatch.

    Returns:
      The gradient of the hidden layers [S, 2, P], of the output layer [S, 2, Q], sums of squares
      whose sum is that of the gradient [S, ...], and the parts of policy loss or value loss and of
      the KL divergence [S, 2, 2, rows].
    """
    num_seeds, _, num_samples, _ = args[0].shape
    tiles_per_block = _tiles_per_block(num_samples // TILE, num_seeds)

    def run(*args: jax.Array) -> tuple[jax.Array, ...]:
        return _run(config, sizes, interpret, num_samples, tiles_per_block, *args)

    def specs(inputs: PartitionSpec) -> tuple[tuple[PartitionSpec, ...], ...]:
        axis = inputs[2] if len(inputs) > 2 else None
        samples, whole = PartitionSpec(None, None, axis), PartitionSpec()
        arguments = (samples, samples, PartitionSpec(None, None, None, axis), *[whole] * 4)
        return arguments, (samples,) * 3

    rule = (
        "s m (t i) d, s m (t i) a, s m r (t i), s k h w, s k o a, s k o a, s -> "
        "s k t h w, s k (t g) o a, s k (t g) e n"
    )
    parts = {"i": TILE * tiles_per_block, "g": 2}
    partial = partition_by(run, specs, rule, tuple("smidarkhwogen"), **parts)(*args)
    if jax.device_count() > 1:
        hidden, output, losses = (jnp.sum(x, axis=2) for x in partial)
        squares = jnp.stack([jnp.sum(jnp.square(x), axis=(1, 2, 3)) for x in (hidden, output)], 1)
    else:
        flat = [x.reshape(2 * num_seeds, x.shape[2], -1) for x in partial]
        (hidden, output, losses), squares = block_sums(flat, interpret)
        # Without those of the losses.
        squares = squares[:, : -num_chunks(losses.shape[1])].reshape(num_seeds, -1)
    return (
        *(x.reshape(num_seeds, 2, -1) for x in (hidden, output)),
        squares,
        losses.reshape(num_seeds, 2, 2, _ROWS),
    )


def _tiles_per_block(tiles: int, num_seeds: int) -> int:
    """Number of tiles that a block takes one after another: as few as fill the multiprocessors of
    each device once, because every block writes a sum of gradients of its own."""
    here = tiles // jax.device_count() or tiles
    blocks = 2 * tiles * num_seeds // jax.device_count()
    divisors = (n for n in range(1, here + 1) if here % n == 0)
    return next((n for n in divisors if blocks // n <= MULTIPROCESSORS), here)


def _run(
    config: PPOConfig,
    sizes: Sizes,
    interpret: Any,
    num_samples: int,
    tiles_per_block: int,
    inputs: jax.Array,
    action: jax.Array,
    scalars: jax.Array,
    hidden: jax.Array,
    output: jax.Array,
    exact_output: jax.Array,
    index: jax.Array,
) -> tuple[jax.Array, ...]:
    """Runs the kernel for S seeds.

    Args:
      num_samples: number of samples of the whole minibatch; a device may hold only some of them.
      inputs, action, scalars: the fields of `Batch`, [S, ...].
      hidden, output: bfloat16 parameters [S, ...].
      exact_output: the same as `output`, float32.
      index: index of the minibatch [S].

    Returns:
      Sums over the samples of each block: gradients [S, 2, blocks, ...] of the hidden layers; and
      over the samples of each of its two warpgroups, gradients of the output layer
      [S, 2, 2 * blocks, ...], both in the form of the parameters. Policy loss or value loss, and KL
      divergence, of each row of a tile [S, 2, 2 * blocks, 2, rows].
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import mosaic_gpu as plgpu

    num_seeds, _, samples_here, _ = inputs.shape
    blocks = samples_here // (TILE * tiles_per_block)
    width = hidden.shape[-1]
    columns = width // 2
    first, second = pl.ds(0, NUM_INPUTS), pl.ds(NUM_INPUTS, width)
    hidden_bias, output_bias, noise_row = NUM_INPUTS + width, width, width + 1
    log_scale = 0.5 * sizes.action * math.log(2.0 * math.pi)
    mean_of = 1.0 / num_samples
    entropy_part = config.entropy_cost * tiles_per_block / num_samples
    low, high = 1.0 - config.clip_epsilon, 1.0 + config.clip_epsilon
    float32, bfloat16 = jnp.float32, jnp.bfloat16
    layout = plgpu.Layout.WGMMA

    def kernel(
        inputs_ref, action_ref, scalars_ref, hidden_ref, output_ref, exact_ref, index_ref,
        hidden_gradient_ref, output_gradient_ref, metrics_ref,
        x, w1, w2, w3, h1, slope1, h2, slope2, out_gradient,
        weights_ready, inputs_ready, both,
    ):  # fmt: skip
        seed, block, network = (jax.lax.axis_index(name) for name in ("seed", "block", "network"))
        # Each warpgroup has half of the rows of a tile, and half of the columns of the gradients.
        group = jax.lax.axis_index("group")
        minibatch = index_ref[seed]
        own_columns = pl.ds(group * columns, columns)

        def rows_of(number: jax.Array):
            return pl.ds((block * tiles_per_block + number) * TILE + group * _ROWS, _ROWS)

        def fetch_inputs(number: jax.Array) -> None:
            source = inputs_ref.at[seed, minibatch, rows_of(number)]
            target = x.at[jax.lax.rem(number, 2), group]
            plgpu.copy_gmem_to_smem(source, target, inputs_ready.at[group])

        def wait_for_both() -> None:
            plgpu.barrier_arrive(both)
            plgpu.barrier_wait(both)

        @pl.when(group == 0)
        def _():
            copy_weights(hidden_ref, output_ref, (seed, network), (w1, w2, w3), weights_ready)

        fetch_inputs(jnp.int32(0))

        def zeros(shape: tuple[int, ...], kind: Any) -> jax.Array:
            value = jnp.zeros(shape, float32)
            return value if interpret is not None else plgpu.layout_cast(value, kind)

        def add_product(total: jax.Array, a: Any, b: Any, flip_a=False, flip_b=False) -> jax.Array:
            """`total` plus the product of two arrays in shared memory; a flipped operand is
            transposed."""
            if interpret is not None:
                a, b = (x[...].T if flip else x[...] for x, flip in ((a, flip_a), (b, flip_b)))
                return total + jnp.dot(a, b, preferred_element_type=float32)
            a, b = (
                plgpu.transpose_ref(x, (1, 0)) if flip else x
                for x, flip in ((a, flip_a), (b, flip_b))
            )
            return pl.run_state(lambda sum_ref: plgpu.wgmma(sum_ref, a, b))(plgpu.ACC.init(total))

        def product(shape: tuple[int, int], a: Any, b: Any, **flips: bool) -> jax.Array:
            return add_product(zeros(shape, layout), a, b, **flips)

        def load(ref: Any, kind: Any = layout) -> jax.Array:
            if interpret is not None:
                return ref[...]
            return plgpu.load(ref, (), layout=kind, optimized=False)

        def store(ref: Any, value: jax.Array) -> None:
            ref[...] = value.astype(ref.dtype)
            plgpu.commit_smem()

        def each_row(ref: Any, cols: int) -> jax.Array:
            vector = load(ref, layout.reduce(0)).astype(float32)
            return jax.lax.broadcast_in_dim(vector, (_ROWS, cols), [1])

        def each_column(vector: jax.Array) -> jax.Array:
            return jax.lax.broadcast_in_dim(vector, (_ROWS, NUM_OUTPUTS), [0])

        def silu(z: jax.Array) -> tuple[jax.Array, jax.Array]:
            """SiLU and its derivative."""
            # The tensor cores' bfloat16 is less precise than this instruction of the GPU.
            sigmoid = 0.5 + 0.5 * jnp.tanh(0.5 * z)
            value = z * sigmoid
            return value, sigmoid + value * (1.0 - sigmoid)

        def numbers(shape: tuple[int, int], axis: int) -> jax.Array:
            if interpret is not None:
                return jax.lax.broadcasted_iota(jnp.int32, shape, axis)
            return plgpu.broadcasted_iota(jnp.int32, shape, axis, layout=layout)

        column = numbers((_ROWS, NUM_OUTPUTS), 1)
        is_policy = network == 0
        plgpu.barrier_wait(weights_ready)

        def one_tile(number: jax.Array, sums: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
            first_sum, second_sum, bias_sum, last_sum, last_bias, noise_sum, losses, kls = sums
            rows = rows_of(number)
            samples = (seed, minibatch, rows)
            old_log_prob, advantage, target = (
                load(scalars_ref.at[seed, minibatch, i, rows], layout.reduce(1)) for i in range(3)
            )
            chosen = load(action_ref.at[samples])
            slot = jax.lax.rem(number, 2)
            plgpu.barrier_wait(inputs_ready.at[group])
            pl.when(number + 1 < tiles_per_block)(lambda: fetch_inputs(number + 1))

            value, slope = silu(product((_ROWS, width), x.at[slot, group], w1))
            store(slope1.at[group], slope)
            store(h1.at[group], value)
            z = product((_ROWS, width), h1.at[group], w2)
            value, slope = silu(z + each_row(hidden_ref.at[seed, network, hidden_bias], width))
            store(slope2.at[group], slope)
            store(h2.at[group], value)
            result = product((_ROWS, NUM_OUTPUTS), h2.at[group], w3)
            result += each_row(exact_ref.at[seed, network, output_bias], NUM_OUTPUTS)

            log_std = each_row(exact_ref.at[seed, network, noise_row], NUM_OUTPUTS)
            inverse_std = jnp.exp(-log_std)
            deviation = (chosen - result) * inverse_std
            log_density = deviation * deviation * -0.5 - log_std
            log_ratio = jnp.sum(log_density, axis=1) - log_scale - old_log_prob
            ratio = jnp.exp(log_ratio)
            gain = ratio * advantage
            clipped_gain = jnp.minimum(jnp.maximum(ratio, low), high) * advantage
            # The derivative by the logarithm of the probability; 0 where the clipped ratio counts.
            by_log_prob = each_column(
                jnp.where(gain <= clipped_gain, gain, jnp.zeros_like(gain)) * -mean_of
            )
            error = jnp.where(column == 0, result - each_column(target), jnp.zeros_like(result))
            by_result = jnp.where(
                is_policy,
                by_log_prob * deviation * inverse_std,
                error * (2.0 * config.value_cost * mean_of),
            )
            store(out_gradient.at[group], by_result)
            losses += jnp.where(
                is_policy, -jnp.minimum(gain, clipped_gain), jnp.sum(error * error, axis=1)
            )
            kls += ratio - 1.0 - log_ratio
            last_bias += by_result
            noise_sum += by_log_prob * (deviation * deviation - 1.0)
            last_sum = add_product(last_sum, h2.at[group], out_gradient.at[group], flip_a=True)

            gradient = product((_ROWS, width), out_gradient.at[group], w3, flip_b=True)
            gradient *= load(slope2.at[group]).astype(float32)
            store(slope2.at[group], gradient)
            gradient = product((_ROWS, width), slope2.at[group], w2, flip_b=True)
            store(slope1.at[group], gradient * load(slope1.at[group]).astype(float32))
            wait_for_both()
            for half in range(2):
                by_hidden = slope2.at[half, :, own_columns]
                second_sum = add_product(second_sum, h1.at[half], by_hidden, flip_a=True)
                # Its last row, by the input that is always 1, is the gradient by the bias.
                bias_sum = add_product(bias_sum, x.at[slot, half], by_hidden, flip_a=True)
                by_hidden = slope1.at[half, :, own_columns]
                first_sum = add_product(first_sum, x.at[slot, half], by_hidden, flip_a=True)
            wait_for_both()
            return first_sum, second_sum, bias_sum, last_sum, last_bias, noise_sum, losses, kls

        by_columns = [zeros((rows, columns), layout) for rows in (NUM_INPUTS, width, NUM_INPUTS)]
        by_outputs = [zeros((rows, NUM_OUTPUTS), layout) for rows in (width, _ROWS, _ROWS)]
        by_samples = [zeros((_ROWS,), layout.reduce(1))] * 2
        sums = jax.lax.fori_loop(
            0, tiles_per_block, one_tile, (*by_columns, *by_outputs, *by_samples)
        )
        first_sum, second_sum, bias_sum, last_sum, last_bias, noise_sum, losses, kls = sums

        hidden_result = hidden_gradient_ref.at[seed, network, block]
        row = numbers((NUM_INPUTS, columns), 0)
        # The policy does not see the critic's inputs.
        seen = (row < sizes.observation) | (row == NUM_INPUTS - 1) | (network == 1)
        hidden_result[first, own_columns] = jnp.where(seen, first_sum, jnp.zeros_like(first_sum))
        hidden_result[second, own_columns] = second_sum
        output_result = output_gradient_ref.at[seed, network, 2 * block + group]
        output_result[pl.ds(0, width)] = last_sum
        for i, values in enumerate((losses, kls)):
            metrics_ref[seed, network, 2 * block + group, i] = values * mean_of

        bias_sum = jnp.where(row == NUM_INPUTS - 1, bias_sum, jnp.zeros_like(bias_sum))
        is_noise = is_policy & (column < sizes.action)
        # Each row adds its part of the entropy bonus, whose gradient is constant.
        noise_sum = jnp.where(is_noise, noise_sum - entropy_part, jnp.zeros_like(noise_sum))

        def add_rows() -> None:
            hidden_result[hidden_bias, own_columns] = jnp.sum(bias_sum, axis=0)
            output_result[output_bias] = jnp.sum(last_bias, axis=0)
            output_result[noise_row] = jnp.sum(noise_sum, axis=0)

        def clear_hidden(unused: jax.Array, _: None) -> None:
            hidden_result[unused, own_columns] = zeros((columns,), layout.reduce(0))

        def clear_output(unused: jax.Array, _: None) -> None:
            output_result[unused] = zeros((NUM_OUTPUTS,), layout.reduce(0))

        # Loops, because Python lowers every store of an unrolled one.
        jax.lax.fori_loop(hidden_bias + 1, hidden_bias + _EXTRA_ROWS, clear_hidden, None)
        jax.lax.fori_loop(noise_row + 1, output_bias + _EXTRA_ROWS, clear_output, None)

        def one_group(number: jax.Array, _: None) -> None:
            pl.when(group == number)(add_rows)
            wait_for_both()

        # One after the other, because Mosaic GPU has one place in shared memory for sums over rows.
        jax.lax.fori_loop(0, 2, one_group, None)

    # Operands of one product need the same swizzle, which their narrowest dimension bounds.
    wide = (plgpu.TilingTransform((8, columns)), plgpu.SwizzleTransform(2 * columns))
    narrow = (plgpu.TilingTransform((8, 16)), plgpu.SwizzleTransform(32))

    def shared(*shape: int, transforms: tuple = wide) -> plgpu.SMEM:
        return plgpu.SMEM(shape, bfloat16, transforms=transforms)

    def sums(count: int, *shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((num_seeds, 2, count, *shape), float32)

    results = [
        sums(blocks, *hidden.shape[2:]),
        sums(2 * blocks, *output.shape[2:]),
        sums(2 * blocks, 2, _ROWS),
    ]
    run = plgpu.kernel(
        kernel,
        out_type=results,
        scratch_types=[
            shared(2, 2, _ROWS, NUM_INPUTS),
            shared(NUM_INPUTS, width),
            shared(width, width),
            shared(width, NUM_OUTPUTS, transforms=narrow),
            shared(2, _ROWS, width),
            shared(2, _ROWS, width),
            shared(2, _ROWS, width, transforms=narrow),
            shared(2, _ROWS, width),
            shared(2, _ROWS, NUM_OUTPUTS, transforms=narrow),
            plgpu.Barrier(num_arrivals=3),
            plgpu.Barrier(num_barriers=2),
            plgpu.Barrier(num_arrivals=2),
        ],
        grid=(blocks, 2, num_seeds),
        grid_names=("block", "network", "seed"),
        num_threads=2,
        thread_name="group",
        compiler_params=plgpu.CompilerParams(
            approx_math=True,
            lowering_semantics=plgpu.LoweringSemantics.Lane,
        ),
        interpret=interpret,
    )
    args = inputs, action, scalars, hidden, output, exact_output, index
    if interpret is not None:
        return tuple(run(*args))
    key = "minibatch", config, sizes, num_samples, tiles_per_block
    return tuple(call_kernel(run, results, *args, key=key))
