"""The report of an evaluation: the task's expected results, and further figures."""

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any

import jax
import numpy as np
from pydantic import Field, InstanceOf

from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError, shorten
from bounce_mjx.evaluation.config import goal_ranges
from bounce_mjx.evaluation.statistics import Statistics
from bounce_mjx.task.results import Episodes, Figure, Result
from bounce_mjx.task.task import Recording, Task


@dataclasses.dataclass(frozen=True)
class Report:
    """An evaluation of a policy over many episodes."""

    results: Annotated[tuple[Result, ...], Field(min_length=1)]
    details: dict[str, Figure]
    """Further figures: episodes, the task's own, mean_return and mean_length_s."""
    recording: Annotated[InstanceOf[Recording] | None, Field(exclude=True)] = None
    """The first episodes, if they were recorded; not stored."""
    screening: bool = False
    """Whether these are the few episodes of a screening, after which the evaluation ended, as the
    policy could not become the best, whether they pass or not."""

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
        results not missed counts, then the smallest margin, then the mean return."""
        met = sum(result.passed is not False for result in self.results)
        return not self.screening, met, self.margin, self.details["mean_return"]

    @property
    def merit(self) -> str:
        """What makes this evaluation the best of a training, in words (`score`)."""
        if not self.passed:
            return "the most results met, then the highest return"
        if self.passed_with_margin:
            return "a margin in all results, then the highest return"
        judged = [result for result in self.results if result.passed is not None]
        tightest = min(judged, key=lambda result: result.margin or 0.0)
        return f"the largest margin (its tightest: {tightest.name})"

    def to_dict(self) -> dict[str, Any]:
        """The report as plain data for JSON, with null for a missing figure."""
        return {
            "passed": self.passed,
            "screening": self.screening,
            "results": [dataclasses.asdict(result) for result in self.results],
            "details": self.details,
        }


def is_share(measured: str) -> bool:
    """Whether a result is a share of episodes, steps or events, from what it measures
    (`Result.measured`)."""
    return measured.endswith("%")


def episodes_of(statistics: Statistics, goals: dict[str, tuple[float, float]]) -> Episodes:
    """Statistics of E episodes as a task judges them: NumPy arrays, the figures in float64.

    Args:
      goals: range of each goal in these episodes.
    """
    tally = jax.tree.map(lambda figure: np.asarray(figure, np.float64), statistics.tally)
    return Episodes(tally.sums, tally.maxima, np.asarray(statistics.running), goals)


def judge(
    env: Env,
    statistics: Statistics,
    recording: Recording | None = None,
    goals: dict[str, tuple[float, float]] | None = None,
    task: Task | None = None,
) -> Report:
    """The report of an evaluation, from the statistics of E episodes.

    Args:
      recording: of the first episodes.
      goals: ranges of goals in these episodes, where they are not the config's.
      task: the task with the settings of these episodes, where they are not the environment's.

    Raises:
      UserError: the task gives no results, two of one name, or a detail that is not one number.
    """
    task = task or env.task
    measured = jax.device_get(statistics)
    episodes = episodes_of(measured, goal_ranges(env.config) | (goals or {}))
    results = task.results(episodes)
    task_details = task.details(episodes)
    _check_results(results, task)
    _check_details(task_details, task)
    details = {
        "episodes": float(len(measured.running)),
        **task_details,
        "mean_return": float(measured.episode_return.astype(float).mean()),
        "mean_length_s": float(measured.steps.astype(float).mean() * env.dt),
    }
    return Report(tuple(results), details, jax.device_get(recording))


def _check_results(results: Any, task: Task) -> None:
    """Refuses results by which nothing is judged, or of which one would take another's place."""
    code = f"results of the task {type(task).__name__}"
    is_sequence = isinstance(results, tuple | list)
    if not is_sequence or not all(isinstance(result, Result) for result in results):
        raise UserError(
            f"{code} returns {shorten(repr(results))}; return a tuple of task.Result, such as "
            "(task.share_of_episodes(...),)"
        )
    if not results:
        raise UserError(f"{code} returns none, by which nothing is judged; return at least one")
    names = [result.name for result in results]
    for name in names:
        if names.count(name) > 1:
            raise UserError(
                f"{code} returns {names.count(name)} of the name {name!r}; give each its own name"
            )


def _check_details(details: Any, task: Task) -> None:
    """Refuses further figures that are not one number each."""
    code = f"details of the task {type(task).__name__}"
    if not isinstance(details, Mapping):
        raise UserError(
            f"{code} returns {shorten(repr(details))}; return a dictionary of one number for each "
            "name"
        )
    for name, figure in details.items():
        if np.ndim(figure) != 0:
            raise UserError(
                f"{code} returns an array of the shape {np.shape(figure)} for {name}; return one "
                "number of all episodes, such as its mean"
            )
