"""The flags of the command that trains."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import pydantic
import tyro
from pydantic import Field

from bounce_mjx.config.command_line import parse, parse_first
from bounce_mjx.config.files import differing_keys
from bounce_mjx.config.settings import Count, HostName, NonNegativeInt, Steps, StrictModel
from bounce_mjx.errors import UserError
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.runs.config import (
    TrainConfig,
    load_run_config,
    preset_files,
    read_preset,
    runs_folder,
    train_config,
)
from bounce_mjx.runs.task import is_same_task
from bounce_mjx.tasks.registry import DEFAULT, find_task, is_file
from bounce_mjx.world.config import WorldConfig

PROG = "bounce-mjx train"


class Options(StrictModel):
    """How a training starts, and what it does that its config does not say: flags without a key."""

    config: Annotated[
        tuple[Path, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="PATH")
    ] = ()
    """Preset: the name of a YAML file in configs/, such as cpu, robust or finetune; a task's own
    preset of that name, such as configs/track/cpu.yaml, has priority. The default is default on an
    accelerator, and cpu on a CPU. A YAML file of yours lies on that default, or on the preset that
    its key base names. Given again, each file lies on those before it."""
    robot: Path | None = None
    """Config of a robot on top of the preset: the file that bounce-mjx adopt wrote, or the name of
    one in configs/robots/ (ur5e, panda or iiwa)."""
    world: Path | None = None
    """Named world in place of the preset's: a YAML file, or the name of one in configs/worlds/
    (ur5e_rtde, panda_fci, iiwa_fri or fast_servo). It may have a robot."""
    resume: Path | None = None
    """Folder of a run, or latest for the newest run, to continue in place from its latest
    checkpoint. The other flags may then change only total-steps, eval-every, eval-episodes,
    screening-episodes, eval-seed, stop-when-solved, num-devices and log-dir. With total-steps, a
    run that has met all results continues."""
    report: bool = True
    """Write report.html into the run's folder after the results are printed."""
    wandb: str | None = None
    """Project of Weights & Biases to log to, in addition to TensorBoard; needs the extra wandb."""
    distributed: bool = False
    """Train together with the same command on other hosts, started by Slurm, Open MPI or
    Kubernetes."""
    coordinator_address: str | None = None
    """HOST:PORT of process 0, to train on several hosts without one of these launchers."""
    num_processes: Count | None = None
    """Number of processes, one per host; with coordinator-address."""
    process_id: NonNegativeInt | None = None
    """Number of this process, from 0; with coordinator-address."""
    watch: bool = False
    """Serve a page during the training, with the newest policy, the curves and the results."""
    watch_host: str = "127.0.0.1"
    """Address of that page's server; 0.0.0.0 also admits other machines."""
    watch_allow_host: tuple[HostName, ...] = ()
    """Other names under which a browser may open that page, such as a proxy's."""
    watch_port: Annotated[int, Field(ge=1, lt=2**16)] = 8080
    """Port of that page's server, or the next free port."""
    host_timeout: Annotated[Count, Field(le=10**6)] = 300
    """Seconds that the processes wait for each other at the start."""

    @property
    def on_several_hosts(self) -> bool:
        """Whether other processes train too."""
        joins = (self.coordinator_address, self.num_processes, self.process_id)
        return self.distributed or any(value is not None for value in joins)


class TrainCommand(Options, TrainConfig):
    """Trains a policy; by default, one that keeps the ball bouncing."""

    env: Annotated[pydantic.SerializeAsAny[WorldConfig], tyro.conf.arg(name="")]
    ppo: Annotated[PPOConfig, tyro.conf.arg(name="")] = PPOConfig()


class _FirstFlags(Options):
    """The flags that decide the config on which the others lie."""

    task: str | None = None
    warm_start: Path | None = None
    log_dir: Path | None = None
    total_steps: Steps | None = None


def read_command(args: Sequence[str], machine: Path | None = None) -> TrainCommand:
    """Reads a command line on top of the preset, or of the resumed run's config. Its `config` are
    the files of that preset, each of which lies on those before it.

    Args:
      machine: name of the preset for this machine, where JAX's devices may not start yet.

    Raises:
      UserError: a flag or the preset is wrong, or a flag changes a key of the resumed run that must
        stay the same.
    """
    first = parse_first(_FirstFlags, args, prog=PROG)
    if first.resume:
        return _resumed(first, args)
    if first.warm_start and first.robot:
        raise UserError(
            "--warm-start and --robot cannot be combined; the policy's own robot is trained on"
        )
    if first.warm_start:
        from bounce_mjx.training.warm_start import warm_config

        base = warm_config(first.warm_start, first.config, first.task, first.world, machine)
    else:
        base = read_preset(first.config, first.robot, first.task, first.world, machine)
    command = _parse(args, base)
    files = preset_files(first.config, base.task, machine)
    # The run of a warm start by its own name, if it was the latest.
    return command.model_copy(update={"config": tuple(files), "warm_start": base.warm_start})


def _resumed(first: _FirstFlags, args: Sequence[str]) -> TrainCommand:
    """A command line on top of a resumed run's config."""
    for flag in ("config", "robot", "world"):
        if getattr(first, flag):
            raise UserError(
                f"--{flag} and --resume cannot be combined; a resumed run has its config"
            )
    from bounce_mjx.runs.folders import find_run, named_run
    from bounce_mjx.runs.reading import RESUMABLE_KEYS

    log_dir = first.log_dir or runs_folder(find_task(first.task or DEFAULT))
    run = find_run(named_run(first.resume, log_dir))
    base = load_run_config(run, first.task)
    if first.task is not None and not is_same_task(base.task, first.task):
        raise UserError(
            f"--resume cannot change the task, and {first.task} differs from {base.task}; restore "
            "it, name the run's copy, or start a new run"
        )
    longer = first.total_steps is not None and _is_solved(run)
    start = base.model_copy(update={"stop_when_solved": False}) if longer else base
    command = _parse(args, start).model_copy(update={"resume": run, "task": base.task})
    if changed := differing_keys(base, config_of(command)) - RESUMABLE_KEYS:
        raise UserError(
            f"--resume cannot change {', '.join(sorted(changed))}; leave those flags out, or start "
            "a new run"
        )
    return command


def _parse(args: Sequence[str], base: TrainConfig) -> TrainCommand:
    """A command line on top of a config."""
    own_class = train_config(base.env.task, TrainCommand)
    return parse(own_class, args, prog=PROG, default=own_class(**dict(base)))


def _is_solved(run: Path) -> bool:
    """Whether `stop_when_solved` has ended a run."""
    from bounce_mjx.runs.folders import runs_of_seeds
    from bounce_mjx.runs.progress import load_results

    results = [load_results(seed) for seed in runs_of_seeds(run)]
    return all(found is not None and found.solved for found in results)


def named_task(config: TrainConfig) -> list[str]:
    """The flag with which a later command has to name a task's file again."""
    return ["--task", config.task] if is_file(config.task) else []


def config_of(command: TrainCommand) -> TrainConfig:
    """The run's config within a command line."""
    return TrainConfig(**{key: getattr(command, key) for key in TrainConfig.model_fields})
