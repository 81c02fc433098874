"""The GPU kernel of a minibatch, in Pallas' interpreter, against autodiff of PPO's loss."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.pallas import mosaic_gpu as plgpu

from bounce_mjx.learning import minibatch_kernel
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.minibatch_kernel import Batch, PackedParams
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
NUM_SAMPLES = CONFIG.batch_steps // CONFIG.num_minibatches


@pytest.fixture(scope="module")
def interpret():
    if hasattr(plgpu, "InterpretGPUParams"):
        return plgpu.InterpretGPUParams()
    from jax._src.pallas.mosaic_gpu.interpret.params import InterpretGPUParams

    return InterpretGPUParams()


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
    gradients = minibatch_kernel.kernel_gradients(CONFIG, NUM_ACTIONS, params)
    packed = gradients.pack(params)
    for ours, theirs in zip(
        jax.tree.leaves(gradients.unpack(packed)), jax.tree.leaves(params), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)
    squares = [sum(float(jnp.sum(x**2)) for x in jax.tree.leaves(t)) for t in (packed, params)]
    assert squares[0] == pytest.approx(squares[1], rel=1e-6)
    ones = minibatch_kernel.pack(jax.tree.map(jnp.ones_like, params))
    for mask, one in zip(minibatch_kernel.parameter_mask(params), ones, strict=True):
        np.testing.assert_array_equal(mask, one > 0.0)


def test_gradient_and_metrics_equal_autodiff_of_the_loss(interpret, monkeypatch):
    networks, params = random_params(jax.random.PRNGKey(0))
    samples = random_samples(jax.random.PRNGKey(1), networks, params)
    monkeypatch.setattr(
        minibatch_kernel,
        "loss_gradient",
        lambda *args, plain=minibatch_kernel.loss_gradient: plain(*args, interpret=interpret),
    )
    gradients = minibatch_kernel.kernel_gradients(CONFIG, NUM_ACTIONS, params)
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
    gradients = minibatch_kernel.kernel_gradients(CONFIG, NUM_ACTIONS, params)
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
    """This needs no GPU: the program has one kernel per minibatch, for one seed and for several."""
    _, params = random_params(jax.random.PRNGKey(0))
    packed = minibatch_kernel.pack(params)
    shape = (CONFIG.num_minibatches, NUM_SAMPLES)
    batch = Batch(
        jnp.zeros((*shape, 64), jnp.bfloat16), jnp.zeros((*shape, 16)), jnp.zeros((2, 3, shape[1]))
    )

    def gradient(packed: PackedParams, batch: Batch, index: jax.Array):
        low = minibatch_kernel.low_precision(packed)
        return minibatch_kernel.loss_gradient(CONFIG, NUM_ACTIONS, packed, low, batch, index)

    two = jax.tree.map(lambda x: jnp.stack([x, x]), (packed, batch, jnp.int32(0)))
    for program, args in (
        (gradient, (packed, batch, jnp.int32(0))),
        (jax.vmap(gradient), two),
    ):
        lowered = jax.jit(program).trace(*args).lower(lowering_platforms=("cuda",)).as_text()
        assert lowered.count("custom_call @mosaic_gpu") == 1
