"""The page of a running training: its newest policy, its curves and its results."""

import collections
import contextlib
import functools
import html
import queue
import signal
import threading
from collections.abc import Collection, Iterator

import jax
import numpy as np
import viser
from rich.console import Console

from bounce_mjx.env.env import Env
from bounce_mjx.errors import reason_of
from bounce_mjx.evaluation.results import Report
from bounce_mjx.interrupt import StopRequest
from bounce_mjx.learning.policy import make_networks, untrained_policy
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.task.shown import Curve
from bounce_mjx.training.callbacks import Event
from bounce_mjx.viewers.browser import AXIS, LivePage, free_port
from bounce_mjx.viewers.guard import open_server
from bounce_mjx.viewers.options import Address, PageStart
from bounce_mjx.viewers.simulation import Simulation, make_policy_controller

_ROBOTS = 4
_RETURN = Curve("episode/return", "", title="return of an episode")
_MAX_POINTS = 2000


class TrainingPage:
    """A callback of a training that serves a page from its own thread. The simulation runs
    on the CPU, so that training on a GPU keeps its speed."""

    def __init__(
        self,
        config: TrainConfig,
        host: str,
        port: int,
        console: Console,
        allowed: Collection[str] = (),
    ):
        """Starts the thread, which serves the page and compiles the simulation.

        Args:
          allowed: see `open_server`.

        Raises:
          UserError: the page cannot be served there.
        """
        self._config, self._console = config, console
        self._address = Address(host, free_port(host, port), allowed)
        self._news: queue.SimpleQueue = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def __call__(self, event: Event) -> None:
        """Shows a block or an evaluation of the first seed."""
        if event.config.seed == self._config.seed:
            self._news.put(functools.partial(_show, event))

    def wait(self) -> None:
        """Waits until Ctrl-C ends the page."""
        self._news.put(lambda _, panel: panel.end())
        if self._thread.is_alive():
            self._say(f"the page stays at {self._address.url} until Ctrl-C")
        with StopRequest(signal.SIGINT) as stop:
            while self._thread.is_alive() and not stop.requested:
                self._thread.join(0.2)

    def _serve(self) -> None:
        try:
            with _on_cpu():
                with open_server(*self._address) as server:
                    self._say(f"watch: {self._address.url}")
                    side = server.gui.add_panel()
                    panel = _Panel(server.gui, side, self._config)
                    simulation = self._simulate()
                    page = LivePage(server, simulation, PageStart("training"), side)
                    page.run(None, lambda: self._tell(simulation, panel))
        # The training continues without its page.
        except Exception as error:
            reason = reason_of(error)
            self._say(f"the page is not served ({reason}); training continues without it")

    def _simulate(self) -> Simulation:
        config = self._config
        env = Env(config.env)
        networks = make_networks(config.ppo, env.observation_size, env.action_size)
        untrained = untrained_policy(
            networks, env.observation_size, jax.random.PRNGKey(config.seed)
        )
        robots = _ROBOTS if env.engine.name == "fused" else 1
        controller = make_policy_controller(networks)
        untrained = jax.device_get(untrained)
        return Simulation(env, controller, robots, config.seed, policy=untrained)

    def _tell(self, simulation: Simulation, panel: "_Panel") -> None:
        """Shows the news since the last call."""
        if self._news.empty():
            return
        while not self._news.empty():
            self._news.get()(simulation, panel)
        panel.draw()

    def _say(self, line: str) -> None:
        self._console.out(line, highlight=False)


def _show(event: Event, simulation: Simulation, panel: "_Panel") -> None:
    if event.report is None:
        panel.add_block(event.steps, event.metrics)
    else:
        simulation.policy = event.policy
        panel.add_evaluation(event.steps, event.report)


class _Panel:
    """The tab of the training: its progress, its results and the task's curves."""

    def __init__(self, gui: viser.GuiApi, side: viser.PanelHandle, config: TrainConfig):
        self._total_steps = config.total_steps
        titled = [curve for curve in config.env.task.curves if curve.title]
        self._curves = (_RETURN, *titled)
        self._points: collections.deque[tuple[float, ...]] = collections.deque(maxlen=_MAX_POINTS)
        self._met_at: dict[str, int] = {}
        with side.add_tab("training", viser.Icon.SCHOOL):
            self._progress = gui.add_html(_text("compiling"))
            self._results = gui.add_html(_text("no evaluation yet; the arm is untrained"))
            self._plots = []
            for curve in self._curves:
                line = {"label": curve.title, "stroke": "#e8590c", "width": 2}
                gui.add_markdown(curve.title)
                self._plots.append(
                    gui.add_uplot(
                        (np.zeros(1), np.zeros(1)),
                        ({"label": "M steps"}, line),
                        axes=({**AXIS, "size": 30}, {**AXIS, "size": 50}),
                        scales={"x": {"time": False}},
                        legend={"show": False},
                        height=130,
                    )
                )

    def add_block(self, steps: int, means: dict[str, float]) -> None:
        """Adds a point to the curves."""
        values = (curve.scale * means.get(curve.tag, np.nan) for curve in self._curves)
        self._points.append((steps / 1e6, *values))
        rate = means["speed/steps_per_second"]
        done = f"{steps:,} of {self._total_steps:,} steps"
        self._progress.content = _text(f"<b>{done}</b><br>{rate:,.0f} steps/s")

    def end(self) -> None:
        """Says that training has ended."""
        self._progress.content = _text("<b>Training has ended</b>")

    def add_evaluation(self, steps: int, report: Report) -> None:
        """Shows the results of an evaluation."""
        self._results.content = results_list(report, steps, self._met_at)

    def draw(self) -> None:
        """Draws the curves."""
        steps, *values = np.array(self._points).reshape(-1, 1 + len(self._plots)).T
        for plot, curve in zip(self._plots, values, strict=True):
            known = np.isfinite(curve)
            if known.any():
                plot.data = (steps[known], curve[known])


def results_list(report: Report, steps: int, met_at: dict[str, int]) -> str:
    """The results as HTML, each with the step from which it has been met without a break.

    Args:
      steps: environment steps at the evaluation.
      met_at: these steps by name, which this updates.
    """
    rows = []
    for result in report.results:
        if not result.passed:
            met_at.pop(result.name, None)
        since = met_at.setdefault(result.name, steps) if result.passed else None
        mark, colour = {
            True: ("&#10003;", "#2b8a3e"),
            False: ("&#10007;", "#c92a2a"),
            None: ("-", "#444"),
        }[result.passed]
        value = "-" if result.value is None else f"{result.value:.2f}"
        rows.append(
            f'<tr><td style="color:{colour}">{mark}</td><td>{html.escape(result.name)}</td>'
            f'<td style="text-align:right">{value}</td>'
            f"<td>{html.escape(result.bound.partition(' (')[0])}</td>"
            f"<td>{'' if since is None else f'since {since:,}'}</td></tr>"
        )
    kind = "screening" if report.screening else "evaluation"
    head = f"{kind} at {steps:,} steps:<br><b>{html.escape(report.summary)}</b>"
    style = "font:10px sans-serif;white-space:nowrap;width:100%"
    return _text(f'{head}<table style="{style}">{"".join(rows)}</table>')


def _text(content: str) -> str:
    return f'<div style="font:11px sans-serif;padding:2px 12px">{content}</div>'


@contextlib.contextmanager
def _on_cpu() -> Iterator[None]:
    """Runs JAX's programs of this thread on the CPU, where JAX has one."""
    try:
        cpu = jax.devices("cpu")[0]
    except RuntimeError:
        yield
        return
    with jax.default_device(cpu):
        yield
