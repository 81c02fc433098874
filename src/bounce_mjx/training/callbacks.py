"""What a training tells: an event for each block and evaluation, to functions of the user's."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bounce_mjx.evaluation.results import Report
from bounce_mjx.learning.policy import Policy
from bounce_mjx.runs.config import TrainConfig


@dataclasses.dataclass(frozen=True)
class Event:
    """The end of a block of iterations, or an evaluation, of one seed."""

    run: Path
    """Folder of the seed's run."""
    config: TrainConfig
    """The seed's config."""
    steps: int
    """Environment steps so far."""
    metrics: dict[str, float]
    """The finite points of the learning curves by name, such as "episode/return" of a block and
    "results/stable" of an evaluation."""
    report: Report | None = None
    """The results of an evaluation; None at the end of a block."""
    policy: Policy | None = None
    """The policy that was evaluated, as NumPy arrays."""


Callback = Callable[[Event], bool | None]
"""The training waits for it, and ends, as after its last step, once it returns False. On several
hosts it is called where the run is written. It may have two methods: `start(run, config)` is called
for each seed before the training, and `close()` after it."""


def block_points(metrics: dict[str, np.ndarray]) -> list[dict[str, float]]:
    """The finite points of each seed's curves in a block, from metrics of its iterations, each
    [S, I]. NaN stands for nothing to measure."""
    means = {n: np.ma.masked_invalid(x).mean(axis=1).filled(math.nan) for n, x in metrics.items()}
    # A sum, because a mean would hide a single event in many iterations.
    means["task/non_finite"] = np.nansum(metrics["task/non_finite"], axis=1)
    seeds = range(len(means["task/non_finite"]))
    return [{name: float(x[i]) for name, x in means.items() if np.isfinite(x[i])} for i in seeds]


def points_of(report: Report) -> dict[str, float]:
    """The points of an evaluation's curves."""
    values = {result.name.replace(" ", "_"): result.value for result in report.results}
    values |= report.details
    known = {name: x for name, x in values.items() if x is not None and math.isfinite(x)}
    return {f"results/{name}": x for name, x in known.items()}


def call_all(callbacks: list[Any], method: str, *arguments: Any) -> None:
    """Calls a method of the callbacks that have it."""
    for callback in callbacks:
        getattr(callback, method, lambda *_: None)(*arguments)
