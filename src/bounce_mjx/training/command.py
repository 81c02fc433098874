"""The flags of the commands that train."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, TypeVar

import pydantic
import tyro

from bounce_mjx.config.command_line import parse
from bounce_mjx.config.files import differing_keys
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
from bounce_mjx.tasks.registry import DEFAULT, find_task
from bounce_mjx.world.config import WorldConfig


class TrainingCommand(TrainConfig):
    """The command line: the config's keys as flags, and the preset or run to start from."""

    env: Annotated[pydantic.SerializeAsAny[WorldConfig], tyro.conf.arg(name="")]
    ppo: Annotated[PPOConfig, tyro.conf.arg(name="")] = PPOConfig()
    config: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction] = ()
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


CommandT = TypeVar("CommandT", bound=TrainingCommand)


def read_training(
    command_class: type[CommandT],
    args: Sequence[str],
    *,
    prog: str,
    machine: Path | None = None,
) -> CommandT:
    """Reads a command line on top of the preset, or of the resumed run's config. Its `config` are
    the files of that preset, each of which lies on those before it.

    Args:
      machine: name of the preset for this machine, where JAX's devices may not start yet.

    Raises:
      UserError: a flag or the preset is wrong, or a flag changes a key of the resumed run that must
        stay the same.
    """
    configs, resume = list(map(Path, early_flags(args, "--config"))), path_flag(args, "--resume")
    robot, world = path_flag(args, "--robot"), path_flag(args, "--world")
    task, warm_start = early_flag(args, "--task"), path_flag(args, "--warm-start")
    for given, flag in ((configs, "--config"), (robot, "--robot"), (world, "--world")):
        if given and resume:
            raise UserError(f"{flag} and --resume cannot be combined; a resumed run has its config")
    if warm_start and robot:
        raise UserError(
            "--warm-start and --robot cannot be combined; the policy's own robot is trained on"
        )
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
    elif warm_start:
        from bounce_mjx.training.warm_start import warm_config

        base = warm_config(warm_start, configs, task, world, machine)
    else:
        base = read_preset(configs, robot, task, world, machine)
    start = base
    if resume and early_flag(args, "--total-steps") is not None and _is_solved(resume):
        start = base.model_copy(update={"stop_when_solved": False})
    own_class = train_config(base.env.task, command_class)
    default = own_class(**dict(start), robot=robot, world=world, resume=resume)
    command = parse(own_class, args, prog=prog, default=default)
    if warm_start and not resume:
        # By its own name, if it was the latest.
        command = command.model_copy(update={"warm_start": base.warm_start})
    if resume:
        command = command.model_copy(update={"resume": resume, "task": base.task})
        changed = differing_keys(base, config_of(command)) - RESUMABLE_KEYS
        if changed:
            raise UserError(
                f"--resume cannot change {', '.join(sorted(changed))}; leave those flags out, or "
                "start a new run"
            )
        return command
    files = preset_files(configs, base.task, machine)
    return command.model_copy(update={"config": tuple(files)})


def _is_solved(run: Path) -> bool:
    """Whether `stop_when_solved` has ended a run."""
    from bounce_mjx.runs.folders import runs_of_seeds
    from bounce_mjx.runs.progress import load_results

    results = [load_results(seed) for seed in runs_of_seeds(run)]
    return all(found is not None and found.solved for found in results)


def config_of(command: TrainingCommand) -> TrainConfig:
    """The run's config within a command line."""
    return TrainConfig(**{key: getattr(command, key) for key in TrainConfig.model_fields})


def path_flag(args: Sequence[str], flag: str) -> Path | None:
    """The path in a flag that must be read before the others."""
    word = early_flag(args, flag)
    return None if word is None else Path(word)


def early_flag(args: Sequence[str], flag: str) -> str | None:
    """The value of a flag that must be read before the others, in every spelling that the parser
    accepts: with - or _ in the name, and with = or a space before the value. If the flag is
    repeated, the last value counts."""
    return next(reversed(early_flags(args, flag)), None)


def early_flags(args: Sequence[str], flag: str) -> list[str]:
    """All values of a flag that may be repeated, as for `early_flag`."""
    values = []
    for i, word in enumerate(args):
        name, equals, given = word.partition("=")
        if name.startswith("--") and name.replace("_", "-") == flag:
            following = args[i + 1] if i + 1 < len(args) else ""
            values.append(given if equals else following)
    return values
