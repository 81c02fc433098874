"""The types of settings, and the base class of every group of settings.

A group is immutable, and rejects unknown keys and values out of range. The docstring below a field
gives its unit; it is also the help text of the command line. The bounds of a quantity with a unit
are wide, and refuse the same quantity in another unit: millimetres, degrees or milliseconds.
"""

import math
import numbers
import re
import typing
from collections.abc import Iterator
from typing import Annotated, Any, TypeVar

import pydantic
from pydantic import Field
from pydantic.fields import FieldInfo
from pydantic_core import PydanticKnownError

from bounce_mjx.errors import shorten

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]

NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]

Finite = Annotated[float, Field(allow_inf_nan=False)]

UnitInterval = Annotated[float, Field(ge=0.0, le=1.0)]

Length = Annotated[Positive, Field(le=10.0)]
"""m"""

Distance = Annotated[NonNegative, Field(le=10.0)]
"""m; may be 0."""

Coordinate = Annotated[Finite, Field(ge=-10.0, le=10.0)]
"""m"""

Speed = Annotated[Positive, Field(le=100.0)]
"""m/s or rad/s"""

Velocity = Annotated[Finite, Field(ge=-100.0, le=100.0)]
"""m/s or rad/s"""

Duration = Annotated[Positive, Field(le=3600.0)]
"""s"""

Friction = Annotated[NonNegative, Field(le=10.0)]
"""Coefficient of sliding friction."""

BallInertia = Annotated[Positive, Field(le=0.67)]
"""Moment of inertia of a ball per mass and squared radius."""

HOLLOW = 2.0 / 3.0
"""That of a thin shell, as a table-tennis ball is."""


def as_given(ends: Any) -> str:
    """What a user gave for a range, as it was written; a flag's one word is in a list."""
    is_one_word = isinstance(ends, list) and len(ends) == 1 and isinstance(ends[0], str)
    return shorten(ends[0] if is_one_word else str(ends))


def _check_pair(ends: Any) -> Any:
    if not isinstance(ends, list | tuple) or len(ends) != 2:
        raise ValueError(f"{as_given(ends)} is not a range; give two numbers")
    return ends


def _check_order(ends: tuple[float, float]) -> tuple[float, float]:
    if not ends[0] <= ends[1]:
        raise ValueError(f"{ends} is not a range; give the lower end first")
    return ends


Number = TypeVar("Number")

Range = Annotated[
    tuple[Number, Number],
    pydantic.BeforeValidator(_check_pair),
    pydantic.AfterValidator(_check_order),
]
"""Two ends of a type, such as `Range[Length]`, the lower one first; equal ends are one value."""


def whole_number(value: Any) -> Any:
    """A number in scientific notation, such as "1e6", as a float, of which pydantic reads an
    integer; any other value is returned unchanged. YAML reads 1e6 as a string, because its numbers
    with an exponent need a decimal point.
    """
    scientific = r"[+-]?[\d_]*\d(\.\d*)?[eE][+-]?\d+"
    return float(value) if re.fullmatch(scientific, str(value)) else value


_WholeNumber = pydantic.BeforeValidator(whole_number)

NonNegativeInt = Annotated[int, _WholeNumber, Field(ge=0, lt=2**31)]

Count = Annotated[int, _WholeNumber, Field(ge=1, lt=2**31)]

Steps = Annotated[int, _WholeNumber, Field(ge=1, le=10**12)]


def is_finite(value: Any) -> bool:
    """Whether a value is a finite number, which a truth value is not."""
    is_number = isinstance(value, numbers.Real) and not isinstance(value, bool)
    return is_number and math.isfinite(value)


class StrictModel(pydantic.BaseModel):
    """An immutable group of settings, which refuses unknown keys."""

    model_config = pydantic.ConfigDict(
        frozen=True, extra="forbid", use_attribute_docstrings=True, validate_default=True
    )

    @pydantic.field_validator("*", mode="before")
    @classmethod
    def _refuse_switch(cls, value: Any, info: pydantic.ValidationInfo) -> Any:
        # pydantic would read true as 1.
        kinds = set(types_in(cls.model_fields[info.field_name].annotation))
        is_number = bool(kinds & {int, float}) and bool not in kinds
        if is_number and any(isinstance(part, bool) for part in parts_of(value)):
            raise PydanticKnownError("int_type" if int in kinds else "float_type")
        return value

    @pydantic.model_validator(mode="before")
    @classmethod
    def _complete_groups(cls, values: Any) -> Any:
        """A group that is given in part keeps the other settings of its default, which need not be
        those of its class."""
        if not isinstance(values, dict):
            return values
        completed = dict(values)
        for name, field in cls.model_fields.items():
            if isinstance(values.get(name), dict):
                default = default_of(field)
                if isinstance(default, StrictModel):
                    plain = default.model_dump(exclude_unset=True)
                    completed[name] = merged(plain, values[name])
        return completed


def types_in(kind: Any) -> Iterator[Any]:
    """The types that a type consists of, such as tuple and int of tuple[int, ...]."""
    yield typing.get_origin(kind) or kind
    for inner in typing.get_args(kind):
        yield from types_in(inner)


def has_default(field: FieldInfo) -> bool:
    """Whether a setting has a default, and not one that depends on the other settings."""
    return not (field.is_required() or field.default_factory_takes_validated_data)


def default_of(field: FieldInfo) -> Any:
    """The default of a setting, also one that is made anew for each group; None without one."""
    return field.get_default(call_default_factory=True) if has_default(field) else None


def parts_of(value: Any) -> Iterator[Any]:
    """The values in nested sequences and mappings; a value that is neither is its only part."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for inner in value:
            yield from parts_of(inner)
    else:
        yield value


def fields_in(group: type[pydantic.BaseModel], prefix: str = "") -> dict[str, FieldInfo]:
    """The settings of a group and of the groups in it, by dotted name."""
    fields = {}
    for name, field in group.model_fields.items():
        key = prefix + name
        inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, pydantic.BaseModel):
            fields |= fields_in(inner, f"{key}.")
        else:
            fields[key] = field
    return fields


def nested(key: str, value: Any) -> dict[str, Any]:
    """Nested mappings with one value, by its dotted key."""
    for name in reversed(key.split(".")):
        value = {name: value}
    return value


def merged(values: dict[str, Any], others: dict[str, Any]) -> dict[str, Any]:
    """Nested mappings in which the others' keys win. Settings that are mappings themselves, such as
    `shares`, are joined too."""
    result = dict(values)
    for key, value in others.items():
        if isinstance(value, dict) and isinstance(result.get(key), dict):
            result[key] = merged(result[key], value)
        else:
            result[key] = value
    return result
