"""B episodes on JAX, with NumPy arrays."""

import functools
import os
from typing import Any, NamedTuple

import gymnasium
import jax
import numpy as np
from gymnasium.spaces import Box

from bounce_mjx.adapters.gymnasium.programs import Episodes, Programs, shared_programs
from bounce_mjx.config.validation import checked_count
from bounce_mjx.deploy.environments import refuse_warmup
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UnexpectedArgument, UserError

Goals = dict[str, float | np.ndarray]
"""Some of the task's goals, each [] or [B]; NaN samples it."""

# The process in which a program has run. JAX's threads are lost when this process forks.
_jax_process: int | None = None


class ResetNeeded(UserError, gymnasium.error.ResetNeeded):
    """A step or a picture before the first reset, or a step after the end of an episode."""


class StepArrays(NamedTuple):
    """Result of one step of B environments; the arrays belong to the caller."""

    observation: np.ndarray
    """Observation for the next action [B, N], float32."""
    final_observation: np.ndarray
    """Observation after the step, before any reset [B, N], float32."""
    reward: np.ndarray
    """Reward [B], float64; 0 where the step only reset the environment."""
    terminated: np.ndarray
    """Whether the task ended the episode [B], bool."""
    truncated: np.ndarray
    """Whether the time limit ended the episode [B], bool."""
    metrics: np.ndarray
    """The environment's metrics in the order of their names [M, B], float64."""


class Batch:
    """B episodes. They can be pickled and copied in the middle of an episode."""

    def __init__(self, env: Env, num_envs: int, max_episode_steps: int | None):
        """Compiles nothing; the first start and the first step do, unless equal ones exist.

        Args:
          max_episode_steps: a shorter time limit than the config's, in steps; None or -1 for the
            config's.

        Raises:
          UserError: an argument is wrong, or the environment has a warm-up.
        """
        self.core = env
        self.config = env.config
        refuse_warmup(self.config.randomization, "the environment's settings")
        self.num_envs = checked_count("num_envs", num_envs)
        self.episode_steps = self.config.episode_steps
        """Time limit of an episode in steps."""
        if max_episode_steps not in (None, -1):
            longest = self.episode_steps
            self.episode_steps = checked_count("max_episode_steps", max_episode_steps)
            if self.episode_steps > longest:
                raise UserError(
                    f"max_episode_steps is {max_episode_steps}, but must be from 1 to the "
                    f"{longest} steps of an episode; episode_seconds makes them longer"
                )
        self._episodes: Episodes | None = None

    @functools.cached_property
    def programs(self) -> Programs:
        """The compiled functions; batches of equal environments share them."""
        return shared_programs(self.core)

    @property
    def action_space(self) -> Box:
        """The space of the actions of one environment."""
        return Box(-1.0, 1.0, (self.core.action_size,), np.float32)

    @property
    def observation_space(self) -> Box:
        """The space of the observations of one environment."""
        return Box(-np.inf, np.inf, (self.core.observation_size,), np.float32)

    def start(self, mask: np.ndarray, seeds: np.ndarray, goals: Goals) -> np.ndarray:
        """Starts new episodes where the mask [B] is true: the observations of all environments
        [B, N], float32.

        Args:
          seeds: of the new episodes [B], uint32.
        """
        _check_process()
        if not mask.all():
            self.check_started()
        given = dict.fromkeys(self.config.goals, np.nan) | goals
        values = {name: np.full(self.num_envs, x, np.float32) for name, x in given.items()}
        self._episodes = self.programs.start(self._episodes, mask, seeds, values)
        return _with_batch_first(np.asarray(self._episodes.observation))

    def step(
        self,
        actions: np.ndarray,
        seeds: np.ndarray,
        reset_before: np.ndarray,
        reset_after: bool = False,
    ) -> StepArrays:
        """Advances every environment.

        Args:
          actions: [B, n], float32, clipped to [-1, 1].
          seeds: of the episodes that start within this step [B], uint32.
          reset_before: environments that start a new episode instead of a step [B], bool.
          reset_after: whether an ended episode is followed by a new one in the same step.
        """
        self.check_started()
        _check_process()
        self._episodes, rows = self.programs.step(
            self._episodes, actions, self.episode_steps, seeds, reset_before, reset_after
        )
        rows = np.asarray(rows)
        size = self.core.observation_size
        numbers = rows[2 * size :].astype(np.float64)
        return StepArrays(
            observation=_with_batch_first(rows[:size]),
            final_observation=_with_batch_first(rows[size : 2 * size]),
            reward=numbers[0],
            terminated=numbers[1] > 0.0,
            truncated=numbers[2] > 0.0,
            metrics=numbers[3:],
        )

    def pose(self, index: int) -> tuple[np.ndarray, dict[str, float], dict[str, float]]:
        """The positions [nq], the goals, and the last step's metrics of one environment."""
        self.check_started()
        state = self._episodes.state
        metrics = self._episodes.metrics[:, index]
        goals = {name: float(value[index]) for name, value in state.goal.items()}
        values = dict(zip(self.programs.metric_names, metrics.tolist(), strict=True))
        return np.array(state.physics.qpos[:, index]), goals, values

    def check_started(self) -> None:
        """Raises `ResetNeeded` before the first start."""
        if self._episodes is None:
            raise ResetNeeded("an environment was used before its reset; call reset() first")

    def checked_goals(self, options: dict[str, Any], *others: str) -> Goals:
        """The goals among the options of a reset.

        Args:
          others: names of other options.

        Raises:
          UserError: a goal is not a number within its limits, or an option is unknown, which is
            a TypeError too.
        """
        goals = self.config.goals
        for name in options:
            if name not in (known := (*goals, *others)):
                raise UnexpectedArgument(
                    f"reset got an unexpected option {name!r}; known options are: "
                    f"{', '.join(known) or 'none'}"
                )
        return {
            name: goal.checked(options[name], f"the option {name}")
            for name, goal in goals.items()
            if options.get(name) is not None
        }

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__ | {"_episodes": jax.device_get(self._episodes)}
        state.pop("programs", None)
        return state


def checked_actions(actions: Any, shape: tuple[int, ...]) -> np.ndarray:
    """The actions as an array, float32.

    Raises:
      UserError: they have another shape, or are no numbers.
    """
    try:
        array = np.asarray(actions, np.float32)
    except (TypeError, ValueError) as error:
        raise UserError(f"the action must be an array of numbers {shape}, but: {error}") from error
    if array.shape != shape:
        raise UserError(f"the action has the shape {array.shape}, but must have {shape}")
    return array


def _with_batch_first(observation: np.ndarray) -> np.ndarray:
    """Observations [B, N], float32, of those with the batch last [N, B]."""
    # Without strides, which other libraries refuse.
    return np.array(observation.T, np.float32, order="C")


def _check_process() -> None:
    global _jax_process
    _jax_process = _jax_process or os.getpid()
    if _jax_process != os.getpid():
        raise UserError(
            "this process was forked from one that had already used JAX, in which JAX hangs; call "
            'multiprocessing.set_start_method("forkserver") first, or give AsyncVectorEnv('
            '..., context="forkserver") or make_vec(..., vector_kwargs={"context": "forkserver"})'
        )
