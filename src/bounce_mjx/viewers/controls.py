"""The page's panel of controls. `guard` refuses values that a control does not offer."""

import html
import queue
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from bounce_mjx.viewers.options import SPEED_RANGE, PageStart
from bounce_mjx.viewers.simulation import Simulation
from bounce_mjx.viewers.world import sliders_for
from bounce_mjx.world.config import Command, WorldConfig

_PUSH_RANGE = (0.05, 1.0)
DEFAULT_PUSH = 0.2
"""Speed of a push, m/s."""
_DIRECTIONS = ("up", "away", "back", "left", "right")
_SPEED_STEP = 0.1
# Steps of a command's slider in a change by a key.
_STEPS_PER_KEY = 5
# Decimals that a page keeps.
_DECIMALS = 6
_DRAWN = "drawn at each reset"


class Controls:
    """Pause, speed, number of robots, reset, the task's commands, pushes and the world."""

    def __init__(self, gui: viser.GuiApi, simulation: Simulation, start: PageStart):
        self._simulation = simulation
        # Callbacks run in threads of the server; the simulation's loop obeys their requests.
        self._requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        gui.add_html(f'<div style="padding:0 12px"><b>{html.escape(start.title)}</b></div>')
        self._paused = gui.add_checkbox("pause", False)
        self._speed = gui.add_slider("speed", *SPEED_RANGE, _SPEED_STEP, start.speed)
        most = simulation.num_envs
        self.num_shown = gui.add_slider(
            "robots", 1, max(2, most), 1, start.num_shown, disabled=most == 1
        )
        self.following = gui.add_checkbox("follow the ball", False)
        reset = gui.add_button("reset", icon=viser.Icon.REFRESH)
        reset.on_click(self.reset)
        self.save = gui.add_button("save the last 10 s", icon=viser.Icon.DOWNLOAD)
        self._commands = {
            name: self._add_command(gui, name, command)
            for name, command in simulation.env.config.commands.items()
        }
        with gui.add_folder("push the ball"):
            self._push_speed = gui.add_slider("speed, m/s", *_PUSH_RANGE, 0.05, DEFAULT_PUSH)
            push = gui.add_button_group("towards", _DIRECTIONS)
        push.on_click(lambda event: self.push(push.value, event))
        self._sliders = {}
        self._add_world(gui)
        # Ctrl-K lists them. The arrows and W, A, S, D, Q and E move viser's camera.
        for label, key, act in keys(self, simulation.env.config):
            gui.add_command(label, hotkey=key).on_trigger(act)

    def _add_command(
        self, gui: viser.GuiApi, name: str, command: Command
    ) -> tuple[viser.GuiCheckboxHandle, viser.GuiSliderHandle]:
        """Whether the command is drawn at each reset, and its value if not."""
        given = self._simulation.command.get(name)
        start = 0.5 * (command.low + command.high) if given is None else given
        start, *ends = (
            round(float(end), _DECIMALS)
            for end in (start, command.low, command.high, *(command.span or ()))
        )
        low, high = min(start, *ends), max(start, *ends)
        label = words(name)
        # The folder has the whole name, as the panel is narrow.
        short = label.split()[-1] + (f", {command.unit}" if command.unit else "")
        with gui.add_folder(label):
            drawn = gui.add_checkbox(_DRAWN, given is None)
            slider = gui.add_slider(short, low, high, command.step / _STEPS_PER_KEY, start)
        slider.on_update(lambda _: setattr(drawn, "value", False))
        return drawn, slider

    def _add_world(self, gui: viser.GuiApi) -> None:
        """The world's sliders, of those terms that the simulation lets move."""
        sliders = sliders_for(self._simulation.env.config.randomization)
        if not sliders:
            return
        is_drawn = self._simulation.world is None
        with gui.add_folder("world"):
            self._drawn = gui.add_checkbox(_DRAWN, is_drawn, visible=is_drawn)
            for slider in sliders:
                handle = gui.add_slider(slider.label, *slider.limits, slider.step, slider.nominal)
                handle.on_update(lambda _: setattr(self._drawn, "value", False))
                self._sliders[slider] = handle
            gui.add_button("nominal world").on_click(self._make_nominal)

    def pause(self, _: object) -> None:
        """Pauses the simulation, or resumes it."""
        self._paused.value = not self._paused.value

    def reset(self, _: object) -> None:
        """Requests a new episode of every robot."""
        self._requests.put(self._simulation.reset)

    def move(self, steps: float) -> None:
        """Moves the first command's slider by a number of the command's steps."""
        name, (drawn, slider) = next(iter(self._commands.items()))
        change = steps * self._simulation.env.config.commands[name].step
        slider.value = float(np.clip(slider.value + change, slider.min, slider.max))
        drawn.value = False

    def hasten(self, change: float) -> None:
        """Changes the speed."""
        self._speed.value = float(np.clip(round(self._speed.value + change, 1), *SPEED_RANGE))

    def push(self, towards: str, event: viser.GuiEvent | viser.CommandEvent) -> None:
        """Requests a push of the ball in a direction as the event's page sees it."""
        camera = event.client.camera
        velocity = self._push_speed.value * direction(towards, camera.look_at - camera.position)
        self._requests.put(lambda: self._simulation.push(velocity))

    def _make_nominal(self, _: object) -> None:
        for slider, handle in self._sliders.items():
            handle.value = slider.nominal
        self._drawn.value = False

    def pace(self) -> float:
        """The present speed, as a factor of real time; 0 is a pause."""
        return 0.0 if self._paused.value else self._speed.value

    def apply(self) -> None:
        """Applies the settings and the requests to the simulation."""
        self._simulation.command = {
            name: slider.value
            for name, (drawn, slider) in self._commands.items()
            if not drawn.value
        }
        if self._sliders:
            positions = {slider: handle.value for slider, handle in self._sliders.items()}
            world = {slider.term: slider.world_value(x) for slider, x in positions.items()}
            self._simulation.world = None if self._drawn.value else world
        while not self._requests.empty():
            self._requests.get()()


def keys(viewer: Any, config: WorldConfig) -> list[tuple[str, str, Callable[[Any], None]]]:
    """The keys of the page and of MuJoCo's window: what each one does, the key, and the function of
    its event.

    Args:
      viewer: has the methods pause, reset, move, hasten and push.
    """
    moved = [words(name) for name in config.commands][:1]
    return [
        ("pause", "space", viewer.pause),
        ("reset", "R", viewer.reset),
        *((f"{name} up", "T", lambda _: viewer.move(1.0)) for name in moved),
        *((f"{name} down", "G", lambda _: viewer.move(-1.0)) for name in moved),
        ("faster", "M", lambda _: viewer.hasten(_SPEED_STEP)),
        ("slower", "N", lambda _: viewer.hasten(-_SPEED_STEP)),
        ("push the ball up", "I", lambda event: viewer.push("up", event)),
        ("push the ball back", "K", lambda event: viewer.push("back", event)),
        ("push the ball left", "J", lambda event: viewer.push("left", event)),
        ("push the ball right", "L", lambda event: viewer.push("right", event)),
    ]


def direction(towards: str, view: np.ndarray) -> np.ndarray:
    """Unit vector [3] in the world for a direction on the screen: up, or horizontally away from the
    camera, back to it, left or right.

    Args:
      view: direction in which the camera looks [3]; if it has no horizontal part, away is +x.
    """
    length = np.hypot(view[0], view[1])
    x, y = view[:2] / length if 1e-9 < length < np.inf else (1.0, 0.0)
    directions = {
        "up": (0.0, 0.0, 1.0),
        "away": (x, y, 0.0),
        "back": (-x, -y, 0.0),
        "left": (-y, x, 0.0),
        "right": (y, -x, 0.0),
    }
    return np.array(directions[towards])


def words(name: str) -> str:
    """A name as words."""
    return name.replace("_", " ")
