"""A look at the first block of a training, before anything is saved: settings that no policy can
learn with show there."""

import numpy as np

from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.training.trainer import Metrics

MIN_SECONDS = 0.1
"""Shortest mean time to the end of an episode, s; after a reset a ball flies for longer."""

MAX_REWARD = 1e4
"""Largest mean of a reward term in an iteration, times `ppo.reward_scale`."""


def fault_of(metrics: Metrics, config: TrainConfig) -> str | None:
    """What is wrong with the first block, as a sentence; None if it can be learned from. A fault
    is in every seed.

    Args:
      metrics: each [S, I], as from `Trainer.run`.
    """
    # What follows an iteration that diverged is not due to the settings.
    diverged = np.cumsum(metrics["fault"] != 0, axis=1) > (metrics["fault"] != 0)
    return _fault_of_rewards(metrics, config, ~diverged) or _fault_of_lengths(metrics, config)


def _fault_of_rewards(metrics: Metrics, config: TrainConfig, counts: np.ndarray) -> str | None:
    terms = {name: x for name, x in metrics.items() if name.startswith("reward/")}
    for name, values in terms.items():
        scaled = config.ppo.reward_scale * values
        wrong = counts & ~(np.abs(scaled) <= MAX_REWARD)
        if wrong.any(axis=1).all():
            mean = values[wrong][0]
            size = f"{mean:.3g} on average, beyond {MAX_REWARD:g} after ppo.reward_scale"
            return (
                f"the reward term {name.removeprefix('reward/')} is "
                f"{size if np.isfinite(mean) else 'not finite'}; check the unit of its settings "
                "and of those of the robot"
            )
    return None


def _fault_of_lengths(metrics: Metrics, config: TrainConfig) -> str | None:
    env, ended = config.env, metrics["episode/ended"].sum(axis=1)
    limits = (env.episode_seconds, config.ppo.training_episode_seconds or env.episode_seconds)
    steps = config.ppo.batch_steps * metrics["episode/ended"].shape[1]
    with np.errstate(divide="ignore"):
        seconds = env.control_dt * steps / ended
    if min(limits) <= MIN_SECONDS or not (seconds < MIN_SECONDS).all():
        return None
    causes = {
        "the physics, which is not finite": "task/non_finite",
        f"max_joint_velocity ({env.max_joint_velocity:g} rad/s)": "task/too_fast",
    }
    most = [
        cause
        for cause, name in causes.items()
        if name in metrics and metrics[name].sum() > 0.5 * ended.sum()
    ]
    cause = most[0] if most else f"an end of the task {config.task}{_ends(config)}"
    return (
        f"an episode lasts {seconds.max():.2g} s on average, less than {MIN_SECONDS:g} s, and what "
        f"ends it is {cause}; check the unit of the settings"
    )


def _ends(config: TrainConfig) -> str:
    """The settings of the task that end an episode, with their values."""
    fields = type(config.env).model_fields.items()
    names = (n for n, field in fields if (field.description or "").startswith("The episode ends"))
    ends = (f"{n} {getattr(config.env, n):g}" for n in names if n != "max_joint_velocity")
    text = ", ".join(ends)
    return f" ({text})" if text else ""
