"""The classes behind `gymnasium.make` and `gymnasium.make_vec("bounce_mjx/BounceBall-v0")`.

The arrays are NumPy arrays; `adapters/torch/gymnasium_env.py` has a vectorised environment with
tensors that stay on JAX's device. Keyword arguments are the settings of `EnvConfig`.
"""

import weakref
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.vector import AutoresetMode

from bounce_mjx.adapters.gymnasium.registration import ENV_ID
from bounce_mjx.config.validation import validate
from bounce_mjx.errors import UserError
from bounce_mjx.task import vector
from bounce_mjx.task.config import EnvConfig
from bounce_mjx.task.env import BounceBall, BounceState
from bounce_mjx.task.state import State
from bounce_mjx.viewers.offscreen import Renderer, choose_backend

_FRAMES_PER_SECOND = 50
_HEIGHT, _WIDTH = 480, 640


def action_space(task: BounceBall) -> gymnasium.spaces.Box:
    """The space of the actions of one environment."""
    return gymnasium.spaces.Box(-1.0, 1.0, (task.action_size,), np.float32)


def observation_space(task: BounceBall) -> gymnasium.spaces.Box:
    """The space of the observations of one environment."""
    return gymnasium.spaces.Box(-np.inf, np.inf, (task.observation_size,), np.float32)


class BounceBallEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One environment with the time limit of its config."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": _FRAMES_PER_SECOND}

    def __init__(self, render_mode: str | None = None, **settings: Any):
        """Makes the environment.

        Args:
          settings: fields of `EnvConfig`, such as target_height_range=(0.3, 0.8).

        Raises:
          UserError: a setting or the render mode is wrong, or there is no OpenGL library for
            rendering.
        """
        _check_render_mode(render_mode)
        self.task = BounceBall(validate(EnvConfig, settings, ENV_ID))
        self.metadata = self.metadata | {"render_fps": round(1.0 / self.task.dt)}
        self.render_mode = render_mode
        self.action_space = action_space(self.task)
        self.observation_space = observation_space(self.task)
        self._reset = jax.jit(self.task.reset)
        self._step = jax.jit(self.task.step)
        self._state: State | None = None
        self._length = 0
        self._pictures = Pictures(self.task) if render_mode else None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode: its first observation [N] and an empty info."""
        super().reset(seed=seed)
        self._state = self._reset(_key(self.np_random))
        self._length = 0
        return np.array(self._state.obs), {}

    def step(
        self, action: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advances one control step under the action [n].

        Returns:
          Observation [N], reward, terminated, truncated, and the environment's metrics.
        """
        self._state = self._step(self._state, np.asarray(action, np.float32))
        self._length += 1
        state = jax.device_get(self._state)
        terminated = bool(state.done)
        truncated = not terminated and self._length >= self.task.config.episode_steps
        metrics = {name: float(value) for name, value in state.metrics.items()}
        return np.array(state.obs), float(state.reward), terminated, truncated, metrics

    def render(self) -> np.ndarray | None:
        """A picture [480, 640, 3], uint8; None without render_mode="rgb_array"."""
        if self._pictures is None:
            return None
        return self._pictures.draw(jax.device_get(self._state.pipeline_state))

    def close(self) -> None:
        """Frees the renderer."""
        if self._pictures is not None:
            self._pictures.close()


class BounceBallVectorEnv(gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """B environments; an ended episode is reset within the step that ends it.

    `info["final_obs"]` [B, N] is every environment's observation after the step, before any reset;
    `info["_final_obs"]` [B] is true where the episode ended.
    """

    metadata = {
        "render_modes": ["rgb_array"],
        "render_fps": _FRAMES_PER_SECOND,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(self, num_envs: int = 1, render_mode: str | None = None, **settings: Any):
        """Makes `num_envs` environments; see `BounceBallEnv`."""
        _check_render_mode(render_mode)
        self.task = BounceBall(validate(EnvConfig, settings, ENV_ID))
        self.metadata = self.metadata | {"render_fps": round(1.0 / self.task.dt)}
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.single_action_space = action_space(self.task)
        self.single_observation_space = observation_space(self.task)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)
        self.observation_space = gymnasium.vector.utils.batch_space(
            self.single_observation_space, num_envs
        )
        self._reset = jax.jit(lambda key: vector.reset(self.task, key, num_envs))
        self._step = jax.jit(self._step_and_split_key, donate_argnums=0)
        self._state: vector.VectorState | None = None
        self._key: jax.Array | None = None
        self._pictures = Pictures(self.task) if render_mode else None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts a new episode in every environment: observations [B, N] and an empty info."""
        super().reset(seed=seed)
        self._key, key = jax.random.split(_key(self.np_random))
        self._state = self._reset(key)
        return np.array(vector.observe(self._state)), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advances every environment under the actions [B, 6].

        Returns:
          Observations [B, N], rewards [B], terminated [B], truncated [B], and an info of the
          environments' metrics and the final observations.
        """
        self._state, self._key, result = self._step(
            self._state, np.asarray(actions, np.float32), self._key
        )
        # Copies, because the caller may write into them.
        result = jax.tree.map(np.array, result)
        info = dict(result.metrics) | {
            "final_obs": result.final_observation,
            "_final_obs": result.terminated | result.truncated,
        }
        return result.observation, result.reward, result.terminated, result.truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture [480, 640, 3], uint8, of each environment; None without a render mode."""
        if self._pictures is None:
            return None
        states = jax.device_get(self._state.env.pipeline_state)
        return tuple(
            self._pictures.draw(jax.tree.map(lambda x, i=i: x[..., i], states))
            for i in range(self.num_envs)
        )

    def close_extras(self, **kwargs: Any) -> None:
        """Frees the renderer."""
        if self._pictures is not None:
            self._pictures.close()

    def _step_and_split_key(
        self, state: vector.VectorState, action: jax.Array, key: jax.Array
    ) -> tuple[vector.VectorState, jax.Array, vector.StepResult]:
        key, reset_key = jax.random.split(key)
        steps = self.task.config.episode_steps
        state, result = vector.step(self.task, state, action, reset_key, steps)
        return state, key, result


class Pictures:
    """Draws states of the environment."""

    def __init__(self, task: BounceBall):
        renderer = Renderer(task, _WIDTH, _HEIGHT, choose_backend())
        self._render = renderer.render
        # Also closed at exit, where OpenGL would be unloaded before the renderer.
        self.close = weakref.finalize(self, renderer.close)

    def draw(self, state: BounceState) -> np.ndarray:
        """The picture [480, 640, 3], uint8, of one environment."""
        return self._render(np.asarray(state.physics.qpos), float(state.task.target_height))


def _key(generator: np.random.Generator) -> jax.Array:
    return jax.random.PRNGKey(int(generator.integers(2**31)))


def _check_render_mode(render_mode: str | None) -> None:
    if render_mode not in (None, "rgb_array"):
        raise UserError(f'render_mode is {render_mode!r}; choose "rgb_array" or omit it')
