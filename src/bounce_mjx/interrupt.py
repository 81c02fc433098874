"""Ctrl-C during work that Python cannot interrupt, such as a compilation by XLA."""

import concurrent.futures
import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any, NoReturn, TypeVar

from bounce_mjx.garbage import no_garbage_collection

Result = TypeVar("Result")

INTERRUPTED = 130
"""Exit status of a process that Ctrl-C ended, by the shells' convention."""

# Windows does not interrupt an unlimited wait.
_POLL_SECONDS = 0.1


class Interrupted(KeyboardInterrupt):
    """Ctrl-C came while a thread was doing work that cannot be stopped."""


def run_interruptible(function: Callable[..., Result], *arguments: Any, **keywords: Any) -> Result:
    """Calls a function in a thread of its own and waits for its result.

    Python runs signal handlers in the main thread, between two bytecodes. A compilation on that
    thread would therefore delay Ctrl-C until it ends.

    Raises:
      Interrupted: Ctrl-C came. The thread cannot be stopped: end the process with `leave`.
      BaseException: the function raised it.
    """
    future: concurrent.futures.Future[Result] = concurrent.futures.Future()

    def run() -> None:
        try:
            future.set_result(function(*arguments, **keywords))
        except BaseException as error:  # noqa: BLE001
            future.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    try:
        while not concurrent.futures.wait([future], timeout=_POLL_SECONDS).done:
            pass
    except KeyboardInterrupt as interrupt:
        raise Interrupted from interrupt
    return future.result()


@contextlib.contextmanager
def interruptible_imports() -> Iterator[None]:
    """Lets Ctrl-C end the process at once, without a KeyboardInterrupt: a library that is being
    imported may turn it into another exception. Python does not search for garbage meanwhile."""
    with no_garbage_collection():
        if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
            yield
            return
        signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, signal.default_int_handler)


def leave(status: int = INTERRUPTED) -> NoReturn:
    """Ends the process at once, without waiting for its threads.

    A normal exit of the interpreter would free memory that a compilation in another thread still
    uses.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
