"""PureJaxRL's loop in small, with its names: collect, advantages and update in one `scan`.

`python examples/purejaxrl.py` needs only the core package. The algorithm is advantage actor-critic,
with one gradient step for each rollout. It shows the form and prints a tenth of the mean
reward of each update; in these 500 updates it does not learn to bounce.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn

from bounce_mjx.adapters.gymnax_env import EnvState, PureJaxRLBounceBall

GAMMA = 0.98
GAE_LAMBDA = 0.95
ACTION_STD = 0.3
LEARNING_RATE = 3e-4
# A reward is up to 12 a step, which would be large for the value network.
REWARD_SCALE = 0.1

env = PureJaxRLBounceBall()
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


def env_step(runner_state: RunnerState, key: jax.Array) -> tuple[RunnerState, Transition]:
    """Acts once in every environment; consumes the key."""
    action_key, step_key = jax.random.split(key)
    mean, value = actor_critic(runner_state.params, runner_state.last_obs)
    action = mean + ACTION_STD * jax.random.normal(action_key, mean.shape)
    step_keys = jax.random.split(step_key, len(mean))
    obs, env_state, reward, done, _ = jax.vmap(env.step)(step_keys, runner_state.env_state, action)
    transition = Transition(
        obs=runner_state.last_obs,
        action=action,
        value=value,
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


def loss_fn(
    params: Any, traj_batch: Transition, advantages: jax.Array, targets: jax.Array
) -> jax.Array:
    """Of the policy and of the values []; `targets` [T, B] are what the values should be."""
    mean, value = actor_critic(params, traj_batch.obs)
    # Up to a constant, which has no gradient.
    deviation = (traj_batch.action - mean) / ACTION_STD
    log_prob = -0.5 * jnp.sum(jnp.square(deviation), axis=-1)
    normalized = (advantages - advantages.mean()) / (advantages.std() + 1e-6)
    actor_loss = -log_prob * normalized
    value_loss = 0.5 * jnp.square(value - targets)
    return jnp.mean(actor_loss + value_loss)


def main(num_envs: int = 512, rollout: int = 32, updates: int = 500) -> list[float]:
    """Trains; the mean scaled reward of each update.

    Args:
      rollout: steps of each environment in an update.
    """

    def update_step(runner_state: RunnerState, key: jax.Array) -> tuple[RunnerState, jax.Array]:
        step_keys = jax.random.split(key, rollout)
        runner_state, traj_batch = jax.lax.scan(env_step, runner_state, step_keys)
        _, last_val = actor_critic(runner_state.params, runner_state.last_obs)
        advantages = calculate_gae(traj_batch, last_val)
        targets = advantages + traj_batch.value
        grads = jax.grad(loss_fn)(runner_state.params, traj_batch, advantages, targets)
        changes, opt_state = tx.update(grads, runner_state.opt_state)
        params = optax.apply_updates(runner_state.params, changes)
        runner_state = runner_state._replace(params=params, opt_state=opt_state)
        return runner_state, traj_batch.reward.mean()

    reset_key, init_key, train_key = jax.random.split(jax.random.key(0), 3)
    obs, env_state = jax.vmap(env.reset)(jax.random.split(reset_key, num_envs))
    params = network.init(init_key, obs)
    runner_state = RunnerState(
        params=params, opt_state=tx.init(params), last_obs=obs, env_state=env_state
    )
    update_keys = jax.random.split(train_key, updates)
    _, mean_rewards = jax.lax.scan(update_step, runner_state, update_keys)
    return mean_rewards.tolist()


if __name__ == "__main__":
    print(main())
