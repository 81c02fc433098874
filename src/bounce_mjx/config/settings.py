"""The types of settings, and the base class of every group of settings.

A group is immutable, and rejects unknown keys and values out of range. The docstring below a field
gives its unit; it is also the help text of the command line.
"""

import re
from pathlib import Path
from typing import Annotated, Any

import pydantic
from pydantic import Field

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]

NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]

Finite = Annotated[float, Field(allow_inf_nan=False)]

UnitInterval = Annotated[float, Field(ge=0.0, le=1.0)]


def _check_path(path: Path) -> Path:
    if "\0" in str(path):
        raise ValueError("a path cannot hold the null character; remove it")
    return path


PlainPath = Annotated[Path, pydantic.AfterValidator(_check_path)]


def _check_host(name: str) -> str:
    if not re.fullmatch(r"[\w.-]+", name):
        raise ValueError(f"{name!r} is not the name of a host; give it without http:// and port")
    return name


HostName = Annotated[str, pydantic.AfterValidator(_check_host)]


def whole_number(value: Any) -> Any:
    """A whole number in scientific notation, such as "1e6", as an integer; any other value is
    returned unchanged. YAML reads 1e6 as a string, because its numbers with an exponent need a
    decimal point.
    """
    if isinstance(value, str) and re.fullmatch(r"[+-]?[\d_]*\d(\.\d*)?[eE][+-]?\d+", value):
        number = float(value)
        return int(number) if number.is_integer() else value
    return value


_WholeNumber = pydantic.BeforeValidator(whole_number)

NonNegativeInt = Annotated[int, _WholeNumber, Field(ge=0, lt=2**31)]

Count = Annotated[int, _WholeNumber, Field(ge=1, lt=2**31)]

Steps = Annotated[int, _WholeNumber, Field(ge=1, le=10**12)]


class StrictModel(pydantic.BaseModel):
    """An immutable, strict group of settings."""

    model_config = pydantic.ConfigDict(
        frozen=True, extra="forbid", use_attribute_docstrings=True, validate_default=True
    )

    @pydantic.model_validator(mode="before")
    @classmethod
    def _complete_groups(cls, values: Any) -> Any:
        """A group that is given in part keeps the other settings of its default, which need not be
        those of its class."""
        if not isinstance(values, dict):
            return values
        defaults = {name: field.default for name, field in cls.model_fields.items()}
        return {
            name: merged(default.model_dump(exclude_unset=True), value)
            if isinstance(default := defaults.get(name), StrictModel) and isinstance(value, dict)
            else value
            for name, value in values.items()
        }


def merged(values: dict[str, Any], others: dict[str, Any]) -> dict[str, Any]:
    """Nested mappings in which the others' keys win."""
    result = dict(values)
    for key, value in others.items():
        both = isinstance(value, dict) and isinstance(result.get(key), dict)
        result[key] = merged(result[key], value) if both else value
    return result
