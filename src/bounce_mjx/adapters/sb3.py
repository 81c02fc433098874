"""Stable-Baselines3's `VecEnv` over a whole batch; SBX uses it too. It needs the extra `sb3`."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError, needed

with needed("Stable-Baselines3", "bounce_mjx[sb3]"):
    import gymnasium
    from gymnasium.vector import AutoresetMode
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import VecEnv

from bounce_mjx.adapters.gymnasium.batch import Batch
from bounce_mjx.adapters.gymnasium.environments import TaskEnv, TaskVectorEnv

_SHOWN = 4


class Sb3VecEnv(VecEnv):
    """B environments in one compiled step; an ended episode is reset within the step that ends it.

    The info of an ended episode has `terminal_observation`, `TimeLimit.truncated`, the metrics of
    its last step, and its statistics as `episode`, as from SB3's `Monitor`. Other infos have
    `TimeLimit.truncated` alone, because many entries would take longer than the physics.
    """

    def __init__(self, env: Env, num_envs: int = 256, **options: Any):
        """Makes the environments; the first reset compiles them.

        Args:
          env: such as from `environment`.
          options: other arguments of `TaskVectorEnv`, such as max_episode_steps=400. Of pictures,
            the first four environments are tiled.

        Raises:
          UserError: an argument is wrong.
        """
        same_step = AutoresetMode.SAME_STEP
        self._envs = TaskVectorEnv(env, num_envs, autoreset_mode=same_step, **options)
        self._actions: np.ndarray | None = None
        self.render_mode = self._envs.render_mode
        self.spec: gymnasium.envs.registration.EnvSpec | None = None
        super().__init__(
            self._envs.num_envs,
            self._envs.single_observation_space,
            self._envs.single_action_space,
        )
        self.metadata["render_fps"] = self._envs.metadata["render_fps"]

    @property
    def _batch(self) -> Batch:
        return self._envs._batch

    # Properties that ask the batch, which both classes have.
    core = TaskEnv.core
    mj_model = TaskEnv.mj_model
    dt = TaskEnv.dt
    episode_steps = TaskEnv.episode_steps

    def reset(self) -> np.ndarray:
        """Starts a new episode in every environment: observations [B, N], float32. It uses the
        seeds of `seed` and the options of `set_options` once."""
        observation = self._restart(range(self.num_envs), self._seeds, self._options)
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Takes the actions [B, n] of the next `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Advances every environment.

        Returns:
          Observations [B, N], rewards [B], dones [B], and an info of each environment.
        """
        observation, reward, terminated, truncated, info = self._envs.step(self._actions)
        ended = terminated | truncated
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": False} for _ in ended]
        for i in np.flatnonzero(ended):
            infos[i] = _row(info["final_info"], i) | {
                "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                "terminal_observation": info["final_obs"][i],
            }
        return observation, reward.astype(np.float32), ended, infos

    def get_images(self) -> list[np.ndarray | None]:
        """Pictures of the first four environments, each [height, width, 3], uint8."""
        return self._drawn(range(min(self.num_envs, _SHOWN)))

    def close(self) -> None:
        """Frees the renderer."""
        self._envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """A common attribute of the environments, once for each index."""
        return [getattr(self, attr_name)] * len(self._get_indices(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Sets an attribute of all environments, to be read by `get_attr`.

        Raises:
          UserError: `indices` leaves some out, although the environments share their attributes, or
            the attribute is one of the environments' own, which follow from their settings.
        """
        if len(self._get_indices(indices)) != self.num_envs:
            raise UserError(
                f"set_attr of {attr_name} would change only some of the {self.num_envs} "
                "environments, which share their attributes; omit indices"
            )
        if hasattr(type(self), attr_name):
            raise UserError(
                f"set_attr got {attr_name!r}, which is fixed by the settings; give these to "
                "environment(...), and the goals of the next reset to set_options"
            )
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Calls a method of single environments: `reset`, `render` or `get_wrapper_attr`.

        Returns:
          The results of the environments with these indices.

        Raises:
          UserError: there is no such method.
        """
        methods: dict[str, Callable[..., list[Any]]] = {
            "reset": self._reset_some,
            "render": self._drawn,
            "get_wrapper_attr": lambda chosen, name: self.get_attr(name, chosen),
        }
        if method_name not in methods:
            raise UserError(
                f"env_method got {method_name!r}; the environments have the methods "
                f"{', '.join(methods)}"
            )
        chosen = list(self._get_indices(indices))
        return methods[method_name](chosen, *method_args, **method_kwargs)

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper], indices: Any = None
    ) -> list[bool]:
        """True for `Monitor`, whose statistics the infos have."""
        return [issubclass(wrapper_class, Monitor)] * len(self._get_indices(indices))

    def _reset_some(
        self, chosen: list[int], seed: int | None = None, options: dict[str, Any] | None = None
    ) -> list[tuple[np.ndarray, dict[str, Any]]]:
        seeds = [seed if i in chosen else None for i in range(self.num_envs)]
        observation = self._restart(chosen, seeds, [options or {}] * self.num_envs)
        return [(observation[i], {}) for i in chosen]

    def _restart(
        self, chosen: Iterable[int], seeds: Sequence[int | None], options: Sequence[dict[str, Any]]
    ) -> np.ndarray:
        mask = np.isin(np.arange(self.num_envs), list(chosen))
        given = [self._batch.checked_goals(one) for one in options]
        goals = {
            name: np.array([one.get(name, np.nan) for one in given])
            for name in self._batch.config.goals
        }
        return self._envs.restart(seeds, mask, goals)

    def _drawn(self, chosen: Iterable[int]) -> list[np.ndarray | None]:
        return [self._envs.draw(i) for i in chosen]


def _row(info: dict[str, Any], index: int) -> dict[str, Any]:
    """One environment's part of a vector's info, in which masks start with an underscore."""
    return {
        name: _row(value, index) if isinstance(value, dict) else value[index].item()
        for name, value in info.items()
        if not name.startswith("_")
    }
