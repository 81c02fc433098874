"""A training run in a command: its start, the printed results and the report."""

import contextlib
import importlib.util
import shlex
import time
from collections.abc import Callable, Sequence

from rich.console import Console

from bounce_mjx.config.command_line import stdout
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError, install_command, reason_of
from bounce_mjx.interrupt import leave
from bounce_mjx.reports.tables import details_line, results_table, seeds_table, unsolved_line
from bounce_mjx.runs.config import TrainConfig, shown_file
from bounce_mjx.runs.folders import find_checkpoint
from bounce_mjx.training import hosts
from bounce_mjx.training.command import TrainCommand, config_of, named_task
from bounce_mjx.training.console import say
from bounce_mjx.training.job import SeedRun, TrainingStopped, train
from bounce_mjx.training.log import open_log
from bounce_mjx.training.trainer import Trainer, Watcher


def run_command(
    command: TrainCommand,
    make_trainer: Callable[[TrainConfig, Env], Trainer],
    watcher: Watcher | None = None,
) -> None:
    """Trains according to the command, and prints the results.

    Args:
      watcher: receives the progress of the first seed.

    Raises:
      UserError: see `train`; or a package that the command asks for is missing.
    """
    if command.wandb is not None and importlib.util.find_spec("wandb") is None:
        raise UserError(
            "--wandb needs the package wandb; install it with: "
            f"{install_command('bounce_mjx[wandb]')}"
        )
    console = stdout(quiet=not hosts.is_leader())
    if command.resume is None:
        say(console, f"config: {' on '.join(map(shown_file, reversed(command.config)))}")
        if command.warm_start is not None:
            say(console, f"warm start: {command.warm_start}")
    try:
        seeds = train(config_of(command), console, make_trainer, command, watcher)
    except TrainingStopped as stop:
        say(console, str(stop))
        # Does not wait for a compilation or an evaluation in another thread.
        leave(0)
    best = print_results(seeds, console)
    run = shlex.join([str(best.run), *named_task(command)])
    if command.report and hosts.is_leader():
        leave_report(best, console, f"bounce-mjx report {run}")
    say(console, f"measure it: bounce-mjx eval {run}")
    say(console, f"watch it: bounce-mjx play {run}")


def print_results(seeds: Sequence[SeedRun], console: Console) -> SeedRun:
    """Prints the results of a training run; returns the best seed."""
    best = max((s for s in seeds if s.report is not None), key=lambda s: s.report.score)
    if len(seeds) > 1:
        console.print(seeds_table({s.config.seed: s.report for s in seeds}))
    else:
        steps = best.progress.best_steps
        console.print(results_table(best.report, f"best checkpoint, {steps:,} steps"))
        say(console, details_line(best.report))
    if unsolved := unsolved_line(best.report):
        say(console, unsolved)
    spent = ", ".join(f"{name} {value:.1f} s" for name, value in best.seconds.items())
    say(console, f"time: {spent}")
    label = "run" if len(seeds) == 1 else f"best seed: {best.config.seed}  run"
    say(console, f"{label}: {best.run}")
    return best


def leave_report(seed: SeedRun, console: Console, again: str) -> None:
    """Draws the report, and the figure of the final evaluation in the TensorBoard log. The training
    is already saved, so a failure only prints one line.

    Args:
      again: the command that draws the report.
    """
    started = time.perf_counter()
    try:
        # Imported during the compilation (`job.REPORT_MODULE`).
        from bounce_mjx.reports import figures, page

        recording = seed.report.recording or page.record_checkpoint(find_checkpoint(seed.run))
        path, evaluation = page.write_report(seed.run, recording)
        # A new file, because the log of the training is already closed.
        with contextlib.closing(open_log(seed.run, suffix=".report")) as log:
            log.add_image("evaluation", figures.pixels(evaluation), seed.progress.best_steps)
    except Exception as error:
        say(console, f"report: not drawn ({reason_of(error)}); draw it with: {again}")
    else:
        say(console, f"report: {path}  ({time.perf_counter() - started:.1f} s)")
