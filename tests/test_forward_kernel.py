"""The GPU kernel of a network's outputs, in Pallas' interpreter, against the network itself."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bounce_mjx.learning import forward_kernel, minibatch_kernel
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import make_networks

NUM_OBSERVATIONS, NUM_CRITIC_INPUTS, NUM_ACTIONS = 29, 30, 6
LENGTH, BATCH = 3, 128


def random_networks(width: int, seed: int = 0):
    config = PPOConfig(hidden_layers=(width, width))
    networks = make_networks(
        config, NUM_OBSERVATIONS, NUM_ACTIONS, NUM_CRITIC_INPUTS - NUM_OBSERVATIONS
    )
    key = jax.random.PRNGKey(seed)
    params = networks.policy_network.init(key), networks.value_network.init(key)
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(key, len(leaves))
    # Biases and outputs of a new network are 0.
    moved = [x + 0.1 * jax.random.normal(k, x.shape) for x, k in zip(leaves, keys, strict=True)]
    return networks, tree.unflatten(moved)


def random_inputs() -> jax.Array:
    return jax.random.normal(jax.random.PRNGKey(1), (LENGTH, BATCH, NUM_CRITIC_INPUTS))


def outputs(params, inputs, interpret=None) -> tuple[jax.Array, jax.Array]:
    """Means of the policy and values."""
    packed = minibatch_kernel.pack(params)
    low = minibatch_kernel.low_precision(packed)
    return tuple(
        forward_kernel.forward(packed, low, network, inputs, num_outputs, interpret)
        for network, num_outputs in ((0, NUM_ACTIONS), (1, 1))
    )


@pytest.mark.parametrize("multiprocessors", [3, 1])
def test_outputs_equal_the_networks(interpret, monkeypatch, multiprocessors):
    """Six tiles in blocks of one tile each, and in blocks of three."""
    monkeypatch.setattr(forward_kernel, "MULTIPROCESSORS", multiprocessors)
    networks, params = random_networks(64)
    inputs = random_inputs()
    means, values = outputs(params, inputs, interpret)
    exact = networks.policy_network.apply(params[0], inputs[..., :NUM_OBSERVATIONS]).mean
    # bfloat16 has eight binary digits.
    np.testing.assert_allclose(means, exact, rtol=0, atol=0.02 * float(jnp.abs(exact).max()))
    exact = networks.value_network.apply(params[1], inputs)
    np.testing.assert_allclose(
        values[..., 0], exact, rtol=0, atol=0.02 * float(jnp.abs(exact).max())
    )


def test_several_seeds_keep_their_own_weights(interpret):
    inputs = random_inputs()
    both = [random_networks(64, seed)[1] for seed in range(2)]
    alone = [outputs(params, inputs, interpret) for params in both]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *both)
    together = jax.vmap(lambda params: outputs(params, inputs, interpret))(stacked)
    for i in range(2):
        for ours, theirs in zip(together, alone[i], strict=True):
            np.testing.assert_array_equal(ours[i], theirs)


@pytest.mark.parametrize("width", [64, 128])
def test_the_kernel_is_lowered_for_a_gpu(width):
    """This needs no GPU."""
    _, params = random_networks(width)
    traced = jax.jit(outputs).trace(params, random_inputs())
    lowered = traced.lower(lowering_platforms=("cuda",)).as_text()
    assert lowered.count("custom_call @mosaic_gpu") == 2


_TWO_DEVICES = """
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec as P
from bounce_mjx.learning import forward_kernel, minibatch_kernel

mesh = Mesh(np.array(jax.devices()), ("devices",))

def shape(*sizes, dtype=jnp.float32, spec=P()):
    return jax.ShapeDtypeStruct(sizes, dtype, sharding=NamedSharding(mesh, spec))

inputs = shape(3, 256, 30, spec=P(None, "devices"))
params = minibatch_kernel.PackedParams(shape(2, 136, 64), shape(2, 72, 16))
low = minibatch_kernel.PackedParams(*(shape(*x.shape, dtype=jnp.bfloat16) for x in params))
means = jax.jit(lambda *args: forward_kernel.forward(*args[:2], 0, args[2], 6))
lowered = means.trace(params, low, inputs).lower(lowering_platforms=("cuda",)).as_text()
assert lowered.count("@CustomSPMDPartitioning") == 1, lowered
assert forward_kernel.supports(128) and not forward_kernel.supports(192)
"""


def test_the_kernel_is_lowered_for_two_gpus():
    """The compiler accepts the rule by which two devices share the environments."""
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-c", _TWO_DEVICES], env=os.environ | flags, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
