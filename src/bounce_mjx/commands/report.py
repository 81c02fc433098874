"""Writes the report of a run: `bounce-mjx report [RUN]`."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from bounce_mjx.commands.run_options import RunCommand
from bounce_mjx.config.command_line import parse
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.viewers.options import ViewerOptions


class ReportCommand(RunCommand):
    """Writes the report of a run, report.html in its folder, with a replay."""

    run: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[RUN]")] = None
    """A run's folder; latest, the default, is the newest run."""


@exit_on_user_error()
def main(args: Sequence[str]) -> None:
    """Runs the command line."""
    command = parse(ReportCommand, args, prog="bounce-mjx report")
    from bounce_mjx.commands.play import load_shown
    from bounce_mjx.reports.page import REPLAY_FILE, record_checkpoint, write_report
    from bounce_mjx.runs.folders import find_checkpoint, named_run
    from bounce_mjx.training.setup import set_up_jax
    from bounce_mjx.viewers.show import show

    checkpoint, console = find_checkpoint(named_run(command.run, command.folder)), Console()
    page = checkpoint.run / REPLAY_FILE
    if page.is_dir() or not os.access(checkpoint.run, os.W_OK):
        raise UserError(f"{page} cannot be written; make its folder writable, and its place free")
    config = command.config(checkpoint.run)
    set_up_jax(config.env)
    shown = load_shown(checkpoint, config, console)
    recording = record_checkpoint(checkpoint)
    show([shown], ViewerOptions(html=page), commands={}, console=console)
    report, _ = write_report(checkpoint.run, recording)
    print(report)
