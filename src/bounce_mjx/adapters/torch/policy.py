"""A policy that was trained in PyTorch, for every command of `bounce-mjx`."""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import torch
from torch import nn

from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import Policy
from bounce_mjx.learning.statistics import Normalizer
from bounce_mjx.runs import checkpoints
from bounce_mjx.runs.checkpoints import policy_shapes
from bounce_mjx.runs.config import TrainConfig

_ACTIVATIONS = {nn.SiLU: "silu", nn.ReLU: "relu", nn.Tanh: "tanh", nn.ELU: "elu"}
"""The modules of PyTorch, and their values of `ppo.activation`."""


class TorchPolicy(NamedTuple):
    """A policy that was trained in PyTorch, and the settings of its network."""

    policy: Policy
    config: PPOConfig
    """Its `hidden_layers` and `activation`, of which `make_networks` makes the network."""


def to_policy(
    mlp: nn.Sequential, mean: torch.Tensor, std: torch.Tensor, log_std: torch.Tensor
) -> TorchPolicy:
    """The policy of a network in PyTorch.

    Args:
      mlp: normalised observation [N] -> mean action [A]; linear layers with SiLU, ReLU, Tanh or ELU
        between them.
      mean: mean of the observations [N].
      std: what the network's inputs are divided by [N], with any epsilon of the library. A policy
        clips its inputs to 10 standard deviations, and replaces constant ones by 0.
      log_std: logarithm of the action noise [A].

    Raises:
      UserError: the network has other layers.
    """
    modules = list(mlp)
    linears = modules[::2]
    activations = modules[1::2]
    kinds = {type(module) for module in activations}
    is_known = len(kinds) == 1 and kinds <= _ACTIVATIONS.keys()
    if (
        len(linears) == len(activations)
        or not is_known
        or {type(x) for x in linears} != {nn.Linear}
    ):
        raise UserError(
            f"the network has the layers {', '.join(type(x).__name__ for x in modules)}, but "
            "a policy has linear ones with one of SiLU, ReLU, Tanh or ELU between them; train such "
            'a network (in rsl_rl, activation "swish", "relu", "tanh" or "elu")'
        )
    if any(getattr(module, "alpha", 1.0) != 1.0 for module in activations):
        raise UserError(
            "the network has an ELU with another alpha than 1, which a policy has not; train with 1"
        )
    layers = [{"kernel": _array(x.weight).T, "bias": _bias(x)} for x in linears]
    # The names of `learning/policy.py`, which are brax's.
    params = {
        "MLP_0": {f"hidden_{i}": layer for i, layer in enumerate(layers[:-1])},
        "Dense_0": layers[-1],
        "std_logparam": {"log_value": _array(log_std)},
    }
    (kind,) = kinds
    widths = tuple(linear.out_features for linear in linears[:-1])
    config = PPOConfig(hidden_layers=widths, activation=_ACTIVATIONS[kind])
    normalizer = Normalizer(_array(mean), _array(std))
    return TorchPolicy(Policy(normalizer, {"params": params}), config)


def write_run(log_dir: Path, env: Env, policy: TorchPolicy, steps: int, seed: int = 0) -> Path:
    """Writes a policy as a run that the commands read, such as `bounce-mjx eval`. Its training
    cannot be resumed.

    Args:
      log_dir: folder in which the run creates its own.
      env: the environment of the training.
      policy: the result of `to_policy`.
      steps: environment steps of the training.

    Returns:
      The run's folder.

    Raises:
      UserError: the policy is for another environment, or the folder cannot be written.
    """
    config = TrainConfig(env=env.config, ppo=policy.config, seed=seed, log_dir=log_dir)
    shapes, expected = (
        jax.tree.map(lambda x: x.shape, tree) for tree in (policy.policy, policy_shapes(config))
    )
    if shapes != expected:
        raise UserError(
            f"the policy's arrays have the shapes {shapes}, but the environment's policies have "
            f"{expected}; give the environment of the training"
        )
    return checkpoints.write_run(config, steps, policy.policy)


def _bias(linear: nn.Linear) -> jax.Array:
    return jnp.zeros(linear.out_features) if linear.bias is None else _array(linear.bias)


def _array(tensor: torch.Tensor) -> jax.Array:
    return jnp.asarray(tensor.detach().cpu().numpy().astype(np.float32))
