"""Who may open the live page, and what a client may send to it.

viser admits every client and stores every value that one sends. Without a guard, a page of any
website that is open in the user's browser could control the simulation, by a WebSocket of its own
or by a name that it lets point to this machine (DNS rebinding).
"""

import asyncio
import contextlib
import functools
import http
import ipaddress
import logging
import socket
import threading
from collections.abc import Callable, Collection, Iterator
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

import msgspec
import pydantic
import rich
import viser
import websockets.asyncio.server
from pydantic import Field
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from bounce_mjx.config.settings import StrictModel
from bounce_mjx.errors import UserError

_LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")
_ALL_ADDRESSES = ("0.0.0.0", "::", "")
# The longest message of a page, its camera, has 400 bytes.
_MAX_BYTES = 4096
_ROUNDING = 1e-6
# viser's `stop` waits up to 6 s for clients that do not answer, such as a page in a debugger.
_STOP_SECONDS = 1.0
_REFUSAL = (
    "the page was opened by another website, or under a name that it does not have; open the "
    "address that the command printed, or give the command the name with --allow-host (train: "
    "--watch-allow-host)\n"
)
_STARTING = threading.Lock()

_Number = Annotated[float, Field(strict=True, ge=-1e6, le=1e6)]
_PositiveNumber = Annotated[_Number, Field(gt=0.0)]
_Vector = tuple[_Number, _Number, _Number]


class _Camera(StrictModel):
    type: Literal["ViewerCameraMessage"]
    wxyz: tuple[_Number, _Number, _Number, _Number]
    position: _Vector
    look_at: _Vector
    up_direction: _Vector
    fov: _PositiveNumber
    near: _PositiveNumber
    far: _PositiveNumber
    image_height: _PositiveNumber
    image_width: _PositiveNumber


class _Key(StrictModel):
    type: Literal["CommandTriggerMessage"]
    uuid: str


class _Update(StrictModel):
    type: Literal["GuiUpdateMessage"]
    uuid: str
    updates: Annotated[dict[Literal["value"], Any], Field(min_length=1)]


_MESSAGES = pydantic.TypeAdapter(Annotated[_Camera | _Key | _Update, Field(discriminator="type")])


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
    guard = _Guard(host, allowed)
    # viser prints with rich's global console, from several threads; this package uses others.
    rich.get_console().quiet = True
    # viser has no parameter for any of this. It starts its websocket server in its constructor.
    with _STARTING:
        serve = websockets.asyncio.server.serve
        websockets.asyncio.server.serve = functools.partial(guard.serve, serve)
        try:
            guard.server = viser.ViserServer(host=host, port=port, verbose=False)
        finally:
            websockets.asyncio.server.serve = serve
    try:
        if not guard.is_serving:
            raise UserError(
                f"viser {viser.__version__} would admit every website to the page; install viser "
                "1.1"
            )
        yield guard.server
    finally:
        stopping = threading.Thread(target=guard.server.stop, daemon=True)
        stopping.start()
        stopping.join(_STOP_SECONDS)


class _Guard:
    def __init__(self, host: str, allowed: Collection[str]):
        self.server: viser.ViserServer | None = None
        self.is_serving = False
        self._allowed = {name.lower() for name in allowed}
        self._names = self._allowed | {*_LOCAL_NAMES, host.lower()}
        self._is_everywhere = host in _ALL_ADDRESSES
        if self._is_everywhere:
            self._names.add(socket.gethostname().lower())

    def serve(self, serve: Callable[..., Any], *args: Any, **options: Any) -> Any:
        """`websockets.asyncio.server.serve` with the guard."""
        self.is_serving = True
        asyncio.get_running_loop().set_exception_handler(lambda loop, context: None)
        return serve(
            *args,
            **options
            | {
                "process_request": functools.partial(self._refusal, options["process_request"]),
                # viser prints a line for a client of another version.
                "subprotocols": [f"viser-v{viser.__version__}"],
                "select_subprotocol": None,
                "create_connection": functools.partial(_Connection, self),
                "max_size": _MAX_BYTES,
                "logger": logging.Logger(__name__, logging.CRITICAL + 1),
            },
        )

    def _refusal(
        self, process_request: Callable[..., Any], connection: ServerConnection, request: Request
    ) -> Response | None:
        """The answer to a request from elsewhere; viser's own answer to any other one."""
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        if (
            len(hosts) == 1
            and self._is_name(_host_name(f"//{hosts[0]}"))
            and all(self._is_own(origin, hosts[0]) for origin in origins)
        ):
            return process_request(connection, request)
        return connection.respond(http.HTTPStatus.FORBIDDEN, _REFUSAL)

    def _is_name(self, name: str) -> bool:
        """Whether the page may be opened at a name. No website can let an address point here."""
        if self._is_everywhere and name not in self._names:
            with contextlib.suppress(ValueError):
                return bool(ipaddress.ip_address(name))
        return name in self._names

    def _is_own(self, origin: str, host: str) -> bool:
        """Whether a page of an origin may connect to a host: the page from there, and one through a
        proxy that replaces the name."""
        own = origin.lower().partition("://")[2] == host.lower()
        return own or _host_name(origin) in self._allowed

    def accepts(self, data: str | bytes) -> bool:
        """Whether a client's message is valid."""
        try:
            message = _MESSAGES.validate_python(msgspec.msgpack.decode(data))
        # Any bytes may come.
        except Exception:
            return False
        return not isinstance(message, _Update) or self._fits(message)

    def _fits(self, update: _Update) -> bool:
        """Whether a control offers the new value."""
        gui, value = getattr(self.server, "gui", None), update.updates["value"]
        handle = gui and gui._gui_input_handle_from_uuid.get(update.uuid)
        if handle is None or handle.disabled:
            return False
        if isinstance(handle, viser.GuiSliderHandle):
            # A page sends whole numbers as such, and rounds the others.
            is_number = type(value) in (int, type(handle.value))
            return is_number and handle.min - _ROUNDING <= value <= handle.max + _ROUNDING
        if isinstance(handle, viser.GuiButtonGroupHandle):
            return value in handle.options
        return isinstance(value, bool)


class _Connection(ServerConnection):
    """A connection that drops invalid messages."""

    def __init__(self, guard: _Guard, *args: Any, **options: Any):
        super().__init__(*args, **options)
        self._guard = guard

    async def recv(self, *args: Any, **options: Any) -> str | bytes:
        message = await super().recv(*args, **options)
        while not self._guard.accepts(message):
            message = await super().recv(*args, **options)
        return message


def _host_name(url: str) -> str:
    """The host of a URL, without its port; empty for anything else."""
    with contextlib.suppress(ValueError):
        return urlsplit(url).hostname or ""
    return ""
