"""Gymnasium's `VectorEnv` with tensors that stay on JAX's device."""

from typing import Any

import numpy as np
import torch

from bounce_mjx.errors import needed

with needed("Gymnasium", "bounce_mjx[gymnasium]"):
    import gymnasium
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space

from bounce_mjx.adapters.gymnasium.batch import (
    action_space,
    checked_commands,
    observation_space,
)
from bounce_mjx.adapters.gymnasium.environments import TaskVectorEnv
from bounce_mjx.adapters.torch.vector_env import TorchVectorEnv


class TorchGymnasiumVectorEnv(gymnasium.vector.VectorEnv[torch.Tensor, torch.Tensor, torch.Tensor]):
    """B environments; an ended episode is reset within the step that ends it.

    `info["final_obs"]` [B, N] is every environment's observation after the step, before any reset;
    `info["_final_obs"]` [B] is true where the episode ended. Rewards and ends may be the operands
    of NumPy's functions, with which Gymnasium's `RecordEpisodeStatistics` works.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": [], "torch": True}
    autoreset_mode = AutoresetMode.SAME_STEP

    def __init__(self, env: TorchVectorEnv):
        self.env = env
        self.num_envs = env.num_envs
        self.device = env.device
        self.single_action_space = action_space(env.env)
        self.single_observation_space = observation_space(env.env)
        self.action_space = batch_space(self.single_action_space, env.num_envs)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[torch.Tensor, dict[str, Any]]:
        """Starts a new episode in every environment: observations [B, N] and an empty info. There
        are no options."""
        checked_commands(options, {})
        super().reset(seed=seed)
        observation, _ = self.env.reset(seed)
        return observation, {}

    def step(
        self, actions: torch.Tensor | np.ndarray
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advances every environment under the actions [B, A]: tensors of any type and device, or
        an array, as skrl's wrapper gives it."""
        tensor = torch.as_tensor(actions, dtype=torch.float32, device=self.device)
        result = self.env.step(tensor)
        info = {"final_obs": result.final_observation, "_final_obs": result.done}
        numbers = (result.reward, result.terminated, result.truncated)
        return result.observation, *(x.as_subclass(_Operand) for x in numbers), info

    def render(self) -> None:
        """Does nothing, as there is no render mode; skrl's trainers call it at every step."""

    call = TaskVectorEnv.call


class _Operand(torch.Tensor):
    """A tensor that NumPy's functions take from any device; they return arrays. (From a plain one
    on the CPU, they return tensors, in which truth values are bytes.) PyTorch's functions return
    plain tensors."""

    __torch_function__ = torch._C._disabled_torch_function_impl

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> Any:
        arrays = (x.cpu().numpy() if isinstance(x, torch.Tensor) else x for x in inputs)
        return getattr(ufunc, method)(*arrays, **kwargs)
