"""The viewers and recordings that `view` and `play` start."""

import contextlib
import string
from collections.abc import Callable, Sequence
from typing import NamedTuple

from rich.console import Console

from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.interrupt import Interrupted, StopRequest
from bounce_mjx.robot.model import fingerprint
from bounce_mjx.viewers.controllers import Controller
from bounce_mjx.viewers.files import check_writable
from bounce_mjx.viewers.native import check_display, has_display, run_native
from bounce_mjx.viewers.options import MAX_ENVS, ViewerOptions
from bounce_mjx.viewers.simulation import SideBySide, Simulation
from bounce_mjx.viewers.world import drawn_ranges, with_sliders
from bounce_mjx.world.config import WorldConfig

_RECORDED_SECONDS = 10.0


class Shown(NamedTuple):
    """An environment to show, and its controller."""

    config: WorldConfig
    make_controller: Callable[[Env], Controller]
    title: str


def show(
    shown: Sequence[Shown],
    options: ViewerOptions,
    *,
    commands: dict[str, float],
    console: Console,
) -> None:
    """Shows or records environments under their controllers; Ctrl-C closes a viewer.

    Args:
      shown: one, or several with the same robot side by side, on the page or in its recording. The
        labels of several are A, B, ...

    Raises:
      UserError: a file cannot be written, or the viewer does not work here, or it shows only one
        of several.
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
    # Policies side by side are compared in one world.
    is_drawn = all(one.config.randomization.terms for one in shown)
    if several:
        each = max(1, options.num_envs // len(shown))
        letters = string.ascii_uppercase[: len(shown)]
        names = [letter for letter in letters for _ in range(each)]
        titles = zip(letters, shown, strict=True)
        title = ", ".join(f"{letter}: {one.title}" for letter, one in titles)

    def simulate(one: Shown) -> Simulation:
        config, num_envs = one.config, each if several else options.num_envs
        env, ranges = Env(config), None
        if on_page:
            env, ranges = Env(with_sliders(config)), drawn_ranges(config)
            # The page's slider goes up to the simulated number. On a CPU, MJX is too slow for 16.
            if env.engine.name == "fused" and not several:
                num_envs = MAX_ENVS
        simulation = Simulation(env, one.make_controller(env), num_envs, options.seed, ranges)
        simulation.command = commands
        simulation.world = None if is_drawn else {}
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
    with contextlib.suppress(Interrupted), StopRequest() as stop:
        if viewer == "native":
            run_native(simulation, speed=options.speed, seconds=options.seconds, stop=stop)
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
                allowed=options.allow_host,
                stop=stop,
            )
