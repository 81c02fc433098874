"""What the policy sees of an observation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import Policy, act, make_networks
from bounce_mjx.learning.statistics import (
    init_normalizer,
    init_statistics,
    normalize,
    update,
)

CONSTANT = slice(9, 13)


@pytest.fixture(scope="module")
def seen() -> np.ndarray:
    """Observations [5000, 29] of a training in which the ball's quaternion never changed."""
    rng = np.random.default_rng(0)
    scale = rng.uniform(0.01, 2.0, 29)
    observations = rng.normal(rng.uniform(-1.0, 1.0, 29), scale, (5000, 29))
    observations[:, CONSTANT] = [1.0, 0.0, 0.0, 0.0]
    return observations.astype(np.float32)


@pytest.fixture(scope="module")
def normalizer(seen):
    return update(init_statistics(29), jnp.asarray(seen)).normalizer


def test_varying_observations_are_standardized(seen, normalizer):
    exact = seen.astype(np.float64)
    expected = (exact - exact.mean(0)) / np.sqrt(exact.var(0) + 1e-6)
    varying = np.delete(np.arange(29), CONSTANT)
    actual = normalize(jnp.asarray(seen), normalizer)
    np.testing.assert_allclose(actual[:, varying], expected[:, varying], rtol=2e-3, atol=2e-3)


def test_far_observations_are_clipped(normalizer):
    far = normalize(jnp.full(29, 1e6), normalizer)
    np.testing.assert_array_equal(np.delete(far, CONSTANT), 10.0)


def test_before_any_data_observations_pass_as_they_are():
    observation = jnp.linspace(-3.0, 3.0, 29)
    np.testing.assert_array_equal(normalize(observation, init_normalizer(29)), observation)


def test_drift_of_what_never_varied_does_not_move_the_policy(seen, normalizer):
    """As the ball's orientation drifts by rounding in MJX: policies that bounced elsewhere failed
    there before."""
    networks = make_networks(PPOConfig(hidden_layers=(16,)), 29, 6)
    params = networks.policy_network.init(jax.random.PRNGKey(0))
    policy = Policy(normalizer, params)
    observation = jnp.asarray(seen[0])
    drifted = observation.at[CONSTANT].set(jnp.array([0.99, 0.1, -0.05, 0.02]))
    action = act(networks, policy, observation)
    np.testing.assert_array_equal(act(networks, policy, drifted), action)
    moved = act(networks, policy, observation.at[0].add(1.0))
    assert np.abs(moved - action).max() > 1e-4
