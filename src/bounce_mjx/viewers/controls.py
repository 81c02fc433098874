"""The page's panel of controls. `guard` refuses values that a control does not offer."""

import html
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import viser

from bounce_mjx.viewers.options import PageStart
from bounce_mjx.viewers.pace import SPEED_RANGE
from bounce_mjx.viewers.simulation import SideBySide, Simulation
from bounce_mjx.viewers.world import sliders_for
from bounce_mjx.world.config import Command

_PUSH_RANGE = (0.05, 1.0)
_DEFAULT_PUSH = 0.2
_DIRECTIONS = ("up", "away", "back", "left", "right")
_SPEED_STEP = 0.1
# Steps of a command's slider in a change by a key.
_STEPS_PER_KEY = 5


class Settings(NamedTuple):
    """The settings of the controls, within the bounds of the simulation."""

    paused: bool
    speed: float
    """Speed as a factor of real time."""
    num_shown: int
    """Number of environments in the scene."""
    command: dict[str, float]
    """See `Simulation.command`."""
    world: dict[str, tuple[float, ...]] | None
    """See `Simulation.world`."""
    following: bool
    """Whether the camera follows the first ball."""


class Controls:
    """Pause, speed, number of robots, reset, the task's commands, pushes and the world."""

    def __init__(
        self, server: viser.ViserServer, simulation: Simulation | SideBySide, start: PageStart
    ):
        gui = server.gui
        self._max_shown = simulation.num_envs
        self._reset_requested = False
        self._requested_push: np.ndarray | None = None
        self._saving: list[viser.ClientHandle] = []

        gui.add_html(f'<div style="padding:0 12px"><b>{html.escape(start.title)}</b></div>')
        self._paused = gui.add_checkbox("pause", False)
        self._speed = gui.add_slider("speed", *SPEED_RANGE, 0.1, start.speed)
        self._num_shown = gui.add_slider(
            "robots", 1, max(2, self._max_shown), 1, start.num_shown, disabled=self._max_shown == 1
        )
        self._following = gui.add_checkbox("follow the ball", False)
        reset = gui.add_button("reset", icon=viser.Icon.REFRESH)
        save = gui.add_button("save the last 10 s", icon=viser.Icon.DOWNLOAD)
        self._commands = {
            name: _CommandControls(gui, name, command, simulation.command.get(name))
            for name, command in simulation.env.config.commands.items()
        }
        with gui.add_folder("push the ball"):
            self._push_speed = gui.add_slider("speed, m/s", *_PUSH_RANGE, 0.05, _DEFAULT_PUSH)
            push = gui.add_button_group("towards", _DIRECTIONS)
        self._world = _WorldControls(gui, simulation)

        # Callbacks run in threads of the server; the simulation's loop takes their requests.
        reset.on_click(self._request_reset)
        push.on_click(lambda event: self._push(push.value, event.client))
        save.on_click(lambda event: self._saving.append(event.client))
        self._add_keys(gui)

    def _add_keys(self, gui: viser.GuiApi) -> None:
        """The keys of MuJoCo's window (`native`), which Ctrl-K also lists. The arrows and W, A, S,
        D, Q and E move viser's camera."""

        def pause(_) -> None:
            self._paused.value = not self._paused.value

        def speed(step: float) -> Callable[[viser.CommandEvent], None]:
            def change(_) -> None:
                self._speed.value = _within(round(self._speed.value + step, 1), SPEED_RANGE)

            return change

        def push(towards: str) -> Callable[[viser.CommandEvent], None]:
            return lambda event: self._push(towards, event.client)

        keys = [("pause", "space", pause), ("reset", "R", self._request_reset)]
        if self._commands:
            name, first = next(iter(self._commands.items()))
            keys.append((f"{words(name)} up", "T", lambda _: first.move(1.0)))
            keys.append((f"{words(name)} down", "G", lambda _: first.move(-1.0)))
        keys += [
            ("faster", "M", speed(_SPEED_STEP)),
            ("slower", "N", speed(-_SPEED_STEP)),
            ("push the ball up", "I", push("up")),
            ("push the ball back", "K", push("back")),
            ("push the ball left", "J", push("left")),
            ("push the ball right", "L", push("right")),
        ]
        for label, key, change in keys:
            gui.add_command(label, hotkey=key).on_trigger(change)

    def _request_reset(self, _: object) -> None:
        self._reset_requested = True

    def _push(self, towards: str, client: viser.ClientHandle) -> None:
        """Requests a push in a direction as a page sees it."""
        view = client.camera.look_at - client.camera.position
        speed = _within(self._push_speed.value, _PUSH_RANGE)
        self._requested_push = speed * direction(towards, view)

    def read(self) -> Settings:
        """The current settings."""
        values = {name: controls.read() for name, controls in self._commands.items()}
        return Settings(
            paused=self._paused.value,
            speed=_within(self._speed.value, SPEED_RANGE),
            num_shown=_within(self._num_shown.value, (1, self._max_shown)),
            command={name: value for name, value in values.items() if value is not None},
            world=self._world.read(),
            following=self._following.value,
        )

    def take_reset(self) -> bool:
        """Whether a reset was requested since the last call."""
        requested, self._reset_requested = self._reset_requested, False
        return requested

    def take_push(self) -> np.ndarray | None:
        """The velocity [3] (m/s) of the last push that was requested since the last call."""
        push, self._requested_push = self._requested_push, None
        return push

    def take_saving(self) -> list[viser.ClientHandle]:
        """The pages that asked for a recording since the last call."""
        pages, self._saving = self._saving, []
        return [page for page in pages if page is not None]


class _CommandControls:
    """A command of the task: drawn at each reset, or the value of a slider."""

    def __init__(self, gui: viser.GuiApi, name: str, command: Command, value: float | None):
        """
        Args:
          value: the value that is set; None if it is drawn.
        """
        start = round(0.5 * (command.low + command.high), 6) if value is None else value
        ends = (command.low, command.high, start, *(command.span or ()))
        self._limits = float(min(ends)), float(max(ends))
        self._step = command.step
        label = words(name)
        # The folder has the whole name, as the panel is narrow.
        short = label.split()[-1] + (f", {command.unit}" if command.unit else "")
        with gui.add_folder(label):
            self._drawn = gui.add_checkbox("drawn at each reset", value is None)
            self._slider = gui.add_slider(
                short, *self._limits, command.step / _STEPS_PER_KEY, start
            )

        @self._slider.on_update
        def _(_) -> None:
            self._drawn.value = False

    def move(self, steps: float) -> None:
        """Moves the slider by a number of the command's steps."""
        self._slider.value = _within(self._slider.value + steps * self._step, self._limits)
        self._drawn.value = False

    def read(self) -> float | None:
        """The value that is set; None if it is drawn."""
        return None if self._drawn.value else _within(self._slider.value, self._limits)


class _WorldControls:
    """The world's sliders, of those terms that the simulation lets move."""

    def __init__(self, gui: viser.GuiApi, simulation: Simulation | SideBySide):
        self._initial = simulation.world
        self._sliders = {}
        sliders = sliders_for(simulation.env.config.randomization)
        if not sliders:
            return
        is_drawn = simulation.world is None
        with gui.add_folder("world"):
            self._drawn = gui.add_checkbox("drawn at each reset", is_drawn, visible=is_drawn)
            for slider in sliders:
                handle = gui.add_slider(slider.label, *slider.limits, slider.step, slider.nominal)
                handle.on_update(self._set)
                self._sliders[slider] = handle
            gui.add_button("nominal world").on_click(self._make_nominal)

    def _set(self, _: object) -> None:
        self._drawn.value = False

    def _make_nominal(self, _: object) -> None:
        for slider, handle in self._sliders.items():
            handle.value = slider.nominal
        self._drawn.value = False

    def read(self) -> dict[str, tuple[float, ...]] | None:
        """See `Simulation.world`."""
        if not self._sliders:
            return self._initial
        if self._drawn.value:
            return None
        return {
            slider.term: slider.world_value(_within(handle.value, slider.limits))
            for slider, handle in self._sliders.items()
        }


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


def _within(value: float, limits: tuple[float, float]) -> float:
    """The number nearest to `value` within the limits."""
    return min(max(value, limits[0]), limits[1])
