"""The project's tuned PPO settings for brax's trainer."""

from typing import Any

from bounce_mjx.resources import resource_path
from bounce_mjx.runs.config import TrainConfig, load_config


def ppo_settings(config: TrainConfig | None = None) -> dict[str, Any]:
    """Keyword arguments of brax's `ppo.train`, from a config or `configs/default.yaml`.

    brax's trainer lacks `critic_metrics` and the decay of the learning rate.
    """
    config = config or load_config(resource_path("configs/default.yaml"))
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
        learning_rate_schedule="ADAPTIVE_KL",
        learning_rate_schedule_min_lr=ppo.min_learning_rate,
        learning_rate_schedule_max_lr=ppo.max_learning_rate,
        desired_kl=ppo.target_kl,
        discounting=ppo.discount,
        gae_lambda=ppo.gae_lambda,
        clipping_epsilon=ppo.clip_epsilon,
        entropy_cost=ppo.entropy_cost,
        max_grad_norm=ppo.max_grad_norm,
        reward_scaling=ppo.reward_scale,
    )


def network_settings(config: TrainConfig | None = None) -> dict[str, Any]:
    """Keyword arguments of brax's `make_ppo_networks`, from a config or `configs/default.yaml`."""
    ppo = (config or load_config(resource_path("configs/default.yaml"))).ppo
    return dict(
        policy_hidden_layer_sizes=ppo.hidden_layers,
        value_hidden_layer_sizes=ppo.hidden_layers,
        distribution_type="normal",
        noise_std_type="log",
        init_noise_std=ppo.init_noise_std,
    )
