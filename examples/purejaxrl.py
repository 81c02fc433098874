"""PureJaxRL's loop in small, with its names: collect, advantages and update in one `scan`.

`python examples/purejaxrl.py` needs only the core package. The algorithm is PPO. It prints the mean
length of an episode in each tenth of the updates, in control steps: at the end, the ball stays up
about six times as long as at the start.
"""

import statistics
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn

from bounce_mjx import environment
from bounce_mjx.adapters.gymnax_env import EnvState, PureJaxRLTaskEnv

GAMMA = 0.98
GAE_LAMBDA = 0.95
ACTION_STD = 0.3
LEARNING_RATE = 1e-3
CLIP_EPS = 0.2
UPDATE_EPOCHS = 4
NUM_MINIBATCHES = 8
# A reward is up to 12 a step, which would be large for the value network.
REWARD_SCALE = 0.1

env = PureJaxRLTaskEnv(environment())
network = nn.Sequential([nn.Dense(128), nn.tanh, nn.Dense(env.num_actions + 1)])
tx = optax.adam(LEARNING_RATE)


class Transition(NamedTuple):
    """A step of B environments."""

    obs: jax.Array
    """Before the action [B, N]."""
    action: jax.Array
    """[B, A]."""
    value: jax.Array
    """Of the observation [B]."""
    log_prob: jax.Array
    """Of the action, up to a constant [B]."""
    reward: jax.Array
    """Scaled [B]."""
    done: jax.Array
    """Whether the step ended the episode [B], bool."""


class RunnerState(NamedTuple):
    """What an update passes on to the next one."""

    params: Any
    opt_state: optax.OptState
    last_obs: jax.Array
    """Of the environments now [B, N]."""
    env_state: EnvState
    """Of B environments."""


def actor_critic(params: Any, obs: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The mean actions [..., A] and the values [...] of observations [..., N]."""
    outputs = network.apply(params, obs)
    return outputs[..., :-1], outputs[..., -1]


def log_prob_of(mean: jax.Array, action: jax.Array) -> jax.Array:
    """The log-probabilities [...] of actions [..., A], up to a constant, which has no gradient."""
    return -0.5 * jnp.sum(jnp.square((action - mean) / ACTION_STD), axis=-1)


def env_step(runner_state: RunnerState, key: jax.Array) -> tuple[RunnerState, Transition]:
    """Acts once in every environment; consumes the key."""
    action_key, step_key = jax.random.split(key)
    mean, value = actor_critic(runner_state.params, runner_state.last_obs)
    action = mean + ACTION_STD * jax.random.normal(action_key, mean.shape)
    log_prob = log_prob_of(mean, action)
    step_keys = jax.random.split(step_key, len(mean))
    obs, env_state, reward, done, _ = jax.vmap(env.step)(step_keys, runner_state.env_state, action)
    transition = Transition(
        obs=runner_state.last_obs,
        action=action,
        value=value,
        log_prob=log_prob,
        reward=REWARD_SCALE * reward,
        done=done,
    )
    return runner_state._replace(last_obs=obs, env_state=env_state), transition


def calculate_gae(traj_batch: Transition, last_val: jax.Array) -> jax.Array:
    """The generalised advantages [T, B] of transitions [T, B, ...].

    Args:
      last_val: values [B] of the observations after the last transition.
    """

    def get_advantages(gae_and_next_value, transition):
        gae, next_value = gae_and_next_value
        # As in PureJaxRL, a time-out counts as an end, after which there is no value.
        goes_on = 1.0 - transition.done
        delta = transition.reward + GAMMA * next_value * goes_on - transition.value
        gae = delta + GAMMA * GAE_LAMBDA * goes_on * gae
        return (gae, transition.value), gae

    after_the_last = (jnp.zeros_like(last_val), last_val)
    _, advantages = jax.lax.scan(get_advantages, after_the_last, traj_batch, reverse=True)
    return advantages


def loss_fn(params: Any, traj_batch: Transition, gae: jax.Array, targets: jax.Array) -> jax.Array:
    """PPO's loss [] of N transitions; `targets` [N] are what the values should be."""
    mean, value = actor_critic(params, traj_batch.obs)
    ratio = jnp.exp(log_prob_of(mean, traj_batch.action) - traj_batch.log_prob)
    clipped = jnp.clip(ratio, 1.0 - CLIP_EPS, 1.0 + CLIP_EPS)
    gae = (gae - gae.mean()) / (gae.std() + 1e-8)
    loss_actor = -jnp.minimum(ratio * gae, clipped * gae)
    value_loss = 0.5 * jnp.square(value - targets)
    return jnp.mean(loss_actor + value_loss)


def main(num_envs: int = 512, rollout: int = 64, updates: int = 250) -> list[float]:
    """Trains; the mean number of steps for each end of an episode, in each update.

    Args:
      rollout: steps of each environment in an update.
    """
    batch_size = num_envs * rollout

    def update_minibatch(train_state: tuple, minibatch: tuple) -> tuple[tuple, None]:
        params, opt_state = train_state
        grads = jax.grad(loss_fn)(params, *minibatch)
        changes, opt_state = tx.update(grads, opt_state)
        return (optax.apply_updates(params, changes), opt_state), None

    def update_step(runner_state: RunnerState, key: jax.Array) -> tuple[RunnerState, jax.Array]:
        rollout_key, epochs_key = jax.random.split(key)
        step_keys = jax.random.split(rollout_key, rollout)
        runner_state, traj_batch = jax.lax.scan(env_step, runner_state, step_keys)
        _, last_val = actor_critic(runner_state.params, runner_state.last_obs)
        advantages = calculate_gae(traj_batch, last_val)
        targets = advantages + traj_batch.value
        batch = jax.tree.map(
            lambda x: x.reshape((batch_size, *x.shape[2:])), (traj_batch, advantages, targets)
        )

        def update_epoch(train_state: tuple, epoch_key: jax.Array) -> tuple[tuple, None]:
            order = jax.random.permutation(epoch_key, batch_size).reshape((NUM_MINIBATCHES, -1))
            minibatches = jax.tree.map(lambda x: x[order], batch)
            return jax.lax.scan(update_minibatch, train_state, minibatches)

        train_state = (runner_state.params, runner_state.opt_state)
        epoch_keys = jax.random.split(epochs_key, UPDATE_EPOCHS)
        (params, opt_state), _ = jax.lax.scan(update_epoch, train_state, epoch_keys)
        runner_state = runner_state._replace(params=params, opt_state=opt_state)
        return runner_state, traj_batch.done.sum()

    reset_key, init_key, train_key = jax.random.split(jax.random.key(0), 3)
    obs, env_state = jax.vmap(env.reset)(jax.random.split(reset_key, num_envs))
    params = network.init(init_key, obs)
    runner_state = RunnerState(
        params=params, opt_state=tx.init(params), last_obs=obs, env_state=env_state
    )
    update_keys = jax.random.split(train_key, updates)
    _, num_ends = jax.lax.scan(update_step, runner_state, update_keys)
    return (batch_size / jnp.maximum(num_ends, 1)).tolist()


if __name__ == "__main__":
    lengths = main()
    tenth = len(lengths) // 10
    for i in range(10):
        mean_length = statistics.harmonic_mean(lengths[i * tenth : (i + 1) * tenth])
        print(f"updates {i * tenth + 1} to {(i + 1) * tenth}: {mean_length:.0f} steps")
