"""Tasks by name: those of the package, those of installed packages, and those in a file.

A task in a file is code. It runs only if the user names the file.
"""

import difflib
import hashlib
import importlib
import importlib.metadata
import importlib.util
import sys
import traceback
from pathlib import Path

from bounce_mjx.errors import UserError, shorten
from bounce_mjx.task.task import Task
from bounce_mjx.world.config import WorldConfig

DEFAULT = "bounce"
"""Name of the task of the original specification."""

GROUP = "bounce_mjx.tasks"
"""Entry points of installed packages that have tasks."""

_OWN = {"bounce": "bounce_mjx.tasks.bounce:Bounce"}


def find_task(name: str) -> type[Task]:
    """The task of a name, of an entry point in `GROUP`, or of FILE.py:CLASS.

    Raises:
      UserError: there is none, or it cannot be imported.
    """
    if is_file(name):
        return _from_file(name)
    known = {entry.name: entry.value for entry in importlib.metadata.entry_points(group=GROUP)}
    known |= _OWN
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        advice = f"did you mean {near[0]}?" if near else "give FILE.py:CLASS or a known name"
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


def task_config(task: str | type[Task]) -> type[WorldConfig]:
    """The settings of a task: its class, or a name as for `find_task`."""
    return (find_task(task) if isinstance(task, str) else task).Config


def is_file(name: str) -> bool:
    """Whether a task's name is FILE.py:CLASS."""
    return name.rpartition(":")[0].endswith(".py")


def source_file(name: str) -> Path:
    """Absolute path of the file in FILE.py:CLASS."""
    return Path(name.rpartition(":")[0]).expanduser().absolute()


def _from_file(name: str) -> type[Task]:
    path, attribute = source_file(name), name.rpartition(":")[2]
    try:
        source = path.read_bytes()
    except OSError as error:
        raise UserError(
            f"the task's file {path} cannot be read ({error.strerror}); give FILE.py:CLASS"
        ) from error
    # The same file gives the same classes, which a config compares.
    module_name = f"bounce_mjx_task_{hashlib.sha256(bytes(path) + source).hexdigest()[:16]}"
    if module_name not in sys.modules:
        spec = importlib.util.spec_from_file_location(module_name, path)
        module = importlib.util.module_from_spec(spec)
        sys.modules[module_name] = module
        try:
            spec.loader.exec_module(module)
        except Exception as error:
            del sys.modules[module_name]
            frames = [
                f for f in traceback.extract_tb(error.__traceback__) if f.filename == str(path)
            ]
            line = getattr(error, "lineno", None) or (frames[-1].lineno if frames else 1)
            raise UserError(
                f"the task's file {path} cannot be imported ({type(error).__name__} in "
                f"line {line}: {shorten(str(error), 300)}); correct it"
            ) from error
    found = getattr(sys.modules[module_name], attribute, None)
    if not (isinstance(found, type) and issubclass(found, Task)):
        classes = [
            key
            for key, value in vars(sys.modules[module_name]).items()
            if isinstance(value, type) and issubclass(value, Task) and value is not Task
        ]
        raise UserError(
            f"the task's file {path} has no task {shorten(attribute)!r} (its subclasses of Task: "
            f"{', '.join(classes) or 'none'}); give FILE.py:CLASS"
        )
    return found
