"""The environment in MuJoCo Playground's registry."""

from typing import Any

from ml_collections import config_dict
from mujoco_playground import manipulation, registry
from mujoco_playground.config import manipulation_params

from bounce_mjx.adapters import randomization
from bounce_mjx.adapters.playground.environment import (
    ENV_NAME,
    PlaygroundBounceBall,
    default_config,
)
from bounce_mjx.resources import resource_path
from bounce_mjx.robot.model import load_model
from bounce_mjx.runs.config import load_config


def register() -> None:
    """Adds the environment, its domain randomisation and its PPO parameters.

    Playground's registry has no function for the last two. It also fetches the robots of its own
    environments over the network before it loads any environment; this one does not need them.
    """
    if ENV_NAME in manipulation._envs:
        return
    manipulation.register_environment(ENV_NAME, PlaygroundBounceBall, default_config)
    manipulation._randomizer[ENV_NAME] = domain_randomize
    registry.ALL_ENVS = (*registry.ALL_ENVS, ENV_NAME)
    load, ppo_parameters = manipulation.load, manipulation_params.brax_ppo_config

    def load_any(env_name: str, config: Any = None, config_overrides: Any = None) -> Any:
        if env_name == ENV_NAME:
            return PlaygroundBounceBall(config or default_config(), config_overrides)
        return load(env_name, config, config_overrides)

    def parameters_of_any(env_name: str, impl: str | None = None) -> config_dict.ConfigDict:
        return brax_ppo_config() if env_name == ENV_NAME else ppo_parameters(env_name, impl)

    manipulation.load = load_any
    manipulation_params.brax_ppo_config = parameters_of_any


def domain_randomize(model: Any, rng: Any) -> tuple[Any, Any]:
    """The `randomization_fn` of the shipped robot: `adapters.randomization.DEFAULT`.

    Args:
      model: `mjx_model` of the environment.
      rng: keys [B].
    """
    return randomization.domain_randomize(load_model(None, model.opt.timestep), model, rng)


def brax_ppo_config() -> config_dict.ConfigDict:
    """brax's PPO parameters, from the project's tuned settings for an accelerator
    (`configs/default.yaml`)."""
    config = load_config(resource_path("configs/default.yaml"))
    ppo = config.ppo
    return config_dict.create(
        num_timesteps=config.total_steps,
        num_evals=10,
        num_resets_per_eval=1,
        episode_length=config.env.episode_steps,
        action_repeat=1,
        normalize_observations=True,
        num_envs=ppo.num_envs,
        num_eval_envs=128,
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
        network_factory=config_dict.create(
            policy_hidden_layer_sizes=ppo.hidden_layers,
            value_hidden_layer_sizes=ppo.hidden_layers,
            policy_obs_key="state",
            value_obs_key="state",
            distribution_type="normal",
            noise_std_type="log",
            init_noise_std=ppo.init_noise_std,
        ),
    )
