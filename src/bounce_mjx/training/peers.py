"""The connection between the processes of one training run, separate from JAX's own.

Process 0 holds a socket to every other process. Three things go over them: values that all
processes exchange, heartbeats, and the news that a process has died. JAX notices a death too, but
late and without the process's number, and then aborts with pages of C++ stack.
"""

import contextlib
import json
import queue
import secrets
import socket
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, NoReturn, TextIO

DEFAULT_TIMEOUT = 300
"""Time after which a silent process counts as dead, s."""

# Within this time, a process that fails on its own prints its own reason.
_GRACE_SECONDS = 1.0
_CONNECT_SECONDS = 30.0
# Exit status of a process that ends because another one died.
LOST_STATUS = 2


class Peers:
    """The other processes of a run; process 0 is connected to all, the others to process 0.

    While they are connected, the death of any process ends all the others, and each prints one
    sentence.
    """

    def __init__(
        self,
        index: int,
        count: int,
        timeout: float,
        advice: Callable[[], str],
        end_process: Callable[[int], NoReturn],
    ):
        """
        Args:
          index: number of this process, from 0.
          count: number of processes.
          timeout: seconds without a sign of life after which a process counts as dead.
          advice: the end of the message about a death, which says how to continue.
          end_process: ends this process with an exit status.
        """
        self._index, self._count, self._timeout = index, count, timeout
        self._advice, self._end_process = advice, end_process
        self._token = secrets.token_hex(16)
        self._sockets: dict[int, socket.socket] = {}
        self._lines: dict[int, TextIO] = {}
        self._names: dict[int, str] = {}
        self._received: dict[int, queue.Queue] = {}
        self._sending = threading.Lock()
        self._closed = threading.Event()
        self._leaving = threading.Lock()

    def listen(self) -> tuple[str, socket.socket]:
        """Opens the port of process 0.

        Returns:
          The port and a secret of this training in one word each, as `connect` takes them, and the
          server; connections without the secret are dropped.
        """
        if socket.has_dualstack_ipv6():
            server = socket.create_server(("", 0), family=socket.AF_INET6, dualstack_ipv6=True)
        else:
            server = socket.create_server(("", 0))
        return f"{server.getsockname()[1]} {self._token}", server

    def accept(self, server: socket.socket) -> None:
        """Waits in process 0 until every other process is connected.

        Raises:
          OSError: a process did not connect in time.
        """
        deadline = time.monotonic() + _CONNECT_SECONDS
        with server:
            while len(self._sockets) < self._count - 1:
                server.settimeout(max(0.01, deadline - time.monotonic()))
                connection, _ = server.accept()
                connection.settimeout(_CONNECT_SECONDS)
                lines = connection.makefile("r")
                try:
                    hello = json.loads(lines.readline(1000))
                    if not secrets.compare_digest(hello["token"], self._token):
                        raise ValueError
                    index, name = int(hello["index"]), str(hello["host"])
                except (OSError, ValueError, KeyError, TypeError):
                    lines.close()
                    connection.close()
                    continue
                self._sockets[index], self._names[index] = connection, name
                # The reader is kept because it may have read beyond the first line.
                self._lines[index] = lines
        self._start()

    def connect(self, host: str, address: str) -> None:
        """Connects this process to process 0.

        Args:
          address: from `listen` in process 0.

        Raises:
          OSError: process 0 cannot be reached.
        """
        port, token = address.split()
        connection = socket.create_connection((host, int(port)), _CONNECT_SECONDS)
        self._sockets[0], self._names[0] = connection, host
        self._lines[0] = connection.makefile("r")
        hello = {"token": token, "index": self._index, "host": socket.gethostname()}
        self._send(0, hello)
        self._start()

    def exchange(self, value: Any) -> list[Any]:
        """The values of all processes, by number; every process must call this at the same point.

        Args:
          value: plain data.
        """
        if self._index == 0:
            values = [value, *(self._received[i].get() for i in range(1, self._count))]
            for i in self._sockets:
                self._send(i, {"value": values})
            return values
        self._send(0, {"value": value})
        return self._received[0].get()

    def close(self) -> None:
        """Says goodbye: from now on the others may end at any time."""
        for i in self._sockets:
            self._send(i, {"bye": True})
        self._closed.set()

    def _leave(self, lost: int) -> NoReturn:
        """Ends this process with a message, because another one died."""
        with self._leaving:
            for i in self._sockets.keys() - {lost}:
                self._send(i, {"lost": lost})
            time.sleep(_GRACE_SECONDS)
            place = f" (on {self._names[lost]})" if lost in self._names else ""
            print(
                f"error: process {lost}{place} of this training has ended or no longer answers; "
                f"see its output, then {self._advice()}",
                file=sys.stderr,
                flush=True,
            )
            self._end_process(LOST_STATUS)

    def _start(self) -> None:
        for i, connection in self._sockets.items():
            connection.settimeout(self._timeout)
            self._received[i] = queue.Queue()
            threading.Thread(target=self._receive, args=(i,), daemon=True).start()
        threading.Thread(target=self._beat, daemon=True).start()

    def _beat(self) -> None:
        while not self._closed.wait(self._timeout / 4):
            for i in self._sockets:
                self._send(i, {})

    def _send(self, index: int, message: dict[str, Any]) -> None:
        # The receiving thread handles a broken connection.
        with self._sending, contextlib.suppress(OSError):
            self._sockets[index].sendall((json.dumps(message) + "\n").encode())

    def _receive(self, index: int) -> None:
        lost = index
        with contextlib.suppress(OSError, ValueError):
            for line in self._lines[index]:
                message = json.loads(line)
                if "value" in message:
                    self._received[index].put(message["value"])
                elif "bye" in message:
                    return
                elif "lost" in message:
                    lost = message["lost"]
                    break
        if not self._closed.is_set():
            self._leave(lost)
