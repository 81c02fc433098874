"""What ends a training with a sentence: settings with which nothing can be learned, numbers that
are not finite, and a device that fails."""

from collections.abc import Sequence

import jax
import numpy as np

from bounce_mjx.errors import reason_of, shorten
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.training.seeds import SeedRun
from bounce_mjx.training.trainer import BlockMetrics

MIN_SECONDS = 0.1
"""Shortest mean time to the end of an episode, s; after a reset a ball flies for longer."""

MAX_REWARD = 1e4
"""Largest mean of a reward term in an iteration, times `ppo.reward_scale`."""


def why_unlearnable(metrics: BlockMetrics, config: TrainConfig) -> str | None:
    """What is wrong with the first block, as a sentence; None if it can be learned from. Settings
    that no policy can learn with show there, before anything that was trained is saved, and in
    every seed.

    Args:
      metrics: each [S, I], as from `Trainer.train_block`.
    """
    # The iterations of each seed up to its first fault, with it: what follows is not due to the
    # settings.
    faults = metrics["fault"] != 0
    until_fault = np.cumsum(faults, axis=1) <= faults
    rewards = {name: values for name, values in metrics.items() if name.startswith("reward/")}
    for name, values in rewards.items():
        wrong = until_fault & ~(np.abs(config.ppo.reward_scale * values) <= MAX_REWARD)
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
    cause = f"an end of the task {config.task}"
    for end, name in ends.items():
        count = metrics.get(f"task/{name}")
        if count is not None and count.sum() > 0.5 * ended.sum():
            cause = end
    return (
        f"an episode lasts {seconds.max():.2g} s on average, less than {MIN_SECONDS:g} s, and what "
        f"ends it is {cause}; check the unit of the settings"
    )


def mark_diverged(
    seeds: Sequence[SeedRun], faults: np.ndarray, checked: Sequence[str], first: int
) -> list[SeedRun]:
    """Notes the seeds whose state is useless, as one of its numbers is not finite; returns those
    that diverged in this block.

    Args:
      faults: the metric "fault" of a block of I iterations [S, I].
      checked: see `Trainer`.
      first: number of the block's first iteration, from 1.
    """
    diverged = []
    for seed, block_faults in zip(seeds, faults, strict=True):
        if seed.progress.fault is None and block_faults.any():
            index = int(np.argmax(block_faults != 0))
            quantity = checked[int(block_faults[index]) - 1]
            seed.progress.fault = f"{quantity} became infinite or NaN at iteration {first + index}"
            diverged.append(seed)
    return diverged


def describe_failure(
    error: jax.errors.JaxRuntimeError, device: str, config: TrainConfig, steps: int, advice: str
) -> str:
    """What the failure of a device means to the user.

    Args:
      device: its name.
      advice: how to continue.
    """
    reason = shorten(reason_of(error), 200)
    if reason.startswith("RESOURCE_EXHAUSTED"):
        envs = f"{config.ppo.num_envs:,} environments"
        return f"{device} has too little memory for {envs} ({reason}); lower num_envs"
    return f"{device} failed after {steps:,} steps ({reason}); {advice}"
