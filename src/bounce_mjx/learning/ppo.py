"""Proximal policy optimisation, read from top to bottom: collect -> advantages -> update.

`make_trainer` gives two pure functions over one pytree of state: `init(key)` and
`run(state, num_iterations)`. Inside `run` everything is a `scan`; nothing returns to Python.
With a gru, the update unrolls the policy over the rollout of each environment, from its memory
before the rollout.
Source: Schulman et al., Proximal Policy Optimization Algorithms (2017).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from bounce_mjx.errors import UserError
from bounce_mjx.gpu.availability import has_kernels
from bounce_mjx.gpu.rows import pack, pack_steps, unpack
from bounce_mjx.learning import forward_kernel, minibatch_kernel, statistics
from bounce_mjx.learning.advantages import generalized_advantages
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.gaussian import Gaussian
from bounce_mjx.learning.gradients import MinibatchGradients
from bounce_mjx.learning.metrics import (
    Metrics,
    matching_metrics,
    rollout_metrics,
    step_metrics,
)
from bounce_mjx.learning.policy import (
    Memory,
    Outputs,
    Policy,
    cast_hidden_layers,
    forget,
    make_networks,
    respond,
    respond_in_sequence,
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
    memory: Memory = ()
    """Memory of the policy network, each array [H, B]."""


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
    first_memory: Memory
    """Memory of the policy network before the first step, each array [H, B]."""
    last_memory: Memory
    """Memory after the last step."""


class Samples(NamedTuple):
    """Data of an update: G groups of M samples (`num_groups`). With a gru a sample is a sequence,
    the whole rollout of one environment, and arrays have the T steps as third axis."""

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
    memory: Memory = ()
    """Memory of the policy network before each sequence, each array [G, M, H]."""
    starts: jax.Array | None = None
    """Whether a step of a sequence is the first one of an episode [G, M, T], bool."""


class Trainer(NamedTuple):
    """Training as pure functions; `jax.jit` them (the second argument of `run` is static)."""

    init: Callable[[jax.Array], TrainingState]
    """key -> state; consumes the key."""
    run: Callable[[TrainingState, int], tuple[TrainingState, Metrics]]
    """(state, number of iterations I) -> (state, metrics, each [I]); the metric "fault" is the
    result of `first_fault`."""
    has_products: bool
    """Whether XLA computes the networks' matrix products in `run`, and not the GPU kernels."""


def make_trainer(config: PPOConfig, env: Env, episode_steps: int, num_devices: int = 1) -> Trainer:
    """Builds the trainer of an environment whose episodes are truncated at `episode_steps`.

    Args:
      num_devices: devices that share the environments.

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
    optimizer = optax.chain(_clip_by_norm(config.max_grad_norm), optax.scale_by_adam(eps=1e-5))

    kernel_sizes = minibatch_kernel.Sizes(env.observation_size, env.action_size)
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

    def policy_apply(params: Params, inputs: jax.Array, memory: Memory) -> tuple[Gaussian, Memory]:
        observation = inputs[..., : env.observation_size]
        return respond(networks.policy_network, params.policy, observation, memory)

    def distribution_of(params: Params, samples: Samples) -> Gaussian:
        """Distributions of the samples' actions."""
        if samples.starts is None:
            return policy_apply(params, samples.inputs, ())[0]
        observation = samples.inputs[..., : env.observation_size]
        return respond_in_sequence(
            networks.policy_network, params.policy, observation, samples.memory, samples.starts
        )

    def value_apply(params: Params, inputs: jax.Array) -> jax.Array:
        return networks.value_network.apply(params.value, inputs)

    def has_gradient_kernel() -> bool:
        return has_kernels() and minibatch_kernel.supports(config, num_inputs, env.action_size)

    def has_output_kernel() -> bool:
        return has_gradient_kernel() and forward_kernel.supports(config.num_envs)

    def outputs_of(params: Params) -> Outputs:
        if has_output_kernel():
            return forward_kernel.kernel_outputs(kernel_sizes, params)
        params = cast_params(params)
        return Outputs(
            lambda inputs, memory: policy_apply(params, cast_inputs(inputs), memory),
            lambda inputs: value_apply(params, cast_inputs(inputs)),
        )

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
            memory=_transposed(networks.policy_network.start_memory((config.num_envs,))),
        )

    def collect(state: TrainingState, key: jax.Array) -> tuple[Collection, Metrics]:
        """Runs the policy for T steps."""
        respond_to, normalizer = outputs_of(state.params).distribution, state.statistics.normalizer

        first_inputs = make_inputs(vector.observe(state.env), state.env.env.metrics)

        def one_step(carry, draws):
            env_state, timeout_inputs, memory = unpack(carry)
            noise, fresh = draws
            raw_inputs = make_inputs(vector.observe(env_state), env_state.env.metrics)
            inputs = normalize(raw_inputs, normalizer)
            distribution, memory = respond_to(inputs, _transposed(memory))
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
            memory = _transposed(forget(memory, result.terminated | result.truncated))
            return pack((env_state, timeout_inputs, memory)), (pack(step_of_rollout), pack(metrics))

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
        carry = pack((state.env, first_inputs.T, state.memory))
        carry, (steps, metrics) = jax.lax.scan(
            one_step, carry, (noise, pack_steps(fresh, num_devices))
        )
        env_state, timeout_inputs, memory = unpack(carry)
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
            first_memory=state.memory,
            last_memory=memory,
        )
        return collection, rollout_metrics(unpack(metrics))

    def prepare(params: Params, collection: Collection) -> Samples:
        """Computes values and advantages of the rollout, and groups its samples."""
        rollout = collection.rollout
        ends = jnp.stack([collection.last_inputs, collection.timeout_inputs])
        values = outputs_of(params).values(jnp.concatenate([rollout.inputs, ends]))
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
        if config.network == "mlp":
            return jax.tree.map(lambda x: group(x, groups), samples)
        ended = rollout.terminated | rollout.truncated
        # The memory before the first step is already empty where an episode starts there.
        starts = jnp.concatenate([jnp.zeros_like(ended[:1]), ended[:-1]])
        samples = jax.tree.map(
            lambda x: group_sequences(x, groups), samples._replace(starts=starts)
        )
        first_memory = _transposed(collection.first_memory)
        return samples._replace(
            memory=jax.tree.map(lambda x: x.reshape(groups, -1, x.shape[-1]), first_memory)
        )

    def loss(params: Params, samples: Samples) -> tuple[jax.Array, Metrics]:
        params = cast_params(params)
        distribution = distribution_of(params, samples)
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

    def xla_gradients(unravel: Callable[[jax.Array], Params]) -> MinibatchGradients:
        """Gradients by XLA, with the parameters in one array, so that one kernel clips the gradient
        and one takes the step."""

        def shuffle(samples: Samples, order: jax.Array, mean: jax.Array, deviation: jax.Array):
            return samples, (jnp.moveaxis(order, 1, 0), mean, deviation)

        def gradient(flat_params: jax.Array, _, shuffled, index: jax.Array):
            samples, minibatches = shuffled
            order, mean, deviation = (x[index] for x in minibatches)
            batch = jax.tree.map(lambda x: jax.vmap(lambda x, i: x[i])(x, order), samples)
            batch = batch._replace(advantage=(batch.advantage - mean) / (deviation + 1e-8))
            # With the groups as an axis of their own, XLA transposes the layers' outputs on a CPU.
            batch = jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), batch)
            gradient, metrics = jax.grad(lambda flat: loss(unravel(flat), batch), has_aux=True)(
                flat_params
            )
            return gradient, metrics | {"loss/gradient_norm": optax.tree.norm(gradient)}

        return MinibatchGradients(
            lambda x: ravel_pytree(x)[0], unravel, lambda _: (), shuffle, gradient
        )

    def make_gradients(params: Params) -> MinibatchGradients:
        if has_gradient_kernel():
            return minibatch_kernel.kernel_gradients(config, kernel_sizes, params)
        return xla_gradients(ravel_pytree(params)[1])

    def update(state: TrainingState, samples: Samples, key: jax.Array):
        """Several epochs of minibatch steps."""
        limit = max_learning_rate(config, state.iteration)
        gradients, unravel = make_gradients(state.params), ravel_pytree(state.params)[1]

        def epoch(carry, epoch_key):
            keys = jax.random.split(epoch_key, groups)
            size = samples.log_prob.shape[1]
            order = jax.vmap(lambda key: random_order(key, size))(keys)
            order = order.reshape((groups, config.num_minibatches, -1))
            # Mean and deviation of all minibatches at once: on several devices each reduction is a
            # message, and every minibatch already has one for its gradient.
            advantage = jax.vmap(lambda x, i: x[i])(samples.advantage, order)
            axes = (0, *range(2, advantage.ndim))
            mean, deviation = jnp.mean(advantage, axis=axes), jnp.std(advantage, axis=axes)
            shuffled = gradients.shuffle(samples, order, mean, deviation)

            def step(index, carry):
                (params, copies, optimizer_state, learning_rate), all_metrics = carry
                gradient, metrics = gradients.gradient(params, copies, shuffled, index)
                direction, optimizer_state = optimizer.update(
                    gradient, optimizer_state, params, norm=metrics["loss/gradient_norm"]
                )
                params = jax.tree.map(lambda x, d: x - learning_rate * d, params, direction)
                learning_rate = adapt_learning_rate(
                    config, learning_rate, metrics["policy/kl"], limit
                )
                row = jnp.stack([metrics[name] for name in _MINIBATCH_METRICS])
                carry = params, gradients.copy(params), optimizer_state, learning_rate
                return carry, all_metrics.at[index].set(row)

            # Not `scan`: on a GPU each slice of its inputs and each result costs a kernel.
            shape = (config.num_minibatches, len(_MINIBATCH_METRICS))
            all_metrics = jnp.zeros(shape, advantage.dtype)
            return jax.lax.fori_loop(0, config.num_minibatches, step, (carry, all_metrics))

        # Between updates the optimizer's moments are one flat array, whichever implementation
        # computes the gradients.
        moments = jax.tree.map(
            lambda x: gradients.pack(unravel(x)) if x.ndim else x, state.optimizer
        )
        params = gradients.pack(state.params)
        carry = (params, gradients.copy(params), moments, state.learning_rate)
        (params, _, moments, learning_rate), all_metrics = jax.lax.scan(
            epoch, carry, jax.random.split(key, config.num_epochs)
        )
        optimizer_state = jax.tree.map(
            lambda x, packed: ravel_pytree(gradients.unpack(packed))[0] if x.ndim else packed,
            state.optimizer,
            moments,
        )
        metrics = dict(zip(_MINIBATCH_METRICS, jnp.moveaxis(all_metrics, -1, 0), strict=True))
        means = {name: jnp.mean(value) for name, value in metrics.items()}
        means["policy/kl"] = jnp.mean(metrics["policy/kl"][-1])
        return (gradients.unpack(params), optimizer_state, learning_rate), means, metrics

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
            memory=collection.last_memory,
        )
        metrics |= losses | {"policy/learning_rate": learning_rate, "fault": fault}
        return state, metrics

    def run(state: TrainingState, num_iterations: int) -> tuple[TrainingState, Metrics]:
        def packed_iteration(state: TrainingState, _) -> tuple[TrainingState, Metrics]:
            state, metrics = iteration(state._replace(env=unpack(state.env)))
            return state._replace(env=pack(state.env)), pack(metrics)

        if has_gradient_kernel():
            minibatch_kernel.compile_ahead(config, kernel_sizes, state.iteration)
        state = state._replace(env=pack(state.env))
        state, metrics = jax.lax.scan(packed_iteration, state, length=num_iterations)
        return state._replace(env=unpack(state.env)), unpack(metrics)

    return Trainer(init, run, not has_output_kernel())


def population(trainer: Trainer) -> Trainer:
    """A trainer of S independent trainings: keys [S, 2] -> states with S as the first axis of every
    array; metrics are [S, I]."""

    def run(states: TrainingState, num_iterations: int) -> tuple[TrainingState, Metrics]:
        return jax.vmap(lambda state: trainer.run(state, num_iterations))(states)

    return Trainer(jax.vmap(trainer.init), run, trainer.has_products)


def num_groups(config: PPOConfig) -> int:
    """Number of equal groups of environments, a power of two.

    Samples are shuffled within their group, and every minibatch takes equally many from each group.
    A device that holds whole groups therefore shuffles only its own samples, and the training does
    not depend on the number of devices.
    """
    samples = config.num_envs if config.network == "gru" else config.batch_steps
    groups = max(_MIN_GROUPS, 1 << (config.num_envs // _GROUP_ENVS).bit_length() >> 1)
    while config.num_envs % groups or (samples // groups) % config.num_minibatches:
        groups //= 2
    return groups


def random_order(key: jax.Array, size: int) -> jax.Array:
    """A random permutation of 0 ... `size` - 1 [size], int32; consumes the key.

    `jax.random.permutation` sorts pairs of a random number and an index, which takes five times as
    long on a CPU as one number with the index in its low bits. In the rare case of two equal random
    numbers the smaller index comes first.
    """
    low_bits = (size - 1).bit_length()
    numbers = jax.random.bits(key, (size,), jnp.uint32) >> low_bits << low_bits
    ordered = jnp.sort(numbers | jnp.arange(size, dtype=jnp.uint32))
    return (ordered & jnp.uint32((1 << low_bits) - 1)).astype(jnp.int32)


def group(x: jax.Array, groups: int) -> jax.Array:
    """Deals samples [T, B, ...] into groups of environments [G, T * B / G, ...]."""
    length, batch, *rest = x.shape
    x = jnp.moveaxis(x.reshape((length, groups, batch // groups, *rest)), 1, 0)
    return x.reshape((groups, length * batch // groups, *rest))


def group_sequences(x: jax.Array, groups: int) -> jax.Array:
    """Deals the steps [T, B, ...] of environments into groups of sequences [G, B / G, T, ...]."""
    length, batch, *rest = x.shape
    return jnp.moveaxis(x, 0, 1).reshape((groups, batch // groups, length, *rest))


def _clip_by_norm(max_norm: float) -> optax.GradientTransformationExtraArgs:
    """`optax.clip_by_global_norm` for a norm that is already known, with the same state."""

    def update(gradient: Any, state: Any, params: Any = None, *, norm: jax.Array):
        del params
        clipped = jax.tree.map(
            lambda x: jnp.where(norm < max_norm, x, x / norm * max_norm), gradient
        )
        return clipped, state

    return optax.GradientTransformationExtraArgs(lambda params: optax.EmptyState(), update)


def _transposed(memory: Memory) -> Memory:
    return jax.tree.map(jnp.transpose, memory)


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
