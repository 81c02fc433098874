"""Settings of the evaluations, and their defaults."""

from typing import Literal

DEFAULT_EPISODES = 1024
DEFAULT_SEED = 20_000
"""Seed of the resets; a training evaluates with a different one."""

DEFAULT_CONDITION_EPISODES = 64
"""Episodes in each condition of a suite."""

Physics = Literal["config", "fused", "mjx", "mujoco"]
"""Engine of an evaluation: "mujoco" is MuJoCo's C engine, "config" the choice in the config."""
