"""Command lines made from config types, with one-sentence errors."""

import contextlib
import dataclasses
import difflib
import itertools
import re
import sys
import time
import typing
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import pydantic
import tyro
from pydantic.fields import FieldInfo
from rich.console import Console
from rich.progress import Progress

# tyro's own hook for replacing its error boxes; unstable, so pyproject.toml bounds the version.
from tyro import _errors as tyro_errors
from tyro.constructors import (
    MISSING_NONPROP,
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from bounce_mjx.config.settings import whole_number
from bounce_mjx.config.validation import describe
from bounce_mjx.errors import UserError

CommandT = TypeVar("CommandT")

# Lines about the progress are left out where less time than this is left.
_SILENT_SECONDS = 10.0

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


@contextlib.contextmanager
def progress(console: Console, doing: str, done: str) -> Iterator[Callable[[float], None]]:
    """A function that shows the share of a task that is done, from 0 to 1: as a bar on a terminal;
    elsewhere, as a line after each tenth of a task whose rest is slow.

    Args:
      doing: what the task does, such as "evaluating".
      done: what is done with the share, such as "evaluated".
    """
    # The first call follows the compilation.
    said, first, started = 0.0, 0.0, None
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("compiling", total=1.0)

        def show(share: float) -> None:
            nonlocal said, first, started
            bar.update(task, completed=share, description=doing)
            if started is None:
                first, started = share, time.monotonic()
            spent, left = time.monotonic() - started, 1.0 - share
            slow = spent * left >= _SILENT_SECONDS * (share - first)
            if not console.is_terminal and slow and left and share - max(said, first) > 0.0999:
                said = share
                console.print(f"{share:.0%} {done}", highlight=False)

        yield show


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

    words = _usual_spelling(args, flags_of(command_class))

    def raise_user_error(event: tyro_errors.ParseErrorEvent) -> None:
        raise UserError(f"{_mistake(event, command_class, args)} (see {prog} --help)")

    with tyro_errors.on_parse_error(raise_user_error):
        try:
            return tyro.cli(
                command_class,
                args=words,
                prog=prog,
                description=description,
                registry=_REGISTRY,
                **({} if default is None else {"default": default}),
            )
        # tyro raises the errors of groups without a prefix, and reports the others as an event.
        except pydantic.ValidationError as error:
            raise UserError(f"{_bad_value(error, command_class)} (see {prog} --help)") from error


@_REGISTRY.struct_rule
def _described(info: StructTypeInfo) -> StructConstructorSpec | None:
    """A group of settings with help that reads well: tyro's own rule keeps the line breaks of the
    docstrings, and shows `{None}|PATH` and `(default: )`."""
    if not (isinstance(info.type, type) and issubclass(info.type, pydantic.BaseModel)):
        return None
    fields = []
    for name, field in info.type.model_fields.items():
        default = getattr(info.default, name, MISSING_NONPROP)
        if default is MISSING_NONPROP and not field.is_required():
            default = field.get_default(call_default_factory=True)
        kind, spec = field.annotation, _spec(field)
        if spec is not None and isinstance(default, tuple) and spec.is_instance(default) is False:
            # A file may give what a flag cannot, such as a range for each joint.
            shown = {"is_instance": lambda _: True, "str_from_instance": lambda given: [str(given)]}
            kind = Annotated[Any, dataclasses.replace(spec, **shown)]
        hint = "" if default in (None, (), MISSING_NONPROP) else "(default: {})".format
        # The field's own marks follow, and win.
        mark = tyro.conf.arg(metavar=_metavar(field, spec), help_behavior_hint=hint)
        kind = Annotated[kind, mark, *field.metadata]
        text = " ".join((field.description or "").split())
        fields.append(StructFieldSpec(name, kind, default, text or None))
    return StructConstructorSpec(info.type, tuple(fields))


def _spec(field: FieldInfo) -> PrimitiveConstructorSpec | None:
    """How tyro reads a setting's value; None for a group or a switch, which take none."""
    if field.annotation is bool or _is_group(field):
        return None
    kind = PrimitiveTypeInfo.make(field.annotation, set())
    spec = ConstructorRegistry.get_primitive_spec(kind)
    return spec if isinstance(spec, PrimitiveConstructorSpec) else None


def _metavar(field: FieldInfo, spec: PrimitiveConstructorSpec | None) -> str | None:
    """The form of a setting's value: `PATH` of tyro's `{None}|PATH`, `INT ...` of
    `[INT [INT ...]]`."""
    if spec is None:
        return None
    form = re.sub(r"\{None\}\||(?<=\{)None,", "", spec.metavar)
    form = re.sub(r"\[(.+?) \[\1 \.\.\.\]\]", r"\1 ...", form)
    if "," not in form:
        form = form.strip("{}")
    if tyro.conf.UseAppendAction in field.metadata:
        form = form.removesuffix(" ...")
    return f"[{form}]" if tyro.conf.Positional in field.metadata else form


def _usual_spelling(args: Sequence[str], flags: dict[str, FieldInfo | None]) -> list[str]:
    """A command line in tyro's spelling.

    Other programs also take `--flag=false` for `--no-flag`, `1e6` for a whole number, and
    `256,256` for a list of two.
    """
    words: list[str] = []
    field = None
    for word in args:
        flag, equals, value = word.partition("=") if word.startswith("--") else ("", "", word)
        if flag:
            field = flags.get(flag.replace("_", "-"))
        kind = None if field is None else field.annotation
        if kind is bool and value.lower() in ("true", "false"):
            if flag or words[-1].startswith("--"):
                flag = flag or words.pop()
                words.append(flag if value.lower() == "true" else _negated(flag))
                continue
        types = set(_types(kind))
        # The name of a file may have commas.
        parts = value.split(",") if tuple in types and Path not in types else [value]
        if int in types:
            parts = [str(whole_number(part)) for part in parts]
        if len(parts) > 1 and flag:
            words.append(flag)
        elif flag:
            parts = [flag + equals + parts[0]]
        words.extend(parts)
    return words


def _types(kind: Any) -> Iterator[Any]:
    """The types that a type consists of, such as tuple and int of tuple[int, ...]."""
    yield typing.get_origin(kind) or kind
    for inner in typing.get_args(kind):
        yield from _types(inner)


def _negated(flag: str) -> str:
    """The flag that sets a switch to false."""
    group, dot, name = flag.removeprefix("--").rpartition(".")
    return f"--{group}{dot}no-{name}"


def _mistake(
    event: tyro_errors.ParseErrorEvent, command_class: type[pydantic.BaseModel], args: Sequence[str]
) -> str:
    if isinstance(event, tyro_errors.UnrecognizedArgs):
        return unknown_argument(event.tokens[0], flags_of(command_class))
    invalid = _validation_error()
    if invalid is not None:
        return _bad_value(invalid, command_class)
    argument = getattr(event, "argument", None)
    if argument is None:
        return "the command line is not understood"
    flag = (argument.lowered.name_or_flags or [argument.field.extern_name])[0]
    wanted = argument.lowered.metavar or "no value"
    return f"{flag} takes {wanted}, but was given {_given(args, flag) or 'nothing'}"


def unknown_argument(word: str, flags: Iterable[str]) -> str:
    """A word of a command line that is none of the flags, as part of an error."""
    near = difflib.get_close_matches(word.split("=")[0].replace("_", "-"), flags, n=1)
    return f"unknown argument {word}" + (f"; did you mean {near[0]}?" if near else "")


def _bad_value(error: pydantic.ValidationError, command_class: type[pydantic.BaseModel]) -> str:
    """The first mistake of a validation error, named by its flag."""
    groups = {group.__name__: (group, prefix) for group, prefix in _groups(command_class)}
    group, prefix = groups[error.title]
    return describe(error, group, lambda name: flag_of(prefix + name))


def _validation_error() -> pydantic.ValidationError | None:
    """The validation error that tyro is handling; tyro's event contains only its text."""
    error = sys.exception()
    while error is not None and not isinstance(error, pydantic.ValidationError):
        error = error.__context__
    return error


def _given(args: Sequence[str], flag: str) -> str:
    """The value of a flag on the command line."""
    for i, word in enumerate(args):
        name, equals, value = word.partition("=")
        if name.replace("_", "-") == flag:
            values = itertools.takewhile(lambda word: not word.startswith("--"), args[i + 1 :])
            return value if equals else " ".join(values)
    return ""


def flags_of(command_class: type[pydantic.BaseModel]) -> dict[str, FieldInfo | None]:
    """The settings of a command, keyed by the flags that tyro gives them; None for the negation of
    a switch."""
    flags: dict[str, FieldInfo | None] = {}
    for group, prefix in _groups(command_class):
        for name, field in group.model_fields.items():
            if tyro.conf.Positional in field.metadata or _is_group(field):
                continue
            flag = flag_of(prefix + _argument_name(name, field))
            flags[flag] = field
            if field.annotation is bool:
                flags[_negated(flag)] = None
    return flags


def _groups(
    command_class: type[pydantic.BaseModel], prefix: str = ""
) -> Iterator[tuple[type[pydantic.BaseModel], str]]:
    """A command and the groups of settings in it, each with the prefix of its flags."""
    yield command_class, prefix
    for name, field in command_class.model_fields.items():
        if _is_group(field):
            inner = _argument_name(name, field)
            yield from _groups(field.annotation, f"{prefix}{inner}." if inner else prefix)


def _is_group(field: FieldInfo) -> bool:
    annotation = field.annotation
    return isinstance(annotation, type) and issubclass(annotation, pydantic.BaseModel)


def _argument_name(name: str, field: FieldInfo) -> str:
    """The name of a field's flag, which `tyro.conf.arg(name=...)` may replace."""
    given = (getattr(mark, "name", None) for mark in field.metadata)
    return next((new for new in given if isinstance(new, str)), name)


def flag_of(name: str) -> str:
    """The flag of a setting: --num-envs of num_envs."""
    return f"--{name}".replace("_", "-")
