"""Proximal policy optimisation, read from top to bottom: collect -> advantages -> update.

`make_trainer` gives two pure functions over one pytree of state: `init(key)` and
`run(state, num_iterations)`. Inside `run` everything is a `scan`; nothing returns to Python.
Sources: Schulman et al., Proximal Policy Optimization Algorithms (2017); Schulman et al.,
High-Dimensional Continuous Control Using Generalized Advantage Estimation (2016).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from brax.envs.base import Env
from brax.training.acme import running_statistics
from jax.flatten_util import ravel_pytree

from bounce_mjx.errors import UserError
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import (
    Policy,
    cast_hidden_layers,
    init_normalizer,
    make_networks,
    normalize,
)
from bounce_mjx.task import vector
from bounce_mjx.task.env import OBSERVATION_SIZE

# Factor by which one update may change the learning rate.
_LEARNING_RATE_FACTOR = 1.1

# Steps of the advantages' recursion that become one kernel on a GPU.
_ADVANTAGE_UNROLL = 32

# Environments are shuffled in so many groups, or in more of so many environments.
_FEW_GROUPS, _GROUP_ENVS = 64, 64

# What is checked to be finite, in the order in which an iteration computes it.
CHECKED = ("reward", "observation", "loss/value", "loss/policy", "gradient", "parameters")

Metrics = dict[str, jax.Array]


class Params(NamedTuple):
    """Parameters of the two networks."""

    policy: Any
    value: Any


class TrainingState(NamedTuple):
    """Everything that training goes on from."""

    params: Params
    optimizer: optax.OptState
    normalizer: running_statistics.RunningStatisticsState
    """Statistics [29 + K] of what the networks see: the observation and K critic metrics."""
    learning_rate: jax.Array
    """Current learning rate []."""
    env: vector.VectorState
    key: jax.Array
    """Random key of the next iteration."""
    iteration: jax.Array
    """Iterations done [], int."""


class Rollout(NamedTuple):
    """T steps of B environments."""

    seen: jax.Array
    """Normalised observation and critic metrics [T, B, 29 + K]."""
    action: jax.Array
    """As drawn, before clipping [T, B, 6]."""
    log_prob: jax.Array
    """Of the action [T, B]."""
    reward: jax.Array
    """Scaled [T, B]."""
    terminated: jax.Array
    """[T, B], bool."""
    truncated: jax.Array
    """[T, B], bool."""


class Collection(NamedTuple):
    """A rollout and what surrounds it."""

    env: vector.VectorState
    """Environments after the last step."""
    rollout: Rollout
    raw: jax.Array
    """What the rollout's `seen` is before its normalisation [T, B, 29 + K]."""
    normalizer: running_statistics.RunningStatisticsState
    """Statistics with those of the rollout."""
    last: jax.Array
    """What is seen after the last step, normalised [B, 29 + K]."""
    at_timeout: jax.Array
    """The same before each environment's reset by a time-out, if it had one [B, 29 + K]."""


class Samples(NamedTuple):
    """What the update learns from: G groups of N samples (`num_groups`)."""

    seen: jax.Array
    """Normalised observation and critic metrics [G, N, 29 + K], as the networks take them."""
    action: jax.Array
    """[G, N, 6]."""
    log_prob: jax.Array
    """[G, N]."""
    advantage: jax.Array
    """[G, N]."""
    value_target: jax.Array
    """[G, N]."""


@functools.partial(jax.tree_util.register_dataclass, data_fields=["columns"], meta_fields=["names"])
@dataclasses.dataclass(frozen=True)
class Packed:
    """Metrics in one array, as on a GPU each small array of a loop costs a kernel."""

    names: tuple[str, ...]
    columns: jax.Array
    """The metrics in the order of their names [..., M]."""

    @classmethod
    def of(cls, metrics: Metrics) -> "Packed":
        """Packs metrics of one shape [...]."""
        return cls(tuple(metrics), jnp.stack(list(metrics.values()), axis=-1))

    def metrics(self) -> Metrics:
        """The metrics, each [...]."""
        return dict(zip(self.names, jnp.moveaxis(self.columns, -1, 0), strict=True))


class Trainer(NamedTuple):
    """Training as pure functions; `jax.jit` them (the second argument of `run` is static)."""

    init: Callable[[jax.Array], TrainingState]
    """key -> state; consumes the key."""
    run: Callable[[TrainingState, int], tuple[TrainingState, Metrics]]
    """(state, number of iterations I) -> (state, metrics, each [I]); the metric "fault" tells what
    was not finite (`first_fault`)."""


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
    unknown = [name for name in config.critic_metrics if name not in known_metrics]
    if unknown:
        raise UserError(
            f"critic_metrics names {unknown[0]}, which the environment does not have; choose from "
            f"{', '.join(known_metrics)}"
        )
    networks = make_networks(config, env.observation_size, env.action_size)
    distribution = networks.parametric_action_distribution
    groups = num_groups(config)
    optimizer = optax.chain(
        optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_adam(eps=1e-5)
    )

    lowers = config.compute_dtype != "float32"

    def lower(seen: jax.Array) -> jax.Array:
        """Inputs of the networks in the type that the hidden layers are computed in."""
        return seen.astype(config.compute_dtype) if lowers else seen

    def lower_layers(params: Params) -> Params:
        """Parameters with the hidden layers in that type."""
        if not lowers:
            return params
        dtype = jnp.dtype(config.compute_dtype)
        return Params(*(cast_hidden_layers(config, network, dtype) for network in params))

    def policy_apply(params: Params, seen: jax.Array):
        observation = seen[..., : env.observation_size]
        return networks.policy_network.apply(None, params.policy, observation)

    def value_apply(params: Params, seen: jax.Array) -> jax.Array:
        return networks.value_network.apply(None, params.value, seen)

    def see(observation: jax.Array, metrics: Metrics) -> jax.Array:
        extra = [metrics[name][:, None] for name in config.critic_metrics]
        return jnp.concatenate([observation, *extra], axis=-1)

    def init(key: jax.Array) -> TrainingState:
        key, policy_key, value_key, env_key, clock_key = jax.random.split(key, 5)
        params = Params(
            networks.policy_network.init(policy_key), networks.value_network.init(value_key)
        )
        # brax starts the noise as a weakly typed number, with which `run` would compile again
        # for its own result.
        params = jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype), params)
        env_state = vector.reset(env, env_key, config.num_envs)
        # Episodes that all began together would all time out together.
        clock = jax.random.randint(clock_key, (config.num_envs,), 0, episode_steps)
        return TrainingState(
            params=params,
            optimizer=optimizer.init(ravel_pytree(params)[0]),
            normalizer=init_normalizer(env.observation_size + len(config.critic_metrics)),
            learning_rate=jnp.float32(config.learning_rate),
            env=env_state._replace(clock=clock),
            key=key,
            iteration=jnp.int32(0),
        )

    def collect(state: TrainingState, key: jax.Array) -> tuple[Collection, Metrics]:
        """Runs the policy for T steps."""
        params = lower_layers(state.params)

        def one_step(carry, inputs):
            env_state, at_timeout = carry
            noise, fresh = inputs
            raw = see(vector.observe(env_state), env_state.env.metrics)
            seen = normalize(raw, state.normalizer)
            logits = policy_apply(params, lower(seen))
            mean, standard_deviation = logits
            action = mean + standard_deviation * noise
            env_state, result = vector.step_with(env, env_state, action, fresh, episode_steps)
            at_timeout = jnp.where(
                result.truncated[:, None],
                see(result.final_observation, result.metrics),
                at_timeout,
            )
            step_of_rollout = Rollout(
                seen=seen,
                action=action,
                log_prob=distribution.log_prob(logits, action),
                reward=config.reward_scale * result.reward,
                terminated=result.terminated,
                truncated=result.truncated,
            )
            metrics = Packed.of(step_metrics(result, groups))
            return (env_state, at_timeout), (step_of_rollout, raw, metrics)

        # An environment times out at most once in a rollout, as no episode is shorter than it.
        first = see(vector.observe(state.env), state.env.env.metrics)
        noise_key, reset_key = jax.random.split(key)
        # All at once, as on a GPU each draw costs a kernel or two.
        shape = (config.rollout_length, config.num_envs, env.action_size)
        noise = jax.random.normal(noise_key, shape)
        fresh = jax.vmap(lambda key: vector.first_states(env, key, config.num_envs))(
            jax.random.split(reset_key, config.rollout_length)
        )
        (env_state, at_timeout), (rollout, raw, metrics) = jax.lax.scan(
            one_step, (state.env, first), (noise, fresh)
        )
        last = see(vector.observe(env_state), env_state.env.metrics)
        collection = Collection(
            env=env_state,
            rollout=rollout,
            raw=raw,
            normalizer=running_statistics.update(state.normalizer, raw),
            last=normalize(last, state.normalizer),
            at_timeout=normalize(at_timeout, state.normalizer),
        )
        return collection, rollout_metrics(metrics.metrics())

    def prepare(params: Params, collection: Collection) -> Samples:
        """Values the rollout and turns it into samples."""
        rollout, params = collection.rollout, lower_layers(params)
        after = jnp.stack([collection.last, collection.at_timeout])
        seen = lower(jnp.concatenate([rollout.seen, after]))
        values = value_apply(params, seen)
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
        # The next rollout acts on what the new statistics make of an observation, so that is what
        # the networks learn on: with the old ones the policy shifts whenever the statistics do.
        samples = Samples(
            seen=lower(normalize(collection.raw, collection.normalizer)),
            action=rollout.action,
            log_prob=rollout.log_prob,
            advantage=advantage,
            value_target=advantage + values[:-1],
        )
        return jax.tree.map(lambda x: group(x, groups), samples)

    def loss(params: Params, samples: Samples) -> tuple[jax.Array, Metrics]:
        params = lower_layers(params)
        logits = policy_apply(params, samples.seen)
        log_ratio = distribution.log_prob(logits, samples.action) - samples.log_prob
        ratio = jnp.exp(log_ratio)
        advantage = samples.advantage
        clipped = jnp.clip(ratio, 1.0 - config.clip_epsilon, 1.0 + config.clip_epsilon)
        policy_loss = -jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage))
        values = value_apply(params, samples.seen)
        value_loss = jnp.mean(jnp.square(values - samples.value_target))
        standard_deviation = logits[1]
        entropy = jnp.mean(
            jnp.sum(jnp.log(standard_deviation) + 0.5 * jnp.log(2.0 * jnp.pi * jnp.e), axis=-1)
        )
        total = policy_loss + config.value_cost * value_loss - config.entropy_cost * entropy
        return total, {
            "loss/policy": policy_loss,
            "loss/value": value_loss,
            "policy/entropy": entropy,
            # Schulman's low-variance estimate of KL(old || new).
            "policy/kl": jnp.mean(ratio - 1.0 - log_ratio),
            "policy/action_std": jnp.mean(standard_deviation),
        }

    def update(state: TrainingState, samples: Samples, key: jax.Array):
        """Several epochs of minibatch steps."""
        limit = max_learning_rate(config, state.iteration)

        # Gradients and parameters as one array: one kernel clips and one makes a step of Adam.
        flat_params, unravel = ravel_pytree(state.params)

        def minibatch(carry, chosen):
            params, optimizer_state, learning_rate = carry
            order, mean, deviation = chosen
            batch = jax.tree.map(lambda x: jax.vmap(lambda x, i: x[i])(x, order), samples)
            batch = batch._replace(advantage=(batch.advantage - mean) / (deviation + 1e-8))
            gradient, metrics = jax.grad(lambda flat: loss(unravel(flat), batch), has_aux=True)(
                params
            )
            direction, optimizer_state = optimizer.update(gradient, optimizer_state, params)
            params = params - learning_rate * direction
            learning_rate = adapt_learning_rate(config, learning_rate, metrics["policy/kl"], limit)
            metrics["loss/gradient_norm"] = jnp.linalg.norm(gradient)
            return (params, optimizer_state, learning_rate), Packed.of(metrics)

        def epoch(carry, epoch_key):
            keys = jax.random.split(epoch_key, groups)
            size = config.batch_steps // groups
            order = jax.vmap(lambda key: jax.random.permutation(key, size))(keys)
            order = order.reshape((groups, config.num_minibatches, -1))
            # The advantages of all minibatches are measured at once: on several devices each
            # measurement is a message, and there is one more in every minibatch anyhow.
            advantage = jax.vmap(lambda x, i: x[i])(samples.advantage, order)
            chosen = (
                jnp.moveaxis(order, 1, 0),
                jnp.mean(advantage, axis=(0, 2)),
                jnp.std(advantage, axis=(0, 2)),
            )
            return jax.lax.scan(minibatch, carry, chosen)

        carry = (flat_params, state.optimizer, state.learning_rate)
        (flat_params, optimizer_state, learning_rate), packed = jax.lax.scan(
            epoch, carry, jax.random.split(key, config.num_epochs)
        )
        metrics = packed.metrics()
        means = {name: jnp.mean(value) for name, value in metrics.items()}
        means["policy/kl"] = jnp.mean(metrics["policy/kl"][-1])
        return (unravel(flat_params), optimizer_state, learning_rate), means, metrics

    def iteration(state: TrainingState, _) -> tuple[TrainingState, Metrics]:
        key, collect_key, update_key = jax.random.split(state.key, 3)
        collection, metrics = collect(state, collect_key)
        samples = prepare(state.params, collection)
        (params, optimizer_state, learning_rate), losses, of_minibatches = update(
            state, samples, update_key
        )
        fault = first_fault(metrics["reward"], collection.normalizer, of_minibatches, params)
        state = TrainingState(
            params=params,
            optimizer=optimizer_state,
            normalizer=collection.normalizer,
            learning_rate=learning_rate,
            env=collection.env,
            key=key,
            iteration=state.iteration + 1,
        )
        metrics |= losses | {"policy/learning_rate": learning_rate, "fault": fault}
        return state, metrics

    def run(state: TrainingState, num_iterations: int) -> tuple[TrainingState, Metrics]:
        return jax.lax.scan(iteration, state, length=num_iterations)

    return Trainer(init, run)


def population(trainer: Trainer) -> Trainer:
    """The trainer of S independent trainings at once: keys [S, 2] -> states, their arrays with S
    as the first axis; metrics are [S, I]."""
    return Trainer(
        jax.vmap(trainer.init),
        lambda states, num_iterations: jax.vmap(lambda state: trainer.run(state, num_iterations))(
            states
        ),
    )


def num_groups(config: PPOConfig) -> int:
    """Number of equal groups that the environments are dealt into, a power of two.

    Samples are shuffled within their group, and every minibatch takes as many from each. So a
    device that holds whole groups shuffles its own samples alone, and as the groups do not depend
    on the devices, neither does the training.
    """
    groups = max(_FEW_GROUPS, 1 << (config.num_envs // _GROUP_ENVS).bit_length() >> 1)
    while config.num_envs % groups or (config.batch_steps // groups) % config.num_minibatches:
        groups //= 2
    return groups


def group(x: jax.Array, groups: int) -> jax.Array:
    """Deals samples [T, B, ...] into groups of environments [G, T * B / G, ...]."""
    length, batch, *rest = x.shape
    x = jnp.moveaxis(x.reshape((length, groups, batch // groups, *rest)), 1, 0)
    return x.reshape((groups, length * batch // groups, *rest))


def policy_of(state: TrainingState) -> Policy:
    """What acting needs of a training state, or of those of several seeds."""
    n = OBSERVATION_SIZE
    statistics = state.normalizer
    normalizer = statistics.replace(
        mean=statistics.mean[..., :n],
        std=statistics.std[..., :n],
        summed_variance=statistics.summed_variance[..., :n],
    )
    return Policy(normalizer, state.params.policy)


def generalized_advantages(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    truncated: jax.Array,
    discount: float,
    gae_lambda: float,
) -> jax.Array:
    """Generalised advantage estimation (Schulman et al. 2016, equation 16), all arrays [T, B].

    Args:
      next_value: value of the state that the step led to; at a time-out that of the old episode's
        last state, never of the new episode's first.
      terminated: no value follows the step.
      truncated: the value that follows counts, but no advantage flows back over the step.
    """
    delta = reward + discount * jnp.where(terminated, 0.0, next_value) - value
    carried = discount * gae_lambda * (~(terminated | truncated))

    def backward(advantage, step):
        delta, carried = step
        advantage = delta + carried * advantage
        return advantage, advantage

    _, advantages = jax.lax.scan(
        backward, jnp.zeros_like(delta[0]), (delta, carried), reverse=True, unroll=_ADVANTAGE_UNROLL
    )
    return advantages


def max_learning_rate(config: PPOConfig, iteration: jax.Array) -> jax.Array:
    """Upper limit of the learning rate []: from max_learning_rate to final_max_learning_rate in
    equal ratios over decay_steps. Without it the KL rule lets the rate grow when the policy
    hardly changes any more, and a late large step ruins it."""
    progress = jnp.minimum(1.0, iteration * (config.batch_steps / config.decay_steps))
    ratio = config.final_max_learning_rate / config.max_learning_rate
    return config.max_learning_rate * ratio**progress


def adapt_learning_rate(
    config: PPOConfig, learning_rate: jax.Array, kl: jax.Array, limit: jax.Array
) -> jax.Array:
    """Steers the KL divergence of an update towards target_kl (the adaptive rule of Schulman et
    al. 2017, section 4, applied to the learning rate)."""
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
    normalizer: running_statistics.RunningStatisticsState,
    of_minibatches: Metrics,
    params: Params,
) -> jax.Array:
    """Number [], from 1, of the one of `CHECKED` that was the first not to be finite in an
    iteration; 0 if all were.

    Args:
      reward: mean of the rollout [].
      normalizer: statistics with the rollout's observations.
      of_minibatches: metrics, each [epochs, minibatches].
      params: after the update.
    """
    in_minibatch = ("loss/value", "loss/policy", "loss/gradient_norm")
    flags = jnp.stack([jnp.isfinite(of_minibatches[n]).ravel() for n in in_minibatch], axis=-1)
    finite = jnp.concatenate(
        [
            jnp.stack([jnp.isfinite(reward), all_finite(normalizer)]),
            flags.ravel(),
            all_finite(params)[None],
        ]
    )
    numbers = [1, 2] + [3, 4, 5] * flags.shape[0] + [6]
    return jnp.where(finite.all(), 0, jnp.array(numbers)[jnp.argmin(finite)])


def all_finite(tree: Any) -> jax.Array:
    """Whether every number of a pytree of arrays is finite [], bool."""
    return jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(tree)]).all()


def step_metrics(result: vector.StepResult, groups: int) -> Metrics:
    """Means over each group of environments [G] of one step, and sums over the episodes in it that
    ended on the step."""
    ended = result.terminated | result.truncated
    means = result.metrics | {"reward": result.reward}
    totals = {
        "ended": ended,
        "return": jnp.where(ended, result.episode_return, 0.0),
        "length": jnp.where(ended, result.episode_length, 0),
        "bounces": jnp.where(ended, result.metrics["n_bounces"], 0.0),
        "apex_error": result.metrics["apex_error"],
        "bounced": result.metrics["bounced"],
        "non_finite": result.metrics["non_finite"],
    }
    # One array, as on a GPU each small one costs a kernel.
    rows = jnp.stack([x.astype(result.reward.dtype) for x in (means | totals).values()])
    sums = jnp.sum(rows.reshape(len(rows), groups, -1), axis=-1)
    count = result.reward.size // groups
    return {
        name: total if name in totals else total / count
        for name, total in zip(means | totals, sums, strict=True)
    }


def rollout_metrics(steps: Metrics) -> Metrics:
    """Metrics of a rollout from those of its steps and groups [T, G]. Where no episode ended (or
    no bounce happened), its means are not a number."""
    ended, bounced = jnp.sum(steps["ended"]), jnp.sum(steps["bounced"])
    rewards = {name: jnp.mean(v) for name, v in steps.items() if name.startswith("reward")}
    return rewards | {
        "episode/return": jnp.sum(steps["return"]) / ended,
        "episode/length": jnp.sum(steps["length"]) / ended,
        "episode/bounces": jnp.sum(steps["bounces"]) / ended,
        "episode/ended": ended,
        "task/apex_error": jnp.sum(steps["apex_error"]) / bounced,
        "task/ball_xy_error": jnp.mean(steps["ball_xy_error"]),
        "task/n_bounces": jnp.mean(steps["n_bounces"]),
        "task/non_finite": jnp.sum(steps["non_finite"]),
    }
