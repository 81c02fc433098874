"""Command lines from the types of settings: argparse reads words, and pydantic their values.

The flag of a setting is its dotted key, without a first group of `UNNAMED_GROUPS`: --friction of
env.friction, --reward.height.weight of env.reward.height.weight (`flag_names`).
"""

import argparse
import re
import types
from collections.abc import Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any, NamedTuple, NoReturn, TypeVar

import pydantic
from pydantic.fields import FieldInfo
from rich.console import Console

from bounce_mjx.config.files import flat
from bounce_mjx.config.settings import fields_in, merged, nested, types_in
from bounce_mjx.config.validation import describe
from bounce_mjx.errors import UserError, suggest

CommandT = TypeVar("CommandT", bound=pydantic.BaseModel)

UNNAMED_GROUPS = ("env", "ppo", "viewing", "goals")
"""Groups that the flags of their settings do not name."""

# Words for a setting without a value: that of YAML and of the help, and Python's.
_NO_VALUE = ("null", "None")
# A negative number with an exponent.
_SMALL_NUMBER = re.compile(r"-(\d+\.?\d*|\.\d+)[eE][+-]?\d{1,3}")
# Columns: more than any table or line has.
_NO_WRAP = 100_000


class Flag(NamedTuple):
    """A mark of a setting: how its flag differs from its name and type."""

    name: str | None = None
    """Name in place of the setting's."""
    metavar: str | None = None
    """Form of the value in the help."""
    is_positional: bool = False
    """Whether the value has no flag."""
    is_repeated: bool = False
    """Whether the flag may come several times, each with one of the values."""
    instead_of: tuple[str, ...] = ()
    """Flags of other commands for which this command has this one, such as --out: for an error."""
    needs: str | None = None
    """Key of a setting without which this one says nothing."""
    excludes: tuple[str, ...] = ()
    """Keys of settings and of groups beside which this one cannot be given."""


def stdout(**options: Any) -> Console:
    """The console that a command prints to. Elsewhere than on a terminal, such as in a pipe, it
    neither wraps nor cuts a line.

    Args:
      options: arguments of `rich.console.Console`.
    """
    console = Console(**options)
    # A signal may end the process before a hidden cursor is shown again.
    console.show_cursor = lambda show=True: False
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
    is_first: bool = False,
) -> CommandT:
    """Reads a command line into a config.

    Args:
      description: what the command does; by default, the type's docstring.
      default: values for the flags that are not given; by default, the type's own default values.
      is_first: whether unknown flags are left for a later call, as the flags of this one decide
        which there are.

    Raises:
      UserError: a flag is unknown or has a bad value.
    """
    fields = fields_in(command_class)
    defaults = command_class.model_construct() if default is None else default
    given = read_flags(
        fields,
        args,
        prog=prog,
        # Python's option -OO leaves out docstrings.
        description=description or command_class.__doc__ or "",
        defaults=flat(defaults.model_dump()),
        is_first=is_first,
    )
    below = {} if default is None else default.model_dump()
    return typed(command_class, given, flag_names(fields), prog, below)


def typed(
    command_class: type[CommandT],
    given: Mapping[str, Any],
    flags: Mapping[str, str],
    prog: str,
    below: Mapping[str, Any] = types.MappingProxyType({}),
) -> CommandT:
    """A command line from the given values.

    Args:
      given: by the dotted keys of the settings; those of other settings are left out.
      flags: the flag of each setting by its dotted key, for errors.
      below: nested values for settings that are not given.

    Raises:
      UserError: a value is out of range.
    """
    values = dict(below)
    for key in given.keys() & fields_in(command_class).keys():
        values = merged(values, nested(key, given[key]))
    try:
        return command_class.model_validate(values)
    except pydantic.ValidationError as error:
        text = describe(error, fields_in(command_class), flags)
        raise UserError(f"{text} (see {prog} --help)") from error


def read_flags(
    fields: Mapping[str, FieldInfo],
    args: Sequence[str],
    *,
    prog: str,
    description: str,
    defaults: Mapping[str, Any],
    shown: Sequence[str] | None = None,
    epilog: str | None = None,
    is_first: bool = False,
) -> dict[str, Any]:
    """The given values of a command line by the dotted keys of their settings, not yet validated.

    Args:
      fields: the settings by dotted key.
      defaults: values for the help, by dotted key.
      shown: dotted keys of the flags that --help lists; by default, all.
      epilog: the end of the help.
      is_first: see `parse`.

    Raises:
      UserError: a flag is unknown or lacks its value.
    """
    parser = _Parser(
        prog=prog,
        description=description,
        epilog=epilog,
        allow_abbrev=False,
        add_help=not is_first,
        argument_default=argparse.SUPPRESS,
        formatter_class=lambda prog: argparse.HelpFormatter(prog, max_help_position=26, width=100),
    )
    _add_arguments(parser, fields, defaults, shown)
    given, unknown = parser.parse_known_intermixed_args(plain_words(args))
    if unknown and not is_first:
        advice = _near_flag(unknown[0].partition("=")[0], fields)
        parser.error(f"unknown argument {unknown[0]}" + (advice and f"; {advice}"))
    values = {}
    for key, value in vars(given).items():
        values[key] = _plain(fields[key].annotation, value)
        if isinstance(values[key], list) and dict in types_in(fields[key].annotation):
            values[key] = _pairs(values[key], flag_names(fields)[key], parser)
    _check_together(values, fields, parser)
    return values


def _check_together(
    given: Mapping[str, Any], fields: Mapping[str, FieldInfo], parser: "_Parser"
) -> None:
    """Holds what is given against what its flags need and exclude.

    Raises:
      UserError: a flag is given without the one that it needs, or beside one that it excludes.
    """
    flags = flag_names(fields)
    said = [key for key, value in given.items() if value is not None and value is not False]
    for key in said:
        mark = _mark(fields[key])
        if mark.needs is not None and mark.needs not in said:
            parser.error(f"{flags[key]} needs {flags[mark.needs]}; add it, or omit {flags[key]}")
        for other in said:
            if any(f"{other}.".startswith(f"{excluded}.") for excluded in mark.excludes):
                parser.error(f"{flags[key]} and {flags[other]} cannot be combined; omit one")


def plain_words(args: Sequence[str]) -> list[str]:
    """The words of a command line with each flag in one spelling: --num-envs for --num_envs,
    --report for --report=true, and --no-report for --report=false. A negative number is without an
    exponent, -0.001 for -1e-3, which argparse takes for a flag."""
    return [_plain_word(word) for word in args]


def _plain_word(word: str) -> str:
    if _SMALL_NUMBER.fullmatch(word):
        return f"{Decimal(word):f}"
    if not word.startswith("--"):
        return word
    flag, equals, value = word.partition("=")
    flag = flag.replace("_", "-")
    if value.lower() == "true":
        return flag
    if value.lower() == "false":
        return negated(flag)
    return f"{flag}{equals}{value}"


def _near_flag(word: str, fields: Mapping[str, FieldInfo]) -> str:
    """A question about the flag that an unknown word may stand for; empty if none is near."""
    for key, field in fields.items():
        mark = _mark(field)
        if word in mark.instead_of:
            if mark.is_positional:
                return f"its value has no flag, and stands first: {mark.metavar}"
            return f"did you mean {flag_names(fields)[key]}?"
    return suggest(word, all_flags(fields))


def _pairs(words: list[str | None], flag: str, parser: "_Parser") -> dict[str | None, str | None]:
    """The mapping that the words of a flag stand for: a name, its value, a name, its value.

    Raises:
      UserError: there is none, a name lacks its value, or a name appears twice.
    """
    names = words[::2]
    values = words[1::2]
    if not words or len(names) != len(values):
        parser.error(f"{flag} needs pairs of a name and its value, such as NAME 0.5")
    pairs = dict(zip(names, values, strict=True))
    if len(pairs) != len(names):
        parser.error(f"{flag} has a name twice; leave one out")
    return pairs


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message} (see {self.prog} --help)")


def _mark(field: FieldInfo) -> Flag:
    return next((mark for mark in field.metadata if isinstance(mark, Flag)), Flag())


def flag_names(fields: Mapping[str, FieldInfo]) -> dict[str, str]:
    """The flag of each setting by its dotted key: --reset.joint-angles of env.reset.joint_angles.
    Where another setting has that flag, the later one has the whole key, such as --env.seed,
    because a task's author may give a setting or a goal any name."""
    flags: dict[str, str] = {}
    taken = {"--help", "--help-all"}
    # A setting that stands in no group keeps its flag.
    for key in sorted(fields, key=lambda key: "." in key):
        group, dot, name = key.rpartition(".")
        whole = flag_of(group + dot + (_mark(fields[key]).name or name))
        short = re.sub(rf"^--({'|'.join(UNNAMED_GROUPS)})\.", "--", whole)
        flag = whole if short in taken else short
        taken.add(flag)
        if fields[key].annotation is bool:
            taken.add(negated(flag))
        flags[key] = flag
    return flags


def negated(flag: str) -> str:
    """The flag that switches off what a flag switches on."""
    return flag.replace("--", "--no-", 1)


def _add_arguments(
    parser: argparse.ArgumentParser,
    fields: Mapping[str, FieldInfo],
    defaults: Mapping[str, Any],
    shown: Sequence[str] | None,
) -> None:
    """Adds the arguments, in groups; `defaults` are by dotted name."""
    positional = ""
    flags = flag_names(fields)
    groups = {}
    for key, field in fields.items():
        mark = _mark(field)
        options = _options_of(field, mark)
        options["help"] = argparse.SUPPRESS
        if shown is None or key in shown:
            options["help"] = _help_of(field, defaults.get(key), is_short=shown is not None)
        name = key.rpartition(".")[0] or "arguments"
        if name not in groups:
            groups[name] = parser.add_argument_group(name)
        if mark.is_positional:
            positional += f" {options['metavar']}"
            groups[name].add_argument(key, **options)
        else:
            groups[name].add_argument(flags[key], dest=key, **options)
    parser.usage = f"{parser.prog}{positional} [FLAGS]"


def _help_of(field: FieldInfo, default: Any, is_short: bool) -> str:
    """A flag's help: the docstring of its setting, of which a short help has the first sentence,
    and the default value."""
    text = " ".join((field.description or "").split())
    if is_short:
        text = re.split(r"(?<=[\w)])[.;] ", text)[0].rstrip(".")
    if default is not False and default not in (None, ()):
        words = " ".join(map(str, default)) if isinstance(default, tuple) else default
        text = f"{text} (default: {words})"
    # To argparse, a single one begins a name.
    return text.replace("%", "%%")


def _options_of(field: FieldInfo, mark: Flag) -> dict[str, Any]:
    """What argparse must know of a flag's value."""
    if field.annotation is bool:
        return {"action": argparse.BooleanOptionalAction}
    options = {"metavar": mark.metavar or _form(field.annotation)}
    if mark.is_repeated:
        options["action"] = "append"
    elif _is_list(field.annotation):
        options["nargs"] = "*"
    elif mark.is_positional and not field.is_required():
        options["nargs"] = "?"
    return options


def _is_list(kind: Any) -> bool:
    return not {tuple, dict}.isdisjoint(types_in(kind))


def _plain(kind: Any, given: bool | str | list[str]) -> Any:
    """The words of a setting as pydantic reads them, or None; those of a mapping as a list, from
    which `_pairs` makes it. A list may also have commas, except where a file's name may."""
    if isinstance(given, bool):
        return given
    kinds = set(types_in(kind))
    is_list = _is_list(kind)
    parts = []
    for word in [given] if isinstance(given, str) else given:
        parts += word.split(",") if is_list and Path not in kinds else [word]
    if type(None) in kinds:
        parts = [None if part in _NO_VALUE else part for part in parts]
    return parts if is_list and parts != [None] else parts[0]


def _form(kind: Any) -> str:
    """The form of a setting's value, such as INT of tuple[int, ...]."""
    hidden = {tuple, dict, type(None), types.UnionType, Annotated}
    choices = []
    names = []
    for part in types_in(kind):
        if isinstance(part, str):
            choices.append(part)
        elif isinstance(part, type) and part not in hidden:
            names.append(part.__name__.upper())
    if choices and names:
        return "|".join([*names, *choices])
    return f"{{{','.join(choices)}}}" if choices else " ".join(names)


def all_flags(fields: Mapping[str, FieldInfo]) -> list[str]:
    """Every flag of settings, also those that negate one."""
    flags = []
    for key, flag in flag_names(fields).items():
        if not _mark(fields[key]).is_positional:
            flags.append(flag)
            if fields[key].annotation is bool:
                flags.append(negated(flag))
    return flags


def flag_of(name: str) -> str:
    """The flag of a name: --num-envs of num_envs."""
    return f"--{name}".replace("_", "-")
