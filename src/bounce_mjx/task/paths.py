"""A target point that moves along a path at a phase from 0 to 1, at a height that sways.

Its goals are target_x, target_y and target_height (m), the point now; point_speed (m/s), its
greatest horizontal speed; and those of `GOALS`.
"""

from __future__ import annotations

import math
from typing import Any

from bounce_mjx import task
from bounce_mjx.lazy import jax, jnp, np

NAMES = ("circle", "line", "figure of eight", "steps", "wandering")
"""Names of the paths, by their numbers."""
STEPS = 3
"""Number of the path of steps: the corners of a hexagon."""
CORNERS = 6
"""Corners of the hexagon."""
SIDE = 0.1
"""Side of the hexagon, and the distance of its corners from the middle, m."""
STEP_SECONDS = 4.0
"""Time at a corner, s."""
FASTEST = (1.0, 1.0, math.sqrt(2.0), math.inf, math.sqrt(32.0) / 3.0)
"""Greatest speed on each path of the size 1, per radian of its phase."""
SHARPEST = 17.0 / 16.0
"""Greatest acceleration on a path of the size 1 with the greatest speed 1: on the figure of eight,
max(sin^2 a + 4 sin^2 2a) = (17 / 8)^2 for its phase a, in radians."""
SWAY = 0.05
"""Amplitude of the height, m."""
GOALS = {
    "path": task.Goal(
        0.0, len(NAMES), least=0.0, greatest=len(NAMES), step=1.0, names=NAMES, hidden=True
    ),
    "course": task.Goal(0.0, 1.0, "turns", least=0.0, greatest=1.0, hidden=True),
    "phase": task.Goal(0.0, 1.0, "turns", least=0.0, greatest=1.0, hidden=True),
}
"""Number of the path; its direction, and the form of the wandering; the place on it."""

Values = dict[str, Any]


def point(goal: Values, xp: Any = None) -> Any:
    """The point now [3, ...], m, in JAX or in another array library."""
    return (xp or jnp).stack([goal[f"target_{axis}"] for axis in ("x", "y", "height")])


def at_point(goal: Values, point: Any) -> Values:
    """The goals with another point now [3], m."""
    x, y, height = point
    return goal | {"target_x": x, "target_y": y, "target_height": height}


def offset(goal: Values, size: float, phase: Any, xp: Any = None) -> Any:
    """The point from the middle of its path [3, ...], m, at places on it [...], turns.

    Args:
      size: radius of the circle, half the length of the line and of the figure of eight, and at
        most half the width of the wandering, m.
    """
    xp = xp or jnp
    course = goal["course"]

    def sine(turns: Any) -> Any:
        return xp.sin(2.0 * math.pi * turns)

    def cosine(turns: Any) -> Any:
        return xp.sin(2.0 * math.pi * (turns + 0.25))

    # The steps' own size does not depend on that of the others.
    corner = xp.floor(CORNERS * phase) / CORNERS
    side = SIDE / size
    wandering_x = (sine(phase + 3.0 * course) + sine(2.0 * phase + 5.0 * course) / 2.0) / 1.5
    wandering_y = (sine(phase + 7.0 * course) + sine(3.0 * phase + 11.0 * course) / 3.0) / 1.5
    # In the order of the names, each of the size 1.
    xs = (cosine(phase), sine(phase), sine(phase), side * cosine(corner), wandering_x)
    ys = (sine(phase), 0.0 * phase, sine(2.0 * phase) / 2.0, side * sine(corner), wandering_y)
    x = size * _choose(xs, goal, xp)
    y = size * _choose(ys, goal, xp)

    # The course turns the path.
    cos_course = cosine(course)
    sin_course = sine(course)
    turned_x = cos_course * x - sin_course * y
    turned_y = sin_course * x + cos_course * y
    return xp.stack([turned_x, turned_y, SWAY * sine(phase + course)])


def phase_in(seconds: Any, goal: Values, size: float) -> jax.Array:
    """Place on the path in some seconds [], turns. Steps have their own time, unless the speed
    is 0."""
    speed = goal["point_speed"]
    turns_a_second = [speed / (2.0 * math.pi * size * fastest) for fastest in FASTEST]
    turns_a_second[STEPS] = (speed > 0.0) / (CORNERS * STEP_SECONDS)
    return goal["phase"] + seconds * _choose(turns_a_second, goal, jnp)


def seconds_at_corner(goal: Values) -> jax.Array:
    """Time since the last step of a point on the path of steps [], s."""
    corners = CORNERS * goal["phase"]
    return (corners - jnp.floor(corners)) * STEP_SECONDS


def markers(goal: dict[str, float], size: float) -> tuple[task.Marker, ...]:
    """A disc at the point, and dots on its path."""
    here = point(goal, np)
    here_from_middle = offset(goal, size, goal["phase"], np)
    phases = np.linspace(0.0, 1.0, 24, endpoint=False)
    dots = here + offset(goal, size, phases, np).T - here_from_middle
    markers = [
        task.Marker(
            "target point",
            position=tuple(here.tolist()),
            size=(0.03, 0.001, 0.0),
            rgba=(0.15, 0.9, 0.3, 0.6),
            shape="cylinder",
        )
    ]
    for i, dot in enumerate(dots.tolist()):
        markers.append(
            task.Marker(
                f"path {i}",
                position=tuple(dot),
                size=(0.004, 0.004, 0.004),
                rgba=(0.15, 0.45, 1.0, 0.7),
            )
        )
    return tuple(markers)


def name(goal: dict[str, float]) -> str:
    """Name of the path."""
    return NAMES[min(int(goal["path"]), len(NAMES) - 1)]


def _choose(values: Any, goal: Values, xp: Any) -> Any:
    """The value that belongs to the goal's path, of one for each path."""
    # Not jnp.select, which is made with argmax: XLA for CPUs aborts where it fuses two of them.
    value, *others = values
    for number, other in enumerate(others, start=1):
        value = xp.where(goal["path"] >= number, other, value)
    return value
