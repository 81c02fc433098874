"""Shared by the commands about a run: whose run it is, and the commands of its task as flags."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import pydantic
from pydantic import Field

from bounce_mjx.config.command_line import Flag, flag_names, parse
from bounce_mjx.config.settings import StrictModel, fields_in
from bounce_mjx.errors import UserError, suggest
from bounce_mjx.runs import config as run_configs
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.settings import read_preset
from bounce_mjx.runs.worlds import in_world
from bounce_mjx.task.registry import DEFAULT, find_task, registered_tasks
from bounce_mjx.world.config import Command, WorldConfig

if TYPE_CHECKING:
    from bounce_mjx.runs.folders import Checkpoint

MIRROR = "mirror"
"""Name of the mirror law in place of a checkpoint."""

CommandT = TypeVar("CommandT", bound=StrictModel)


class RunCommand(StrictModel):
    """A command line about a run."""

    task: str | None = None
    """Task of the run. A run of a task in a file, FILE.py:CLASS, needs it, as the file is code."""
    log_dir: Path | None = None
    """Folder in which to look for the newest run; by default, that of the task's runs."""

    @property
    def folder(self) -> Path:
        """Folder in which to look for the newest run."""
        return self.log_dir or run_configs.runs_folder(find_task(self.task or DEFAULT))

    def config(self, run: Path) -> TrainConfig:
        """The config of a run.

        Raises:
          UserError: as `load_run_config`.
        """
        return run_configs.load_run_config(run, self.task)


class ActorCommand(RunCommand):
    """A command line that simulates a policy or the mirror law."""

    robot: Path | None = None
    """Robot of the mirror law; a policy has that of its training."""

    def choose(self, path: Path | None) -> "Checkpoint":
        """`choose_checkpoint`, or `MIRROR_LAW` for the word mirror.

        Raises:
          UserError: there is none, or a robot is given for a policy.
        """
        from bounce_mjx.runs.folders import MIRROR_LAW, choose_checkpoint

        if str(path) == MIRROR and not os.path.isdir(path):
            return MIRROR_LAW
        if path is not None and not os.path.isdir(path) and (near := suggest(str(path), [MIRROR])):
            raise UserError(f"there is no checkpoint folder and no policy {path}; {near}")
        if self.robot is not None:
            raise UserError("--robot is for the mirror law; omit it, or give mirror as checkpoint")
        return choose_checkpoint(path, self.folder)

    def config_of(self, checkpoint: "Checkpoint") -> TrainConfig:
        """The config of a checkpoint's run, or that of the mirror law: the task's preset.

        Raises:
          UserError: as `load_run_config` and `read_preset`.
        """
        from bounce_mjx.baselines.mirror import observing
        from bounce_mjx.runs.folders import MIRROR_LAW

        if checkpoint is not MIRROR_LAW:
            return self.config(checkpoint.run)
        config = read_preset(Path("default"), self.robot, self.task)
        return config.model_copy(update={"env": observing(config.env)})


class OneActorCommand(ActorCommand):
    """A command line about one policy or the mirror law."""

    checkpoint: Annotated[Path | None, Flag(metavar="[CHECKPOINT]", is_positional=True)] = None
    """A run's folder (its best checkpoint), a checkpoint in it, latest for the newest run, a policy
    that comes with the package (pretrained, robust, robust_small, or the name of a task or an arm),
    or mirror for the mirror law, a model-based baseline. The default is the newest run, or the
    task's policy in the package if there is no run."""


class WorldCommand(ActorCommand):
    """A command line that simulates in the world of the training or in another one."""

    world: Path | None = None
    """World in place of that of the training: a YAML file, or the name of one in configs/worlds/
    (ur5e_rtde, panda_fci, iiwa_fri or fast_servo)."""

    def config_of(self, checkpoint: "Checkpoint") -> TrainConfig:
        """The config of a checkpoint's run in the given world.

        Raises:
          UserError: as `ActorCommand.config_of` and `in_world`.
        """
        config = super().config_of(checkpoint)
        return config if self.world is None else in_world(config, self.world)[0]


def parse_with_commands(
    command_class: type[CommandT], args: Sequence[str], *, prog: str
) -> tuple[CommandT, Callable[[WorldConfig], dict[str, float]]]:
    """Reads a command line in which the commands of the run's task are flags too, such as
    `--target-height 0.5` of the task bounce.

    Returns:
      The command line; and a function of the run's `env` to the given values of its task's commands
      by name, which raises a UserError for a flag that is not the task's, or a value outside its
      limits.

    Raises:
      UserError: a flag has a bad value, or no task has it.
    """
    task = parse(RunCommand, args, prog=prog, is_first=True).task
    commands: dict[str, Command] = {}
    # Without --task, the run may be of any task.
    for name in [task] if task else registered_tasks():
        commands |= find_task(name).Config().commands
    # A command may have a name that pydantic takes for its own, such as copy.
    keys = {f"command_{i}": name for i, name in enumerate(commands)}
    fields = {}
    for key, name in keys.items():
        names, unit = commands[name].names, commands[name].unit
        kind = (str if names else float) | None
        flag = Flag(name=name, metavar="|".join(names) or unit.upper() or None)
        about = Field(None, description="Command of the task, if the run's has it.")
        fields[key] = Annotated[kind, flag], about
    group = pydantic.create_model("Commands", __base__=StrictModel, **fields)
    own_class = pydantic.create_model(
        command_class.__name__,
        __base__=command_class,
        __doc__=command_class.__doc__,
        commands=(group, group()),
    )
    command = parse(own_class, args, prog=prog)
    given = {keys[key]: x for key, x in command.commands if x is not None}
    of_all = flag_names(fields_in(own_class))
    flags = {name: of_all[f"commands.{key}"] for key, name in keys.items()}

    def values(env: WorldConfig) -> dict[str, float]:
        for name in given.keys() - env.commands.keys():
            raise UserError(f"{flags[name]} is not a command of the run's task; omit it")
        return {name: env.commands[name].checked(x, flags[name]) for name, x in given.items()}

    return command, values
