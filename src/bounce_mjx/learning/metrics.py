"""Metrics of a rollout: means over its steps and over the episodes that ended in it."""

import fnmatch
from collections.abc import Iterable, Sequence

import jax
import jax.numpy as jnp

from bounce_mjx.env import vector
from bounce_mjx.env.contract import ENDS, WORLD_PREFIXES, unnamed_metrics
from bounce_mjx.errors import UserError
from bounce_mjx.task import Curve

Metrics = dict[str, jax.Array]

# Prefix of a curve's denominator: the sum of what the curve is the mean over.
_OVER = "over/"


def matching_metrics(patterns: Sequence[str], known: Iterable[str]) -> tuple[str, ...]:
    """The known names that match the patterns. A pattern such as world/* matches several, and none
    where the world is not sampled.

    Raises:
      UserError: a name, or another pattern, matches none.
    """
    known = tuple(known)
    matching = []
    for pattern in patterns:
        matches = fnmatch.filter(known, pattern)
        if not matches and not _is_of_a_fixed_world(pattern, known):
            raise UserError(
                f"critic_metrics names {pattern}, which the environment does not have; choose from "
                f"{', '.join(known)}"
            )
        matching += matches
    # Each name once, in the order of the patterns.
    return tuple(dict.fromkeys(matching))


def _is_of_a_fixed_world(pattern: str, known: Sequence[str]) -> bool:
    """Whether a pattern is of metrics that this environment does not have, as its world is not
    sampled."""
    for prefix in WORLD_PREFIXES:
        if pattern.startswith(prefix) and "*" in pattern:
            return not any(name.startswith(prefix) for name in known)
    return False


def step_metrics(result: vector.VectorStep, groups: int, curves: Sequence[Curve]) -> Metrics:
    """Sums of one step of B environments, of which `rollout_metrics` makes means. A metric whose
    curve is over events is already 0 on the other steps (`Curve.over`): it is summed without a
    mask.

    Args:
      result: of the step of all environments.
      groups: number of equal groups of environments, G. A device holds whole groups, so that no
        step sums over devices.
      curves: a task's. Each has a sum by its tag, and one of what it is the mean over.

    Returns:
      The sum over each group [G], by name.
    """
    ended = result.terminated | result.truncated
    one = jnp.ones_like(result.reward)
    values = {name: value for name, value in result.metrics.items() if name.startswith("reward")}
    values["reward"] = result.reward
    values["steps"] = one
    values["ended"] = ended
    values["return"] = jnp.where(ended, result.episode_return, 0.0)
    values["length"] = jnp.where(ended, result.episode_length, 0)
    for name in ENDS:
        if name in result.metrics:
            values[f"task/{name}"] = result.metrics[name]

    weights = {"steps": one, "episodes": ended} | result.metrics
    for name in unnamed_metrics(result.metrics, curves):
        curves = (*curves, Curve(f"task/{name}", name, over="steps"))
    for curve in curves:
        value = result.metrics[curve.metric]
        if curve.over == "episodes":
            value = jnp.where(ended, value, 0.0)
        values[curve.tag] = value
        values[_OVER + curve.tag] = weights[curve.over]

    # One array, because on a GPU each small array costs a kernel.
    rows = jnp.stack([value.astype(result.reward.dtype) for value in values.values()])
    sums = jnp.sum(rows.reshape(len(rows), groups, -1), axis=-1)
    return dict(zip(values, sums, strict=True))


def rollout_metrics(steps: Metrics) -> Metrics:
    """Metrics [] of a rollout from the sums of its steps and groups [T, G]: the rewards, the
    episodes and a task's curves. Means over episodes are NaN if none ended, means over events if
    there were none."""
    total = {name: jnp.sum(sums) for name, sums in steps.items()}
    metrics = {
        "episode/return": total["return"] / total["ended"],
        "episode/length": total["length"] / total["ended"],
        "episode/ended": total["ended"],
    }
    for name, value in total.items():
        if _OVER + name in total:
            metrics[name] = value / total[_OVER + name]
        elif name.startswith("reward"):
            metrics[name] = value / total["steps"]
    for end in ENDS:
        if f"task/{end}" in total:
            metrics[f"task/{end}"] = total[f"task/{end}"]
    return metrics
