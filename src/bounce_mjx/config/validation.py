"""Turns plain values into settings; a mistake is one sentence."""

import difflib
import re
from collections.abc import Callable
from typing import Any, TypeVar

import pydantic

from bounce_mjx.config.settings import StrictModel, leaves
from bounce_mjx.errors import UserError, shorten

ConfigT = TypeVar("ConfigT", bound=StrictModel)

_UNIT = re.compile(r", (1/m|s/m|m/s\^2|m/s|rad/s|rad|m|s|kg|Hz|N m)(?=[.;]| \()")


def validate(config_class: type[ConfigT], values: dict[str, Any], source: str) -> ConfigT:
    """Builds a config from plain values.

    Args:
      source: origin of the values, for the error.

    Raises:
      UserError: a key is unknown or a value is out of range.
    """
    try:
        return config_class.model_validate(values)
    except pydantic.ValidationError as error:
        raise UserError(f"{shorten(source)}: {describe(error, config_class)}") from error


def describe(
    error: pydantic.ValidationError,
    config_class: type[pydantic.BaseModel],
    spell: Callable[[str], str] = str,
    show: Callable[[Any], str] = repr,
) -> str:
    """The first mistake of a validation error as part of a sentence, in pydantic's words.

    Args:
      spell: turns the dotted name of a setting into the form for the message, such as a flag.
      show: the same for its value.
    """
    first = error.errors()[0]
    fields = {".".join(name for name, _ in path): path[-1][1] for path in leaves(config_class)}
    if first["type"] in ("extra_forbidden", "invalid_key"):
        *groups, name = (shorten(str(part)) for part in first["loc"])
        return f"unknown key {'.'.join([*groups, name])}; {_advice(fields, groups, name)}"
    key = ".".join(part for part in first["loc"] if isinstance(part, str))
    if first["type"] == "value_error":
        reason = shorten(first["msg"].removeprefix("Value error, "), 500)
        return ": ".join(filter(None, [key.rpartition(".")[2], reason]))
    reason = first["msg"][0].lower() + first["msg"][1:]
    if first["type"] == "missing":
        reason = "an item is missing"
    if first["type"].startswith(("greater_than", "less_than")) and key in fields:
        reason += f" {unit_of(fields[key].description or '')}".rstrip()
    given = shorten(show(first["input"]))
    return f"{spell(key)} is {given}, but {reason.replace('input should', 'must', 1)}"


def unit_of(text: str) -> str:
    """The unit in the docstring of a setting, where it follows a comma, at the end or before an
    addition; empty for a pure number."""
    units = _UNIT.findall(" ".join(text.split()))
    return units[-1] if units else ""


def _advice(known: dict[str, Any], groups: list[str], name: str) -> str:
    """Advice on an unknown key.

    Args:
      known: the settings by dotted name.
      groups: the groups that the key is in.
    """
    prefix = "".join(f"{group}." for group in groups)
    here = {key.removeprefix(prefix).split(".")[0] for key in known if key.startswith(prefix)}
    same_name = [key for key in known if key.rpartition(".")[2] == name]
    near = [prefix + key for key in difflib.get_close_matches(name, here, n=1)]
    if near or same_name:
        return f"did you mean {(same_name or near)[0]}?"
    return f"known keys here are {', '.join(sorted(here))}"
