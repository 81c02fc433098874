"""What a training shows and writes while it runs: the progress line and the TensorBoard log."""

import contextlib
import math
import typing
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from bounce_mjx.config import TrainConfig, dump_config
from bounce_mjx.evaluation import Report, Result

if typing.TYPE_CHECKING:
    from tensorboardX import SummaryWriter


def open_log(run: Path, first_step: int | None = None, suffix: str = "") -> "SummaryWriter":
    """Opens a TensorBoard log in a run's folder.

    Args:
      first_step: that from which a run is resumed; what was logged later is taken back.
      suffix: of the file's name, which otherwise is that of any log opened in the same second.
    """
    # tensorboardX imports PyTorch where that is installed, which takes seconds; this way they
    # pass beside the compilation.
    from tensorboardX import SummaryWriter
    from tensorboardX.record_writer import register_writer_factory

    register_writer_factory(_LOG_PREFIX, _LogFiles())
    purge_step = None if first_step is None else first_step + 1
    return SummaryWriter(
        logdir=f"{_LOG_PREFIX}:{run}",
        purge_step=purge_step,
        flush_secs=10,
        filename_suffix=suffix,
    )


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
        self, log: "SummaryWriter", console: Console, config: TrainConfig, first_step: int
    ):
        self._console = console
        self._writer = log
        self._writer.add_text("config", f"```yaml\n{dump_config(config)}```", first_step)
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
        self._last = {"episode/return": math.nan, "episode/bounces": math.nan}
        self._saving_problem = False

    def __enter__(self) -> "Reporter":
        self._progress.start()
        return self

    def __exit__(self, *_) -> None:
        self._progress.stop()
        self._writer.close()

    def block(self, steps: int, seconds: float, metrics: dict[str, np.ndarray]) -> None:
        """Reports a block of iterations.

        Args:
          steps: environment steps done so far.
          seconds: what the block took.
          metrics: each [iterations]; a value that is not a number is left out.
        """
        means = {}
        for name, values in metrics.items():
            present = values[np.isfinite(values)]
            if present.size:
                means[name] = float(present.mean())
        # A count, where a mean would hide one event in many iterations.
        non_finite = int(np.sum(metrics.get("task/non_finite", 0)))
        means["task/non_finite"] = float(non_finite)
        for name, value in means.items():
            self._writer.add_scalar(name, value, steps)
        self._last |= {name: means[name] for name in self._last if name in means}
        rate = means["speed/steps_per_second"]
        figures = (
            f"{steps / 1e6:.1f}M steps  {_short(rate)} steps/s  "
            f"return {self._last['episode/return']:.0f}  "
            f"bounces {self._last['episode/bounces']:.1f}"
        )
        self._progress.update(self._task, completed=steps, figures=figures)
        if not self._console.is_terminal:
            left = (self._total_steps - steps) / rate
            line = f"{figures}  {seconds:.1f} s, {left:.0f} s left"
            self._console.print(line, highlight=False, soft_wrap=True)

        if non_finite:
            self.say(f"{non_finite:,} environments had a state that was not finite, and were reset")

    def say(self, line: str) -> None:
        """Prints a line."""
        self._console.print(line, highlight=False, soft_wrap=True)

    def saving_problem(
        self,
        problem: str | None,
        until_then: str = "the training goes on, and saves at its next evaluation",
    ) -> None:
        """Tells once why the last save failed, and once when there is no such problem any more."""
        if problem is not None and not self._saving_problem:
            self.say(f"the state is not saved, as {problem}; make room: {until_then}")
        if problem is None and self._saving_problem:
            self.say("the state is saved again")
        self._saving_problem = problem is not None

    def evaluation(self, steps: int, report: Report) -> None:
        """Reports an evaluation."""
        for result in report.results:
            self._writer.add_scalar(f"results/{result.name.replace(' ', '_')}", result.value, steps)
        for name, value in report.details.items():
            self._writer.add_scalar(f"results/{name}", value, steps)
        self._writer.add_text("results", results_markdown(report), steps)
        met = sum(result.passed is not False for result in report.results)
        figures = ", ".join(f"{result.name} {result.value:.4g}" for result in report.results)
        self._console.print(
            f"evaluation at {steps / 1e6:.1f}M steps: {met} of {len(report.results)} results met "
            f"({figures})",
            highlight=False,
            soft_wrap=True,
        )


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


def _short(rate: float) -> str:
    return f"{rate / 1e6:.2f}M" if rate >= 1e6 else f"{rate / 1e3:.0f}k"
