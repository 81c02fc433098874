"""The viewers and recordings that `view` and `play` start."""

import contextlib
from collections.abc import Callable

from rich.console import Console

from bounce_mjx.errors import UserError
from bounce_mjx.interrupt import run_interruptible
from bounce_mjx.task.config import EnvConfig
from bounce_mjx.task.env import BounceBall
from bounce_mjx.viewers.controllers import Controller
from bounce_mjx.viewers.files import check_writable
from bounce_mjx.viewers.native import check_display, has_display, run_native
from bounce_mjx.viewers.options import MAX_ENVS, ViewerOptions
from bounce_mjx.viewers.simulation import Simulation
from bounce_mjx.viewers.world import drawn_ranges, with_sliders

_RECORDED_SECONDS = 10.0


def show(
    config: EnvConfig,
    make_controller: Callable[[BounceBall], Controller],
    options: ViewerOptions,
    *,
    title: str,
    target_height: float | None,
    console: Console,
) -> None:
    """Shows or records an environment under a controller; Ctrl-C closes a viewer.

    Raises:
      UserError: a file cannot be written, or the viewer does not work here.
      KeyboardInterrupt: Ctrl-C came during the compilation or the recording.
    """
    recorded = options.video is not None or options.html is not None
    if recorded and options.viewer != "auto":
        raise UserError(
            f"--viewer {options.viewer} and --video or --html exclude each other; give only one"
        )
    viewer = options.viewer
    if viewer == "auto":
        viewer = "native" if has_display() else "browser"
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

    env, num_envs, ranges = BounceBall(config), options.num_envs, None
    if not recorded and viewer == "browser":
        env, ranges = BounceBall(with_sliders(config)), drawn_ranges(config)
        # The page's slider goes up to the simulated number. On a CPU, MJX is too slow for 16.
        if env.engine.name == "fused":
            num_envs = MAX_ENVS
    with console.status("compiling"):
        simulation = run_interruptible(
            Simulation, env, make_controller(env), num_envs, options.seed, ranges
        )
        simulation.target_height = target_height
        simulation.world = None if config.randomization.terms else {}

    if recorded:
        with console.status("recording"):
            recording = simulation.record(options.seconds or _RECORDED_SECONDS)
            if film is not None:
                film.write(simulation, recording)
            if options.html is not None:
                write_page(options.html, simulation, recording, options.fps)
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
                num_shown=options.num_envs,
                speed=options.speed,
                seconds=options.seconds,
                host=options.host,
                port=port,
                title=title,
                console=console,
            )
