"""The classes behind `gymnasium.make` and `gymnasium.make_vec`, with NumPy arrays.

Keyword arguments are the settings of the task's config.
"""

import dataclasses
import functools
import os
import time
import weakref
from collections.abc import Sequence
from typing import Any

import gymnasium
import jax
import mujoco
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from bounce_mjx.adapters.gymnasium.programs import Episodes, Programs, Step, shared_programs
from bounce_mjx.config.validation import validate
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError, suggest
from bounce_mjx.task.task import Task
from bounce_mjx.tasks.registry import DEFAULT, task_config
from bounce_mjx.viewers.offscreen import Renderer
from bounce_mjx.viewers.simulation import at_index

# The process in which a program has run. JAX's threads are lost when this process forks.
_jax_process: int | None = None

Commands = dict[str, float | np.ndarray]
"""Some of the task's commands, each [] or [B]; NaN samples it."""


class UnexpectedArgument(UserError, TypeError):
    """An argument with an unknown name; libraries that try several expect a TypeError with these
    words of Python's own."""


class TaskVectorEnv(gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """B environments in one compiled step. They can be pickled and copied, including the state of
    their episodes.

    Given the same seeds and actions, they return the same as a `gymnasium.vector.SyncVectorEnv` of
    B single environments up to float32 rounding, in every autoreset mode. In the same-step mode,
    `info["final_info"]` also has the entry `episode` of Gymnasium's `RecordEpisodeStatistics`.
    """

    metadata = {"render_modes": ["rgb_array"]}
    _spec: EnvSpec | None = None

    def __init__(
        self,
        task: str | type[Task] = DEFAULT,
        num_envs: int = 1,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        width: int = 640,
        height: int = 480,
        camera: str | None = None,
        **settings: Any,
    ):
        """Makes `num_envs` environments. The first reset compiles them, unless equal ones exist.

        Args:
          task: its class, its name, or FILE.py:CLASS.
          max_episode_steps: a shorter time limit than the config's, in steps; None or -1 for the
            config's.
          autoreset_mode: the reset of an ended episode: in the next step, in the same step, or
            disabled, which leaves it to reset(options={"reset_mask": ...}).
          width: of the pictures, in pixels, as is `height`.
          camera: name of a camera of the model; None for the overview.
          settings: fields of the task's config, such as episode_seconds=30.

        Raises:
          UserError: an argument is wrong, or there is no OpenGL library for rendering; an unknown
            argument is a TypeError too.
        """
        kind = task_config(task)
        for name in settings.keys() - kind.model_fields.keys():
            advice = suggest(name, kind.model_fields) or f"give {', '.join(kind.model_fields)}"
            raise UnexpectedArgument(f"got an unexpected keyword argument {name!r}; {advice}")
        self.config = validate(kind, settings, "the environment's settings")
        self.dt = self.config.control_dt
        """Time of one step, s."""
        self.num_envs = num_envs
        if num_envs < 1:
            raise UserError(f"num_envs is {num_envs}, but must be at least 1")
        self.episode_steps = self.config.episode_steps
        """Time limit of an episode in steps."""
        if max_episode_steps not in (None, -1):
            if not 1 <= max_episode_steps <= self.episode_steps:
                raise UserError(
                    f"max_episode_steps is {max_episode_steps}, but must be from 1 to the "
                    f"{self.episode_steps} steps of an episode; episode_seconds makes them longer"
                )
            self.episode_steps = max_episode_steps
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = self.metadata | {
            "render_fps": round(1.0 / self.dt),
            "autoreset_mode": self.autoreset_mode,
        }
        if render_mode not in (None, "rgb_array"):
            raise UserError(f'render_mode is {render_mode!r}; choose "rgb_array" or omit it')
        self.render_mode, self._picture = render_mode, (width, height, camera)
        if render_mode is not None:
            _ = self._renderer  # which a missing camera or library makes fail
        self.single_action_space = Box(-1.0, 1.0, (self.task.action_size,), np.float32)
        self.single_observation_space = Box(
            -np.inf, np.inf, (self.task.observation_size,), np.float32
        )
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._episodes: Episodes | None = None
        self._ended = np.zeros(num_envs, bool)
        self._returns, self._lengths = np.zeros(num_envs), np.zeros(num_envs, int)
        self._starts = np.zeros(num_envs)

    @property
    def spec(self) -> EnvSpec | None:
        """How Gymnasium made the environments, with their time limit in steps."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec) -> None:
        self._spec = dataclasses.replace(spec, max_episode_steps=self.episode_steps)

    @property
    def task(self) -> Env:
        """The environment on JAX; equal environments share it."""
        return self._programs.task

    @property
    def mj_model(self) -> mujoco.MjModel:
        """MuJoCo's model, to read; edits have no effect."""
        return self.task.mj_model

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts a new episode in every environment, or in some.

        Args:
          seed: s seeds the environments with s, s + 1, ...; a list gives each one's seed.
          options: the task's commands of these episodes by name; "reset_mask" [B], bool, chooses
            the environments.

        Returns:
          The observations of all environments [B, N] and an empty info.
        """
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, bool)))
        if mask.dtype != bool or mask.shape != (self.num_envs,) or not mask.any():
            raise UserError(
                f"the option reset_mask has the type {mask.dtype} and the shape {mask.shape}, but "
                f"must be an array of bools of the shape {(self.num_envs,)} with at least one True"
            )
        commands = self.checked_commands(options)
        if seed is None or isinstance(seed, int | np.integer):
            seed = [None if seed is None else int(seed) + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise UserError(
                f"there are {len(seed)} seeds for {self.num_envs} environments; give as many"
            )
        super().reset(seed=seed[0])
        return self.restart(seed, mask, commands), {}

    def checked_commands(self, options: dict[str, Any]) -> Commands:
        """The commands among the options of a reset.

        Raises:
          UserError: a command is not a number within its limits, or an option is unknown.
        """
        known = self.config.commands
        for name in options:
            if name not in known:
                raise UserError(
                    f"reset got an unexpected option {name!r}; known options are: "
                    f"{', '.join(known) or 'none'}"
                )
        return {
            name: known[name].checked(value, f"the option {name}")
            for name, value in options.items()
            if value is not None
        }

    def restart(
        self, seeds: Sequence[int | None], mask: np.ndarray, commands: Commands
    ) -> np.ndarray:
        """Starts new episodes where the mask [B] is true: the observations of all environments
        [B, N].

        Args:
          seeds: seed of each environment; None continues its random numbers.
        """
        _check_process()
        if not mask.all():
            self._check_started()
        if self._episodes is None:
            sampled = self.np_random.integers(2**32, size=self.num_envs)
            seeds = [d if s is None else s for s, d in zip(seeds, sampled, strict=True)]
        seeded = np.array([s is not None for s in seeds])
        numbers = np.array([(s or 0) % 2**32 for s in seeds], np.uint32)
        given = dict.fromkeys(self.config.commands, np.nan) | commands
        values = {name: np.full(self.num_envs, x, np.float32) for name, x in given.items()}
        self._episodes = self._programs.start(self._episodes, mask, numbers, seeded, values)
        self._ended[mask] = False
        self._begin_statistics(mask)
        return np.array(self._episodes.env.obs.T, np.float32)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advances every environment under the actions [B, n], clipped to [-1, 1].

        Returns:
          Observations [B, N], rewards [B], terminated [B], truncated [B], and an info of the
          environments' metrics.
        """
        mode, before = self.autoreset_mode, self._ended
        if mode is AutoresetMode.DISABLED and before.any():
            raise UserError(
                f"the episodes of the environments {np.flatnonzero(before).tolist()} have ended; "
                'reset them with reset(options={"reset_mask": terminated | truncated})'
            )
        actions, shape = np.asarray(actions, np.float32), self.action_space.shape
        if actions.shape != shape:
            raise UserError(f"the action has the shape {actions.shape}, but must have {shape}")
        self._check_started()
        _check_process()
        same_step = mode is AutoresetMode.SAME_STEP
        # In the same-step mode, the ended ones have already been reset.
        skipped = np.zeros_like(before) if same_step else before
        self._episodes, result = self._programs.step(
            self._episodes, actions, self.episode_steps, skipped, same_step
        )
        # Copies, because the arrays belong to the caller.
        result = Step(*(np.array(x) for x in jax.device_get(result)))
        self._ended = result.terminated | result.truncated
        reward = result.reward.astype(np.float64)
        info = self._info(result, reward, skipped)
        return result.observation, reward, result.terminated, result.truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture [height, width, 3], uint8, of each environment; None without a render mode."""
        return None if self.render_mode is None else tuple(map(self.draw, range(self.num_envs)))

    def draw(self, index: int) -> np.ndarray | None:
        """A picture [height, width, 3], uint8, of one environment; None without a render mode."""
        if self.render_mode is None:
            return None
        self._check_started()
        env, state = self._episodes.env, self._episodes.env.pipeline_state
        command, metrics = (at_index(values, index) for values in (state.command, env.metrics))
        return self._renderer.render(np.array(state.physics.qpos[:, index]), command, metrics)

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """A common attribute of the environments, or the result of a method such as render, once
        for each environment [B]."""
        if name == "render":
            return self.render() or (None,) * self.num_envs
        value = getattr(self, name)
        return (value(*args, **kwargs) if callable(value) else value,) * self.num_envs

    def close_extras(self, **kwargs: Any) -> None:
        """Frees the renderer."""
        if self.__dict__.pop("_renderer", None) is not None:
            self._close_renderer()

    @functools.cached_property
    def _programs(self) -> Programs:
        return shared_programs(self.config)

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__ | {"_episodes": jax.device_get(self._episodes)}
        made_anew = "_programs", "_renderer", "_close_renderer"
        return {name: value for name, value in state.items() if name not in made_anew}

    @functools.cached_property
    def _renderer(self) -> Renderer:
        renderer = Renderer(self.task, *self._picture, plain=True)
        # Also closed at exit, where OpenGL would be unloaded before the renderer.
        self._close_renderer = weakref.finalize(self, renderer.close)
        return renderer

    def _check_started(self) -> None:
        if self._episodes is None:
            raise UserError("an environment was used before its reset; call reset() first")

    def _info(self, result: Step, reward: np.ndarray, skipped: np.ndarray) -> dict[str, Any]:
        """The info in the form of `VectorEnv._add_info`: each key has a mask [B], `_key`."""
        names = sorted(self._episodes.env.metrics)
        metrics = dict(zip(names, result.metrics.astype(np.float64), strict=True))
        if self.autoreset_mode is not AutoresetMode.SAME_STEP:
            return _mask(metrics, ~skipped)
        self._returns += reward
        self._lengths += 1
        durations = np.round(time.perf_counter() - self._starts, 6)
        statistics = {"r": self._returns.copy(), "l": self._lengths.copy(), "t": durations}
        info, ended = _mask(metrics, ~self._ended), self._ended.copy()
        if ended.any():
            self._begin_statistics(ended)
            final_obs = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(ended):
                final_obs[i] = result.final_observation[i]
            final_info = _mask(metrics, ended) | {
                "episode": _mask(statistics, ended),
                "_episode": ended,
            }
            info |= {"final_obs": final_obs, "_final_obs": ended}
            info |= {"final_info": final_info, "_final_info": ended}
        return info

    def _begin_statistics(self, mask: np.ndarray) -> None:
        self._returns[mask], self._lengths[mask] = 0.0, 0
        self._starts[mask] = time.perf_counter()


class TaskEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One environment. The config's `episode_seconds` limit its episodes; the argument
    `max_episode_steps` of `gymnasium.make` can only shorten them."""

    metadata = {"render_modes": ["rgb_array"]}
    _spec: EnvSpec | None = None

    def __init__(self, task: str | type[Task] = DEFAULT, **arguments: Any):
        """Makes the environment; the arguments are those of `TaskVectorEnv` that are about one
        environment: `render_mode`, `width`, `height`, `camera`, and the settings."""
        self._envs = TaskVectorEnv(task, 1, autoreset_mode=AutoresetMode.DISABLED, **arguments)
        self.dt, self.episode_steps = self._envs.dt, self._envs.episode_steps
        self.metadata = self.metadata | {"render_fps": self._envs.metadata["render_fps"]}
        self.render_mode = self._envs.render_mode
        self.action_space = self._envs.single_action_space
        self.observation_space = self._envs.single_observation_space

    spec = TaskVectorEnv.spec

    @property
    def task(self) -> Env:
        """The environment on JAX; equal environments share it."""
        return self._envs.task

    @property
    def mj_model(self) -> mujoco.MjModel:
        """MuJoCo's model, to read; edits have no effect."""
        return self._envs.mj_model

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode.

        Args:
          options: the task's commands of this episode by name, instead of sampled ones.

        Returns:
          The first observation [N] and an empty info.
        """
        super().reset(seed=seed)
        observation, info = self._envs.reset(seed=seed, options=options)
        return observation[0], info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advances one control step under the action [n], clipped to [-1, 1].

        Returns:
          Observation [N], reward, terminated, truncated, and the environment's metrics.
        """
        observation, reward, terminated, truncated, info = self._envs.step(np.asarray([action]))
        metrics = {name: float(x[0]) for name, x in info.items() if not name.startswith("_")}
        return observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), metrics

    def render(self) -> np.ndarray | None:
        """A picture [height, width, 3], uint8; None without render_mode="rgb_array"."""
        return self._envs.draw(0)

    def close(self) -> None:
        """Frees the renderer."""
        self._envs.close()


def _mask(values: dict[str, np.ndarray], mask: np.ndarray) -> dict[str, np.ndarray]:
    if not mask.any():
        return {}
    masked = {}
    for name, value in values.items():
        masked[name] = np.where(mask, value, value.dtype.type(0))
        masked[f"_{name}"] = mask.copy()
    return masked


def _check_process() -> None:
    global _jax_process
    _jax_process = _jax_process or os.getpid()
    if _jax_process != os.getpid():
        raise UserError(
            "this process was forked from one that had already used JAX, in which JAX hangs; "
            'start it another way, with AsyncVectorEnv(..., context="forkserver") or '
            'make_vec(..., vector_kwargs={"context": "forkserver"})'
        )
