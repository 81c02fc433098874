"""The environment in MuJoCo Playground's registry."""

from typing import Any

from ml_collections import config_dict
from mujoco_playground import manipulation, registry
from mujoco_playground.config import manipulation_params

from bounce_mjx.adapters import randomization
from bounce_mjx.adapters.brax.ppo import network_settings, ppo_settings
from bounce_mjx.adapters.playground.environment import (
    ENV_NAME,
    PlaygroundBounceBall,
    default_config,
)
from bounce_mjx.robot.model import load_model


def register() -> None:
    """Adds the environment, its domain randomisation and its PPO parameters.

    Playground's registry has no functions for the last two. It also fetches the robots of its own
    environments over the network before it loads any environment; this one does not need them.
    """
    if ENV_NAME in manipulation.ALL_ENVS:
        return
    manipulation.register_environment(ENV_NAME, PlaygroundBounceBall, default_config)
    registry.ALL_ENVS = (*registry.ALL_ENVS, ENV_NAME)
    load, randomizer = manipulation.load, manipulation.get_domain_randomizer
    ppo_parameters = manipulation_params.brax_ppo_config

    def load_any(env_name: str, config: Any = None, config_overrides: Any = None) -> Any:
        if env_name == ENV_NAME:
            return PlaygroundBounceBall(config or default_config(), config_overrides)
        return load(env_name, config, config_overrides)

    def randomizer_of_any(env_name: str) -> Any:
        return domain_randomize if env_name == ENV_NAME else randomizer(env_name)

    def parameters_of_any(env_name: str, impl: str | None = None) -> config_dict.ConfigDict:
        return brax_ppo_config() if env_name == ENV_NAME else ppo_parameters(env_name, impl)

    manipulation.load, manipulation.get_domain_randomizer = load_any, randomizer_of_any
    manipulation_params.brax_ppo_config = parameters_of_any


def domain_randomize(model: Any, rng: Any) -> tuple[Any, Any]:
    """The `randomization_fn` of the shipped robot: `adapters.randomization.DEFAULT`.

    Args:
      model: `mjx_model` of the environment.
      rng: keys [B].
    """
    return randomization.domain_randomize(load_model(None, model.opt.timestep), model, rng)


def brax_ppo_config() -> config_dict.ConfigDict:
    """brax's PPO parameters, from the project's tuned settings (`adapters/brax/ppo.py`)."""
    return config_dict.create(
        num_evals=10,
        num_eval_envs=128,
        network_factory=config_dict.create(
            policy_obs_key="state", value_obs_key="state", **network_settings()
        ),
        **ppo_settings(),
    )
