"""The policies that brax's PPO saved."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
from brax.training import checkpoint as training_checkpoint
from brax.training import networks as brax_networks
from brax.training.agents.ppo import checkpoint
from brax.training.agents.ppo import networks as ppo_networks

from bounce_mjx.errors import UserError

BraxPolicy = Callable[[jax.Array, jax.Array], tuple[jax.Array, dict[str, Any]]]
"""(observation [..., N], key) -> (action [..., A], extras)."""


def load_brax_policy(path: str | Path, deterministic: bool = True) -> BraxPolicy:
    """The policy of a checkpoint that `ppo.train(save_checkpoint_path=...)` wrote.

    brax 0.14.2 has a function of this name, but it cannot read the checkpoints of networks without
    an initialiser of the mean, the default, or of an observation that is one array.

    Args:
      path: a checkpoint, or the folder of all checkpoints, of which the last one is loaded.

    Raises:
      UserError: there is no checkpoint.
    """
    folder = Path(path).resolve()
    steps = sorted(child for child in folder.glob("*") if child.is_dir() and child.name.isdigit())
    if steps and not (folder / "ppo_network_config.json").exists():
        folder = steps[-1]
    if not (folder / "ppo_network_config.json").exists():
        raise UserError(
            f"{path} holds no checkpoint of brax's PPO; give the save_checkpoint_path of ppo.train"
        )
    brax_networks.KERNEL_INITIALIZER.setdefault(None, None)
    config = checkpoint.load_config(folder)
    if "shape" in config.observation_size:
        with config.ignore_type():
            config.observation_size = config.observation_size["shape"][-1]
    networks = training_checkpoint.get_network(config, ppo_networks.make_ppo_networks)
    return ppo_networks.make_inference_fn(networks)(
        checkpoint.load(folder), deterministic=deterministic
    )
