"""What a training tells: events to functions of the user's, and lines to the console."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from bounce_mjx.evaluation.results import Report
from bounce_mjx.learning.policy import Policy
from bounce_mjx.reports.tables import count_text, result_text
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
    "results/stable" of an evaluation. What a callback adds is in the log too."""
    report: Report | None = None
    """The results of an evaluation; None at the end of a block."""
    policy: Policy | None = None
    """The policy that was evaluated, as NumPy arrays."""


Callback = Callable[[Event], bool | None]
"""The training waits for it, and ends, as after its last step, once it returns False. An exception
stops it, as a signal does: it is raised once the state is saved, and the callback is called no
more; one in `start` or `close` is raised at once. On several hosts it is called where the run is
written. It may have two methods: `start(run, config)` is called for each seed before the training,
and `close()` after it."""


def block_points(metrics: dict[str, np.ndarray]) -> list[dict[str, float]]:
    """The finite points of each seed's curves in a block, from metrics of its iterations, each
    [S, I]. NaN stands for nothing to measure."""
    points: list[dict[str, float]] = [{} for _ in metrics["task/non_finite"]]
    for name, values in metrics.items():
        for seed_points, iterations in zip(points, values, strict=True):
            measured = iterations[np.isfinite(iterations)]
            # A sum, because a mean would hide a single event in many iterations.
            if name == "task/non_finite":
                seed_points[name] = float(measured.sum())
            elif len(measured):
                seed_points[name] = float(measured.mean())
    return points


def points_of(report: Report) -> dict[str, float]:
    """The points of an evaluation's curves."""
    values = {result.name.replace(" ", "_"): result.value for result in report.results}
    values |= report.details
    points = {}
    for name, value in values.items():
        if value is not None and math.isfinite(value):
            points[f"results/{name}"] = value
    return points


def call_all(callbacks: list[Any], method: str, *arguments: Any) -> None:
    """Calls a method of the callbacks that have it."""
    for callback in callbacks:
        if hasattr(callback, method):
            getattr(callback, method)(*arguments)


def say(console: Console, line: str) -> None:
    """Prints a line unchanged: rich would read square brackets in a path as markup."""
    console.print(line, highlight=False, markup=False, soft_wrap=True)


def block_line(
    config: TrainConfig,
    steps: int,
    seconds: float,
    left: float | None,
    points: list[dict[str, float]],
) -> str:
    """A block of iterations.

    Args:
      steps: environment steps of each seed so far.
      seconds: duration of the block.
      left: estimated time to the last step, s; the training may end earlier. None without one.
      points: those of the curves of each seed.
    """
    rate = count_text(points[0]["speed/steps_per_second"])
    line = f"{count_text(steps)} steps  {rate} steps/s"
    line += _point_text("episode/return", points, ".0f")
    for curve in config.env.task.curves:
        line += _point_text(curve.tag, points, ".3g", curve.scale, curve.unit)
    line += f"  block {seconds:.1f} s"
    if left:
        or_sooner = " or by its results" if config.stop_when_solved else ""
        line += f", ends in {left:.0f} s{or_sooner}"
    return line


def _point_text(
    tag: str, points: list[dict[str, float]], form: str, scale: float = 1.0, unit: str = ""
) -> str:
    """A curve's newest point, the mean over the seeds that have one, and their standard deviation;
    empty if none has.

    Args:
      tag: of the curve.
      points: of each seed.
      form: format of a number.
      scale: factor to the unit.
      unit: of the number as text; empty for none.
    """
    values = [scale * point[tag] for point in points if tag in point]
    if not values:
        return ""
    name = tag.rpartition("/")[2].replace("_", " ")
    text = f"  {name} {np.mean(values):{form}}"
    if len(values) > 1:
        text += f" +- {np.std(values):{form}}"
    return f"{text} {unit}" if unit else text


def evaluation_line(config: TrainConfig, steps: int, reports: Sequence[Report]) -> str:
    """An evaluation, with a report of each seed that has not diverged."""
    passed = [report for report in reports if report.passed]
    sure = sum(report.passed_with_margin for report in passed)
    line = f"{len(passed)} of {config.num_seeds} seeds meet all results"
    missing = f", {sure} with a margin"
    if config.num_seeds == 1:
        (report,) = reports
        figures = (f"{r.name} {result_text(r, 4, 'g')}" for r in report.results)
        line = f"{report.summary} ({', '.join(figures)})"
        missing = ", not yet with a margin"
    kind = "evaluation"
    if reports[0].screening:
        episodes = reports[0].details["episodes"]
        kind = f"screening ({episodes:,.0f} of {config.eval_episodes:,} episodes)"
        # A larger one would have been evaluated in all episodes.
        missing = ", with no larger margin than the best so far"
    note = missing if sure < len(passed) or (passed and reports[0].screening) else ""
    return f"{kind} at {count_text(steps)} steps: {line}{note}"
