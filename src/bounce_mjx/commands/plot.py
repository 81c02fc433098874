"""Draws learning curves and an evaluation: `bounce-mjx plot [RUN ...]`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro
from pydantic import Field

from bounce_mjx.commands.run_options import RunOptions
from bounce_mjx.config.command_line import parse
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.garbage import no_garbage_collection
from bounce_mjx.interrupt import interruptible


class PlotCommand(StrictModel):
    """The command line."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Folders of runs; latest, the default, is the newest run. Runs that differ only in the seed
    become one curve with a band, as do the seeds of one run. For a run of one seed, or one
    checkpoint in it, the evaluation is drawn too."""
    out: Path = Path("plots")
    """Folder for the pictures: curves, rewards and, for one run, evaluation."""
    formats: Annotated[tuple[Literal["png", "svg"], ...], Field(min_length=1)] = ("png", "svg")
    """File formats of each picture."""
    of_run: Annotated[RunOptions, tyro.conf.arg(name="")] = RunOptions()


@interruptible
def main(args: Sequence[str] | None = None) -> None:
    """Runs the command line."""
    with exit_on_user_error():
        command = parse(
            PlotCommand,
            sys.argv[1:] if args is None else args,
            prog="bounce-mjx plot",
            description="Draws the learning curves of runs, and the evaluation of a checkpoint.",
        )
        with no_garbage_collection():
            from bounce_mjx.env.env import Env
            from bounce_mjx.reports.curves import group_runs
            from bounce_mjx.reports.figures import (
                curves_figure,
                evaluation_figure,
                image,
                rewards_figure,
            )
            from bounce_mjx.reports.page import record_checkpoint
            from bounce_mjx.runs.files import write_output
            from bounce_mjx.runs.folders import find_checkpoint, named_run, runs_of_seeds

        runs = [named_run(run, command.of_run.folder) for run in command.runs or (None,)]
        seeds = [seed for run in runs for seed in runs_of_seeds(run)]
        checkpoints = [find_checkpoint(seed) for seed in seeds]
        configs = [command.of_run.config(checkpoint.run) for checkpoint in checkpoints]
        groups = group_runs([checkpoint.run for checkpoint in checkpoints])
        figures = {"curves": curves_figure(groups), "rewards": rewards_figure(groups)}
        if len(checkpoints) == 1:
            env = Env(configs[0].env)
            figures["evaluation"] = evaluation_figure(env, record_checkpoint(checkpoints[0]))
        for name, figure in figures.items():
            for suffix in command.formats:
                path = command.out / f"{name}.{suffix}"
                try:
                    command.out.mkdir(parents=True, exist_ok=True)
                    write_output(path, image(figure, suffix))
                except OSError as error:
                    raise UserError(
                        f"{path} cannot be written ({error.strerror}); choose another folder with "
                        "--out"
                    ) from error
                print(path)
