"""B environments on JAX that start and end their episodes separately, with NumPy arrays.

Each environment has its own stream of random numbers, so that it draws the same episodes in a batch
of any size. Batches of equal configs and sizes share their compiled programs.
"""

import functools
import operator
import os
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from bounce_mjx.config.validation import validate
from bounce_mjx.env.env import Env
from bounce_mjx.env.state import State
from bounce_mjx.errors import UserError
from bounce_mjx.task.task import Task
from bounce_mjx.tasks.registry import task_config
from bounce_mjx.training.setup import cache_compilations
from bounce_mjx.world.config import Command, WorldConfig

# The process in which a program has run. JAX's threads are lost when this process forks.
_jax_process: int | None = None


class UnexpectedArgument(UserError, TypeError):
    """An argument or an option with an unknown name; libraries that try several expect a
    TypeError."""


class ResetNeeded(UserError, gymnasium.error.ResetNeeded):
    """A step or a picture before the first reset."""


def action_space(task: Env) -> gymnasium.spaces.Box:
    """The space of the actions of one environment."""
    return gymnasium.spaces.Box(-1.0, 1.0, (task.action_size,), np.float32)


def observation_space(task: Env) -> gymnasium.spaces.Box:
    """The space of the observations of one environment."""
    return gymnasium.spaces.Box(-np.inf, np.inf, (task.observation_size,), np.float32)


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
    metrics: dict[str, np.ndarray]
    """The environment's metrics, each [B], float64."""


class Batch:
    """B environments. It can be pickled and copied, including the state of its episodes."""

    def __init__(
        self,
        task: str | type[Task],
        settings: dict[str, Any],
        num_envs: int,
        max_episode_steps: int | None,
    ):
        """Compiles nothing and does not use JAX's device; the first `restart` does both.

        Args:
          task: its class, or a name as for `find_task`.
          settings: fields of its config.
          max_episode_steps: a shorter time limit than the config's, in steps; None or -1 for the
            config's.

        Raises:
          UserError: a setting is wrong; if its name is unknown, the error is a TypeError too.
        """
        self.config = _task_config(task, settings)
        self.num_envs = _whole("num_envs", num_envs)
        self.episode_steps = self.config.episode_steps
        """Time limit of an episode in steps."""
        if max_episode_steps not in (None, -1):
            given = _whole("max_episode_steps", max_episode_steps)
            if given > self.episode_steps:
                raise UserError(
                    f"max_episode_steps is {given}, but an episode lasts {self.episode_steps} "
                    f"steps, which it can only shorten; give "
                    f"episode_seconds={given * self.config.control_dt:g} instead"
                )
            self.episode_steps = given
        self._episodes: _Episodes | None = None

    @property
    def task(self) -> Env:
        """The environment on JAX."""
        return self._programs.task

    def restart(
        self,
        seeds: Sequence[int | None],
        generator: np.random.Generator,
        mask: np.ndarray,
        commands: dict[str, float | np.ndarray],
    ) -> np.ndarray:
        """Starts new episodes.

        Args:
          seeds: seed of each environment; None continues its random numbers.
          generator: seeds the environments that have neither a seed nor random numbers yet.
          mask: environments to reset [B], bool.
          commands: some commands, each [] or [B]; NaN draws it.

        Returns:
          The observations of all environments [B, N], float32.
        """
        self._check_process()
        if not mask.all():
            self._check_started()
        if self._episodes is None:
            drawn = generator.integers(2**32, size=self.num_envs)
            seeds = [d if s is None else s for s, d in zip(seeds, drawn, strict=True)]
        seeded = np.array([s is not None for s in seeds])
        numbers = np.array([(s or 0) % 2**32 for s in seeds], np.uint32)
        given = dict.fromkeys(self.config.commands, np.nan) | commands
        values = {
            name: np.broadcast_to(np.asarray(value, np.float32), self.num_envs)
            for name, value in given.items()
        }
        self._episodes = self._programs.start(self._episodes, mask, numbers, seeded, values)
        return np.array(self._episodes.env.obs.T, np.float32)

    def step(
        self,
        actions: np.ndarray,
        reset_before: np.ndarray | None = None,
        reset_after: bool = False,
    ) -> StepArrays:
        """Advances every environment.

        Args:
          actions: [B, n], clipped to [-1, 1].
          reset_before: environments that start a new episode instead of a step [B], bool.
          reset_after: whether an ended episode is followed by a new one in the same step.

        Raises:
          UserError: the actions have another shape, or `restart` was never called.
        """
        actions = checked_actions(actions, (self.num_envs, self.task.action_size))
        self._check_started()
        self._check_process()
        if reset_before is None:
            reset_before = np.zeros(self.num_envs, bool)
        self._episodes, packed = self._programs.step(
            self._episodes, actions, self.episode_steps, reset_before, reset_after
        )
        packed, size = np.asarray(packed), self.task.observation_size
        # Other libraries refuse views with strides.
        numbers = np.ascontiguousarray(packed[:, 2 * size :].T, np.float64)
        reward, terminated, truncated, *metrics = numbers
        return StepArrays(
            observation=np.array(packed[:, :size], np.float32),
            final_observation=np.array(packed[:, size : 2 * size], np.float32),
            reward=reward,
            terminated=terminated > 0.0,
            truncated=truncated > 0.0,
            metrics=dict(zip(sorted(self._episodes.env.metrics), metrics, strict=True)),
        )

    def pose(self, index: int) -> tuple[np.ndarray, dict[str, float], dict[str, float]]:
        """The generalised positions [nq], the commands, and the last step's metrics of one
        environment."""
        self._check_started()
        env, state = self._episodes.env, self._episodes.env.pipeline_state
        command, metrics = (
            {name: float(value[index]) for name, value in values.items()}
            for values in (state.command, env.metrics)
        )
        return np.array(state.physics.qpos[:, index]), command, metrics

    @functools.cached_property
    def _programs(self) -> "_Programs":
        # An edited file is another model.
        mjcf = self.config.mjcf
        edited = mjcf.stat().st_mtime_ns if mjcf and mjcf.exists() else None
        return _programs(self.config, self.num_envs, edited)

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__ | {"_episodes": jax.device_get(self._episodes)}
        return {name: value for name, value in state.items() if name != "_programs"}

    def _check_started(self) -> None:
        if self._episodes is None:
            raise ResetNeeded("an environment was used before its reset; call reset() first")

    def _check_process(self) -> None:
        global _jax_process
        _jax_process = _jax_process or os.getpid()
        if _jax_process != os.getpid():
            raise UserError(
                "this process was forked from one that had already used JAX, in which JAX hangs; "
                'start it another way, with AsyncVectorEnv(..., context="forkserver") or '
                'make_vec(..., vector_kwargs={"context": "forkserver"})'
            )


class _Episodes(NamedTuple):
    """State of the B episodes."""

    env: State
    """Environment states, the batch last in every array."""
    length: jax.Array
    """Steps since the reset [B], int32."""
    key: jax.Array
    """Key of each environment's later resets [B, ...]."""


class _Programs(NamedTuple):
    """The functions of `_Episodes`, compiled for one config and number of environments."""

    task: Env
    start: Any
    step: Any


@functools.lru_cache(maxsize=32)
def _programs(config: WorldConfig, num_envs: int, edited: int | None) -> _Programs:
    del edited
    cache_compilations()
    task = Env(config)
    return _Programs(
        task=task,
        start=jax.jit(functools.partial(_start, task)),
        step=jax.jit(functools.partial(_step, task), donate_argnums=0),
    )


def _start(
    task: Env,
    episodes: _Episodes | None,
    mask: jax.Array,
    seeds: jax.Array,
    seeded: jax.Array,
    commands: dict[str, jax.Array],
) -> _Episodes:
    """New episodes where the mask [B] is true; `episodes` is None before the first ones."""
    keys = jax.vmap(jax.random.PRNGKey)(seeds)
    if episodes is not None:
        keys = jnp.where(seeded[:, None], keys, episodes.key)
    keys, now = _split(keys)
    env = jax.vmap(functools.partial(_first_state, task), out_axes=-1)(now, commands)
    started = _Episodes(env, jnp.zeros(seeds.shape, jnp.int32), keys)
    return started if episodes is None else _choose(mask, started, episodes)


def _first_state(task: Env, key: jax.Array, commands: dict[str, jax.Array]) -> State:
    """The start of an episode with commands, each []; NaN draws one."""
    ranges = task.ranges()
    for name, own in task.config.commands.items():
        given = commands[name]
        ranges[name] = tuple(jnp.where(jnp.isnan(given), end, given) for end in (own.low, own.high))
    return task.reset(key, ranges)


def _step(
    task: Env,
    episodes: _Episodes,
    actions: jax.Array,
    limit: jax.Array,
    reset_before: jax.Array,
    reset_after: jax.Array,
) -> tuple[_Episodes, jax.Array]:
    """`Batch.step`; its results come as one array, as every transfer from a GPU costs time."""
    keys, now = _split(episodes.key)
    fresh = jax.vmap(task.reset, out_axes=-1)(now)
    stepped = jax.vmap(task.step, in_axes=-1, out_axes=-1)(episodes.env, actions.T)
    length = episodes.length + 1
    terminated = (stepped.done > 0) & ~reset_before
    # The limit counts even if the task ended the episode too, as in Gymnasium's TimeLimit.
    truncated = (length >= limit) & ~reset_before
    replaced = reset_before | (reset_after & (terminated | truncated))
    after = _choose(
        replaced,
        _Episodes(fresh, jnp.zeros_like(length), keys),
        _Episodes(stepped, length, episodes.key),
    )
    numbers = (jnp.where(reset_before, 0.0, stepped.reward), terminated, truncated)
    metrics = [stepped.metrics[name] for name in sorted(stepped.metrics)]
    columns = jnp.stack([*numbers, *metrics], axis=1)
    return after, jnp.concatenate([after.env.obs.T, stepped.obs.T, columns], axis=1)


def _choose(mask: jax.Array, chosen: _Episodes, other: _Episodes) -> _Episodes:
    """The episodes `chosen` where the mask [B] is true, and the others elsewhere."""
    env = jax.tree.map(lambda a, b: jnp.where(mask, a, b), chosen.env, other.env)
    return _Episodes(
        env,
        jnp.where(mask, chosen.length, other.length),
        jnp.where(mask[:, None], chosen.key, other.key),
    )


def _split(keys: jax.Array) -> tuple[jax.Array, jax.Array]:
    pairs = jax.vmap(jax.random.split)(keys)
    return pairs[:, 0], pairs[:, 1]


def _task_config(task: str | type[Task], settings: dict[str, Any]) -> WorldConfig:
    config = task_config(task)
    try:
        return validate(config, settings, "the environment's settings")
    except UserError as error:
        unknown = [name for name in settings if name not in config.model_fields]
        if not unknown:
            raise
        # Libraries look for this part of Python's own message.
        python = f"got an unexpected keyword argument {unknown[0]!r}"
        raise UnexpectedArgument(f"{error} ({python})") from error


def checked_commands(
    options: dict[str, Any] | None, commands: dict[str, Command], *others: str
) -> dict[str, float]:
    """The commands among the options of a reset.

    Args:
      others: names of other options.

    Raises:
      UserError: a command is not a number within its limits, or an option is unknown, which is an
        `UnexpectedArgument`.
    """
    options, known = options or {}, (*commands, *others)
    for name in options:
        if name not in known:
            raise UnexpectedArgument(
                f"reset got an unexpected option {name!r}; known options are: "
                f"{', '.join(known) or 'none'}"
            )
    return {
        name: command.checked(options[name], f"the option {name}")
        for name, command in commands.items()
        if options.get(name) is not None
    }


def _whole(name: str, value: Any) -> int:
    try:
        number = operator.index(value)
    except TypeError:
        number = None
    if number is None or number < 1:
        raise UserError(f"{name} is {value!r}, but must be a whole number of at least 1")
    return number


def checked_actions(actions: Any, shape: tuple[int, ...]) -> np.ndarray:
    """The actions as an array, float32.

    Raises:
      UserError: they are not numbers of that shape.
    """
    try:
        array = np.asarray(actions, np.float32)
    except (TypeError, ValueError) as error:
        raise UserError(f"the action must be an array of numbers {shape}, but: {error}") from error
    if array.shape != shape:
        raise UserError(f"the action has the shape {array.shape}, but must have {shape}")
    return array
