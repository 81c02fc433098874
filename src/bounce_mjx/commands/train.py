"""The main job: trains a policy, and leaves a run's folder with it (`python train_jax.py`)."""

import importlib
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from pydantic import Field
from rich.console import Console

from bounce_mjx.config.command_line import parse
from bounce_mjx.config.files import differing_keys
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.reports.tables import details_line, results_table, seeds_table
from bounce_mjx.runs.config import TrainConfig, load_run_config
from bounce_mjx.runs.folders import find_run
from bounce_mjx.runs.presets import read_preset
from bounce_mjx.runs.reading import RESUMABLE_KEYS
from bounce_mjx.task.config import EnvConfig
from bounce_mjx.training import hosts
from bounce_mjx.training.job import REPORT_MODULE, Outcome, TrainingStopped, train
from bounce_mjx.training.setup import set_up_jax


class TrainCommand(TrainConfig):
    """The command line: the config's keys as flags, and where to start from."""

    env: Annotated[EnvConfig, tyro.conf.arg(name="")] = EnvConfig()
    ppo: Annotated[PPOConfig, tyro.conf.arg(name="")] = PPOConfig()
    config: Path | None = None
    """Preset: a YAML file such as configs/seed.yaml. Left out: configs/default.yaml where there is
    an accelerator, else configs/cpu.yaml."""
    resume: Path | None = None
    """A run's folder to go on with, in place, from its latest checkpoint. The other flags may then
    change only total-steps, eval-every, eval-episodes, screening-episodes, eval-seed,
    stop-when-solved, num-devices and log-dir, and mjcf where that file has moved."""
    distributed: bool = False
    """Train together with the same command on other hosts, where Slurm, Open MPI or Kubernetes
    tells each process of the others."""
    coordinator_address: str | None = None
    """HOST:PORT of the first process, to train on several hosts without such a launcher."""
    num_processes: Annotated[int, Field(ge=1)] | None = None
    """Processes in all, one a host; with coordinator-address."""
    process_id: Annotated[int, Field(ge=0)] | None = None
    """Number of this process, from 0; with coordinator-address."""
    report: bool = True
    """Leave report.html in the run's folder, drawn when the results are printed."""


def main(args: Sequence[str] | None = None) -> None:
    """Runs the command line."""
    with exit_on_user_error():
        args = sys.argv[1:] if args is None else args
        set_up_jax()
        _join_hosts(args)
        command = read_command(args)
        console = Console(quiet=not hosts.is_leader())
        try:
            outcomes = train(
                config_of(command), console, resume=command.resume, report=command.report
            )
        except TrainingStopped as stopped:
            console.print(str(stopped), highlight=False, soft_wrap=True)
            # Without waiting for a compilation or an evaluation that is still going on.
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(0)
        best = show(outcomes, console)
        if command.report and hosts.is_leader():
            leave_report(best, console)


def show(outcomes: Sequence[Outcome], console: Console) -> Outcome:
    """Prints what a training came to; returns the best seed's outcome."""
    best = max((o for o in outcomes if o.report is not None), key=lambda o: o.report.score)
    if len(outcomes) > 1:
        console.print(seeds_table({o.seed: o.report for o in outcomes}))
    else:
        console.print(results_table(best.report, f"best checkpoint, {best.best_steps:,} steps"))
        console.print(details_line(best.report), highlight=False)
    spent = ", ".join(f"{name} {value:.1f} s" for name, value in best.seconds.items())
    console.print(f"time: {spent}", highlight=False)
    which = "run" if len(outcomes) == 1 else f"best seed: {best.seed}  run"
    console.print(
        f"{which}: {best.run}  (python -m bounce_mjx.eval {best.run})",
        highlight=False,
        soft_wrap=True,
    )
    return best


def leave_report(outcome: Outcome, console: Console) -> None:
    """Draws the report. The training is safe by now, so whatever fails is only told."""
    started = time.perf_counter()
    try:
        report_module = importlib.import_module(REPORT_MODULE)
        page = report_module.report_training(outcome.run, outcome.report, outcome.best_steps)
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        again = f"python -m bounce_mjx.report {outcome.run}"
        text = f"report: not drawn ({reason}); {again} draws it"
    else:
        text = f"report: {page}  ({time.perf_counter() - started:.1f} s)"
    console.print(text, highlight=False, soft_wrap=True)


def read_command(args: Sequence[str]) -> TrainCommand:
    """Reads the command line on top of the preset, or of the resumed run's config.

    Raises:
      UserError: a flag or the preset is wrong, or a resumed run is to change what it may not.
    """
    config_path, resume = path_flag(args, "--config"), path_flag(args, "--resume")
    if config_path and resume:
        raise UserError("--config and --resume exclude each other; a resumed run has its config")
    if resume:
        base = load_run_config(find_run(resume))
    else:
        base = read_preset(config_path)
    command = parse(
        TrainCommand,
        args,
        prog="train_jax.py",
        description="Trains a policy that keeps the ball bouncing.",
        default=TrainCommand(**dict(base), config=config_path, resume=resume),
    )
    if resume:
        changed = differing_keys(base, config_of(command)) - RESUMABLE_KEYS
        if changed:
            raise UserError(
                f"--resume cannot change {', '.join(sorted(changed))}; leave those flags out, or "
                "start a new run"
            )
    return command


def config_of(command: TrainCommand) -> TrainConfig:
    """The run's part of a command line."""
    return TrainConfig(**{key: getattr(command, key) for key in TrainConfig.model_fields})


def _join_hosts(args: Sequence[str]) -> None:
    """Joins the other hosts, which must come before JAX is asked for its devices."""
    address = _flag(args, "--coordinator-address")
    numbers = [_flag(args, flag) for flag in ("--num-processes", "--process-id")]
    if all(word is None or word.isdecimal() for word in numbers) and (
        "--distributed" in args or any(word is not None for word in (address, *numbers))
    ):
        hosts.join(address, *[None if word is None else int(word) for word in numbers])


def path_flag(args: Sequence[str], flag: str) -> Path | None:
    word = _flag(args, flag)
    return None if word is None else Path(word)


def _flag(args: Sequence[str], flag: str) -> str | None:
    """The value of a flag that must be read before the others."""
    for i, word in enumerate(args):
        if word == flag and i + 1 < len(args):
            return args[i + 1]
        if word.startswith(f"{flag}="):
            return word.removeprefix(f"{flag}=")
    return None
