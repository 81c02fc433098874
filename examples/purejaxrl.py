"""PureJaxRL's loop in small: collect, advantages and update in one `scan`, on its own interface.

`python examples/purejaxrl.py` needs only the core package.
"""

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from jax import lax

from bounce_mjx.adapters.gymnax_env import PureJaxRLBounceBall

GAMMA, LAMBDA, STD = 0.98, 0.95, 0.3


def main(num_envs: int = 512, rollout: int = 32, updates: int = 500) -> list[float]:
    """Trains by advantage actor-critic; the mean reward of each update."""
    env, adam = PureJaxRLBounceBall(), optax.adam(3e-4)
    net = nn.Sequential([nn.Dense(128), nn.tanh, nn.Dense(env.num_actions + 1)])

    def act(carry, key):
        params, observation, state = carry
        mean, value = jnp.split(net.apply(params, observation), [env.num_actions], axis=-1)
        action = mean + STD * jax.random.normal(key, mean.shape)
        keys = jax.random.split(key, num_envs)
        following, state, reward, done, _ = jax.vmap(env.step)(keys, state, action)
        return (params, following, state), (observation, action, value[:, 0], 0.1 * reward, done)

    def accumulate(carry, sample):
        (advantage, following), (value, reward, done) = carry, sample
        delta = reward + GAMMA * following * (1.0 - done) - value
        advantage = delta + GAMMA * LAMBDA * (1.0 - done) * advantage
        return (advantage, value), advantage

    def loss(params, observation, action, advantage, target):
        output = net.apply(params, observation)
        log_prob = -0.5 * jnp.sum(((action - output[..., :-1]) / STD) ** 2, axis=-1)
        scaled = (advantage - advantage.mean()) / (advantage.std() + 1e-6)
        return jnp.mean(0.5 * (output[..., -1] - target) ** 2 - log_prob * scaled)

    def update(carry, key):
        params, moments, *begin = carry
        keys = jax.random.split(key, rollout)
        (_, *end), (*seen, value, reward, done) = lax.scan(act, (params, *begin), keys)
        start = (jnp.zeros(num_envs), net.apply(params, end[0])[:, -1])
        _, advantage = lax.scan(accumulate, start, (value, reward, done), reverse=True)
        gradient = jax.grad(loss)(params, *seen, advantage, advantage + value)
        change, moments = adam.update(gradient, moments)
        return (optax.apply_updates(params, change), moments, *end), reward.mean()

    reset_key, init_key, key = jax.random.split(jax.random.key(0), 3)
    begin = jax.vmap(env.reset)(jax.random.split(reset_key, num_envs))
    params = net.init(init_key, begin[0])
    start = (params, adam.init(params), *begin)
    return lax.scan(update, start, jax.random.split(key, updates))[1].tolist()


if __name__ == "__main__":
    print(main())
