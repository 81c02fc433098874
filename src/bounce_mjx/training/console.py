"""Output of a running training: the progress line and the TensorBoard log."""

import math
import time
from collections.abc import Callable, Sequence

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

from bounce_mjx.evaluation.results import Report
from bounce_mjx.reports.tables import count_text, figure_text, results_markdown
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.training.log import TensorBoardLog
from bounce_mjx.training.trainer import Watcher


class Reporter:
    """Shows a progress bar on a terminal, or a line per block elsewhere, and logs to
    TensorBoard."""

    def __init__(
        self,
        logs: Callable[[], Sequence[TensorBoardLog]],
        console: Console,
        config: TrainConfig,
        first_step: int,
        watcher: Watcher | None = None,
    ):
        """
        Args:
          logs: returns one log per seed, none in a process that writes nothing; it is first called
            after the first block, as TensorBoard's library takes seconds to import.
        """
        self._console, self._watcher, self._logs = console, watcher, logs
        columns = BarColumn(), TaskProgressColumn(), TextColumn("{task.description}")
        self._bar = Progress(*columns, console=console, disable=not console.is_terminal)
        self._config, self._first_step = config, first_step
        self._started = time.monotonic()
        total = config.total_steps
        self._task = self._bar.add_task("training", total=total, completed=first_step)
        unknown = np.full(config.num_seeds, math.nan)
        self._last = {"episode/return": unknown}
        self._last |= dict.fromkeys((c.tag for c in config.env.task.curves[:1]), unknown)
        self._saving_problem: str | None = None

    def __enter__(self) -> "Reporter":
        self._bar.start()
        return self

    def __exit__(self, *_) -> None:
        self._bar.stop()
        for log in self._logs():
            log.close()

    def block(self, steps: int, seconds: float, metrics: dict[str, np.ndarray]) -> None:
        """Reports a block of iterations.

        Args:
          steps: environment steps of each seed so far.
          seconds: duration of the block.
          metrics: each [seeds, iterations]; NaN is ignored.
        """
        means = {
            name: np.ma.masked_invalid(values).mean(axis=1).filled(math.nan)
            for name, values in metrics.items()
        }
        # A sum, because a mean would hide a single event in many iterations.
        non_finite = np.nansum(metrics["task/non_finite"], axis=1)
        means["task/non_finite"] = non_finite.astype(float)
        for name, seed_values in means.items():
            for log, value in zip(self._logs(), seed_values, strict=False):
                if math.isfinite(value):
                    log.add_scalar(name, float(value), steps)
        if self._watcher is not None:
            self._watcher.block(steps, {name: float(values[0]) for name, values in means.items()})
        for name, last in self._last.items():
            self._last[name] = np.where(np.isfinite(means[name]), means[name], last)
        rate = means["speed/steps_per_second"][0]
        figures = f"{count_text(steps)} steps  {count_text(rate)} steps/s"
        for tag, values in self._last.items():
            form = ".0f" if tag == "episode/return" else ".3g"
            figures += f"  {tag.rpartition('/')[2]} {_mean_and_deviation(values, form)}"
        line = f"{figures}  {seconds:.1f} s, {self._time_left(steps)}"
        self._bar.update(self._task, completed=steps, description=line)
        if not self._console.is_terminal:
            self.say(line)

        if total := int(non_finite.sum()):
            had = "environment had a state that was not finite, and was reset"
            if total > 1:
                had = "environments had a state that was not finite, and were reset"
            self.say(f"{total:,} {had}")

    def _time_left(self, steps: int) -> str:
        """The time until the last step, at the mean speed so far with its evaluations; an upper
        bound if the training may end earlier."""
        share = (self._config.total_steps - steps) / (steps - self._first_step)
        left = f"{share * (time.monotonic() - self._started):.0f} s left"
        return f"at most {left}" if self._config.stop_when_solved else left

    def say(self, line: str) -> None:
        """Prints a line."""
        say(self._console, line)

    def flush(self) -> None:
        """Writes everything reported so far to the logs' files."""
        for log in self._logs():
            log.flush()

    def saving_problem(self, problem: str | None) -> None:
        """Prints once why saving fails, and once when it works again."""
        if problem is not None and self._saving_problem is None:
            meanwhile = "training continues, and saves at its next evaluation"
            self.say(f"the state is not saved, as {problem}; make room: {meanwhile}")
        elif problem is None and self._saving_problem is not None:
            self.say("the state is saved again")
        self._saving_problem = problem

    def evaluation(
        self, steps: int, reports: Sequence[Report], healthy: Sequence[bool] = (True,)
    ) -> None:
        """Reports an evaluation.

        Args:
          reports: one report per seed.
          healthy: False for a seed that diverged.
        """
        for log, report, sound in zip(self._logs(), reports, healthy, strict=False):
            if not sound:
                continue
            group = "screening" if report.screening else "results"
            values = {result.name.replace(" ", "_"): result.value for result in report.results}
            for name, value in (values | report.details).items():
                if value is not None:
                    log.add_scalar(f"{group}/{name}", value, steps)
            log.add_text(group, results_markdown(report), steps)
        passed = [r for r, sound in zip(reports, healthy, strict=True) if r.passed and sound]
        sure = sum(report.passed_with_margin for report in passed)
        if len(reports) == 1:
            (report,) = reports
            figures = (f"{r.name} {figure_text(r.value, '.4g')}" for r in report.results)
            line = f"{report.summary} ({', '.join(figures)})"
            missing = ", not yet with a margin"
        else:
            line = f"{len(passed)} of {len(reports)} seeds meet all results"
            missing = f", {sure} with a margin"
        if sure < len(passed):
            line += missing
        kind = "evaluation"
        if reports[0].screening:
            kind = f"screening ({reports[0].details['episodes']:.0f} episodes)"
        self.say(f"{kind} at {count_text(steps)} steps: {line}")


def say(console: Console, line: str) -> None:
    """Prints a line unchanged: rich would read square brackets in a path as markup."""
    console.print(line, highlight=False, markup=False, soft_wrap=True)


def _mean_and_deviation(values: np.ndarray, form: str) -> str:
    if len(values) == 1:
        return f"{values[0]:{form}}"
    return f"{np.mean(values):{form}} +- {np.std(values):{form}}"
