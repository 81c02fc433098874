"""The policy and the value network: brax's networks, distribution and running statistics."""

from typing import Any, NamedTuple

import jax
from brax.training.acme import running_statistics
from brax.training.agents.ppo.networks import PPONetworks, make_ppo_networks
from brax.training.types import PreprocessObservationFn, identity_observation_preprocessor

from bounce_mjx.learning.config import PPOConfig

# A normalised observation beyond this many standard deviations is clipped.
MAX_NORMALIZED = 10.0
# Added to the variance of every observation.
MIN_VARIANCE = 1e-6
# An observation whose standard deviation is no more than what MIN_VARIANCE gives it never varied.
MIN_STD = 1.01 * MIN_VARIANCE**0.5


class Policy(NamedTuple):
    """What acting needs of a training: a pytree of arrays."""

    normalizer: running_statistics.RunningStatisticsState
    params: Any
    """Parameters of the policy network."""


def make_networks(
    config: PPOConfig,
    observation_size: int,
    action_size: int,
    preprocess: PreprocessObservationFn = identity_observation_preprocessor,
) -> PPONetworks:
    """Networks on normalised inputs: a Gaussian with a learned, state-independent standard
    deviation on the observation, and a value on the observation and the critic's metrics.

    Args:
      preprocess: what a trainer that hands over raw observations normalises them with.
    """
    return make_ppo_networks(
        {"state": (observation_size,), "critic": (observation_size + len(config.critic_metrics),)},
        action_size,
        preprocess_observations_fn=preprocess,
        policy_obs_key="state",
        value_obs_key="critic",
        policy_hidden_layer_sizes=config.hidden_layers,
        value_hidden_layer_sizes=config.hidden_layers,
        activation=jax.nn.silu,
        distribution_type="normal",
        noise_std_type="log",
        init_noise_std=config.init_noise_std,
        policy_network_kernel_init_fn=jax.nn.initializers.orthogonal,
        policy_network_kernel_init_kwargs={"scale": 2**0.5},
        value_network_kernel_init_fn=jax.nn.initializers.orthogonal,
        value_network_kernel_init_kwargs={"scale": 2**0.5},
        mean_kernel_init_fn=jax.nn.initializers.orthogonal,
        mean_kernel_init_kwargs={"scale": 0.01},
    )


def cast_hidden_layers(config: PPOConfig, params: Any, dtype: jax.numpy.dtype) -> Any:
    """Parameters of one network of `make_networks` with its hidden layers in another type.

    The output layer and the noise keep theirs, so the outputs stay as precise: flax computes a
    layer in the wider of the types of its parameters and its input.
    """
    hidden = {f"hidden_{i}" for i in range(len(config.hidden_layers))}

    def cast(path: tuple, x: jax.Array) -> jax.Array:
        return x.astype(dtype) if any(getattr(k, "key", None) in hidden for k in path) else x

    return jax.tree_util.tree_map_with_path(cast, params)


def init_normalizer(observation_size: int) -> running_statistics.RunningStatisticsState:
    """Running statistics of observations [observation_size], before any were seen."""
    template = jax.ShapeDtypeStruct((observation_size,), jax.numpy.float32)
    return running_statistics.init_state(template, std_eps=MIN_VARIANCE)


def normalize(
    observation: jax.Array, normalizer: running_statistics.RunningStatisticsState
) -> jax.Array:
    """Observations [..., 29] in standard deviations from their mean, clipped.

    One that never varied is 0, whatever it is now. In the fused physics the ball's quaternion and
    spin are constant; in another engine's float32 they drift by rounding, which must not be
    magnified to a signal.
    """
    standardized = running_statistics.normalize(
        observation, normalizer, max_abs_value=MAX_NORMALIZED
    )
    return jax.numpy.where(normalizer.std > MIN_STD, standardized, 0.0)


def act(networks: PPONetworks, policy: Policy, observation: jax.Array) -> jax.Array:
    """The most likely actions [..., 6] for observations [..., 29], clipped to [-1, 1]."""
    logits = networks.policy_network.apply(
        None, policy.params, normalize(observation, policy.normalizer)
    )
    return jax.numpy.clip(networks.parametric_action_distribution.mode(logits), -1.0, 1.0)
