"""B episodes on JAX that start and end separately, and their compiled functions.

Each episode has its own random key, so that a seed starts the same one in a batch of any size.
Batches of equal environments share their programs, of which JAX keeps one for each size.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.env.env import Env, EnvState, State
from bounce_mjx.training.setup import cache_compilations
from bounce_mjx.world.config import WorldConfig


class Episodes(NamedTuple):
    """State of the B episodes. A step takes and returns few arrays, as each costs a microsecond."""

    state: EnvState
    """Environment states, the batch last in every array."""
    observation: jax.Array
    """Observations [N, B]."""
    metrics: jax.Array
    """The environment's metrics in the order of their names [M, B]."""
    length: jax.Array
    """Steps since the reset [B], int32."""


class Programs:
    """The functions of `Episodes`, compiled for one environment."""

    def __init__(self, env: Env):
        cache_compilations()
        self.core = env
        self.start = jax.jit(self._start)
        self.step = jax.jit(self._step, donate_argnums=0)

    @functools.cached_property
    def metric_names(self) -> tuple[str, ...]:
        """Names of the environment's metrics, sorted."""
        return tuple(sorted(jax.eval_shape(self.core.reset, jax.random.PRNGKey(0)).metrics))

    def _start(
        self,
        episodes: Episodes | None,
        mask: jax.Array,
        seeds: jax.Array,
        goals: dict[str, jax.Array],
    ) -> Episodes:
        """New episodes where the mask [B] is true; `episodes` is None before the first ones.

        Args:
          seeds: of the new episodes [B], uint32.
          goals: each [B]; NaN samples one.
        """

        def first_state(key: jax.Array, goals: dict[str, jax.Array]) -> State:
            ranges = self.core.ranges()
            for name, goal in self.core.config.goals.items():
                given = goals[name]
                is_free = jnp.isnan(given)
                low = jnp.where(is_free, goal.low, given)
                high = jnp.where(is_free, goal.high, given)
                ranges[name] = low, high
            return self.core.reset(key, ranges)

        states = jax.vmap(first_state, -1, -1)(_keys(seeds), goals)
        started = self._episodes(states, jnp.zeros(seeds.shape, jnp.int32))
        return started if episodes is None else _choose(mask, started, episodes)

    def _step(
        self,
        episodes: Episodes,
        actions: jax.Array,
        limit: jax.Array,
        seeds: jax.Array,
        reset_before: jax.Array,
        reset_after: jax.Array,
    ) -> tuple[Episodes, jax.Array]:
        """Advances every environment under the actions [B, n].

        Args:
          limit: time limit of an episode in steps [].
          seeds: of the episodes that start within this step [B], uint32.
          reset_before: environments that start a new episode instead of a step [B], bool.
          reset_after: whether an ended episode is followed by a new one in the same step [].

        Returns:
          The episodes, and the result as one array [2 N + 3 + M, B], because each transfer takes
          time: the observation for the next action, the one before any reset, the reward (0 where
          the step only reset the environment), whether the task ended the episode, whether the
          time limit did, and the metrics.
        """
        before = State(episodes.state, obs=None, reward=None, done=None)
        stepped = jax.vmap(self.core.step, -1, -1)(before, actions.T)
        length = episodes.length + 1
        terminated = (stepped.done > 0) & ~reset_before
        # The limit counts even if the task ended the episode too, as in Gymnasium's TimeLimit.
        truncated = (length >= limit) & ~reset_before
        continued = self._episodes(stepped, length)

        restarts = reset_before | (reset_after & (terminated | truncated))

        def restart() -> Episodes:
            states = jax.vmap(self.core.reset, -1, -1)(_keys(seeds))
            return _choose(restarts, self._episodes(states, jnp.zeros_like(length)), continued)

        after = jax.lax.cond(jnp.any(restarts), restart, lambda: continued)
        reward = jnp.where(reset_before, 0.0, stepped.reward)
        rows = [after.observation, stepped.obs, reward, terminated, truncated, continued.metrics]
        return after, jnp.vstack(rows)

    def _episodes(self, states: State, length: jax.Array) -> Episodes:
        metrics = jnp.stack([states.metrics[name] for name in sorted(states.metrics)])
        return Episodes(states.pipeline_state, states.obs, metrics, length)


def shared_programs(env: Env) -> Programs:
    """The programs of an environment, which those of equal settings share."""
    if not env.is_of_its_settings:
        return Programs(env)
    # An edited file is another model.
    mjcf = env.config.mjcf
    edited = mjcf.stat().st_mtime_ns if mjcf and mjcf.exists() else None
    return _programs(type(env), env.config, edited)


@functools.lru_cache(maxsize=32)
def _programs(kind: type[Env], config: WorldConfig, edited: int | None) -> Programs:
    del edited
    return Programs(kind(config))


def _keys(seeds: jax.Array) -> jax.Array:
    return jax.vmap(jax.random.PRNGKey, out_axes=-1)(seeds)


def _choose(mask: jax.Array, chosen: Episodes, other: Episodes) -> Episodes:
    """The episodes `chosen` where the mask [B] is true, and the others elsewhere."""
    return jax.tree.map(lambda a, b: jnp.where(mask, a, b), chosen, other)
