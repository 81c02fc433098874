"""Metrics of a rollout: means over its steps and over the episodes that ended in it."""

import fnmatch
from collections.abc import Iterable, Sequence

import jax
import jax.numpy as jnp

from bounce_mjx.env import vector
from bounce_mjx.errors import UserError
from bounce_mjx.task import Curve

Metrics = dict[str, jax.Array]

PRIVILEGED = ("world/", "true/")
"""Prefixes of metrics that only a critic may use."""

SUM = "sum/"
"""Prefix of the metrics of a step that are sums; a mean of them over steps has no meaning."""


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


def step_metrics(result: vector.VectorStep, groups: int, curves: Sequence[Curve]) -> Metrics:
    """Metrics of one step over each group of environments [G]: means, and sums under the names
    `SUM`... for means over episodes and events."""
    ended = result.terminated | result.truncated
    logged = {n: v for n, v in result.metrics.items() if not n.startswith(PRIVILEGED)}
    means = logged | {"reward": result.reward}
    sums = {
        "ended": ended,
        "return": jnp.where(ended, result.episode_return, 0.0),
        "length": jnp.where(ended, result.episode_length, 0),
        "non_finite": result.metrics["non_finite"],
        "too_fast": result.metrics["too_fast"],
    }
    for curve in curves:
        value = result.metrics[curve.metric]
        if curve.over == "episodes":
            sums[f"last/{curve.metric}"] = jnp.where(ended, value, 0.0)
        elif curve.over != "steps":
            sums |= {curve.metric: value, curve.over: result.metrics[curve.over]}
    totals = {SUM + name: value for name, value in sums.items()}
    # One array, because on a GPU each small array costs a kernel.
    rows = jnp.stack([x.astype(result.reward.dtype) for x in (means | totals).values()])
    row_sums = jnp.sum(rows.reshape(len(rows), groups, -1), axis=-1)
    count = result.reward.size // groups
    return {
        name: total if name in totals else total / count
        for name, total in zip(means | totals, row_sums, strict=True)
    }


def rollout_metrics(steps: Metrics, curves: Sequence[Curve]) -> Metrics:
    """Metrics of a rollout from the metrics of its steps and groups [T, G]: the rewards, the
    episodes and a task's curves. Means over episodes are NaN if none ended, means over events if
    there were none."""

    def total(name: str) -> jax.Array:
        return jnp.sum(steps[SUM + name])

    ended = total("ended")
    rewards = {name: jnp.mean(v) for name, v in steps.items() if name.startswith("reward")}
    metrics = rewards | {
        "episode/return": total("return") / ended,
        "episode/length": total("length") / ended,
        "episode/ended": ended,
        "task/non_finite": total("non_finite"),
        "task/too_fast": total("too_fast"),
    }
    for curve in curves:
        if curve.over == "steps":
            metrics[curve.tag] = jnp.mean(steps[curve.metric])
        elif curve.over == "episodes":
            metrics[curve.tag] = total(f"last/{curve.metric}") / ended
        else:
            metrics[curve.tag] = total(curve.metric) / total(curve.over)
    return metrics
