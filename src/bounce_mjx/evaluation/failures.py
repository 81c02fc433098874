"""The episodes of an evaluation that failed: what failed, when and in which world; the terms of the
world that go with failure; and a film of one."""

import math
from typing import NamedTuple

import jax
import numpy as np

from bounce_mjx.env.env import Env
from bounce_mjx.evaluation.config import goal_ranges
from bounce_mjx.evaluation.episodes import make_filmer
from bounce_mjx.evaluation.policy_evaluation import EpisodeSetup
from bounce_mjx.evaluation.results import episodes_of, is_share
from bounce_mjx.evaluation.statistics import Statistics
from bounce_mjx.learning.policy import Actor, Policy
from bounce_mjx.task.task import Recording

# Quantile of the normal distribution for 95% intervals.
_Z = 1.959964
# Of each of `ENDS`.
_CAUSES = {"too_fast": "a joint too fast", "non_finite": "the physics"}


class Failure(NamedTuple):
    """An episode that ended early, or that misses a result which is a share."""

    episode: int
    """Its number, from 0."""
    seconds: float
    """Its length, s."""
    lasted: bool
    """Whether it lasted until its time limit."""
    failed: tuple[str, ...]
    """Why it ended early, and the results that its own figures miss."""
    goal: dict[str, float]
    """First value of each goal."""
    world: dict[str, float | list[float]]
    """Values of the active terms of the randomisation."""


class Third(NamedTuple):
    """Episodes whose value of a term is in one third of the range of the values that occurred."""

    low: float
    high: float
    episodes: int
    failed: int
    interval: tuple[float, float]
    """Wilson's 95% interval of the share that fails."""


class Association(NamedTuple):
    """How failure goes with a term of the world, or with a goal."""

    name: str
    thirds: tuple[Third, ...]

    @property
    def is_clear(self) -> bool:
        """Whether the intervals of two thirds are apart."""
        highest = max(third.interval[0] for third in self.thirds)
        return highest > min(third.interval[1] for third in self.thirds)

    @property
    def difference(self) -> float:
        """Difference of the largest and the smallest share that fails."""
        shares = [third.failed / third.episodes for third in self.thirds if third.episodes]
        return max(shares) - min(shares) if shares else 0.0


def failures_of(setup: EpisodeSetup, statistics: Statistics) -> list[Failure]:
    """The failed episodes of an evaluation, each judged alone: one that lasts may miss a result
    that all together meet."""
    env = setup.env
    goals = goal_ranges(env.config) | setup.goals
    s = jax.tree.map(np.asarray, statistics)
    found = []
    for i in range(len(s.running)):
        alone = jax.tree.map(lambda figure, i=i: figure[i : i + 1], s)
        results = env.task.results(episodes_of(alone, goals))
        # A mean over all episodes says nothing of one of them.
        shares = [result for result in results if is_share(result.measured)]
        missed = [result for result in shares if result.passed is False]
        lasted = bool(s.running[i])
        if not lasted:
            # One that ended before there was something to measure did not miss that.
            missed = [result for result in missed if result.value is not None]
        failed = [result.name for result in missed]
        if not lasted:
            failed.insert(0, _cause(s.ended_by, i))
        if failed:
            goal = {name: float(values[i]) for name, values in s.goal.items()}
            world = {name: values[i].astype(float).tolist() for name, values in s.world.items()}
            failure = Failure(
                episode=i,
                seconds=float(s.steps[i]) * env.dt,
                lasted=lasted,
                failed=tuple(failed),
                goal=goal,
                world=world,
            )
            found.append(failure)
    return found


def _cause(ended_by: dict[str, np.ndarray], index: int) -> str:
    """Why an episode ended early, in words; of two causes at once, the first by name."""
    causes = [_CAUSES[name] for name, ended in ended_by.items() if ended[index]]
    return causes[0] if causes else "ended by the task"


def associations(statistics: Statistics, failures: list[Failure]) -> list[Association]:
    """The share of failures by third of the range of each goal and each entry of each term; the
    clear ones first, then the largest difference."""
    s = jax.tree.map(np.asarray, statistics)
    has_failed = np.zeros(len(s.running), bool)
    has_failed[[failure.episode for failure in failures]] = True
    columns = dict(s.goal)
    for name, values in s.world.items():
        entries = values.reshape(len(values), -1)
        for i, entry in enumerate(entries.T):
            columns[f"{name}[{i}]" if entries.shape[1] > 1 else name] = entry
    found = []
    for name, values in columns.items():
        # One that does not vary goes with nothing.
        if np.ptp(values) > 0.0:
            found.append(Association(name, _thirds(values.astype(float), has_failed)))
    return sorted(found, key=lambda one: (-one.is_clear, -one.difference))


def _thirds(values: np.ndarray, has_failed: np.ndarray) -> tuple[Third, ...]:
    """The failures in the thirds of the range of values [E]."""
    ends = np.linspace(values.min(), values.max(), 4)
    # The greatest value is in the last third.
    third = np.minimum(np.searchsorted(ends, values, "right") - 1, 2)
    thirds = []
    for i in range(3):
        is_in = third == i
        episodes = int(np.sum(is_in))
        failed = int(np.sum(has_failed[is_in]))
        thirds.append(
            Third(
                low=float(ends[i]),
                high=float(ends[i + 1]),
                episodes=episodes,
                failed=failed,
                interval=wilson_interval(failed, episodes),
            )
        )
    return tuple(thirds)


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """The 95% interval of a share by E. B. Wilson, "Probable inference, the law of succession, and
    statistical inference", 1927; (0, 1) without trials."""
    if not trials:
        return 0.0, 1.0
    share = successes / trials
    square = _Z**2
    centre = share + square / (2.0 * trials)
    half = _Z * math.sqrt((share * (1.0 - share) + square / (4.0 * trials)) / trials)
    whole = 1.0 + square / trials
    return max(0.0, (centre - half) / whole), min(1.0, (centre + half) / whole)


class Film(NamedTuple):
    """One episode of an evaluation."""

    env: Env
    recording: Recording
    """Of this episode alone [T, ..., 1]."""
    statistics: Statistics
    """Of this episode [1]."""


def film_episode(
    setup: EpisodeSetup,
    actor: Actor,
    policy: Policy | None,
    episodes: int,
    seed: int,
    episode: int,
) -> Film:
    """Simulates one episode of an evaluation again, as it was (`make_filmer`).

    Args:
      episodes: number of the evaluation's episodes.
      seed: of the evaluation's resets.
      episode: its number, from 0.
    """
    run = make_filmer(setup.env, actor, episodes, episode)
    measured = run(policy, jax.random.PRNGKey(seed), setup.ranges)
    statistics, recording = jax.device_get(measured)
    return Film(setup.env, recording, statistics)
