"""PureJaxRL's loop in small: collect, advantages and update in one `scan`, on its own interface.

`python examples/purejaxrl.py` needs only the core package.
"""

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn

from bounce_mjx.adapters.gymnax_env import PureJaxRLBounceBall


class ActorCritic(nn.Module):
    """Mean of a Gaussian action [A], and the value []."""

    num_actions: int

    @nn.compact
    def __call__(self, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        hidden = nn.tanh(nn.Dense(64)(nn.tanh(nn.Dense(64)(observation))))
        return nn.Dense(self.num_actions)(hidden), nn.Dense(1)(hidden)[..., 0]


def main(num_envs: int = 512, rollout: int = 32, updates: int = 500) -> list[float]:
    """Trains by advantage actor-critic; the mean reward of each update."""
    env, gamma, lam, std = PureJaxRLBounceBall(), 0.98, 0.95, 0.3
    net, adam = ActorCritic(env.num_actions), optax.adam(3e-4)
    reset_key, key = jax.random.split(jax.random.key(0))
    observation, state = jax.vmap(env.reset)(jax.random.split(reset_key, num_envs))
    params = net.init(key, observation)

    def act(carry, key):
        params, observation, state = carry
        mean, value = net.apply(params, observation)
        action = mean + std * jax.random.normal(key, mean.shape)
        following, state, reward, done, _ = jax.vmap(env.step)(
            jax.random.split(key, num_envs), state, action
        )
        return (params, following, state), (observation, action, value, 0.1 * reward, done)

    def accumulate(carry, sample):
        advantage, following = carry
        value, reward, done = sample
        delta = reward + gamma * following * (1.0 - done) - value
        advantage = delta + gamma * lam * (1.0 - done) * advantage
        return (advantage, value), advantage

    def loss(params, observation, action, advantage, target):
        mean, value = net.apply(params, observation)
        log_prob = -0.5 * jnp.sum(((action - mean) / std) ** 2, axis=-1)
        scaled = (advantage - advantage.mean()) / (advantage.std() + 1e-6)
        return jnp.mean(0.5 * (value - target) ** 2 - log_prob * scaled)

    def update(carry, key):
        params, moments, observation, state = carry
        (_, observation, state), (seen, action, value, reward, done) = jax.lax.scan(
            act, (params, observation, state), jax.random.split(key, rollout)
        )
        last = net.apply(params, observation)[1]
        start = (jnp.zeros_like(last), last)
        _, advantage = jax.lax.scan(accumulate, start, (value, reward, done), reverse=True)
        gradient = jax.grad(loss)(params, seen, action, advantage, advantage + value)
        change, moments = adam.update(gradient, moments)
        return (optax.apply_updates(params, change), moments, observation, state), reward.mean()

    start = (params, adam.init(params), observation, state)
    keys = jax.random.split(key, updates)
    return jax.jit(lambda: jax.lax.scan(update, start, keys)[1])().tolist()


if __name__ == "__main__":
    print(main())
