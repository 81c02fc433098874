"""The exception that a user's mistake raises, and how a command reports it."""

import contextlib
import sys
from collections.abc import Iterator

from bounce_mjx.interrupt import INTERRUPTED, Interrupted, leave


class UserError(Exception):
    """A mistake that the user can correct. Its text is one sentence with the given value, the
    expected one and the remedy."""


@contextlib.contextmanager
def exit_on_user_error() -> Iterator[None]:
    """Reports a `UserError` as one sentence on stderr and exits with status 2; Ctrl-C exits with
    status 130. Neither prints a traceback."""
    try:
        yield
    except UserError as error:
        print(f"error: {on_one_line(str(error))}", file=sys.stderr)
        sys.exit(2)
    except Interrupted:
        leave()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def on_one_line(text: str) -> str:
    """A text without the line breaks and terminal codes that a file or a flag may hold."""
    line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return shorten(line, 3000)


def reason_of(error: Exception) -> str:
    """An exception's text on one line, for a sentence; its type if it has no text."""
    return " ".join(str(error).split()) or type(error).__name__


def shorten(text: str, length: int = 100) -> str:
    """A user's text, cut to fit into a sentence."""
    return text if len(text) <= length else f"{text[: length - 3]}..."
