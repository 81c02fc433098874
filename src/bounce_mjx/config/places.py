"""Lines of the user's code, for errors: where an object is made, a function is defined, an error is
raised."""

import inspect
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any


def where_made() -> str:
    """The place of the user's code that makes an object, such as " (mine.py, line 12)", from within
    the object's `__post_init__`; empty for the package's own code."""
    frame = inspect.currentframe()
    made_by = ("where_made", "__post_init__", "__init__", "__new__")
    while frame is not None and frame.f_code.co_name in made_by:
        frame = frame.f_back
    return "" if frame is None else _place(frame.f_code.co_filename, frame.f_lineno)


def where_defined(function: Callable[..., Any]) -> str:
    """The place of a function of the user's, as in `where_made`."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    return "" if code is None else _place(code.co_filename, code.co_firstlineno)


def where_raised(error: BaseException, function: Callable[..., Any] | None = None) -> str:
    """The last line of the user's code that an error passed, as in `where_made`; that of the
    function, if any, if it passed none."""
    place = where_defined(function) if function else ""
    for frame in traceback.extract_tb(error.__traceback__):
        place = _place(frame.filename, frame.lineno) or place
    return place


def _place(file: str, line: int) -> str:
    """A line of a user's file in words; empty for a file of an installed package."""
    path = Path(file)
    is_installed = {"site-packages", "dist-packages"} & {*path.parts}
    is_of_package = path.is_relative_to(Path(__file__).parent.parent)
    if is_installed or is_of_package or not path.suffix:
        return ""
    return f" ({path.name}, line {line})"
