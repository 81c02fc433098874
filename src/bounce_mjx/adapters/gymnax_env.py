"""The environment with the interface of gymnax, which PureJaxRL also uses; gymnax is not needed.

The functions are pure and take one environment: apply `jax.vmap` to batch them.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.config.validation import validate
from bounce_mjx.env.env import Env
from bounce_mjx.env.state import State
from bounce_mjx.task.task import Task
from bounce_mjx.tasks.registry import DEFAULT, task_config


class EnvParams(NamedTuple):
    """Parameters of the environment."""

    max_steps_in_episode: int | jax.Array
    """Time limit in control steps."""


class EnvState(NamedTuple):
    """State of one environment."""

    env: State
    time: jax.Array
    """Control steps since the reset [], int32."""


@dataclasses.dataclass(frozen=True)
class Box:
    """Arrays of one shape with entries from `low` to `high`."""

    low: float
    high: float
    shape: tuple[int, ...]
    dtype: Any = jnp.float32

    def sample(self, key: jax.Array) -> jax.Array:
        """A uniform draw of a bounded box."""
        return jax.random.uniform(key, self.shape, self.dtype, self.low, self.high)


class GymnaxBounceBall:
    """One environment in the form of gymnax 1.x; an ended episode is reset within the step."""

    name = "BounceBall"
    """Name of the environment."""

    def __init__(self, task: str | type[Task] = DEFAULT, **settings: Any):
        """Makes the environment.

        Args:
          task: its class, its name, or FILE.py:CLASS.
          settings: fields of the task's config, such as episode_seconds=30.

        Raises:
          UserError: a setting is wrong.
        """
        self.task = Env(validate(task_config(task), settings, self.name))
        self.default_params = EnvParams(self.task.config.episode_steps)
        """The time limit of the settings."""
        self.num_actions = self.task.action_size
        """Length of the action vector."""

    def action_space(self, params: EnvParams | None = None) -> Box:
        """The space of the actions."""
        return Box(-1.0, 1.0, (self.task.action_size,))

    def observation_space(self, params: EnvParams | None = None) -> Box:
        """The space of the observations, which has no limits."""
        return Box(-jnp.inf, jnp.inf, (self.task.observation_size,))

    def reset(self, key: jax.Array, params: EnvParams | None = None) -> tuple[jax.Array, EnvState]:
        """Starts an episode; consumes the key.

        Returns:
          The observation [N] and the state.
        """
        state = self.task.reset(key)
        return state.obs, EnvState(state, jnp.zeros((), jnp.int32))

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
          the episode [], whether only the time limit ended it [], and an info: the metrics of the
          step and the `final_observation` [N] before any reset.
        """
        limit = (params or self.default_params).max_steps_in_episode
        stepped = self.task.step(state.env, action)
        time = state.time + 1
        terminated = stepped.done > 0
        truncated = (time >= limit) & ~terminated
        _, fresh = self.reset(key)
        next_state = jax.tree.map(
            lambda new, old: jnp.where(terminated | truncated, new, old),
            fresh,
            EnvState(stepped, time),
        )
        info = stepped.metrics | {"final_observation": stepped.obs}
        return next_state.env.obs, next_state, stepped.reward, terminated, truncated, info


class PureJaxRLBounceBall(GymnaxBounceBall):
    """The same in the form of gymnax before 1.0, for which PureJaxRL is written."""

    def step(
        self,
        key: jax.Array,
        state: EnvState,
        action: jax.Array,
        params: EnvParams | None = None,
    ) -> tuple[jax.Array, EnvState, jax.Array, jax.Array, dict[str, Any]]:
        """As in `GymnaxBounceBall`, but with one `done` [] for both ends; the info also holds
        `terminated` and `truncated`."""
        observation, state, reward, terminated, truncated, info = super().step(
            key, state, action, params
        )
        info |= {"terminated": terminated, "truncated": truncated}
        return observation, state, reward, terminated | truncated, info
