"""The lines that a running training prints."""

from collections.abc import Sequence

import numpy as np
from rich.console import Console

from bounce_mjx.evaluation.results import Report
from bounce_mjx.reports.tables import count_text, figure_text
from bounce_mjx.runs.config import TrainConfig


def say(console: Console, line: str) -> None:
    """Prints a line unchanged: rich would read square brackets in a path as markup."""
    console.print(line, highlight=False, markup=False, soft_wrap=True)


def block_line(
    config: TrainConfig, steps: int, seconds: float, left: float, points: list[dict[str, float]]
) -> str:
    """A block of iterations.

    Args:
      steps: environment steps of each seed so far.
      seconds: duration of the block.
      left: estimated time to the last step, s; the training may end earlier.
      points: those of the curves of each seed.
    """
    rate = count_text(points[0]["speed/steps_per_second"])
    line = f"{count_text(steps)} steps  {rate} steps/s"
    for tag in ("episode/return", *(curve.tag for curve in config.env.task.curves[:1])):
        values = [point[tag] for point in points if tag in point]
        form = ".0f" if tag == "episode/return" else ".3g"
        spread = f" +- {np.std(values):{form}}" if len(values) > 1 else ""
        if values:
            line += f"  {tag.rpartition('/')[2]} {np.mean(values):{form}}{spread}"
    return f"{line}  {seconds:.1f} s, {'at most ' * config.stop_when_solved}{left:.0f} s left"


def evaluation_line(num_seeds: int, steps: int, reports: Sequence[Report]) -> str:
    """An evaluation, with a report of each seed that has not diverged."""
    passed = [report for report in reports if report.passed]
    sure = sum(report.passed_with_margin for report in passed)
    line = f"{len(passed)} of {num_seeds} seeds meet all results"
    missing = f", {sure} with a margin"
    if num_seeds == 1:
        (report,) = reports
        figures = (f"{r.name} {figure_text(r.value, '.4g')}" for r in report.results)
        line = f"{report.summary} ({', '.join(figures)})"
        missing = ", not yet with a margin"
    kind = "evaluation"
    if reports[0].screening:
        kind = f"screening ({reports[0].details['episodes']:.0f} episodes)"
    line += missing if sure < len(passed) else ""
    return f"{kind} at {count_text(steps)} steps: {line}"
