"""The networks of `learning/networks.py` in PyTorch, and their conversion to a `Policy`.

Layers, activation, initial weights and normalisation are the same, so that every command that takes
a `Policy` also takes a policy that was trained in PyTorch.
"""

import itertools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import torch
from torch import nn

from bounce_mjx.errors import UserError
from bounce_mjx.learning import statistics
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import Policy, make_networks
from bounce_mjx.learning.statistics import MAX_NORMALIZED, MIN_STD, MIN_VARIANCE


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
        # TorchScript knows no constants of a module.
        self.max_normalized, self.min_std = float(MAX_NORMALIZED), float(MIN_STD)

    @torch.jit.unused
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
        limit = self.max_normalized
        clipped = ((observation - self.mean) / self.std).clamp(-limit, limit)
        return torch.where(self.std > self.min_std, clipped, torch.zeros_like(clipped))


def make_mlp(config: PPOConfig, num_inputs: int, num_outputs: int) -> nn.Sequential:
    """The hidden layers of the config with SiLU between them, and a linear output."""
    sizes = [num_inputs, *config.hidden_layers, num_outputs]
    layers: list[nn.Module] = []
    for inputs, outputs in itertools.pairwise(sizes):
        layers += [nn.Linear(inputs, outputs), nn.SiLU()]
    return nn.Sequential(*layers[:-1])


def init_weights(mlp: nn.Sequential, output_gain: float) -> None:
    """Sets orthogonal weights as in `learning/networks.py`: gain sqrt(2), and `output_gain` in the
    last layer (0.01 for the policy's mean)."""
    linears = linears_of(mlp)
    for linear in linears:
        gain = output_gain if linear is linears[-1] else 2**0.5
        nn.init.orthogonal_(linear.weight, gain)
        nn.init.zeros_(linear.bias)


def linears_of(mlp: nn.Module) -> list[nn.Linear]:
    """The linear layers of a network, in order."""
    return [module for module in mlp.modules() if isinstance(module, nn.Linear)]


def to_policy(
    config: PPOConfig,
    normalizer: InputNormalizer,
    linears: Sequence[nn.Linear],
    log_std: torch.Tensor,
) -> Policy:
    """The `Policy` with the normalisation and the mean network of a PyTorch policy.

    Args:
      normalizer: normaliser of the observation [N].
      linears: hidden layers and output layer of the mean network.
      log_std: logarithm of the standard deviation [n].

    Raises:
      UserError: the layers differ from the config's layers.
    """
    layers = [
        {"kernel": _array(linear.weight).T, "bias": _array(linear.bias)} for linear in linears
    ]
    params = {
        "params": {
            "MLP_0": {f"hidden_{i}": layer for i, layer in enumerate(layers[:-1])},
            "Dense_0": layers[-1],
            "std_logparam": {"log_value": _array(log_std)},
        }
    }
    networks = make_networks(config, len(normalizer.mean), len(log_std))
    expected = jax.eval_shape(networks.policy_network.init, jax.random.PRNGKey(0))
    shapes, expected_shapes = (jax.tree.map(lambda x: x.shape, tree) for tree in (params, expected))
    if shapes != expected_shapes:
        raise UserError(
            f"the policy's network has layers {shapes}, but the config's has {expected_shapes}; "
            "build it with the hidden_layers of the config"
        )
    mean, std = (jnp.asarray(_array(x)) for x in (normalizer.mean, normalizer.std))
    return Policy(statistics.Normalizer(mean, std), jax.tree.map(jnp.asarray, params))


def _array(tensor: torch.Tensor) -> np.ndarray:
    """A copy, because the training reuses the tensor's memory."""
    return tensor.detach().cpu().numpy().copy()
