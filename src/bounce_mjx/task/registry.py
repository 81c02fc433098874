"""Tasks by name: those of the package, those of installed packages, and those in a file.

A task in a file is code, which runs only if the user names the file. Code is known by its content:
a run's copy of a file that the user has named is the same task.
"""

import importlib
import importlib.metadata
import inspect
import os
import sys
import traceback
import types
from pathlib import Path
from typing import TypeVar

from bounce_mjx.errors import UserError, reason_of, shorten, suggest
from bounce_mjx.task.task import Task
from bounce_mjx.world.config import WorldConfig

Kind = TypeVar("Kind")

DEFAULT = "bounce"
"""Name of the task of the original specification."""

GROUP = "bounce_mjx.tasks"
"""Entry points of installed packages that have tasks."""

# The modules of the files that the user has named, by their content.
_files: dict[bytes, types.ModuleType] = {}
# The tasks that the user has named for those of runs, by the run's FILE.py:CLASS.
_named: dict[str, type[Task]] = {}

_OWN = {
    name: f"bounce_mjx.task.{name}:{name.title()}"
    for name in ("balance", "bounce", "catch", "juggle", "track")
}


def find_task(name: str) -> type[Task]:
    """The task of a name, of an entry point in `GROUP`, or of FILE.py:CLASS.

    Raises:
      UserError: there is none, or it cannot be imported.
    """
    if is_file(name):
        return class_in_file(name, Task)
    # Without a look at the installed packages, which takes 10 ms.
    known = _OWN if name in _OWN else registered_tasks()
    if name not in known:
        advice = suggest(name, known) or "give FILE.py:CLASS or a known name"
        raise UserError(
            f"there is no task {shorten(name)!r} (known: {', '.join(sorted(known))}); {advice}"
        )
    module, _, attribute = known[name].partition(":")
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise UserError(
            f"the task {name} cannot be imported ({reason_of(error)}); install the package that "
            "has it again"
        ) from error


def task_name(task: type[Task]) -> str:
    """The name under which `find_task` finds a task: its registered name, or FILE.py:CLASS."""
    place = f"{task.__module__}:{task.__qualname__}"
    names = [name for name, value in registered_tasks().items() if value == place]
    return names[0] if names else f"{inspect.getsourcefile(task)}:{task.__qualname__}"


def task_config(task: str | type[Task]) -> type[WorldConfig]:
    """The settings of a task: its class, or a name as for `find_task`."""
    return (find_task(task) if isinstance(task, str) else task).Config


def is_file(name: str) -> bool:
    """Whether a task's name is FILE.py:CLASS."""
    return name.rpartition(":")[0].endswith(".py")


def source_file(name: str) -> Path:
    """Absolute path of the file in FILE.py:CLASS, without .. in it."""
    return Path(os.path.abspath(Path(name.rpartition(":")[0]).expanduser()))


def read_source(name: str) -> bytes:
    """Content of the file in FILE.py:CLASS.

    Raises:
      UserError: the file cannot be read.
    """
    path = source_file(name)
    try:
        return path.read_bytes()
    except OSError as error:
        raise UserError(
            f"{shorten(str(path))} cannot be read ({reason_of(error)}); give FILE.py:CLASS"
        ) from error


def is_same_code(name: str, other: str) -> bool:
    """Whether two names stand for the same task, which a copy of its file is too."""
    if not (is_file(name) and is_file(other)):
        return name == other
    is_same_class = name.rpartition(":")[2] == other.rpartition(":")[2]
    return is_same_class and read_source(name) == read_source(other)


def known_task(name: str) -> type[Task] | None:
    """The task of FILE.py:CLASS if code with the same content has been named in this process;
    nothing of the file is run."""
    if name in _named:
        return _named[name]
    module = _files.get(read_source(name))
    return None if module is None else _class_in(module, name, Task)


def admit(name: str, task: type[Task]) -> None:
    """Lets a task stand for the run's FILE.py:CLASS, whose code may be another one."""
    _named[name] = task


def registered_tasks() -> dict[str, str]:
    """MODULE:CLASS of the tasks of the package and of installed packages, by name."""
    entries = importlib.metadata.entry_points(group=GROUP)
    installed = {entry.name: entry.value for entry in entries}
    return dict(sorted((installed | _OWN).items()))


def class_in_file(name: str, base: type[Kind]) -> type[Kind]:
    """The subclass of `base` in FILE.py:CLASS, whose code runs once in a process.

    Raises:
      UserError: the file cannot be imported, or has no such class.
    """
    path = source_file(name)
    source = read_source(name)
    if source not in _files:
        module = types.ModuleType(f"bounce_mjx_{path.stem}_{len(_files)}")
        module.__file__ = str(path)
        sys.modules[module.__name__] = module
        try:
            exec(compile(source, str(path), "exec"), vars(module))
        except Exception as error:
            frames = traceback.extract_tb(error.__traceback__)
            lines = [frame.lineno for frame in frames if frame.filename == str(path)]
            line = getattr(error, "lineno", None) or (lines or [1])[-1]
            raise UserError(
                f"{path} cannot be imported ({type(error).__name__} in line {line}: "
                f"{shorten(str(error), 300)}); correct it"
            ) from error
        _files[source] = module
    return _class_in(_files[source], name, base)


def _class_in(module: types.ModuleType, name: str, base: type[Kind]) -> type[Kind]:
    """The subclass of `base` of FILE.py:CLASS in the file's module."""
    classes = {
        key: value
        for key, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, base) and value is not base
    }
    attribute = name.rpartition(":")[2]
    if attribute not in classes:
        raise UserError(
            f"{source_file(name)} has no subclass {shorten(attribute)!r} of {base.__name__} "
            f"(it has: {', '.join(classes) or 'none'}); give FILE.py:CLASS"
        )
    return classes[attribute]
