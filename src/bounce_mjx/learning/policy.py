"""The networks of a config, and the policy that acts with them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.gaussian import Gaussian
from bounce_mjx.learning.networks import MLP, PolicyNetwork, RecurrentPolicyNetwork
from bounce_mjx.learning.statistics import Normalizer, init_normalizer, normalize


class Policy(NamedTuple):
    """The arrays that are needed to act, as a pytree."""

    normalizer: Normalizer
    """Normaliser of the observation [N]."""
    params: Any
    """Parameters of the policy network."""


Memory = tuple[jax.Array, ...]
"""Memory of a policy network between control steps: (hidden state [..., H],) of a gru, and () of an
mlp."""


class Network(NamedTuple):
    """A network as two pure functions."""

    init: Callable[[jax.Array], Any]
    """key -> parameters; consumes the key."""
    apply: Callable[[Any, jax.Array], Any]
    """(parameters, normalised inputs [..., N]) -> output."""


class PolicyFunctions(NamedTuple):
    """A policy network as pure functions."""

    init: Callable[[jax.Array], Any]
    """key -> parameters; consumes the key."""
    apply: Callable[..., Any]
    """(parameters, normalised observations [..., N]) -> `Gaussian` over actions [..., A]. A gru
    takes its hidden state [..., H] as third argument and also returns the next one; `respond` calls
    both kinds alike."""
    start_memory: Callable[[tuple[int, ...]], Memory]
    """Shape of the batch -> memory at the start of an episode: zeros."""


class Networks(NamedTuple):
    """The two networks of a training."""

    policy_network: PolicyFunctions
    value_network: Network
    """Its inputs are the observation and the critic metrics, its output the values [...]."""


def make_networks(
    config: PPOConfig, observation_size: int, action_size: int, num_critic_metrics: int = 0
) -> Networks:
    """The networks of a config for an environment with these sizes; the critic is not needed to
    act."""
    value = MLP((*config.hidden_layers, 1), activate_final=False)
    critic_size = observation_size + num_critic_metrics
    return Networks(
        policy_network=_policy_functions(config, observation_size, action_size),
        value_network=Network(
            init=lambda key: value.init(key, jnp.zeros((1, critic_size))),
            apply=lambda params, inputs: value.apply(params, inputs)[..., 0],
        ),
    )


def _policy_functions(
    config: PPOConfig, observation_size: int, action_size: int
) -> PolicyFunctions:
    sizes = action_size, config.init_noise_std
    one = jnp.zeros((1, observation_size))
    if config.network == "mlp":
        mlp = PolicyNetwork(config.hidden_layers, *sizes)
        return PolicyFunctions(
            init=lambda key: mlp.init(key, one),
            apply=mlp.apply,
            start_memory=lambda batch: (),
        )
    gru = RecurrentPolicyNetwork(config.hidden_layers, config.gru_size, *sizes)
    return PolicyFunctions(
        init=lambda key: gru.init(key, one, jnp.zeros((1, config.gru_size))),
        apply=gru.apply,
        start_memory=lambda batch: (jnp.zeros((*batch, config.gru_size)),),
    )


def untrained_policy(networks: Networks, observation_size: int, key: jax.Array) -> Policy:
    """A policy before the first update; consumes the key."""
    return Policy(init_normalizer(observation_size), networks.policy_network.init(key))


def respond(
    network: PolicyFunctions, params: Any, inputs: jax.Array, memory: Memory
) -> tuple[Gaussian, Memory]:
    """Distribution of the actions [..., A] and the next memory, for normalised observations
    [..., N]."""
    if not memory:
        return network.apply(params, inputs), ()
    distribution, hidden = network.apply(params, inputs, *memory)
    return distribution, (hidden,)


def respond_in_sequence(
    network: PolicyFunctions, params: Any, inputs: jax.Array, memory: Memory, starts: jax.Array
) -> Gaussian:
    """Distributions of the actions [..., T, A] for T control steps; a gradient flows back through
    all of them (Werbos 1990).

    Args:
      inputs: normalised observations [..., T, N].
      memory: before the first step.
      starts: whether each step is the first one of an episode, which begins without a memory
        [..., T], bool.
    """

    def step(memory: Memory, now: tuple[jax.Array, jax.Array]) -> tuple[Memory, Gaussian]:
        inputs, starts = now
        distribution, memory = respond(network, params, inputs, forget(memory, starts))
        return memory, distribution

    steps = jnp.moveaxis(inputs, -2, 0), jnp.moveaxis(starts, -1, 0)
    _, distributions = jax.lax.scan(step, memory, steps)
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -2), distributions)


def forget(memory: Memory, starts: jax.Array) -> Memory:
    """Memory [..., H], emptied where an episode starts [...]."""
    return jax.tree.map(lambda x: jnp.where(starts[..., None], 0.0, x), memory)


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
    """The most likely actions [..., A] of an mlp for observations [..., N], clipped to [-1, 1]."""
    return act_with_memory(networks, policy, observation, ())[0]


def act_with_memory(
    networks: Networks, policy: Policy, observation: jax.Array, memory: Memory
) -> tuple[jax.Array, Memory]:
    """The most likely actions [..., A] for observations [..., N], clipped to [-1, 1], and the next
    memory."""
    inputs = normalize(observation, policy.normalizer)
    distribution, memory = respond(networks.policy_network, policy.params, inputs, memory)
    return jnp.clip(distribution.mean, -1.0, 1.0), memory
