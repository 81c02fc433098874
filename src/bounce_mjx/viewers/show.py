"""The viewers and recordings that `view` and `play` start."""

import string
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from rich.console import Console
from rich.status import Status

from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.interrupt import StopRequest
from bounce_mjx.learning.policy import Policy
from bounce_mjx.robot.model import fingerprint
from bounce_mjx.runs.storage import check_output, write_output
from bounce_mjx.viewers.film import FilmPlayer
from bounce_mjx.viewers.native import has_display, show_window
from bounce_mjx.viewers.options import MAX_ENVS, Address, PageStart, ViewerOptions
from bounce_mjx.viewers.simulation import Controller, Simulation
from bounce_mjx.viewers.world import reset_ranges, with_sliders
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.model import world_model


class Shown(NamedTuple):
    """An environment to show, and its controller."""

    config: WorldConfig
    make_controller: Callable[[Env], Controller]
    title: str
    policy: Policy | None = None
    film: Callable[[], FilmPlayer] | None = None
    """Simulates an episode of an evaluation, which is shown in place of new ones. Called once, when
    the files and the port are checked."""


def show(
    shown: Sequence[Shown],
    options: ViewerOptions,
    *,
    goals: dict[str, float],
    console: Console,
) -> None:
    """Shows or records environments under their controllers; Ctrl-C closes a viewer.

    Args:
      shown: one, or several with the same task and robot side by side, on the page or in its
        recording. The labels of several are A, B, ...
      goals: values of the task's goals; the others are sampled.

    Raises:
      UserError: a file cannot be written, or the viewer does not work here, or it shows only one
        of several.
    """
    if len({one.config.task for one in shown}) > 1:
        raise UserError("the policies have different tasks; show one at a time")
    viewer = _viewer(options, several=len(shown) > 1)
    each = max(1, options.num_envs // len(shown))

    def simulate() -> Simulation:
        with console.status("compiling"):
            if shown[0].film is not None:
                return shown[0].film()
            return _simulate(shown, each, options.seed, goals, viewer == "browser")

    start = PageStart(shown[0].title, None, each)
    if len(shown) > 1:
        letters = string.ascii_uppercase[: len(shown)]
        titles = [f"{letter}: {one.title}" for letter, one in zip(letters, shown, strict=True)]
        names = [letter for letter in letters for _ in range(each)]
        start = PageStart(", ".join(titles), names, len(names))
    if viewer == "recording":
        _record(simulate, start, options, console)
    elif viewer == "browser":
        _serve(simulate, start, options, console)
    else:
        with StopRequest() as stop:
            show_window(simulate(), options.seconds, lambda: stop.requested)


def _viewer(options: ViewerOptions, several: bool) -> str:
    """browser, native or recording."""
    is_recorded = options.video is not None or options.html is not None
    if is_recorded and options.viewer != "auto":
        raise UserError(
            f"--viewer {options.viewer} and --video or --html cannot be combined; give only one"
        )
    if several and (options.viewer == "native" or options.video is not None):
        raise UserError("a window or a video shows one policy; show several with --viewer browser")
    if is_recorded:
        return "recording"
    if options.viewer == "browser" or several:
        return "browser"
    if has_display():
        return "native"
    if options.viewer == "native":
        raise UserError(
            "--viewer native needs a display that works (DISPLAY names it), and on a Mac mjpython; "
            "use --viewer browser"
        )
    return "browser"


def _record(
    simulate: Callable[[], Simulation], start: PageStart, options: ViewerOptions, console: Console
) -> None:
    """Writes the files; checks them before it simulates."""
    writer = None
    if options.video is not None:
        from bounce_mjx.viewers.video import SUFFIXES, VideoWriter

        check_output(options.video, "--video", SUFFIXES)
        writer = VideoWriter(options.video, options.size, options.fps, options.zoom)
    if options.html is not None:
        from bounce_mjx.viewers.page import SUFFIXES, replay

        check_output(options.html, "--html", SUFFIXES)

    simulation = simulate()
    with console.status("recording") as status:
        recording = simulation.record(options.seconds)
        if options.html is not None:
            page = replay(simulation.env, recording, options.fps, start.names)
            write_output(options.html, page)
        if writer is not None:
            writer.write(simulation.env, recording, partial(_tell_frames, console, status))
    for path in (options.video, options.html):
        if path is not None:
            console.out(f"written: {path}", highlight=False)


def _tell_frames(console: Console, status: Status, done: int, number: int) -> None:
    """Says how far a video is: on a terminal in the status line, elsewhere a line each tenth."""
    text = f"recording: {done:,} of {number:,} frames"
    status.update(text)
    ends_a_tenth = 10 * done // number > 10 * (done - 1) // number
    if ends_a_tenth and not console.is_terminal:
        console.out(text, highlight=False)


def _serve(
    simulate: Callable[[], Simulation], start: PageStart, options: ViewerOptions, console: Console
) -> None:
    """Serves the page; looks for a port before it simulates."""
    from bounce_mjx.viewers.browser import free_port, run_page
    from bounce_mjx.viewers.guard import open_server

    port = free_port(options.host, options.port)
    simulation = simulate()
    opening = open_server(options.host, port, options.allow_host)
    with StopRequest() as stop, opening as server:
        # Another program may have taken the port meanwhile; viser then takes the next one.
        address = Address(options.host, server.get_port())
        say = partial(console.out, f"viewer: {address.url}  (Ctrl-C ends it)", highlight=False)
        run_page(server, simulation, start, lambda: stop.requested, say, options.seconds)


def _robot(config: WorldConfig) -> bytes:
    """What tells the robots of two policies apart; their balls may be hollow or solid, and rub."""
    with_same_ball = config.model_copy(update={"ball_inertia": None, "friction": None})
    return fingerprint(world_model(with_same_ball, visual=False))


def _simulate(
    shown: Sequence[Shown], each: int, seed: int, goals: dict[str, float], has_sliders: bool
) -> Simulation:
    """Compiles the simulation.

    Args:
      each: number of robots of each controller.
      has_sliders: whether sliders change the world and the number of robots.
    """
    envs = [Env(with_sliders(one.config) if has_sliders else one.config) for one in shown]
    # One policy needs no comparison, which compiles its model again.
    if len(envs) > 1 and len({_robot(env.config) for env in envs}) > 1:
        raise UserError("the policies have different robots or time steps; show one at a time")
    num_envs = each
    # The page's slider goes up to the simulated number. On a CPU, MJX is too slow for 16.
    if has_sliders and len(shown) == 1 and envs[0].engine.name == "fused":
        num_envs = MAX_ENVS
    # Policies side by side are compared in the nominal world if the config of one samples none;
    # otherwise each samples its own.
    is_sampled = all(one.config.randomization.terms for one in shown)
    world = None if is_sampled else {}
    simulations = []
    for one, env in zip(shown, envs, strict=True):
        ranges = reset_ranges(one.config) if has_sliders else None
        controller = one.make_controller(env)
        simulation = Simulation(env, controller, num_envs, seed, ranges, one.policy)
        simulation.goal = goals
        simulation.world = world
        simulations.append(simulation)
    first, *others = simulations
    first.others = others
    return first
