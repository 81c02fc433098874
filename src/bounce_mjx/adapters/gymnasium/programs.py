"""B episodes on JAX that start and end separately, and their compiled functions.

Each environment has its own stream of random numbers, so that it samples the same episodes in a
batch of any size. Batches of equal configs and sizes share their programs.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.env.env import Env, State
from bounce_mjx.training.setup import cache_compilations
from bounce_mjx.world.config import WorldConfig


class Episodes(NamedTuple):
    """State of the B episodes."""

    env: State
    """Environment states, the batch last in every array."""
    length: jax.Array
    """Steps since the reset [B], int32."""
    key: jax.Array
    """Key of each environment's later resets [..., B]."""


class Step(NamedTuple):
    """Result of one step of B environments."""

    observation: jax.Array
    """Observation for the next action [B, N]."""
    final_observation: jax.Array
    """Observation after the step, before any reset [B, N]."""
    reward: jax.Array
    """Reward [B]; 0 where the step only reset the environment."""
    terminated: jax.Array
    """Whether the task ended the episode [B], bool."""
    truncated: jax.Array
    """Whether the time limit ended the episode [B], bool."""
    metrics: jax.Array
    """The environment's metrics in the order of their names [M, B]."""


class Programs:
    """The functions of `Episodes`, compiled for one config and number of environments."""

    def __init__(self, config: WorldConfig):
        cache_compilations()
        self.task = Env(config)
        self.start = jax.jit(self._start)
        self.step = jax.jit(self._step, donate_argnums=0)

    def _start(
        self,
        episodes: Episodes | None,
        mask: jax.Array,
        seeds: jax.Array,
        seeded: jax.Array,
        commands: dict[str, jax.Array],
    ) -> Episodes:
        """New episodes where the mask [B] is true; `episodes` is None before the first ones.

        Args:
          seeds: [B]; where `seeded` [B] is false, the environment continues its random numbers.
          commands: each [B]; NaN samples one.
        """
        keys = jax.vmap(jax.random.PRNGKey, out_axes=-1)(seeds)
        if episodes is not None:
            keys = jnp.where(seeded, keys, episodes.key)
        keys, now = jax.vmap(jax.random.split, -1, -1)(keys)

        def reset_one(key: jax.Array, commands: dict[str, jax.Array]) -> State:
            ranges = self.task.ranges()
            for name, own in self.task.config.commands.items():
                ends, given = (own.low, own.high), commands[name]
                ranges[name] = tuple(jnp.where(jnp.isnan(given), end, given) for end in ends)
            return self.task.reset(key, ranges)

        env = jax.vmap(reset_one, -1, -1)(now, commands)
        started = Episodes(env, jnp.zeros(seeds.shape, jnp.int32), keys)
        return started if episodes is None else _choose(mask, started, episodes)

    def _step(
        self,
        episodes: Episodes,
        actions: jax.Array,
        limit: jax.Array,
        reset_before: jax.Array,
        reset_after: jax.Array,
    ) -> tuple[Episodes, Step]:
        """Advances every environment under the actions [B, n].

        Args:
          limit: time limit of an episode in steps [].
          reset_before: environments that start a new episode instead of a step [B], bool.
          reset_after: whether an ended episode is followed by a new one in the same step [].
        """
        keys, now = jax.vmap(jax.random.split, -1, -1)(episodes.key)
        fresh = jax.vmap(self.task.reset, -1, -1)(now)
        stepped = jax.vmap(self.task.step, -1, -1)(episodes.env, actions.T)
        length = episodes.length + 1
        terminated = (stepped.done > 0) & ~reset_before
        # The limit counts even if the task ended the episode too, as in Gymnasium's TimeLimit.
        truncated = (length >= limit) & ~reset_before
        after = _choose(
            reset_before | (reset_after & (terminated | truncated)),
            Episodes(fresh, jnp.zeros_like(length), keys),
            Episodes(stepped, length, episodes.key),
        )
        return after, Step(
            observation=after.env.obs.T.astype(jnp.float32),
            final_observation=stepped.obs.T.astype(jnp.float32),
            reward=jnp.where(reset_before, 0.0, stepped.reward),
            terminated=terminated,
            truncated=truncated,
            metrics=jnp.stack([stepped.metrics[name] for name in sorted(stepped.metrics)]),
        )


def shared_programs(config: WorldConfig) -> Programs:
    """The programs of a config."""
    # An edited file is another model.
    mjcf = config.mjcf
    return _programs(config, mjcf.stat().st_mtime_ns if mjcf and mjcf.exists() else None)


@functools.lru_cache(maxsize=32)
def _programs(config: WorldConfig, edited: int | None) -> Programs:
    del edited
    return Programs(config)


def _choose(mask: jax.Array, chosen: Episodes, other: Episodes) -> Episodes:
    """The episodes `chosen` where the mask [B] is true, and the others elsewhere."""
    return jax.tree.map(lambda a, b: jnp.where(mask, a, b), chosen, other)
