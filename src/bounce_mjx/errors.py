"""The exception that a user's mistake raises, and how a command reports it."""

import contextlib
import difflib
import functools
import io
import os
import re
import select
import shlex
import sys
from collections.abc import Iterable, Iterator

from bounce_mjx.interrupt import leave

# Time for a slow reader of an output that does not block.
_PATIENCE_SECONDS = 1.0


class UserError(Exception):
    """A mistake that the user can correct. Its text is one sentence with the given value, the
    expected one and the remedy."""


class UnexpectedArgument(UserError, TypeError):
    """An argument or an option with an unknown name; libraries that try several expect a TypeError
    with these words of Python's own."""


class MissingPackage(UserError, ImportError):
    """An optional package cannot be imported."""


@contextlib.contextmanager
def needed(package: str, install: str) -> Iterator[None]:
    """Around the import of an optional package.

    Args:
      install: its name on the package index, as for `install_command`.

    Raises:
      MissingPackage: the package cannot be imported.
    """
    try:
        yield
    except MissingPackage:
        raise
    except ImportError as error:
        raise MissingPackage(
            f"{package} cannot be imported ({reason_of(error)}); install it with: "
            f"{install_command(install)}"
        ) from error


def install_command(*words: str) -> str:
    """The command that installs a package where this process runs.

    Args:
      words: options, and its name on the package index or an extra such as "bounce_mjx[sb3]".
    """
    # `uv run` sets the variable, and its environment has no pip.
    uv = "uv " if "UV_RUN_RECURSION_DEPTH" in os.environ else ""
    return f"{uv}pip install {shlex.join(words)}"


@contextlib.contextmanager
def exit_on_user_error() -> Iterator[None]:
    """Reports a `UserError` as one sentence on stderr and exits with status 2; Ctrl-C exits with
    status 130. Neither prints a traceback, and nor does a device on which JAX does not start, an
    output that cannot encode a path, or one that cannot be written any more: see `_Output`."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        # Not where a test or a notebook has put its own stream.
        if stream is not None and stream is getattr(sys, f"__{name}__"):
            stream.flush()
            output = io.BufferedWriter(_Output(stream.fileno(), "w", closefd=False))
            lasting = io.TextIOWrapper(
                output, stream.encoding, "backslashreplace", line_buffering=True
            )
            setattr(sys, name, lasting)
    try:
        yield
    except (UserError, RuntimeError) as error:
        refusal = _refused_device(error)
        if refusal is None and not isinstance(error, UserError):
            raise
        print(f"error: {_printable(refusal or reason_of(error))}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        leave()


def _refused_device(error: BaseException | None) -> str | None:
    """Why JAX does not start, if an error or its cause says so; it may look like another one, such
    as a checkpoint that cannot be read."""
    # A cause may lead back to its own error.
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        reason = str(error)
        if isinstance(error, RuntimeError) and reason.startswith("Unable to initialize backend"):
            platforms = os.environ.get("JAX_PLATFORMS", "")
            return (
                f"JAX does not start on JAX_PLATFORMS={platforms} ({shorten(reason, 300)}); unset "
                "it, or name platforms of this machine, such as cpu"
            )
        error = error.__cause__
    return None


def _printable(text: str) -> str:
    """A sentence without the codes that a terminal would obey, which a file's name may hold."""
    letters = (x if x.isprintable() else x.encode("unicode_escape").decode() for x in text)
    return shorten("".join(letters), 3000)


class _Output(io.FileIO):
    """Standard output or error, which drops everything from the first bytes that cannot be written:
    the disk is full, or the reader, such as head, or the terminal is gone. Of an output that does
    not block, it drops what a slow reader leaves no room for."""

    _is_slow = False

    def write(self, data: memoryview) -> int:
        try:
            written = super().write(data)
            if written is None and not self._is_slow:
                select.select([], [self], [], _PATIENCE_SECONDS)
                written = super().write(data)
        except OSError:
            # Also for the output of C++.
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.fileno())
            return len(data)
        # A training must not wait again and again for a reader that has stopped.
        self._is_slow = written is None
        return len(data) if written is None else written


@functools.cache
def warn_once(sentence: str) -> None:
    """Prints a warning on stderr, unless this process has printed it before."""
    print(f"warning: {sentence}", file=sys.stderr)


def reason_of(error: Exception) -> str:
    """An exception's text on one line, for a sentence, with the nearest name that there is of a
    wrong one; its type if it has no text."""
    text = " ".join(str(error).split())
    # pydantic's text ends in a link to its own pages.
    text = re.sub(r" For further information visit \S+", "", text)
    if near := _nearest_name(error):
        # An ImportError ends with the module's place.
        text = f"{text.partition(' (/')[0]} ({near})"
    return text or type(error).__name__


def _nearest_name(error: Exception) -> str:
    """A question about the name that a module or an object has in place of a wrong one; empty if
    none is near."""
    if isinstance(error, AttributeError) and error.name:
        return suggest(error.name, dir(error.obj))
    if isinstance(error, ImportError) and error.name in sys.modules:
        # Python 3.12 has the name as `name_from`.
        wrong = re.match(r"cannot import name '(\w+)'", str(error))
        return suggest(wrong[1], dir(sys.modules[error.name])) if wrong else ""
    return ""


def shorten(text: str, length: int = 100) -> str:
    """A user's text, cut to fit into a sentence."""
    return text if len(text) <= length else f"{text[: length - 3]}..."


RENAMED = {
    "BounceConfig": "Config",
    "BounceObservation": "Observation",
    "BounceReward": "Rewards",
    "Command": "Goal",
    "command": "goal",
    "command_seconds": "goal_seconds",
    "commands": "goals",
    "first_command": "first_goal",
    "next_command": "next_goal",
}
"""Today's names of what a task's file may have by another one."""


def suggest(name: str, known: Iterable[str]) -> str:
    """A question about the known name that a mistaken one has today, or that is nearest to it;
    empty if none is near."""
    known = list(known)
    if RENAMED.get(name) in known:
        return f"did you mean {RENAMED[name]}?"
    near = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {near[0]}?" if near else ""
