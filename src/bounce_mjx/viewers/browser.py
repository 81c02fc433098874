"""The live page: viser serves the scene, the controls and the plots to any browser."""

import collections
import html
import itertools
import json
import socket
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
import viser
import viser.uplot

from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.viewers.controls import Controls, words
from bounce_mjx.viewers.display import TRAIL_RGB, TRAIL_SECONDS
from bounce_mjx.viewers.options import PageStart
from bounce_mjx.viewers.scene import Scene
from bounce_mjx.viewers.simulation import (
    EnvFrame,
    Simulation,
    at_index,
    environment_pose,
    in_real_time,
)

# Plots per second.
_PLOT_RATE = 8.0
_PLOT_SECONDS = 4.0
AXIS = {"stroke": "#444", "grid": {"stroke": "#e3e6ea"}}
"""Style of the axes of a plot."""
# uPlot's range: from the floor to 1.05 m, and further where a ball or a target is outside.
_HEIGHT_AXIS = {
    "min": {"soft": 0.0, "mode": 1, "pad": 0.05},
    "max": {"soft": 1.05, "mode": 1, "pad": 0.05},
}
# What viser has no setting for: a slider's handle would cover the labels of its ends, and on a
# phone the panel would leave a strip beside it that nothing can be done with.
_STYLE = """<style>
.mantine-Slider-markLabel { padding-top: 4px; }
.mantine-Paper-root[style*="position: fixed"] { left: 0 !important; width: auto !important; }
.mantine-Paper-root[style*="position: fixed"] [style*="width: 20em"] { width: 100% !important; }
</style>"""
_LEVEL_COLOURS = ("#2b8a3e", "#9c36b5", "#0b7285")
_REWARD = "reward/"


def _window_title(title: str) -> str:
    """HTML that sets the title of the browser's tab, for which viser has no setting."""
    script = html.escape(f"document.title = {json.dumps(title)}")
    return f'<img src="data:," alt="" hidden onerror="{script}">'


def run_page(
    server: viser.ViserServer,
    simulation: Simulation,
    start: PageStart,
    between_pictures: Callable[[], bool | None],
    on_ready: Callable[[], object] = lambda: None,
    seconds: float | None = None,
    side: viser.PanelHandle | None = None,
) -> None:
    """Builds the page of a simulation, steps it in real time, and sends pictures and plots.

    Args:
      between_pictures: called between two pictures; true ends the page. A training tells its news
        there, and returns None.
      on_ready: called when the page is built.
      seconds: simulated time; None for no end.
      side: the left panel, if it has tabs already.
    """
    gui = server.gui
    gui.configure_theme(
        show_logo=False, show_share_button=False, control_width="medium",
        brand_color=(230, 95, 20),
    )  # fmt: skip
    gui.set_panel_label("bounce_mjx")
    gui.main_panel.dock_right()
    gui.main_panel.set_width(280)
    gui.add_html(_STYLE + _window_title(f"bounce_mjx: {start.title}"))
    controls = Controls(gui, simulation, start)
    scene = Scene(server, simulation.env, start.num_shown, start.names)
    side = side or gui.add_panel()
    side.dock_left()
    side.set_width(300)
    with side.add_tab("robot 1" if start.names is None else start.names[0], viser.Icon.CHART_LINE):
        plots = _Plots(gui, simulation.env, simulation.frame)
    on_ready()
    next_plot = 0.0
    for frames in in_real_time(simulation, seconds, controls.pace):
        if between_pictures():
            break
        controls.apply()
        if controls.num_shown != scene.num_envs:
            scene.show(controls.num_shown)
        plots.history.extend(frames)
        # Without a step, there may be a reset, or a new target.
        scene.update(frames or [simulation.frame])
        if time.monotonic() >= next_plot:
            # Also in a pause, in which a user may reset, or let a value be sampled again.
            controls.show_values()
            if frames:
                plots.update()
            next_plot = time.monotonic() + 1.0 / _PLOT_RATE
    server.flush()


class _Plots:
    """The heights and the reward terms of the first environment."""

    def __init__(self, gui: viser.GuiApi, env: Env, frame: EnvFrame):
        self._env = env
        self.history: collections.deque[EnvFrame] = collections.deque(
            maxlen=round(_PLOT_SECONDS / env.dt)
        )
        """The last frames."""
        # The order of `_height_row`, after the times.
        lines: list[dict[str, Any]] = [{"label": "s"}]
        count = frame.balls.shape[1]
        for i in range(count):
            name = "ball" if count == 1 else f"ball {i + 1}"
            lines.append({"label": name, "stroke": "#e8590c", "width": 2})
        colours = itertools.cycle(_LEVEL_COLOURS)
        for name in self._levels(frame):
            lines.append({"label": name, "stroke": next(colours), "width": 2, "dash": [6, 4]})
        lines.append({"label": "paddle", "stroke": "#1c7ed6", "width": 2})
        gui.add_markdown("height, m, over the last seconds")
        self._heights = gui.add_uplot(
            (np.zeros(1),) * len(lines),
            tuple(lines),
            axes=({**AXIS, "size": 30}, {**AXIS, "size": 40}),
            scales={"x": {"time": False}, "y": {"range": _HEIGHT_AXIS}},
            legend={"live": False},
            height=190,
        )
        gui.add_markdown("reward, by term")
        self._terms = gui.add_html(reward_bars(dict.fromkeys(_reward_terms(frame), 0.0)))
        gui.add_html(_legend(env, frame))

    def _levels(self, frame: EnvFrame) -> dict[str, float]:
        """The task's heights."""
        return self._env.task.levels(at_index(frame.goal, 0))

    def _height_row(self, frame: EnvFrame) -> list[float]:
        """The heights of the balls, of the task's levels and of the paddle."""
        levels = self._levels(frame).values()
        return [*frame.balls[0, :, 2], *levels, frame.paddle[0, 2]]

    def update(self) -> None:
        """Sends the history to the page."""
        dt = self._env.dt
        frames = list(self.history)
        heights = [self._height_row(frame) for frame in frames]
        times = np.arange(1 - len(heights), 1) * dt
        self._heights.data = (times, *np.array(heights).T)
        recent = frames[-round(1.0 / _PLOT_RATE / dt) :]
        terms = jax.tree.map(lambda *values: np.mean(values), *map(_reward_terms, recent))
        self._terms.content = reward_bars(terms)


def _reward_terms(frame: EnvFrame) -> dict[str, float]:
    """The weighted reward terms of the first environment."""
    terms = {}
    for name, value in frame.metrics.items():
        if name.startswith(_REWARD):
            terms[name.removeprefix(_REWARD)] = value[0]
    return terms


def _legend(env: Env, frame: EnvFrame) -> str:
    """HTML that explains the task's markers, the line and the keys."""
    markers = env.task.markers(*environment_pose(frame, 0)[1:])
    # Markers whose names differ by a number are parts of one.
    rows = {}
    for marker in markers:
        name = words(marker.name.rstrip("_ 0123456789"))
        rows[name] = 255.0 * np.array(marker.rgba[:3])
    rows[f"path of the ball, {TRAIL_SECONDS} s"] = TRAIL_RGB
    lines = []
    for meaning, rgb in rows.items():
        colour = ",".join(f"{part:.0f}" for part in rgb)
        square = f'<b style="color:rgb({colour})">&#9632;</b>'
        lines.append(f"{square} {html.escape(meaning)}<br>")
    return f"""<div style="font:11px sans-serif;line-height:1.6;padding:0 12px 8px 12px">
{"".join(lines)}
<b>space</b> pause, <b>R</b> reset, <b>Ctrl-K</b> all keys
</div>"""


def reward_bars(terms: Mapping[str, float]) -> str:
    """A bar chart of the weighted reward terms as HTML, and their sum."""
    longest = max(5.0, *map(abs, terms.values()))
    rows = []
    for name, value in terms.items():
        width = 50.0 * abs(value) / longest
        left = 50.0 - width * (value < 0.0)
        colour = "#2b8a3e" if value >= 0.0 else "#c92a2a"
        rows.append(
            f"<tr><td>{html.escape(words(name))}</td>"
            f'<td style="text-align:right">{_format(value)}</td>'
            f'<td style="width:36%"><div style="height:9px;margin-left:{left:.1f}%;'
            f'width:{width:.1f}%;background:{colour}"></div></td></tr>'
        )
    total = _format(sum(terms.values()))
    rows.append(f'<tr><td colspan="3"><b>sum {total}</b> a step</td></tr>')
    return f'<table style="font:11px sans-serif;padding:0 12px;width:100%">{"".join(rows)}</table>'


def _format(value: float) -> str:
    """Two decimals, without the sign of a negative zero."""
    return f"{round(value, 2) + 0.0:.2f}"


def free_port(host: str, port: int) -> int:
    """The first free port of 100, from `port` on.

    Raises:
      UserError: the host is not an address of this machine, or none of the ports is free.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    for candidate in range(port, min(port + 100, 2**16)):
        try:
            with socket.create_server((host, candidate), family=family):
                return candidate
        except OSError as error:
            reason = error.strerror
    raise UserError(
        f"the page cannot be served at --host {host} --port {port} ({reason}); give an address of "
        "this machine, such as 127.0.0.1, or ::1 if it has only IPv6, and a free port"
    )
