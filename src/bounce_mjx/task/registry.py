"""Tasks by name: those of the package, those of installed packages, and those of imported code."""

import importlib
import importlib.metadata

from bounce_mjx.config.user_code import class_named, own_name, own_names
from bounce_mjx.errors import UserError, reason_of, shorten, suggest
from bounce_mjx.task.task import Task
from bounce_mjx.world.config import WorldConfig

DEFAULT = "bounce"
"""Name of the task of the original specification."""

GROUP = "bounce_mjx.tasks"
"""Entry points of installed packages that have tasks."""

_OF_THE_PACKAGE = {
    name: f"bounce_mjx.task.{name}:{name.title()}"
    for name in ("balance", "bounce", "catch", "juggle", "track")
}


def find_task(name: str) -> type[Task]:
    """The task of a name: one of the package, of an entry point in `GROUP`, or of imported code.

    Raises:
      UserError: there is none, it cannot be imported, or it is no task.
    """
    # Without a look at the installed packages, which takes 10 ms.
    known = _OF_THE_PACKAGE if name in _OF_THE_PACKAGE else registered_tasks()
    if name not in known:
        own = class_named(name, Task)
        if own is not None:
            return own
        names = sorted({*known, *own_names(Task)})
        advice = suggest(name, names) or "give one of these, or --import the file of your own"
        raise UserError(f"there is no task {shorten(name)!r} (known: {', '.join(names)}); {advice}")
    module, _, attribute = known[name].partition(":")
    try:
        task = getattr(importlib.import_module(module), attribute)
    # Code of another package raises any error.
    except Exception as error:
        raise UserError(
            f"the task {name} cannot be imported ({reason_of(error)}); install the package that "
            "has it again"
        ) from error
    if not (isinstance(task, type) and issubclass(task, Task) and task is not Task):
        raise UserError(
            f"the task {name} is {known[name]}, which is no subclass of Task; correct the entry "
            "point of the package that has it"
        )
    return task


def is_task(name: str) -> bool:
    """Whether a word is the name of a task."""
    if name in _OF_THE_PACKAGE or class_named(name, Task) is not None:
        return True
    return name in registered_tasks()


def task_name(task: type[Task]) -> str:
    """The name under which `find_task` finds a task.

    Raises:
      UserError: another task has it.
    """
    place = f"{task.__module__}:{task.__qualname__}"
    known = registered_tasks()
    names = [name for name, value in known.items() if value == place]
    if names:
        return names[0]
    name = own_name(task)
    if name in known:
        raise UserError(
            f"the class {task.__qualname__} of {task.__module__} has the name of the task {name}; "
            "rename it"
        )
    return name


def own_task(name: str) -> type[Task] | None:
    """The task of imported code that has a name; None for that of a package, and where no imported
    code has one of that name."""
    return None if name in registered_tasks() else class_named(name, Task)


def task_config(task: str | type[Task]) -> type[WorldConfig]:
    """The settings of a task: its class, or a name as for `find_task`."""
    return (find_task(task) if isinstance(task, str) else task).Config


def registered_tasks() -> dict[str, str]:
    """MODULE:CLASS of the tasks of the package and of installed packages, by name."""
    entries = importlib.metadata.entry_points(group=GROUP)
    installed = {entry.name: entry.value for entry in entries}
    return dict(sorted((installed | _OF_THE_PACKAGE).items()))
