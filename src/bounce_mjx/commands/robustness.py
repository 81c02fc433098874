"""Measures the results of a policy in perturbed worlds: `bounce-mjx robustness [CHECKPOINT]`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from bounce_mjx.commands.run_options import RunOptions
from bounce_mjx.config.command_line import parse
from bounce_mjx.config.settings import Count, NonNegativeInt, StrictModel
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.evaluation.config import (
    DEFAULT_CONDITION_EPISODES,
    DEFAULT_SEED,
    EvaluationOptions,
    Physics,
)
from bounce_mjx.garbage import no_garbage_collection
from bounce_mjx.interrupt import interruptible
from bounce_mjx.resources import resource_path
from bounce_mjx.training.loop_fusion import join_loops

if TYPE_CHECKING:
    from bounce_mjx.evaluation.robustness import ConditionOutcome, RobustnessReport
    from bounce_mjx.evaluation.suite import Condition
    from bounce_mjx.learning.policy import Policy
    from bounce_mjx.runs.config import TrainConfig


class RobustnessCommand(StrictModel):
    """The command line."""

    checkpoint: Annotated[Path | None, tyro.conf.Positional] = None
    """A run's folder (its best checkpoint), a checkpoint in it, latest for the newest run, or a
    policy that comes with the package: pretrained or robust. The default is the newest run, or
    pretrained if there is no run."""
    suite: Path | None = None
    """YAML file of the perturbations; the default is configs/robustness.yaml."""
    episodes: Count = DEFAULT_CONDITION_EPISODES
    """Episodes in each condition."""
    seed: NonNegativeInt = DEFAULT_SEED
    """Seed of the resets."""
    physics: Physics = "config"
    """Engine: mujoco is MuJoCo's C engine; config is the engine of the training."""
    out: Path | None = None
    """Folder for robustness.json and the pictures. The default is the run's folder, or robustness
    for a policy that comes with the package."""
    of_run: Annotated[RunOptions, tyro.conf.arg(name="")] = RunOptions()


@interruptible
def main(args: Sequence[str] | None = None) -> None:
    """Runs the command line; exits with 0 if all conditions meet all judged results, 1 if one does
    not, 2 on a mistake."""
    with exit_on_user_error():
        args = sys.argv[1:] if args is None else args
        command = parse(
            RobustnessCommand,
            args,
            prog="bounce-mjx robustness",
            description="Measures the results of a trained policy in perturbed worlds.",
        )
        with no_garbage_collection():
            from bounce_mjx.evaluation.robustness import RobustnessReport
            from bounce_mjx.evaluation.suite import load_suite
            from bounce_mjx.reports.robustness import robustness_table
            from bounce_mjx.runs.folders import SHIPPED, choose_checkpoint
            from bounce_mjx.runs.reading import load_policy
            from bounce_mjx.training.setup import set_up_jax

        console = Console()
        checkpoint = choose_checkpoint(command.checkpoint, command.of_run.folder, console)
        config = command.of_run.config(checkpoint.run)
        suite = command.suite or resource_path("configs/robustness.yaml")
        conditions = load_suite(suite, config.env)
        engine = {"physics": command.physics} if command.physics in ("fused", "mjx") else {}
        join_loops(*(condition.env.model_copy(update=engine) for condition in conditions))
        set_up_jax()
        policy = load_policy(checkpoint, config)
        shipped = checkpoint.run in map(resource_path, SHIPPED.values())
        out = command.out or (Path("robustness") if shipped else checkpoint.run)
        _make_folder(out)
        outcomes = _measure(command, config, policy, conditions, console)
        report = RobustnessReport(
            checkpoint=str(checkpoint.folder),
            steps=checkpoint.steps,
            suite=str(suite),
            episodes=command.episodes,
            seed=command.seed,
            measured=outcomes[0].measured,
            outcomes=outcomes,
        )
        console.print(robustness_table(report))
        _write(out, report)
    sys.exit(0 if report.passed else 1)


def _measure(
    command: RobustnessCommand,
    config: "TrainConfig",
    policy: "Policy",
    conditions: "Sequence[Condition]",
    console: Console,
) -> "list[ConditionOutcome]":
    """Measures all conditions and shows a progress bar."""
    from bounce_mjx.evaluation.robustness import measure_conditions

    options = EvaluationOptions(command.episodes, command.seed, command.physics)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    with Progress(*columns, TimeElapsedColumn(), console=console, transient=True) as bar:
        task = bar.add_task("conditions", total=len(conditions))
        return measure_conditions(
            policy,
            config.ppo,
            conditions,
            options,
            progress=lambda done: bar.update(task, completed=done),
        )


def _make_folder(out: Path) -> None:
    """Fails before the evaluation if its results could not be written."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _not_writable(out, error) from error


def _write(out: Path, report: "RobustnessReport") -> None:
    """Writes the results and the pictures, and prints their paths."""
    from bounce_mjx.reports.figures import image
    from bounce_mjx.reports.robustness import ROBUSTNESS_FILE, robustness_figure
    from bounce_mjx.runs.files import to_json, write_atomically

    figure = robustness_figure(report)
    try:
        write_atomically(out / ROBUSTNESS_FILE, to_json(report.model_dump()))
        for suffix in ("png", "svg"):
            write_atomically(out / f"robustness.{suffix}", image(figure, suffix))
    except OSError as error:
        raise _not_writable(out, error) from error
    for suffix in ("json", "png", "svg"):
        print(out / f"robustness.{suffix}")


def _not_writable(out: Path, error: OSError) -> UserError:
    return UserError(
        f"{out} cannot be written ({error.strerror}); choose another folder with --out"
    )
