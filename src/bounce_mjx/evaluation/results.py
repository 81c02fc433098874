"""The five expected results: their bounds, and the report that compares an evaluation with them."""

import dataclasses
import math
from typing import Annotated, Any

import jax
import numpy as np
import pydantic
from pydantic import Field, InstanceOf

from bounce_mjx.evaluation.recording import Recording
from bounce_mjx.evaluation.statistics import MAX_APEX_ERROR, MAX_X_ERROR, Statistics
from bounce_mjx.task.env import BounceBall

MIN_CONSECUTIVE_BOUNCES = 3
MIN_EPISODE_SHARE = 0.99
"""Minimum share of episodes with enough consecutive bounces, and of stable episodes."""

MIN_STEP_SHARE = 0.95
"""Minimum share of centred steps, and of accurate bounces."""

UPWARD_SPEED_RANGE = (0.1, 1.5)
"""Bounds of the mean upward speed, m/s."""

UPWARD_SPEED_TARGETS = (0.4, 0.6)
"""Target heights at which the upward speed is judged, m, for a paddle with the home height
`HOME_HEIGHT`; another home height shifts them."""

HOME_HEIGHT = 0.05
"""Home height of the original specification, m."""

MARGIN_EPISODES = 64
"""Number of episodes in a quick evaluation, which a policy should pass as well."""

MARGIN_ERRORS = 2.0
"""Distance from the bound of a result that is met with a margin, for means and shares over steps
and bounces, in standard errors of `MARGIN_EPISODES` episodes."""

MARGIN_FAILURES = 0.5
"""Largest number of failed episodes, as a share of those that the bound allows, in a result that is
met with a margin."""


Figure = Annotated[float, Field(allow_inf_nan=False)] | None
"""A stored measurement; None where there was nothing to measure, such as the height without a
bounce."""


def _complete(details: dict[str, Figure]) -> dict[str, Figure]:
    for name in ("episodes", "mean_consecutive_bounces", "mean_return", "mean_length_s"):
        if details.get(name) is None:
            raise ValueError(f"{name} is missing")
    return {"mean_apex_error_m": None} | details


@dataclasses.dataclass(frozen=True)
class Result:
    """One expected result, as measured."""

    name: str
    measured: str
    """Description of the measured quantity, with its unit."""
    value: Figure
    bound: str
    """The bound in words."""
    passed: bool | None
    """Whether the value meets the bound; None where the bound does not apply."""
    margin: Figure = None
    """How clearly the value meets the bound: 0 at the bound or beyond it, 1 where `MARGIN_EPISODES`
    other episodes should meet it too; None where the bound does not apply."""


@dataclasses.dataclass(frozen=True)
class Report:
    """An evaluation of a policy over many episodes. Only a stored one is validated."""

    results: Annotated[tuple[Result, ...], Field(min_length=1)]
    details: Annotated[dict[str, Figure], pydantic.AfterValidator(_complete)]
    """Further figures: episodes, mean_consecutive_bounces, mean_apex_error_m, mean_return and
    mean_length_s."""
    recording: Annotated[InstanceOf[Recording] | None, Field(exclude=True)] = None
    """The first episodes, if they were recorded; not stored."""
    screening: bool = False
    """Whether these are the few episodes of a screening, which did not pass."""

    @property
    def passed(self) -> bool:
        """Whether no result failed."""
        return all(result.passed is not False for result in self.results)

    @property
    def margin(self) -> float:
        """The smallest margin of a judged result, from 0 to 1."""
        margins = [result.margin or 0.0 for result in self.results if result.passed is not None]
        return min(margins, default=1.0)

    @property
    def passed_with_margin(self) -> bool:
        """Whether `MARGIN_EPISODES` other episodes should pass as well."""
        return self.margin == 1.0

    @property
    def summary(self) -> str:
        """The number of results that are met, such as "4 of 5 results met". A result that is not
        judged does not count."""
        judged = [result.passed for result in self.results if result.passed is not None]
        kind = "results" if len(judged) == len(self.results) else "judged results"
        return f"{sum(judged)} of {len(judged)} {kind} met"

    @property
    def score(self) -> tuple[bool, int, float, float]:
        """Sort key of quality: a full evaluation ranks above a screening, then the number of
        results met counts, then the smallest margin, then the mean return."""
        met = sum(result.passed is not False for result in self.results)
        return not self.screening, met, self.margin, self.details["mean_return"]

    @classmethod
    def from_dict(cls, plain: dict[str, Any]) -> "Report":
        """The inverse of `to_dict`; a pydantic.ValidationError for anything else."""
        return pydantic.TypeAdapter(cls).validate_python(plain)

    def to_dict(self) -> dict[str, Any]:
        """The report as plain data for JSON, with null for a missing figure."""
        return {
            "passed": self.passed,
            "screening": self.screening,
            "results": [dataclasses.asdict(result) for result in self.results],
            "details": self.details,
        }


def judge(
    env: BounceBall,
    statistics: Statistics,
    target_heights: tuple[float, float] | None = None,
) -> Report:
    """The report of an evaluation: the five expected results, from the statistics of E episodes.

    Args:
      target_heights: range of the target heights in these episodes, m; by default, the config's.
    """
    s = jax.tree.map(lambda x: jax.device_get(x).astype(float), statistics)
    episodes = len(s.running)
    enough_bounces = float((s.max_bounces >= MIN_CONSECUTIVE_BOUNCES).mean())
    stable = float(s.running.mean())
    episode_margin = MARGIN_FAILURES * (1.0 - MIN_EPISODE_SHARE)
    results = (
        _share_result(
            "consecutive bounces",
            f"episodes with at least {MIN_CONSECUTIVE_BOUNCES} in a row",
            (enough_bounces, episode_margin),
            MIN_EPISODE_SHARE,
        ),
        _share_result(
            "horizontal position",
            f"steps with |x error| <= {MAX_X_ERROR} m",
            _mean_and_margin(s.centred_steps, s.settled_steps),
            MIN_STEP_SHARE,
        ),
        _share_result(
            "height",
            f"bounces with |apex error| <= {MAX_APEX_ERROR} m",
            _mean_and_margin(s.accurate_bounces, s.settled_bounces),
            MIN_STEP_SHARE,
        ),
        _speed_result(
            _mean_and_margin(s.rising_speed, s.rising_steps),
            target_heights or env.config.target_heights,
            env.config.reward.paddle_home_height,
        ),
        _share_result(
            "stable",
            f"episodes that last the full {env.config.episode_seconds:g} s",
            (stable, episode_margin),
            MIN_EPISODE_SHARE,
        ),
    )
    details = {
        "episodes": float(episodes),
        "mean_consecutive_bounces": float(s.max_bounces.mean()),
        "mean_apex_error_m": _ratio(s.apex_error.sum(), s.settled_bounces.sum()),
        "mean_return": float(s.episode_return.mean()),
        "mean_length_s": float(s.steps.mean() * env.dt),
    }
    return Report(results, details)


def _share_result(
    name: str, measured: str, share_and_margin: tuple[float, float] | None, minimum: float
) -> Result:
    """The result for a share of all episodes, steps or bounces; without any of them it fails."""
    share, margin = share_and_margin or (None, 0.0)
    return Result(
        name,
        f"{measured}, %",
        None if share is None else 100.0 * share,
        f">= {100 * minimum:g}",
        share is not None and share >= minimum,
        0.0 if share is None else _clearness(share - minimum, margin),
    )


def _speed_result(
    speed_and_margin: tuple[float, float] | None,
    target_heights: tuple[float, float],
    home_height: float,
) -> Result:
    """The upward speed, which is judged only if all targets are as high above the paddle's home as
    `UPWARD_SPEED_TARGETS`."""
    low, high = UPWARD_SPEED_RANGE
    bound = f"{low} to {high}"
    # Rounded, as a config has the heights of another arm with four digits.
    lowest, highest = (round(h + home_height - HOME_HEIGHT, 4) for h in UPWARD_SPEED_TARGETS)
    judged = lowest <= target_heights[0] and target_heights[1] <= highest
    speed, margin = speed_and_margin or (None, 0.0)
    passed = speed is not None and low <= speed <= high
    distance = 0.0 if speed is None else min(speed - low, high - speed)
    return Result(
        "upward speed",
        "mean velocity of the rising ball, m/s",
        speed,
        bound if judged else f"{bound} (targets {lowest} to {highest} only)",
        passed if judged else None,
        _clearness(distance, margin) if judged else None,
    )


def _clearness(distance: float, margin: float) -> float:
    """`Result.margin` of a value at a distance inside its bound."""
    if distance <= 0.0:
        return 0.0
    # Rounded, as a number of failed episodes may lie exactly at the margin.
    return min(1.0, round(distance / margin, 9)) if margin else 1.0


def _mean_and_margin(totals: np.ndarray, counts: np.ndarray) -> tuple[float, float] | None:
    """The mean over all steps or bounces of E episodes, and its margin; None without any of them.

    The steps of one episode are alike, so the margin comes from the spread between episodes: the
    standard error of a ratio estimator (W. G. Cochran, Sampling Techniques, 1977, section 2.11).

    Args:
      totals: sum of the quantity in each episode [E].
      counts: number of steps or bounces in each episode [E].
    """
    mean = _ratio(totals.sum(), counts.sum())
    if mean is None:
        return None
    spread = float((totals - mean * counts).std() / counts.mean())
    return mean, MARGIN_ERRORS * spread / math.sqrt(MARGIN_EPISODES)


def _ratio(total: float, count: float) -> float | None:
    """A mean or a share; None where the count is 0."""
    return float(total / count) if count else None
