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
from unittest.mock import patch
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

    Args:
      port: 0 takes any free port.
      allowed: names of hosts, in addition to the address, at which a browser may open the page.

    Raises:
      UserError: this version of viser cannot be guarded.
    """
    serve, guarded = websockets.asyncio.server.serve, []

    def guarded_serve(*args: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        guarded.append(True)
        asyncio.get_running_loop().set_exception_handler(lambda loop, context: None)

        def answer(connection: ServerConnection, request: Request) -> Response | None:
            if _is_own(request.headers, host, allowed):
                return process_request(connection, request)
            return connection.respond(http.HTTPStatus.FORBIDDEN, _REFUSAL)

        options |= {"create_connection": _Connection, "max_size": _MAX_BYTES, "logger": _NO_LOGGER}
        return serve(*args, process_request=answer, **options)

    # viser starts its websocket server in its constructor, and has no parameter for a guard.
    replaced = patch.object(websockets.asyncio.server, "serve", guarded_serve)
    with _STARTING, _quiet_console(), replaced:
        server = viser.ViserServer(host=host, port=port, verbose=False)
    try:
        if not guarded:
            raise UserError(
                f"viser {viser.__version__} would admit every website to the page; install viser "
                "1.1"
            )
        yield server
    finally:
        with _quiet_console():
            server.stop()


def _quiet_console() -> contextlib.AbstractContextManager:
    """Silences rich's global console, on which viser prints; this package uses others."""
    return patch.object(rich.get_console(), "quiet", True)


def _is_own(headers: Headers, host: str, allowed: Collection[str]) -> bool:
    """Whether a request is from the page itself, or of no browser.

    No website can let an address (a number) point here; and a proxy may replace the name of the
    host.
    """
    proxies = {name.lower() for name in allowed}
    own = proxies | {"localhost", host.lower(), socket.gethostname().lower()}
    hosts = headers.get_all("Host")
    name = _host_name(f"//{hosts[0]}") if len(hosts) == 1 else ""
    return (name in own or _is_address(name)) and all(
        origin.lower().partition("://")[2] == hosts[0].lower() or _host_name(origin) in proxies
        for origin in headers.get_all("Origin")
    )


def _is_address(name: str) -> bool:
    with contextlib.suppress(ValueError):
        return bool(ipaddress.ip_address(name))
    return False


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
                # viser would read a number from a text.
                is_word = isinstance(value, str) and value.replace(" ", "").isalpha()
                return not others and (is_word or abs(value) <= _MAX_NUMBER)
    return False


def _host_name(url: str) -> str:
    """The host of a URL, without its port; empty for anything else."""
    with contextlib.suppress(ValueError):
        return urlsplit(url).hostname or ""
    return ""
