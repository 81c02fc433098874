"""Draws learning curves and an evaluation: `bounce-mjx plot [RUN ...]`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from bounce_mjx.commands.which_policy import WhichPolicy
from bounce_mjx.config.command_line import Flag, parse
from bounce_mjx.runs.config import load_run_config


class PlotCommand(WhichPolicy):
    """Draws the learning curves of runs, and the evaluation of a checkpoint."""

    runs: Annotated[tuple[Path, ...], Flag(metavar="[RUN ...]", is_positional=True)] = ()
    """Folders of runs; latest, the default, is the newest run. Runs that differ only in the seed
    become one curve with a band, as do the seeds of one run. For a run of one seed, or one
    checkpoint in it, the evaluation is drawn too."""
    out: Path = Path("plots")
    """Folder for the pictures: curves, rewards, what your task's file registers and, for one run,
    evaluation."""
    formats: Annotated[tuple[Literal["png", "svg"], ...], Field(min_length=1)] = ("png", "svg")
    """File formats of each picture."""


def main(args: Sequence[str]) -> None:
    """Runs the command line."""
    command = parse(PlotCommand, args, prog="bounce-mjx plot")
    from bounce_mjx.runs.folders import find_checkpoint, runs_of_seeds

    places = command.choose_places(*command.runs or (None,))
    # With several seeds, each has its own curves.
    each = [folder for place in places for folder in runs_of_seeds(place)]
    checkpoints = [find_checkpoint(place) for place in each]
    configs = [load_run_config(checkpoint.run) for checkpoint in checkpoints]

    # These take seconds, which a mistake in the words above should not.
    from bounce_mjx.env.env import Env
    from bounce_mjx.reports import curves, figures, page
    from bounce_mjx.runs.storage import writable, write_output
    from bounce_mjx.training.setup import set_up_jax

    set_up_jax(*(config.env for config in configs))
    groups = curves.group_runs([checkpoint.run for checkpoint in checkpoints])
    with writable(command.out, "choose another folder with --out"):
        command.out.mkdir(parents=True, exist_ok=True)
    drawn = {name: plot.draw(groups) for name, plot in figures.RUN_PLOTS.items()}
    if len(checkpoints) == 1:
        recording = page.record_checkpoint(checkpoints[0])
        drawn[figures.EVALUATION] = figures.evaluation_figure(Env(configs[0].env), recording)
    for name, figure in drawn.items():
        for suffix in command.formats:
            path = command.out / f"{name}.{suffix}"
            write_output(path, figures.image(figure, suffix))
            print(path)
