"""The lines that a running training prints."""

import math
import time
from collections.abc import Sequence

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

from bounce_mjx.evaluation.results import Report
from bounce_mjx.reports.tables import count_text, figure_text
from bounce_mjx.runs.config import TrainConfig


class Reporter:
    """Shows a progress bar on a terminal, or a line per block elsewhere."""

    def __init__(self, console: Console, config: TrainConfig, first_step: int):
        self._console, self._config, self._first_step = console, config, first_step
        columns = BarColumn(), TaskProgressColumn(), TextColumn("{task.description}")
        self._bar = Progress(*columns, console=console, disable=not console.is_terminal)
        self._started = time.monotonic()
        total = config.total_steps
        self._task = self._bar.add_task("training", total=total, completed=first_step)
        self._last = {"episode/return": np.full(config.num_seeds, math.nan)}
        self._last |= dict.fromkeys(
            (curve.tag for curve in config.env.task.curves[:1]), self._last["episode/return"]
        )
        self._saving_problem: str | None = None

    def __enter__(self) -> "Reporter":
        self._bar.start()
        return self

    def __exit__(self, *_) -> None:
        self._bar.stop()

    def block(self, steps: int, seconds: float, means: dict[str, np.ndarray]) -> None:
        """Reports a block of iterations.

        Args:
          steps: environment steps of each seed so far.
          seconds: duration of the block.
          means: see `block_means`.
        """
        for name, last in self._last.items():
            self._last[name] = np.where(np.isfinite(means[name]), means[name], last)
        rate = means["speed/steps_per_second"][0]
        figures = f"{count_text(steps)} steps  {count_text(rate)} steps/s"
        for tag, values in self._last.items():
            form = ".0f" if tag == "episode/return" else ".3g"
            spread = f" +- {np.std(values):{form}}" if len(values) > 1 else ""
            figures += f"  {tag.rpartition('/')[2]} {np.mean(values):{form}}{spread}"
        # At the mean speed so far with its evaluations; the training may end earlier.
        share = (self._config.total_steps - steps) / (steps - self._first_step)
        left = f"{share * (time.monotonic() - self._started):.0f} s left"
        left = f"at most {left}" if self._config.stop_when_solved else left
        line = f"{figures}  {seconds:.1f} s, {left}"
        self._bar.update(self._task, completed=steps, description=line)
        if not self._console.is_terminal:
            self.say(line)
        if total := int(means["task/non_finite"].sum()):
            self.say(f"states that were not finite, whose environments were reset: {total:,}")

    def say(self, line: str) -> None:
        """Prints a line."""
        say(self._console, line)

    def saving_problem(self, problem: str | None) -> None:
        """Prints once why saving fails, and once when it works again."""
        if problem is not None and self._saving_problem is None:
            meanwhile = "training continues, and saves at its next evaluation"
            self.say(f"the state is not saved, as {problem}; make room: {meanwhile}")
        elif problem is None and self._saving_problem is not None:
            self.say("the state is saved again")
        self._saving_problem = problem

    def evaluation(self, steps: int, reports: Sequence[Report]) -> None:
        """Reports an evaluation, with a report of each seed that has not diverged."""
        passed = [report for report in reports if report.passed]
        sure = sum(report.passed_with_margin for report in passed)
        line = f"{len(passed)} of {self._config.num_seeds} seeds meet all results"
        missing = f", {sure} with a margin"
        if self._config.num_seeds == 1:
            (report,) = reports
            figures = (f"{r.name} {figure_text(r.value, '.4g')}" for r in report.results)
            line = f"{report.summary} ({', '.join(figures)})"
            missing = ", not yet with a margin"
        kind = "evaluation"
        if reports[0].screening:
            kind = f"screening ({reports[0].details['episodes']:.0f} episodes)"
        line += missing if sure < len(passed) else ""
        self.say(f"{kind} at {count_text(steps)} steps: {line}")


def say(console: Console, line: str) -> None:
    """Prints a line unchanged: rich would read square brackets in a path as markup."""
    console.print(line, highlight=False, markup=False, soft_wrap=True)
