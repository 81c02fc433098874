"""The one exception that a user's mistake raises, and how a command reports it."""

import contextlib
import sys
from collections.abc import Iterator


class UserError(Exception):
    """A mistake that the user can mend; its text is one sentence: what was given, what was
    expected, what to do."""


@contextlib.contextmanager
def exit_on_user_error() -> Iterator[None]:
    """Turns a `UserError` into that sentence on stderr and exit status 2, without a traceback."""
    try:
        yield
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
