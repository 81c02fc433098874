"""Tasks by name: those of the package, those of installed packages, and those in a file.

A task in a file is code, which runs only if the user names the file. Code is known by its content:
a run's copy of a file that the user has named is the same task.
"""

import copyreg
import hashlib
import importlib
import importlib.metadata
import inspect
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

# The tasks of the files that the user has named, by their code.
_named: dict[tuple[str, str], type[Task]] = {}

_OWN = {
    "balance": "bounce_mjx.tasks.balance:Balance",
    "bounce": "bounce_mjx.tasks.bounce:Bounce",
    "catch": "bounce_mjx.tasks.catch:Catch",
    "juggle": "bounce_mjx.tasks.juggle:Juggle",
    "track": "bounce_mjx.tasks.track:Track",
}


def find_task(name: str) -> type[Task]:
    """The task of a name, of an entry point in `GROUP`, or of FILE.py:CLASS.

    Raises:
      UserError: there is none, or it cannot be imported.
    """
    if is_file(name):
        task = class_in_file(name, Task)
        admit(name, task)
        return task
    # Without a look at the installed packages, which takes 10 ms.
    known = _OWN if name in _OWN else _registered()
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
            f"the task {name} cannot be imported ({error}); install the package that has it again"
        ) from error


def task_name(task: type[Task]) -> str:
    """The name under which `find_task` finds a task: its registered name, or FILE.py:CLASS."""
    place = f"{task.__module__}:{task.__qualname__}"
    for name, value in _registered().items():
        if value == place:
            return name
    return f"{inspect.getsourcefile(task)}:{task.__qualname__}"


def task_config(task: str | type[Task]) -> type[WorldConfig]:
    """The settings of a task: its class, or a name as for `find_task`."""
    return (find_task(task) if isinstance(task, str) else task).Config


def is_file(name: str) -> bool:
    """Whether a task's name is FILE.py:CLASS."""
    return name.rpartition(":")[0].endswith(".py")


def source_file(name: str) -> Path:
    """Absolute path of the file in FILE.py:CLASS."""
    return Path(name.rpartition(":")[0]).expanduser().absolute()


def known_task(name: str) -> type[Task] | None:
    """The task of FILE.py:CLASS if code with the same content has been named in this process;
    nothing of the file is run."""
    return _named.get(code_of(name))


def admit(name: str, task: type[Task]) -> None:
    """Lets a task stand for FILE.py:CLASS, whose code may be another one."""
    _named[code_of(name)] = task


def code_of(name: str) -> tuple[str, str]:
    """What identifies the code of a task: the hash of its file and the class; for a registered
    task, its name.

    Raises:
      UserError: the file cannot be read.
    """
    if not is_file(name):
        return name, ""
    return _digest(read_source(name)), name.rpartition(":")[2]


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
            f"the task's file {shorten(str(path))} cannot be read ({reason_of(error)}); give "
            "FILE.py:CLASS"
        ) from error


def _digest(source: bytes) -> str:
    return hashlib.sha256(source).hexdigest()[:16]


def registered_tasks() -> tuple[str, ...]:
    """Names of the tasks of the package and of installed packages."""
    return tuple(sorted(_registered()))


def _registered() -> dict[str, str]:
    """MODULE:CLASS by name."""
    entries = importlib.metadata.entry_points(group=GROUP)
    return {entry.name: entry.value for entry in entries} | _OWN


def class_in_file(name: str, base: type[Kind]) -> type[Kind]:
    """The subclass of `base` in FILE.py:CLASS, whose code runs once in a process.

    Raises:
      UserError: the file cannot be imported, or has no such class.
    """
    path, source = source_file(name), read_source(name)
    # The name is the same in every process that reads a pickled environment.
    module = types.ModuleType(f"bounce_mjx_task_{_digest(source)}")
    module.__file__ = str(path)
    if module.__name__ not in sys.modules:
        sys.modules[module.__name__] = module
        try:
            exec(compile(source, str(path), "exec"), vars(module))
        except Exception as error:
            del sys.modules[module.__name__]
            frames = traceback.extract_tb(error.__traceback__)
            lines = [frame.lineno for frame in frames if frame.filename == str(path)]
            line = getattr(error, "lineno", None) or (lines or [1])[-1]
            raise UserError(
                f"the {_word(base)}'s file {path} cannot be imported ({type(error).__name__} in "
                f"line {line}: {shorten(str(error), 300)}); correct it"
            ) from error
    found = _class_in(sys.modules[module.__name__], name, base)
    if base is Task and found.__module__ == module.__name__:
        copyreg.pickle(found.Config, _pickled)
    return found


def _pickled(config: WorldConfig) -> tuple:
    """A pickled config names the task's file first, which another process imports before it reads
    the rest: the settings, and what follows the config in an environment."""
    task = type(config).task
    return _unpickled, (task_name(task), task.__module__), config.__getstate__()


def _unpickled(name: str, module_name: str) -> WorldConfig:
    """A config without its settings, of the task in a file."""
    module = sys.modules.get(module_name)
    task = find_task(name) if module is None else _class_in(module, name, Task)
    if task.__module__ != module_name:
        raise UserError(
            f"the task's file {source_file(name)} is not the one with which the environment was "
            "pickled; restore it"
        )
    return task.Config.__new__(task.Config)


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
            f"the {_word(base)}'s file {source_file(name)} has no {_word(base)} "
            f"{shorten(attribute)!r} (its subclasses of {base.__name__}: "
            f"{', '.join(classes) or 'none'}); give FILE.py:CLASS"
        )
    return classes[attribute]


def _word(base: type) -> str:
    return "task" if base is Task else "algorithm"
