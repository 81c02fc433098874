"""Classes in files of the user, as a setting names them: FILE.py:CLASS.

Such a file is code, which runs only if the user names the file. Code is known by its content: a
run's copy of a file that the user has named is the same code.
"""

import os
import sys
import traceback
import types
from pathlib import Path
from typing import TypeVar

import pydantic

from bounce_mjx.config.validation import describe
from bounce_mjx.errors import UserError, reason_of, shorten

Kind = TypeVar("Kind")

# The modules of the files that the user has named, by their content.
_modules: dict[bytes, types.ModuleType] = {}
# The classes that the user has named for those of runs, by the run's FILE.py:CLASS.
_admitted: dict[str, type] = {}


def is_file(name: str) -> bool:
    """Whether a name is FILE.py:CLASS."""
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
    """Whether two names stand for the same class, which one of the same name in a copy of its file
    is too."""
    if not (is_file(name) and is_file(other)):
        return name == other
    is_same_class = name.rpartition(":")[2] == other.rpartition(":")[2]
    return is_same_class and read_source(name) == read_source(other)


def class_in_file(name: str, base: type[Kind]) -> type[Kind]:
    """The subclass of `base` in FILE.py:CLASS, whose code runs once in a process.

    Raises:
      UserError: the file cannot be imported, or has no such class.
    """
    source = read_source(name)
    if source not in _modules:
        _modules[source] = _run(source, source_file(name))
    return _class_in(_modules[source], name, base)


def known_class(name: str, base: type[Kind]) -> type[Kind] | None:
    """The subclass of `base` in FILE.py:CLASS if code with the same content has been named in this
    process; nothing of the file is run.

    Raises:
      UserError: the file cannot be read, or has no such class.
    """
    if name in _admitted:
        return _admitted[name]
    module = _modules.get(read_source(name))
    return None if module is None else _class_in(module, name, base)


def admit(name: str, named: type) -> None:
    """Lets a class that the user has named stand for a run's FILE.py:CLASS, whose code may be
    another one."""
    _admitted[name] = named


def _run(source: bytes, path: Path) -> types.ModuleType:
    """The module of a file, whose code runs here.

    Raises:
      UserError: it raises an error.
    """
    module = types.ModuleType(f"bounce_mjx_{path.stem}_{len(_modules)}")
    module.__file__ = str(path)
    # Dataclasses and pickles look for their module there.
    sys.modules[module.__name__] = module
    try:
        exec(compile(source, str(path), "exec"), vars(module))
    except UserError as error:
        raise UserError(f"{path} cannot be imported: {error}") from error
    except Exception as error:
        line = 1
        for frame in traceback.extract_tb(error.__traceback__):
            if frame.filename == str(path):
                line = frame.lineno
        # A SyntaxError has its own.
        line = getattr(error, "lineno", None) or line
        reason = reason_of(error)
        if isinstance(error, pydantic.ValidationError):
            reason = describe(error, {})
        raise UserError(
            f"{path} cannot be imported ({type(error).__name__} in line {line}: "
            f"{shorten(reason, 300)}); correct it"
        ) from error
    return module


def _class_in(module: types.ModuleType, name: str, base: type[Kind]) -> type[Kind]:
    """The subclass of `base` of FILE.py:CLASS in the file's module."""
    classes = {
        key: value
        for key, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, base) and value is not base
    }
    class_name = name.rpartition(":")[2]
    if class_name not in classes:
        raise UserError(
            f"{source_file(name)} has no subclass {shorten(class_name)!r} of {base.__name__} "
            f"(it has: {', '.join(classes) or 'none'}); give FILE.py:CLASS"
        )
    return classes[class_name]
