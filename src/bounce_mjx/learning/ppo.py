"""Proximal policy optimisation, read from top to bottom: collect -> advantages -> update.

`PPO` has two pure functions over one pytree of state: `init(key)` and
`run(state, num_iterations)`. Inside `run` everything is a `scan`; nothing returns to Python.
Arrays have the axes T (control steps of a rollout), B (environments), N (observation), K (critic
metrics) and A (action); samples have G groups.
Source: Schulman et al., Proximal Policy Optimization Algorithms (2017).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from bounce_mjx.env import vector
from bounce_mjx.env.vector import AnyEnv
from bounce_mjx.errors import UserError
from bounce_mjx.gpu.rows import pack, unpack
from bounce_mjx.learning import statistics
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.metrics import Metrics, matching_metrics, rollout_metrics, step_metrics
from bounce_mjx.learning.networks import Gaussian
from bounce_mjx.learning.policy import Networks, Policy, make_networks
from bounce_mjx.learning.statistics import Normalizer, RunningStatistics, normalize

# Factor by which one update may change the learning rate.
_LEARNING_RATE_FACTOR = 1.1

# Minimum number of groups in which samples are shuffled, and the maximum number of environments per
# group if there are more groups.
_MIN_GROUPS, _GROUP_ENVS = 64, 64

# Number of steps of the recursion that are unrolled into one kernel on a GPU. For each result XLA
# writes out all steps before it, so the kernel's code grows with the square of this number.
_UNROLL = 16

# Quantities that must be finite, in the order in which an iteration computes them.
CHECKED = ("reward", "observation", "loss/value", "loss/policy", "gradient", "parameters")


class Params(NamedTuple):
    """Parameters of the two networks."""

    policy: Any
    value: Any


class TrainingState(NamedTuple):
    """Everything that the next iteration depends on."""

    params: Params
    optimizer: optax.OptState
    statistics: RunningStatistics
    """Statistics of the networks' inputs [N + K]: the observation and K critic metrics."""
    learning_rate: jax.Array
    """Current learning rate []."""
    env: vector.VectorState
    key: jax.Array
    """Random key of the next iteration."""
    iteration: jax.Array
    """Iterations done [], int."""


class Rollout(NamedTuple):
    """T steps of B environments; one step lacks the first axis."""

    inputs: jax.Array
    """Inputs of the networks before normalisation: observation and critic metrics [T, B, N + K]."""
    action: jax.Array
    """Sampled action before clipping [T, B, A]."""
    log_prob: jax.Array
    """Logarithm of the action's probability density [T, B]."""
    reward: jax.Array
    """Scaled reward [T, B]."""
    terminated: jax.Array
    """[T, B], bool."""
    truncated: jax.Array
    """[T, B], bool."""


class Samples(NamedTuple):
    """Data of an update: [T, B, ...] of a rollout, [G, T * B / G, ...] in groups (`num_groups`),
    [S, ...] in a minibatch of S samples."""

    inputs: jax.Array
    """Normalised inputs of the networks [T, B, N + K]."""
    action: jax.Array
    """[T, B, A]."""
    log_prob: jax.Array
    """[T, B]."""
    advantage: jax.Array
    """[T, B]; in a minibatch with the mean 0 and the standard deviation 1."""
    value_target: jax.Array
    """[T, B]."""
    noise_bound: jax.Array
    """[T, B, 1]."""


class LearnerState(NamedTuple):
    """What a minibatch step changes."""

    params: jax.Array
    """All parameters in one array: on a GPU, each array costs kernels in every step."""
    optimizer: optax.OptState
    learning_rate: jax.Array


class PPO:
    """Training as two pure functions, `init` and `run`; `jax.jit` them (the second argument of
    `run` is static). A subclass may change every method (docs/algorithms.md)."""

    Config = PPOConfig
    """Type of the settings; a subclass may add some, which become keys and flags."""

    def __init__(self, config: PPOConfig, env: AnyEnv, episode_steps: int):
        """
        Args:
          episode_steps: control steps after which an episode is truncated.

        Raises:
          UserError: a rollout is longer than an episode, or the environment lacks a critic metric.
        """
        if config.rollout_length > episode_steps:
            raise UserError(
                f"rollout_length {config.rollout_length} is longer than an episode of "
                f"{episode_steps} control steps; choose a shorter rollout or longer episodes"
            )
        self.config, self.env, self.episode_steps = config, env, episode_steps
        self.critic_metrics = names_of_critic_metrics(config, env)
        """Names of the environment's metrics that the value network sees."""
        self.networks = self.make_networks()
        self.optimizer = self.make_optimizer()

    def make_networks(self) -> Networks:
        """The networks. That of the policy stays as its config says, for all that acts with it."""
        sizes = self.env.observation_size, self.env.action_size, len(self.critic_metrics)
        return make_networks(self.config, *sizes, dtype=self.config.compute_dtype)

    def make_optimizer(self) -> optax.GradientTransformation:
        """Gradient of the parameters -> direction of a step, which the learning rate scales: Adam
        on clipped gradients."""
        clip = optax.clip_by_global_norm(self.config.max_grad_norm)
        return optax.chain(clip, optax.scale_by_adam(eps=1e-5))

    def init(self, key: jax.Array) -> TrainingState:
        """The state before the first iteration; consumes the key."""
        config, env = self.config, self.env
        key, policy_key, value_key, env_key, clock_key = jax.random.split(key, 5)
        params = Params(
            self.networks.policy_network.init(policy_key),
            self.networks.value_network.init(value_key),
        )
        ranges = vector.ranges_after(env, jnp.int32(0), config.batch_steps)
        env_state = vector.reset(env, env_key, config.num_envs, ranges)
        # With equal clocks, all episodes would time out together.
        clock = jax.random.randint(clock_key, (config.num_envs,), 0, self.episode_steps)
        return TrainingState(
            params=params,
            optimizer=self.optimizer.init(ravel_pytree(params)[0]),
            statistics=statistics.init_statistics(env.observation_size + len(self.critic_metrics)),
            learning_rate=jnp.float32(config.learning_rate),
            env=env_state._replace(clock=clock),
            key=key,
            iteration=jnp.int32(0),
        )

    def run(self, state: TrainingState, num_iterations: int) -> tuple[TrainingState, Metrics]:
        """State and a number of iterations I -> state and metrics, each [I]; the metric "fault" is
        the result of `first_fault`."""

        def step(state: TrainingState, _) -> tuple[TrainingState, Metrics]:
            state, metrics = self.iterate(state._replace(env=unpack(state.env)))
            return state._replace(env=pack(state.env)), metrics

        state, metrics = jax.lax.scan(
            step, state._replace(env=pack(state.env)), length=num_iterations
        )
        return state._replace(env=unpack(state.env)), metrics

    def iterate(self, state: TrainingState) -> tuple[TrainingState, Metrics]:
        """One iteration: collect -> advantages -> update."""
        key, collect_key, update_key = jax.random.split(state.key, 3)
        env, rollout, ends, metrics = self.collect(state, collect_key)
        advantage, value_target = self.advantages(state, rollout, ends)
        # The next rollout normalises by the new statistics, so the networks learn on inputs
        # normalised by them; otherwise the policy would shift with every change of the statistics.
        new_statistics = statistics.update(state.statistics, rollout.inputs)
        samples = Samples(
            inputs=normalize(rollout.inputs, new_statistics.normalizer),
            action=rollout.action,
            log_prob=rollout.log_prob,
            advantage=advantage,
            value_target=value_target,
            noise_bound=jnp.broadcast_to(noise_bounds(self.config), (*value_target.shape, 1)),
        )
        state, minibatches = self.update(state, samples, update_key)
        fault = first_fault(metrics["reward"], new_statistics, minibatches, state.params)
        metrics |= {name: jnp.mean(values) for name, values in minibatches.items()}
        if "policy/kl" in minibatches:
            # How far the whole update has moved the policy.
            metrics["policy/kl"] = jnp.mean(minibatches["policy/kl"][-1])
        metrics |= {
            "policy/learning_rate": state.learning_rate,
            "loss/explained_variance": 1.0 - jnp.var(advantage) / jnp.var(value_target),
            "fault": fault,
        }
        return state._replace(
            statistics=new_statistics, env=env, key=key, iteration=state.iteration + 1
        ), metrics

    def collect(
        self, state: TrainingState, key: jax.Array
    ) -> tuple[vector.VectorState, Rollout, jax.Array, Metrics]:
        """Runs the policy for T steps.

        Returns:
          The environments' states after the last step; the rollout; the inputs [2, B, N + K] of the
          networks after the last step, and at each environment's time-out before its reset (unused
          for an environment that did not time out); the metrics of the rollout.
        """
        config, env = self.config, self.env
        noise_key, reset_key = jax.random.split(key)
        # All numbers are sampled at once, because on a GPU each sample costs a kernel or two.
        shape = (config.rollout_length, config.num_envs, env.action_size)
        noise = jax.random.normal(noise_key, shape, jnp.float32)
        ranges = vector.ranges_after(env, state.iteration, config.batch_steps)
        # One start for each environment: one that ends twice within a rollout starts twice alike.
        fresh = vector.first_states(env, reset_key, config.num_envs, ranges)

        def step(carry, noise):
            packed, timeout_inputs = carry
            env_state = unpack(packed)
            inputs = self.network_inputs(vector.observe(env_state), env_state.env.metrics)
            normalized = normalize(inputs, state.statistics.normalizer)
            policy = self.distribution(state.params, normalized, noise_bounds(config))
            action = policy.mean + policy.std * noise
            env_state, result = vector.step(
                env, env_state, action, None, self.episode_steps, fresh=fresh
            )
            # An environment times out at most once in a rollout, because no time limit is shorter.
            final_inputs = self.network_inputs(result.final_observation, result.metrics)
            timeout_inputs = jnp.where(result.truncated[:, None], final_inputs, timeout_inputs)
            step = Rollout(
                inputs=inputs,
                action=action,
                log_prob=policy.log_prob(action),
                reward=(config.reward_scale * result.reward).astype(jnp.float32),
                terminated=result.terminated,
                truncated=result.truncated,
            )
            metrics = step_metrics(result, num_groups(config), env.task.curves)
            return (pack(env_state), timeout_inputs), (step, pack(metrics))

        no_inputs = jnp.zeros((config.num_envs, state.statistics.mean.size))
        (packed, timeout_inputs), (rollout, metrics) = jax.lax.scan(
            step, (pack(state.env), no_inputs), noise
        )
        env_state = unpack(packed)
        last_inputs = self.network_inputs(vector.observe(env_state), env_state.env.metrics)
        ends = jnp.stack([last_inputs, timeout_inputs])
        return env_state, rollout, ends, rollout_metrics(unpack(metrics))

    def network_inputs(self, observation: jax.Array, metrics: Metrics) -> jax.Array:
        """Inputs of the networks before normalisation [B, N + K]."""
        columns = [metrics[name][:, None] for name in self.critic_metrics]
        return jnp.concatenate([observation, *columns], axis=-1, dtype=jnp.float32)

    def distribution(self, params: Params, inputs: jax.Array, noise_bound: jax.Array) -> Gaussian:
        """The policy's distribution of the action [..., A] for normalised inputs [..., N + K].

        Args:
          noise_bound: lower bounds of the standard deviation [..., 1]. It is the root of the sum of
            squares, as a clipped one would have no gradient.
        """
        observation = inputs[..., : self.env.observation_size]
        mean, std = self.networks.policy_network.apply(params.policy, observation)
        return Gaussian(mean, jnp.sqrt(jnp.square(std) + jnp.square(noise_bound)))

    def values(self, params: Params, inputs: jax.Array) -> jax.Array:
        """Values [...] of states with normalised inputs [..., N + K]."""
        if self.config.shared_critic:
            observation, metrics = jnp.split(inputs, [self.env.observation_size], axis=-1)
            features = self.networks.features(params.policy, observation)
            inputs = jnp.concatenate([features, metrics], axis=-1)
        return self.networks.value_network.apply(params.value, inputs)

    def advantages(
        self, state: TrainingState, rollout: Rollout, ends: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Advantages and targets of the values [T, B].

        Args:
          ends: inputs after the last step and at the time-outs (`collect`).
        """
        inputs = jnp.concatenate([rollout.inputs, ends])
        inputs = normalize(inputs, state.statistics.normalizer)
        values = self.values(state.params, inputs)
        values, timeout_values = values[:-1], values[-1]
        following = jnp.where(rollout.truncated, timeout_values, values[1:])
        over = rollout.terminated, rollout.truncated
        rates = self.config.discount, self.config.gae_lambda
        advantage = generalized_advantages(rollout.reward, values[:-1], following, *over, *rates)
        return advantage, advantage + values[:-1]

    def update(
        self, state: TrainingState, samples: Samples, key: jax.Array
    ) -> tuple[TrainingState, Metrics]:
        """Several epochs of minibatch steps; also metrics of each step [epochs, minibatches]."""
        config, groups = self.config, num_groups(self.config)
        samples = jax.tree.map(lambda x: group(x, groups), samples)
        size = samples.log_prob.shape[1]
        flat, unravel = ravel_pytree(state.params)

        def step(learner, minibatch):
            order, advantage = minibatch
            batch = jax.tree.map(lambda x: chosen(x, order), samples)._replace(advantage=advantage)
            # With the groups as an axis of their own, XLA transposes the layers' outputs on a CPU.
            batch = jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), batch)
            batch_loss = lambda flat: self.loss(unravel(flat), batch)  # noqa: E731
            learner, metrics = self.minibatch_step(batch_loss, learner, state.iteration)
            return learner, pack(metrics)

        def epoch(learner, key):
            orders = jax.vmap(lambda key: random_order(key, size))(jax.random.split(key, groups))
            orders = jnp.moveaxis(orders.reshape((groups, config.num_minibatches, -1)), 1, 0)
            # All minibatches at once: on several devices each reduction is a message, and every
            # minibatch already has one for its gradient.
            advantage = jax.vmap(lambda order: chosen(samples.advantage, order))(orders)
            mean = jnp.mean(advantage, axis=(1, 2), keepdims=True)
            deviation = jnp.std(advantage, axis=(1, 2), keepdims=True)
            return jax.lax.scan(step, learner, (orders, (advantage - mean) / (deviation + 1e-8)))

        learner = LearnerState(flat, state.optimizer, state.learning_rate)
        learner, metrics = jax.lax.scan(epoch, learner, jax.random.split(key, config.num_epochs))
        return state._replace(
            params=unravel(learner.params),
            optimizer=learner.optimizer,
            learning_rate=learner.learning_rate,
        ), unpack(metrics)

    def minibatch_step(
        self, batch_loss: Callable, learner: LearnerState, iteration: jax.Array
    ) -> tuple[LearnerState, Metrics]:
        """One step of the optimizer.

        Args:
          batch_loss: parameters in one array -> the loss of the minibatch [], and its parts.
          iteration: iterations done before this one [], int.
        """
        gradient, metrics = jax.grad(batch_loss, has_aux=True)(learner.params)
        direction, optimizer = self.optimizer.update(gradient, learner.optimizer)
        rate = learner.learning_rate
        metrics["loss/gradient_norm"] = optax.tree.norm(gradient)
        return LearnerState(
            params=learner.params - rate * direction,
            optimizer=optimizer,
            learning_rate=self.next_learning_rate(rate, metrics, iteration),
        ), metrics

    def next_learning_rate(
        self, learning_rate: jax.Array, metrics: Metrics, iteration: jax.Array
    ) -> jax.Array:
        """The learning rate [] of the next minibatch step: `adapt_learning_rate`. A subclass with a
        schedule of its own overrides this, and nothing else changes the rate.

        Args:
          learning_rate: of this minibatch step [].
          metrics: of this minibatch step, each [].
          iteration: iterations done before this one [], int.

        Raises:
          UserError: `loss` does not return the KL divergence.
        """
        if self.config.target_kl == 0.0:
            return learning_rate
        if "policy/kl" not in metrics:
            raise UserError(
                f"the loss of {type(self).__name__} returns no metric policy/kl, to which the "
                "learning rate adapts; return it, or set target_kl to 0"
            )
        limit = max_learning_rate(self.config, iteration)
        return adapt_learning_rate(self.config, learning_rate, metrics["policy/kl"], limit)

    def loss(self, params: Params, samples: Samples) -> tuple[jax.Array, Metrics]:
        """The loss of a minibatch [], and its parts."""
        config = self.config
        policy = self.distribution(params, samples.inputs, samples.noise_bound)
        log_ratio = policy.log_prob(samples.action) - samples.log_prob
        ratio = jnp.exp(log_ratio)
        clipped = jnp.clip(ratio, 1.0 - config.clip_epsilon, 1.0 + config.clip_epsilon)
        policy_loss = -jnp.mean(jnp.minimum(ratio * samples.advantage, clipped * samples.advantage))
        values = self.values(params, samples.inputs)
        value_loss = jnp.mean(jnp.square(values - samples.value_target))
        entropy = jnp.mean(policy.entropy())
        total = policy_loss + config.value_cost * value_loss - config.entropy_cost * entropy
        return total, {
            "loss/policy": policy_loss,
            "loss/value": value_loss,
            "policy/entropy": entropy,
            # Schulman's low-variance estimate of KL(old || new).
            "policy/kl": jnp.mean(ratio - 1.0 - log_ratio),
            "policy/clip_fraction": jnp.mean(jnp.abs(ratio - 1.0) > config.clip_epsilon),
            "policy/action_std": jnp.mean(policy.std),
        }


def names_of_critic_metrics(config: PPOConfig, env: AnyEnv) -> tuple[str, ...]:
    """Names of the environment's metrics that the value network sees, in order.

    Raises:
      UserError: the environment lacks one.
    """
    known_metrics = jax.eval_shape(lambda: env.reset(jax.random.PRNGKey(0))).metrics
    wanted = config.critic_metrics
    return matching_metrics(env.task.critic_metrics if wanted is None else wanted, known_metrics)


def noise_bounds(config: PPOConfig) -> jax.Array:
    """Lower bounds of the action noise of each environment [B, 1]: evenly from 0 to twice
    min_noise_std.

    With one bound for all, either no environment visits the states from which a policy must
    recover, or none those in which it must be precise. Different noise for each actor is that of
    Horgan et al. (2018), Distributed prioritized experience replay.
    """
    share = (jnp.arange(config.num_envs) + 0.5) / config.num_envs
    return 2.0 * config.min_noise_std * share[:, None]


def generalized_advantages(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    truncated: jax.Array,
    discount: float,
    gae_lambda: float,
) -> jax.Array:
    """Advantages [T, B] of T steps of B environments (Schulman et al. 2016, equation 16).

    Args:
      reward, value: reward of each step, and value of the state before it [T, B].
      next_value: value of the state after the step [T, B]; at a time-out, the value of the old
        episode's last state, not of the new episode's first one.
      terminated: steps without a following value [T, B], bool.
      truncated: steps whose following value counts, but across which no advantage is propagated
        back [T, B], bool.
    """
    delta = reward + discount * jnp.where(terminated, 0.0, next_value) - value
    carried = discount * gae_lambda * (~(terminated | truncated))

    def backward(advantage, step):
        delta, carried = step
        advantage = delta + carried * advantage
        return advantage, advantage

    _, advantages = jax.lax.scan(
        backward, jnp.zeros_like(delta[0]), (delta, carried), reverse=True, unroll=_UNROLL
    )
    return advantages


def population(trainer: PPO) -> tuple[Callable, Callable]:
    """`init` and `run` of S independent runs: keys [S, 2] -> states with S as the first axis of
    every array; metrics are [S, I]."""
    return jax.vmap(trainer.init), jax.vmap(trainer.run, in_axes=(0, None))


def num_groups(config: PPOConfig) -> int:
    """Number of equal groups of environments, a power of two.

    Samples are shuffled within their group, and every minibatch takes equally many from each group.
    A device that holds whole groups therefore shuffles only its own samples, and the training does
    not depend on the number of devices.
    """
    groups = max(_MIN_GROUPS, 1 << (config.num_envs // _GROUP_ENVS).bit_length() >> 1)
    while config.num_envs % groups or (config.batch_steps // groups) % config.num_minibatches:
        groups //= 2
    return groups


def random_order(key: jax.Array, size: int) -> jax.Array:
    """A random permutation of 0 ... `size` - 1 [size], int32; consumes the key.

    `jax.random.permutation` sorts pairs of a random number and an index, which takes four times as
    long on a CPU as one number with the index in its low bits. Of two equal random numbers the
    smaller index comes first; where that would happen, one order shuffles another.
    """
    low_bits = (size - 1).bit_length()

    def sorted_indices(key: jax.Array) -> jax.Array:
        numbers = jax.random.bits(key, (size,), jnp.uint32) >> low_bits << low_bits
        ordered = jnp.sort(numbers | jnp.arange(size, dtype=jnp.uint32))
        return (ordered & jnp.uint32((1 << low_bits) - 1)).astype(jnp.int32)

    # The expected number of equal pairs is size^2 / 2 / 2^(32 - low_bits): here below 1 / 32.
    if 3 * low_bits < 28:
        return sorted_indices(key)
    first, second = jax.random.split(key)
    return sorted_indices(first)[sorted_indices(second)]


def group(x: jax.Array, groups: int) -> jax.Array:
    """Deals samples [T, B, ...] into groups of environments [G, T * B / G, ...]."""
    length, batch, *rest = x.shape
    x = jnp.moveaxis(x.reshape((length, groups, batch // groups, *rest)), 1, 0)
    return x.reshape((groups, length * batch // groups, *rest))


def chosen(x: jax.Array, order: jax.Array) -> jax.Array:
    """Samples [G, n, ...] of each group [G, M, ...] in an order [G, n]."""
    return jax.vmap(lambda x, i: x[i])(x, order)


def policy_of(state: TrainingState, observation_size: int) -> Policy:
    """The policy of a training state, or the policies of a population's state."""
    mean, std = (x[..., :observation_size] for x in state.statistics.normalizer)
    return Policy(Normalizer(mean, std), state.params.policy)


def max_learning_rate(config: PPOConfig, iteration: jax.Array) -> jax.Array:
    """Upper limit of the learning rate []: an exponential decay from max_learning_rate to
    final_max_learning_rate over decay_steps. Without this limit the KL rule raises the rate once
    the policy hardly changes, and a late large step ruins the policy.
    """
    progress = jnp.minimum(1.0, iteration * (config.batch_steps / config.decay_steps))
    ratio = config.final_max_learning_rate / config.max_learning_rate
    return config.max_learning_rate * ratio**progress


def adapt_learning_rate(
    config: PPOConfig, learning_rate: jax.Array, kl: jax.Array, limit: jax.Array
) -> jax.Array:
    """The learning rate [] after a minibatch step, adapted so that the KL divergence approaches
    target_kl (the adaptive rule of Schulman et al. 2017, section 4, applied to the learning rate);
    the same one if target_kl is 0.

    Args:
      learning_rate: of the minibatch step [].
      kl: the policy's KL divergence from that of the rollout, in the minibatch step [].
      limit: upper limit of the rate [], such as `max_learning_rate`.
    """
    if config.target_kl == 0.0:
        return learning_rate
    is_large = kl > 2.0 * config.target_kl
    is_small = kl < 0.5 * config.target_kl
    factor = jnp.where(is_small, _LEARNING_RATE_FACTOR, 1.0)
    learning_rate *= jnp.where(is_large, 1.0 / _LEARNING_RATE_FACTOR, factor)
    return jnp.clip(learning_rate, config.min_learning_rate, limit)


def first_fault(
    reward: jax.Array, statistics: RunningStatistics, minibatch_metrics: Metrics, params: Params
) -> jax.Array:
    """Number [], from 1, of the first quantity of `CHECKED` that was not finite in an iteration; 0
    if all were finite.

    Args:
      reward: mean reward of the rollout [].
      statistics: the statistics that include the rollout.
      minibatch_metrics: each [epochs, minibatches]; the gradient's norm is one of them.
      params: the parameters after the update.
    """
    places = {"loss/value": 3, "loss/policy": 4, "loss/gradient_norm": 5}
    # The loss of a subclass may have other parts.
    places = {name: place for name, place in places.items() if name in minibatch_metrics}
    minibatches = jnp.stack([minibatch_metrics[name].ravel() for name in places], axis=-1)
    before = jnp.stack([jnp.isfinite(reward), all_finite(statistics)])
    finite = jnp.hstack([before, jnp.isfinite(minibatches).ravel(), all_finite(params)])
    numbers = [1, 2, *[*places.values()] * len(minibatches), 6]
    return jnp.where(finite.all(), 0, jnp.array(numbers)[jnp.argmin(finite)])


def all_finite(tree: Any) -> jax.Array:
    """Whether every number of a pytree of arrays is finite [], bool."""
    return jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(tree)]).all()
