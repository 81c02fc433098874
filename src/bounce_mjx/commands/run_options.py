"""Shared by the commands that show or measure a run: whose run it is, and the task's commands."""

import difflib
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from bounce_mjx.config.command_line import flag_of, flags_of, parse
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.errors import UserError
from bounce_mjx.runs.config import TrainConfig, load_run_config, runs_folder
from bounce_mjx.tasks.registry import DEFAULT, find_task, registered_tasks
from bounce_mjx.training.command import early_flag
from bounce_mjx.world.config import WorldConfig

CommandT = TypeVar("CommandT", bound=StrictModel)


class RunOptions(StrictModel):
    """Whose run it is."""

    task: str | None = None
    """Task of the run. A run of a task in a file, FILE.py:CLASS, needs it, as the file is code."""
    log_dir: Path | None = None
    """Folder in which to look for the newest run; by default, that of the task's runs."""

    @property
    def folder(self) -> Path:
        """Folder in which to look for the newest run."""
        return self.log_dir or runs_folder(find_task(self.task or DEFAULT))

    def config(self, run: Path) -> TrainConfig:
        """The config of a run.

        Raises:
          UserError: as `load_run_config`.
        """
        return load_run_config(run, self.task)


def parse_with_commands(
    command_class: type[CommandT], args: Sequence[str], *, prog: str, description: str
) -> tuple[CommandT, "CommandFlags"]:
    """Reads a command line in which the commands of the run's task are flags too, such as
    `--target-height 0.5` of the task bounce.

    Raises:
      UserError: a flag has a bad value.
    """
    known = {*flags_of(command_class), "--help"}
    words, given = [], {}
    rest = iter(args)
    for word in rest:
        name, equals, value = word.partition("=")
        name = name.replace("_", "-")
        if name.startswith("--") and name not in known:
            given[name] = value if equals else next(rest, "")
        else:
            words.append(word)
    task = early_flag(words, "--task")
    commands = find_task(task or DEFAULT).Config().commands
    if commands:
        flags = ", ".join(f"{flag_of(name)} {c.unit.upper()}" for name, c in commands.items())
        description += f" The commands of the task {task or DEFAULT} are flags too: {flags}."
    # Without --task, the run may be of any registered task.
    tasks = [task] if task else registered_tasks() if given else []
    possible = {flag_of(name) for task in tasks for name in find_task(task).Config().commands}
    for flag in given.keys() - possible:
        raise _unknown(flag, [*known, *possible], prog)
    command = parse(command_class, words, prog=prog, description=description)
    return command, CommandFlags(given, sorted(known), prog)


class CommandFlags:
    """Flags that may be the commands of a task, which is known once the run is found."""

    def __init__(self, given: dict[str, str], known: Sequence[str], prog: str):
        self._given, self._known, self._prog = given, known, prog

    def values(self, env: WorldConfig) -> dict[str, float]:
        """The given values of the task's commands by name.

        Raises:
          UserError: a flag is not one of the command's or of the task's, or its value is outside of
            its limits.
        """
        commands = {flag_of(name): (name, command) for name, command in env.commands.items()}
        values = {}
        for flag, text in self._given.items():
            if flag not in commands:
                raise _unknown(flag, [*self._known, *commands], self._prog)
            name, command = commands[flag]
            values[name] = command.checked(text, flag)
        return values


def _unknown(flag: str, known: Sequence[str], prog: str) -> UserError:
    near = difflib.get_close_matches(flag, known, n=1)
    advice = f"; did you mean {near[0]}?" if near else ""
    return UserError(f"unknown argument {flag}{advice} (see {prog} --help)")
