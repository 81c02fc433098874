"""The classes behind `gymnasium.make` and `gymnasium.make_vec`, with NumPy arrays; `make_env` and
`make_vector_env` are what the registry calls."""

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from bounce_mjx.adapters.gymnasium.batch import (
    Batch,
    Goals,
    ResetNeeded,
    StepArrays,
    checked_actions,
)
from bounce_mjx.adapters.gymnasium.pictures import Pictures
from bounce_mjx.deploy.environments import EnvironmentOf, environment
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError

# Of one environment.
_CHOSEN = np.ones(1, bool)
_NOT_RESET = np.zeros(1, bool)
_NO_SEED = np.zeros(1, np.uint32)


class TaskEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One environment. Its random numbers come from `np_random`, of which each reset takes one.

    The config's `episode_seconds` limit its episodes; the argument `max_episode_steps` of
    `gymnasium.make` can only shorten them.
    """

    metadata = {"render_modes": ["rgb_array"]}
    _spec: EnvSpec | None = None

    def __init__(
        self,
        env: Env,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        width: int = 640,
        height: int = 480,
        camera: str | None = None,
    ):
        """Wraps an environment. The first reset compiles it, unless an equal one exists.

        Args:
          env: such as from `environment`.
          max_episode_steps: a shorter time limit than the config's, in steps; None or -1 for the
            config's.
          width: of the pictures, in pixels, as is `height`.
          camera: name of a camera of the model; None for the overview.

        Raises:
          UserError: an argument is wrong.
        """
        self._batch = Batch(env, 1, max_episode_steps)
        self._has_ended = False
        self._pictures = Pictures(self._batch, render_mode, width, height, camera)
        self.render_mode = render_mode
        self.metadata = self.metadata | {"render_fps": round(1.0 / self.dt)}
        self.action_space = self._batch.action_space
        self.observation_space = self._batch.observation_space

    @property
    def spec(self) -> EnvSpec | None:
        """How Gymnasium made the environment, with its time limit in steps."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec) -> None:
        self._spec = _TaskSpec.limited(spec, self.episode_steps)

    @property
    def core(self) -> Env:
        """The `Env` in it, on JAX."""
        return self._batch.core

    @property
    def mj_model(self) -> mujoco.MjModel:
        """MuJoCo's model, to read; edits have no effect."""
        return self.core.mj_model

    @property
    def dt(self) -> float:
        """Time of one step, s."""
        return self._batch.config.control_dt

    @property
    def episode_steps(self) -> int:
        """Time limit of an episode in steps."""
        return self._batch.episode_steps

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode.

        Args:
          options: the task's goals of this episode by name, instead of sampled ones.

        Returns:
          The first observation [N] and an empty info.
        """
        goals = self._batch.checked_goals(options or {})
        super().reset(seed=seed)
        seeds = np.array([_next_seed(self.np_random)])
        observation = self._batch.start(_CHOSEN, seeds, goals)
        self._has_ended = False
        return observation[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advances one control step under the action [n], clipped to [-1, 1].

        Returns:
          Observation [N], reward, terminated, truncated, and the environment's metrics.
        """
        action = checked_actions(action, self.action_space.shape)
        if self._has_ended:
            raise ResetNeeded("the episode has ended; call reset() before the next step")
        result = self._batch.step(action[None], _NO_SEED, _NOT_RESET)
        terminated = bool(result.terminated[0])
        truncated = bool(result.truncated[0])
        self._has_ended = terminated or truncated
        metrics = result.metrics[:, 0].tolist()
        info = dict(zip(self._batch.programs.metric_names, metrics, strict=True))
        return result.observation[0], float(result.reward[0]), terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """A picture [height, width, 3], uint8; None without render_mode="rgb_array"."""
        return self._pictures.draw(0)

    def close(self) -> None:
        """Frees the renderer."""
        self._pictures.close()


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
        env: Env,
        num_envs: int = 1,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        width: int = 640,
        height: int = 480,
        camera: str | None = None,
    ):
        """Makes `num_envs` environments; the other arguments and the errors are as in `TaskEnv`.

        Args:
          autoreset_mode: the reset of an ended episode: in the next step, in the same step, or
            disabled, which leaves it to reset(options={"reset_mask": ...}).
        """
        self._batch = Batch(env, num_envs, max_episode_steps)
        self._pictures = Pictures(self._batch, render_mode, width, height, camera)
        self.num_envs = self._batch.num_envs
        self.render_mode = render_mode
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        self.metadata = self.metadata | {
            "render_fps": round(1.0 / self.dt),
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_action_space = self._batch.action_space
        self.single_observation_space = self._batch.observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._seeds = EpisodeSeeds(num_envs)
        self._statistics = EpisodeStatistics(num_envs)
        self._ended = np.zeros(num_envs, bool)

    spec = TaskEnv.spec
    core = TaskEnv.core
    mj_model = TaskEnv.mj_model
    dt = TaskEnv.dt
    episode_steps = TaskEnv.episode_steps

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:
        """The random numbers of each environment, as in a `SyncVectorEnv`."""
        return tuple(self._seeds.generators)

    @property
    def np_random_seed(self) -> tuple[int, ...]:
        """The seed of each environment's random numbers."""
        return tuple(self._seeds.generator_seeds)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts a new episode in every environment, or in some.

        Args:
          seed: s seeds the environments with s, s + 1, ...; a list gives each one's seed.
          options: the task's goals of these episodes by name; "reset_mask" [B], bool, chooses
            the environments.

        Returns:
          The observations of all environments [B, N] and an empty info.
        """
        goals = self._batch.checked_goals(options or {}, "reset_mask")
        mask = _checked_mask((options or {}).get("reset_mask"), self.num_envs)
        if seed is None or isinstance(seed, int | np.integer):
            seed = [None if seed is None else int(seed) + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise UserError(
                f"there are {len(seed)} seeds for {self.num_envs} environments; give as many"
            )
        return self.restart(seed, mask, goals), {}

    def restart(self, seeds: Sequence[int | None], mask: np.ndarray, goals: Goals) -> np.ndarray:
        """Starts new episodes where the mask [B] is true: the observations of all environments
        [B, N].

        Args:
          seeds: seed of each environment; None continues its random numbers.
        """
        chosen_seeds = [seed if chosen else None for seed, chosen in zip(seeds, mask, strict=True)]
        self._seeds.seed(chosen_seeds)
        observation = self._batch.start(mask, self._seeds.draw(mask), goals)
        self._seeds.use(mask)
        self._ended[mask] = False
        self._statistics.restart(mask)
        return observation

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advances every environment under the actions [B, n], clipped to [-1, 1].

        Returns:
          Observations [B, N], rewards [B], terminated [B], truncated [B], and an info of the
          environments' metrics.
        """
        ended_before = self._ended
        if self.autoreset_mode is AutoresetMode.DISABLED and ended_before.any():
            numbers = np.flatnonzero(ended_before).tolist()
            raise ResetNeeded(
                f"the episodes of the environments {numbers} have ended; "
                'reset them with reset(options={"reset_mask": terminated | truncated})'
            )
        actions = checked_actions(actions, self.action_space.shape)
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            # The ended ones have already been reset, and any one may end now: a seed is drawn for
            # each, and those of episodes that go on are kept (`EpisodeSeeds`).
            skipped = np.zeros(self.num_envs, bool)
            seeds = self._seeds.draw(~skipped)
            result = self._batch.step(actions, seeds, skipped, reset_after=True)
            restarted = result.terminated | result.truncated
        else:
            skipped = restarted = ended_before
            seeds = self._seeds.draw(skipped)
            result = self._batch.step(actions, seeds, skipped)
        self._seeds.use(restarted)
        self._ended = result.terminated | result.truncated
        info = self._info(result, skipped)
        return result.observation, result.reward, result.terminated, result.truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture [height, width, 3], uint8, of each environment; None without a render mode."""
        return None if self.render_mode is None else tuple(map(self.draw, range(self.num_envs)))

    def draw(self, index: int) -> np.ndarray | None:
        """A picture [height, width, 3], uint8, of one environment; None without a render mode."""
        return self._pictures.draw(index)

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """A common attribute of the environments, or the result of a method such as render, once
        for each environment [B]."""
        if name == "render":
            return self.render() or (None,) * self.num_envs
        if name in ("reset", "step"):
            raise UserError(f"call of {name} would do it to all environments; use {name} itself")
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
        names = self._batch.programs.metric_names
        if self.autoreset_mode is not AutoresetMode.SAME_STEP:
            return _masked(names, result.metrics, ~skipped)
        statistics = self._statistics.step(result.reward, self._ended)
        info = _masked(names, result.metrics, ~self._ended)
        if self._ended.any():
            ended = self._ended.copy()
            final_obs = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(ended):
                final_obs[i] = result.final_observation[i]
            final_info = _masked(names, result.metrics, ended)
            final_info |= {"episode": statistics, "_episode": ended}
            info |= {"final_obs": final_obs, "_final_obs": ended}
            info |= {"final_info": final_info, "_final_info": ended}
        return info


def make_env(
    task: EnvironmentOf | None = None,
    render_mode: str | None = None,
    max_episode_steps: int | None = None,
    width: int = 640,
    height: int = 480,
    camera: str | None = None,
    **settings: Any,
) -> TaskEnv:
    """What `gymnasium.make` calls: a `TaskEnv` of an `environment`.

    Args:
      task: a task, a policy, a run or a config (`EnvironmentOf`).
      settings: its other arguments, such as policy="robust", world="fast_servo" or
        episode_seconds=30.
    """
    env = environment(task, **settings)
    return TaskEnv(env, render_mode, max_episode_steps, width, height, camera)


def make_vector_env(
    task: EnvironmentOf | None = None,
    num_envs: int = 1,
    render_mode: str | None = None,
    max_episode_steps: int | None = None,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    width: int = 640,
    height: int = 480,
    camera: str | None = None,
    **settings: Any,
) -> TaskVectorEnv:
    """What `gymnasium.make_vec` calls: a `TaskVectorEnv` of an `environment`, as `make_env`."""
    env = environment(task, **settings)
    return TaskVectorEnv(
        env, num_envs, render_mode, max_episode_steps, autoreset_mode, width, height, camera
    )


class EpisodeSeeds:
    """A generator for each of B environments, of which each episode takes one number, as in
    `TaskEnv.reset`. A number may be drawn before it is known whether its episode starts."""

    def __init__(self, num_envs: int):
        self.generators: list[np.random.Generator | None] = [None] * num_envs
        self.generator_seeds = [0] * num_envs
        self._drawn = np.zeros(num_envs, np.uint32)
        self._is_drawn = np.zeros(num_envs, bool)
        self.seed([None] * num_envs)

    def seed(self, seeds: Sequence[int | None]) -> None:
        """New generators of these seeds; None keeps an environment's generator."""
        for i, seed in enumerate(seeds):
            if seed is not None or self.generators[i] is None:
                number = None if seed is None else int(seed)
                self.generators[i], self.generator_seeds[i] = seeding.np_random(number)
                self._is_drawn[i] = False

    def draw(self, mask: np.ndarray) -> np.ndarray:
        """Seeds of the next episodes [B], uint32, of the environments where the mask is true."""
        for i in np.flatnonzero(mask & ~self._is_drawn):
            self._drawn[i] = _next_seed(self.generators[i])
            self._is_drawn[i] = True
        return self._drawn

    def use(self, mask: np.ndarray) -> None:
        """Counts the drawn seeds as used where an episode has started."""
        self._is_drawn[mask] = False


class EpisodeStatistics:
    """Return, length and duration of the episodes of B environments that restart as they end."""

    def __init__(self, num_envs: int):
        self._returns = np.zeros(num_envs)
        self._lengths = np.zeros(num_envs, int)
        self._starts = np.full(num_envs, time.perf_counter())

    def restart(self, mask: np.ndarray) -> None:
        """Begins new episodes where the mask is true."""
        self._returns[mask] = 0.0
        self._lengths[mask] = 0
        self._starts[mask] = time.perf_counter()

    def step(self, reward: np.ndarray, ended: np.ndarray) -> dict[str, np.ndarray]:
        """Counts a step with rewards [B], which ends the episodes of the mask `ended`.

        Returns:
          Of the ended episodes: r, the returns; l, the lengths in steps; and t, the durations in s
          [B]; and their masks, as in an info.
        """
        self._returns += reward
        self._lengths += 1
        durations = np.round(time.perf_counter() - self._starts, 6)
        statistics = {}
        for name, values in (("r", self._returns), ("l", self._lengths), ("t", durations)):
            statistics[name] = np.where(ended, values, values.dtype.type(0))
            statistics[f"_{name}"] = ended.copy()
        self.restart(ended)
        return statistics


class _TaskSpec(EnvSpec):
    """A spec in which a time limit above the task's own, as of a `TimeLimit` around the
    environment, is the task's own."""

    @classmethod
    def limited(cls, spec: EnvSpec, episode_steps: int) -> EnvSpec:
        """The spec of an environment with this time limit in steps."""
        fields = [field.name for field in dataclasses.fields(spec) if field.init]
        limited = cls(**{name: getattr(spec, name) for name in fields})
        limited.episode_steps = limited.max_episode_steps = episode_steps
        return limited

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "max_episode_steps" and value is not None:
            value = min(value, getattr(self, "episode_steps", value))
        super().__setattr__(name, value)


def _next_seed(generator: np.random.Generator) -> np.uint32:
    return generator.integers(2**32, dtype=np.uint32)


def _autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError as error:
        known = ", ".join(repr(known.value) for known in AutoresetMode)
        raise UserError(f"autoreset_mode is {mode!r}; choose one of {known}") from error


def _checked_mask(mask: Any, num_envs: int) -> np.ndarray:
    array = np.ones(num_envs, bool) if mask is None else np.asarray(mask)
    if array.dtype != bool or array.shape != (num_envs,) or not array.any():
        raise UserError(
            f"the option reset_mask has the type {array.dtype} and the shape {array.shape}, but "
            f"must be an array of bools of the shape {(num_envs,)} with at least one True"
        )
    return array


def _masked(names: Sequence[str], values: np.ndarray, mask: np.ndarray) -> dict[str, np.ndarray]:
    """Named values [K, B] and their masks as in an info; empty if the mask [B] is false."""
    if not mask.any():
        return {}
    masked = {}
    # Arrays of their own, because they belong to the caller.
    values = np.where(mask, values, 0.0)
    masks = np.repeat(mask[None], len(names), axis=0)
    for name, value, own_mask in zip(names, values, masks, strict=True):
        masked[name] = value
        masked[f"_{name}"] = own_mask
    return masked
