"""Turns plain values into settings; a mistake is one sentence."""

import difflib
import operator
import re
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any, TypeVar

import pydantic
from pydantic.fields import FieldInfo

from bounce_mjx.config.settings import StrictModel, fields_in, types_in
from bounce_mjx.errors import UserError, shorten

ConfigT = TypeVar("ConfigT", bound=StrictModel)

_UNIT = re.compile(
    r", (1/m|s/m|m/s\^2|m/s|rad/s\^3|rad/s\^2|rad/s|rad|m|s|kg|Hz|N m s/rad|N m)(?=[.;]| \()"
)


def validate(
    config_class: type[ConfigT], values: dict[str, Any], source: str, group: str = ""
) -> ConfigT:
    """Builds a config from plain values.

    Args:
      source: origin of the values, for the error.
      group: dotted key of the config in a larger one, for the error.

    Raises:
      UserError: a key is unknown or a value is out of range.
    """
    try:
        return config_class.model_validate(values)
    except pydantic.ValidationError as error:
        fields = fields_in(config_class, f"{group}." if group else "")
        raise UserError(f"{shorten(source)}: {describe(error, fields, group=group)}") from error


def checked_count(name: str, value: Any) -> int:
    """A whole number of at least 1, of an argument in Python.

    Raises:
      UserError: it is none.
    """
    try:
        number = operator.index(value)
    except TypeError:
        number = 0
    if number < 1:
        raise UserError(f"{name} is {value!r}, but must be a whole number of at least 1")
    return number


def describe(
    error: pydantic.ValidationError,
    fields: Mapping[str, FieldInfo],
    flags: Mapping[str, str] = MappingProxyType({}),
    group: str = "",
) -> str:
    """The first mistake of a validation error as part of a sentence, in pydantic's words.

    Args:
      fields: the settings by dotted name.
      flags: of a command line, the flag of each setting by its dotted name.
      group: dotted key, in `fields`, of what was validated.
    """
    first = error.errors()[0]
    key = _setting_of(key_of(error, group), fields)
    if first["type"] in ("extra_forbidden", "invalid_key"):
        return f"unknown key {shorten(key)}; {_advice_on(key, fields)}"
    if first["type"] == "value_error":
        reason = shorten(first["msg"].removeprefix("Value error, "), 500)
        name = key.rpartition(".")[2]
        return f"{name}: {reason}" if name else reason
    expected = _expected(first)
    reason = expected[0].lower() + expected[1:]
    if first["type"] == "missing":
        reason = "an item is missing"
    if first["type"] == "path_type":
        reason = "must be a path"
    if first["type"].startswith(("greater_than", "less_than")) and key in fields:
        reason += f" {unit_of(fields[key].description or '')}".rstrip()
    for other in error.errors()[1:]:
        # Each member of a union says what it accepts of the same value.
        is_of_setting = _setting_of(".".join(_path(other, group)), fields) == key
        if is_of_setting and _items(other) == _items(first):
            reason += f", or {_expected(other).removeprefix('Input should ')}"
    given = shorten(str(first["input"]))
    return f"{flags.get(key, key)} is {given}, but {reason.replace('input should', 'must', 1)}"


def unknown_key(error: UserError, group: str = "") -> str | None:
    """The dotted key that a `validate` refused as unknown; None where it refused another thing."""
    cause = error.__cause__
    if not isinstance(cause, pydantic.ValidationError):
        return None
    return key_of(cause, group) if cause.errors()[0]["type"] == "extra_forbidden" else None


def groups_of(fields: Iterable[str]) -> set[str]:
    """The dotted keys of the groups in which settings are, such as env and env.reward."""
    groups = set()
    for field in fields:
        group = field.rpartition(".")[0]
        while group:
            groups.add(group)
            group = group.rpartition(".")[0]
    return groups


def _advice_on(key: str, fields: Mapping[str, FieldInfo]) -> str:
    """What an unknown key may mean: one that is not nested but has dots, the same name in another
    group, a key that is spelt like it, a name that is; or which keys its group has."""
    group, dot, name = key.rpartition(".")
    by_name: dict[str, str] = {}
    groups = groups_of(fields)
    here: set[str] = set()
    for field in fields:
        by_name.setdefault(field.rpartition(".")[2], field)
        if field.startswith(group + dot):
            here.add(field.removeprefix(group + dot).split(".")[0])
    for known in (*fields, *groups):
        if group and f".{known}".endswith(f".{key}"):
            *parents, last = known.split(".")
            opened = "".join(f"{parent}: {{" for parent in parents)
            return f"nest it: {opened}{last}: ...{'}' * len(parents)}"
    if name in by_name:
        return f"did you mean {by_name[name]}?"
    keys = [*fields, *sorted(groups)]
    if near := difflib.get_close_matches(key, keys, n=1, cutoff=0.8):
        return f"did you mean {near[0]}?"
    if near := difflib.get_close_matches(name, by_name, n=1, cutoff=0.8):
        return f"did you mean {by_name[near[0]]}?"
    return f"known keys here are {', '.join(sorted(here))}"


def _setting_of(key: str, fields: Mapping[str, FieldInfo]) -> str:
    """The setting of a mistake's key, which may go on with the type of a union's member; of a
    mapping such as `shares`, it goes on with a key of it."""
    for setting, field in fields.items():
        if key.startswith(f"{setting}.") and dict not in types_in(field.annotation):
            return setting
    return key


def key_of(error: pydantic.ValidationError, group: str = "") -> str:
    """The dotted key of the first mistake; that of a group for a rule that joins its settings."""
    return ".".join(path_of(error, group))


def path_of(error: pydantic.ValidationError, group: str = "") -> list[str]:
    """The names of `key_of`, of which an unknown one may have dots itself."""
    return _path(error.errors()[0], group)


def _expected(mistake: Mapping[str, Any]) -> str:
    """What pydantic expected in place of a value, without how it tried to read a word."""
    return mistake["msg"].partition(", unable to parse")[0]


def _items(mistake: Mapping[str, Any]) -> list[int]:
    """The numbers of the items of nested lists in which pydantic found a mistake."""
    return [part for part in mistake["loc"] if isinstance(part, int)]


def _path(mistake: Mapping[str, Any], group: str) -> list[str]:
    """The names at which pydantic found a mistake, without the numbers of a list's items."""
    parents = group.split(".") if group else []
    return parents + [part for part in mistake["loc"] if isinstance(part, str)]


def unit_of(text: str) -> str:
    """The unit in the docstring of a setting, where it follows a comma, at the end or before an
    addition; empty for a pure number."""
    units = _UNIT.findall(" ".join(text.split()))
    return units[-1] if units else ""
