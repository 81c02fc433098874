"""The five results of a policy, on any engine."""

import jax

from bounce_mjx.config.validation import validate
from bounce_mjx.evaluation.c_episodes import make_mujoco_evaluator
from bounce_mjx.evaluation.episodes import make_evaluator
from bounce_mjx.evaluation.results import DEFAULT_EPISODES, DEFAULT_SEED, Report, judge
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import Policy, make_networks
from bounce_mjx.task.config import EnvConfig
from bounce_mjx.task.env import BounceBall


def evaluate_policy(
    policy: Policy,
    env_config: EnvConfig,
    ppo_config: PPOConfig,
    *,
    episodes: int = DEFAULT_EPISODES,
    seed: int = DEFAULT_SEED,
    target_height: float | None = None,
    physics: str = "config",
) -> tuple[Report, str]:
    """Measures the five results.

    Args:
      target_height: one target height for all episodes, m; None for the config's range.
      physics: "fused", "mjx", "mujoco", or "config" for the config's.

    Returns:
      The report, and the name of the engine.

    Raises:
      UserError: the engine does not support the model.
    """
    changes = {}
    if target_height is not None:
        changes["target_height_range"] = (target_height, target_height)
    if physics in ("fused", "mjx"):
        changes["physics"] = physics
    env = BounceBall(validate(EnvConfig, dict(env_config) | changes, "evaluation"))
    networks = make_networks(ppo_config, env.observation_size, env.action_size)
    make = make_mujoco_evaluator if physics == "mujoco" else make_evaluator
    statistics = make(env, networks, episodes)(policy, jax.random.PRNGKey(seed))
    return judge(env, statistics), physics if physics == "mujoco" else env.engine.name
