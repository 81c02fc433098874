"""The networks of a config, and the policy that acts with them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.networks import MLP, PolicyNetwork
from bounce_mjx.learning.statistics import Normalizer, init_normalizer, normalize


class Policy(NamedTuple):
    """The arrays that are needed to act, as a pytree."""

    normalizer: Normalizer
    """Normaliser of the observation [N]."""
    params: Any
    """Parameters of the policy network."""


class Network(NamedTuple):
    """A network as two pure functions."""

    init: Callable[[jax.Array], Any]
    """key -> parameters; consumes the key."""
    apply: Callable[[Any, jax.Array], Any]
    """(parameters, normalised inputs [..., N]) -> output."""


class Networks(NamedTuple):
    """The two networks of a training."""

    policy_network: Network
    """Its inputs are observations, its output is a `Gaussian` over actions [..., A]."""
    value_network: Network
    """Its inputs are the observation and the critic metrics, its output the values [...]."""


def make_networks(
    config: PPOConfig, observation_size: int, action_size: int, num_critic_metrics: int = 0
) -> Networks:
    """The networks of a config for an environment with these sizes; the critic is not needed to
    act."""
    policy = PolicyNetwork(config.hidden_layers, action_size, config.init_noise_std)
    value = MLP((*config.hidden_layers, 1), activate_final=False)
    critic_size = observation_size + num_critic_metrics
    return Networks(
        policy_network=Network(
            init=lambda key: policy.init(key, jnp.zeros((1, observation_size))),
            apply=policy.apply,
        ),
        value_network=Network(
            init=lambda key: value.init(key, jnp.zeros((1, critic_size))),
            apply=lambda params, inputs: value.apply(params, inputs)[..., 0],
        ),
    )


def untrained_policy(networks: Networks, observation_size: int, key: jax.Array) -> Policy:
    """A policy before the first update; consumes the key."""
    return Policy(init_normalizer(observation_size), networks.policy_network.init(key))


def cast_hidden_layers(config: PPOConfig, params: Any, dtype: jnp.dtype) -> Any:
    """Parameters of one network of `make_networks` with its hidden layers in another type.

    The output layer and the noise keep theirs, so the outputs stay as precise: flax computes a
    layer in the wider one of the types of its parameters and its input.
    """
    hidden = {f"hidden_{i}" for i in range(len(config.hidden_layers))}

    def cast(path: tuple, x: jax.Array) -> jax.Array:
        return x.astype(dtype) if any(getattr(k, "key", None) in hidden for k in path) else x

    return jax.tree_util.tree_map_with_path(cast, params)


def act(networks: Networks, policy: Policy, observation: jax.Array) -> jax.Array:
    """The most likely actions [..., A] for observations [..., N], clipped to [-1, 1]."""
    inputs = normalize(observation, policy.normalizer)
    return jnp.clip(networks.policy_network.apply(policy.params, inputs).mean, -1.0, 1.0)
