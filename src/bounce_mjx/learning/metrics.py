"""Metrics of a rollout: means over its steps and over the episodes that ended in it."""

import fnmatch
from collections.abc import Iterable, Sequence

import jax
import jax.numpy as jnp

from bounce_mjx.env import vector
from bounce_mjx.errors import UserError
from bounce_mjx.task import Curve

Metrics = dict[str, jax.Array]

# Prefix of the sums that a curve is the mean over.
_OVER = "over/"
# Prefixes of the environment's own metrics: what it rewards, and what it alone knows of the world.
_NO_METRICS_OF_A_TASK = ("reward", "world/", "true/")

# Ends of an episode that are no task's, by their metrics, which another environment may lack.
_ENDS = ("non_finite", "too_fast")


def matching_metrics(patterns: Sequence[str], known: Iterable[str]) -> tuple[str, ...]:
    """The known names that match the patterns; a pattern such as world/* matches several.

    Raises:
      UserError: a pattern matches none.
    """
    known = tuple(known)
    for pattern in patterns:
        if "*" not in pattern and pattern not in known:
            raise UserError(
                f"critic_metrics names {pattern}, which the environment does not have; choose from "
                f"{', '.join(known)}"
            )
    return tuple(dict.fromkeys(n for p in patterns for n in fnmatch.filter(known, p)))


def step_metrics(result: vector.VectorStep, groups: int, curves: Sequence[Curve]) -> Metrics:
    """Sums of one step over each group of environments [G], of which `rollout_metrics` makes
    means: each curve has one by its tag, and one of what it is the mean over."""
    ended, ones = result.terminated | result.truncated, jnp.ones_like(result.reward)
    sums = {name: x for name, x in result.metrics.items() if name.startswith("reward")}
    sums |= {
        "reward": result.reward,
        "steps": ones,
        "ended": ended,
        "return": jnp.where(ended, result.episode_return, 0.0),
        "length": jnp.where(ended, result.episode_length, 0),
    }
    sums |= {f"task/{name}": result.metrics[name] for name in _ENDS if name in result.metrics}
    for curve in (*curves, *_other_curves(result.metrics, curves)):
        value, over = result.metrics[curve.metric], {"steps": ones, "episodes": ended}
        sums[curve.tag] = jnp.where(ended, value, 0.0) if curve.over == "episodes" else value
        sums[_OVER + curve.tag] = (over | result.metrics)[curve.over]
    # One array, because on a GPU each small array costs a kernel.
    rows = jnp.stack([x.astype(result.reward.dtype) for x in sums.values()])
    return dict(zip(sums, jnp.sum(rows.reshape(len(rows), groups, -1), axis=-1), strict=True))


def _other_curves(metrics: Metrics, curves: Sequence[Curve]) -> list[Curve]:
    """For each metric that no curve has, its mean over the steps."""
    named = {curve.metric for curve in curves} | {curve.over for curve in curves}
    known = named.union(_ENDS)
    return [
        Curve(f"task/{name}", name)
        for name in metrics
        if name not in known and not name.startswith(_NO_METRICS_OF_A_TASK)
    ]


def rollout_metrics(steps: Metrics) -> Metrics:
    """Metrics of a rollout from the sums of its steps and groups [T, G]: the rewards, the
    episodes and a task's curves. Means over episodes are NaN if none ended, means over events if
    there were none."""
    total = {name: jnp.sum(x) for name, x in steps.items()}
    metrics = {n: x / total["steps"] for n, x in total.items() if n.startswith("reward")}
    curves = [name for name in total if _OVER + name in total]
    metrics |= {name: total[name] / total[_OVER + name] for name in curves}
    return metrics | {
        "episode/return": total["return"] / total["ended"],
        "episode/length": total["length"] / total["ended"],
        "episode/ended": total["ended"],
        **{f"task/{name}": total[f"task/{name}"] for name in _ENDS if f"task/{name}" in total},
    }
