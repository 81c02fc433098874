"""Ctrl-C and SIGTERM as a request to stop, which the training follows at its next safe point."""

import concurrent.futures
import os
import signal
import threading
import time

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
# Launchers forward a Ctrl-C to a process that has already received it from the terminal.
_SAME_REQUEST_SECONDS = 0.5


class StopRequest:
    """While entered, the first SIGINT or SIGTERM only sets `requested`; the next one ends the
    process at once."""

    def __init__(self):
        self._requested_at: float | None = None
        self._previous = {}

    @property
    def requested(self) -> bool:
        """Whether a signal has come."""
        return self._requested_at is not None

    def __enter__(self) -> "StopRequest":
        # Only the main thread may install signal handlers.
        if threading.current_thread() is threading.main_thread():
            self._previous = {number: signal.signal(number, self._handle) for number in _SIGNALS}
        return self

    def __exit__(self, *_) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def wait_for(self, future: concurrent.futures.Future) -> bool:
        """Waits until the future is done, and returns True; returns False as soon as a stop is
        requested."""
        while not self.requested:
            if concurrent.futures.wait([future], timeout=0.1).done:
                return True
        return False

    def _handle(self, number: int, _) -> None:
        if self._requested_at is None:
            self._requested_at = time.monotonic()
        elif time.monotonic() - self._requested_at > _SAME_REQUEST_SECONDS:
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
