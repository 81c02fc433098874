"""Proximal policy optimisation, read from top to bottom: collect -> advantages -> update.

`PPO` has two pure functions over one pytree of state: `init(key)` and
`run(state, num_iterations)`. Inside `run` everything is a `scan`; nothing returns to Python. An
iteration is `PPO.iterate`:

    collect       T steps of B environments with the policy as it is
    advantages    values of the states, bootstrapped at time-outs, and the advantages
    (statistics)  the rollout updates those of the inputs; the new ones normalise the update
    update        epochs of minibatches: `loss`, its gradient, a step of `learning_rate`

Normalised are the networks' inputs, by the running statistics, and the advantages of each
minibatch; a reward is only scaled.

Arrays have the axes T (control steps of a rollout), B (environments), N (observation), K (critic
metrics) and A (action); samples have G groups, and a minibatch has S samples.
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
from bounce_mjx.learning.algorithm import Algorithm
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.metrics import Metrics, matching_metrics, rollout_metrics, step_metrics
from bounce_mjx.learning.policy import ActionDistribution, Networks, Policy, make_networks
from bounce_mjx.learning.statistics import (
    Normalizer,
    RunningStatistics,
    denormalize,
    normalize,
)

# Factor by which one minibatch step may change the learning rate.
_LEARNING_RATE_FACTOR = 1.1

# Number of groups in which samples are shuffled, a power of two: twice as many as long as each
# keeps _MIN_GROUP_ENVS environments, half as many as long as the batch cannot be divided. (The
# groups of a small batch have fewer.)
_GROUPS = 64
_MIN_GROUP_ENVS = 64

# Number of steps of the recursion that are unrolled into one kernel on a GPU. For each result XLA
# writes out all steps before it, so the kernel's code grows with the square of this number.
_UNROLL = 16

# Quantities that must be finite, in the order in which a fault is named; "observation" is of the
# critic metrics too.
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
    """Learning rate that the KL rule has reached [], `LearnerState.adapted_rate`;
    `PPO.learning_rate` says which one acts."""
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
    """Whether the task ended the episode [T, B], bool."""
    truncated: jax.Array
    """Whether only the time limit ended the episode [T, B], bool."""


class BootstrapInputs(NamedTuple):
    """Inputs of the networks, before normalisation, in the states that no step of the rollout
    begins with, but whose values are needed."""

    after_rollout: jax.Array
    """In the state after the last step [B, N + K]."""
    at_timeout: jax.Array
    """In the last state of the episode that timed out, before the reset [B, N + K]; unused for an
    environment without a time-out in this rollout."""


class Samples(NamedTuple):
    """Data of an update: [T, B, ...] of a rollout, [G, T * B / G, ...] in groups (`num_groups`),
    [S, ...] in a minibatch. The fields' axes are those of a rollout: in `PPO.loss`, read [S] for
    [T, B]."""

    inputs: jax.Array
    """Normalised inputs of the networks [T, B, N + K]: the first N are the observation, the last K
    the critic metrics, each in standard deviations from its mean. `raw_inputs` has their units."""
    action: jax.Array
    """Sampled action before clipping [T, B, A]."""
    log_prob: jax.Array
    """Logarithm of the action's probability density at the time of the rollout [T, B]."""
    advantage: jax.Array
    """[T, B]; in a minibatch with the mean 0 and the standard deviation 1."""
    value_target: jax.Array
    """What the value network should predict, the scaled and discounted return [T, B]: the advantage
    plus the value of the rollout."""
    noise_bound: jax.Array
    """Lower bound of the action noise in the sample's environment [T, B, 1]."""
    normalizer: Normalizer
    """What the inputs are normalised with [N + K]; one for all samples."""

    @property
    def raw_inputs(self) -> jax.Array:
        """The inputs in the units of the environment [T, B, N + K]. One that was more than 10
        standard deviations from its mean comes back at 10, and a constant one at its mean."""
        return denormalize(self.inputs, self.normalizer)

    def map_arrays(self, function: Callable[[jax.Array], jax.Array]) -> "Samples":
        """The samples with a function applied to each of their arrays."""
        arrays = self._replace(normalizer=None)
        return jax.tree.map(function, arrays)._replace(normalizer=self.normalizer)


class Minibatch(NamedTuple):
    """Which samples a minibatch has: n of each of G groups."""

    order: jax.Array
    """Indices of the samples within their group [G, n], int."""
    advantage: jax.Array
    """Their advantages, with the mean 0 and the standard deviation 1 [G, n]."""


class LearnerState(NamedTuple):
    """What a minibatch step changes."""

    params: jax.Array
    """All parameters in one array: on a GPU, each array costs kernels in every step."""
    optimizer: optax.OptState
    adapted_rate: jax.Array
    """Learning rate that the KL rule has reached []."""


class PPO(Algorithm):
    """Training as two pure functions, `init` and `run`; `jax.jit` them (the second argument of
    `run` is static). A subclass may change every method (docs/algorithms.md; of `make_networks` the
    value network alone). Its `update` returns the metric loss/gradient_norm, or loss/value or
    loss/policy, in which a divergence shows."""

    Config = PPOConfig
    """Type of the settings; a subclass may add some, which become keys and flags."""

    @classmethod
    def make_trainer(cls, config: Any, env: Any) -> None:
        """None: `training.ppo_trainer`, which this package may not import, trains with `init` and
        `run` on each device."""

    def __init__(self, config: PPOConfig, env: AnyEnv, episode_steps: int):
        """
        Args:
          config: the settings.
          env: one environment, of which a batch is stepped.
          episode_steps: control steps after which an episode is truncated.

        Raises:
          UserError: a rollout is longer than an episode, or the environment lacks a critic metric.
        """
        config.check_rollout(episode_steps)
        self.config = config
        self.env = env
        self.episode_steps = episode_steps
        self.critic_metrics = names_of_critic_metrics(config, env)
        """Names of the environment's metrics that the value network sees."""
        self.networks = self.make_networks()
        self.optimizer = self.make_optimizer()
        if type(self).make_optimizer is not PPO.make_optimizer:
            self._check_optimizer()

    def make_networks(self) -> Networks:
        """The networks. A subclass may change the value network alone: an evaluation, an export and
        a video make the policy's network anew from the config."""
        return make_networks(
            self.config,
            self.env.observation_size,
            self.env.action_size,
            len(self.critic_metrics),
            dtype=self.config.compute_dtype,
        )

    def make_optimizer(self) -> optax.GradientTransformation:
        """Gradient of all parameters in one array [P] -> what the learning rate scales and a step
        subtracts [P]: Adam on clipped gradients. So it has the gradient's sign and no learning
        rate, as `optax.scale_by_adam`, and not as `optax.adam`. It is given the parameters [P] too,
        for a weight decay (`optax.add_decayed_weights`)."""
        clip = optax.clip_by_global_norm(self.config.max_grad_norm)
        return optax.chain(clip, optax.scale_by_adam(eps=1e-5))

    def _check_optimizer(self) -> None:
        """Refuses an optimizer with which a step would climb the loss."""
        gradient = jnp.ones(1)
        state = self.optimizer.init(gradient)
        # Several, as a schedule may begin with 0.
        for _ in range(3):
            direction, state = self.optimizer.update(gradient, state, jnp.zeros(1))
        if direction[0] < 0.0:
            raise UserError(
                f"make_optimizer of {type(self).__name__} turns a gradient around, as optax.adam "
                "does, but a step subtracts what it gives; return one without a learning rate, "
                "such as optax.scale_by_adam()"
            )

    def init(self, key: jax.Array) -> TrainingState:
        """The state before the first iteration; consumes the key."""
        config = self.config
        key, policy_key, value_key, env_key, clock_key = jax.random.split(key, 5)
        params = Params(
            policy=self.networks.policy_network.init(policy_key),
            value=self.networks.value_network.init(value_key),
        )
        ranges = vector.ranges_after(self.env, jnp.int32(0), config.batch_steps)
        env_state = vector.reset(self.env, env_key, config.num_envs, ranges)
        # With equal clocks, all episodes would time out together.
        clock = jax.random.randint(clock_key, (config.num_envs,), 0, self.episode_steps)
        num_inputs = self.env.observation_size + len(self.critic_metrics)
        return TrainingState(
            params=params,
            optimizer=self.optimizer.init(ravel_pytree(params)[0]),
            statistics=statistics.init_statistics(num_inputs),
            learning_rate=jnp.float32(config.learning_rate),
            env=env_state._replace(clock=clock),
            key=key,
            iteration=jnp.int32(0),
        )

    def run(self, state: TrainingState, num_iterations: int) -> tuple[TrainingState, Metrics]:
        """State and a number of iterations I -> state and metrics, each [I]; the metric "fault" is
        the result of `first_fault`."""

        def iterate_packed(packed: TrainingState, _: None) -> tuple[TrainingState, Metrics]:
            state, metrics = self.iterate(_unpack_env(packed))
            return _pack_env(state), metrics

        packed, metrics = jax.lax.scan(iterate_packed, _pack_env(state), length=num_iterations)
        return _unpack_env(packed), metrics

    def iterate(self, state: TrainingState) -> tuple[TrainingState, Metrics]:
        """One iteration: collect -> advantages -> update."""
        key, collect_key, update_key = jax.random.split(state.key, 3)
        env_state, rollout, bootstrap, metrics = self.collect(state, collect_key)
        advantage, value_target = self.advantages(state, rollout, bootstrap)
        # The next rollout normalises by the new statistics, so the networks learn on inputs
        # normalised by them; otherwise the policy would shift with every change of the statistics.
        # The log_prob and the advantages are those of the old ones; therefore the ratio in the loss
        # begins only near 1.
        new_statistics = statistics.update(state.statistics, rollout.inputs)
        normalizer = new_statistics.normalizer
        samples = Samples(
            inputs=normalize(rollout.inputs, normalizer),
            action=rollout.action,
            log_prob=rollout.log_prob,
            advantage=advantage,
            value_target=value_target,
            noise_bound=jnp.broadcast_to(self.noise_bounds(), (*value_target.shape, 1)),
            normalizer=normalizer,
        )
        learned, minibatch_metrics = self.update(state, samples, update_key)

        fault = first_fault(metrics["reward"], new_statistics, minibatch_metrics, learned.params)
        metrics |= {name: jnp.mean(values) for name, values in minibatch_metrics.items()}
        if "policy/kl" in minibatch_metrics:
            # How far the whole update has moved the policy: that of the last epoch.
            metrics["policy/kl"] = jnp.mean(minibatch_metrics["policy/kl"][-1])
        # Of the KL rule: the rate with which the next update begins. Of a schedule: that of this
        # update.
        metrics["policy/learning_rate"] = self.learning_rate(learned.learning_rate, state.iteration)
        metrics["loss/explained_variance"] = 1.0 - jnp.var(advantage) / jnp.var(value_target)
        metrics["fault"] = fault
        return learned._replace(
            statistics=new_statistics, env=env_state, key=key, iteration=state.iteration + 1
        ), metrics

    def collect(
        self, state: TrainingState, key: jax.Array
    ) -> tuple[vector.VectorState, Rollout, BootstrapInputs, Metrics]:
        """Runs the policy for T steps; consumes the key.

        Returns:
          The environments' states after the last step; the rollout; the inputs of the networks
          where a value is needed that no step begins with; the metrics of the rollout, each [].
        """
        config = self.config
        normalizer = state.statistics.normalizer
        noise_key, reset_key = jax.random.split(key)
        # All numbers are sampled at once, because on a GPU each sample costs a kernel or two.
        noise_shape = (config.rollout_length, config.num_envs, self.env.action_size)
        noise = jax.random.normal(noise_key, noise_shape, jnp.float32)
        ranges = vector.ranges_after(self.env, state.iteration, config.batch_steps)
        # One start for each environment: if it ends twice within a rollout, it starts twice alike.
        fresh = vector.first_states(self.env, reset_key, config.num_envs, ranges)

        def control_step(carry: tuple, noise: jax.Array) -> tuple:
            # Packed into one array, because on a GPU each array that a loop carries costs a kernel
            # in each step; elsewhere `pack` changes nothing.
            packed, timeout_inputs = carry
            env_state = unpack(packed)
            inputs = self.network_inputs(vector.observe(env_state), env_state.env.metrics)
            policy = self.distribution(
                state.params, normalize(inputs, normalizer), self.noise_bounds()
            )
            action = policy.mean + policy.std * noise
            env_state, result = vector.step(
                self.env, env_state, action, key=None, episode_steps=self.episode_steps, fresh=fresh
            )
            # An environment times out at most once in a rollout, because no time limit is shorter.
            final_inputs = self.network_inputs(result.final_observation, result.metrics)
            timeout_inputs = jnp.where(result.truncated[:, None], final_inputs, timeout_inputs)
            rollout_step = Rollout(
                inputs=inputs,
                action=action,
                log_prob=policy.log_prob(action),
                reward=(config.reward_scale * result.reward).astype(jnp.float32),
                terminated=result.terminated,
                truncated=result.truncated,
            )
            metrics = step_metrics(result, num_groups(config), self.env.task.curves)
            return (pack(env_state), timeout_inputs), (rollout_step, pack(metrics))

        no_inputs = jnp.zeros((config.num_envs, state.statistics.mean.size))
        (packed, timeout_inputs), (rollout, metrics) = jax.lax.scan(
            control_step, (pack(state.env), no_inputs), noise
        )
        env_state = unpack(packed)
        bootstrap = BootstrapInputs(
            after_rollout=self.network_inputs(vector.observe(env_state), env_state.env.metrics),
            at_timeout=timeout_inputs,
        )
        return env_state, rollout, bootstrap, rollout_metrics(unpack(metrics))

    def noise_bounds(self) -> jax.Array:
        """Lower bounds of the action noise of each environment [B, 1]: evenly from 0 to twice
        mean_noise_bound.

        With one bound for all, either no environment visits the states from which a policy must
        recover, or none those in which it must be precise. Different noise for each actor is that
        of Horgan et al. (2018), Distributed prioritized experience replay.
        """
        share = (jnp.arange(self.config.num_envs) + 0.5) / self.config.num_envs
        return 2.0 * self.config.mean_noise_bound * share[:, None]

    def network_inputs(self, observation: jax.Array, metrics: Metrics) -> jax.Array:
        """Inputs of the networks before normalisation [B, N + K].

        Args:
          observation: [B, N].
          metrics: of the environments, each [B].
        """
        columns = [metrics[name][:, None] for name in self.critic_metrics]
        return jnp.concatenate([observation, *columns], axis=-1, dtype=jnp.float32)

    def distribution(
        self, params: Params, inputs: jax.Array, noise_bound: jax.Array
    ) -> ActionDistribution:
        """The policy's distribution of the action [..., A]; of the inputs it sees the observation.

        Args:
          params: of both networks.
          inputs: normalised [..., N + K].
          noise_bound: lower bounds of the standard deviation [..., 1]. The deviation is the root of
            std^2 + noise_bound^2, as a clipped one would have no gradient.
        """
        observation = inputs[..., : self.env.observation_size]
        mean, std = self.networks.policy_network.apply(params.policy, observation)
        return ActionDistribution(mean, jnp.sqrt(jnp.square(std) + jnp.square(noise_bound)))

    def values(self, params: Params, inputs: jax.Array) -> jax.Array:
        """Values [...] of states with normalised inputs [..., N + K]."""
        if self.config.shared_critic:
            observation, metrics = jnp.split(inputs, [self.env.observation_size], axis=-1)
            features = self.networks.features(params.policy, observation)
            inputs = jnp.concatenate([features, metrics], axis=-1)
        return self.networks.value_network.apply(params.value, inputs)

    def advantages(
        self, state: TrainingState, rollout: Rollout, bootstrap: BootstrapInputs
    ) -> tuple[jax.Array, jax.Array]:
        """Advantages and targets of the values [T, B].

        Args:
          state: of which the parameters and the statistics are those of the rollout.
          rollout: T steps.
          bootstrap: inputs where a value is needed that no step begins with.
        """
        inputs = jnp.concatenate(
            [rollout.inputs, bootstrap.after_rollout[None], bootstrap.at_timeout[None]]
        )
        inputs = normalize(inputs, state.statistics.normalizer)
        values = self.values(state.params, inputs)
        num_steps = len(rollout.reward)
        value = values[:num_steps]
        next_value = values[1 : num_steps + 1]
        timeout_value = values[-1]
        # A time-out is bootstrapped: what follows is worth as much as the old episode's last state,
        # and not as the new episode's first one.
        next_value = jnp.where(rollout.truncated, timeout_value, next_value)
        advantage = generalized_advantages(
            reward=rollout.reward,
            value=value,
            next_value=next_value,
            terminated=rollout.terminated,
            truncated=rollout.truncated,
            discount=self.config.discount,
            gae_lambda=self.config.gae_lambda,
        )
        return advantage, advantage + value

    def update(
        self, state: TrainingState, samples: Samples, key: jax.Array
    ) -> tuple[TrainingState, Metrics]:
        """Several epochs of minibatch steps. Samples are shuffled within groups of environments
        (`num_groups`).

        Args:
          state: before the update.
          samples: of the rollout [T, B, ...].
          key: consumed.

        Returns:
          The state with other parameters, optimizer and learning rate; metrics of each minibatch
          step [epochs, minibatches].
        """
        groups = num_groups(self.config)
        grouped = samples.map_arrays(lambda array: group(array, groups))
        params, unravel = ravel_pytree(state.params)

        def learn_epoch(learner: LearnerState, epoch_key: jax.Array) -> tuple:
            minibatches = self.minibatches(grouped.advantage, epoch_key)
            return jax.lax.scan(learn_minibatch, learner, minibatches)

        def learn_minibatch(learner: LearnerState, minibatch: Minibatch) -> tuple:
            batch = samples_of(minibatch, grouped)
            learner, metrics = self.minibatch_step(learner, batch, unravel, state.iteration)
            return learner, pack(metrics)

        learner = LearnerState(params, state.optimizer, state.learning_rate)
        epoch_keys = jax.random.split(key, self.config.num_epochs)
        learner, metrics = jax.lax.scan(learn_epoch, learner, epoch_keys)
        return state._replace(
            params=unravel(learner.params),
            optimizer=learner.optimizer,
            learning_rate=learner.adapted_rate,
        ), unpack(metrics)

    def minibatches(self, advantage: jax.Array, key: jax.Array) -> Minibatch:
        """The M minibatches of an epoch, each array [M, ...]: every sample is in one of them.

        Args:
          advantage: of the samples of each group [G, T * B / G].
          key: consumed.
        """
        groups, group_size = advantage.shape
        orders = jax.vmap(lambda key: random_order(key, group_size))(jax.random.split(key, groups))
        orders = jnp.moveaxis(orders.reshape((groups, self.config.num_minibatches, -1)), 1, 0)
        # All minibatches at once: on several devices each reduction is a message, and every
        # minibatch already has one for its gradient.
        advantages = jax.vmap(lambda order: take(advantage, order))(orders)
        mean = jnp.mean(advantages, axis=(1, 2), keepdims=True)
        deviation = jnp.std(advantages, axis=(1, 2), keepdims=True)
        return Minibatch(orders, (advantages - mean) / (deviation + 1e-8))

    def minibatch_step(
        self,
        learner: LearnerState,
        samples: Samples,
        unravel: Callable[[jax.Array], Params],
        iteration: jax.Array,
    ) -> tuple[LearnerState, Metrics]:
        """One step of the optimizer, and the metrics of the minibatch, each [].

        Args:
          learner: before the step.
          samples: of the minibatch [S, ...].
          unravel: the learner's parameters in one array -> the same as `loss` takes them.
          iteration: iterations done before this one [], int.
        """

        def loss_of(params: jax.Array) -> tuple[jax.Array, Metrics]:
            return self.loss(unravel(params), samples)

        gradient, metrics = jax.grad(loss_of, has_aux=True)(learner.params)
        metrics["loss/gradient_norm"] = optax.tree.norm(gradient)
        direction, optimizer = self.optimizer.update(gradient, learner.optimizer, learner.params)
        learning_rate = self.learning_rate(learner.adapted_rate, iteration)
        return LearnerState(
            params=learner.params - learning_rate * direction,
            optimizer=optimizer,
            adapted_rate=self.adapt_learning_rate(learner.adapted_rate, metrics, iteration),
        ), metrics

    def loss(self, params: Params, samples: Samples) -> tuple[jax.Array, Metrics]:
        """The loss of a minibatch [], and its parts and other metrics [] by name: the clipped
        surrogate objective (Schulman et al. 2017, equation 7), the squared error of the values and
        the entropy bonus (equation 9). A subclass adds a term here, and metrics, of which the log
        has the mean over all minibatches (of policy/kl over those of the last epoch)."""
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
            # Schulman's low-variance estimate of KL(old || new): joschu.net/blog/kl-approx.html.
            "policy/kl": jnp.mean(ratio - 1.0 - log_ratio),
            "policy/clip_fraction": jnp.mean(jnp.abs(ratio - 1.0) > config.clip_epsilon),
            "policy/action_std": jnp.mean(policy.std),
        }

    def learning_rate(self, adapted: jax.Array, iteration: jax.Array) -> jax.Array:
        """The learning rate [] of every minibatch step of an iteration. A subclass with a schedule
        of its own overrides this: the KL rule then has no effect, and target_kl may be 0.

        Args:
          adapted: the rate that the KL rule has reached [] (`adapt_learning_rate`).
          iteration: iterations done before this one [], int.
        """
        return adapted

    def adapt_learning_rate(
        self, adapted: jax.Array, metrics: Metrics, iteration: jax.Array
    ) -> jax.Array:
        """The rate [] after a minibatch step, adapted so that the KL divergence of the policy from
        that of the rollout approaches target_kl: the adaptive rule of Schulman et al. 2017, section
        4, applied to the learning rate. If target_kl is 0, it stays.

        Args:
          adapted: the rate that the rule had reached before [].
          metrics: of this minibatch step, each [].
          iteration: iterations done before this one [], int.

        Raises:
          UserError: `loss` does not return the KL divergence.
        """
        config = self.config
        if config.target_kl == 0.0:
            return adapted
        if "policy/kl" not in metrics:
            raise UserError(
                f"the loss of {type(self).__name__} returns no metric policy/kl, to which the "
                "learning rate adapts; return it, or set target_kl to 0"
            )
        is_large = metrics["policy/kl"] > 2.0 * config.target_kl
        is_small = metrics["policy/kl"] < 0.5 * config.target_kl
        factor = jnp.where(is_small, _LEARNING_RATE_FACTOR, 1.0)
        factor = jnp.where(is_large, 1.0 / _LEARNING_RATE_FACTOR, factor)
        limit = self.max_learning_rate(iteration)
        return jnp.clip(adapted * factor, config.min_learning_rate, limit)

    def max_learning_rate(self, iteration: jax.Array) -> jax.Array:
        """Upper limit [] of the rate that adapts: an exponential decay from max_learning_rate to
        final_max_learning_rate over decay_steps. Without this limit the KL rule raises the rate
        once the policy hardly changes, and a late large step ruins the policy.

        Args:
          iteration: iterations done before this one [], int.
        """
        config = self.config
        progress = jnp.minimum(1.0, iteration * (config.batch_steps / config.decay_steps))
        ratio = config.final_max_learning_rate / config.max_learning_rate
        return config.max_learning_rate * ratio**progress


def generalized_advantages(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    truncated: jax.Array,
    discount: float,
    gae_lambda: float,
) -> jax.Array:
    """Advantages [T, B] of T steps of B environments (Schulman et al. 2016, High-dimensional
    continuous control using generalized advantage estimation, equation 16).

    Args:
      reward: of each step [T, B].
      value: of the state before each step [T, B].
      next_value: of the state after each step [T, B]; at a time-out, of the old episode's last
        state, not of the new episode's first one.
      terminated: steps without a following value [T, B], bool.
      truncated: steps whose following value counts, but across which no advantage is propagated
        back [T, B], bool.
      discount: factor of a later step, gamma.
      gae_lambda: factor of a later step's error, lambda.
    """
    delta = reward + discount * jnp.where(terminated, 0.0, next_value) - value
    carried = discount * gae_lambda * (~(terminated | truncated))

    def backward(later_advantage: jax.Array, step: tuple) -> tuple[jax.Array, jax.Array]:
        delta, carried = step
        advantage = delta + carried * later_advantage
        return advantage, advantage

    _, advantages = jax.lax.scan(
        backward, jnp.zeros_like(delta[0]), (delta, carried), reverse=True, unroll=_UNROLL
    )
    return advantages


def num_groups(config: PPOConfig) -> int:
    """Number of equal groups of environments, a power of two.

    Samples are shuffled within their group, and every minibatch takes equally many from each group.
    A device that holds whole groups therefore shuffles only its own samples, and the training does
    not depend on the number of devices.
    """
    groups = _GROUPS
    while 2 * groups * _MIN_GROUP_ENVS <= config.num_envs:
        groups *= 2
    while config.num_envs % groups or (config.batch_steps // groups) % config.num_minibatches:
        groups //= 2
    return groups


def group(array: jax.Array, groups: int) -> jax.Array:
    """Deals samples [T, B, ...] into groups of environments [G, T * B / G, ...]."""
    length, num_envs, *sample_shape = array.shape
    by_group = array.reshape((length, groups, num_envs // groups, *sample_shape))
    by_group = jnp.moveaxis(by_group, 1, 0)
    return by_group.reshape((groups, length * num_envs // groups, *sample_shape))


def take(array: jax.Array, order: jax.Array) -> jax.Array:
    """Samples [G, n, ...] of those of each group [G, T * B / G, ...] in an order [G, n]."""
    return jax.vmap(lambda samples, indices: samples[indices])(array, order)


def samples_of(minibatch: Minibatch, grouped: Samples) -> Samples:
    """The samples [S, ...] of a minibatch, S = G * n, from those in groups."""
    taken = grouped.map_arrays(lambda array: take(array, minibatch.order))
    taken = taken._replace(advantage=minibatch.advantage)
    # With the groups as an axis of their own, XLA transposes the layers' outputs on a CPU.
    return taken.map_arrays(lambda array: array.reshape((-1, *array.shape[2:])))


def random_order(key: jax.Array, size: int) -> jax.Array:
    """A random permutation of 0 ... `size` - 1 [size], int32; consumes the key.

    `jax.random.permutation` sorts pairs of a random number and an index, which takes four times as
    long on a CPU as one number with the index in its low bits. Of two equal random numbers the
    smaller index comes first; where equal ones are likely, one order shuffles another.
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


def names_of_critic_metrics(config: PPOConfig, env: AnyEnv) -> tuple[str, ...]:
    """Names of the environment's metrics that the value network sees, in order.

    Raises:
      UserError: the environment lacks one.
    """
    known_metrics = jax.eval_shape(lambda: env.reset(jax.random.PRNGKey(0))).metrics
    patterns = config.critic_metrics
    if patterns is None:
        patterns = env.task.critic_metrics
    return matching_metrics(patterns, known_metrics)


def policy_of(state: TrainingState, observation_size: int) -> Policy:
    """The policy of a training state, or the policies of a population's state."""
    of_observation = [array[..., :observation_size] for array in state.statistics.normalizer]
    return Policy(Normalizer(*of_observation), state.params.policy)


def population(algorithm: PPO) -> tuple[Callable, Callable]:
    """`init` and `run` of S independent runs: keys [S, 2] -> states with S as the first axis of
    every array; metrics are [S, I]."""
    return jax.vmap(algorithm.init), jax.vmap(algorithm.run, in_axes=(0, None))


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

    Raises:
      UserError: an `update` of a subclass returns none of the metrics in which a fault shows.
    """
    number = {quantity: i for i, quantity in enumerate(CHECKED, start=1)}
    number_of_metric = {
        "loss/value": number["loss/value"],
        "loss/policy": number["loss/policy"],
        "loss/gradient_norm": number["gradient"],
    }
    # The loss of a subclass may have other parts.
    names = [name for name in number_of_metric if name in minibatch_metrics]
    if not names:
        raise UserError(
            "the update of the algorithm returns no metric loss/gradient_norm, in which a "
            "divergence shows; return it for each minibatch step"
        )
    # A row for each minibatch step, in their order.
    steps = jnp.stack([minibatch_metrics[name].ravel() for name in names], axis=-1)
    numbers_of_steps = len(steps) * [number_of_metric[name] for name in names]
    is_finite = jnp.hstack(
        [
            jnp.isfinite(reward),
            all_finite(statistics),
            jnp.isfinite(steps).ravel(),
            all_finite(params),
        ]
    )
    numbers = jnp.array(
        [number["reward"], number["observation"], *numbers_of_steps, number["parameters"]]
    )
    first_infinite = jnp.argmin(is_finite)
    return jnp.where(is_finite.all(), 0, numbers[first_infinite])


def all_finite(tree: Any) -> jax.Array:
    """Whether every number of a pytree of arrays is finite [], bool."""
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree)]).all()


def _pack_env(state: TrainingState) -> TrainingState:
    """The state as a loop carries it: on a GPU, its environments are rows of one array."""
    return state._replace(env=pack(state.env))


def _unpack_env(state: TrainingState) -> TrainingState:
    """The inverse of `_pack_env`."""
    return state._replace(env=unpack(state.env))
