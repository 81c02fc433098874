"""The page's panel of controls."""

import html
import queue
from collections.abc import Callable, Sequence

import numpy as np
import viser

from bounce_mjx.viewers.film import FilmPlayer, world_rows
from bounce_mjx.viewers.options import PageStart
from bounce_mjx.viewers.simulation import Simulation
from bounce_mjx.viewers.world import WorldSlider
from bounce_mjx.world.config import Goal

# Slowest and fastest speed, as factors of real time.
_SPEED_RANGE = (0.1, 4.0)
_PUSH_RANGE = (0.05, 1.0)
_DIRECTIONS = ("up", "away", "back", "left", "right")
_SPEED_STEP = 0.1
# Steps of a goal's slider in a change by a key.
_STEPS_PER_KEY = 5
# Decimals that a page keeps.
_DECIMALS = 6
_SAMPLED = "sampled at each reset"
# Also between resets, as a task may have it.
_GOAL_SAMPLED = "sampled"


class _Setting:
    """A slider, or a choice by names, for a value that is sampled as long as `sampled` is on: a
    goal has a checkbox of its own, and all terms of the world share one."""

    def __init__(
        self,
        handle: viser.GuiSliderHandle | viser.GuiDropdownHandle,
        sampled: viser.GuiCheckboxHandle,
        names: Sequence[str] = (),
    ):
        self.sampled = sampled
        self._handle = handle
        self._names = list(names)
        self._shown: float | None = None
        handle.on_update(self._take)
        sampled.on_update(self._forget)

    def _take(self, event: viser.GuiEvent) -> None:
        """What a user sets is not sampled; what `show` sets is."""
        if event.client is not None:
            self.sampled.value = False

    def _forget(self, _: object) -> None:
        """Once the value is sampled again, the slider shows the user's until `show` sets it."""
        self._shown = None

    @property
    def value(self) -> float:
        """The value; a choice's number."""
        if not self._names:
            return _clip(self._handle)
        name = self._handle.value
        return float(self._names.index(name)) if name in self._names else 0.0

    def show(self, value: float) -> None:
        """Shows a sampled value that holds, in the slider's steps."""
        if self._names:
            shown = min(int(value), len(self._names) - 1)
        else:
            shown = round(round(value / self._handle.step) * self._handle.step, _DECIMALS)
        # Set only for a new value, as a user may be moving it.
        if shown != self._shown:
            self._shown = shown
            self._handle.value = self._names[shown] if self._names else shown

    def set(self, value: float) -> None:
        """Sets a value."""
        self.sampled.value = False
        self._handle.value = self._names[int(value)] if self._names else value

    def move(self, change: float) -> None:
        """Adds to the value, within the limits."""
        if self._names:
            self.set((self.value + np.sign(change)) % len(self._names))
        else:
            ends = self._handle.min, self._handle.max
            self.set(round(float(np.clip(self.value + change, *ends)), _DECIMALS))


class Controls:
    """Pause, speed, number of robots, reset, the task's goals, pushes and the world."""

    def __init__(self, gui: viser.GuiApi, simulation: Simulation, start: PageStart):
        self._simulation = simulation
        # A film shows the values that hold, and takes none.
        self._is_film = simulation.is_film
        # Callbacks run in threads of the server; the simulation's loop obeys their requests.
        self._requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        gui.add_html(f'<div style="padding:0 12px"><b>{html.escape(start.title)}</b></div>')
        self._paused = gui.add_checkbox("pause", False)
        self._speed = gui.add_slider("speed", *_SPEED_RANGE, _SPEED_STEP, 1.0)
        most = simulation.num_envs
        self._num_shown = gui.add_slider(
            "robots", 1, max(2, most), 1, start.num_shown, disabled=most == 1
        )
        reset = gui.add_button(
            "play it again" if self._is_film else "reset the robots", icon=viser.Icon.REFRESH
        )
        reset.on_click(self._reset)
        self._goals = {
            name: self._add_goal(gui, name, goal)
            for name, goal in simulation.env.config.goals.items()
        }
        with gui.add_folder("push the ball", visible=not self._is_film):
            self._push_speed = gui.add_slider("speed, m/s", *_PUSH_RANGE, 0.05, 0.2)
            push = gui.add_button_group("push", [f"ball {towards}" for towards in _DIRECTIONS])
        push.on_click(lambda event: self._push(push.value.removeprefix("ball "), event))
        self._world: dict[WorldSlider, _Setting] = {}
        self._add_world(gui)
        # Ctrl-K lists them. The arrows and W, A, S, D, Q and E move viser's camera.
        for label, key, act in self._keys():
            gui.add_command(label, hotkey=key).on_trigger(act)
        self.show_values()

    def _add_goal(self, gui: viser.GuiApi, name: str, goal: Goal) -> _Setting:
        given = self._simulation.goal.get(name)
        start = 0.5 * (goal.low + goal.high) if given is None else given
        start = round(float(start), _DECIMALS)
        # A value that is given beyond what is offered widens the slider.
        reached = [start, *goal.offered]
        lowest = round(float(min(reached)), _DECIMALS)
        highest = round(float(max(reached)), _DECIMALS)
        label = words(name)
        # The folder has the whole name, as the panel is narrow.
        short = label.split()[-1] + (f", {goal.unit}" if goal.unit else "")
        with gui.add_folder(label):
            sampled = gui.add_checkbox(_GOAL_SAMPLED, given is None, visible=not self._is_film)
            if goal.names:
                handle = gui.add_dropdown(short, goal.names, disabled=self._is_film)
            else:
                handle = gui.add_slider(
                    short,
                    lowest,
                    highest,
                    goal.step / _STEPS_PER_KEY,
                    start,
                    disabled=self._is_film,
                )
        setting = _Setting(handle, sampled, goal.names)
        if goal.names:
            setting.show(start)
        return setting

    def _add_world(self, gui: viser.GuiApi) -> None:
        """The world's sliders, of those terms that the simulation lets move."""
        sliders = self._simulation.sliders
        if not sliders:
            return
        is_sampled = self._simulation.world is None
        with gui.add_folder("world"):
            is_free = is_sampled and not self._is_film
            sampled = gui.add_checkbox(_SAMPLED, is_sampled, visible=is_free)
            for slider in sliders:
                handle = gui.add_slider(
                    slider.label,
                    *slider.limits,
                    slider.step,
                    slider.nominal,
                    disabled=self._is_film,
                )
                self._world[slider] = _Setting(handle, sampled)
            nominal = gui.add_button("make the world nominal", visible=not self._is_film)
            nominal.on_click(self._make_nominal)
            if isinstance(self._simulation, FilmPlayer):
                gui.add_html(_world_table(self._simulation.world_values))

    def show_values(self) -> None:
        """Shows the sampled values that hold in the first environment."""
        for name, setting in self._goals.items():
            if setting.sampled.value:
                setting.show(float(self._simulation.frame.goal[name][0]))
        for slider, setting in self._world.items():
            if setting.sampled.value:
                setting.show(self._simulation.world_value(slider.term) / slider.scale)

    @property
    def num_shown(self) -> int:
        """Number of robots in the scene."""
        return min(_clip(self._num_shown), self._simulation.num_envs)

    def pace(self) -> float:
        """The present speed, as a factor of real time; 0 is a pause."""
        return 0.0 if self._paused.value else _clip(self._speed)

    def _keys(self) -> list[tuple[str, str, Callable[[viser.CommandEvent], None]]]:
        """What each key does, the key, and the function of its event."""
        keys = [
            ("pause", "space", self._pause),
            ("reset", "R", self._reset),
            ("faster", "M", lambda _: self._accelerate(_SPEED_STEP)),
            ("slower", "N", lambda _: self._accelerate(-_SPEED_STEP)),
        ]
        if self._is_film:
            return keys
        if self._goals:
            name = words(next(iter(self._goals)))
            keys += [
                (f"{name} up", "T", lambda _: self._move(1.0)),
                (f"{name} down", "G", lambda _: self._move(-1.0)),
            ]
        keys += [
            ("push the ball up", "I", lambda event: self._push("up", event)),
            ("push the ball back", "K", lambda event: self._push("back", event)),
            ("push the ball left", "J", lambda event: self._push("left", event)),
            ("push the ball right", "L", lambda event: self._push("right", event)),
        ]
        return keys

    def _pause(self, _: object) -> None:
        self._paused.value = not self._paused.value

    def _reset(self, _: object) -> None:
        self._requests.put(self._simulation.reset)

    def _move(self, steps: float) -> None:
        """Moves the first goal by a number of its steps."""
        name, setting = next(iter(self._goals.items()))
        setting.move(steps * self._simulation.env.config.goals[name].step)

    def _accelerate(self, change: float) -> None:
        speed = round(_clip(self._speed) + change, 1)
        self._speed.value = float(np.clip(speed, *_SPEED_RANGE))

    def _push(self, towards: str, event: viser.GuiEvent | viser.CommandEvent) -> None:
        """Requests a push of the ball in a direction as the event's page sees it."""
        if towards in _DIRECTIONS:
            camera = event.client.camera
            view = camera.look_at - camera.position
            velocity = _clip(self._push_speed) * direction(towards, view)
            self._requests.put(lambda: self._simulation.push(velocity))

    def _make_nominal(self, _: object) -> None:
        for slider, setting in self._world.items():
            setting.set(slider.nominal)

    def apply(self) -> None:
        """Applies the settings and the requests to the simulation."""
        if self._is_film:
            while not self._requests.empty():
                self._requests.get()()
            return
        self._simulation.goal = {
            name: setting.value
            for name, setting in self._goals.items()
            if not setting.sampled.value
        }
        if self._world:
            world = {x.term: x.world_value(setting.value) for x, setting in self._world.items()}
            is_sampled = next(iter(self._world.values())).sampled.value
            self._simulation.world = None if is_sampled else world
        while not self._requests.empty():
            self._requests.get()()


def _world_table(values: dict[str, np.ndarray]) -> str:
    """Every term of a world and its value, in the unit of its setting, as HTML."""
    rows = "".join(
        f"<tr><td>{html.escape(name)}</td><td>{html.escape(value)}</td></tr>"
        for name, value in world_rows(values)
    )
    return f'<table style="margin:0 12px;font-size:11px">{rows}</table>'


def _clip(slider: viser.GuiSliderHandle) -> float:
    """The slider's value. A page may send any number, which viser does not check."""
    return max(slider.min, min(slider.value, slider.max))


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
