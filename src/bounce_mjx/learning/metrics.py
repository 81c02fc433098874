"""Metrics of a rollout: means over its steps and over the episodes that ended in it."""

import fnmatch
from collections.abc import Iterable, Sequence

import jax
import jax.numpy as jnp

from bounce_mjx.errors import UserError
from bounce_mjx.env import vector

Metrics = dict[str, jax.Array]

PRIVILEGED = ("world/", "true/")
"""Prefixes of metrics that only a critic may use."""


def matching_metrics(patterns: Sequence[str], known: Iterable[str]) -> tuple[str, ...]:
    """The known names that match the patterns; a pattern such as world/* matches several.

    Raises:
      UserError: a pattern matches none.
    """
    known = tuple(known)
    names: dict[str, None] = {}
    for pattern in patterns:
        matching = fnmatch.filter(known, pattern)
        if not matching and "*" not in pattern:
            raise UserError(
                f"critic_metrics names {pattern}, which the environment does not have; choose from "
                f"{', '.join(known)}"
            )
        names |= dict.fromkeys(matching)
    return tuple(names)


def step_metrics(result: vector.StepResult, groups: int) -> Metrics:
    """Metrics of one step over each group of environments [G]: means, and sums over the episodes
    that ended on the step."""
    ended = result.terminated | result.truncated
    logged = {n: v for n, v in result.metrics.items() if not n.startswith(PRIVILEGED)}
    means = logged | {"reward": result.reward}
    totals = {
        "ended": ended,
        "return": jnp.where(ended, result.episode_return, 0.0),
        "length": jnp.where(ended, result.episode_length, 0),
        "bounces": jnp.where(ended, result.metrics["n_bounces"], 0.0),
        "apex_error": result.metrics["apex_error"],
        "bounced": result.metrics["bounced"],
        "non_finite": result.metrics["non_finite"],
    }
    # One array, because on a GPU each small array costs a kernel.
    rows = jnp.stack([x.astype(result.reward.dtype) for x in (means | totals).values()])
    sums = jnp.sum(rows.reshape(len(rows), groups, -1), axis=-1)
    count = result.reward.size // groups
    return {
        name: total if name in totals else total / count
        for name, total in zip(means | totals, sums, strict=True)
    }


def rollout_metrics(steps: Metrics) -> Metrics:
    """Metrics of a rollout from the metrics of its steps and groups [T, G]. Means over episodes are
    NaN if none ended, means over bounces if there were none."""
    ended, bounced = jnp.sum(steps["ended"]), jnp.sum(steps["bounced"])
    rewards = {name: jnp.mean(v) for name, v in steps.items() if name.startswith("reward")}
    return rewards | {
        "episode/return": jnp.sum(steps["return"]) / ended,
        "episode/length": jnp.sum(steps["length"]) / ended,
        "episode/bounces": jnp.sum(steps["bounces"]) / ended,
        "episode/ended": ended,
        "task/apex_error": jnp.sum(steps["apex_error"]) / bounced,
        "task/ball_xy_error": jnp.mean(steps["ball_xy_error"]),
        "task/n_bounces": jnp.mean(steps["n_bounces"]),
        "task/non_finite": jnp.sum(steps["non_finite"]),
    }
