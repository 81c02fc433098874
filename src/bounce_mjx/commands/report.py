"""Writes the report of a run: `bounce-mjx report [RUN]`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from bounce_mjx.commands.run_options import RunOptions
from bounce_mjx.config.command_line import parse
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.errors import exit_on_user_error
from bounce_mjx.garbage import no_garbage_collection
from bounce_mjx.interrupt import interruptible


class ReportCommand(StrictModel):
    """The command line."""

    run: Annotated[Path | None, tyro.conf.Positional] = None
    """A run's folder; latest, the default, is the newest run."""
    of_run: Annotated[RunOptions, tyro.conf.arg(name="")] = RunOptions()


@interruptible
def main(args: Sequence[str] | None = None) -> None:
    """Runs the command line."""
    with exit_on_user_error():
        command = parse(
            ReportCommand,
            sys.argv[1:] if args is None else args,
            prog="bounce-mjx report",
            description="Writes the report of a run, report.html in its folder.",
        )
        with no_garbage_collection():
            from bounce_mjx.reports.page import record_checkpoint, write_report
            from bounce_mjx.runs.folders import find_checkpoint, named_run

        checkpoint = find_checkpoint(named_run(command.run, command.of_run.folder))
        command.of_run.config(checkpoint.run)
        recording = record_checkpoint(checkpoint)
        path, _ = write_report(checkpoint.run, recording)
        print(path)
