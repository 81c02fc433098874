"""The page's panel of controls. `guard` refuses values that a control does not offer."""

import html
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import viser

from bounce_mjx.viewers.pace import SPEED_RANGE
from bounce_mjx.viewers.simulation import SideBySide, Simulation
from bounce_mjx.viewers.world import sliders_for

_PUSH_RANGE = (0.05, 1.0)
_DEFAULT_PUSH = 0.2
_DIRECTIONS = ("up", "away", "back", "left", "right")
_TARGET_STEP = 0.05
_SPEED_STEP = 0.1


class Settings(NamedTuple):
    """The settings of the controls, within the bounds of the simulation."""

    paused: bool
    speed: float
    """Speed as a factor of real time."""
    num_shown: int
    """Number of environments in the scene."""
    target_height: float | None
    """Target height of all environments, m; None for the height drawn at each reset."""
    world: dict[str, tuple[float, ...]] | None
    """See `Simulation.world`."""
    following: bool
    """Whether the camera follows the first ball."""


class Controls:
    """Pause, speed, number of robots, reset, target height, pushes and the world."""

    def __init__(
        self,
        server: viser.ViserServer,
        simulation: Simulation | SideBySide,
        *,
        title: str,
        speed: float,
        num_shown: int,
    ):
        gui = server.gui
        low, high = simulation.env.config.target_height_range
        target = simulation.target_height or 0.5 * (low + high)
        self._initial_world = simulation.world
        self._max_shown = simulation.num_envs
        self._height_range = min(0.3, low, target), max(0.8, high, target)
        self._reset_requested = False
        self._requested_push: np.ndarray | None = None
        self._saving: list[viser.ClientHandle] = []

        gui.add_html(f'<div style="padding:0 12px"><b>{html.escape(title)}</b></div>')
        self._paused = gui.add_checkbox("pause", False)
        self._speed = gui.add_slider("speed", *SPEED_RANGE, 0.1, speed)
        self._num_shown = gui.add_slider(
            "robots", 1, max(2, self._max_shown), 1, num_shown, disabled=self._max_shown == 1
        )
        self._following = gui.add_checkbox("follow the ball", False)
        reset = gui.add_button("reset", icon=viser.Icon.REFRESH)
        save = gui.add_button("save the last 10 s", icon=viser.Icon.DOWNLOAD)
        with gui.add_folder("target height"):
            self._drawn = gui.add_checkbox("drawn at each reset", simulation.target_height is None)
            self._height = gui.add_slider("height, m", *self._height_range, 0.01, target)
        with gui.add_folder("push the ball"):
            self._push_speed = gui.add_slider("speed, m/s", *_PUSH_RANGE, 0.05, _DEFAULT_PUSH)
            push = gui.add_button_group("towards", _DIRECTIONS)
        self._sliders = {}
        if sliders := sliders_for(simulation.env.config.randomization):
            is_drawn = simulation.world is None
            with gui.add_folder("world"):
                self._world_drawn = gui.add_checkbox(
                    "drawn at each reset", is_drawn, visible=is_drawn
                )
                for slider in sliders:
                    self._sliders[slider] = gui.add_slider(
                        slider.label, *slider.limits, slider.step, slider.nominal
                    )
                nominal = gui.add_button("nominal world")

            @nominal.on_click
            def _(_) -> None:
                for slider, handle in self._sliders.items():
                    handle.value = slider.nominal
                self._world_drawn.value = False

            for handle in self._sliders.values():

                @handle.on_update
                def _(_) -> None:
                    self._world_drawn.value = False

        # Callbacks run in threads of the server; the simulation's loop takes their requests.
        @reset.on_click
        def _(_) -> None:
            self._reset_requested = True

        @self._height.on_update
        def _(_) -> None:
            self._drawn.value = False

        @push.on_click
        def _(event) -> None:
            self._push(push.value, event.client)

        @save.on_click
        def _(event) -> None:
            self._saving.append(event.client)

        self._add_keys(gui)

    def _add_keys(self, gui: viser.GuiApi) -> None:
        """The keys of MuJoCo's window (`native`), which Ctrl-K also lists. The arrows and W, A, S,
        D, Q and E move viser's camera."""

        def pause(_) -> None:
            self._paused.value = not self._paused.value

        def reset(_) -> None:
            self._reset_requested = True

        def target(step: float) -> Callable[[viser.CommandEvent], None]:
            def change(_) -> None:
                self._height.value = _within(self._height.value + step, self._height_range)
                self._drawn.value = False

            return change

        def speed(step: float) -> Callable[[viser.CommandEvent], None]:
            def change(_) -> None:
                self._speed.value = _within(round(self._speed.value + step, 1), SPEED_RANGE)

            return change

        def push(towards: str) -> Callable[[viser.CommandEvent], None]:
            return lambda event: self._push(towards, event.client)

        for label, key, change in (
            ("pause", "space", pause),
            ("reset", "R", reset),
            ("target height up", "T", target(_TARGET_STEP)),
            ("target height down", "G", target(-_TARGET_STEP)),
            ("faster", "M", speed(_SPEED_STEP)),
            ("slower", "N", speed(-_SPEED_STEP)),
            ("push the ball up", "I", push("up")),
            ("push the ball back", "K", push("back")),
            ("push the ball left", "J", push("left")),
            ("push the ball right", "L", push("right")),
        ):
            gui.add_command(label, hotkey=key).on_trigger(change)

    def _push(self, towards: str, client: viser.ClientHandle) -> None:
        """Requests a push in a direction as a page sees it."""
        view = client.camera.look_at - client.camera.position
        speed = _within(self._push_speed.value, _PUSH_RANGE)
        self._requested_push = speed * direction(towards, view)

    def read(self) -> Settings:
        """The current settings."""
        height = _within(self._height.value, self._height_range)
        return Settings(
            paused=self._paused.value,
            speed=_within(self._speed.value, SPEED_RANGE),
            num_shown=_within(self._num_shown.value, (1, self._max_shown)),
            target_height=None if self._drawn.value else height,
            world=self._read_world(),
            following=self._following.value,
        )

    def _read_world(self) -> dict[str, tuple[float, ...]] | None:
        if not self._sliders:
            return self._initial_world
        if self._world_drawn.value:
            return None
        return {
            slider.term: slider.world_value(_within(handle.value, slider.limits))
            for slider, handle in self._sliders.items()
        }

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


def _within(value: float, limits: tuple[float, float]) -> float:
    """The number nearest to `value` within the limits."""
    return min(max(value, limits[0]), limits[1])
