"""Ctrl-C, SIGTERM and SIGHUP as requests: a handler that raised an exception would lose it wherever
Python drops exceptions, such as in JAX's callback of the garbage collection."""

import concurrent.futures
import os
import signal
import sys
import threading
import time
import types
from collections.abc import Callable
from typing import Any, NoReturn, TypeVar

Result = TypeVar("Result")

_POLL_SECONDS = 0.1
# Launchers forward a Ctrl-C to a process that has already received it from the terminal.
_SAME_REQUEST_SECONDS = 0.5
# Windows has no SIGHUP.
_SIGNALS = [getattr(signal, n) for n in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, n)]


class Interrupted(KeyboardInterrupt):
    """A stop was requested."""


def end_on_ctrl_c() -> None:
    """Lets Ctrl-C end the process at once, by the signal's default action. Python would run its own
    handler only after the C++ function that it is in, such as a compilation, and a library may turn
    a KeyboardInterrupt into another exception."""
    # A shell script starts processes in the background with SIGINT ignored.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        _handle(signal.SIGINT, signal.SIG_DFL)


def _handle(number: int, handler: Any) -> Any:
    """Sets the handler of a signal, and returns the one before. The signal waits meanwhile: Python
    would drop one that it has seen and whose handler is then the default action."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        return signal.signal(number, handler)
    signal.pthread_sigmask(signal.SIG_BLOCK, [number])
    try:
        return signal.signal(number, handler)
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [number])


class StopRequest:
    """While entered in the main thread, the first signal only sets `requested`. A SIGINT or SIGTERM
    more than `_SAME_REQUEST_SECONDS` later does what it did before: as by the default action, which
    commands have (`end_on_ctrl_c`), it ends the process at once; a Python handler is called, of
    which Python's own, also that of a notebook, raises a KeyboardInterrupt, and the process ends
    where one returns. Any other signal after the first does nothing."""

    def __init__(self) -> None:
        self._requested_at: float | None = None
        self._previous = {}

    @property
    def requested(self) -> bool:
        """Whether a signal has come."""
        return self._requested_at is not None

    def __enter__(self) -> "StopRequest":
        # Only the main thread may install signal handlers.
        if threading.current_thread() is threading.main_thread():
            self._previous = {
                number: _handle(number, self._request)
                for number in _SIGNALS
                if signal.getsignal(number) is not signal.SIG_IGN
            }
        return self

    def __exit__(self, *_) -> None:
        for number, handler in self._previous.items():
            _handle(number, handler)

    def wait_for(self, future: concurrent.futures.Future) -> bool:
        """Waits until the future is done, and returns True; returns False as soon as a stop is
        requested."""
        while not self.requested:
            if concurrent.futures.wait([future], timeout=_POLL_SECONDS).done:
                return True
        return False

    def _request(self, number: int, frame: types.FrameType | None) -> None:
        if self._requested_at is None:
            self._requested_at = time.monotonic()
        # A terminal that goes away asks only once, but its shell and the kernel both say so.
        elif number in (signal.SIGINT, signal.SIGTERM):
            if time.monotonic() - self._requested_at > _SAME_REQUEST_SECONDS:
                if callable(previous := self._previous.get(number)):
                    previous(number, frame)
                os._exit(128 + number)


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


def leave(status: int = 130) -> NoReturn:
    """Ends the process at once, without waiting for its threads; the default status is that of
    Ctrl-C by the shells' convention.

    A normal exit of the interpreter would free memory that a compilation in another thread still
    uses.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
