"""The page of a running training: its newest policy, its progress and its results."""

import html
import queue
import threading

import jax
import viser
from rich.console import Console

from bounce_mjx.env.env import Env
from bounce_mjx.errors import reason_of
from bounce_mjx.interrupt import StopRequest
from bounce_mjx.learning.policy import make_networks, untrained_policy
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.training.events import Event, evaluation_line, say
from bounce_mjx.viewers.browser import free_port, run_page
from bounce_mjx.viewers.guard import open_server
from bounce_mjx.viewers.options import Address, PageStart
from bounce_mjx.viewers.simulation import Simulation, make_policy_controller

_ROBOTS = 4


class TrainingPage:
    """A callback of a training that serves a page from its own thread. The simulation runs
    on the CPU, so that training on a GPU keeps its speed."""

    def __init__(self, config: TrainConfig, address: Address, console: Console):
        """Starts the thread, which serves the page and compiles the simulation.

        Args:
          address: with the first port to try.

        Raises:
          UserError: the page cannot be served there.
        """
        self._config = config
        self._console = console
        self._address = address._replace(port=free_port(address.host, address.port))
        self._news: queue.SimpleQueue[Event | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def __call__(self, event: Event) -> None:
        """Shows a block or an evaluation of the first seed."""
        if event.config.seed == self._config.seed:
            self._news.put(event)

    def wait(self) -> None:
        """Waits until Ctrl-C ends the page."""
        self._news.put(None)
        if self._thread.is_alive():
            say(self._console, f"the page stays at {self._address.url} until Ctrl-C")
        with StopRequest() as stop:
            while self._thread.is_alive() and not stop.requested:
                self._thread.join(0.2)

    def _serve(self) -> None:
        try:
            cpu = jax.default_device(jax.devices("cpu")[0])
            with cpu, open_server(*self._address) as server:
                self._address = self._address._replace(port=server.get_port())
                say(self._console, f"watch: {self._address.url}")
                side = server.gui.add_panel()
                with side.add_tab("training", viser.Icon.SCHOOL):
                    self._progress = server.gui.add_html(_text("compiling"))
                    waiting = _text("no evaluation yet; the arm is untrained")
                    self._results = server.gui.add_html(waiting)
                simulation = _simulate(self._config)
                start = PageStart("training")
                run_page(server, simulation, start, lambda: self._tell(simulation), side=side)
        # The training continues without its page.
        except Exception as error:
            reason = reason_of(error)
            say(self._console, f"the page is not served ({reason}); training continues without it")

    def _tell(self, simulation: Simulation) -> None:
        """Shows the news since the last call; None is the end of the training."""
        while not self._news.empty():
            event = self._news.get()
            if event is None:
                self._progress.content = _text("<b>Training has ended</b>")
            elif event.report is not None:
                line = html.escape(evaluation_line(event.config, event.steps, [event.report]))
                self._results.content = _text(line)
                simulation.policy = event.policy
            else:
                done = f"{event.steps:,} of {self._config.total_steps:,} steps"
                rate = event.metrics["speed/steps_per_second"]
                self._progress.content = _text(f"<b>{done}</b><br>{rate:,.0f} steps/s")


def _simulate(config: TrainConfig) -> Simulation:
    """A simulation with an untrained policy."""
    env = Env(config.env)
    key = jax.random.PRNGKey(config.seed)
    networks = make_networks(config.ppo, env.observation_size, env.action_size)
    policy = jax.device_get(untrained_policy(networks, env.observation_size, key))
    robots = _ROBOTS if env.engine.name == "fused" else 1
    return Simulation(env, make_policy_controller(networks), robots, config.seed, policy=policy)


def _text(content: str) -> str:
    return f'<div style="font:11px sans-serif;padding:2px 12px">{content}</div>'
