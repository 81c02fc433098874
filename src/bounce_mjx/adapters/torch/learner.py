"""Shared by the PyTorch learners: separate random numbers for each learner, and its state as
data."""

import abc
from pathlib import Path
from typing import Any, ClassVar

import jax
import numpy as np
import torch
from torch import nn

from bounce_mjx.adapters.torch.vector_env import TorchVectorEnv
from bounce_mjx.files import new_file
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import Policy

State = dict[str, Any]

# The quantities that must stay finite, in the order of their computation.
CHECKED = ("reward", "loss/value", "loss/policy", "parameters")


class Learner(abc.ABC):
    """A library's PPO on a batch of environments.

    Between two calls of `learn`, its state consists of the networks, the statistics, Adam's
    moments, the learning rate, the environments, their last observations, and PyTorch's random
    state.
    """

    library: ClassVar[str]
    losses: ClassVar[tuple[str, ...]]
    """Names of the metrics of an update."""
    optimizer: torch.optim.Adam
    iteration: int = 0
    """Iterations done."""

    def __init__(self, config: PPOConfig, vector: TorchVectorEnv, seed: int):
        """Builds networks and algorithm; several learners do not share random numbers."""
        self.config, self.vector = config, vector
        outside = _random_state(vector.device)
        torch.manual_seed(seed)
        self._build()
        self._random = _random_state(vector.device)
        _set_random_state(vector.device, outside)

    def learn(self) -> dict[str, np.ndarray]:
        """Trains for an iteration, if the parameters are finite: the library would otherwise raise
        exceptions.

        Returns: The environment's metrics of each step [T], the losses [], and "fault" []: the
          number, from 1, of the first quantity of `CHECKED` that was not finite; 0 if all were
          finite. Without an iteration, all other metrics are NaN.
        """
        outside = _random_state(self.vector.device)
        _set_random_state(self.vector.device, self._random)
        names = self.vector.metric_names
        per_step = np.full((self.config.rollout_length, len(names)), np.nan, np.float32)
        losses, fault = dict.fromkeys(self.losses, np.nan), len(CHECKED)
        if self._is_finite():
            rollout, losses = self._iterate()
            self.iteration += 1
            per_step = rollout.cpu().numpy()
            reward = per_step[:, names.index("reward")].mean()
            parameters = 0.0 if self._is_finite() else np.nan
            finite = np.isfinite((reward, losses["loss/value"], losses["loss/policy"], parameters))
            fault = 0 if finite.all() else np.argmin(finite) + 1
        self._random = _random_state(self.vector.device)
        _set_random_state(self.vector.device, outside)
        return dict(zip(names, per_step.T, strict=True)) | losses | {"fault": fault}

    def state(self) -> State:
        """Everything that is needed to continue the training, as nested dictionaries of NumPy
        arrays."""
        return jax.tree.map(_to_array, self._tensors()) | {"env": self.vector.state}

    def restore(self, state: State) -> None:
        """Continues from a `state`."""
        current = self._tensors()
        given = {name: state[name] for name in current}
        tensors = jax.tree.map(_to_tensor, given, current)
        for name, module in self._modules().items():
            module.load_state_dict(tensors["modules"][name])
        for i, parameter in enumerate(self._parameters()):
            self.optimizer.state[parameter] = tensors["adam"][str(i)]
        self._set_learning_rate(tensors["learning_rate"].item())
        self.iteration = tensors["iteration"].item()
        self.vector.state = state["env"]
        self._observe(**tensors["observed"])
        self._random = tensors["random"]

    def _tensors(self) -> State:
        """The state without the environments."""
        rate = self.optimizer.param_groups[0]["lr"]
        return {
            "modules": {name: dict(m.state_dict()) for name, m in self._modules().items()},
            "adam": {str(i): self._moments(p) for i, p in enumerate(self._parameters())},
            "learning_rate": torch.tensor(rate, dtype=torch.float64),
            "iteration": torch.tensor(self.iteration, dtype=torch.int32),
            "observed": self._observed(),
            "random": self._random,
        }

    def save_model(self, path: Path) -> None:
        """Writes networks, optimizer and iteration in the format of rsl_rl's runner, whose `load`
        reads the file of an rsl_rl learner; a complete file replaces an older one."""
        names = {f"{name}_state_dict": m.state_dict() for name, m in self._modules().items()}
        others = {"optimizer_state_dict": self.optimizer.state_dict(), "iter": self.iteration}
        with new_file(path) as new:
            torch.save(names | others | {"infos": None}, new)

    @abc.abstractmethod
    def policy(self) -> Policy:
        """The current policy, without action noise."""

    @abc.abstractmethod
    def _build(self) -> None:
        """Builds networks, algorithm and `optimizer`, and resets the environments."""

    @abc.abstractmethod
    def _iterate(self) -> tuple[torch.Tensor, dict[str, float]]:
        """Runs one iteration; returns the environment's metrics of each step [T, M] and the
        `losses`."""

    @abc.abstractmethod
    def _modules(self) -> dict[str, nn.Module]:
        """Networks and statistics."""

    def _set_learning_rate(self, rate: float) -> None:
        """Sets the learning rate in every place where the library stores it."""
        for group in self.optimizer.param_groups:
            group["lr"] = rate

    @abc.abstractmethod
    def _observed(self) -> dict[str, torch.Tensor]:
        """The tensors on which the next action depends."""

    @abc.abstractmethod
    def _observe(self, **observed: torch.Tensor) -> None:
        """Sets the tensors of `_observed`."""

    def _is_finite(self) -> bool:
        """Whether every parameter is finite."""
        return bool(torch.stack([p.isfinite().all() for p in self._parameters()]).all())

    def _parameters(self) -> list[nn.Parameter]:
        return [p for group in self.optimizer.param_groups for p in group["params"]]

    def _moments(self, parameter: nn.Parameter) -> dict[str, torch.Tensor]:
        """Adam's state for a parameter, which PyTorch creates at the first update."""
        zeros = {
            "step": torch.zeros(()),
            "exp_avg": torch.zeros_like(parameter),
            "exp_avg_sq": torch.zeros_like(parameter),
        }
        return self.optimizer.state.get(parameter) or zeros


def _random_state(device: torch.device) -> dict[str, torch.Tensor]:
    states = {"cpu": torch.get_rng_state()}
    return states if device.type == "cpu" else states | {"cuda": torch.cuda.get_rng_state(device)}


def _set_random_state(device: torch.device, states: dict[str, torch.Tensor]) -> None:
    torch.set_rng_state(states["cpu"])
    if "cuda" in states:
        torch.cuda.set_rng_state(states["cuda"], device)


def _to_array(tensor: torch.Tensor) -> np.ndarray:
    """A copy, because the training reuses the tensor's memory. 64-bit numbers become pairs of words
    [..., 2], because JAX reads checkpoints in 32 bits."""
    array = tensor.detach().cpu().numpy().copy()
    return array[..., None].view(np.uint32) if array.dtype.itemsize == 8 else array


def _to_tensor(array: jax.Array | np.ndarray, like: torch.Tensor) -> torch.Tensor:
    """The inverse of `_to_array`: a tensor with the type and the device of `like`."""
    tensor = torch.from_numpy(np.array(array))
    if like.dtype.itemsize == 8:
        tensor = tensor.view(like.dtype)[..., 0]
    return tensor.to(like.device)
