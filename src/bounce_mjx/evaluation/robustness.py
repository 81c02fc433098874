"""Robustness of a policy: its results in every condition of a suite."""

import json
import os
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Annotated, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pydantic
from pydantic import Field

from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.c_episodes import make_mujoco_evaluator
from bounce_mjx.evaluation.config import EvaluationOptions, Physics, goal_ranges, on_engine
from bounce_mjx.evaluation.episodes import make_evaluator
from bounce_mjx.evaluation.policy_evaluation import EpisodeSetup, InEvaluation
from bounce_mjx.evaluation.results import is_share, judge
from bounce_mjx.evaluation.statistics import Statistics
from bounce_mjx.evaluation.suite import Condition, condition_label
from bounce_mjx.learning.policy import Actor, Policy
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.randomization import TERMS, RandomizationConfig, Ranges

# Terms without a neutral value (the first two; `suite` has one for each interval), or with a high
# cost in the physics: only the conditions that need such a term are simulated with it. Dry friction
# also puts MuJoCo's C engine in the place of MJX.
_SEPARATE_TERMS = frozenset(
    ("camera_rate", "torque_limit", "contact_friction", "joint_frictionloss")
)
# Episodes in one call: larger batches are not faster and would delay the progress report.
_CPU_BATCH = 1024
_GPU_BATCH = 16_384
_MUJOCO_BATCH_PER_CORE = 128


class ConditionOutcome(pydantic.BaseModel):
    """Results of a policy in one condition."""

    perturbation: str
    group: str
    unit: str
    strength: float | None
    trained: bool
    """Whether the training ranges of the policy contain the condition."""
    physics: Literal["fused", "mjx", "mujoco"]
    """Name of the engine."""
    values: Annotated[dict[str, float | None], Field(min_length=1)]
    """The results by name; None if there was nothing to measure."""
    failed: list[str]
    """Names of results that miss their bounds."""
    lasted: float
    """Share of the episodes that lasted until their time limit."""
    mean_length_s: float
    """Mean length of the episodes, s."""
    lost: list[int] = []
    """Numbers of the episodes that ended before their time limit. A number means the same keys in
    all conditions, and the same draws in those that share a program."""
    measured: Annotated[dict[str, str], Field(exclude=True)] = {}
    """What each result measures, with its unit; not stored."""

    @property
    def label(self) -> str:
        """Its perturbation and strength, such as "action latency 20 ms"."""
        return condition_label(self.perturbation, self.strength, self.unit)

    @property
    def passed(self) -> bool:
        """Whether every judged result meets its bound."""
        return not self.failed


class RobustnessReport(pydantic.BaseModel):
    """Results of a policy in all conditions: the content of `robustness.json`."""

    checkpoint: str
    steps: int
    """Number of environment steps in the policy's training."""
    suite: str
    version: str = ""
    """Version of the suite."""
    episodes: int
    """Number of episodes in each condition."""
    seed: int
    measured: dict[str, str] = {}
    """What each result measures, with its unit."""
    outcomes: Annotated[list[ConditionOutcome], Field(min_length=1)]

    @property
    def passed(self) -> bool:
        """Whether all conditions meet all judged results."""
        return all(outcome.passed for outcome in self.outcomes)

    @property
    def met(self) -> int:
        """Number of conditions that meet all judged results: the score."""
        return sum(outcome.passed for outcome in self.outcomes)

    def worst_share(self, outcome: ConditionOutcome) -> float:
        """Lowest of a condition's results that are shares, from 0 to 1; the share of the episodes
        that last if none is known to be one."""
        shares = []
        for name, value in outcome.values.items():
            if value is not None and is_share(self.measured.get(name, "")):
                shares.append(value)
        return min(shares, default=100.0 * outcome.lasted) / 100.0


def measure_conditions(
    policy: Policy | None,
    actor: Callable[[Env], Actor],
    conditions: Sequence[Condition],
    options: EvaluationOptions,
    progress: Callable[[int], None] = lambda done: None,
) -> list[ConditionOutcome]:
    """Measures the results of a deterministic policy, in the order of the conditions.

    One compiled program simulates all conditions with the same structure; their ranges are its
    inputs. The episodes of all conditions start from the same keys. MuJoCo's C engine simulates
    conditions with dry friction in place of the mjx engine, which refuses it.

    Args:
      actor: what acts with the policy, such as the networks of its training (`networks_of`).
      options: the number of episodes in each condition, their seed and the engine; a condition has
        its own world and goals.
      progress: callback for the number of finished conditions.

    Raises:
      UserError: the engine does not support the model.
    """
    outcomes: list[ConditionOutcome | None] = [None] * len(conditions)
    key = jax.random.PRNGKey(options.seed)
    done = 0
    for indices in _programs(conditions):
        members = [conditions[index] for index in indices]
        program = _program(members, options.physics)
        env = program.env
        size = _batch_size(program, len(members), options.episodes)
        make = make_mujoco_evaluator if program.on_c else make_evaluator
        evaluate = make(env, actor(env), size * options.episodes)
        for start in range(0, len(members), size):
            batch = members[start : start + size]
            ranges = _stack_ranges(program.inputs, _padded(batch, size))
            statistics, _ = evaluate(policy, key, ranges)
            for place, condition in enumerate(batch):
                its = slice(place * options.episodes, (place + 1) * options.episodes)
                part = jax.tree.map(lambda figure, its=its: figure[its], statistics)
                outcomes[indices[start + place]] = _outcome(program, condition, part)
            done += len(batch)
            progress(done)
    return outcomes


def find_episode(
    conditions: Sequence[Condition], index: int, options: EvaluationOptions, episode: int
) -> InEvaluation:
    """Where `measure_conditions` simulates an episode of one of the conditions.

    Raises:
      UserError: MuJoCo's C engine simulates the condition: the options ask for it, or its program
        has dry friction in MJX.
    """
    condition = conditions[index]
    (indices,) = [program for program in _programs(conditions) if index in program]
    members = [conditions[member] for member in indices]
    program = _program(members, options.physics)
    if program.on_c:
        raise UserError(
            f"the condition {condition.label} is simulated on MuJoCo's C engine, which has no "
            "films; choose another condition"
        )
    size = _batch_size(program, len(members), options.episodes)
    place = indices.index(index)
    start = place // size * size
    ranges = _stack_ranges(program.inputs, _padded(members[start : start + size], size))
    return InEvaluation(
        setup=EpisodeSetup(program.env, condition.goals, ranges),
        episodes=size * options.episodes,
        episode=(place - start) * options.episodes + episode,
    )


def _programs(conditions: Sequence[Condition]) -> list[list[int]]:
    """The indices of the conditions that share a compiled program, for each program."""
    programs = defaultdict(list)
    for index, condition in enumerate(conditions):
        key = json.dumps(condition.env.model_dump(mode="json"))
        programs[key, _SEPARATE_TERMS.intersection(condition.ranges)].append(index)
    return [*programs.values()]


class _Program(NamedTuple):
    """What simulates conditions of one structure."""

    env: Env
    inputs: list[str]
    """Names of the terms and the goals whose ranges are inputs."""
    on_c: bool
    """Whether MuJoCo's C engine simulates all of them."""


def _program(members: Sequence[Condition], physics: Physics) -> _Program:
    """The program of all conditions that share it."""
    env = Env(_spanning_config(members, physics))
    is_dry = any("joint_frictionloss" in condition.ranges for condition in members)
    on_c = physics == "mujoco" or (env.engine.name == "mjx" and is_dry)
    # Of the goals, those for which a condition has another range than the config.
    changed = []
    for name, ends in goal_ranges(env.config).items():
        if any(condition.goals[name] != ends for condition in members):
            changed.append(name)
    return _Program(env, [*env.config.randomization.terms, *changed], on_c)


def _padded(batch: list[Condition], size: int) -> list[Condition]:
    """The conditions of a call. Padding the last one with a repeated condition avoids compiling
    another shape."""
    return batch + [batch[-1]] * (size - len(batch))


def _outcome(program: _Program, condition: Condition, statistics: Statistics) -> ConditionOutcome:
    """The outcome of a condition, from the statistics of its own episodes."""
    # What a task judges may depend on the world, and the program's spans several. Its geometry is
    # that of the settings, which all of them share.
    task = condition.config.task(condition.config)
    task.geometry = program.env.task.geometry
    report = judge(program.env, statistics, goals=condition.goals, task=task)
    return ConditionOutcome(
        perturbation=condition.perturbation.name,
        group=condition.perturbation.group,
        unit=condition.perturbation.unit,
        strength=condition.strength,
        trained=condition.trained,
        physics="mujoco" if program.on_c else program.env.engine.name,
        values={result.name: result.value for result in report.results},
        failed=[result.name for result in report.results if result.passed is False],
        lasted=float(np.mean(statistics.running)),
        lost=np.flatnonzero(~np.asarray(statistics.running, bool)).tolist(),
        mean_length_s=report.details["mean_length_s"],
        measured={result.name: result.measured for result in report.results},
    )


def _spanning_config(conditions: Sequence[Condition], physics: Physics) -> WorldConfig:
    """Config with all terms of the conditions active, in ranges that contain all their ranges."""
    perturbed = TERMS.keys() & {name for condition in conditions for name in condition.ranges}
    spans = {}
    for name in sorted(perturbed):
        lows, highs = zip(*(condition.range(name) for condition in conditions), strict=True)
        spans[name] = _end(np.min(lows, axis=0)), _end(np.max(highs, axis=0))
    # Not validated: a neutral value, such as an interval of 1e9 s, may lie beyond a term's limits.
    sampled = RandomizationConfig().model_copy(update=spans)
    world = conditions[0].env.model_copy(update={"randomization": sampled})
    return on_engine(world, physics)


def _end(numbers: np.ndarray) -> float | tuple[float, ...]:
    """An end of a term's range as a config has it."""
    return tuple(numbers.tolist()) if numbers.ndim else float(numbers)


def _stack_ranges(names: Sequence[str], conditions: Sequence[Condition]) -> Ranges | None:
    """Ranges of C conditions, each end [C, ...]; None without names."""
    if not names:
        return None
    of_conditions = [{name: condition.range(name) for name in names} for condition in conditions]
    return jax.tree.map(lambda *ends: jnp.asarray(np.stack(ends), jnp.float32), *of_conditions)


def _batch_size(program: _Program, conditions: int, episodes: int) -> int:
    """Number of conditions in one call; calls have about equal sizes."""
    if not program.inputs:
        # Without ranges, the episodes of a call all have different keys (`reset_episodes`).
        return 1
    if program.on_c:
        batch = _MUJOCO_BATCH_PER_CORE * (os.cpu_count() or 1)
    elif jax.default_backend() == "cpu":
        batch = _CPU_BATCH
    else:
        batch = _GPU_BATCH
    calls = -(-conditions // max(1, batch // episodes))
    return -(-conditions // calls)
