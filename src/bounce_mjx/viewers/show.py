"""The viewing options that `view` and `play` share, and the viewers that they start."""

import contextlib
import string
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import Field
from rich.console import Console

from bounce_mjx.config.settings import Positive, StrictModel
from bounce_mjx.errors import UserError
from bounce_mjx.interrupt import run_interruptible
from bounce_mjx.robot.model import fingerprint
from bounce_mjx.task.config import EnvConfig
from bounce_mjx.task.env import BounceBall
from bounce_mjx.viewers.controllers import Controller
from bounce_mjx.viewers.files import check_writable
from bounce_mjx.viewers.native import check_display, has_display, run_native
from bounce_mjx.viewers.pace import SPEED_RANGE
from bounce_mjx.viewers.scene import MAX_ENVS
from bounce_mjx.viewers.simulation import SideBySide, Simulation
from bounce_mjx.viewers.world import drawn_ranges, with_sliders

_RECORDED_SECONDS = 10.0


class ViewerOptions(StrictModel):
    """Choice of a viewer or a recording."""

    viewer: Literal["auto", "browser", "native"] = "auto"
    """browser serves a page, native opens MuJoCo's own window, auto is native on a machine with a
    display and browser elsewhere."""
    video: Path | None = None
    """File for a video, .mp4 or .gif, instead of a viewer."""
    html: Path | None = None
    """File for a page that replays the episode offline, instead of a viewer."""
    seconds: Positive | None = None
    """Simulated time, s. The default is 10 for a recording; a viewer runs until it is closed."""
    num_envs: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 1
    """Robots side by side, on the live page and in the replay."""
    speed: Annotated[float, Field(ge=SPEED_RANGE[0], le=SPEED_RANGE[1])] = 1.0
    """Speed of a viewer, as a factor of real time."""
    fps: Annotated[int, Field(ge=1, le=240)] | None = None
    """Frames per second of a recording. The default is 60 for an MP4, 25 for a GIF and 30 for a
    page."""
    size: tuple[Annotated[int, Field(ge=64, le=4096)], Annotated[int, Field(ge=64, le=4096)]] = (
        640,
        480,
    )
    """Width and height of a video in pixels."""
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    """Seed of the resets."""
    host: str = "127.0.0.1"
    """Address of the page's server; 0.0.0.0 also admits other machines."""
    port: Annotated[int, Field(ge=1, lt=2**16)] = 8080
    """Port of the page's server, or the next free port."""


class Shown(NamedTuple):
    """An environment to show, and its controller."""

    config: EnvConfig
    make_controller: Callable[[BounceBall], Controller]
    title: str


def show(
    shown: Sequence[Shown],
    options: ViewerOptions,
    *,
    target_height: float | None,
    console: Console,
) -> None:
    """Shows or records environments under their controllers; Ctrl-C closes a viewer.

    Args:
      shown: one, or several with the same robot side by side, on the page or in its recording. The
        labels of several are A, B, ...

    Raises:
      UserError: a file cannot be written, or the viewer does not work here, or it shows only one
        of several.
      KeyboardInterrupt: Ctrl-C came during the compilation or the recording.
    """
    recorded = options.video is not None or options.html is not None
    if recorded and options.viewer != "auto":
        raise UserError(
            f"--viewer {options.viewer} and --video or --html exclude each other; give only one"
        )
    viewer, several = options.viewer, len(shown) > 1
    if several and (viewer == "native" or options.video is not None):
        raise UserError("a window or a video shows one policy; show several with --viewer browser")
    if viewer == "auto":
        viewer = "native" if not several and has_display() else "browser"
    film = None
    if options.video is not None:
        from bounce_mjx.viewers.video import SUFFIXES, VideoWriter

        check_writable(options.video, "--video", SUFFIXES)
        film = VideoWriter(options.video, options.size, options.fps)
    if options.html is not None:
        from bounce_mjx.viewers.page import SUFFIXES, write_page

        check_writable(options.html, "--html", SUFFIXES)
    if not recorded and viewer == "native":
        check_display()
    if not recorded and viewer == "browser":
        from bounce_mjx.viewers.browser import free_port, run_browser

        port = free_port(options.host, options.port)

    on_page = not recorded and viewer == "browser"
    title, names = shown[0].title, None
    if several:
        each = max(1, options.num_envs // len(shown))
        letters = string.ascii_uppercase[: len(shown)]
        names = [letter for letter in letters for _ in range(each)]
        titles = zip(letters, shown, strict=True)
        title = ", ".join(f"{letter}: {one.title}" for letter, one in titles)

    def simulate(one: Shown) -> Simulation:
        config, num_envs = one.config, each if several else options.num_envs
        env, ranges = BounceBall(config), None
        if on_page:
            env, ranges = BounceBall(with_sliders(config)), drawn_ranges(config)
            # The page's slider goes up to the simulated number. On a CPU, MJX is too slow for 16.
            if env.engine.name == "fused" and not several:
                num_envs = MAX_ENVS
        simulation = run_interruptible(
            Simulation, env, one.make_controller(env), num_envs, options.seed, ranges
        )
        simulation.target_height = target_height
        simulation.world = None if config.randomization.terms else {}
        return simulation

    with console.status("compiling"):
        simulations = [simulate(one) for one in shown]
    if len({fingerprint(one.env.mj_model) for one in simulations}) > 1:
        raise UserError("the policies have different robots or time steps; show one at a time")
    simulation = SideBySide(simulations) if several else simulations[0]

    if recorded:
        with console.status("recording"):
            recording = simulation.record(options.seconds or _RECORDED_SECONDS)
            if film is not None:
                film.write(simulation, recording)
            if options.html is not None:
                write_page(options.html, simulation, recording, options.fps, names)
        for path in (options.video, options.html):
            if path is not None:
                # rich would read brackets in a path as markup.
                console.print(f"written: {path}", markup=False, highlight=False, soft_wrap=True)
        return
    with contextlib.suppress(KeyboardInterrupt):
        if viewer == "native":
            run_native(simulation, speed=options.speed, seconds=options.seconds)
        else:
            run_browser(
                simulation,
                num_shown=simulation.num_envs if several else options.num_envs,
                speed=options.speed,
                seconds=options.seconds,
                host=options.host,
                port=port,
                title=title,
                console=console,
                names=names,
            )
