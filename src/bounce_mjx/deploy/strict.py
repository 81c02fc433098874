"""JSON as annotated types: the twin of the settings' strictness, for robots without pydantic."""

import types
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

# Limits of a number that states none; products of such numbers stay finite.
_LIMITS = -1e12, 1e12


def read(kind: Any, value: Any, name: str) -> Any:
    """A value from JSON as a type; only lists become tuples, and whole numbers floats.

    Args:
      kind: int, float, str, a `NamedTuple` (a group of exactly its fields), or tuple, dict, Literal
        or `| None` of these; a number's limits are `Annotated[float, (low, high)]`.
      name: of the value, for the error.

    Raises:
      ValueError: the value is of another type, not finite, or beyond its limits.
    """
    limits, origin, args = _LIMITS, get_origin(kind), get_args(kind)
    if origin is Annotated:
        kind, limits = args
    fields = get_type_hints(kind, include_extras=True) if hasattr(kind, "_fields") else {}
    if origin in (Union, types.UnionType):
        return None if value is None else read(args[0], value, name)
    if origin is Literal and value in args:
        return value
    if origin is dict and isinstance(value, dict):
        return {key: read(args[1], item, f"{name}.{key}") for key, item in value.items()}
    if fields and isinstance(value, dict) and value.keys() == fields.keys():
        return kind(**{key: read(fields[key], value[key], f"{name}.{key}") for key in fields})
    if origin is tuple and isinstance(value, list):
        kinds = args[:1] * len(value) if args[-1] is ... else args
        if len(kinds) == len(value):
            items = zip(kinds, value, strict=True)
            return tuple(read(one, item, f"{name}[{i}]") for i, (one, item) in enumerate(items))
    if kind is str and isinstance(value, str):
        return value
    types_of_number = {int: (int,), float: (int, float)}.get(kind, ())
    if type(value) in types_of_number and limits[0] <= value <= limits[1]:
        return kind(value)
    raise ValueError(f"its {name} is {repr(value)[:60]}, but must be {_expected(kind, limits)}")


def _expected(kind: Any, limits: tuple[float, float]) -> str:
    origin, args = get_origin(kind), get_args(kind)
    if origin is Literal:
        return " or ".join(args)
    if origin is tuple:
        return "a list" if args[-1] is ... else f"a list of {len(args)}"
    if origin is dict or hasattr(kind, "_fields"):
        return f"a group of {', '.join(getattr(kind, '_fields', ['ranges']))}"
    if kind is str:
        return "a text"
    number = "a whole number" if kind is int else "a number"
    return f"{number} from {limits[0]:g} to {limits[1]:g}"
