"""The live page: the scene, controls and plots, served by viser to any browser."""

import collections
import html
import queue
import socket
import time

import numpy as np
import viser
import viser.uplot
from rich.console import Console

from bounce_mjx.errors import UserError
from bounce_mjx.task.rewards import TERM_NAMES
from bounce_mjx.viewers.pace import Pace
from bounce_mjx.viewers.page import open_server
from bounce_mjx.viewers.scene import Scene
from bounce_mjx.viewers.simulation import Frame, Simulation

# Pictures and plots a second.
_PICTURE_RATE = 50.0
_PLOT_RATE = 8.0
_PLOT_SECONDS = 4.0
_PUSHES = {
    "up": (0, 0, 1),
    "away": (1, 0, 0),
    "back": (-1, 0, 0),
    "left": (0, 1, 0),
    "right": (0, -1, 0),
}


def run_browser(
    simulation: Simulation,
    *,
    shown: int,
    speed: float,
    seconds: float | None,
    host: str,
    port: int,
    title: str,
    console: Console,
) -> None:
    """Serves the page until the simulated `seconds` are over (None: until Ctrl-C).

    Args:
      shown: environments shown at first; the page's slider goes up to all of the simulation.
      port: a free one.
    """
    with open_server(host, port) as server:
        _Page(server, simulation, shown, speed, title).run(seconds, console)


class _Page:
    def __init__(
        self,
        server: viser.ViserServer,
        simulation: Simulation,
        shown: int,
        speed: float,
        title: str,
    ):
        self._server = server
        self._simulation = simulation
        self._pace = Pace(simulation.env.dt)
        self._scene = Scene(server, simulation.env, shown)
        self._shown = shown
        # The page's callbacks run in threads; what they ask for is done between two steps.
        self._wishes: queue.SimpleQueue = queue.SimpleQueue()
        self._history: collections.deque[Frame] = collections.deque(
            maxlen=round(_PLOT_SECONDS / simulation.env.dt)
        )
        self._add_controls(speed, shown, title)
        self._add_plots()

    def run(self, seconds: float | None, console: Console) -> None:
        """Steps in real time, and sends pictures and plots."""
        server, simulation = self._server, self._simulation
        console.print(
            f"viewer: http://{server.get_host()}:{server.get_port()}  (Ctrl-C ends it)",
            highlight=False,
            soft_wrap=True,
        )
        self._scene.update([simulation.frame])
        left = float("inf") if seconds is None else round(seconds / simulation.env.dt)
        next_plot = 0.0
        while left > 0:
            changed = self._grant_wishes()
            due = 0 if self._paused.value else self._pace.due(self._speed.value)
            due = min(due, left)
            frames = [simulation.step() for _ in range(due)]
            left -= due
            self._history.extend(frames)
            if frames or changed:
                self._scene.update(frames or [simulation.frame])
            if time.monotonic() >= next_plot and (frames or changed):
                self._update_plots()
                next_plot = time.monotonic() + 1.0 / _PLOT_RATE
            time.sleep(1.0 / _PICTURE_RATE)
            if self._paused.value:
                self._pace.forget()
        server.flush()

    def _add_controls(self, speed: float, shown: int, title: str) -> None:
        gui, simulation = self._server.gui, self._simulation
        gui.configure_theme(
            show_logo=False, show_share_button=False, control_width="medium",
            brand_color=(230, 95, 20),
        )  # fmt: skip
        gui.set_panel_label("bounce_mjx")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(280)
        gui.add_markdown(f"**{title}**")
        self._paused = gui.add_checkbox("pause", False)
        self._speed = gui.add_slider("speed", 0.1, 2.0, 0.1, float(np.clip(speed, 0.1, 2.0)))
        number = gui.add_slider(
            "robots", 1, max(2, simulation.num_envs), 1, shown, disabled=simulation.num_envs == 1
        )
        reset = gui.add_button("reset", icon=viser.Icon.REFRESH)
        low, high = simulation.env.config.target_height_range
        with gui.add_folder("target height"):
            drawn = gui.add_checkbox("drawn at each reset", simulation.target_height is None)
            height = gui.add_slider(
                "height, m", min(0.3, low), max(0.8, high), 0.01,
                float(np.round(simulation.target_height or 0.5 * (low + high), 2)),
            )  # fmt: skip
        with gui.add_folder("push the ball"):
            strength = gui.add_slider("speed, m/s", 0.05, 1.0, 0.05, 0.2)
            push = gui.add_button_group("towards", tuple(_PUSHES))

        @reset.on_click
        def _(_) -> None:
            self._wish(self._reset)

        @number.on_update
        def _(_) -> None:
            self._wish(lambda: self._show(number.value))

        @drawn.on_update
        def _(_) -> None:
            self._wish(lambda: self._aim(None if drawn.value else height.value))

        @height.on_update
        def _(_) -> None:
            drawn.value = False
            self._wish(lambda: self._aim(height.value))

        @push.on_click
        def _(_) -> None:
            velocity = strength.value * np.array(_PUSHES[push.value])
            self._wish(lambda: simulation.push(velocity))

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
            self._terms = gui.add_html(reward_bars(np.zeros(len(TERM_NAMES))))

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
        self._terms.content = reward_bars(np.mean([f.reward_terms[0] for f in recent], axis=0))

    def _wish(self, action) -> None:
        self._wishes.put(action)

    def _grant_wishes(self) -> bool:
        """Does what the page asked for; whether it asked for anything."""
        asked = False
        while not self._wishes.empty():
            self._wishes.get()()
            asked = True
        return asked

    def _reset(self) -> None:
        self._simulation.reset()
        self._history.clear()

    def _show(self, number: int) -> None:
        if number != self._shown:
            self._shown = number
            self._scene.show(number)

    def _aim(self, height: float | None) -> None:
        self._simulation.target_height = height


def reward_bars(terms: np.ndarray) -> str:
    """A bar chart of the weighted reward terms, in the order of `TERM_NAMES`, and of their sum, as
    HTML."""
    rows = [
        (name.replace("_", " "), value, value / max(5.0, np.abs(terms).max()))
        for name, value in zip(TERM_NAMES, np.round(terms, 2) + 0.0, strict=True)
    ]
    lines = []
    for name, value, share in rows:
        left = 50.0 + 50.0 * min(share, 0.0)
        color = "#2b8a3e" if value >= 0.0 else "#c92a2a"
        lines.append(
            f'<div style="display:flex;align-items:center;height:15px">'
            f'<span style="width:44%">{html.escape(name)}</span>'
            f'<span style="width:16%;text-align:right;padding-right:6px">{value:.2f}</span>'
            f'<span style="width:40%;height:9px;position:relative;background:#eef0f3">'
            f'<span style="position:absolute;height:9px;left:{left:.1f}%;'
            f'width:{50.0 * abs(share):.1f}%;background:{color}"></span></span></div>'
        )
    return (
        f'<div style="font:11px sans-serif;padding:0 12px 8px 12px">{"".join(lines)}'
        f'<div style="padding-top:4px"><b>sum {terms.sum():.2f}</b> a step</div></div>'
    )


def free_port(host: str, port: int) -> int:
    """The first free port from `port` on.

    Raises:
      UserError: the host is not an address of this machine, or no port is free.
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
