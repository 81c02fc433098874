"""What judges a policy: results with bounds, from figures of many episodes."""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated, NamedTuple

from pydantic import Field

from bounce_mjx.errors import UserError
from bounce_mjx.lazy import np

MARGIN_EPISODES = 64
"""Number of episodes in a quick evaluation, which a policy should pass as well."""

MARGIN_ERRORS = 2.0
"""Distance from the bound of a result that is met with a margin, for means and shares over steps
and events, in standard errors of `MARGIN_EPISODES` episodes."""

MARGIN_FAILURES = 0.5
"""Largest number of failed episodes, as a share of those that the bound allows, in a result that is
met with a margin."""

_TAKEN_NAMES = ("steps", "passed", "screening")

Figure = Annotated[float, Field(allow_inf_nan=False)] | None
"""A measurement; None where there was nothing to measure, such as the height without a bounce."""


class Episodes(NamedTuple):
    """Figures of E episodes, each up to its end, as NumPy arrays [E]."""

    sums: dict[str, np.ndarray]
    """Sums over the steps of what `Task.tally` gave."""
    maxima: dict[str, np.ndarray]
    """Greatest values over the steps of what `Task.tally` gave."""
    lasted: np.ndarray
    """Whether the episode lasted until its time limit, bool."""
    goals: dict[str, tuple[float, float]]
    """The range of each goal in these episodes."""


@dataclasses.dataclass(frozen=True)
class Result:
    """One expected result, as measured."""

    name: str
    measured: str
    """Description of the measured quantity, with its unit at the end. One in % is a share of
    episodes, steps or events, by which an episode alone can be judged too."""
    value: Figure
    bound: str
    """The bound in words."""
    passed: bool | None
    """Whether the value meets the bound; None where the bound does not apply."""
    margin: Figure = None
    """How clearly the value meets the bound: 0 at the bound or beyond it, 1 where `MARGIN_EPISODES`
    other episodes should meet it too; None where the bound does not apply."""

    def __post_init__(self) -> None:
        if self.name in _TAKEN_NAMES:
            raise UserError(
                f"a result of the task has the name {self.name!r}, which a run's record needs for "
                "itself; choose another name"
            )


def share_of_episodes(name: str, measured: str, met: np.ndarray, least: float) -> Result:
    """The result for the share of the episodes that meet a condition.

    Args:
      name: of the result.
      measured: description of the measured quantity.
      met: whether each episode meets the condition [E], bool.
      least: least share, from 0 to 1; 1 leaves no room for a margin, so that a training that stops
        when solved waits for one in vain (`runs.progress.PATIENCE`).

    Raises:
      UserError: the least share is not from 0 to 1.
    """
    _check_share(name, least)
    share = float(met.mean())
    return Result(
        name=name,
        measured=_in_percent(measured),
        value=100.0 * share,
        bound=f">= {100 * least:g}",
        passed=share >= least,
        margin=_clearness(share - least, MARGIN_FAILURES * (1.0 - least)),
    )


def share_of_events(
    name: str, measured: str, met: np.ndarray, events: np.ndarray, least: float
) -> Result:
    """The result for the share of steps or events that meet a condition, at least `least`; without
    any it fails.

    Args:
      name: of the result.
      measured: description of the measured quantity.
      met: number that meet the condition in each episode [E].
      events: number of all in each episode [E].
      least: least share, from 0 to 1.

    Raises:
      UserError: the least share is not from 0 to 1.
    """
    _check_share(name, least)
    share = mean_of_events(name, _in_percent(measured), met, events, (least, math.inf))
    percentage = None if share.value is None else 100.0 * share.value
    return dataclasses.replace(share, value=percentage, bound=f">= {100 * least:g}")


def mean_of_events(
    name: str,
    measured: str,
    totals: np.ndarray,
    events: np.ndarray,
    bounds: tuple[float, float],
    condition: str = "",
) -> Result:
    """The result for a mean over steps or events, between two bounds; without any it fails.

    Args:
      name: of the result.
      measured: description of the measured quantity, with its unit.
      totals: sum of the quantity in each episode [E].
      events: number of steps or events in each episode [E].
      bounds: least and greatest mean, of which one may be infinite.
      condition: the condition that the bounds need and that does not hold, in words; "" where the
        bounds judge.

    Raises:
      UserError: no mean could lie between the bounds.
    """
    low, high = bounds
    if not low <= high:
        raise UserError(
            f"the result {name} has the bounds {low:g} and {high:g}; give the lower one first"
        )
    mean, margin = mean_and_margin(totals, events)
    if math.isinf(low):
        bound = f"<= {high:g}"
    elif math.isinf(high):
        bound = f">= {low:g}"
    else:
        bound = f"{low} to {high}"
    if condition:
        return Result(name, measured, mean, f"{bound} ({condition})", None)
    distance = -1.0 if mean is None else min(mean - low, high - mean)
    return Result(name, measured, mean, bound, distance >= 0.0, _clearness(distance, margin))


def root_mean_square(
    name: str, measured: str, squares: np.ndarray, events: np.ndarray, most: float
) -> Result:
    """The result for the root of a mean square over steps or events, at most `most`; without any it
    fails.

    Args:
      name: of the result.
      measured: description of the measured quantity, with its unit.
      squares: sum of the squared quantity in each episode [E].
      events: number of steps or events in each episode [E].
      most: greatest root of the mean square.
    """
    mean_square = mean_of_events(name, measured, squares, events, (-math.inf, most**2))
    root = None if mean_square.value is None else math.sqrt(mean_square.value)
    return dataclasses.replace(mean_square, value=root, bound=f"<= {most:g}")


def mean_and_margin(totals: np.ndarray, events: np.ndarray) -> tuple[float | None, float]:
    """The mean over all steps or events of E episodes, and its margin; None without any.

    The steps of one episode are alike, so the margin comes from the spread between episodes: the
    standard error of a ratio estimator (W. G. Cochran, Sampling Techniques, 1977, section 2.11).
    """
    count = events.sum()
    if not count:
        return None, 0.0
    mean = float(totals.sum() / count)
    spread = float((totals - mean * events).std() / events.mean())
    return mean, MARGIN_ERRORS * spread / math.sqrt(MARGIN_EPISODES)


def _in_percent(measured: str) -> str:
    """A description of a share with its unit at the end, also where it has that already."""
    return f"{measured.removesuffix('%').rstrip(' ,')}, %"


def _check_share(name: str, least: float) -> None:
    """Refuses a least share that is not from 0 to 1, such as one in %."""
    if not 0.0 <= least <= 1.0:
        raise UserError(
            f"the result {name} has the least share {least:g}; give one from 0 to 1, such as 0.95 "
            "for 95 %"
        )


def _clearness(distance: float, margin: float) -> float:
    """`Result.margin` of a value at a distance inside its bound."""
    if distance <= 0.0:
        return 0.0
    # Rounded, as a number of failed episodes may lie exactly at the margin.
    return min(1.0, round(distance / margin, 9)) if margin else 1.0
