"""The goals of a task as flags, such as `--target-height 0.5` of the task bounce. Those of a user's
own task are flags where it is imported."""

from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple, TypeVar

from pydantic.fields import FieldInfo

from bounce_mjx.commands.which_policy import WhichPolicy
from bounce_mjx.config.command_line import Flag, flag_names, parse, read_flags, typed
from bounce_mjx.config.files import flat
from bounce_mjx.config.settings import fields_in
from bounce_mjx.config.user_code import own_names
from bounce_mjx.errors import UserError, warn_once
from bounce_mjx.task.registry import find_task, registered_tasks
from bounce_mjx.task.task import Task
from bounce_mjx.world.config import Goal, WorldConfig

CommandT = TypeVar("CommandT", bound=WhichPolicy)

_GROUP = "goals."
"""Begin of the dotted keys of a task's goals."""


class GivenGoals(NamedTuple):
    """The values that a user gave to a task's goals."""

    values: dict[str, str]
    """By name, as they stand on the command line."""
    flags: dict[str, str]
    """The flag of each goal by name."""

    def checked(self, env: WorldConfig) -> dict[str, float]:
        """The values as numbers.

        Raises:
          UserError: a flag is not of the run's task, or its value is outside its limits.
        """
        numbers = {}
        for name, word in self.values.items():
            flag = self.flags[name]
            if name not in env.goals:
                raise UserError(f"{flag} is not a goal of the run's task; omit it")
            numbers[name] = env.goals[name].checked(word, flag)
        return numbers


def parse_with_goals(
    command_class: type[CommandT], args: Sequence[str], *, prog: str
) -> tuple[CommandT, GivenGoals]:
    """Reads a command line in which the goals of the run's task are flags too.

    Raises:
      UserError: a flag has a bad value, or no task has it.
    """
    task = parse(WhichPolicy, args, prog=prog, is_first=True).task
    fields = fields_in(command_class) | _fields_of(task)
    given = read_flags(
        fields,
        args,
        prog=prog,
        # Python's option -OO leaves out docstrings.
        description=command_class.__doc__ or "",
        defaults=flat(command_class().model_dump()),
    )
    names = flag_names(fields)
    command = typed(command_class, given, names, prog)
    values = _of_group(given)
    return command, GivenGoals(values, _of_group(names))


def _fields_of(task: str | None) -> dict[str, FieldInfo]:
    """The goals of a task, or of every task, as settings by dotted key."""
    goals: dict[str, Goal] = {}
    # Without --task, the run may be of any task.
    for name in [task] if task else (*registered_tasks(), *own_names(Task)):
        try:
            goals |= find_task(name).Config().goals
        except UserError as error:
            if task:
                raise
            # The run is hardly of a task of another package that is broken.
            warn_once(f"{error}; its goals are no flags")
    fields = {}
    for name, goal in goals.items():
        flag = Flag(metavar="|".join(goal.names) or goal.unit.upper() or "FLOAT")
        field = FieldInfo.from_annotation(Annotated[str, flag])
        field.description = "Goal of the task, if the run's task has it."
        fields[_GROUP + name] = field
    return fields


def _of_group(values: dict[str, Any]) -> dict[str, Any]:
    """What belongs to a task's goals, by the goal's name."""
    return {
        key.removeprefix(_GROUP): value for key, value in values.items() if key.startswith(_GROUP)
    }
