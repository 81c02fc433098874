"""The results of a policy, on any engine."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.env.env import Env
from bounce_mjx.evaluation.c_episodes import make_mujoco_evaluator
from bounce_mjx.evaluation.config import (
    DEFAULT_OPTIONS,
    EvaluationOptions,
    goal_ranges,
    on_engine,
)
from bounce_mjx.evaluation.episodes import make_evaluator
from bounce_mjx.evaluation.results import Report, judge
from bounce_mjx.evaluation.statistics import Statistics
from bounce_mjx.evaluation.suite import neutral_goals
from bounce_mjx.learning.policy import Actor, Policy
from bounce_mjx.physics.convergence import solver_warning
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.randomization import RandomizationConfig, Ranges


class EpisodeSetup(NamedTuple):
    """From what the episodes of an evaluation are sampled."""

    env: Env
    goals: dict[str, tuple[float, float]]
    """Ranges of goals in the episodes that are judged; those left out have the config's."""
    ranges: Ranges | None
    """Ranges of the worlds and goals of one or more conditions, each end [C, ...], as for
    `reset_episodes`; None for the config's."""


class InEvaluation(NamedTuple):
    """Where an evaluation simulates one of its episodes, for a film of it."""

    setup: EpisodeSetup
    episodes: int
    """Number of episodes that one call simulates."""
    episode: int
    """Number of the episode among them, from 0."""


class PolicyEvaluation(NamedTuple):
    """A report, and what it was measured with."""

    report: Report
    engine: str
    """fused, mjx or mujoco."""
    warning: str | None
    """Why MuJoCo's C engine computes something else than the config's; None if it does not, or was
    not used."""
    setup: EpisodeSetup
    statistics: Statistics
    """Figures of each episode, with its world."""


def evaluate_policy(
    policy: Policy | None,
    env_config: WorldConfig,
    actor: Callable[[Env], Actor],
    options: EvaluationOptions = DEFAULT_OPTIONS,
    recorded: int = 0,
) -> PolicyEvaluation:
    """Measures the results of a policy without action noise.

    Args:
      env_config: the world and the task of the policy's training.
      actor: what acts with the policy, such as the networks of its training (`networks_of`).
      recorded: number of episodes in the report's recording.

    Raises:
      UserError: the engine does not support the model.
    """
    setup = setup_of(env_config, options)
    env = setup.env
    on_c = options.physics == "mujoco"
    engine = "mujoco" if on_c else env.engine.name
    make = make_mujoco_evaluator if on_c else make_evaluator
    evaluate = make(env, actor(env), options.episodes, recorded)
    statistics, recording = evaluate(policy, jax.random.PRNGKey(options.seed), setup.ranges)
    warning = solver_warning(env.mj_model) if on_c else None
    report = judge(env, statistics, recording, setup.goals)
    return PolicyEvaluation(report, engine, warning, setup, jax.device_get(statistics))


def setup_of(env_config: WorldConfig, options: EvaluationOptions) -> EpisodeSetup:
    """The environment of an evaluation, and the ranges of its worlds and goals.

    Raises:
      UserError: the engine does not support the model.
    """
    trained = goal_ranges(env_config)
    goals = neutral_goals(env_config) if options.nominal else {}
    goals |= {name: (value, value) for name, value in options.goals.items()}
    # A range of the config's own is no input of the program.
    goals = {name: ends for name, ends in goals.items() if ends != trained[name]}

    world = env_config.in_world(RandomizationConfig()) if options.nominal else env_config
    if options.goals.keys() >= trained.keys():
        # Each goal has one value, so that none changes within an episode.
        randomization = world.randomization.model_copy(update={"goal_interval": None})
        world = world.model_copy(update={"randomization": randomization})
    env = Env(on_engine(world, options.physics))
    if not goals:
        return EpisodeSetup(env, goals, ranges=None)
    ranges = jax.tree.map(lambda end: jnp.asarray(end, jnp.float32)[None], env.ranges() | goals)
    return EpisodeSetup(env, goals, ranges)
