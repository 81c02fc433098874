"""Writes the report of a run: `bounce-mjx report [RUN]`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from bounce_mjx.commands.which_policy import WhichPolicy
from bounce_mjx.config.command_line import Flag, parse
from bounce_mjx.errors import UserError
from bounce_mjx.runs.config import load_run_config


class ReportCommand(WhichPolicy):
    """Writes the report of a run, report.html in its folder."""

    run: Annotated[Path | None, Flag(metavar="[RUN]", is_positional=True)] = None
    """A run's folder; latest, the default, is the newest run."""


def main(args: Sequence[str]) -> None:
    """Runs the command line."""
    command = parse(ReportCommand, args, prog="bounce-mjx report")
    from bounce_mjx.runs.folders import find_checkpoint

    (place,) = command.choose_places(command.run)
    checkpoint = find_checkpoint(place)
    # With several seeds, that of the best one lies below the run.
    if checkpoint.run.absolute() in place.absolute().parents:
        raise UserError(
            f"a report is of a run's best checkpoint; give {checkpoint.run}, not {place}"
        )
    config = load_run_config(checkpoint.run)

    # These take seconds, which a mistake in the words above should not.
    from bounce_mjx.reports.page import write_report
    from bounce_mjx.training.setup import set_up_jax

    set_up_jax(config.env)
    print(write_report(checkpoint.run))
