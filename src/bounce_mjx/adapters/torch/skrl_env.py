"""skrl (2.x): the environments as a `Wrapper`."""

from typing import Any

import numpy as np
import torch

from bounce_mjx.adapters.torch.vector_env import StepResult, TorchVectorEnv
from bounce_mjx.errors import needed

with needed("skrl", "bounce_mjx[torch]"):
    import gymnasium
    from gymnasium.spaces import Box
    from skrl.envs.wrappers.torch import Wrapper


class SkrlEnv(Wrapper):
    """B environments with the interface of skrl's trainers, which need no `wrap_env` for it.

    Rewards, terminated and truncated are [B, 1]; `state()` is the value network's input, the
    observation and the critic metrics [B, N + K]. skrl's trainers bootstrap a time-out from the
    first observation of the next episode; `result` has the last one of the old. They also reset a
    single environment again after each of its episodes.
    """

    # skrl's properties would ask the environment that is wrapped.
    observation_space: gymnasium.Space = None
    state_space: gymnasium.Space = None
    action_space: gymnasium.Space = None

    def __init__(self, env: TorchVectorEnv):
        super().__init__(env)
        num_states = env.num_observations + len(env.critic_metrics)
        self.observation_space = Box(-np.inf, np.inf, (env.num_observations,))
        self.state_space = Box(-np.inf, np.inf, (num_states,))
        self.action_space = Box(-1.0, 1.0, (env.num_actions,))
        self._states: torch.Tensor | None = None
        self.result: StepResult | None = None
        """Result of the last step."""

    def reset(self) -> tuple[torch.Tensor, dict[str, Any]]:
        """Starts a new episode in every environment."""
        observation, critic_metrics = self._env.reset()
        self._states = torch.cat([observation, critic_metrics], dim=-1)
        return observation, {}

    def step(
        self, actions: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advances every environment under the actions [B, A]."""
        result = self.result = self._env.step(actions)
        self._states = torch.cat([result.observation, result.critic_metrics], dim=-1)
        # A copy of the rewards, because skrl adds values to them in place.
        return (
            result.observation,
            result.reward[:, None].clone(),
            result.terminated[:, None],
            result.truncated[:, None],
            {},
        )

    def state(self) -> torch.Tensor:
        """Inputs of the value network [B, N + K]."""
        return self._states

    def render(self, *args: Any, **kwargs: Any) -> None:
        """Does nothing: skrl calls it at every step."""

    def close(self) -> None:
        """Does nothing: the environments hold no resources."""
