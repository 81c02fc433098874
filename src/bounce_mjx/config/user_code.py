"""The user's own code: imported once, by `--import` or as any module, its classes have names.

In the names of functions, here and where these are called, `own` is the user's (`own_algorithm`).

The name of a class is its class name in lower case, such as dribble of `class Dribble(Task)`; a
task of an installed package has that of its entry point (`task/registry.py`). Nothing else ever
runs a file: neither a config nor a run brings code into a process. A run has a copy of the code
that it was trained with, which the commands that a training prints import; code is compared by its
content.
"""

import importlib
import inspect
import itertools
import os
import shlex
import sys
import traceback
import types
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import pydantic

from bounce_mjx.config.validation import describe
from bounce_mjx.errors import UserError, reason_of, shorten

Kind = TypeVar("Kind")

_FLAG = "--import"
_PACKAGE = "bounce_mjx."
# Begin of the names of the modules of imported files.
_PREFIX = "bounce_mjx_file_"


class CodeFile(NamedTuple):
    """A file of code."""

    path: Path
    content: bytes
    """What was imported, which may have been edited since; of a module that Python imported itself,
    what its file holds now."""


# Of the imported files, by the name of their module.
_code_files: dict[str, CodeFile] = {}
_numbers = itertools.count()
# The words of the command that runs here, for the command that has an import in addition.
_command: list[str] = []


def import_code(place: str | os.PathLike) -> None:
    """Imports a file of the user's own tasks or algorithms, whose classes then have names. A file
    of the same content, such as a run's copy of it, is the same code, and runs once.

    Args:
      place: FILE.py, or the name of a module.

    Raises:
      UserError: it cannot be read or imported.
    """
    if not str(place).endswith(".py"):
        _import_module(str(place))
        return
    path = Path(os.path.abspath(Path(place).expanduser()))
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(
            f"{shorten(str(path))} cannot be read ({error.strerror}); give {_FLAG} FILE.py"
        ) from error
    if all(content != code_file.content for code_file in _code_files.values()):
        _run(CodeFile(path, content))


def do_imports(args: Sequence[str], prog: Sequence[str]) -> list[str]:
    """Imports what a command line names with --import; its other words.

    Args:
      args: such as RUN, --import, FILE.py.
      prog: the words before these, such as bounce-mjx, eval, for the command that an error advises.

    Raises:
      UserError: a place is missing, or cannot be imported.
    """
    _command[:] = [*prog, *args]
    others = []
    words = iter(args)
    for word in words:
        flag, equals, place = word.partition("=")
        if flag != _FLAG:
            others.append(word)
            continue
        place = place if equals else next(words, "")
        if not place or place.startswith("--"):
            raise UserError(f"{_FLAG} needs a file or a module; give {_FLAG} FILE.py")
        import_code(place)
    return others


def class_named(name: str, base: type[Kind]) -> type[Kind] | None:
    """The user's class of a name, of those that were imported; None without one.

    Raises:
      UserError: two files have one of this name.
    """
    found = [kind for kind in _subclasses(base) if own_name(kind) == name.lower()]
    if not found:
        return None
    newest = found[-1]
    for other in found:
        if not _is_same(code_file_of(other), code_file_of(newest)):
            places = f"{_place_of(other)} and {_place_of(newest)}"
            raise UserError(f"{name} is a class of {places}; import one of them, or rename one")
    return newest


def own_names(base: type) -> list[str]:
    """The names of the user's classes that were imported."""
    return list(dict.fromkeys(map(own_name, _subclasses(base))))


def own_name(kind: type) -> str:
    """The name of a user's class."""
    return kind.__name__.lower()


def code_file_of(kind: type) -> CodeFile | None:
    """The file of a class; None for one of a notebook or an interpreter."""
    if kind.__module__ in _code_files:
        return _code_files[kind.__module__]
    try:
        path = Path(os.path.abspath(inspect.getsourcefile(kind) or ""))
        return CodeFile(path, path.read_bytes())
    except (TypeError, OSError):
        return None


def import_flags_of_classes(*kinds: type) -> list[str]:
    """The flags with which a later command imports these classes again; none for those of the
    package, and of no file."""
    paths: list[Path] = []
    for kind in kinds:
        code_file = None if kind.__module__.startswith(_PACKAGE) else code_file_of(kind)
        if code_file is not None:
            paths.append(code_file.path)
    return import_flags(paths)


def import_flags(files: Iterable[Path]) -> list[str]:
    """The flags with which a command imports files."""
    return [word for file in dict.fromkeys(files) for word in (_FLAG, str(file))]


def not_imported(source: str, key: str, name: str, file: Path | None) -> UserError:
    """The refusal of a run or a file whose code was not imported in this process.

    Args:
      source: of the name, such as the run.
      key: task or algorithm.
      file: the code, where it is known.
    """
    place = file or "FILE.py"
    code = f", whose code is {file}" if file else ""
    advice = f'import_code("{place}")'
    if _command:
        advice = shlex.join([*_command, _FLAG, str(place)])
    return UserError(f"{source} has the {key} {name}{code}; import it to run it: {advice}")


def _import_module(name: str) -> None:
    # The user's own modules lie in the working directory.
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        importlib.import_module(name)
    except Exception as error:
        raise UserError(
            f"{shorten(name)} cannot be imported ({reason_of(error)}); give {_FLAG} FILE.py, or "
            "the name of a module"
        ) from error


def _run(code_file: CodeFile) -> None:
    """Runs a file as a module.

    Raises:
      UserError: it raises an error.
    """
    module = types.ModuleType(f"{_PREFIX}{code_file.path.stem}_{next(_numbers)}")
    module.__file__ = str(code_file.path)
    # Dataclasses and pickles look for their module there.
    sys.modules[module.__name__] = module
    _code_files[module.__name__] = code_file
    try:
        exec(compile(code_file.content, str(code_file.path), "exec"), vars(module))
    except UserError as error:
        del _code_files[module.__name__]
        raise UserError(f"{code_file.path} cannot be imported: {error}") from error
    except Exception as error:
        del _code_files[module.__name__]
        line = 1
        for frame in traceback.extract_tb(error.__traceback__):
            if frame.filename == str(code_file.path):
                line = frame.lineno
        # A SyntaxError has its own.
        line = getattr(error, "lineno", None) or line
        reason = reason_of(error)
        if isinstance(error, pydantic.ValidationError):
            reason = describe(error, {})
        raise UserError(
            f"{code_file.path} cannot be imported ({type(error).__name__} in line {line}: "
            f"{shorten(reason, 300)}); correct it"
        ) from error


def _subclasses(base: type[Kind]) -> Iterator[type[Kind]]:
    """The user's subclasses of a class of the package, as their modules have them: not one that a
    module has defined anew since, nor one within a function."""
    for kind in base.__subclasses__():
        module = sys.modules.get(kind.__module__)
        is_forgotten = kind.__module__.startswith(_PREFIX) and kind.__module__ not in _code_files
        is_own = not kind.__module__.startswith(_PACKAGE) and not is_forgotten
        if is_own and getattr(module, kind.__qualname__, None) is kind:
            yield kind
        yield from _subclasses(kind)


def _is_same(one: CodeFile | None, other: CodeFile | None) -> bool:
    """Whether two files of code are one, or its copy."""
    if one is None or other is None:
        return one is other
    return one.path == other.path or one.content == other.content


def _place_of(kind: type) -> str:
    code_file = code_file_of(kind)
    return kind.__module__ if code_file is None else str(code_file.path)
