"""Evosax: a linear policy evolves on 1,024 environments (`pip install evosax`)."""

import jax
import jax.numpy as jnp
from evosax.algorithms import Open_ES

from bounce_mjx import BounceBall


def main(population: int = 1024, generations: int = 200, steps: int = 200) -> list[float]:
    """The best return of each generation."""
    env = BounceBall()
    zeros = jnp.zeros((env.action_size, env.observation_size + 1))
    search = Open_ES(population_size=population, solution=zeros)

    def episode_return(weights: jax.Array, key: jax.Array) -> jax.Array:
        def act(state, _):
            state = env.step(state, jnp.tanh(weights @ jnp.append(state.obs, 1.0)))
            return state, (state.reward, 1.0 - state.done)

        _, (rewards, alive) = jax.lax.scan(act, env.reset(key), length=steps)
        return jnp.sum(rewards * jnp.cumprod(alive))

    def generation(state, key: jax.Array):
        keys = jax.random.split(key, population + 2)
        weights, state = search.ask(keys[0], state, search.default_params)
        returns = jax.vmap(episode_return)(weights, keys[2:])
        state, _ = search.tell(keys[1], weights, -returns, state, search.default_params)
        return state, returns.max()

    state = search.init(jax.random.key(0), zeros, search.default_params)
    keys = jax.random.split(jax.random.key(1), generations)
    return jax.lax.scan(generation, state, keys)[1].tolist()


if __name__ == "__main__":
    print(main())
