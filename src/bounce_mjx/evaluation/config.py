"""Settings of the evaluations, and their defaults."""

from typing import Literal, NamedTuple

from bounce_mjx.world.config import WorldConfig

DEFAULT_EPISODES = 1024
DEFAULT_SEED = 20_000
"""Seed of the resets; a training run evaluates with a different one."""

DEFAULT_CONDITION_EPISODES = 64
"""Episodes in each condition of a suite."""

Physics = Literal["config", "fused", "mjx", "mujoco"]
"""Engine of an evaluation: "mujoco" is MuJoCo's C engine, "config" the choice in the config."""


def on_engine(env: WorldConfig, physics: Physics) -> WorldConfig:
    """The settings of an environment with an evaluation's choice of the engine.

    With "mujoco" they stay as they are: MuJoCo's C engine replaces only the steps of theirs.
    """
    return env.model_copy(update={"physics": physics}) if physics in ("fused", "mjx") else env


def goal_ranges(env: WorldConfig) -> dict[str, tuple[float, float]]:
    """The range from which each goal is sampled."""
    return {name: (goal.low, goal.high) for name, goal in env.goals.items()}


class EvaluationOptions(NamedTuple):
    """How a policy is measured."""

    episodes: int = DEFAULT_EPISODES
    """Number of episodes, each from its own reset."""
    seed: int = DEFAULT_SEED
    """The seed of the resets."""
    physics: Physics = "config"
    nominal: bool = False
    """Whether the worlds are the model's own, with the task's default goals where the policy was
    trained with them; else both are sampled as in the training."""
    goals: dict[str, float] = {}
    """Goals by name with one value for all episodes; the others are sampled."""


DEFAULT_OPTIONS = EvaluationOptions()
