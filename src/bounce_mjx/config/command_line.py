"""Command lines made from the types of settings: tyro reads words, and pydantic their values."""

import functools
import re
import textwrap
import types
import typing
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import pydantic
import tyro
from pydantic.fields import FieldInfo
from rich.console import Console
from tyro.constructors import (
    MISSING_NONPROP,
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from bounce_mjx.config.settings import is_group, leaves
from bounce_mjx.config.validation import describe
from bounce_mjx.errors import UserError, suggest

CommandT = TypeVar("CommandT", bound=pydantic.BaseModel)

# Column at which the texts of a help page start.
_HELP_COLUMN = 26

# Columns: more than any table or line has.
_NO_WRAP = 100_000

_REGISTRY = ConstructorRegistry()


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
) -> CommandT:
    """Reads a command line into a config.

    Args:
      description: what the command does; by default, the type's docstring.
      default: values for the flags that are not given; by default, the type's own default values.

    Raises:
      UserError: a flag is unknown or has a bad value.
    """
    # Python's option -OO leaves out docstrings.
    options = {"description": description or command_class.__doc__ or ""}
    if default is not None:
        options["default"] = default
    values, unknown = _read(command_class, args, prog, **options)
    if unknown:
        word = unknown[0].partition("=")[0].replace("_", "-")
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
    return " ".join(map(str, value)) or "empty" if isinstance(value, list) else str(value)


def _read(
    command_class: type[pydantic.BaseModel], args: Sequence[str], prog: str, **options: Any
) -> tuple[dict[str, Any], list[str]]:
    """The values of a command's flags, nested, and the words that are none of its flags."""
    args = [re.sub(r"^--(.*?)([^.=]+)=false$", r"--\1no-\2", word, flags=re.I) for word in args]
    args = [re.sub(r"^(--[^=]+)=true$", r"\1", word, flags=re.I) for word in args]
    return tyro.cli(
        command_class,
        args=args,
        prog=prog,
        return_unknown_args=True,
        registry=_REGISTRY,
        **options,
    )


@_REGISTRY.struct_rule
def _arguments(info: StructTypeInfo) -> StructConstructorSpec | None:
    """The arguments of a group of settings, which become a mapping of words."""
    if not is_group(info.type):
        return None
    fields = []
    for name, field in info.type.model_fields.items():
        default = getattr(info.default, name, MISSING_NONPROP)
        if default is MISSING_NONPROP and not field.is_required():
            default = field.get_default(call_default_factory=True)
        hint = "" if default in (None, (), {}, MISSING_NONPROP) else "(default: {})".format
        marks = [tyro.conf.arg(help_behavior_hint=hint), *field.metadata]
        kind = field.annotation
        if tyro.conf.UseAppendAction in field.metadata:
            kind = tuple[str, ...]
        elif not (is_group(kind) or kind is bool):
            marks.append(_words(kind))
        text = " ".join((field.description or "").split())
        fields.append(StructFieldSpec(name, Annotated[kind, *marks], default, text or None))
    return StructConstructorSpec(dict, tuple(fields))


def _words(kind: Any) -> PrimitiveConstructorSpec:
    """The words of a setting that pydantic is to read. A list may also have commas, except where a
    file's name may."""
    types = set(_types(kind))
    is_list = bool({tuple, dict} & types)

    def read(words: list[str]) -> Any:
        parts = [
            None if part == "None" and type(None) in types else part
            for word in words
            for part in (word.split(",") if is_list and Path not in types else [word])
        ]
        if dict in types:
            return dict(zip(parts[::2], parts[1::2], strict=False))
        return parts if is_list and parts != [None] else parts[0]

    return PrimitiveConstructorSpec(
        nargs="*" if is_list else 1,
        metavar=_form(kind),
        instance_from_str=read,
        is_instance=lambda _: True,
        str_from_instance=lambda value: list(map(str, value if is_list and value else [value])),
    )


def _types(kind: Any) -> Iterator[Any]:
    """The types that a type consists of, such as tuple and int of tuple[int, ...]."""
    yield typing.get_origin(kind) or kind
    for inner in typing.get_args(kind):
        yield from _types(inner)


def _form(kind: Any) -> str:
    """The form of a setting's value, such as `INT ...` of tuple[int, ...]."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin is Annotated:
        return _form(inner[0])
    if origin is Literal:
        return f"{{{','.join(inner)}}}"
    if origin is dict:
        return f"{' '.join(map(_form, inner))} ..."
    if origin is tuple:
        return f"{_form(inner[0])} ..." if inner[-1] is ... else " ".join(map(_form, inner))
    if origin in (typing.Union, types.UnionType):
        return "|".join(_form(kind) for kind in inner if kind is not type(None))
    return kind.__name__.upper()


def help_page(command: pydantic.BaseModel, keys: Sequence[str] = ()) -> str:
    """The flags of a command that has their defaults: each with its text, by group of settings; or
    those of some dotted keys, in this order, each with its first sentence."""
    paths = {".".join(name for name, _ in path): path for path in leaves(type(command))}
    groups = [*dict.fromkeys(["", *(key.rpartition(".")[0] for key in paths)])]
    lines, group = [], None
    for key in keys or sorted(paths, key=lambda key: groups.index(key.rpartition(".")[0])):
        if not keys and key.rpartition(".")[0] != group:
            group = key.rpartition(".")[0]
            lines.append(f"\n{group or 'training'}:")
        field, value = paths[key][-1][1], functools.reduce(getattr, key.split("."), command)
        form = "" if field.annotation is bool else f" {_form(field.annotation)}"
        text = " ".join((field.description or "").split())
        text = re.split(r"(?<=[\w)])[.;] ", text)[0].rstrip(".") if keys else text
        if value is not False and value not in (None, (), {}):
            value = " ".join(map(str, value)) if isinstance(value, tuple) else value
            text += f" (default: {value})"
        flag, margin = _flag(paths[key]), " " * _HELP_COLUMN
        flag = f"  {_switch_off(flag) if value is True else flag}{form}"
        wrapped = textwrap.fill(text, 100, initial_indent=margin, subsequent_indent=margin)
        fits = len(flag) < _HELP_COLUMN - 1
        lines.append(flag + (wrapped[len(flag) :] if fits else f"\n{wrapped}"))
    return "\n".join(lines).lstrip("\n")


def flags_of(command_class: type[pydantic.BaseModel]) -> list[str]:
    """The flags of a command."""
    flags = []
    for path in leaves(command_class):
        field = path[-1][1]
        if tyro.conf.Positional not in field.metadata:
            flags.append(_flag(path))
            if field.annotation is bool:
                flags.append(_switch_off(flags[-1]))
    return flags


def _switch_off(flag: str) -> str:
    """The flag that switches another one off: --reset.no-noise of --reset.noise."""
    return re.sub(r"^(--(?:.*\.)?)", r"\1no-", flag)


def _flag(path: Sequence[tuple[str, FieldInfo]]) -> str:
    """The flag of a setting: --reset.joint-angles of env.reset.joint_angles."""
    names = []
    for name, field in path:
        given = (getattr(mark, "name", None) for mark in field.metadata)
        names.append(next((new for new in given if isinstance(new, str)), name))
    return flag_of(".".join(filter(None, names)))


def flag_of(name: str) -> str:
    """The flag of a name: --num-envs of num_envs."""
    return f"--{name}".replace("_", "-")
