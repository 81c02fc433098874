"""Ctrl-C and SIGTERM as requests: a handler that raised an exception would lose it wherever Python
drops exceptions, such as in JAX's callback of the garbage collection."""

import concurrent.futures
import contextlib
import functools
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import NoReturn, ParamSpec, TypeVar

from bounce_mjx.garbage import no_garbage_collection

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

INTERRUPTED = 130
"""Exit status of a process that Ctrl-C ended, by the shells' convention."""

# Windows does not interrupt an unlimited wait.
_POLL_SECONDS = 0.1
# Launchers forward a Ctrl-C to a process that has already received it from the terminal.
_SAME_REQUEST_SECONDS = 0.5
_SHOW_CURSOR = "\x1b[?25h"


class Interrupted(KeyboardInterrupt):
    """Ctrl-C came while a thread was doing work that cannot be stopped."""


class StopRequest:
    """While entered, the first signal only sets `requested`; the next one ends the process at once.

    Python runs signal handlers in the main thread, so the signals must be those of a request that
    is entered there. The innermost request of all threads receives them.
    """

    _entered: "list[StopRequest]" = []

    def __init__(self, *signals: signal.Signals):
        """
        Args:
          signals: SIGINT and SIGTERM by default.
        """
        self._signals = signals or (signal.SIGINT, signal.SIGTERM)
        self._requested_at: float | None = None
        self._previous = {}

    @property
    def requested(self) -> bool:
        """Whether a signal has come."""
        return self._requested_at is not None

    def __enter__(self) -> "StopRequest":
        self._entered.append(self)
        # Only the main thread may install signal handlers.
        if threading.current_thread() is threading.main_thread():
            # A shell script starts processes in the background with SIGINT ignored.
            self._previous = {
                number: signal.signal(number, lambda number, _: self._entered[-1]._handle(number))
                for number in self._signals
                if signal.getsignal(number) is not signal.SIG_IGN
            }
        return self

    def __exit__(self, *_) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._entered.remove(self)

    def check(self) -> None:
        """Raises `Interrupted` if a signal has come."""
        if self.requested:
            raise Interrupted

    def wait_for(self, future: concurrent.futures.Future) -> bool:
        """Waits until the future is done, and returns True; returns False as soon as a stop is
        requested."""
        while not self.requested:
            if concurrent.futures.wait([future], timeout=_POLL_SECONDS).done:
                return True
        return False

    def _handle(self, number: int) -> None:
        if self._requested_at is None:
            self._requested_at = time.monotonic()
        elif time.monotonic() - self._requested_at > _SAME_REQUEST_SECONDS:
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)


def run_interruptible(
    function: Callable[Arguments, Result], *args: Arguments.args, **kwargs: Arguments.kwargs
) -> Result:
    """Calls a function in a new thread and waits for its result.

    Python runs signal handlers in the main thread, between two bytecodes. A compilation on that
    thread would therefore delay Ctrl-C until it ends.

    Raises:
      Interrupted: Ctrl-C came. The thread cannot be stopped: end the process with `leave`.
      BaseException: the function raised it.
    """
    with StopRequest(signal.SIGINT) as stop:
        future = in_daemon_thread(functools.partial(function, *args, **kwargs))
        if not stop.wait_for(future):
            raise Interrupted
    return future.result()


def in_daemon_thread(function: Callable[[], Result]) -> concurrent.futures.Future[Result]:
    """Calls a function in a thread for which the end of the process does not wait, unlike for the
    threads of an executor."""
    future: concurrent.futures.Future[Result] = concurrent.futures.Future()

    def run() -> None:
        try:
            future.set_result(function())
        except BaseException as error:  # noqa: BLE001
            future.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return future


def interruptible(command: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """A command that runs in its own thread, and that Ctrl-C ends at once with status 130."""

    @functools.wraps(command)
    def run(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        try:
            return run_interruptible(command, *args, **kwargs)
        except Interrupted:
            leave()

    return run


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
    # A progress bar of another thread hides it, and has replaced sys.stdout.
    if sys.__stdout__ is not None and sys.__stdout__.isatty():
        print(_SHOW_CURSOR, end="", file=sys.__stdout__, flush=True)
    os._exit(status)
