"""The classes behind `gymnasium.make` and `gymnasium.make_vec`.

The arrays are NumPy arrays; `adapters/torch/gymnasium_env.py` has a vectorised environment with
tensors that stay on JAX's device. Keyword arguments are the
settings of the task's config.
"""

import dataclasses
import multiprocessing
import time
from collections.abc import Sequence
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from bounce_mjx.adapters.gymnasium.batch import (
    Batch,
    StepArrays,
    action_space,
    checked_actions,
    checked_commands,
    observation_space,
)
from bounce_mjx.adapters.gymnasium.pictures import HEIGHT, WIDTH, Pictures
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.task.task import Task
from bounce_mjx.tasks.registry import DEFAULT


class TaskEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One environment. The config's `episode_seconds` limit its episodes; the argument
    `max_episode_steps` of `gymnasium.make` can only shorten them."""

    metadata = {"render_modes": ["rgb_array"]}
    _spec: EnvSpec | None = None

    def __init__(
        self,
        task: str | type[Task] = DEFAULT,
        render_mode: str | None = None,
        width: int = WIDTH,
        height: int = HEIGHT,
        camera: str | None = None,
        **settings: Any,
    ):
        """Makes the environment. The first reset compiles it, unless an equal one exists.

        Args:
          task: its class, its name, or FILE.py:CLASS.
          width: of the pictures, in pixels, as is `height`.
          camera: name of a camera of the model; None for the overview.
          settings: fields of the task's config, such as episode_seconds=30.

        Raises:
          UserError: an argument is wrong, or there is no OpenGL library for rendering; an unknown
            argument is a TypeError too.
        """
        _prefer_forkserver()
        self._batch = Batch(task, settings, 1, None)
        self.metadata = self.metadata | {"render_fps": round(1.0 / self.dt)}
        self.render_mode = render_mode
        self.action_space = action_space(self.task)
        self.observation_space = observation_space(self.task)
        self._pictures = Pictures(self._batch, render_mode, width, height, camera)

    @property
    def spec(self) -> EnvSpec | None:
        """How Gymnasium made the environment, with its time limit in steps."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec) -> None:
        self._spec = dataclasses.replace(spec, max_episode_steps=self._batch.episode_steps)

    @property
    def task(self) -> Env:
        """The environment on JAX; equal environments share it."""
        return self._batch.task

    @property
    def dt(self) -> float:
        """Time of one step, s."""
        return self._batch.config.control_dt

    @property
    def mj_model(self) -> mujoco.MjModel:
        """MuJoCo's model, to read; edits have no effect."""
        return self.task.mj_model

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode.

        Args:
          options: the task's commands of this episode by name, instead of drawn ones.

        Returns:
          The first observation [N] and an empty info.
        """
        super().reset(seed=seed)
        given = checked_commands(options, self._batch.config.commands)
        return self._batch.restart([seed], self.np_random, np.ones(1, bool), given)[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advances one control step under the action [n].

        Returns:
          Observation [N], reward, terminated, truncated, and the environment's metrics.
        """
        action = checked_actions(action, self.action_space.shape)
        result = self._batch.step(action[None])
        metrics = {name: float(value[0]) for name, value in result.metrics.items()}
        return (
            result.observation[0],
            float(result.reward[0]),
            bool(result.terminated[0]),
            bool(result.truncated[0]),
            metrics,
        )

    def render(self) -> np.ndarray | None:
        """A picture [height, width, 3], uint8; None without render_mode="rgb_array"."""
        return self._pictures.draw(0)

    def close(self) -> None:
        """Frees the renderer."""
        self._pictures.close()


class TaskVectorEnv(gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """B environments in one compiled step.

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
        width: int = WIDTH,
        height: int = HEIGHT,
        camera: str | None = None,
        **settings: Any,
    ):
        """Makes `num_envs` environments; the other arguments are as in `TaskEnv`.

        Args:
          max_episode_steps: a shorter time limit than the config's, in steps.
          autoreset_mode: the reset of an ended episode: in the next step, in the same step, or
            disabled, which leaves it to reset(options={"reset_mask": ...}).
        """
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        self._batch = Batch(task, settings, num_envs, max_episode_steps)
        self.metadata = self.metadata | {
            "render_fps": round(1.0 / self.dt),
            "autoreset_mode": self.autoreset_mode,
        }
        self.num_envs = self._batch.num_envs
        self.render_mode = render_mode
        self.single_action_space = action_space(self.task)
        self.single_observation_space = observation_space(self.task)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._pictures = Pictures(self._batch, render_mode, width, height, camera)
        self._ended = np.zeros(num_envs, bool)
        self._statistics = EpisodeStatistics(num_envs)

    spec, task, dt, mj_model = TaskEnv.spec, TaskEnv.task, TaskEnv.dt, TaskEnv.mj_model

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
        given = checked_commands(options, self._batch.config.commands, "reset_mask")
        mask = _checked_mask((options or {}).get("reset_mask"), self.num_envs)
        seeds = _seeds(seed, self.num_envs)
        super().reset(seed=seeds[0])
        return self.restart(seeds, mask, given), {}

    def restart(
        self,
        seeds: Sequence[int | None],
        mask: np.ndarray,
        commands: dict[str, float | np.ndarray],
    ) -> np.ndarray:
        """Starts new episodes where the mask [B] is true: the observations of all environments
        [B, N]; the arguments are those of `Batch.restart`."""
        observation = self._batch.restart(seeds, self.np_random, mask, commands)
        self._ended[mask] = False
        self._statistics.restart(mask)
        return observation

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advances every environment under the actions [B, n].

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
        same_step = mode is AutoresetMode.SAME_STEP
        # In the same-step mode, the ended ones have already been reset.
        skipped = np.zeros_like(before) if same_step else before
        result = self._batch.step(actions, skipped, same_step)
        self._ended = result.terminated | result.truncated
        info = self._info(result, skipped)
        return result.observation, result.reward, result.terminated, result.truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture [height, width, 3], uint8, of each environment; None without a render mode."""
        if self.render_mode is None:
            return None
        return tuple(self._pictures.draw(i) for i in range(self.num_envs))

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """A common attribute of the environments, or the result of a method such as render, once
        for each environment [B]."""
        if name == "render":
            return self.render() or (None,) * self.num_envs
        value = getattr(self, name)
        return (value(*args, **kwargs) if callable(value) else value,) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """A common attribute of the environments, once for each environment [B]."""
        return self.call(name)

    def close_extras(self, **kwargs: Any) -> None:
        """Frees the renderer."""
        self._pictures.close()

    def _info(self, result: StepArrays, skipped: np.ndarray) -> dict[str, Any]:
        """The info in the form of `VectorEnv._add_info`: each key has a mask [B], `_key`."""
        if self.autoreset_mode is not AutoresetMode.SAME_STEP:
            return _masked(result.metrics, ~skipped)
        statistics = self._statistics.step(result.reward, self._ended)
        info = _masked(result.metrics, ~self._ended)
        if self._ended.any():
            final_obs = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(self._ended):
                final_obs[i] = result.final_observation[i]
            ended = self._ended.copy()
            final_info = _masked(result.metrics, ended) | {
                "episode": _masked(statistics, ended),
                "_episode": ended,
            }
            info |= {"final_obs": final_obs, "_final_obs": ended}
            info |= {"final_info": final_info, "_final_info": ended}
        return info


class EpisodeStatistics:
    """Return, length and duration of the episodes of B environments that restart as they end."""

    def __init__(self, num_envs: int):
        self._returns = np.zeros(num_envs)
        self._lengths = np.zeros(num_envs, int)
        self._starts = np.full(num_envs, time.perf_counter())

    def restart(self, chosen: slice | np.ndarray) -> None:
        """Begins new episodes; `chosen` is an index or a mask [B]."""
        self._returns[chosen] = 0.0
        self._lengths[chosen] = 0
        self._starts[chosen] = time.perf_counter()

    def step(self, reward: np.ndarray, ended: np.ndarray) -> dict[str, np.ndarray]:
        """Counts a step with rewards [B]; the episodes of the mask `ended` [B] end with it.

        Returns:
          r, the returns; l, the lengths in steps; and t, the durations in s [B].
        """
        self._returns += reward
        self._lengths += 1
        durations = np.round(time.perf_counter() - self._starts, 6)
        statistics = {"r": self._returns.copy(), "l": self._lengths.copy(), "t": durations}
        self.restart(ended)
        return statistics


def _masked(values: dict[str, np.ndarray], mask: np.ndarray) -> dict[str, np.ndarray]:
    if not mask.any():
        return {}
    masked = {}
    for name, value in values.items():
        masked[name] = np.where(mask, value, value.dtype.type(0))
        masked[f"_{name}"] = mask.copy()
    return masked


def _seeds(seed: int | Sequence[int | None] | None, num_envs: int) -> list[int | None]:
    if seed is None or isinstance(seed, int | np.integer):
        return [None if seed is None else int(seed) + i for i in range(num_envs)]
    if len(seed) != num_envs:
        raise UserError(f"there are {len(seed)} seeds for {num_envs} environments; give as many")
    return list(seed)


def _checked_mask(mask: Any, num_envs: int) -> np.ndarray:
    array = np.ones(num_envs, bool) if mask is None else np.asarray(mask)
    if array.dtype != bool or array.shape != (num_envs,) or not array.any():
        raise UserError(
            f"the option reset_mask has the type {array.dtype} and the shape {array.shape}, but "
            f"must be an array of bools of the shape {(num_envs,)} with at least one True"
        )
    return array


def _autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError as error:
        known = ", ".join(repr(m.value) for m in AutoresetMode)
        raise UserError(f"autoreset_mode is {mode!r}; choose one of {known}") from error


def _prefer_forkserver() -> None:
    """Lets `gymnasium.vector.AsyncVectorEnv` start its processes from a server, as Python 3.14
    does, unless the program has chosen a method: JAX hangs in a fork of a process that used it."""
    available = "forkserver" in multiprocessing.get_all_start_methods()
    if available and multiprocessing.get_start_method(allow_none=True) is None:
        multiprocessing.set_start_method("forkserver")
