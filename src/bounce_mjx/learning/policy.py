"""The networks of a config, and the policy that acts with them."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from bounce_mjx.env.env import Env
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.networks import MLP, PolicyNetwork
from bounce_mjx.learning.statistics import Normalizer, init_normalizer, normalize


class Policy(NamedTuple):
    """The arrays that are needed to act, as a pytree."""

    normalizer: Normalizer
    """Normaliser of the observation [N]."""
    params: Any
    """Parameters of the policy network."""


class NetworkFunctions(NamedTuple):
    """A network as two pure functions."""

    init: Callable[[jax.Array], Any]
    """key -> parameters; consumes the key."""
    apply: Callable[[Any, jax.Array], Any]
    """(parameters, normalised inputs [..., N]) -> output."""


class Networks(NamedTuple):
    """The two networks of a training run."""

    policy_network: NetworkFunctions
    """Its inputs are observations, its output is a `Gaussian` over actions [..., A]."""
    value_network: NetworkFunctions
    """Its inputs are the observation (or the features) and the critic metrics, its output the
    values [...]."""
    features: Callable[[Any, jax.Array], jax.Array]
    """(parameters of the policy, normalised observations [..., N]) -> its last hidden layer."""

    def act(self, policy: Policy, observation: jax.Array) -> jax.Array:
        """The most likely actions [..., A] for observations [..., N], clipped to [-1, 1]."""
        inputs = normalize(observation, policy.normalizer)
        return jnp.clip(self.policy_network.apply(policy.params, inputs).mean, -1.0, 1.0)


class Actor(Protocol):
    """What acts: the networks of a training run, or a law without parameters."""

    def act(self, policy: Any, observation: jax.Array) -> jax.Array:
        """Actions [..., A] in [-1, 1] for observations [..., N]."""


def make_networks(
    config: PPOConfig,
    observation_size: int,
    action_size: int,
    num_critic_metrics: int = 0,
    dtype: Any = None,
) -> Networks:
    """The networks of a config for an environment with these sizes.

    Args:
      num_critic_metrics: metrics that the critic sees; to act, it is not needed.
      dtype: type in which the hidden layers are computed; by default, that of their inputs and
        parameters.
    """
    layers, activation = config.hidden_layers, config.activation
    policy = PolicyNetwork(layers, action_size, config.init_noise_std, dtype, activation)
    hidden = MLP(layers, activate_final=True, dtype=dtype, activation=activation)
    critic_layers = config.critic_layers or (() if config.shared_critic else layers)
    value = MLP((*critic_layers, 1), activate_final=False, dtype=dtype, activation=activation)
    critic_size = layers[-1] if config.shared_critic else observation_size
    critic_size += num_critic_metrics
    return Networks(
        policy_network=NetworkFunctions(
            init=lambda key: policy.init(key, jnp.zeros((1, observation_size))), apply=policy.apply
        ),
        value_network=NetworkFunctions(
            init=lambda key: value.init(key, jnp.zeros((1, critic_size))),
            apply=lambda params, inputs: value.apply(params, inputs)[..., 0],
        ),
        features=lambda params, inputs: hidden.apply({"params": params["params"]["MLP_0"]}, inputs),
    )


def networks_of(config: PPOConfig) -> Callable[[Env], Networks]:
    """`make_networks` of a config, as a function of the environment."""
    return lambda env: make_networks(config, env.observation_size, env.action_size)


def untrained_policy(networks: Networks, observation_size: int, key: jax.Array) -> Policy:
    """A policy before the first update; consumes the key."""
    return Policy(init_normalizer(observation_size), networks.policy_network.init(key))
