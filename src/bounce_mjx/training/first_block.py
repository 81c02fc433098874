"""A look at the first block of a training, before anything is saved: settings that no policy can
learn with show there."""

import numpy as np

from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.training.ppo_trainer import Metrics

MIN_SECONDS = 0.1
"""Shortest mean time to the end of an episode, s; after a reset a ball flies for longer."""

MAX_REWARD = 1e4
"""Largest mean of a reward term in an iteration, times `ppo.reward_scale`."""


def fault_of(metrics: Metrics, config: TrainConfig) -> str | None:
    """What is wrong with the first block, as a sentence; None if it can be learned from. A fault
    is in every seed.

    Args:
      metrics: each [S, I], as from `PPOTrainer.run`.
    """
    # What follows an iteration that diverged is not due to the settings.
    faults = metrics["fault"] != 0
    counts = np.cumsum(faults, axis=1) <= faults
    for name in filter(lambda name: name.startswith("reward/"), metrics):
        values = metrics[name]
        wrong = counts & ~(np.abs(config.ppo.reward_scale * values) <= MAX_REWARD)
        if wrong.any(axis=1).all():
            return (
                f"the reward term {name.removeprefix('reward/')} is {values[wrong][0]:.3g} on "
                f"average, not within {MAX_REWARD:g} after ppo.reward_scale; check its units"
            )
    ended = metrics["episode/ended"].sum(axis=1)
    limit = config.ppo.training_episode_seconds or config.env.episode_seconds
    steps = config.ppo.batch_steps * metrics["episode/ended"].shape[1]
    seconds = config.env.control_dt * steps / np.maximum(ended, 1e-9)
    if min(limit, config.env.episode_seconds) <= MIN_SECONDS or (seconds >= MIN_SECONDS).any():
        return None
    ends = {"max_joint_velocity": "too_fast", "the physics, which is not finite": "non_finite"}
    half, nothing = 0.5 * ended.sum(), np.zeros(1)
    often = (end for end, name in ends.items() if metrics.get(f"task/{name}", nothing).sum() > half)
    cause = next(often, f"an end of the task {config.task}")
    return (
        f"an episode lasts {seconds.max():.2g} s on average, less than {MIN_SECONDS:g} s, and what "
        f"ends it is {cause}; check the unit of the settings"
    )
