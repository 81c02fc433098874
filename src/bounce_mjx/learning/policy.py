"""The policy, its network and the value network: multilayer perceptrons with orthogonal weights.

A policy's file stores the parameters under the names of the modules and layers within the network
(MLP_0, hidden_0, Dense_0, std_logparam), so these must not change.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from flax import linen as nn

from bounce_mjx.env.vector import AnyEnv
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.statistics import Normalizer, init_normalizer, normalize

_GAIN = math.sqrt(2.0)
# A small gain, so that the first mean actions are near 0.
_MEAN_GAIN = 0.01


class Policy(NamedTuple):
    """The arrays that are needed to act, as a pytree."""

    normalizer: Normalizer
    """Normaliser of the observation [N]."""
    params: Any
    """Parameters of the policy network."""


class Actor(Protocol):
    """What acts: the `Networks` of a training run, or a law without parameters."""

    def act(self, policy: Any, observation: jax.Array) -> jax.Array:
        """Actions [..., A] in [-1, 1] for observations [..., N]."""


class ActionDistribution(NamedTuple):
    """Independent normal distributions of the A entries of an action, before it is clipped."""

    mean: jax.Array
    """Means [..., A], which are also the mode."""
    std: jax.Array
    """Standard deviations [..., A]."""

    def log_prob(self, action: jax.Array) -> jax.Array:
        """Logarithm [...] of the joint density at an action [..., A]."""
        deviation = (action - self.mean) / self.std
        log_density = (
            -0.5 * jnp.square(deviation) - jnp.log(self.std) - 0.5 * math.log(2.0 * math.pi)
        )
        return jnp.sum(log_density, axis=-1)

    def entropy(self) -> jax.Array:
        """Differential entropy [...], nats: sum of log(std) + log(2 pi e) / 2."""
        return jnp.sum(jnp.log(self.std) + 0.5 * math.log(2.0 * math.pi * math.e), axis=-1)


class NetworkFunctions(NamedTuple):
    """A network as two pure functions, whatever library it is written with."""

    init: Callable[[jax.Array], Any]
    """key -> parameters, a pytree; consumes the key."""
    apply: Callable[[Any, jax.Array], Any]
    """(parameters, normalised inputs [..., M]) -> output."""


class Networks(NamedTuple):
    """The two networks of a training run, and the part that they may share."""

    policy_network: NetworkFunctions
    """Its inputs are observations [..., N], its output is an `ActionDistribution` [..., A]."""
    value_network: NetworkFunctions
    """Its inputs are the observation and the critic metrics [..., N + K] (with a shared critic: the
    features [..., H] and the metrics), its output the values [...]."""
    features: Callable[[Any, jax.Array], jax.Array]
    """(parameters of the policy, normalised observations [..., N]) -> its last hidden layer
    [..., H]; only a shared critic needs it."""

    def act(self, policy: Policy, observation: jax.Array) -> jax.Array:
        """The most likely actions [..., A] for observations [..., N], clipped to [-1, 1]."""
        inputs = normalize(observation, policy.normalizer)
        return jnp.clip(self.policy_network.apply(policy.params, inputs).mean, -1.0, 1.0)


def make_networks(
    config: PPOConfig,
    observation_size: int,
    action_size: int,
    num_critic_metrics: int = 0,
    dtype: Any = None,
) -> Networks:
    """The networks of a config for an environment with these sizes.

    Args:
      config: settings, of which those of the layers and of the noise at the start are read.
      observation_size: N.
      action_size: A.
      num_critic_metrics: metrics that the critic sees, K; to act, it is not needed.
      dtype: type in which the hidden layers are computed; by default, that of their inputs and
        parameters.
    """
    layers = config.hidden_layers
    activation = config.activation
    policy = PolicyNetwork(layers, action_size, config.init_noise_std, dtype, activation)
    hidden = MLP(layers, activate_final=True, dtype=dtype, activation=activation)
    critic_layers = config.critic_layers or (() if config.shared_critic else layers)
    value = MLP((*critic_layers, 1), activate_final=False, dtype=dtype, activation=activation)
    critic_input_size = layers[-1] if config.shared_critic else observation_size
    critic_input_size += num_critic_metrics

    def init_policy(key: jax.Array) -> Any:
        return policy.init(key, jnp.zeros((1, observation_size)))

    def init_value(key: jax.Array) -> Any:
        return value.init(key, jnp.zeros((1, critic_input_size)))

    def apply_value(params: Any, inputs: jax.Array) -> jax.Array:
        return value.apply(params, inputs)[..., 0]

    def features(params: Any, observation: jax.Array) -> jax.Array:
        return hidden.apply({"params": params["params"]["MLP_0"]}, observation)

    return Networks(
        policy_network=NetworkFunctions(init_policy, policy.apply),
        value_network=NetworkFunctions(init_value, apply_value),
        features=features,
    )


def networks_of(config: PPOConfig) -> Callable[[AnyEnv], Networks]:
    """`make_networks` of a config, as a function of the environment, to act with: its value network
    has no critic metrics."""

    def networks_for(env: AnyEnv) -> Networks:
        return make_networks(config, env.observation_size, env.action_size)

    return networks_for


def untrained_policy(networks: Networks, observation_size: int, key: jax.Array) -> Policy:
    """A policy before the first update; consumes the key."""
    return Policy(init_normalizer(observation_size), networks.policy_network.init(key))


class PolicyNetwork(nn.Module):
    """The distribution of the action: its mean depends on the observation, its standard deviation
    does not."""

    hidden_layers: tuple[int, ...]
    """Width of each hidden layer."""
    action_size: int
    """Entries of an action, A."""
    init_noise_std: float
    """Standard deviation before the first update."""
    dtype: Any = None
    """Type in which the hidden layers are computed; None for that of inputs and parameters."""
    activation: str = "silu"
    """Name of the activation in `flax.linen`."""

    @nn.compact
    def __call__(self, observation: jax.Array) -> ActionDistribution:
        """Distribution of the action [..., A] for normalised observations [..., N]."""
        hidden = MLP(self.hidden_layers, True, self.dtype, self.activation)(observation)
        mean_init = orthogonal(_MEAN_GAIN)
        mean = nn.Dense(self.action_size, kernel_init=mean_init)(hidden)
        init_log_std = jnp.full(self.action_size, jnp.log(jnp.float32(self.init_noise_std)))
        # The names of the parameters in the policies' files.
        log_std = self.param("std_logparam", lambda _: {"log_value": init_log_std})["log_value"]
        return ActionDistribution(mean, jnp.broadcast_to(jnp.exp(log_std), mean.shape))


class MLP(nn.Module):
    """Dense layers hidden_0, hidden_1, ... with an activation between them."""

    widths: tuple[int, ...]
    """Width of each layer."""
    activate_final: bool
    """Whether the activation follows the last layer too."""
    dtype: Any = None
    """Type in which hidden layers are computed; None for that of inputs and parameters."""
    activation: str = "silu"
    """Name of the activation in `flax.linen`."""

    @nn.compact
    def __call__(self, inputs: jax.Array) -> jax.Array:
        """Outputs [..., widths[-1]] for inputs [..., M]."""
        activate = getattr(nn, self.activation)
        outputs = inputs
        for i, width in enumerate(self.widths):
            is_hidden = self.activate_final or i + 1 < len(self.widths)
            dtype = self.dtype if is_hidden else None
            layer = nn.Dense(width, dtype=dtype, kernel_init=orthogonal(_GAIN), name=f"hidden_{i}")
            outputs = layer(outputs)
            if is_hidden:
                outputs = activate(outputs)
        return outputs


def orthogonal(gain: float) -> Callable[..., jax.Array]:
    """An initialiser (key, shape [N, M], type) -> weights [N, M] with orthogonal columns (rows if
    M > N), all of the norm `gain` (Saxe et al. 2014).

    The weights are those of `jax.nn.initializers.orthogonal` up to rounding, but come from Gram and
    Schmidt's method, applied twice (Giraud et al. 2005), instead of LAPACK or cuSOLVER: these
    libraries take longer to load than the weights to compute, and batched calls of jaxlib's LAPACK
    may wait for each other for ever.
    """

    def init(key: jax.Array, shape: tuple[int, int], dtype: Any = jnp.float32) -> jax.Array:
        num_columns = min(shape)
        tall_shape = (max(shape), num_columns)
        random_columns = jax.random.normal(key, tall_shape, dtype)
        columns = jnp.zeros(tall_shape, dtype)
        for_each_column = functools.partial(_add_orthogonal_column, random_columns)
        columns = jax.lax.fori_loop(0, num_columns, for_each_column, columns)
        return gain * (columns if shape == tall_shape else columns.T)

    return init


def _add_orthogonal_column(
    random_columns: jax.Array, index: jax.Array, columns: jax.Array
) -> jax.Array:
    """The columns [N, M], with that of the index made orthonormal to those before it.

    Args:
      random_columns: [N, M], of which that of the index becomes orthogonal to those before it.
      index: of the column [], int.
      columns: those before the index; 0 from it on [N, M].
    """
    column = random_columns[:, index]
    for _ in range(2):
        projections = jnp.sum(columns * column[:, None], axis=0)
        column = column - jnp.sum(columns * projections, axis=1)
    return columns.at[:, index].set(column / jnp.linalg.norm(column))
