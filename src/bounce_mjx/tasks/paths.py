"""A commanded point that moves along a path at a phase from 0 to 1, at a height that sways.

Its commands are target_x, target_y and target_height (m), the point now; point_speed (m/s), its
greatest horizontal speed; and those of `COMMANDS`.
"""

from __future__ import annotations

import math
from typing import Any

from bounce_mjx import task
from bounce_mjx.lazy import jax, jnp, np

NAMES = ("circle", "line", "figure of eight", "steps", "wandering")
STEPS = 3
"""Number of the path of steps: the corners of a hexagon."""
CORNERS, SIDE, STEP_SECONDS = 6, 0.1, 4.0
"""Corners of the hexagon, its side (m), and the time at a corner (s)."""
FASTEST = (1.0, 1.0, math.sqrt(2.0), math.inf, math.sqrt(32.0) / 3.0)
"""Greatest speed on each path of the size 1, per radian of its phase."""
SWAY = 0.05
"""Amplitude of the height, m."""
COMMANDS = {
    "path": task.Command(0.0, len(NAMES), "", 0.0, len(NAMES), None, 1.0, NAMES, hidden=True),
    "course": task.Command(0.0, 1.0, "turns", 0.0, 1.0, hidden=True),
    "phase": task.Command(0.0, 1.0, "turns", 0.0, 1.0, hidden=True),
}
"""Number of the path; its direction, and the form of the wandering; the place on it."""

Values = dict[str, Any]


def point(command: Values, xp: Any = None) -> Any:
    """The point now [3, ...], m, in JAX or in another array library."""
    return (xp or jnp).stack([command[f"target_{axis}"] for axis in ("x", "y", "height")])


def at_point(command: Values, point: Any) -> Values:
    """The commands with another point now [3], m."""
    x, y, height = point
    return command | {"target_x": x, "target_y": y, "target_height": height}


def offset(command: Values, size: float, phase: Any, xp: Any = None) -> Any:
    """The point from the middle of its path [3, ...], m, at places on it [...], turns.

    Args:
      size: radius of the circle, half the length of the line and of the figure of eight, m.
    """
    xp, course = xp or jnp, command["course"]

    def wave(number: float, shift: Any = 0.0, turns: Any = phase) -> Any:
        return xp.sin(2.0 * math.pi * (number * turns + shift))

    corner, side = xp.floor(CORNERS * phase) / CORNERS, SIDE / size
    wander_x = (wave(1, 3.0 * course) + wave(2, 5.0 * course) / 2.0) / 1.5
    wander_y = (wave(1, 7.0 * course) + wave(3, 11.0 * course) / 3.0) / 1.5
    xs = (wave(1, 0.25), wave(1), wave(1), side * wave(1, 0.25, corner), wander_x)
    ys = (wave(1), 0.0 * phase, wave(2) / 2.0, side * wave(1, 0.0, corner), wander_y)
    x, y = (size * _choose(values, command, xp) for values in (xs, ys))
    cosine, sine = wave(1, 0.25, course), wave(1, 0.0, course)
    return xp.stack([cosine * x - sine * y, sine * x + cosine * y, SWAY * wave(1, course)])


def phase_in(seconds: Any, command: Values, size: float) -> jax.Array:
    """Place on the path in some seconds [], turns. Steps have their own time, unless the speed
    is 0."""
    speed = command["point_speed"]
    rates = [speed / (2.0 * math.pi * size * fastest) for fastest in FASTEST]
    rates[STEPS] = (speed > 0.0) / (CORNERS * STEP_SECONDS)
    return command["phase"] + seconds * _choose(rates, command, jnp)


def seconds_at_corner(command: Values) -> jax.Array:
    """Time since the last step of a point on the path of steps [], s."""
    corners = CORNERS * command["phase"]
    return (corners - jnp.floor(corners)) * STEP_SECONDS


def markers(command: dict[str, float], size: float) -> tuple[task.Marker, ...]:
    """A disc at the point, and dots on its path."""
    here, places = point(command, np), np.linspace(0.0, 1.0, 24, endpoint=False)
    dots = here + offset(command, size, places, np).T - offset(command, size, command["phase"], np)
    green, blue, cube = (0.15, 0.9, 0.3, 0.6), (0.15, 0.45, 1.0, 0.7), (0.004, 0.004, 0.004)
    disc = task.Marker("target point", tuple(here.tolist()), (0.03, 0.001, 0.0), green, "cylinder")
    path = (task.Marker(f"path {i}", tuple(p), cube, blue) for i, p in enumerate(dots.tolist()))
    return disc, *path


def name(command: dict[str, float]) -> str:
    """Name of the path."""
    return NAMES[min(int(command["path"]), len(NAMES) - 1)]


def _choose(values: Any, command: Values, xp: Any) -> Any:
    """The value that belongs to the command's path, of one for each path."""
    # Not jnp.select, which is made with argmax: XLA for CPUs aborts where it fuses two of them.
    value, *others = values
    for number, other in enumerate(others, start=1):
        value = xp.where(command["path"] >= number, other, value)
    return value
