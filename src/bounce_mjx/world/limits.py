"""What ends an episode by where a ball is, as data: the end of a step, the heights that a target
may have, and the starts that a config may have follow from the same limits."""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from bounce_mjx.errors import UserError

if TYPE_CHECKING:
    import jax

Kind = Literal["lowest", "below", "above", "distance", "aside"]
"""What a limit bounds: the ball's height in the world (lowest); how far it is below the target,
above it, or away from it; or |x| and |y| in the world (aside)."""

_WORDS: dict[Kind, str] = {
    "lowest": "lower than {name} ({value:.4g} m)",
    "below": "{name} ({value:.4g} m) below it",
    "above": "{name} ({value:.4g} m) above it",
    "distance": "farther than {name} ({value:.4g} m) from it",
    "aside": "beyond {name} ({value:.4g} m) along x or y",
}


class Limit(NamedTuple):
    """One limit of a ball's position, beyond which the episode ends."""

    name: str
    """The setting or the constant that gives it, for an error."""
    kind: Kind
    value: float
    """m."""


Limits = tuple[Limit, ...]


def is_beyond(limits: Limits, ball: Any, target: Any = None) -> jax.Array:
    """Whether a ball is beyond one of the limits [...], bool; for NumPy's arrays and JAX's.

    Args:
      limits: at least one.
      ball: position [..., 3], m.
      target: position [..., 3] of what the limits are relative to, m; None if none is.
    """
    ball_coordinates = _coordinates(ball)
    target_coordinates = None if target is None else _coordinates(target)
    exceeded = [_is_beyond(limit, ball_coordinates, target_coordinates) for limit in limits]
    return functools.reduce(operator.or_, exceeded)


def _coordinates(position: Any) -> tuple[Any, Any, Any]:
    return position[..., 0], position[..., 1], position[..., 2]


def _is_beyond(limit: Limit, ball: Sequence[Any], target: Sequence[Any] | None) -> Any:
    """Of coordinates, which are numbers or arrays."""
    x, y, z = ball
    value = limit.value
    if limit.kind == "lowest":
        return z < value
    if limit.kind == "aside":
        return (abs(x) > value) | (abs(y) > value)
    target_x, target_y, target_z = target
    if limit.kind == "above":
        return z > target_z + value
    if limit.kind == "below":
        return z - target_z < -value
    aside = (x - target_x) ** 2 + (y - target_y) ** 2
    return aside + (z - target_z) ** 2 > value**2


class HeightLimits(NamedTuple):
    """The heights that a target may have."""

    least: float
    """m."""
    greatest: float
    """m."""
    reason: str
    """The limits from which they follow, for an error."""

    def within(self, low: float, high: float) -> tuple[float, float]:
        """The part of a range of heights that is within them, m."""
        return max(self.least, low), min(self.greatest, high)


def target_heights(
    limits: Limits, min_flight: float = 0.0, start: float | None = None, sway: float = 0.0
) -> HeightLimits:
    """The heights of a target at which no limit ends the episode of a ball that does what it
    should: it starts at its start, and flies between the lowest place and the target.

    Args:
      limits: the ball's; one of the kind lowest among them, and at most one of each other kind.
      min_flight: least height of the target over the lowest place, m.
      start: height at which the ball starts, m; None for a start that follows from the target.
      sway: how far the target moves up and down by itself, to each side, m: a user may set it at
        any place of its sway.
    """
    lowest = max((limit for limit in limits if limit.kind == "lowest"), key=lambda x: x.value)
    least = lowest.value + min_flight
    greatest = float("inf")
    least_by = lowest
    greatest_by = None
    for limit in limits:
        if limit.kind == "distance":
            greatest = lowest.value + limit.value - 2.0 * sway
            greatest_by = limit
        elif limit.kind == "above" and start is not None and start - limit.value > least:
            least = start - limit.value
            least_by = limit
    words = []
    for limit in limits:
        if limit in (least_by, greatest_by):
            words.append(_WORDS[limit.kind].format(**limit._asdict()))
    reason = f"as an episode ends with a ball {' or '.join(words)}"
    if least_by.kind == "above":
        reason += f", and a ball starts at {start:.4g} m"
    return HeightLimits(least, greatest, reason)


def check_within(limits: Limits, starts: Any, targets: Any, setting: str) -> None:
    """Refuses a start of a ball with which the episode ends at once.

    Args:
      limits: the ball's.
      starts: positions of balls [N, 3], m.
      targets: positions of what the limits are relative to [M, 3], m.
      setting: what gives the starts, for the error.

    Raises:
      UserError: one of the starts is beyond one of the limits, for one of the targets.
    """
    for limit in limits:
        for start in starts:
            if any(_is_beyond(limit, start, target) for target in targets):
                position = ", ".join(f"{coordinate:.4g}" for coordinate in start)
                raise UserError(
                    f"{limit.name} is {limit.value:.4g} m, so an episode ends where it starts, at "
                    f"the {setting} ({position}); change one of the two"
                )
