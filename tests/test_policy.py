"""Networks, distribution and normalisation: against brax's implementations, and property by
property."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.acme import running_statistics
from brax.training.agents.ppo.networks import make_ppo_networks
from brax.training.distribution import NormalDistribution

from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import ActionDistribution, Policy, make_networks
from bounce_mjx.learning.statistics import (
    MAX_NORMALIZED,
    MIN_VARIANCE,
    denormalize,
    init_normalizer,
    init_statistics,
    normalize,
    update,
)
from bounce_mjx.task.bounce import Config as BounceConfig

OBSERVATION = BounceConfig().layout

CONSTANT = OBSERVATION["ball_quaternion"]
N = OBSERVATION.size


@pytest.fixture(scope="module")
def seen() -> np.ndarray:
    """Observations [5000, 29] of a training in which the ball's quaternion never changed."""
    rng = np.random.default_rng(0)
    scale = rng.uniform(0.01, 2.0, N)
    observations = rng.normal(rng.uniform(-1.0, 1.0, N), scale, (5000, N))
    observations[:, CONSTANT] = [1.0, 0.0, 0.0, 0.0]
    return observations.astype(np.float32)


@pytest.fixture(scope="module")
def normalizer(seen):
    return update(init_statistics(N), jnp.asarray(seen)).normalizer


def test_far_observations_are_clipped(normalizer):
    far = normalize(jnp.full(N, 1e6), normalizer)
    np.testing.assert_array_equal(np.delete(far, CONSTANT), 10.0)


def test_denormalised_inputs_have_their_units(seen, normalizer):
    """Up to rounding, also the constant ones; one that was clipped is at 10 standard deviations."""
    units = denormalize(normalize(jnp.asarray(seen), normalizer), normalizer)
    np.testing.assert_allclose(units, seen, rtol=1e-5, atol=1e-5)
    far = denormalize(normalize(jnp.full(N, -1e6), normalizer), normalizer)
    limit = seen.mean(axis=0) - 10.0 * seen.std(axis=0)
    np.testing.assert_allclose(far, limit, rtol=1e-3, atol=1e-3)


def test_before_any_data_observations_are_unchanged():
    observation = jnp.linspace(-3.0, 3.0, N)
    for normalizer in (init_normalizer(N), init_statistics(N).normalizer):
        np.testing.assert_array_equal(normalize(observation, normalizer), observation)


def test_statistics_equal_brax(seen):
    """Batches [T, B, N], as the trainer adds them, give the same update and normalisation."""
    ours = init_statistics(N)
    theirs = running_statistics.init_state(
        jax.ShapeDtypeStruct((N,), jnp.float32), std_eps=MIN_VARIANCE
    )
    for batch in np.split(seen[:4800].reshape(60, 80, N), [20, 25]):
        batch = jnp.asarray(batch)
        ours, theirs = update(ours, batch), running_statistics.update(theirs, batch)
        np.testing.assert_allclose(ours.mean, theirs.mean, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(ours.std, theirs.std, rtol=1e-6)
        np.testing.assert_allclose(ours.summed_variance, theirs.summed_variance, rtol=1e-6)
        expected = running_statistics.normalize(batch, theirs, max_abs_value=MAX_NORMALIZED)
        expected = expected.at[..., CONSTANT].set(0.0)
        np.testing.assert_allclose(
            normalize(batch, ours.normalizer), expected, rtol=1e-5, atol=1e-5
        )
    assert int(ours.count) == int(theirs.count) == 4800


@pytest.fixture(scope="module")
def config() -> PPOConfig:
    return PPOConfig(hidden_layers=(16, 12), critic_metrics=("n_bounces", "bounced"))


@pytest.fixture(scope="module")
def brax_networks(config):
    orthogonal = jax.nn.initializers.orthogonal
    return make_ppo_networks(
        {"state": (N,), "critic": (N + 2,)},
        6,
        policy_obs_key="state",
        value_obs_key="critic",
        policy_hidden_layer_sizes=config.hidden_layers,
        value_hidden_layer_sizes=config.hidden_layers,
        activation=jax.nn.silu,
        distribution_type="normal",
        noise_std_type="log",
        init_noise_std=config.init_noise_std,
        policy_network_kernel_init_fn=orthogonal,
        policy_network_kernel_init_kwargs={"scale": 2**0.5},
        value_network_kernel_init_fn=orthogonal,
        value_network_kernel_init_kwargs={"scale": 2**0.5},
        mean_kernel_init_fn=orthogonal,
        mean_kernel_init_kwargs={"scale": 0.01},
    )


@pytest.mark.slow
@pytest.mark.parametrize("which", ["policy_network", "value_network"])
def test_networks_equal_brax(which, config, brax_networks, seen):
    """The same key gives the same parameters, by name and value, and the same outputs; brax takes
    its weights from a QR factorisation."""
    ours, theirs = getattr(make_networks(config, N, 6, 2), which), getattr(brax_networks, which)
    key = jax.random.PRNGKey(3)
    params, expected = ours.init(key), theirs.init(key)
    assert jax.tree.structure(params) == jax.tree.structure(expected)
    jax.tree.map(functools.partial(np.testing.assert_allclose, atol=2e-6), params, expected)
    # Different parameters from the initial ones, whose biases are 0.
    params = jax.tree.map(lambda x: x + 0.1, params)
    inputs = seen[:50] if which == "policy_network" else np.tile(seen[:50, :1], N + 2)
    outputs = (ours.apply(params, inputs), theirs.apply(None, params, inputs))
    for a, b in zip(*map(jax.tree.leaves, outputs), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


def test_distribution_of_the_action_equals_brax(seen):
    rng = np.random.default_rng(1)
    mean, std = rng.normal(size=(50, 6)), np.exp(rng.normal(size=(50, 6)))
    ours, theirs = ActionDistribution(mean, std), NormalDistribution(6)
    value = mean + 3.0 * std * rng.normal(size=(50, 6))
    expected = theirs.log_prob((mean, std), jnp.asarray(value))
    np.testing.assert_allclose(ours.log_prob(value), expected, rtol=1e-4)
    expected = theirs.entropy((mean, std), jax.random.PRNGKey(0))
    np.testing.assert_allclose(ours.entropy(), expected, rtol=1e-4)


def test_drift_of_a_constant_input_does_not_change_the_policy(seen, normalizer):
    """In MJX the ball's orientation drifts by rounding; policies that bounced on other engines once
    failed there."""
    networks = make_networks(PPOConfig(hidden_layers=(16,)), N, 6)
    params = networks.policy_network.init(jax.random.PRNGKey(0))
    policy = Policy(normalizer, params)
    observation = jnp.asarray(seen[0])
    drifted = observation.at[CONSTANT].set(jnp.array([0.99, 0.1, -0.05, 0.02]))
    action = networks.act(policy, observation)
    np.testing.assert_array_equal(networks.act(policy, drifted), action)
    moved = networks.act(policy, observation.at[0].add(1.0))
    assert np.abs(moved - action).max() > 1e-4
