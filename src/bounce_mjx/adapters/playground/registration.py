"""The environments in MuJoCo Playground's registry."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ml_collections import config_dict
from mujoco_playground import manipulation, registry
from mujoco_playground.config import manipulation_params

from bounce_mjx.adapters import randomization
from bounce_mjx.adapters.brax.ppo import network_settings, ppo_settings
from bounce_mjx.adapters.playground.environment import (
    ENV_NAME,
    default_config,
    make_env,
)
from bounce_mjx.resources import TASK_POLICIES
from bounce_mjx.robot.model import load_model
from bounce_mjx.runs.layers import read_preset
from bounce_mjx.task.registry import DEFAULT, task_config

ENVIRONMENTS = {ENV_NAME: DEFAULT} | {f"BounceMjx{task.title()}": task for task in TASK_POLICIES}
"""The package's tasks by their names in the registry."""


def register() -> None:
    """Adds the environments, their domain randomisation and their PPO parameters.

    Playground's registry has no functions for the last two. It also fetches the robots of its own
    environments over the network before it loads any environment; these do not need them.
    """
    if ENV_NAME in manipulation.ALL_ENVS:
        return
    for name, task in ENVIRONMENTS.items():
        make = functools.partial(make_env, task=task)
        manipulation.register_environment(name, make, functools.partial(default_config, task))
    registry.ALL_ENVS = (*registry.ALL_ENVS, *ENVIRONMENTS)

    def extend(module: Any, function: str, own: Callable[..., Any]) -> None:
        """Calls `own` with the task, in place of a function, where the name is one of these."""
        other = getattr(module, function)

        def call(env_name: str, *args: Any, **named: Any) -> Any:
            if env_name in ENVIRONMENTS:
                return own(ENVIRONMENTS[env_name], *args, **named)
            return other(env_name, *args, **named)

        setattr(module, function, call)

    extend(manipulation, "load", lambda task, *x, **y: make_env(*x, **y, task=task))
    randomizer = "get_domain_randomizer"
    extend(manipulation, randomizer, lambda task: functools.partial(domain_randomize, task=task))
    extend(manipulation_params, "brax_ppo_config", lambda task, *_, **__: brax_ppo_config(task))


def domain_randomize(model: Any, rng: Any, task: str = DEFAULT) -> tuple[Any, Any]:
    """The `randomization_fn` of the shipped robot: `adapters.randomization.default_terms`.

    Args:
      model: `mjx_model` of the environment.
      rng: keys [B].
      task: name of the environment's task, which has one ball or two.
    """
    num_balls = task_config(task)().num_balls
    mj_model = load_model(None, model.opt.timestep, num_balls=num_balls)
    return randomization.domain_randomize(mj_model, model, rng)


def brax_ppo_config(task: str = DEFAULT) -> config_dict.ConfigDict:
    """brax's PPO parameters, from the tuned settings of a task (`adapters/brax/ppo.py`)."""
    config = read_preset(Path("default"), task=task)
    return config_dict.create(
        num_evals=10,
        num_eval_envs=128,
        network_factory=config_dict.create(
            policy_obs_key="state", value_obs_key="state", **network_settings(config)
        ),
        **ppo_settings(config),
    )
