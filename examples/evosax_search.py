"""Evosax: generations of linear policies, 1,024 of them side by side (`pip install evosax`).

It prints the mean return of each generation, which rises by half.
"""

import functools

import jax
import jax.numpy as jnp
import optax
from evosax.algorithms import Open_ES

from bounce_mjx import BounceBall

LEARNING_RATE = 0.02
NOISE_STD = 0.05
"""Of the candidates' weights."""

env = BounceBall()


def episode_return(weights: jax.Array, key: jax.Array, num_steps: int) -> jax.Array:
    """The sum [] of the rewards of an episode up to its end, or of this number of steps.

    Args:
      weights: of the observation and of a constant 1 in each action [A, N + 1].
      key: of the reset; consumed.
    """

    def step(carry, _):
        state, is_alive = carry
        action = jnp.tanh(weights @ jnp.append(state.obs, 1.0))
        state = env.step(state, action)
        reward = jnp.where(is_alive, state.reward, 0.0)
        # The environment goes on after the end; what it does then does not count.
        is_alive = is_alive & (state.done == 0.0)
        return (state, is_alive), reward

    start = (env.reset(key), jnp.ones((), bool))
    _, rewards = jax.lax.scan(step, start, length=num_steps)
    return jnp.sum(rewards)


def main(population: int = 1024, generations: int = 40, steps: int = 200) -> list[float]:
    """The mean return of each generation."""
    start = jnp.zeros((env.action_size, env.observation_size + 1))
    es = Open_ES(
        population_size=population,
        solution=start,
        optimizer=optax.adam(LEARNING_RATE),
        std_schedule=optax.constant_schedule(NOISE_STD),
    )
    params = es.default_params
    evaluate = functools.partial(episode_return, num_steps=steps)

    def generation(state, key):
        keys = jax.random.split(key, population + 2)
        key_ask = keys[0]
        key_tell = keys[1]
        episode_keys = keys[2:]
        candidates, state = es.ask(key_ask, state, params)
        returns = jax.vmap(evaluate)(candidates, episode_keys)
        # Evosax minimises.
        state, _ = es.tell(key_tell, candidates, -returns, state, params)
        return state, returns.mean()

    state = es.init(jax.random.key(0), start, params)
    generation_keys = jax.random.split(jax.random.key(1), generations)
    _, mean_returns = jax.lax.scan(generation, state, generation_keys)
    return mean_returns.tolist()


if __name__ == "__main__":
    for generation_number, mean_return in enumerate(main(), start=1):
        print(f"generation {generation_number}: {mean_return:.0f}")
