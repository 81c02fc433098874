"""The one exception that a user's mistake raises, and how a command reports it."""

import contextlib
import sys
from collections.abc import Iterator

from bounce_mjx.interrupt import INTERRUPTED, Interrupted, leave


class UserError(Exception):
    """A mistake that the user can correct; its text is one sentence: what was given, what was
    expected, what to do."""


@contextlib.contextmanager
def exit_on_user_error() -> Iterator[None]:
    """Turns a `UserError` into that sentence on stderr and exit status 2, without a traceback; and
    Ctrl-C into the shell's status 130."""
    try:
        yield
    except UserError as error:
        print(f"error: {_on_one_line(str(error))}", file=sys.stderr)
        sys.exit(2)
    except Interrupted:
        leave()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def _on_one_line(text: str) -> str:
    """Text from a file or a flag may hold line breaks, or what a terminal would obey."""
    line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return shorten(line, 3000)


def shorten(text: str, length: int = 100) -> str:
    """A text of a user, as far as it fits into a sentence."""
    return text if len(text) <= length else f"{text[: length - 3]}..."
