"""What a training shows and writes while it runs: the progress line and the TensorBoard log."""

import contextlib
import math
import typing
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from bounce_mjx.config import TrainConfig, dump_config
from bounce_mjx.evaluation import Report, Result

if typing.TYPE_CHECKING:
    from tensorboardX import SummaryWriter


def open_log(
    run: Path,
    first_step: int | None = None,
    suffix: str = "",
    config: TrainConfig | None = None,
) -> "SummaryWriter":
    """Opens a TensorBoard log in a run's folder.

    Args:
      first_step: that from which a run is resumed; what was logged later is taken back.
      suffix: of the file's name, which otherwise is that of any log opened in the same second.
      config: of the run, to be logged as text.
    """
    # tensorboardX imports PyTorch where that is installed, which takes seconds; this way they
    # pass beside the compilation.
    from tensorboardX import SummaryWriter
    from tensorboardX.record_writer import register_writer_factory

    register_writer_factory(_LOG_PREFIX, _LogFiles())
    purge_step = None if first_step is None else first_step + 1
    log = SummaryWriter(
        logdir=f"{_LOG_PREFIX}:{run}",
        purge_step=purge_step,
        flush_secs=10,
        filename_suffix=suffix,
    )
    if config is not None:
        log.add_text("config", f"```yaml\n{dump_config(config)}```", first_step or 0)
    return log


_LOG_PREFIX = "bounce_mjx"


class _LogFiles:
    """How tensorboardX opens the files of a log."""

    def directory_check(self, path: str) -> None:
        Path(path.removeprefix(f"{_LOG_PREFIX}:")).mkdir(parents=True, exist_ok=True)

    def open(self, path: str) -> "_LogFile":
        return _LogFile(Path(path.removeprefix(f"{_LOG_PREFIX}:")))


class _LogFile:
    """A file that keeps what a full disk does not take until it does. With an ordinary one, the
    thread of tensorboardX would end, and with it, in silence, the training."""

    def __init__(self, path: Path):
        self._path = path
        self._waiting = bytearray()

    def write(self, data: bytes) -> None:
        self._waiting += data

    def flush(self) -> None:
        with contextlib.suppress(OSError), self._path.open("ab", buffering=0) as file:
            while self._waiting:
                del self._waiting[: file.write(self._waiting)]

    def close(self) -> None:
        self.flush()


class Reporter:
    """Shows a progress bar on a terminal, a line a block elsewhere, and logs to TensorBoard."""

    def __init__(
        self,
        logs: Sequence["SummaryWriter"],
        console: Console,
        config: TrainConfig,
        first_step: int,
    ):
        """
        Args:
          logs: one a seed; none in a process that writes nothing.
        """
        self._console = console
        self._logs = logs
        self._progress = Progress(
            TextColumn("[bold]training"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f}% {task.fields[figures]}"),
            TimeElapsedColumn(),
            TextColumn("<"),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self._total_steps = config.total_steps
        self._task = self._progress.add_task(
            "training", total=config.total_steps, completed=first_step, figures=""
        )
        unknown = np.full(config.num_seeds, math.nan)
        self._last = {"episode/return": unknown, "episode/bounces": unknown}
        self._saving_problem: str | None = None

    def __enter__(self) -> "Reporter":
        self._progress.start()
        return self

    def __exit__(self, *_) -> None:
        self._progress.stop()
        for log in self._logs:
            log.close()

    def block(self, steps: int, seconds: float, metrics: dict[str, np.ndarray]) -> None:
        """Reports a block of iterations.

        Args:
          steps: environment steps done so far, of each seed.
          seconds: what the block took.
          metrics: each [seeds, iterations]; a value that is not a number is left out.
        """
        means = {name: _finite_mean(values) for name, values in metrics.items()}
        # A count, where a mean would hide one event in many iterations.
        non_finite = np.sum(metrics["task/non_finite"], axis=1)
        means["task/non_finite"] = non_finite.astype(float)
        for name, of_seeds in means.items():
            for log, value in zip(self._logs, of_seeds, strict=False):
                if math.isfinite(value):
                    log.add_scalar(name, float(value), steps)
        for name, last in self._last.items():
            self._last[name] = np.where(np.isfinite(means[name]), means[name], last)
        rate = means["speed/steps_per_second"][0]
        figures = (
            f"{steps / 1e6:.1f}M steps  {_short(rate)} steps/s  "
            f"return {_mean_and_deviation(self._last['episode/return'], 0)}  "
            f"bounces {_mean_and_deviation(self._last['episode/bounces'], 1)}"
        )
        self._progress.update(self._task, completed=steps, figures=figures)
        if not self._console.is_terminal:
            left = (self._total_steps - steps) * len(non_finite) / rate
            line = f"{figures}  {seconds:.1f} s, {left:.0f} s left"
            self._console.print(line, highlight=False, soft_wrap=True)

        if total := int(non_finite.sum()):
            had = "environment had a state that was not finite, and was reset"
            if total > 1:
                had = "environments had a state that was not finite, and were reset"
            self.say(f"{total:,} {had}")

    def say(self, line: str) -> None:
        """Prints a line."""
        self._console.print(line, highlight=False, soft_wrap=True)

    def saving_problem(
        self,
        problem: str | None,
        meanwhile: str = "the training goes on, and saves at its next evaluation",
    ) -> None:
        """Tells once why the last save failed, and once when there is no such problem any more."""
        sentence = problem and f"the state is not saved, as {problem}; make room: {meanwhile}"
        if sentence != self._saving_problem:
            self.say(sentence or "the state is saved again")
        self._saving_problem = sentence

    def evaluation(
        self, steps: int, reports: Sequence[Report], healthy: Sequence[bool] = (True,)
    ) -> None:
        """Reports an evaluation.

        Args:
          reports: one a seed.
          healthy: whether each seed has not diverged.
        """
        for log, report, sound in zip(self._logs, reports, healthy, strict=False):
            if not sound:
                continue
            for result in report.results:
                log.add_scalar(f"results/{result.name.replace(' ', '_')}", result.value, steps)
            for name, value in report.details.items():
                log.add_scalar(f"results/{name}", value, steps)
            log.add_text("results", results_markdown(report), steps)
        if len(reports) == 1:
            (report,) = reports
            met = sum(result.passed is not False for result in report.results)
            figures = ", ".join(f"{result.name} {result.value:.4g}" for result in report.results)
            line = f"{met} of {len(report.results)} results met ({figures})"
        else:
            solved = sum(r.passed and sound for r, sound in zip(reports, healthy, strict=True))
            line = f"{solved} of {len(reports)} seeds meet all results"
        self.say(f"evaluation at {steps / 1e6:.1f}M steps: {line}")


def results_table(report: Report, title: str) -> Table:
    """The five results as a table."""
    table = Table(title=title, title_justify="left")
    for column, justify in (
        ("result", "left"),
        ("measured", "left"),
        ("value", "right"),
        ("bound", "left"),
        ("", "left"),
    ):
        table.add_column(column, justify=justify)
    for result in report.results:
        colour = {True: "[green]", False: "[red]", None: ""}[result.passed]
        table.add_row(
            result.name,
            result.measured,
            f"{result.value:.2f}",
            result.bound,
            colour + verdict(result),
        )
    return table


def seeds_table(reports: dict[int, Report | None]) -> Table:
    """The five results of several seeds, the mean number of bounces in a row and the mean apex
    error, with mean and standard deviation over the seeds.

    Args:
      reports: by seed; None for one that diverged before any evaluation.
    """
    known = [report for report in reports.values() if report is not None]
    table = Table(title="best checkpoint of each seed", title_justify="left")
    table.add_column("seed", justify="right")
    for result in known[0].results:
        table.add_column(result.name.split()[0], justify="right")
    for column in ("bounces", "apex, cm", "all five"):
        table.add_column(column, justify="right")

    def figures(report: Report) -> list[float]:
        values = [result.value for result in report.results]
        details = report.details
        apex_error = 100 * details["mean_apex_error_m"]
        return [*values, details["mean_consecutive_bounces"], apex_error]

    for seed, report in reports.items():
        if report is None:
            table.add_row(str(seed), "diverged")
            continue
        met = "[green]pass" if report.passed else "[red]FAIL"
        table.add_row(str(seed), *[f"{value:.2f}" for value in figures(report)], met)
    table.add_section()
    values = np.array([figures(report) for report in known])
    passed = sum(report.passed for report in known)
    table.add_row("mean", *[f"{v:.2f}" for v in values.mean(axis=0)], f"{passed}/{len(reports)}")
    table.add_row("std", *[f"{v:.2f}" for v in values.std(axis=0)], "")
    return table


def results_markdown(report: Report) -> str:
    """The five results as a Markdown table."""
    lines = ["| result | measured | value | bound | |", "|---|---|---:|---|---|"]
    for result in report.results:
        # A bare | would begin a new cell.
        cells = (result.name, result.measured.replace("|", "&#124;"), f"{result.value:.2f}")
        lines.append(f"| {' | '.join(cells)} | {result.bound} | {verdict(result)} |")
    return "\n".join(lines)


def verdict(result: Result) -> str:
    """What became of a result, in a word or two."""
    return {True: "pass", False: "FAIL", None: "not judged"}[result.passed]


def details_line(report: Report) -> str:
    """The figures beside the five results, in one line."""
    d = report.details
    return (
        f"{d['episodes']:.0f} episodes: {d['mean_consecutive_bounces']:.1f} consecutive bounces, "
        f"|apex error| {100 * d['mean_apex_error_m']:.1f} cm, return {d['mean_return']:.0f}, "
        f"length {d['mean_length_s']:.2f} s (means)"
    )


def _finite_mean(values: np.ndarray) -> np.ndarray:
    """Mean of the finite values of each row; not a number where there is none."""
    finite = np.isfinite(values)
    number = finite.sum(axis=1)
    total = np.where(finite, values, 0.0).sum(axis=1)
    return np.where(number > 0, total / np.maximum(number, 1), math.nan)


def _mean_and_deviation(values: np.ndarray, digits: int) -> str:
    if len(values) == 1:
        return f"{values[0]:.{digits}f}"
    return f"{np.mean(values):.{digits}f} +- {np.std(values):.{digits}f}"


def _short(rate: float) -> str:
    return f"{rate / 1e6:.2f}M" if rate >= 1e6 else f"{rate / 1e3:.0f}k"
