"""What `view` and `play` let a user choose, and how a page starts."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from bounce_mjx.config.command_line import Flag
from bounce_mjx.config.settings import Positive, StrictModel

MAX_ENVS = 16
"""Largest number of robots side by side."""


class ViewerOptions(StrictModel):
    """Choice of a viewer or a recording."""

    viewer: Literal["auto", "browser", "native"] = "auto"
    """browser serves a page, native opens MuJoCo's own window, auto is native on a machine with a
    display and browser elsewhere."""
    video: Annotated[Path | None, Flag(instead_of=("--out",))] = None
    """File for a video, .mp4, .webp or .gif, instead of a viewer."""
    html: Path | None = None
    """File for a page that replays the episode offline, instead of a viewer."""
    seconds: Positive | None = None
    """Simulated time, s. The default is 10 for a recording, and with --episode the whole episode; a
    viewer runs until it is closed."""
    num_envs: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 1
    """Robots side by side, on the live page and in the replay."""
    fps: Annotated[int, Field(ge=1, le=240)] | None = None
    """Frames per second of a recording. The default is 60 for an MP4, 25 for a WebP or a GIF,
    and 30 for a page."""
    size: tuple[Annotated[int, Field(ge=64, le=4096)], Annotated[int, Field(ge=64, le=4096)]] = (
        640,
        480,
    )
    """Width and height of a video in pixels."""
    zoom: Annotated[float, Field(ge=1.0, le=10.0)] = 1.0
    """How much larger a video shows the paddle and its ball; 1 shows the whole arm."""
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    """Seed of the resets; with --episode, that of the evaluation."""
    host: str = "127.0.0.1"
    """Address of the page's server; 0.0.0.0 also admits other machines."""
    allow_host: tuple[str, ...] = ()
    """Other names under which a browser may open the page, such as a proxy's."""
    port: Annotated[int, Field(ge=1, lt=2**16)] = 8080
    """Port of the page's server, or the next free port."""


class PageStart(NamedTuple):
    """What a page shows at first."""

    title: str
    names: Sequence[str] | None = None
    """A name of each environment for its label; by default their numbers."""
    num_shown: int = 1
    """Number of environments in the scene; the page's slider goes up to all of the simulation."""


class Address(NamedTuple):
    """Where a page is served."""

    host: str
    port: int
    allowed: Collection[str] = ()
    """Other names under which a browser may open the page."""

    @property
    def url(self) -> str:
        """Address of the page for a browser."""
        return f"http://{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}"
