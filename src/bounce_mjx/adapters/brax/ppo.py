"""For brax's PPO: the project's tuned settings, the policies that it saved, and a function that its
trainers miss on a newer JAX. brax's PPO trains in its own loop, outside `training.job`, and
its policies are no runs."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.training import checkpoint as training_checkpoint
from brax.training import networks as brax_networks
from brax.training.agents.ppo import checkpoint
from brax.training.agents.ppo import networks as ppo_networks

from bounce_mjx.errors import UserError
from bounce_mjx.resources import resource_path
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.layers import read_preset

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
    # load_config looks up the initialiser by its name, None where there is none.
    brax_networks.KERNEL_INITIALIZER.setdefault(None, None)
    config = checkpoint.load_config(folder)
    # So brax stores the size of an observation that is one array.
    if "shape" in config.observation_size:
        with config.ignore_type():
            config.observation_size = config.observation_size["shape"][-1]
    networks = training_checkpoint.get_network(config, ppo_networks.make_ppo_networks)
    make_policy = ppo_networks.make_inference_fn(networks)
    return make_policy(checkpoint.load(folder), deterministic=deterministic)


def ppo_settings(config: TrainConfig | None = None) -> dict[str, Any]:
    """Keyword arguments of brax's `ppo.train`, from a config or `configs/default.yaml`.

    brax's trainer lacks `critic_metrics`, `mean_noise_bound`, `compute_dtype`, the decay of the
    learning rate, our epsilon of Adam and, as set here, the value at a time-out. The episodes have
    the environment's whole time limit, not `training_episode_seconds`, as brax evaluates with the
    same `episode_length`.
    """
    config = config or read_preset(resource_path("configs/default.yaml"))
    ppo = config.ppo
    return dict(
        num_timesteps=config.total_steps,
        episode_length=config.env.episode_steps,
        action_repeat=1,
        normalize_observations=True,
        num_envs=ppo.num_envs,
        unroll_length=ppo.rollout_length,
        batch_size=ppo.num_envs // ppo.num_minibatches,
        num_minibatches=ppo.num_minibatches,
        num_updates_per_batch=ppo.num_epochs,
        learning_rate=ppo.learning_rate,
        learning_rate_schedule="ADAPTIVE_KL" if ppo.target_kl > 0.0 else "NONE",
        learning_rate_schedule_min_lr=ppo.min_learning_rate,
        learning_rate_schedule_max_lr=ppo.max_learning_rate,
        desired_kl=ppo.target_kl,
        discounting=ppo.discount,
        gae_lambda=ppo.gae_lambda,
        clipping_epsilon=ppo.clip_epsilon,
        entropy_cost=ppo.entropy_cost,
        # brax halves it.
        vf_loss_coefficient=2.0 * ppo.value_cost,
        max_grad_norm=ppo.max_grad_norm,
        reward_scaling=ppo.reward_scale,
    )


def network_settings(config: TrainConfig | None = None) -> dict[str, Any]:
    """Keyword arguments of brax's `make_ppo_networks`, from a config or `configs/default.yaml`.

    Raises:
      UserError: the config has a shared critic, which brax's networks lack.
    """
    ppo = (config or read_preset(resource_path("configs/default.yaml"))).ppo
    if ppo.shared_critic:
        raise UserError("brax's networks share no layers; set ppo.shared_critic to false")
    return dict(
        policy_hidden_layer_sizes=ppo.hidden_layers,
        value_hidden_layer_sizes=ppo.critic_layers or ppo.hidden_layers,
        activation=brax_networks.ACTIVATION[ppo.activation],
        distribution_type="normal",
        noise_std_type="log",
        init_noise_std=ppo.init_noise_std,
    )


@contextlib.contextmanager
def device_put_replicated() -> Iterator[None]:
    """Provides `jax.device_put_replicated` inside a `with` block, where JAX lacks it: brax 0.14.2
    calls it in `ppo.train`, `sac.train` and `apg.train`, but JAX 0.10 removed it.

    Not thread-safe: the function is added to the module `jax` and removed at the end.
    """
    if hasattr(jax, "device_put_replicated"):
        yield
        return
    jax.device_put_replicated = replicate
    try:
        yield
    finally:
        del jax.device_put_replicated


def replicate(tree: Any, devices: Sequence[jax.Device]) -> Any:
    """Copies every leaf [...] of a tree (arrays, numbers or random keys) to each of D devices.

    Returns:
      The tree with leaves [D, ...], slice i on device i.
    """
    mesh = jax.sharding.Mesh(np.array(devices), ("device",))
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("device"))
    return jax.tree.map(
        lambda leaf: jax.device_put(jnp.stack([jnp.asarray(leaf)] * len(devices)), sharding), tree
    )
