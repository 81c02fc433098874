"""The page's panel of controls.

Anyone who can reach the port can send any value for any control, whatever its slider offers. All
values are therefore checked when they are read.
"""

import html
import math
from typing import NamedTuple

import numpy as np
import viser

from bounce_mjx.viewers.pace import SPEED_RANGE
from bounce_mjx.viewers.simulation import Simulation

_PUSH_RANGE = (0.05, 1.0)
_DEFAULT_PUSH = 0.2
_DIRECTIONS = {
    "up": (0, 0, 1),
    "away": (1, 0, 0),
    "back": (-1, 0, 0),
    "left": (0, 1, 0),
    "right": (0, -1, 0),
}


class Settings(NamedTuple):
    """The settings of the controls, within the bounds of the simulation."""

    paused: bool
    speed: float
    """Speed as a factor of real time."""
    num_shown: int
    """Number of environments in the scene."""
    target_height: float | None
    """Target height of all environments, m; None for the height drawn at each reset."""


class Controls:
    """Pause, speed, number of robots, reset, target height and pushes."""

    def __init__(
        self,
        server: viser.ViserServer,
        simulation: Simulation,
        *,
        title: str,
        speed: float,
        num_shown: int,
    ):
        gui = server.gui
        low, high = simulation.env.config.target_height_range
        target = simulation.target_height or 0.5 * (low + high)
        self._initial = Settings(False, speed, num_shown, simulation.target_height)
        self._max_shown = simulation.num_envs
        self._height_range = min(0.3, low, target), max(0.8, high, target)
        self._reset_requested = False
        self._requested_push: np.ndarray | None = None

        gui.add_html(f'<div style="padding:0 12px"><b>{html.escape(title)}</b></div>')
        self._paused = gui.add_checkbox("pause", False)
        self._speed = gui.add_slider("speed", *SPEED_RANGE, 0.1, speed)
        self._num_shown = gui.add_slider(
            "robots", 1, max(2, self._max_shown), 1, num_shown, disabled=self._max_shown == 1
        )
        reset = gui.add_button("reset", icon=viser.Icon.REFRESH)
        with gui.add_folder("target height"):
            self._drawn = gui.add_checkbox("drawn at each reset", simulation.target_height is None)
            self._height = gui.add_slider("height, m", *self._height_range, 0.01, target)
        with gui.add_folder("push the ball"):
            self._push_speed = gui.add_slider("speed, m/s", *_PUSH_RANGE, 0.05, _DEFAULT_PUSH)
            push = gui.add_button_group("towards", tuple(_DIRECTIONS))

        # Callbacks run in threads of the server; the simulation's loop takes their requests.
        @reset.on_click
        def _(_) -> None:
            self._reset_requested = True

        @self._height.on_update
        def _(_) -> None:
            self._drawn.value = False

        @push.on_click
        def _(_) -> None:
            direction = _DIRECTIONS.get(push.value)
            if direction is not None:
                speed = _number_within(self._push_speed.value, _PUSH_RANGE, _DEFAULT_PUSH)
                self._requested_push = speed * np.array(direction)

    def read(self) -> Settings:
        """The current settings."""
        initial = self._initial
        height = _number_within(self._height.value, self._height_range, self._height_range[0])
        shown = _number_within(self._num_shown.value, (1, self._max_shown), initial.num_shown)
        return Settings(
            paused=bool(self._paused.value),
            speed=_number_within(self._speed.value, SPEED_RANGE, initial.speed),
            num_shown=round(shown),
            target_height=None if self._drawn.value else height,
        )

    def take_reset(self) -> bool:
        """Whether a reset was requested since the last call."""
        requested, self._reset_requested = self._reset_requested, False
        return requested

    def take_push(self) -> np.ndarray | None:
        """The velocity [3] (m/s) of the last push that was requested since the last call."""
        push, self._requested_push = self._requested_push, None
        return push


def _number_within(value: object, limits: tuple[float, float], default: float) -> float:
    """The number nearest to `value` within the limits; `default` if `value` is no number."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return default
    return default if math.isnan(number) else min(max(number, limits[0]), limits[1])
