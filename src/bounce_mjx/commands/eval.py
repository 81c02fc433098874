"""Measures the results of a trained policy: `bounce-mjx eval [CHECKPOINT]`."""

import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from bounce_mjx.commands.run_options import RunOptions, parse_with_commands
from bounce_mjx.config.settings import Count, NonNegativeInt, StrictModel
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.evaluation.config import (
    DEFAULT_EPISODES,
    DEFAULT_SEED,
    EvaluationOptions,
    Physics,
)
from bounce_mjx.garbage import no_garbage_collection
from bounce_mjx.interrupt import interruptible
from bounce_mjx.training.loop_fusion import join_loops

# An evaluation that is not slower needs no lines about its progress.
_SILENT_SECONDS = 10.0


class EvalCommand(StrictModel):
    """The command line."""

    checkpoint: Annotated[Path | None, tyro.conf.Positional] = None
    """A run's folder (its best checkpoint), a checkpoint in it, latest for the newest run, or a
    policy that comes with the package: pretrained or robust. The default is the newest run, or
    pretrained if there is no run."""
    episodes: Count = DEFAULT_EPISODES
    """Episodes, each from its own reset."""
    seed: NonNegativeInt = DEFAULT_SEED
    """Seed of the resets."""
    nominal: bool = False
    """Whether the worlds are the model's own; else each episode draws one, as in the training."""
    physics: Physics = "config"
    """Physics engine: mujoco is MuJoCo's C engine; config is the engine of the training."""
    json_file: Annotated[Path | None, tyro.conf.arg(name="json")] = None
    """File to write the results to."""
    of_run: Annotated[RunOptions, tyro.conf.arg(name="")] = RunOptions()


@interruptible
def main(args: Sequence[str] | None = None) -> None:
    """Runs the command line; exits with 0 if all results pass, 1 if one fails, 2 on a mistake."""
    with exit_on_user_error():
        args = sys.argv[1:] if args is None else args
        command, flags = parse_with_commands(
            EvalCommand,
            args,
            prog="bounce-mjx eval",
            description="Measures the results of a trained policy.",
        )
        if command.json_file is not None:
            _check_writable(command.json_file)
        with no_garbage_collection():
            from bounce_mjx.evaluation.policy_evaluation import evaluate_policy
            from bounce_mjx.reports.tables import details_line, results_table
            from bounce_mjx.runs.files import to_json, write_output
            from bounce_mjx.runs.folders import choose_checkpoint
            from bounce_mjx.runs.reading import load_policy
            from bounce_mjx.training.setup import set_up_jax

        console = Console()
        checkpoint = choose_checkpoint(command.checkpoint, command.of_run.folder, console)
        config = command.of_run.config(checkpoint.run)
        commands = flags.values(config.env)
        engine = {"physics": command.physics} if command.physics in ("fused", "mjx") else {}
        join_loops(config.env.model_copy(update=engine))
        set_up_jax()
        policy = load_policy(checkpoint, config)
        console.out(
            f"checkpoint: {checkpoint.folder} ({checkpoint.steps:,} steps)", highlight=False
        )
        length = f"{command.episodes:,} episodes of {config.env.episode_seconds:g} s"
        with _Progress(console) as progress:
            report, engine, warnings = evaluate_policy(
                policy,
                config.env,
                config.ppo,
                EvaluationOptions(
                    command.episodes, command.seed, command.physics, command.nominal, commands
                ),
                started=lambda engine: console.out(f"physics: {engine}  {length}", highlight=False),
                progress=progress.show,
            )
        for warning in warnings:
            console.print(f"warning: {warning}", markup=False, highlight=False, soft_wrap=True)
        console.print(results_table(report, "the results"))
        console.print(details_line(report), highlight=False)
        if command.json_file is not None:
            plain = {"checkpoint": str(checkpoint.folder), "physics": engine, **report.to_dict()}
            plain |= {"seed": command.seed, "commands": commands, "nominal": command.nominal}
            try:
                write_output(command.json_file, to_json(plain))
            except OSError as error:
                raise UserError(
                    f"--json {command.json_file} cannot be written ({error.strerror}); give "
                    "another file"
                ) from error
    sys.exit(0 if report.passed else 1)


class _Progress:
    """A progress bar on a terminal; elsewhere, a line after each tenth of a slow evaluation."""

    def __init__(self, console: Console):
        columns = TextColumn("{task.description}"), BarColumn(), TaskProgressColumn()
        self._console = console
        self._bar = Progress(
            *columns,
            TimeElapsedColumn(),
            TextColumn("<"),
            TimeRemainingColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("compiling", total=1.0)
        self._said, self._said_at = 0.0, time.monotonic()

    def __enter__(self) -> "_Progress":
        self._bar.start()
        return self

    def __exit__(self, *_) -> None:
        self._bar.stop()

    def show(self, share: float) -> None:
        """Shows the share of the evaluation that is done, from 0 to 1."""
        self._bar.update(self._task, completed=share, description="evaluating")
        slow = time.monotonic() - self._said_at >= _SILENT_SECONDS
        if not self._console.is_terminal and slow and share - self._said >= 0.1:
            self._said, self._said_at = share, time.monotonic()
            self._console.print(f"{share:.0%} evaluated", highlight=False)


def _check_writable(json_file: Path) -> None:
    """Fails before the evaluation if its results could not be written."""
    if not os.path.isdir(json_file.absolute().parent):
        raise UserError(f"the folder of --json {json_file} does not exist; make it")
    if os.path.isdir(json_file):
        raise UserError(f"--json {json_file} is a folder; give a file")
