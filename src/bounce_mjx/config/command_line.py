"""Command lines from the types of settings: argparse reads words, and pydantic their values."""

import argparse
import functools
import re
import types
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, NoReturn, TypeVar

import pydantic
from pydantic.fields import FieldInfo
from rich.console import Console

from bounce_mjx.config.settings import leaves, types_in
from bounce_mjx.config.validation import describe
from bounce_mjx.errors import UserError, suggest

CommandT = TypeVar("CommandT", bound=pydantic.BaseModel)

# Columns: more than any table or line has.
_NO_WRAP = 100_000


class Flag(NamedTuple):
    """A mark of a setting: how its flag differs from its name and type."""

    name: str | None = None
    """Name in place of the setting's; empty for a group whose flags have no prefix."""
    metavar: str | None = None
    """Form of the value in the help."""
    is_positional: bool = False
    """Whether the value has no flag."""
    is_repeated: bool = False
    """Whether the flag may come several times, each with one of the values."""


class _Console(Console):
    def show_cursor(self, show: bool = True) -> bool:
        """Never hides it: a signal may end the process before it is shown again."""
        return False


def stdout(**options: Any) -> Console:
    """The console that a command prints to. Elsewhere than on a terminal, such as in a pipe, it
    neither wraps nor cuts a line.

    Args:
      options: arguments of `rich.console.Console`.
    """
    console = _Console(**options)
    if not console.is_terminal:
        console.width = _NO_WRAP
    return console


def parse(
    command_class: type[CommandT],
    args: Sequence[str],
    *,
    prog: str,
    description: str | None = None,
    default: CommandT | None = None,
    shown: Sequence[str] | None = None,
    epilog: str | None = None,
) -> CommandT:
    """Reads a command line into a config.

    Args:
      description: what the command does; by default, the type's docstring.
      default: values for the flags that are not given; by default, the type's own default values.
      shown: dotted keys of the flags that --help lists; by default, all.
      epilog: the end of the help.

    Raises:
      UserError: a flag is unknown or has a bad value.
    """
    # Python's option -OO leaves out docstrings.
    options = {"description": description or command_class.__doc__ or "", "epilog": epilog}
    values, unknown = _read(command_class, args, prog, default, shown, **options)
    if unknown:
        word = unknown[0].partition("=")[0]
        advice = "; ".join(filter(None, [unknown[0], suggest(word, flags_of(command_class))]))
        raise UserError(f"unknown argument {advice} (see {prog} --help)")
    return _validate(command_class, values, prog)


def parse_first(command_class: type[CommandT], args: Sequence[str], *, prog: str) -> CommandT:
    """Reads the flags that must be known before the others, which it leaves alone.

    Raises:
      UserError: one of these flags has a bad value.
    """
    return _validate(command_class, _read(command_class, args, prog, add_help=False)[0], prog)


def _validate(command_class: type[CommandT], values: dict[str, Any], prog: str) -> CommandT:
    try:
        return command_class.model_validate(values)
    except pydantic.ValidationError as error:
        flags = {".".join(name for name, _ in path): _flag(path) for path in leaves(command_class)}
        sentence = describe(error, command_class, lambda key: flags.get(key, key), _on_one_line)
        raise UserError(f"{sentence} (see {prog} --help)") from error


def _on_one_line(value: Any) -> str:
    """The words of a value."""
    return " ".join(map(str, value)) or "empty" if isinstance(value, list | tuple) else str(value)


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message} (see {self.prog} --help)")


def _read(
    command_class: type[pydantic.BaseModel],
    args: Sequence[str],
    prog: str,
    default: pydantic.BaseModel | None = None,
    shown: Sequence[str] | None = None,
    **options: Any,
) -> tuple[dict[str, Any], list[str]]:
    """The values of a command's arguments, nested, on top of the defaults, and the words that are
    none of its arguments."""
    parser = _Parser(
        prog=prog,
        usage=f"{prog} [FLAGS]",
        allow_abbrev=False,
        argument_default=argparse.SUPPRESS,
        formatter_class=lambda prog: argparse.HelpFormatter(prog, max_help_position=26, width=100),
        **options,
    )
    start, groups = default or command_class.model_construct(), {}
    fields = {}
    for path in leaves(command_class):
        key, field = ".".join(name for name, _ in path), path[-1][1]
        fields[key] = field
        value = functools.reduce(lambda at, name: getattr(at, name, None), key.split("."), start)
        text = " ".join((field.description or "").split()).replace("%", "%%")
        text = text if shown is None else re.split(r"(?<=[\w)])[.;] ", text)[0].rstrip(".")
        if value is not False and value not in (None, (), {}):
            text += f" (default: {_on_one_line(value)})"
        group = key.rpartition(".")[0] or "arguments"
        if group not in groups:
            groups[group] = parser.add_argument_group(group)
        own = {"help": text if shown is None or key in shown else argparse.SUPPRESS}
        if field.annotation is bool:
            own["action"] = argparse.BooleanOptionalAction
        elif _mark(field).is_repeated:
            own["action"] = "append"
        elif _is_list(field.annotation):
            own["nargs"] = "*"
        if field.annotation is not bool:
            own["metavar"] = _mark(field).metavar or _form(field.annotation)
        if _mark(field).is_positional:
            own.setdefault("nargs", None if field.is_required() else "?")
            parser.usage += f" {own['metavar']}"
            groups[group].add_argument(key, **own)
        else:
            groups[group].add_argument(_flag(path), dest=key, **own)
    words = [re.sub(r"^--[^=]+", lambda flag: flag[0].replace("_", "-"), word) for word in args]
    words = [re.sub(r"^--(.+)=false$", r"--no-\1", word, flags=re.I) for word in words]
    words = [re.sub(r"^(--.+)=true$", r"\1", word, flags=re.I) for word in words]
    given, unknown = parser.parse_known_intermixed_args(words)
    values = {} if default is None else default.model_dump()
    for key, value in vars(given).items():
        *outer, name = key.split(".")
        group = functools.reduce(lambda at, name: at.setdefault(name, {}), outer, values)
        group[name] = value if isinstance(value, bool) else _plain(fields[key].annotation, value)
    return values, unknown


def _mark(field: FieldInfo) -> Flag:
    return next((mark for mark in field.metadata if isinstance(mark, Flag)), Flag())


def _is_list(kind: Any) -> bool:
    return not {tuple, dict}.isdisjoint(types_in(kind))


def _plain(kind: Any, words: str | list[str]) -> Any:
    """The words of a setting as pydantic reads them. A list may also have commas, except where a
    file's name may."""
    kinds = set(types_in(kind))
    parts = [
        None if part == "None" and type(None) in kinds else part
        for word in ([words] if isinstance(words, str) else words)
        for part in (word.split(",") if _is_list(kind) and Path not in kinds else [word])
    ]
    if dict in kinds:
        return dict(zip(parts[::2], parts[1::2], strict=False))
    return parts if _is_list(kind) and parts != [None] else parts[0]


def _form(kind: Any) -> str:
    """The form of a setting's value, such as INT of tuple[int, ...]."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin is Annotated:
        return _form(inner[0])
    if origin is Literal:
        return f"{{{','.join(inner)}}}"
    if origin in (tuple, dict):
        return " ".join(_form(kind) for kind in inner if kind is not ...)
    if origin in (typing.Union, types.UnionType):
        return "|".join(_form(kind) for kind in inner if kind is not type(None))
    return kind.__name__.upper()


def flags_of(command_class: type[pydantic.BaseModel]) -> list[str]:
    """The flags of a command."""
    flags = []
    for path in leaves(command_class):
        if not _mark(path[-1][1]).is_positional:
            flags.append(_flag(path))
            if path[-1][1].annotation is bool:
                flags.append(flags[-1].replace("--", "--no-", 1))
    return flags


def _flag(path: Sequence[tuple[str, FieldInfo]]) -> str:
    """The flag of a setting: --reset.joint-angles of env.reset.joint_angles."""
    marks = [(name, _mark(field).name) for name, field in path]
    return flag_of(".".join(filter(None, (name if own is None else own for name, own in marks))))


def flag_of(name: str) -> str:
    """The flag of a name: --num-envs of num_envs."""
    return f"--{name}".replace("_", "-")
