"""Shared by the commands that train: their flags, the start of the job, and the printed results."""

import importlib.util
import shlex
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import pydantic
import tyro
from rich.console import Console

from bounce_mjx.config.command_line import parse
from bounce_mjx.config.files import differing_keys
from bounce_mjx.errors import UserError, reason_of
from bounce_mjx.interrupt import leave, run_interruptible
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.runs.config import (
    TrainConfig,
    load_run_config,
    read_preset,
    runs_folder,
    train_config,
)
from bounce_mjx.runs.task import is_same_task
from bounce_mjx.tasks.registry import DEFAULT, find_task, is_file
from bounce_mjx.world.config import WorldConfig

if TYPE_CHECKING:
    from bounce_mjx.env.env import Env
    from bounce_mjx.training.job import Outcome
    from bounce_mjx.training.trainer import Trainer, Watcher


class TrainingCommand(TrainConfig):
    """The command line: the config's keys as flags, and the preset or run to start from."""

    env: Annotated[pydantic.SerializeAsAny[WorldConfig], tyro.conf.arg(name="")]
    ppo: Annotated[PPOConfig, tyro.conf.arg(name="")] = PPOConfig()
    config: Path | None = None
    """Preset: a YAML file, or the name of one in configs/ (default, cpu, seed, robust or transfer);
    a task's own preset of that name, such as configs/track/cpu.yaml, has priority. The default is
    default on an accelerator, and cpu on a CPU."""
    robot: Path | None = None
    """Config of a robot on top of the preset: the file that bounce-mjx adopt wrote, or the name of
    one in configs/robots/ (ur5e, panda or iiwa)."""
    resume: Path | None = None
    """Folder of a run, or latest for the newest run, to continue in place from its latest
    checkpoint. The other flags may then change only total-steps, eval-every, eval-episodes,
    screening-episodes, eval-seed, stop-when-solved, num-devices and log-dir. With total-steps, a
    run that has met all results goes on."""
    report: bool = True
    """Write report.html into the run's folder after the results are printed."""
    wandb: str | None = None
    """Project of Weights & Biases to log to, beside TensorBoard; needs the extra wandb."""


CommandT = TypeVar("CommandT", bound=TrainingCommand)


def read_command(
    command_class: type[CommandT],
    args: Sequence[str],
    *,
    prog: str,
    description: str,
    preset: Path | None = None,
    **defaults,
) -> CommandT:
    """Reads a command line on top of the preset, or of the resumed run's config.

    Args:
      preset: the preset if the command line names none; by default, this machine's.
      defaults: defaults of flags that are not part of the config.

    Raises:
      UserError: a flag or the preset is wrong, or a flag changes a key of the resumed run that must
        stay the same.
    """
    config_path, resume = path_flag(args, "--config"), path_flag(args, "--resume")
    robot, task = path_flag(args, "--robot"), early_flag(args, "--task")
    for given, flag in ((config_path, "--config"), (robot, "--robot")):
        if given and resume:
            raise UserError(f"{flag} and --resume exclude each other; a resumed run has its config")
    if resume:
        from bounce_mjx.runs.folders import find_run, named_run
        from bounce_mjx.runs.reading import RESUMABLE_KEYS

        log_dir = path_flag(args, "--log-dir") or runs_folder(find_task(task or DEFAULT))
        resume = find_run(named_run(resume, log_dir))
        base = load_run_config(resume, task)
        if task is not None and not is_same_task(base.task, task):
            raise UserError(
                f"--resume cannot change the task, and {task} differs from {base.task}; restore "
                "it, name the run's copy, or start a new run"
            )
    else:
        base = read_preset(config_path or preset, robot, task)
    start = base
    if resume and early_flag(args, "--total-steps") is not None and _is_solved(resume):
        start = base.model_copy(update={"stop_when_solved": False})
    own_class = train_config(base.env.task, command_class)
    command = parse(
        own_class,
        args,
        prog=prog,
        description=description,
        default=own_class(
            **dict(start), config=config_path, robot=robot, resume=resume, **defaults
        ),
    )
    if resume:
        command = command.model_copy(update={"resume": resume, "task": base.task})
        changed = differing_keys(base, config_of(command)) - RESUMABLE_KEYS
        if changed:
            raise UserError(
                f"--resume cannot change {', '.join(sorted(changed))}; leave those flags out, or "
                "start a new run"
            )
    return command


def _is_solved(run: Path) -> bool:
    """Whether `stop_when_solved` has ended a run."""
    from bounce_mjx.runs.folders import runs_of_seeds
    from bounce_mjx.runs.progress import load_results

    results = [load_results(seed) for seed in runs_of_seeds(run)]
    return all(found is not None and found.solved for found in results)


def run_command(
    command: TrainingCommand,
    make_trainer: "Callable[[TrainConfig, Env], Trainer]",
    prog: str,
    watcher: "Watcher | None" = None,
    stopped: Callable[[Sequence[Path]], None] = lambda runs: None,
) -> "Sequence[Outcome]":
    """Trains according to the command, and prints the results; returns each seed's outcome.

    Args:
      prog: the user's command, to which `--resume` may be added.
      watcher: receives the progress of the first seed.
      stopped: called with the folders of the seeds of a training that the user stopped, before the
        process ends; not if nothing was trained.

    Raises:
      UserError: see `train`; or a package that the command asks for is missing.
    """
    from bounce_mjx.training import hosts
    from bounce_mjx.training.console import say
    from bounce_mjx.training.job import Options, TrainingStopped, train

    if command.wandb is not None and importlib.util.find_spec("wandb") is None:
        raise UserError(
            "--wandb needs the package wandb; install it with: pip install 'bounce_mjx[wandb]'"
        )
    console = Console(quiet=not hosts.is_leader())
    # A later command has to name the task's file again.
    task = f" --task {shlex.quote(command.task)}" if is_file(command.task) else ""
    try:
        options = Options(prog + task, command.resume, command.report, command.wandb, watcher)
        outcomes = train(config_of(command), console, make_trainer, options)
    except TrainingStopped as stop:
        say(console, str(stop))
        if stop.runs:
            stopped(stop.runs)
        # Does not wait for a compilation or an evaluation in another thread.
        leave(0)
    best = show(outcomes, console)
    if command.report and hosts.is_leader():
        run_interruptible(leave_report, best, console, task)
    run = shlex.quote(str(best.run))
    say(console, f"measure it: bounce-mjx eval {run}{task}")
    say(console, f"watch it: bounce-mjx play {run}{task}")
    return outcomes


def show(outcomes: "Sequence[Outcome]", console: Console) -> "Outcome":
    """Prints the results of a training; returns the best seed's outcome."""
    from bounce_mjx.reports.tables import details_line, results_table, seeds_table
    from bounce_mjx.training.console import say

    best = max((o for o in outcomes if o.report is not None), key=lambda o: o.report.score)
    if len(outcomes) > 1:
        console.print(seeds_table({o.seed: o.report for o in outcomes}))
    else:
        console.print(results_table(best.report, f"best checkpoint, {best.best_steps:,} steps"))
        say(console, details_line(best.report))
    spent = ", ".join(f"{name} {value:.1f} s" for name, value in best.seconds.items())
    say(console, f"time: {spent}")
    label = "run" if len(outcomes) == 1 else f"best seed: {best.seed}  run"
    say(console, f"{label}: {best.run}")
    return best


def leave_report(outcome: "Outcome", console: Console, task: str = "") -> None:
    """Draws the report. The training is already saved, so a failure only prints one line.

    Args:
      task: the flag that names the task's file, if it has one.
    """
    from bounce_mjx.training.console import say

    started = time.perf_counter()
    try:
        from bounce_mjx.training.report import report_training

        page = report_training(outcome.run, outcome.report, outcome.best_steps)
    except Exception as error:
        reason = reason_of(error)
        again = f"bounce-mjx report {shlex.quote(str(outcome.run))}{task}"
        say(console, f"report: not drawn ({reason}); draw it with: {again}")
    else:
        say(console, f"report: {page}  ({time.perf_counter() - started:.1f} s)")


def config_of(command: TrainingCommand) -> TrainConfig:
    """The run's config within a command line."""
    return TrainConfig(**{key: getattr(command, key) for key in TrainConfig.model_fields})


def asks_for_help(args: Sequence[str]) -> bool:
    """Whether the command line only prints the help."""
    return not {"-h", "--help"}.isdisjoint(args)


def path_flag(args: Sequence[str], flag: str) -> Path | None:
    """The path in a flag that must be read before the others."""
    word = early_flag(args, flag)
    return None if word is None else Path(word)


def early_flag(args: Sequence[str], flag: str) -> str | None:
    """The value of a flag that must be read before the others, in every spelling that the parser
    accepts: with - or _ in the name, and with = or a space before the value. If the flag is
    repeated, the last value counts."""
    value = None
    for i, word in enumerate(args):
        name, equals, given = word.partition("=")
        if name.startswith("--") and name.replace("_", "-") == flag:
            following = args[i + 1] if i + 1 < len(args) else ""
            value = given if equals else following
    return value
