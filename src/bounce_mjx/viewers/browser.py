"""The live page: viser serves the scene, the controls and the plots to any browser."""

import collections
import html
import socket
import time
from collections.abc import Mapping

import numpy as np
import viser
import viser.uplot
from rich.console import Console

from bounce_mjx.errors import UserError
from bounce_mjx.task.rewards import TERM_NAMES
from bounce_mjx.viewers.controls import Controls
from bounce_mjx.viewers.pace import Pace
from bounce_mjx.viewers.page import open_server
from bounce_mjx.viewers.scene import Scene
from bounce_mjx.viewers.simulation import Frame, Simulation

# Pictures and plots per second.
_PICTURE_RATE = 50.0
_PLOT_RATE = 8.0
_PLOT_SECONDS = 4.0


def run_browser(
    simulation: Simulation,
    *,
    num_shown: int,
    speed: float,
    seconds: float | None,
    host: str,
    port: int,
    title: str,
    console: Console,
) -> None:
    """Serves the page until the simulated `seconds` are over (None: until Ctrl-C).

    Args:
      num_shown: environments shown at first; the page's slider goes up to all of the simulation.
      port: a free port of this machine.
    """
    with open_server(host, port) as server:
        page = _Page(server, simulation, num_shown=num_shown, speed=speed, title=title)
        address = f"[{host}]" if ":" in host else host
        # A host name may look like rich's markup.
        console.print(
            f"viewer: http://{address}:{server.get_port()}  (Ctrl-C ends it)",
            markup=False,
            highlight=False,
            soft_wrap=True,
        )
        page.run(seconds)


class _Page:
    """A simulation in real time on a server."""

    def __init__(
        self,
        server: viser.ViserServer,
        simulation: Simulation,
        *,
        num_shown: int,
        speed: float,
        title: str,
    ):
        self._server = server
        self._simulation = simulation
        gui = server.gui
        gui.configure_theme(
            show_logo=False, show_share_button=False, control_width="medium",
            brand_color=(230, 95, 20),
        )  # fmt: skip
        gui.set_panel_label("bounce_mjx")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(280)
        self._controls = Controls(server, simulation, title=title, speed=speed, num_shown=num_shown)
        self._settings = self._controls.read()
        self._scene = Scene(server, simulation.env, num_shown)
        self._history: collections.deque[Frame] = collections.deque(
            maxlen=round(_PLOT_SECONDS / simulation.env.dt)
        )
        self._add_plots()

    def run(self, seconds: float | None) -> None:
        """Steps the simulation and sends pictures and plots."""
        simulation = self._simulation
        pace = Pace(simulation.env.dt)
        self._scene.update([simulation.frame])
        steps_left = float("inf") if seconds is None else round(seconds / simulation.env.dt)
        next_plot = 0.0
        while steps_left > 0:
            changed = self._obey_controls()
            due = 0 if self._settings.paused else pace.due(self._settings.speed)
            due = min(due, steps_left)
            frames = [simulation.step() for _ in range(due)]
            steps_left -= due
            self._history.extend(frames)
            if frames or changed:
                self._scene.update(frames or [simulation.frame])
                if time.monotonic() >= next_plot:
                    self._update_plots()
                    next_plot = time.monotonic() + 1.0 / _PLOT_RATE
            time.sleep(1.0 / _PICTURE_RATE)
            if self._settings.paused:
                pace.forget()
        self._server.flush()

    def _obey_controls(self) -> bool:
        """Applies the controls' settings and requests; returns whether anything changed."""
        before, now = self._settings, self._controls.read()
        self._settings = now
        if now.target_height != before.target_height:
            self._simulation.target_height = now.target_height
        if now.num_shown != before.num_shown:
            self._scene.show(now.num_shown)
        reset, push = self._controls.take_reset(), self._controls.take_push()
        if reset:
            self._simulation.reset()
            self._history.clear()
        if push is not None:
            self._simulation.push(push)
        return now != before or reset or push is not None

    def _add_plots(self) -> None:
        gui = self._server.gui
        axis = {"stroke": "#444", "grid": {"stroke": "#e3e6ea"}}
        panel = gui.add_panel()
        panel.dock_left()
        panel.set_width(300)
        with panel.add_tab("robot 1", viser.Icon.CHART_LINE):
            gui.add_markdown("height, m, over the last seconds")
            self._heights = gui.add_uplot(
                (np.zeros(1), np.zeros(1), np.zeros(1), np.zeros(1)),
                (
                    {"label": "s"},
                    {"label": "ball", "stroke": "#e8590c", "width": 2},
                    {"label": "target", "stroke": "#2b8a3e", "width": 2, "dash": [6, 4]},
                    {"label": "paddle", "stroke": "#1c7ed6", "width": 2},
                ),
                axes=({**axis, "size": 30}, {**axis, "size": 40}),
                scales={"x": {"time": False}, "y": {"range": (0.0, 1.05)}},
                legend={"live": False},
                height=190,
            )
            gui.add_markdown("reward, by term")
            self._terms = gui.add_html(reward_bars(dict.fromkeys(TERM_NAMES, 0.0)))

    def _update_plots(self) -> None:
        if not self._history:
            return
        heights = np.array(
            [(f.ball[0, 2], f.target_height[0], f.paddle[0, 2]) for f in self._history]
        )
        dt = self._simulation.env.dt
        times = np.arange(1 - len(heights), 1) * dt
        self._heights.data = (times, *heights.T)
        recent = list(self._history)[-round(1.0 / _PLOT_RATE / dt) :]
        terms = np.mean([frame.reward_terms[0] for frame in recent], axis=0)
        self._terms.content = reward_bars(dict(zip(TERM_NAMES, terms, strict=True)))


def reward_bars(terms: Mapping[str, float]) -> str:
    """A bar chart of the weighted reward terms as HTML, and their sum."""
    longest = max(5.0, *map(abs, terms.values()))
    lines = []
    for name, value in terms.items():
        share = value / longest
        left = 50.0 + 50.0 * min(share, 0.0)
        color = "#2b8a3e" if value >= 0.0 else "#c92a2a"
        lines.append(
            f'<div style="display:flex;align-items:center;height:15px">'
            f'<span style="width:44%">{html.escape(name.replace("_", " "))}</span>'
            f'<span style="width:16%;text-align:right;padding-right:6px">{_rounded(value)}</span>'
            f'<span style="width:40%;height:9px;position:relative;background:#eef0f3">'
            f'<span style="position:absolute;height:9px;left:{left:.1f}%;'
            f'width:{50.0 * abs(share):.1f}%;background:{color}"></span></span></div>'
        )
    total = _rounded(sum(terms.values()))
    return (
        f'<div style="font:11px sans-serif;padding:0 12px 8px 12px">{"".join(lines)}'
        f'<div style="padding-top:4px"><b>sum {total}</b> a step</div></div>'
    )


def _rounded(value: float) -> str:
    """Two decimals, without the sign of a negative zero."""
    return f"{round(value, 2) + 0.0:.2f}"


def free_port(host: str, port: int) -> int:
    """The first free port of 100, from `port` on.

    Raises:
      UserError: the host is not an address of this machine, or none of the ports is free.
    """
    reason = "no port is free"
    for candidate in range(port, min(port + 100, 2**16)):
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(
                host, candidate, type=socket.SOCK_STREAM
            )[0]
            with socket.socket(family, kind, protocol) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
            return candidate
        except OSError as error:
            reason = error.strerror
    raise UserError(
        f"the page cannot be served at --host {host} --port {port} ({reason}); give an address of "
        "this machine, such as 127.0.0.1, and a free port"
    )
