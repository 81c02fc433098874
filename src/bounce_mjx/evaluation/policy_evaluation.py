"""The five results of a policy, on any engine."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax

from bounce_mjx.config.validation import validate
from bounce_mjx.env.env import Env
from bounce_mjx.evaluation.c_episodes import make_mujoco_evaluator
from bounce_mjx.evaluation.config import DEFAULT_EPISODES, DEFAULT_SEED, Physics
from bounce_mjx.evaluation.episodes import make_evaluator, make_reporting_evaluator
from bounce_mjx.evaluation.results import Report, judge
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import Policy, make_networks
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.randomization import RandomizationConfig


class Evaluation(NamedTuple):
    """A report, and the physics engine that it was measured on."""

    report: Report
    engine: str
    """fused, mjx or mujoco."""
    warnings: tuple[str, ...]
    """Reasons to doubt the engine's physics, one sentence each."""


def evaluate_policy(
    policy: Policy,
    env_config: WorldConfig,
    ppo_config: PPOConfig,
    *,
    episodes: int = DEFAULT_EPISODES,
    seed: int = DEFAULT_SEED,
    target_height: float | None = None,
    nominal: bool = False,
    physics: Physics = "config",
    started: Callable[[str], None] = lambda engine: None,
    progress: Callable[[float], None] | None = None,
) -> Evaluation:
    """Measures the five results of a policy without action noise.

    Args:
      env_config: the task of the policy's training.
      ppo_config: the algorithm's settings in the policy's training, which define the networks.
      episodes: number of episodes, each from its own reset.
      seed: the seed of the resets.
      target_height: one target height for all episodes, m; None for the config's range.
      nominal: whether the worlds are the model's own; else they are drawn as in the training.
      physics: the engine; "mujoco" is MuJoCo's C engine, "config" the config's choice.
      started: called with the engine's name before anything is compiled.
      progress: called now and then with the share of the work that is done, from 0 to 1.

    Raises:
      UserError: the engine does not support the model.
    """
    changes = {}
    if nominal:
        changes["randomization"] = RandomizationConfig()
    elif target_height is not None:
        fixed = {"target_height": None, "target_interval": None}
        changes["randomization"] = env_config.randomization.model_copy(update=fixed)
    if target_height is not None:
        changes["target_height_range"] = (target_height, target_height)
    if physics in ("fused", "mjx"):
        changes["physics"] = physics
    env = Env(validate(WorldConfig, dict(env_config) | changes, "evaluation"))
    networks = make_networks(ppo_config, env.observation_size, env.action_size)
    on_c = physics == "mujoco"
    engine = "mujoco" if on_c else env.engine.name
    started(engine)
    make = make_mujoco_evaluator if on_c else make_evaluator
    if progress is not None:
        make = make_mujoco_evaluator if on_c else make_reporting_evaluator
        make = functools.partial(make, progress=progress)
    statistics = make(env, networks, episodes)(policy, jax.random.PRNGKey(seed))
    return Evaluation(
        judge(env, statistics),
        engine,
        # The warnings concern models on which MuJoCo's solver does not converge, unlike the fused
        # physics.
        warnings=env.engine.warnings if on_c else (),
    )
