"""Stable-Baselines3's `VecEnv` over a whole batch; SBX uses it too. It needs the extra `sb3`."""

from typing import Any, NoReturn

import numpy as np

from bounce_mjx.errors import UserError, needed

with needed("Stable-Baselines3", "bounce_mjx[sb3]"):
    import gymnasium
    from gymnasium.vector import AutoresetMode
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import VecEnv

from bounce_mjx.adapters.gymnasium.environments import TaskVectorEnv

_SHOWN = 4


class Sb3VecEnv(VecEnv):
    """B environments in one compiled step; an ended episode is reset within the step that ends it.

    The info of an ended episode has `terminal_observation`, `TimeLimit.truncated`, the metrics of
    its last step, and its statistics as `episode`, as from SB3's `Monitor`. Other infos are empty,
    because many dictionaries would take longer than the physics.
    """

    def __init__(self, num_envs: int = 256, **settings: Any):
        """Makes the environments; the first reset compiles them.

        Args:
          settings: other arguments of `TaskVectorEnv`, such as max_episode_steps=400 and
            episode_seconds=30. Of pictures, the first four environments are tiled.

        Raises:
          UserError: an argument is wrong, or there is no OpenGL library for rendering; an unknown
            argument is a TypeError too.
        """
        same_step = AutoresetMode.SAME_STEP
        self._envs = TaskVectorEnv(num_envs=num_envs, autoreset_mode=same_step, **settings)
        self._actions: np.ndarray | None = None
        self.render_mode = self._envs.render_mode
        self.spec: gymnasium.envs.registration.EnvSpec | None = None
        self.task, self.dt, self.mj_model = self._envs.task, self._envs.dt, self._envs.mj_model
        super().__init__(
            num_envs, self._envs.single_observation_space, self._envs.single_action_space
        )
        self.metadata["render_fps"] = self._envs.metadata["render_fps"]

    def reset(self) -> np.ndarray:
        """Starts a new episode in every environment: observations [B, N], float32. It uses the
        seeds of `seed` and the options of `set_options` once."""
        given = [self._envs.checked_commands(options) for options in self._options]
        commands = {
            name: np.array([one.get(name, np.nan) for one in given])
            for name in self._envs.config.commands
        }
        observation = self._envs.restart(self._seeds, np.ones(self.num_envs, bool), commands)
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
        return [self._envs.draw(i) for i in range(min(self.num_envs, _SHOWN))]

    def close(self) -> None:
        """Frees the renderer."""
        self._envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """A common attribute of the environments, once for each index."""
        return [getattr(self, attr_name)] * len(self._get_indices(indices))

    def set_attr(self, *_: Any, **__: Any) -> NoReturn:
        """Refuses, as does `env_method`: the environments are one program.

        Raises:
          UserError: always.
        """
        raise UserError(
            "environments of a batch have no attributes to set and no methods; give settings "
            "to Sb3VecEnv, and the commands of the next reset to set_options"
        )

    env_method = set_attr

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper], indices: Any = None
    ) -> list[bool]:
        """True for `Monitor`, whose statistics the infos have."""
        return [issubclass(wrapper_class, Monitor)] * len(self._get_indices(indices))


def _row(info: dict[str, Any], index: int) -> dict[str, Any]:
    """One environment's part of a vector's info, in which masks start with an underscore."""
    return {
        name: _row(value, index) if isinstance(value, dict) else value[index].item()
        for name, value in info.items()
        if not name.startswith("_")
    }
