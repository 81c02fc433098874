"""Turns plain values into settings; a mistake is one sentence."""

import difflib
import re
import reprlib
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import pydantic

from bounce_mjx.config.settings import StrictModel
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
) -> str:
    """The first mistake of a validation error as part of a sentence.

    Args:
      spell: turns the dotted name of a setting into the form for the message, such as a flag.
    """
    first = error.errors()[0]
    if first["type"] in ("extra_forbidden", "invalid_key"):
        path = [shorten(str(part)) for part in first["loc"]]
        return f"unknown key {'.'.join(path)}; {_advice(config_class, path)}"
    path = [part for part in first["loc"] if isinstance(part, str)]
    if first["type"] == "value_error":
        reason = first["msg"].removeprefix("Value error, ")
        return ": ".join([*path[-1:], shorten(reason, 500)])
    given, unit = shorten(_Repr().repr(first["input"])), ""
    if first["type"].startswith(("greater_than", "less_than")):
        unit = f" {unit_of(_text(config_class, path))}".rstrip()
    return f"{spell('.'.join(path))} is {given}, but must {_wanted(error)}{unit}"


def unit_of(text: str) -> str:
    """The unit in the docstring of a setting, where it follows a comma, at the end or before an
    addition; empty for a pure number."""
    units = _UNIT.findall(" ".join(text.split()))
    return units[-1] if units else ""


def _text(config_class: type[pydantic.BaseModel], path: list[str]) -> str:
    """The docstring of a setting; empty if there is none of this dotted name."""
    for name in path[:-1]:
        field = config_class.model_fields.get(name)
        config_class = getattr(field, "annotation", None)
        if not (isinstance(config_class, type) and issubclass(config_class, pydantic.BaseModel)):
            return ""
    field = config_class.model_fields.get(path[-1]) if path else None
    return (field and field.description) or ""


class _Repr(reprlib.Repr):
    """Python's notation, shortened: a value from a file may be very long."""

    def __init__(self):
        super().__init__()
        self.maxstring = self.maxother = self.maxlong = 80
        self.maxlevel = 3

    def repr_int(self, x: int, level: int) -> str:
        # Python refuses to write an integer of many digits.
        return super().repr_int(x, level) if x.bit_length() < 1000 else "a very large number"


def _wanted(error: pydantic.ValidationError) -> str:
    """The requirement that the first mistake violates, to follow "must"."""
    first = error.errors()[0]
    if first["type"] == "missing":
        missing = [e["loc"] for e in error.errors() if e["loc"][:-1] == first["loc"][:-1]]
        return f"have {missing[-1][-1] + 1} items"
    limits = first.get("ctx", {})
    special = {
        "model_type": "be a group of keys and values",
        "path_type": "be a path",
        "too_long": f"have {limits.get('max_length')} items",
        "too_short": f"have at least {limits.get('min_length')} item",
        "tuple_type": "be a list",
    }
    ordinary = first["msg"].removeprefix("Input should ").split(", unable")[0]
    return special.get(first["type"], ordinary)


def _advice(config_class: type[pydantic.BaseModel], path: list[str]) -> str:
    """Advice on an unknown key."""
    known = list(_dotted_keys(config_class))
    prefix = ".".join([*path[:-1], ""])
    siblings = {key.removeprefix(prefix).split(".")[0] for key in known if key.startswith(prefix)}
    same_name = [key for key in known if key.split(".")[-1] == path[-1]]
    near = difflib.get_close_matches(path[-1], siblings, n=1)
    if near or same_name:
        return f"did you mean {same_name[0] if same_name else prefix + near[0]}?"
    return f"known keys here are {', '.join(sorted(siblings))}"


def _dotted_keys(config_class: type[pydantic.BaseModel], prefix: str = "") -> Iterator[str]:
    for name, field in config_class.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, StrictModel):
            yield from _dotted_keys(field.annotation, f"{prefix}{name}.")
        else:
            yield prefix + name
