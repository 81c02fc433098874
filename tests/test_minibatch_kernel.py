"""The GPU kernel of a minibatch, in Pallas' interpreter, against autodiff of PPO's loss."""

import math
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bounce_mjx.gpu.block_sums import block_sums, num_chunks
from bounce_mjx.learning import minibatch_kernel
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.minibatch_kernel import Batch, PackedParams, Sizes
from bounce_mjx.learning.policy import make_networks

NUM_OBSERVATIONS, NUM_CRITIC_INPUTS, NUM_ACTIONS = 29, 30, 6
CONFIG = PPOConfig(
    num_envs=16,
    rollout_length=32,
    num_minibatches=2,
    hidden_layers=(64, 64),
    compute_dtype="bfloat16",
    value_cost=0.7,
    entropy_cost=0.01,
)
SIZES = Sizes(NUM_OBSERVATIONS, NUM_ACTIONS)
NUM_SAMPLES = CONFIG.batch_steps // CONFIG.num_minibatches


def random_params(key: jax.Array):
    networks = make_networks(
        CONFIG, NUM_OBSERVATIONS, NUM_ACTIONS, NUM_CRITIC_INPUTS - NUM_OBSERVATIONS
    )
    params = networks.policy_network.init(key), networks.value_network.init(key)
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(key, len(leaves))
    # Biases and outputs of a new network are 0.
    moved = [x + 0.1 * jax.random.normal(k, x.shape) for x, k in zip(leaves, keys, strict=True)]
    return networks, tree.unflatten(moved)


def random_samples(key: jax.Array, networks, params) -> dict[str, jax.Array]:
    """Samples of all minibatches, some of which have left the clipping range."""
    keys = jax.random.split(key, 5)
    shape = (CONFIG.num_minibatches, NUM_SAMPLES)
    inputs = jax.random.normal(keys[0], (*shape, NUM_CRITIC_INPUTS)).astype(jnp.bfloat16)
    inputs = inputs.astype(jnp.float32)
    distribution = networks.policy_network.apply(params[0], inputs[..., :NUM_OBSERVATIONS])
    action = distribution.mean + distribution.std * jax.random.normal(
        keys[1], (*shape, NUM_ACTIONS)
    )
    return {
        "inputs": inputs,
        "action": action,
        "log_prob": distribution.log_prob(action) + 0.2 * jax.random.normal(keys[2], shape),
        "advantage": jax.random.normal(keys[3], shape),
        "target": jax.random.normal(keys[4], shape),
    }


def expected_loss(params, networks, samples: dict[str, jax.Array]):
    """The loss of Schulman et al. 2017, equations 7 and 9, in float32, and its parts."""
    policy, value = params
    distribution = networks.policy_network.apply(policy, samples["inputs"][:, :NUM_OBSERVATIONS])
    log_ratio = distribution.log_prob(samples["action"]) - samples["log_prob"]
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - CONFIG.clip_epsilon, 1.0 + CONFIG.clip_epsilon)
    advantage = samples["advantage"]
    policy_loss = -jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage))
    error = networks.value_network.apply(value, samples["inputs"]) - samples["target"]
    value_loss = jnp.mean(error**2)
    entropy = jnp.mean(distribution.entropy())
    total = policy_loss + CONFIG.value_cost * value_loss - CONFIG.entropy_cost * entropy
    return total, {
        "loss/policy": policy_loss,
        "loss/value": value_loss,
        "policy/kl": jnp.mean(ratio - 1.0 - log_ratio),
        "policy/entropy": entropy,
        "policy/action_std": jnp.mean(distribution.std),
    }


def test_packing_is_undone_and_pads_with_zeros():
    _, params = random_params(jax.random.PRNGKey(0))
    gradients = minibatch_kernel.kernel_gradients(CONFIG, SIZES, params)
    packed = gradients.pack(params)
    for ours, theirs in zip(
        jax.tree.leaves(gradients.unpack(packed)), jax.tree.leaves(params), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)
    squares = [sum(float(jnp.sum(x**2)) for x in jax.tree.leaves(t)) for t in (packed, params)]
    assert squares[0] == pytest.approx(squares[1], rel=1e-6)


@pytest.mark.parametrize("multiprocessors", [4, 2])
def test_gradient_and_metrics_equal_autodiff_of_the_loss(interpret, monkeypatch, multiprocessors):
    """With two multiprocessors, each network has one block, which takes two tiles."""
    monkeypatch.setattr(minibatch_kernel, "MULTIPROCESSORS", multiprocessors)
    minibatch_kernel._batched_call.cache_clear()
    networks, params = random_params(jax.random.PRNGKey(0))
    samples = random_samples(jax.random.PRNGKey(1), networks, params)
    monkeypatch.setattr(
        minibatch_kernel,
        "loss_gradient",
        lambda *args, plain=minibatch_kernel.loss_gradient: plain(*args, interpret=interpret),
    )
    gradients = minibatch_kernel.kernel_gradients(CONFIG, SIZES, params)
    ones = jnp.ones((*samples["inputs"].shape[:2], 1))
    padding = jnp.zeros((*samples["inputs"].shape[:2], 63 - NUM_CRITIC_INPUTS))
    batch = Batch(
        jnp.concatenate([samples["inputs"], padding, ones], axis=-1).astype(jnp.bfloat16),
        jnp.pad(samples["action"], ((0, 0), (0, 0), (0, 16 - NUM_ACTIONS))),
        jnp.stack([samples[name] for name in ("log_prob", "advantage", "target")], axis=1),
    )
    second = {name: x[1] for name, x in samples.items()}
    packed = gradients.pack(params)
    packed, metrics = gradients.gradient(packed, gradients.copy(packed), batch, jnp.int32(1))
    ours = gradients.unpack(packed)
    theirs, expected = jax.grad(expected_loss, has_aux=True)(params, networks, second)
    for (path, a), b in zip(
        jax.tree_util.tree_leaves_with_path(ours), jax.tree.leaves(theirs), strict=True
    ):
        # bfloat16 has eight binary digits, so rounding moves some samples across the clipping
        # limit.
        error = float(jnp.linalg.norm(a - b) / jnp.linalg.norm(b))
        assert error < 0.05, jax.tree_util.keystr(path)
    norm = math.sqrt(sum(float(jnp.sum(x**2)) for x in jax.tree.leaves(theirs)))
    expected |= {"loss/gradient_norm": norm}
    assert metrics.keys() == expected.keys()
    for name, value in expected.items():
        assert float(metrics[name]) == pytest.approx(float(value), rel=0.02, abs=1e-3), name
    # Padding stays 0, so it does not contribute to the norm of the gradient and never changes.
    total = sum(float(jnp.sum(x**2)) for x in packed)
    assert math.isclose(
        total, sum(float(jnp.sum(x**2)) for x in jax.tree.leaves(ours)), rel_tol=1e-5
    )


def test_shuffling_keeps_samples_together():
    """Each sample's numbers stay together, and the minibatches follow the order."""
    _, params = random_params(jax.random.PRNGKey(0))
    gradients = minibatch_kernel.kernel_gradients(CONFIG, SIZES, params)
    groups, size = 4, CONFIG.batch_steps // 4
    number = jnp.arange(groups * size, dtype=jnp.float32).reshape(groups, size)

    class Samples:
        inputs = jnp.repeat(number[..., None] % 256, NUM_CRITIC_INPUTS, axis=-1)
        action = jnp.repeat(number[..., None], NUM_ACTIONS, axis=-1)
        log_prob, advantage, value_target = number, 2.0 * number, 3.0 * number

    keys = jax.random.split(jax.random.PRNGKey(0), groups)
    order = jax.vmap(lambda key: jax.random.permutation(key, size))(keys)
    order = order.reshape(groups, CONFIG.num_minibatches, -1)
    mean, deviation = jnp.array([1.0, 2.0]), jnp.array([3.0, 4.0])
    batch = gradients.shuffle(Samples, order, mean, deviation)
    chosen = jax.vmap(lambda x, i: x[i])(number, order)
    for i in range(CONFIG.num_minibatches):
        numbers = np.asarray(batch.scalars[i, 0])
        assert set(numbers) == set(np.asarray(chosen[:, i]).ravel())
        np.testing.assert_array_equal(batch.action[i, :, 0], numbers)
        np.testing.assert_array_equal(batch.inputs[i, :, 0].astype(jnp.float32), numbers % 256)
        expected = (2.0 * numbers - mean[i]) / deviation[i]
        np.testing.assert_allclose(batch.scalars[i, 1], expected, rtol=1e-6)
        np.testing.assert_array_equal(batch.scalars[i, 2], 3.0 * numbers)
    np.testing.assert_array_equal(batch.inputs[..., -1], 1.0)


@pytest.mark.parametrize(
    ("changes", "supported"),
    [
        ({}, True),
        ({"hidden_layers": (128, 128), "num_envs": 64}, True),
        ({"compute_dtype": "float32"}, False),
        ({"hidden_layers": (64, 128)}, False),
        ({"hidden_layers": (64, 64, 64)}, False),
        ({"num_minibatches": 8}, False),
    ],
)
def test_the_kernel_supports_these_trainings(changes, supported):
    config = PPOConfig.model_validate(dict(CONFIG) | changes)
    assert minibatch_kernel.supports(config, NUM_CRITIC_INPUTS, NUM_ACTIONS) is supported
    assert not minibatch_kernel.supports(config, 64, NUM_ACTIONS)


def test_the_kernel_is_lowered_for_a_gpu():
    """This needs no GPU: the program has two kernels per minibatch, for one seed and for
    several: the gradients of its parts, and their sum."""
    _, params = random_params(jax.random.PRNGKey(0))
    packed = minibatch_kernel.pack(params)
    shape = (CONFIG.num_minibatches, NUM_SAMPLES)
    batch = Batch(
        jnp.zeros((*shape, 64), jnp.bfloat16), jnp.zeros((*shape, 16)), jnp.zeros((2, 3, shape[1]))
    )

    def gradient(packed: PackedParams, batch: Batch, index: jax.Array):
        low = minibatch_kernel.low_precision(packed)
        return minibatch_kernel.loss_gradient(CONFIG, SIZES, packed, low, batch, index)

    two = jax.tree.map(lambda x: jnp.stack([x, x]), (packed, batch, jnp.int32(0)))
    for program, args in (
        (gradient, (packed, batch, jnp.int32(0))),
        (jax.vmap(gradient), two),
    ):
        lowered = jax.jit(program).trace(*args).lower(lowering_platforms=("cuda",)).as_text()
        assert lowered.count("custom_call @mosaic_gpu") == 2


def test_parts_and_squares_are_summed(interpret):
    """Numbers of blocks that are and are not a multiple of those read ahead, and both chunks."""
    random = np.random.default_rng(0)
    arrays = [
        random.normal(size=(2, blocks, size)).astype(np.float32)
        for blocks, size in ((16, 1024), (6, 384), (11, 128))
    ]
    sums, squares = block_sums([jnp.asarray(x) for x in arrays], interpret)
    expected = [x.astype(np.float64).sum(axis=1) for x in arrays]
    for ours, theirs in zip(sums, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-5)
    chunks = [num_chunks(x.shape[2]) for x in arrays]
    assert squares.shape == (2, sum(chunks))
    for part, total in zip(np.split(squares, np.cumsum(chunks)[:-1], 1), expected, strict=True):
        np.testing.assert_allclose(part.sum(axis=1), (total**2).sum(axis=1), rtol=1e-5)


_TWO_DEVICES = """
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec as P
from bounce_mjx.learning import minibatch_kernel
from bounce_mjx.learning.config import PPOConfig

config = PPOConfig(
    num_envs=64, num_minibatches=2, hidden_layers=(64, 64), compute_dtype="bfloat16"
)
mesh = Mesh(np.array(jax.devices()), ("devices",))

def shape(*sizes, dtype=jnp.float32, spec=P()):
    return jax.ShapeDtypeStruct(sizes, dtype, sharding=NamedSharding(mesh, spec))

batch = minibatch_kernel.Batch(
    shape(2, 1024, 64, dtype=jnp.bfloat16, spec=P(None, "devices")),
    shape(2, 1024, 16, spec=P(None, "devices")),
    shape(2, 3, 1024, spec=P(None, None, "devices")),
)
params = minibatch_kernel.PackedParams(shape(2, 136, 64), shape(2, 72, 16))
low = minibatch_kernel.PackedParams(*(shape(*x.shape, dtype=jnp.bfloat16) for x in params))
gradient = jax.jit(
    lambda *args: minibatch_kernel.loss_gradient(config, minibatch_kernel.Sizes(29, 6), *args)
)
index = shape(dtype=jnp.int32)
lowered = gradient.trace(params, low, batch, index).lower(lowering_platforms=("cuda",)).as_text()
assert lowered.count("@CustomSPMDPartitioning") == 1, lowered
"""


def test_the_kernel_is_lowered_for_two_gpus():
    """The compiler accepts the rule by which two devices share the samples of a minibatch."""
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-c", _TWO_DEVICES], env=os.environ | flags, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
