"""What the PyTorch trainers of `jax_vs_torch.py` share: this project's environments, networks and
normalisation."""

import itertools

import torch
from torch import nn

from bounce_mjx.adapters.torch import TorchVectorEnv
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.statistics import MAX_NORMALIZED, MIN_STD, MIN_VARIANCE


def make_vector_env(config: PPOConfig, env: Env, seed: int) -> TorchVectorEnv:
    """The environments of a learner.

    Raises:
      UserError: the config has networks that the learners here do not make.
    """
    has_other_critic = config.shared_critic or config.critic_layers not in (
        None,
        config.hidden_layers,
    )
    if config.activation != "silu" or has_other_critic:
        raise UserError(
            "rsl_rl and skrl are compared with SiLU and a value network as large as the policy's; "
            "leave --activation, --critic-layers and --shared-critic out"
        )
    torch.manual_seed(seed)
    return TorchVectorEnv(
        env,
        config.num_envs,
        seed=seed,
        critic_metrics=config.critic_metrics,
        reward_scale=config.reward_scale,
    )


class InputNormalizer(nn.Module):
    """`learning.statistics` as a module: running statistics, and normalisation with them.

    rsl_rl uses it as its observation normaliser (`update`), skrl as its preprocessor (`train`).
    """

    def __init__(self, size: int, device: torch.device | str | None = None):
        super().__init__()
        self.register_buffer("count", torch.zeros((), dtype=torch.int64, device=device))
        self.register_buffer("mean", torch.zeros(size, device=device))
        self.register_buffer("summed_variance", torch.zeros(size, device=device))
        self.register_buffer("std", torch.ones(size, device=device))

    @torch.no_grad()
    def update(self, observation: torch.Tensor) -> None:
        """Adds observations [..., N] to the statistics (Chan, Golub and LeVeque 1979)."""
        batch = observation.reshape(-1, observation.shape[-1])
        old_count = self.count.clone()
        self.count += batch.shape[0]
        batch_mean = batch.mean(0)
        delta = batch_mean - self.mean
        self.mean += delta * (batch.shape[0] / self.count)
        self.summed_variance += (batch - batch_mean).square().sum(0)
        self.summed_variance += delta.square() * (old_count * batch.shape[0] / self.count)
        self.std = torch.sqrt(self.summed_variance / self.count + MIN_VARIANCE)

    def forward(self, observation: torch.Tensor, train: bool = False) -> torch.Tensor:
        """Normalises observations [..., N]; `train` adds them to the statistics first."""
        if train:
            self.update(observation)
        clipped = ((observation - self.mean) / self.std).clamp(-MAX_NORMALIZED, MAX_NORMALIZED)
        return torch.where(self.std > MIN_STD, clipped, torch.zeros_like(clipped))


def make_mlp(
    config: PPOConfig, num_inputs: int, num_outputs: int, output_gain: float
) -> nn.Sequential:
    """The hidden layers of the config with SiLU between them, and a linear output."""
    sizes = [num_inputs, *config.hidden_layers, num_outputs]
    layers: list[nn.Module] = []
    for inputs, outputs in itertools.pairwise(sizes):
        layers += [nn.Linear(inputs, outputs), nn.SiLU()]
    mlp = nn.Sequential(*layers[:-1])
    init_weights(mlp, output_gain)
    return mlp


def init_weights(mlp: nn.Sequential, output_gain: float) -> None:
    """Sets orthogonal weights as in `learning/policy.py`: gain sqrt(2), and `output_gain` in the
    last layer."""
    linears = [module for module in mlp if isinstance(module, nn.Linear)]
    for linear in linears:
        gain = output_gain if linear is linears[-1] else 2**0.5
        nn.init.orthogonal_(linear.weight, gain)
        nn.init.zeros_(linear.bias)
