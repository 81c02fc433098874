"""Proximal policy optimisation, read from top to bottom: collect -> advantages -> update.

`make_trainer` gives two pure functions over one pytree of state: `init(key)` and
`run(state, num_iterations)`. Inside `run` everything is a `scan`; nothing returns to Python.
Source: Schulman et al., Proximal Policy Optimization Algorithms (2017).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from bounce_mjx.errors import UserError
from bounce_mjx.gpu.batches import outer_axis
from bounce_mjx.gpu.rows import pack, pack_steps, unpack
from bounce_mjx.learning import statistics
from bounce_mjx.learning.advantages import generalized_advantages
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.gaussian import Gaussian
from bounce_mjx.learning.metrics import (
    Metrics,
    matching_metrics,
    rollout_metrics,
    step_metrics,
)
from bounce_mjx.learning.policy import (
    Policy,
    cast_hidden_layers,
    make_networks,
)
from bounce_mjx.learning.statistics import Normalizer, RunningStatistics, normalize
from bounce_mjx.task import vector
from bounce_mjx.task.state import Env

# Factor by which one update may change the learning rate.
_LEARNING_RATE_FACTOR = 1.1

_MINIBATCH_METRICS = (
    "loss/policy",
    "loss/value",
    "loss/gradient_norm",
    "policy/entropy",
    "policy/kl",
    "policy/action_std",
)

# Minimum number of groups in which samples are shuffled, and the maximum number of environments per
# group if there are more groups.
_MIN_GROUPS, _GROUP_ENVS = 64, 64

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
    """T steps of B environments."""

    inputs: jax.Array
    """Normalised observation and critic metrics [T, B, N + K]."""
    action: jax.Array
    """Drawn action before clipping [T, B, A]."""
    log_prob: jax.Array
    """Logarithm of the action's probability density [T, B]."""
    reward: jax.Array
    """Scaled reward [T, B]."""
    terminated: jax.Array
    """[T, B], bool."""
    truncated: jax.Array
    """[T, B], bool."""


class StepOfRollout(NamedTuple):
    """One step of B environments, the batch last: the fields of `Rollout`."""

    raw_inputs: jax.Array
    """Inputs of the networks before normalisation [N + K, B]."""
    action: jax.Array
    """[A, B]."""
    log_prob: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array


class Collection(NamedTuple):
    """A rollout, with the data that its update needs."""

    env: vector.VectorState
    """States of the environments after the last step."""
    rollout: Rollout
    raw_inputs: jax.Array
    """The rollout's inputs before normalisation [T, B, N + K]."""
    statistics: RunningStatistics
    """Statistics including the rollout."""
    last_inputs: jax.Array
    """Normalised inputs after the last step [B, N + K]."""
    timeout_inputs: jax.Array
    """Normalised inputs at each environment's time-out, before its reset [B, N + K]; unused for an
    environment that did not time out."""


class Samples(NamedTuple):
    """Data of an update: G groups of M samples (`num_groups`)."""

    inputs: jax.Array
    """Normalised observation and critic metrics [G, M, N + K]."""
    action: jax.Array
    """[G, M, A]."""
    log_prob: jax.Array
    """[G, M]."""
    advantage: jax.Array
    """[G, M]."""
    value_target: jax.Array
    """[G, M]."""


class Trainer(NamedTuple):
    """Training as pure functions; `jax.jit` them (the second argument of `run` is static)."""

    init: Callable[[jax.Array], TrainingState]
    """key -> state; consumes the key."""
    run: Callable[[TrainingState, int], tuple[TrainingState, Metrics]]
    """(state, number of iterations I) -> (state, metrics, each [I]); the metric "fault" is the
    result of `first_fault`."""


def make_trainer(config: PPOConfig, env: Env, episode_steps: int) -> Trainer:
    """Builds the trainer of an environment whose episodes are truncated at `episode_steps`.

    Raises:
      UserError: a rollout is longer than an episode, or the environment lacks a critic metric.
    """
    if config.rollout_length > episode_steps:
        raise UserError(
            f"rollout_length {config.rollout_length} is longer than an episode of {episode_steps} "
            "control steps; choose a shorter rollout or longer episodes"
        )
    known_metrics = jax.eval_shape(lambda: env.reset(jax.random.PRNGKey(0))).metrics
    critic_metrics = matching_metrics(config.critic_metrics, known_metrics)
    num_inputs = env.observation_size + len(critic_metrics)
    networks = make_networks(config, env.observation_size, env.action_size, len(critic_metrics))
    groups = num_groups(config)
    optimizer = optax.chain(
        optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_adam(eps=1e-5)
    )
    casts = config.compute_dtype != "float32"

    def cast_inputs(inputs: jax.Array) -> jax.Array:
        """Inputs of the networks in the type of the hidden layers."""
        return inputs.astype(config.compute_dtype) if casts else inputs

    def cast_params(params: Params) -> Params:
        """Parameters with the hidden layers in the training's type."""
        if not casts:
            return params
        dtype = jnp.dtype(config.compute_dtype)
        return Params(*(cast_hidden_layers(config, network, dtype) for network in params))

    def policy_apply(params: Params, inputs: jax.Array) -> Gaussian:
        return networks.policy_network.apply(params.policy, inputs[..., : env.observation_size])

    def value_apply(params: Params, inputs: jax.Array) -> jax.Array:
        return networks.value_network.apply(params.value, inputs)

    def make_inputs(observation: jax.Array, metrics: Metrics) -> jax.Array:
        """Inputs of the networks before normalisation [B, N + K]."""
        columns = [metrics[name][:, None] for name in critic_metrics]
        return jnp.concatenate([observation, *columns], axis=-1)

    def init(key: jax.Array) -> TrainingState:
        key, policy_key, value_key, env_key, clock_key = jax.random.split(key, 5)
        params = Params(
            networks.policy_network.init(policy_key), networks.value_network.init(value_key)
        )
        ranges = vector.ranges_after(env, jnp.int32(0), config.batch_steps)
        env_state = vector.reset(env, env_key, config.num_envs, ranges)
        # With equal clocks, all episodes would time out together.
        clock = jax.random.randint(clock_key, (config.num_envs,), 0, episode_steps)
        return TrainingState(
            params=params,
            optimizer=optimizer.init(ravel_pytree(params)[0]),
            statistics=statistics.init_statistics(num_inputs),
            learning_rate=jnp.float32(config.learning_rate),
            env=env_state._replace(clock=clock),
            key=key,
            iteration=jnp.int32(0),
        )

    def collect(state: TrainingState, key: jax.Array) -> tuple[Collection, Metrics]:
        """Runs the policy for T steps."""
        params, normalizer = cast_params(state.params), state.statistics.normalizer

        first_inputs = make_inputs(vector.observe(state.env), state.env.env.metrics)

        def one_step(carry, draws):
            env_state, timeout_inputs = unpack(carry)
            noise, fresh = draws
            raw_inputs = make_inputs(vector.observe(env_state), env_state.env.metrics)
            inputs = normalize(raw_inputs, normalizer)
            distribution = policy_apply(params, cast_inputs(inputs))
            action = distribution.mean + distribution.std * noise
            env_state, result = vector.step_with(
                env, env_state, action, unpack(fresh), episode_steps
            )
            timeout_inputs = jnp.where(
                result.truncated,
                make_inputs(result.final_observation, result.metrics).T,
                timeout_inputs,
            )
            step_of_rollout = StepOfRollout(
                raw_inputs=raw_inputs.T,
                action=action.T,
                log_prob=distribution.log_prob(action),
                reward=config.reward_scale * result.reward,
                terminated=result.terminated,
                truncated=result.truncated,
            )
            metrics = step_metrics(result, groups)
            return pack((env_state, timeout_inputs)), (pack(step_of_rollout), pack(metrics))

        # An environment times out at most once in a rollout, because no time limit is shorter than
        # a rollout.
        noise_key, reset_key = jax.random.split(key)
        # All numbers are drawn at once, because on a GPU each draw costs a kernel or two.
        shape = (config.rollout_length, config.num_envs, env.action_size)
        noise = jax.random.normal(noise_key, shape)
        ranges = vector.ranges_after(env, state.iteration, config.batch_steps)
        fresh = jax.vmap(lambda key: vector.first_states(env, key, config.num_envs, ranges))(
            jax.random.split(reset_key, config.rollout_length)
        )
        carry = pack((state.env, first_inputs.T))
        carry, (steps, metrics) = jax.lax.scan(one_step, carry, (noise, pack_steps(fresh)))
        env_state, timeout_inputs = unpack(carry)
        steps = unpack(steps)
        raw_inputs = jnp.swapaxes(steps.raw_inputs, 1, 2)
        rollout = Rollout(
            inputs=normalize(raw_inputs, normalizer),
            action=jnp.swapaxes(steps.action, 1, 2),
            log_prob=steps.log_prob,
            reward=steps.reward,
            terminated=steps.terminated,
            truncated=steps.truncated,
        )
        last_inputs = make_inputs(vector.observe(env_state), env_state.env.metrics)
        collection = Collection(
            env=env_state,
            rollout=rollout,
            raw_inputs=raw_inputs,
            statistics=statistics.update(state.statistics, raw_inputs),
            last_inputs=normalize(last_inputs, normalizer),
            timeout_inputs=normalize(timeout_inputs.T, normalizer),
        )
        return collection, rollout_metrics(unpack(metrics))

    def prepare(params: Params, collection: Collection) -> Samples:
        """Computes values and advantages of the rollout, and groups its samples."""
        rollout = collection.rollout
        ends = jnp.stack([collection.last_inputs, collection.timeout_inputs])
        inputs = jnp.concatenate([rollout.inputs, ends])
        values = value_apply(cast_params(params), cast_inputs(inputs))
        values, timeout_values = values[:-1], values[-1]
        advantage = generalized_advantages(
            rollout.reward,
            values[:-1],
            jnp.where(rollout.truncated, timeout_values, values[1:]),
            rollout.terminated,
            rollout.truncated,
            config.discount,
            config.gae_lambda,
        )
        # The next rollout normalises by the new statistics, so the networks learn on inputs
        # normalised by them; otherwise the policy would shift with every change of the statistics.
        inputs = normalize(collection.raw_inputs, collection.statistics.normalizer)
        samples = Samples(
            inputs=cast_inputs(inputs),
            action=rollout.action,
            log_prob=rollout.log_prob,
            advantage=advantage,
            value_target=advantage + values[:-1],
        )
        return jax.tree.map(lambda x: group(x, groups), samples)

    def loss(params: Params, samples: Samples) -> tuple[jax.Array, Metrics]:
        params = cast_params(params)
        distribution = policy_apply(params, samples.inputs)
        log_ratio = distribution.log_prob(samples.action) - samples.log_prob
        ratio = jnp.exp(log_ratio)
        advantage = samples.advantage
        clipped = jnp.clip(ratio, 1.0 - config.clip_epsilon, 1.0 + config.clip_epsilon)
        policy_loss = -jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage))
        values = value_apply(params, samples.inputs)
        value_loss = jnp.mean(jnp.square(values - samples.value_target))
        entropy = jnp.mean(distribution.entropy())
        total = policy_loss + config.value_cost * value_loss - config.entropy_cost * entropy
        return total, {
            "loss/policy": policy_loss,
            "loss/value": value_loss,
            "policy/entropy": entropy,
            # Schulman's low-variance estimate of KL(old || new).
            "policy/kl": jnp.mean(ratio - 1.0 - log_ratio),
            "policy/action_std": jnp.mean(distribution.std),
        }

    def update(state: TrainingState, samples: Samples, key: jax.Array):
        """Several epochs of minibatch steps, with the parameters in one array."""
        limit = max_learning_rate(config, state.iteration)
        flat_params, unravel = ravel_pytree(state.params)

        def epoch(carry, epoch_key):
            keys = jax.random.split(epoch_key, groups)
            size = samples.log_prob.shape[1]
            order = jax.vmap(lambda key: random_order(key, size))(keys)
            order = order.reshape((groups, config.num_minibatches, -1))
            # Mean and deviation of all minibatches at once: on several devices each reduction is a
            # message, and every minibatch already has one for its gradient.
            advantage = jax.vmap(lambda x, i: x[i])(samples.advantage, order)
            mean, deviation = jnp.mean(advantage, axis=(0, 2)), jnp.std(advantage, axis=(0, 2))
            order = jnp.moveaxis(order, 1, 0)

            def step(index, carry):
                (params, optimizer_state, learning_rate), all_metrics = carry
                chosen = order[index]
                batch = jax.tree.map(lambda x: jax.vmap(lambda x, i: x[i])(x, chosen), samples)
                batch = batch._replace(
                    advantage=(batch.advantage - mean[index]) / (deviation[index] + 1e-8)
                )
                # With the groups as an axis of their own, XLA transposes the layers' outputs on a
                # CPU.
                batch = jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), batch)
                gradient, metrics = jax.grad(lambda flat: loss(unravel(flat), batch), has_aux=True)(
                    params
                )
                metrics["loss/gradient_norm"] = optax.tree.norm(gradient)
                direction, optimizer_state = optimizer.update(gradient, optimizer_state)
                params = params - learning_rate * direction
                learning_rate = adapt_learning_rate(
                    config, learning_rate, metrics["policy/kl"], limit
                )
                row = jnp.stack([metrics[name] for name in _MINIBATCH_METRICS])
                return (params, optimizer_state, learning_rate), all_metrics.at[index].set(row)

            # Not `scan`: on a GPU each slice of its inputs and each result costs a kernel.
            shape = (config.num_minibatches, len(_MINIBATCH_METRICS))
            all_metrics = jnp.zeros(shape, advantage.dtype)
            return jax.lax.fori_loop(0, config.num_minibatches, step, (carry, all_metrics))

        carry = (flat_params, state.optimizer, state.learning_rate)
        (flat_params, optimizer_state, learning_rate), all_metrics = jax.lax.scan(
            epoch, carry, jax.random.split(key, config.num_epochs)
        )
        metrics = dict(zip(_MINIBATCH_METRICS, jnp.moveaxis(all_metrics, -1, 0), strict=True))
        means = {name: jnp.mean(value) for name, value in metrics.items()}
        means["policy/kl"] = jnp.mean(metrics["policy/kl"][-1])
        return (unravel(flat_params), optimizer_state, learning_rate), means, metrics

    def iteration(state: TrainingState) -> tuple[TrainingState, Metrics]:
        key, collect_key, update_key = jax.random.split(state.key, 3)
        collection, metrics = collect(state, collect_key)
        samples = prepare(state.params, collection)
        (params, optimizer_state, learning_rate), losses, minibatch_metrics = update(
            state, samples, update_key
        )
        fault = first_fault(metrics["reward"], collection.statistics, minibatch_metrics, params)
        state = TrainingState(
            params=params,
            optimizer=optimizer_state,
            statistics=collection.statistics,
            learning_rate=learning_rate,
            env=collection.env,
            key=key,
            iteration=state.iteration + 1,
        )
        metrics |= losses | {"policy/learning_rate": learning_rate, "fault": fault}
        return state, metrics

    def run(state: TrainingState, num_iterations: int) -> tuple[TrainingState, Metrics]:
        def packed_iteration(state: TrainingState, _) -> tuple[TrainingState, Metrics]:
            state, metrics = iteration(state._replace(env=unpack(state.env)))
            return state._replace(env=pack(state.env)), pack(metrics)

        state = state._replace(env=pack(state.env))
        state, metrics = jax.lax.scan(packed_iteration, state, length=num_iterations)
        return state._replace(env=unpack(state.env)), unpack(metrics)

    return Trainer(init, run)


def population(trainer: Trainer) -> Trainer:
    """A trainer of S independent trainings: keys [S, 2] -> states with S as the first axis of every
    array; metrics are [S, I]."""

    def run(states: TrainingState, num_iterations: int) -> tuple[TrainingState, Metrics]:
        with outer_axis(len(states.iteration)):
            return jax.vmap(lambda state: trainer.run(state, num_iterations))(states)

    return Trainer(jax.vmap(trainer.init), run)


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
    """The learning rate [] after an update, adapted so that the KL divergence approaches target_kl
    (the adaptive rule of Schulman et al. 2017, section 4, applied to the learning rate)."""
    if config.target_kl > 0.0:
        learning_rate = jnp.where(
            kl > 2.0 * config.target_kl,
            learning_rate / _LEARNING_RATE_FACTOR,
            jnp.where(
                kl < 0.5 * config.target_kl, learning_rate * _LEARNING_RATE_FACTOR, learning_rate
            ),
        )
    return jnp.clip(learning_rate, config.min_learning_rate, limit)


def first_fault(
    reward: jax.Array,
    statistics: RunningStatistics,
    minibatch_metrics: Metrics,
    params: Params,
) -> jax.Array:
    """Number [], from 1, of the first quantity of `CHECKED` that was not finite in an iteration; 0
    if all were finite.

    Args:
      reward: mean reward of the rollout [].
      statistics: the statistics that include the rollout.
      minibatch_metrics: each [epochs, minibatches].
      params: the parameters after the update.
    """
    names = ("loss/value", "loss/policy", "loss/gradient_norm")
    flags = jnp.stack([jnp.isfinite(minibatch_metrics[n]).ravel() for n in names], axis=-1)
    finite = jnp.concatenate(
        [
            jnp.stack([jnp.isfinite(reward), all_finite(statistics)]),
            flags.ravel(),
            all_finite(params)[None],
        ]
    )
    numbers = [1, 2] + [3, 4, 5] * flags.shape[0] + [6]
    return jnp.where(finite.all(), 0, jnp.array(numbers)[jnp.argmin(finite)])


def all_finite(tree: Any) -> jax.Array:
    """Whether every number of a pytree of arrays is finite [], bool."""
    return jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(tree)]).all()
