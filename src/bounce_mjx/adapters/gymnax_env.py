"""The environment with the interface of gymnax, which PureJaxRL also uses; only the spaces need
gymnax.

The functions are pure and take one environment: apply `jax.vmap` to batch them.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from bounce_mjx.deploy.environments import refuse_warmup
from bounce_mjx.env.env import Env, State
from bounce_mjx.errors import needed


@struct.dataclass
class EnvParams:
    """Parameters of the environment."""

    max_steps_in_episode: int | jax.Array
    """Time limit in control steps."""


@struct.dataclass
class EnvState:
    """State of one environment."""

    env: State
    time: jax.Array
    """Control steps since the reset [], int32."""


class GymnaxTaskEnv:
    """One environment in the form of gymnax 1.x; an ended episode is reset within the step."""

    name = "BounceBall"
    """Name of the environment."""

    def __init__(self, env: Env):
        """Wraps an environment, such as from `environment`.

        Raises:
          UserError: it has a warm-up.
        """
        refuse_warmup(env.config.randomization, self.name)
        self.core = env
        """The `Env` in it."""
        self.default_params = EnvParams(self.core.config.episode_steps)
        """The time limit of the settings."""
        self.num_actions = self.core.action_size
        """Length of the action vector."""

    def action_space(self, params: EnvParams | None = None) -> Any:
        """The space of the actions."""
        return _box(1.0, self.core.action_size)

    def observation_space(self, params: EnvParams | None = None) -> Any:
        """The space of the observations, which has no limits."""
        return _box(jnp.inf, self.core.observation_size)

    @functools.partial(jax.jit, static_argnames="self")
    def reset(self, key: jax.Array, params: EnvParams | None = None) -> tuple[jax.Array, EnvState]:
        """Starts an episode; consumes the key.

        Returns:
          The observation [N] and the state.
        """
        state = self._start(key)
        return state.env.obs, state

    @functools.partial(jax.jit, static_argnames="self")
    def step(
        self,
        key: jax.Array,
        state: EnvState,
        action: jax.Array,
        params: EnvParams | None = None,
    ) -> tuple[jax.Array, EnvState, jax.Array, jax.Array, jax.Array, dict[str, Any]]:
        """Advances one control step; consumes the key, for the reset of an ended episode.

        Args:
          action: [A].

        Returns:
          The observation [N] for the next action, the state, the reward [], whether the task ended
          the episode [], whether only the time limit ended it [], and an info: both ends, the
          `final_observation` [N] before any reset, and the metrics of the step.
        """
        limit = (params or self.default_params).max_steps_in_episode
        stepped = self.core.step(state.env, action)
        time = state.time + 1
        terminated = stepped.done > 0
        # Never both, as in `env/vector.py`; gymnax's own environments may say both.
        truncated = (time >= limit) & ~terminated
        next_state = jax.tree.map(
            lambda new, old: jnp.where(terminated | truncated, new, old),
            self._start(key),
            EnvState(stepped, time),
        )
        info = stepped.metrics | {
            "terminated": terminated,
            "truncated": truncated,
            "final_observation": stepped.obs,
        }
        return next_state.env.obs, next_state, stepped.reward, terminated, truncated, info

    def _start(self, key: jax.Array) -> EnvState:
        # Apart from `reset`, which gymnax's GymnaxToVectorGymWrapper replaces.
        return EnvState(self.core.reset(key), jnp.zeros((), jnp.int32))


class PureJaxRLTaskEnv(GymnaxTaskEnv):
    """The same in the form of gymnax before 1.0, for which PureJaxRL is written."""

    def step(
        self,
        key: jax.Array,
        state: EnvState,
        action: jax.Array,
        params: EnvParams | None = None,
    ) -> tuple[jax.Array, EnvState, jax.Array, jax.Array, dict[str, Any]]:
        """As in `GymnaxTaskEnv`, but with one `done` [] for both ends. The info has only
        `terminated` and `truncated`, because PureJaxRL keeps that of every step of a training."""
        observation, state, reward, terminated, truncated, _ = super().step(
            key, state, action, params
        )
        info = {"terminated": terminated, "truncated": truncated}
        return observation, state, reward, terminated | truncated, info


def _box(limit: float, size: int) -> Any:
    with needed("gymnax", "gymnax"):
        from gymnax.environments.spaces import Box
    return Box(-limit, limit, (size,))
