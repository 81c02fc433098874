"""Who may open the live page, and what a client may send to it.

viser admits every client and stores every value that one sends. Without a guard, a page of any
website that is open in the user's browser could control the simulation, by a WebSocket of its own
or by a name that it lets point to this machine (DNS rebinding).
"""

import asyncio
import contextlib
import http
import ipaddress
import logging
import socket
import threading
from collections.abc import Callable, Collection, Iterator
from typing import Any
from urllib.parse import urlsplit

import msgspec
import numpy as np
import rich
import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from bounce_mjx.errors import UserError

# The longest message of a page, its camera, has 400 bytes.
_MAX_BYTES = 4096
_MAX_NUMBER = 1e6
# viser's `stop` waits up to 6 s for clients that do not answer, such as a page in a debugger.
_STOP_SECONDS = 1.0
_REFUSAL = (
    "the page was opened by another website, or under a name that it does not have; open the "
    "address that the command printed, or give the command the name with --allow-host (train: "
    "--watch-allow-host)\n"
)
_STARTING = threading.Lock()
_NO_LOGGER = logging.Logger(__name__, logging.CRITICAL + 1)


@contextlib.contextmanager
def open_server(host: str, port: int, allowed: Collection[str] = ()) -> Iterator[viser.ViserServer]:
    """A viser server that admits its own page only, and valid messages only. It prints nothing.

    Closing it takes at most a second: a background thread waits for clients that do not answer.

    Args:
      port: 0 takes any free port.
      allowed: names of hosts, in addition to the address, at which a browser may open the page.

    Raises:
      UserError: this version of viser cannot be guarded.
    """
    serve = websockets.asyncio.server.serve
    is_own = _make_rule(host, allowed)
    server_thread = None

    def guarded_serve(*args: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        nonlocal server_thread
        server_thread = threading.current_thread()
        # viser would print a traceback of each value that it cannot use.
        asyncio.get_running_loop().set_exception_handler(lambda loop, context: None)

        def answer(connection: ServerConnection, request: Request) -> Response | None:
            if is_own(request.headers):
                return process_request(connection, request)
            return connection.respond(http.HTTPStatus.FORBIDDEN, _REFUSAL)

        options |= {"create_connection": _Connection, "max_size": _MAX_BYTES, "logger": _NO_LOGGER}
        return serve(*args, process_request=answer, **options)

    # viser starts its websocket server in its constructor, and has no parameter for a guard.
    with _STARTING, _QUIET_CONSOLE:
        websockets.asyncio.server.serve = guarded_serve
        try:
            server = viser.ViserServer(host=host, port=port, verbose=False)
        finally:
            websockets.asyncio.server.serve = serve
    try:
        if server_thread is None:
            raise UserError(
                f"viser {viser.__version__} would admit every website to the page; install viser "
                "1.1"
            )
        yield server
    finally:
        stopping = threading.Thread(target=_stop, args=(server, server_thread), daemon=True)
        stopping.start()
        stopping.join(_STOP_SECONDS)


class _QuietConsole:
    """Silences rich's global console, on which viser prints; this package uses others. One server
    may start while another one still stops."""

    def __init__(self):
        self._lock = threading.Lock()
        self._users = 0

    def __enter__(self) -> None:
        self._change(1)

    def __exit__(self, *error: object) -> None:
        self._change(-1)

    def _change(self, users: int) -> None:
        with self._lock:
            self._users += users
            rich.get_console().quiet = self._users > 0


_QUIET_CONSOLE = _QuietConsole()


def _stop(server: viser.ViserServer, server_thread: threading.Thread | None) -> None:
    with _QUIET_CONSOLE:
        server.stop()
        if server_thread is not None:
            # Its last act is to print, after `stop` may have lost its patience.
            server_thread.join()


def _make_rule(host: str, allowed: Collection[str]) -> Callable[[Headers], bool]:
    """A function of a request's headers: whether it is from the page itself, or of no browser. It
    admits every program that reaches the port, as there is no login."""
    proxies = {name.lower() for name in allowed}
    names = proxies | {"localhost", host.lower(), socket.gethostname().lower()}

    def is_name(name: str) -> bool:
        """Whether the page may be opened at a name, or at any address: a website can let its own
        name point to this machine, but no address."""
        with contextlib.suppress(ValueError):
            ipaddress.ip_address(name)
            return True
        return name in names

    def is_own(headers: Headers) -> bool:
        hosts = headers.get_all("Host")
        if len(hosts) != 1 or not is_name(_host_name(f"//{hosts[0]}")):
            return False
        # A proxy may replace the name of the host.
        return all(
            origin.lower().partition("://")[2] == hosts[0].lower() or _host_name(origin) in proxies
            for origin in headers.get_all("Origin")
        )

    return is_own


class _Connection(ServerConnection):
    """A connection that drops messages that are not a page's."""

    async def recv(self, *args: Any, **options: Any) -> str | bytes:
        message = await super().recv(*args, **options)
        while not _is_valid(message):
            message = await super().recv(*args, **options)
        return message


def _is_valid(data: str | bytes) -> bool:
    """Whether a message is one that a page sends: its camera, a key, or a control's new value."""
    # Any bytes may come.
    with contextlib.suppress(Exception):
        match msgspec.msgpack.decode(data):
            case {"type": "ViewerCameraMessage", **numbers}:
                return bool(np.all(np.abs(np.hstack(list(numbers.values()))) <= _MAX_NUMBER))
            case {"type": "CommandTriggerMessage", "uuid": str(), **others}:
                return not others
            case {"type": "GuiUpdateMessage", "uuid": str(), "updates": {"value": value, **others}}:
                if isinstance(value, str):
                    is_allowed = not _is_number(value)
                else:
                    is_allowed = abs(value) <= _MAX_NUMBER
                return is_allowed and not others
    return False


def _is_number(text: str) -> bool:
    """Whether viser, which converts a text to a control's type, would read a number of any size or
    a NaN from it."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _host_name(url: str) -> str:
    """The host of a URL, without its port; empty for anything else."""
    with contextlib.suppress(ValueError):
        return urlsplit(url).hostname or ""
    return ""
