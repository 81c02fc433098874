"""Figures that rank policies beyond the five results (docs/evaluation.md).

    python benchmarks/rank.py pretrained robust mirror

A row is a policy, or the seeds of one training run: the mean over the seeds and its 95% interval.
The default seed is that of `bounce-mjx eval`, and of the results with which a policy is shipped: to
choose a policy by the table, give another one.
"""

import functools
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from tables import device_name, markdown_table, write

from bounce_mjx.commands.which_policy import MirrorRobot, WhichPolicy
from bounce_mjx.config.command_line import Flag, parse
from bounce_mjx.config.settings import Count, NonNegativeInt
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.evaluation.config import (
    DEFAULT_CONDITION_EPISODES,
    DEFAULT_SEED,
    EvaluationOptions,
    Physics,
    goal_ranges,
    on_engine,
)
from bounce_mjx.evaluation.episodes import begin, reset_episodes, run_until
from bounce_mjx.evaluation.results import episodes_of
from bounce_mjx.evaluation.robustness import ConditionOutcome, measure_conditions
from bounce_mjx.evaluation.suite import load_suite, neutral_goals
from bounce_mjx.learning.policy import Actor, Policy
from bounce_mjx.resources import resource_path
from bounce_mjx.runs.checkpoints import read_actor
from bounce_mjx.runs.folders import Checkpoint, runs_in, runs_of_seeds
from bounce_mjx.task import Episodes, Task, mean_and_margin
from bounce_mjx.task.bounce import Bounce
from bounce_mjx.task.track import Track
from bounce_mjx.training.setup import set_up_jax
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.randomization import RandomizationConfig

MOST_HITS = 10_000
"""Hits after which an episode without a time limit ends."""
MOST_SECONDS = 20_000.0
"""Longest episode without a time limit, s; a ball that rests on the paddle is never lost."""
HIT_EPISODES = 16
"""Episodes without a time limit, of a task that counts hits."""
TIMED_EPISODES = 256
"""Episodes of the usual length, of another task."""
MIN_STABLE = 0.99
"""Share of the episodes that last within a policy's limits."""
LIMITS = {"latency, ms": "action latency", "push, m/s": "push every 2 s"}
"""The figures that are limits, and their perturbations in limits.yaml."""
_DIGITS = {"suite met": ".0f", "latency, ms": ".0f", "hits": ",.0f"}
_RESAMPLES = 10_000

Figures = dict[str, float | None]
"""Figures by their titles; None if there was nothing to measure."""


class RankCommand(WhichPolicy):
    """The command line."""

    policies: Annotated[tuple[Path, ...], Flag(metavar="POLICY ...", is_positional=True)]
    """Rows: a run, a checkpoint, a policy that comes with the package, mirror for the mirror law,
    or a folder whose runs are the seeds of one training run."""
    robot: MirrorRobot = None
    episodes: Count = DEFAULT_CONDITION_EPISODES
    """Episodes in each condition."""
    seed: NonNegativeInt = DEFAULT_SEED
    """Seed of the resets."""
    physics: Physics = "config"
    """Physics engine of the conditions; config is the engine used in training."""
    out: Path = Path("benchmarks/results")
    """Folder for rank.json and rank.md."""


def main() -> None:
    """Runs the command line; each row takes minutes, so it is written as it ends."""
    with exit_on_user_error():
        doc = __doc__.split("\n")[0]
        command = parse(RankCommand, sys.argv[1:], prog="benchmarks/rank.py", description=doc)
        if not command.policies:
            raise UserError("no policy is given; give one, such as pretrained")
        chosen = {
            str(path): [command.choose(run, command.robot) for run in runs_of_row(path)]
            for path in command.policies
        }
        configs = [command.config_of(one, command.robot) for row in chosen.values() for one in row]
        set_up_jax(*(on_engine(config.env, command.physics) for config in configs))
        rows: dict[str, list[Figures]] = {}
        for name, checkpoints in chosen.items():
            rows[name] = [measure(command, checkpoint) for checkpoint in checkpoints]
            record = {
                "device": device_name(),
                "physics": command.physics,
                "episodes": command.episodes,
                "seed": command.seed,
                "rows": rows,
            }
            write(command.out, "rank", record, f"Device: {record['device']}\n\n{table(rows)}")


def runs_of_row(path: Path) -> list[Path]:
    """Runs of a row: those of a run's seeds or in a folder of runs, or the path itself."""
    is_run = (path / "config.yaml").is_file()
    return runs_of_seeds(path) if is_run else runs_in(path) or [path]


def measure(command: RankCommand, checkpoint: Checkpoint) -> Figures:
    """The figures of one policy, in the nominal world where no condition changes it."""
    config = command.config_of(checkpoint, command.robot)
    _, policy, actor = read_actor(checkpoint, config)
    suite = load_suite(resource_path("configs/robustness.yaml"), config.env)
    limits = load_suite(Path(__file__).with_name("limits.yaml"), config.env)
    options = EvaluationOptions(command.episodes, command.seed, command.physics)
    outcomes = measure_conditions(policy, actor, [*suite, *limits], options)
    in_suite = outcomes[: len(suite)]
    in_limits = outcomes[len(suite) :]
    return {
        "suite met": sum(outcome.passed for outcome in in_suite),
        "suite conditions": len(suite),
        **{title: largest_stable(in_limits, name) for title, name in LIMITS.items()},
        **measure_nominal(policy, actor, config.env, command.seed),
    }


def largest_stable(outcomes: Sequence[ConditionOutcome], perturbation: str) -> float:
    """The largest strength of a perturbation up to which the episodes last; 0 if there is none."""
    largest = 0.0
    for outcome in outcomes:
        if outcome.perturbation == perturbation:
            if outcome.lasted < MIN_STABLE:
                break
            largest = outcome.strength
    return largest


def measure_nominal(
    policy: Policy | None, actor: Callable[[Env], Actor], trained: WorldConfig, seed: int
) -> Figures:
    """The task's own figures in the nominal world, and the median of the hits of bouncing: in
    episodes without a time limit, else in episodes of the usual length."""
    env = Env(trained.in_world(RandomizationConfig()))
    goals = neutral_goals(trained)
    ranges = {name: (jnp.array([low]), jnp.array([high])) for name, (low, high) in goals.items()}
    counts_hits = isinstance(env.task, Bounce)
    num_episodes = HIT_EPISODES if counts_hits else TIMED_EPISODES
    reset = jax.jit(lambda key: reset_episodes(env, key, num_episodes, ranges or None))
    now = begin(env, reset(jax.random.PRNGKey(seed)), recorded=0)
    advance = jax.jit(functools.partial(run_until, env, actor(env)))
    figures: Figures = {}
    if counts_hits:
        limit = round(MOST_SECONDS / env.dt)
        step = 0
        are_going_on = True
        while step < limit and are_going_on:
            step = min(step + env.config.episode_steps, limit)
            now = advance(policy, now, step)
            statistics = jax.device_get(now.statistics)
            hits = np.minimum(statistics.tally.sums["hits"].astype(float), MOST_HITS)
            are_going_on = np.any(statistics.running & (hits < MOST_HITS))
        figures["hits"] = float(np.median(hits))
    else:
        now = advance(policy, now, env.config.episode_steps)
        statistics = jax.device_get(now.statistics)
    episodes = episodes_of(statistics, goal_ranges(env.config) | goals)
    return figures | own_figures(env.task, episodes)


def own_figures(task: Task, episodes: Episodes) -> Figures:
    """The root mean square and the mean of apex minus target height, or the error of a fast
    point."""
    if isinstance(task, Track):
        (fast,) = (r.value for r in task.results(episodes) if r.name == "fast error")
        return {"moving point, cm": fast}
    if not isinstance(task, Bounce):
        return {}
    sums = episodes.sums
    bounces = sums["settled_bounces"]
    square, _ = mean_and_margin(sums["apex_error^2"], bounces)
    bias, _ = mean_and_margin(sums["apex_offset"], bounces)
    if square is None:
        return {"apex RMS, cm": None, "apex bias, cm": None}
    return {"apex RMS, cm": 100.0 * math.sqrt(square), "apex bias, cm": 100.0 * bias}


def table(rows: dict[str, list[Figures]]) -> str:
    """The rows in Markdown."""
    titles = dict.fromkeys(title for row in rows.values() for seed in row for title in seed)
    header = ["policy", "seeds", *(title for title in titles if title != "suite conditions")]
    cells = []
    for name, seeds in rows.items():
        values = {
            title: interval([seed.get(title) for seed in seeds], _DIGITS.get(title, ".2f"))
            for title in header[2:]
        }
        values["suite met"] += f" of {seeds[0]['suite conditions']}"
        cells.append([name, str(len(seeds)), *values.values()])
    return markdown_table(header, cells)


def interval(values: Sequence[float | None], spec: str) -> str:
    """The mean and, for several different values, its 95% interval by the percentile bootstrap
    (Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", 2021).
    """
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    mean = f"{np.mean(known):{spec}}"
    if min(known) == max(known):
        return mean
    drawn = np.random.default_rng(0).choice(known, (_RESAMPLES, len(known))).mean(axis=1)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return f"{mean} ({low:{spec}} to {high:{spec}})"


if __name__ == "__main__":
    main()
