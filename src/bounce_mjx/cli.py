"""Command lines made from config types, with one-sentence errors."""

import difflib
from collections.abc import Iterator, Sequence
from typing import TypeVar

import pydantic
import tyro

# tyro's own hook for replacing its error boxes; unstable, so pyproject.toml bounds the version.
from tyro import _errors as tyro_errors

from bounce_mjx.config import describe
from bounce_mjx.errors import UserError

CommandT = TypeVar("CommandT")


def parse(
    command_class: type[CommandT],
    args: Sequence[str],
    *,
    prog: str,
    description: str,
    default: CommandT | None = None,
) -> CommandT:
    """Reads a command line into a config.

    Args:
      default: values of the flags that are not given; the type's own if left out.

    Raises:
      UserError: a flag is unknown or has a bad value.
    """

    def raise_user_error(event: tyro_errors.ParseErrorEvent) -> None:
        raise UserError(f"{_mistake(event, command_class)} (see {prog} --help)")

    with tyro_errors.on_parse_error(raise_user_error):
        try:
            return tyro.cli(
                command_class,
                args=list(args),
                prog=prog,
                description=description,
                **({} if default is None else {"default": default}),
            )
        except pydantic.ValidationError as error:
            raise UserError(f"{describe(error, command_class)} (see {prog} --help)") from error


def _mistake(event: tyro_errors.ParseErrorEvent, command_class: type) -> str:
    if isinstance(event, tyro_errors.UnrecognizedArgs):
        given = event.tokens[0].split("=")[0].replace("_", "-")
        near = difflib.get_close_matches(given, list(_flags(command_class)), n=1)
        return f"unknown argument {event.tokens[0]}" + (
            f"; did you mean {near[0]}?" if near else ""
        )
    argument = getattr(event, "argument", None)
    if argument is None:
        return "the command line is not understood"
    name = (argument.lowered.name_or_flags or [argument.field.extern_name])[0]
    wanted = argument.lowered.metavar
    return f"{name} has a missing or wrong value; it takes {wanted}"


def _flags(command_class: type, prefix: str = "") -> Iterator[str]:
    """The flags of a config type, whose groups `env` and `ppo` have no prefix."""
    for name, field in command_class.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, pydantic.BaseModel):
            inner = prefix if name in ("env", "ppo") else f"{prefix}{name}."
            yield from _flags(field.annotation, inner)
        else:
            yield f"--{prefix}{name}".replace("_", "-")
