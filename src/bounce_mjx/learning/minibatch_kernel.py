"""Loss and gradient of a PPO minibatch as one GPU kernel.

XLA computes a minibatch step in about 50 kernels of two microseconds each, most of which wait for
memory. Here a block of 128 threads takes 128 samples and one of the two networks through forward
pass, loss and backward pass; activations stay in shared memory, and the tensor cores multiply
bfloat16 numbers and add float32 ones. Written for Pallas' Mosaic GPU backend (NVIDIA's Hopper).

The two networks have the same shape here: weights, inputs and outputs are padded with zeros to the
sizes that tensor cores take, and the bias of the first layer belongs to an input that is always 1.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec

from bounce_mjx.gpu.batches import batch_by, partition_by
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.gradients import MinibatchGradients

# Samples of a block: the rows of two tensor core instructions.
TILE = 128
# Width of the padded inputs, of which the last is 1, and of the padded outputs.
NUM_INPUTS, NUM_OUTPUTS = 64, 16
HIDDEN_WIDTHS = (64, 128)
# Rows of a packed array behind its weights: the first for the biases.
_BIAS_ROWS = 8


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
        return jnp.pad(jnp.stack(padded), ((0, _BIAS_ROWS - len(vectors)), (0, 0)))

    num_inputs, width = first["kernel"].shape
    kernel = jnp.pad(first["kernel"], ((0, NUM_INPUTS - 1 - num_inputs), (0, 0)))
    hidden = [kernel, first["bias"][None], second["kernel"], rows(second["bias"], width=width)]
    last_kernel = jnp.pad(last["kernel"], ((0, 0), (0, NUM_OUTPUTS - last["kernel"].shape[1])))
    output = [last_kernel, rows(last["bias"], log_std, width=NUM_OUTPUTS)]
    return jnp.concatenate(hidden), jnp.concatenate(output)


def kernel_gradients(
    config: PPOConfig, num_actions: int, shapes: tuple[Any, Any]
) -> MinibatchGradients:
    """The implementation of minibatch gradients by this kernel.

    Args:
      shapes: shapes of the parameters of the policy and of the value network.
    """
    is_parameter = parameter_mask(shapes)

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
        inputs = _pad_last(_pad_last(samples.inputs, NUM_INPUTS - 1), NUM_INPUTS, 1.0)
        batch = Batch(
            inputs=gather(inputs.astype(jnp.bfloat16)),
            action=gather(_pad_last(samples.action, NUM_OUTPUTS)),
            scalars=jnp.stack([log_prob, advantage, target], axis=1),
        )
        return batch

    def gradient(params: PackedParams, low: PackedParams, batch: Batch, index: jax.Array):
        gradient, metrics = loss_gradient(config, num_actions, params, low, batch, index)
        gradient = jax.tree.map(lambda x, known: jnp.where(known, x, 0.0), gradient, is_parameter)
        noise_row = params.output.shape[1] - _BIAS_ROWS + 1
        log_std = params.output[0, noise_row, :num_actions]
        if config.entropy_cost > 0.0:
            output = gradient.output.at[0, noise_row, :num_actions].add(-config.entropy_cost)
            gradient = gradient._replace(output=output)
        metrics["policy/entropy"] = jnp.sum(log_std + 0.5 * math.log(2.0 * math.pi * math.e))
        metrics["policy/action_std"] = jnp.mean(jnp.exp(log_std))
        return gradient, metrics

    return MinibatchGradients(pack, unpack, low_precision, shuffle, gradient)


def low_precision(params: PackedParams) -> PackedParams:
    """The parameters in the type that the tensor cores take."""
    return PackedParams(*(x.astype(jnp.bfloat16) for x in params))


def parameter_mask(shapes: tuple[Any, Any]) -> PackedParams:
    """Mask of the packed parameters that is False in the padding, bool. It uses NumPy because JAX
    would compile programs for it."""
    policy, value = (network["params"] for network in shapes)
    width = value["hidden_1"]["kernel"].shape[0]
    num_actions = policy["Dense_0"]["kernel"].shape[1]
    hidden = np.zeros((2, NUM_INPUTS + width + _BIAS_ROWS, width), bool)
    output = np.zeros((2, width + _BIAS_ROWS, NUM_OUTPUTS), bool)
    num_inputs = (
        policy["MLP_0"]["hidden_0"]["kernel"].shape[0],
        value["hidden_0"]["kernel"].shape[0],
    )
    for i, (inputs, outputs) in enumerate(zip(num_inputs, (num_actions, 1), strict=True)):
        hidden[i, :inputs] = True
        hidden[i, NUM_INPUTS - 1 : NUM_INPUTS + width + 1] = True
        output[i, : width + 1, :outputs] = True
    output[0, width + 1, :num_actions] = True
    return PackedParams(hidden, output)


def _pad_last(x: jax.Array, size: int, value: float = 0.0) -> jax.Array:
    padding = [(0, 0)] * (x.ndim - 1) + [(0, size - x.shape[-1])]
    return jnp.pad(x, padding, constant_values=value)


def loss_gradient(
    config: PPOConfig,
    num_actions: int,
    params: PackedParams,
    low: PackedParams,
    batch: Batch,
    index: jax.Array,
    interpret: Any = None,
) -> tuple[PackedParams, dict[str, jax.Array]]:
    """Gradient of the loss of one minibatch without the entropy bonus, and its metrics.

    Args:
      low: the same parameters as `low_precision` returns them.
      index: index of the minibatch [], int32.
      interpret: parameters of Pallas' interpreter for GPU kernels, for tests on a processor.

    Returns:
      The gradient, undefined in the padding, and the means "loss/policy", "loss/value" and
      "policy/kl" [].
    """
    hidden, output, metrics = _batched_call(config, num_actions, interpret)(
        *batch, *low, params.output, index.astype(jnp.int32)
    )
    gradient = PackedParams(jnp.sum(hidden, axis=1), jnp.sum(output, axis=1))
    policy_loss, kl, value_loss, _ = jnp.sum(metrics, axis=1).ravel()
    return gradient, {"loss/policy": policy_loss, "loss/value": value_loss, "policy/kl": kl}


@functools.lru_cache
def _batched_call(config: PPOConfig, num_actions: int, interpret: Any):
    """The kernel as a function that `jax.vmap` can batch, for example over several seeds."""

    def batched(*args: jax.Array) -> tuple[jax.Array, ...]:
        return _call(config, num_actions, interpret, args)

    return batch_by(lambda *args: tuple(x[0] for x in batched(*(x[None] for x in args))), batched)


def _call(
    config: PPOConfig, num_actions: int, interpret: Any, args: Sequence[jax.Array]
) -> tuple[jax.Array, ...]:
    """The kernel on several devices, each with its samples of every minibatch."""
    num_samples = args[0].shape[2]

    def run(*args: jax.Array) -> tuple[jax.Array, ...]:
        return _run(config, num_actions, interpret, num_samples, *args)

    def specs(inputs: PartitionSpec) -> tuple[tuple[PartitionSpec, ...], ...]:
        axis = inputs[2] if len(inputs) > 2 else None
        samples, whole = PartitionSpec(None, None, axis), PartitionSpec()
        arguments = (samples, samples, PartitionSpec(None, None, None, axis), *[whole] * 4)
        return arguments, (samples,) * 3

    rule = (
        "s m (t i) d, s m (t i) a, s m r (t i), s k h w, s k o a, s k o a, s -> "
        "s k t h w, s k t o a, s k t e"
    )
    return partition_by(run, specs, rule, tuple("smidarkhwoe"), i=TILE)(*args)


def _run(
    config: PPOConfig,
    num_actions: int,
    interpret: Any,
    num_samples: int,
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
      Sums over each tile of samples: gradients [S, 2, tiles, ...] in the form of the
      parameters, and policy loss, KL divergence and value loss as [S, 2, tiles, 2].
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import mosaic_gpu as plgpu

    num_seeds, _, samples_here, _ = inputs.shape
    tiles = samples_here // TILE
    width = hidden.shape[-1]
    first, second = pl.ds(0, NUM_INPUTS), pl.ds(NUM_INPUTS, width)
    hidden_bias, output_bias, noise_row = NUM_INPUTS + width, width, width + 1
    log_scale = 0.5 * num_actions * math.log(2.0 * math.pi)
    mean_of = 1.0 / num_samples
    low, high = 1.0 - config.clip_epsilon, 1.0 + config.clip_epsilon
    float32, bfloat16 = jnp.float32, jnp.bfloat16
    layout = plgpu.Layout.WGMMA

    def kernel(
        inputs_ref, action_ref, scalars_ref, hidden_ref, output_ref, exact_ref, index_ref,
        hidden_gradient_ref, output_gradient_ref, metrics_ref,
        x, w1, w2, w3, h1, slope1, h2, slope2, out_gradient, barrier,
    ):  # fmt: skip
        seed, tile, network = (jax.lax.axis_index(name) for name in ("seed", "tile", "network"))
        minibatch = index_ref[seed]
        columns = pl.ds(tile * TILE, TILE)
        samples = (seed, minibatch, columns)
        plgpu.copy_gmem_to_smem(inputs_ref.at[samples], x, barrier)
        plgpu.copy_gmem_to_smem(hidden_ref.at[seed, network, first], w1, barrier)
        plgpu.copy_gmem_to_smem(hidden_ref.at[seed, network, second], w2, barrier)
        plgpu.copy_gmem_to_smem(output_ref.at[seed, network, pl.ds(0, width)], w3, barrier)
        plgpu.barrier_wait(barrier)

        def matmul(a, b, rows: int, cols: int, flip_a=False, flip_b=False) -> jax.Array:
            """Product [rows, cols] of two arrays in shared memory; a flipped operand is
            transposed."""
            if interpret is not None:
                a, b = (x[...].T if flip else x[...] for x, flip in ((a, flip_a), (b, flip_b)))
                return jnp.dot(a, b, preferred_element_type=float32)
            a, b = (
                plgpu.transpose_ref(x, (1, 0)) if flip else x
                for x, flip in ((a, flip_a), (b, flip_b))
            )

            def run(accumulator):
                plgpu.wgmma(accumulator, a, b)
                return accumulator[...]

            return pl.run_scoped(run, plgpu.ACC((rows, cols), float32))

        def load(ref, kind=layout) -> jax.Array:
            if interpret is not None:
                return ref[...]
            return plgpu.load(ref, (), layout=kind, optimized=False)

        def store(ref, value: jax.Array) -> None:
            ref[...] = value.astype(ref.dtype)
            plgpu.commit_smem()

        def each_row(ref, cols: int) -> jax.Array:
            vector = load(ref, layout.reduce(0)).astype(float32)
            return jax.lax.broadcast_in_dim(vector, (TILE, cols), [1])

        def each_column(vector: jax.Array) -> jax.Array:
            return jax.lax.broadcast_in_dim(vector, (TILE, NUM_OUTPUTS), [0])

        def silu(z: jax.Array) -> tuple[jax.Array, jax.Array]:
            """SiLU and its derivative."""
            sigmoid = 1.0 / (1.0 + jnp.exp(-z))
            value = z * sigmoid
            return value, sigmoid * (1.0 + z - value)

        value, slope = silu(matmul(x, w1, TILE, width))
        store(slope1, slope)
        store(h1, value)
        z = matmul(h1, w2, TILE, width)
        value, slope = silu(z + each_row(hidden_ref.at[seed, network, hidden_bias], width))
        store(slope2, slope)
        store(h2, value)
        bias = each_row(exact_ref.at[seed, network, output_bias], NUM_OUTPUTS)
        result = matmul(h2, w3, TILE, NUM_OUTPUTS) + bias

        log_std = each_row(exact_ref.at[seed, network, noise_row], NUM_OUTPUTS)
        inverse_std = jnp.exp(-log_std)
        old_log_prob, advantage, target = (
            load(scalars_ref.at[seed, minibatch, i, columns], layout.reduce(1)) for i in range(3)
        )
        deviation = (load(action_ref.at[samples]) - result) * inverse_std
        log_density = deviation * deviation * -0.5 - log_std
        log_ratio = jnp.sum(log_density, axis=1) - log_scale - old_log_prob
        ratio = jnp.exp(log_ratio)
        gain = ratio * advantage
        clipped_gain = jnp.minimum(jnp.maximum(ratio, low), high) * advantage
        # The derivative by the logarithm of the probability; 0 where the clipped ratio counts.
        by_log_prob = each_column(
            jnp.where(gain <= clipped_gain, gain, jnp.zeros_like(gain)) * -mean_of
        )
        if interpret is not None:
            column = jax.lax.broadcasted_iota(jnp.int32, (TILE, NUM_OUTPUTS), 1)
        else:
            column = plgpu.broadcasted_iota(jnp.int32, (TILE, NUM_OUTPUTS), 1, layout=layout)
        error = jnp.where(column == 0, result - each_column(target), jnp.zeros_like(result))
        is_policy = network == 0
        by_result = jnp.where(
            is_policy,
            by_log_prob * deviation * inverse_std,
            error * (2.0 * config.value_cost * mean_of),
        )
        store(out_gradient, by_result)
        losses = jnp.where(
            is_policy, -jnp.minimum(gain, clipped_gain), jnp.sum(error * error, axis=1)
        )
        metrics_ref[seed, network, tile, 0] = jnp.sum(losses) * mean_of
        metrics_ref[seed, network, tile, 1] = jnp.sum(ratio - 1.0 - log_ratio) * mean_of

        hidden_result = hidden_gradient_ref.at[seed, network, tile]
        output_result = output_gradient_ref.at[seed, network, tile]
        output_result[output_bias] = jnp.sum(by_result, axis=0)
        output_result[noise_row] = jnp.sum(by_log_prob * (deviation * deviation - 1.0), axis=0)
        output_result[pl.ds(0, width)] = matmul(h2, out_gradient, width, NUM_OUTPUTS, flip_a=True)
        gradient = matmul(out_gradient, w3, TILE, width, flip_b=True)
        gradient *= load(slope2).astype(float32)
        hidden_result[hidden_bias] = jnp.sum(gradient, axis=0)
        store(slope2, gradient)
        hidden_result[second] = matmul(h1, slope2, width, width, flip_a=True)
        gradient = matmul(slope2, w2, TILE, width, flip_b=True) * load(slope1).astype(float32)
        store(slope1, gradient)
        hidden_result[first] = matmul(x, slope1, NUM_INPUTS, width, flip_a=True)

    # Operands of one product need the same swizzle, which their narrowest dimension bounds.
    wide = (plgpu.TilingTransform((8, 64)), plgpu.SwizzleTransform(128))
    narrow = (plgpu.TilingTransform((8, 16)), plgpu.SwizzleTransform(32))

    def shared(rows: int, cols: int, transforms: tuple) -> plgpu.SMEM:
        return plgpu.SMEM((rows, cols), bfloat16, transforms=transforms)

    def sums(*shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((num_seeds, 2, tiles, *shape), float32)

    run = plgpu.kernel(
        kernel,
        out_type=[sums(*hidden.shape[2:]), sums(*output.shape[2:]), sums(2)],
        scratch_types=[
            shared(TILE, NUM_INPUTS, wide),
            shared(NUM_INPUTS, width, wide),
            shared(width, width, wide),
            shared(width, NUM_OUTPUTS, narrow),
            shared(TILE, width, wide),
            shared(TILE, width, wide),
            shared(TILE, width, narrow),
            shared(TILE, width, wide),
            shared(TILE, NUM_OUTPUTS, narrow),
            plgpu.Barrier(num_arrivals=4),
        ],
        grid=(tiles, 2, num_seeds),
        grid_names=("tile", "network", "seed"),
        compiler_params=plgpu.CompilerParams(
            approx_math=True, lowering_semantics=plgpu.LoweringSemantics.Lane
        ),
        interpret=interpret,
    )
    return tuple(run(inputs, action, scalars, hidden, output, exact_output, index))
