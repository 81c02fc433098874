"""rsl_rl (5.x): the environments as a `VecEnv`."""

from typing import Any

import torch

from bounce_mjx.adapters.torch.vector_env import StepResult, TorchVectorEnv
from bounce_mjx.errors import needed

with needed("rsl_rl", "bounce_mjx[torch]"):
    from rsl_rl.env import VecEnv
    from tensordict import TensorDict


class RslRlVecEnv(VecEnv):
    """B environments with the interface of rsl_rl's runners.

    The observation groups are `policy` [B, N] and `critic` [B, K], the metrics for the value
    network alone. `extras` holds `time_outs` [B] and `log`, means over the batch.
    """

    def __init__(self, env: TorchVectorEnv):
        self.env = env
        self.num_envs = env.num_envs
        self.num_actions = env.num_actions
        self.max_episode_length = env.episode_steps
        self.device = env.device
        self.cfg = env.core.config
        self.step_dt = env.core.dt
        self.physics_dt = self.cfg.physics_dt
        self.render_mode = None
        self._seed: int | None = None
        self._observations = self._groups(*env.reset())
        self.result: StepResult | None = None
        """Result of the last step."""

    @property
    def unwrapped(self) -> "RslRlVecEnv":
        """The environments themselves, as there is no wrapper around them."""
        return self

    def seed(self, seed: int = -1) -> int:
        """Sets the seed of the next `reset`; -1 continues with the present random numbers. rsl_rl's
        runners call no `reset`: for them, give `TorchVectorEnv` the seed."""
        self._seed = None if seed < 0 else seed
        return seed

    def reset(self) -> tuple[TensorDict, dict[str, Any]]:
        """Starts a new episode in every environment: observations and empty extras."""
        self._observations = self._groups(*self.env.reset(self._seed))
        self._seed = None
        return self._observations, {}

    def close(self) -> None:
        """Does nothing, as the environments hold no window and no file."""

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Steps that count towards the time limit [B], int64; a copy, which may be set."""
        return self.env.clock.long()

    @episode_length_buf.setter
    def episode_length_buf(self, value: torch.Tensor) -> None:
        self.env.clock = value

    def get_observations(self) -> TensorDict:
        """The current observations."""
        return self._observations

    def step(
        self, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advances every environment under the actions [B, A].

        Returns:
          Observations, rewards [B], dones [B] (bool) and extras.
        """
        result = self.result = self.env.step(actions)
        self._observations = self._groups(result.observation, result.critic_metrics)
        means = zip(self.env.metric_names, result.metrics.unbind(), strict=True)
        extras = {
            "time_outs": result.truncated,
            "log": {f"task/{name}": mean for name, mean in means},
        }
        return self._observations, result.reward, result.done, extras

    def _groups(self, observation: torch.Tensor, critic_metrics: torch.Tensor) -> TensorDict:
        # Built on the device and without blocking, because a conversion would wait for the device.
        return TensorDict(
            {"policy": observation, "critic": critic_metrics},
            batch_size=[self.num_envs],
            device=self.device,
            non_blocking=True,
        )
