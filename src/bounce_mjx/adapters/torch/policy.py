"""A policy that was trained in PyTorch, for every command of `bounce-mjx`."""

from pathlib import Path

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


def to_policy(
    mlp: nn.Sequential, mean: torch.Tensor, std: torch.Tensor, log_std: torch.Tensor
) -> Policy:
    """The `Policy` of a network in PyTorch.

    Args:
      mlp: normalised observation [N] -> mean action [A]; linear layers with SiLU between them.
      mean: mean of the observations [N].
      std: what the network's inputs are divided by [N], with any epsilon of the library. A policy
        clips its inputs to 10 standard deviations, and replaces those that never varied by 0.
      log_std: logarithm of the action noise [A].

    Raises:
      UserError: the network has other layers.
    """
    linears = [module for module in mlp if isinstance(module, nn.Linear)]
    kinds = [type(module).__name__ for module in mlp]
    if kinds != ["Linear", *["SiLU", "Linear"] * (len(linears) - 1)] or len(linears) < 2:
        raise UserError(
            f"the network has the layers {', '.join(kinds)}, but a policy has linear ones with "
            'SiLU between them; train such a network (in rsl_rl, activation "swish")'
        )
    layers = [{"kernel": _array(x.weight).T, "bias": _array(x.bias)} for x in linears]
    params = {
        "MLP_0": {f"hidden_{i}": layer for i, layer in enumerate(layers[:-1])},
        "Dense_0": layers[-1],
        "std_logparam": {"log_value": _array(log_std)},
    }
    return Policy(Normalizer(_array(mean), _array(std)), {"params": params})


def write_run(log_dir: Path, env: Env, policy: Policy, steps: int, seed: int = 0) -> Path:
    """Writes a policy as a run that the commands read, such as `bounce-mjx eval`. Its training
    cannot be resumed.

    Args:
      log_dir: folder in which the run creates its own.
      env: the environment of the training.
      steps: environment steps of the training.

    Returns:
      The run's folder.

    Raises:
      UserError: the policy is for another environment, or the folder cannot be written.
    """
    hidden = policy.params["params"]["MLP_0"]
    widths = tuple(len(hidden[f"hidden_{i}"]["bias"]) for i in range(len(hidden)))
    ppo = PPOConfig(hidden_layers=widths)
    config = TrainConfig(env=env.config, ppo=ppo, seed=seed, log_dir=log_dir)
    shapes, expected = (
        jax.tree.map(lambda x: x.shape, tree) for tree in (policy, policy_shapes(config))
    )
    if shapes != expected:
        raise UserError(
            f"the policy's arrays have the shapes {shapes}, but the environment's policies have "
            f"{expected}; give the environment of the training"
        )
    return checkpoints.write_run(config, steps, policy)


def _array(tensor: torch.Tensor) -> jax.Array:
    return jnp.asarray(np.array(tensor.detach().cpu(), np.float32))
