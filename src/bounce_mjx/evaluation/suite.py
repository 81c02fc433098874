"""Suites of perturbations: the conditions of a robustness report, from a YAML file.

`configs/robustness.yaml` explains the format.
"""

import functools
import math
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import mujoco
import numpy as np
from pydantic import Field

from bounce_mjx.config.files import differing_keys, read_mapping
from bounce_mjx.config.settings import Finite, StrictModel, merged, nested
from bounce_mjx.config.validation import validate
from bounce_mjx.env.checks import check_starts
from bounce_mjx.errors import UserError, shorten, warn_once
from bounce_mjx.evaluation.config import goal_ranges
from bounce_mjx.physics.edited import NO_PAIR
from bounce_mjx.robot.model import Addresses, find_addresses
from bounce_mjx.task.registry import find_task
from bounce_mjx.world.actuation import DEFAULT_PUSH_INTERVAL
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.model import model_nominals, world_model
from bounce_mjx.world.randomization import MODEL, TERMS, RandomizationConfig

_CONFIG_UNITS = "factor", "s", "Hz", "m", "m/s", "1/m", "rad", "rad/s", "kg", "N m", "N m s/rad"
UNITS = dict.fromkeys(("", *_CONFIG_UNITS), 1.0) | {
    "%": 0.01,
    "ms": 1e-3,
    "cm": 1e-2,
    "mm": 1e-3,
    "deg": math.radians(1.0),
}
"""Units of strengths, and the factors that convert them to the units of the config."""

NOMINAL = "nominal"
"""Name of the condition without perturbation, which is always measured."""

_SIGNS = {"strength": 1.0, "-strength": -1.0}
# Neutral values of terms that have none in `TERMS`: goals that never change, and pushes that
# come at any interval, as their neutral speed is 0, s.
_INTERVALS = {"goal_interval": 1e9, "push_interval": DEFAULT_PUSH_INTERVAL}

Bounds = tuple[np.ndarray, np.ndarray]


class Perturbation(StrictModel):
    """One change of the world, at several strengths."""

    name: str = ""
    group: str = "others"
    """Heading in the figure and in the table."""
    unit: Literal[tuple(UNITS)] = ""
    """Unit of the strengths."""
    strengths: tuple[Finite, ...] = ()
    task: str | None = None
    """Name of the task that it is for; by default, it is for all."""
    terms: dict[str, Any] = {}
    """Values for terms of `env.randomization` and for goals of the task: see
    `configs/robustness.yaml`."""
    settings: dict[str, Any] = {}
    """New values for settings of `env`, by dotted names."""
    trained_ranges: bool = False
    """Samples from all ranges of the policy's training at once, in the training's own settings;
    replaces `terms`."""


class Suite(StrictModel):
    """Content of a suite file."""

    version: str = ""
    """Name of a suite that stays as it is, with which its scores are given."""
    perturbations: Annotated[tuple[Perturbation, ...], Field(min_length=1)] = ()


class Condition(NamedTuple):
    """A perturbation at one strength."""

    perturbation: Perturbation
    strength: float | None
    """Strength in the perturbation's unit; None for a perturbation without strengths."""
    env: WorldConfig
    """Settings of the condition, without randomisation."""
    randomization: RandomizationConfig
    """The active terms, each with its range; every episode samples all of them, whatever its
    `share`."""
    ranges: dict[str, Bounds]
    """Lower and upper ends of the ranges of all goals and of the active terms, in the shapes of
    the terms."""
    trained: bool
    """Whether the policy's training has episodes in every world of the condition: no setting
    differs, and the training's ranges contain those of the condition. They also contain the neutral
    value of each term that the training alone has, but for intervals and terms without one."""

    @property
    def label(self) -> str:
        """Its perturbation and strength, such as "action latency 20 ms"."""
        return condition_label(self.perturbation.name, self.strength, self.perturbation.unit)

    def range(self, name: str) -> Bounds:
        """Range of a goal, or of a term; a term that is not active has its neutral one.

        Raises:
          UserError: it has none, because the model lacks a contact pair.
        """
        bounds = self.ranges.get(name) or neutral_range(name, self.env)
        if bounds is None:
            raise UserError(NO_PAIR)
        return bounds

    @property
    def config(self) -> WorldConfig:
        """World and task of the condition."""
        return self.env.model_copy(update={"randomization": self.randomization})

    @property
    def goals(self) -> dict[str, tuple[float, float]]:
        """Range of each goal."""
        return {name: tuple(map(float, self.ranges[name])) for name in self.env.goals}


def condition_label(perturbation: str, strength: float | None, unit: str) -> str:
    """A perturbation and its strength in words."""
    return f"{perturbation} {strength_text(strength, unit)}".rstrip()


def strength_text(strength: float | None, unit: str) -> str:
    """A strength with its unit; empty for a perturbation without strengths."""
    return "" if strength is None else f"{strength:g} {unit}".rstrip()


def read_suite(path: Path) -> Suite:
    """Reads a suite file.

    Raises:
      UserError: the file is missing or invalid.
    """
    return validate(Suite, read_mapping(path, "suite", "configs/robustness.yaml"), str(path))


def load_suite(
    path: Path,
    trained: WorldConfig,
    world: WorldConfig | None = None,
    assumed: dict[str, dict[str, Any]] | None = None,
) -> list[Condition]:
    """Reads the conditions of a suite file, the nominal condition first.

    Args:
      trained: config of the policy's training; each condition replaces its randomisation.
      world: config of the policy in a named world, which each condition changes, but for that with
        `trained_ranges`, which is in the training's settings; by default, the policy's without
        randomisation. Each episode samples all its terms, whatever its `share`.
      assumed: by the name of a condition, the nested settings of `env` that it changes in `world`
        (`double_assumed`). These conditions follow the nominal one.

    Raises:
      UserError: the file is missing or invalid.
    """
    suite = read_suite(path)
    nominal = Perturbation(name=NOMINAL, group=NOMINAL)
    world = world or _unrandomized(trained)
    names = {NOMINAL}
    training = _Training.of(trained)
    conditions = [_condition(nominal, None, training, world, NOMINAL)]
    for name, settings in (assumed or {}).items():
        harder = Perturbation(name=name, group="twice the assumed, or half")
        changed = validate(type(world), merged(world.model_dump(), settings), name)
        conditions.append(_condition(harder, None, training, changed, name))
    for perturbation in suite.perturbations:
        source = f"{shorten(path.name, 30)}, perturbation {shorten(perturbation.name, 30)!r}"
        if perturbation.name in names:
            raise UserError(f"{source}: the name is taken; give each perturbation its own name")
        names.add(perturbation.name)
        _check_content(perturbation, source)
        if perturbation.task and not issubclass(trained.task, find_task(perturbation.task)):
            continue
        if perturbation.trained_ranges and not trained.randomization.terms:
            continue
        for strength in perturbation.strengths or (None,):
            place = source
            if strength is not None:
                place += f" at {strength_text(strength, perturbation.unit)}"
            condition = _condition(perturbation, strength, training, world, place)
            if _can_start(condition):
                conditions.append(condition)
    return conditions


def _can_start(condition: Condition) -> bool:
    """Whether the arm and the balls can start as a condition has it; one that no episode could have
    is left out, with a warning."""
    if not {"joint_start", "ball_start"} & condition.ranges.keys():
        return True
    mj_model, addresses = _model(condition.env)
    try:
        check_starts(condition.config, mj_model, addresses, condition.config.task(condition.config))
    except UserError as error:
        warn_once(f"the condition {condition.label} is left out: {error}")
        return False
    return True


@functools.lru_cache(maxsize=8)
def _model(env: WorldConfig) -> tuple[mujoco.MjModel, Addresses]:
    """The compiled model of an environment without its randomisation."""
    mj_model = world_model(env, visual=False)
    return mj_model, find_addresses(mj_model)


def _check_content(perturbation: Perturbation, source: str) -> None:
    """Raises UserError unless a perturbation says what it changes, and what has its strengths."""
    changes = [perturbation.terms, perturbation.settings]
    has_one_content = any(changes) != perturbation.trained_ranges
    has_strengths = bool(perturbation.strengths)
    uses_strength = _fill_in(changes, 0.0) != changes
    if not has_one_content or uses_strength != has_strengths:
        raise UserError(
            f"{source}: give terms or settings, with the word strength in a value if and only "
            "if it has strengths, or trained_ranges: true"
        )


def neutral_range(name: str, env: WorldConfig) -> Bounds | None:
    """Range of a term, not of a goal, without effect on the world; None if it has none."""
    value = _INTERVALS.get(name, TERMS[name].nominal)
    if value == MODEL:
        value = model_nominals(env).get(name)
    return None if value is None else _broadcast(name, env.num_joints, value, value)


def neutral_goals(env: WorldConfig) -> dict[str, tuple[float, float]]:
    """Range of each goal in a world without randomisation: the task's default range for all
    policies that were trained with it, so that those with wider ranges are measured like the
    others; else the policy's own."""
    ranges = dict(env.goals)
    for name, default in type(env)().goals.items():
        if ranges[name].low <= default.low and default.high <= ranges[name].high:
            ranges[name] = default
    return {name: (goal.low, goal.high) for name, goal in ranges.items()}


def _condition(
    perturbation: Perturbation,
    strength: float | None,
    training: "_Training",
    world: WorldConfig,
    source: str,
) -> Condition:
    value = None if strength is None else strength * UNITS[perturbation.unit]
    base = training.config if perturbation.trained_ranges else world
    env = _with_changes(_unrandomized(base), _fill_in(perturbation.settings, value), source)
    goals = neutral_goals(env)
    if perturbation.trained_ranges:
        sampled = training.config.randomization
        goals = goal_ranges(training.config)
    else:
        terms = {name: getattr(world.randomization, name) for name in world.randomization.terms}
        for name, entry in _fill_in(perturbation.terms, value).items():
            low, high = _ends(entry, source)
            if name in env.goals:
                goal = env.goals[name]
                label = f"{source}: {name}"
                goals[name] = goal.checked(low, label), goal.checked(high, label)
                if low > high:
                    raise UserError(f"{label} is from {low} to {high}; exchange the two")
            else:
                terms[name] = low, high
        # The others are off, also those that the task's own world has.
        others = RandomizationConfig().model_dump()
        settings = dict(env) | {"randomization": others | terms}
        sampled = validate(type(env), settings, source).randomization
    ends = {name: getattr(sampled, name) for name in sampled.terms} | goals
    ranges = {
        name: _broadcast(name, env.num_joints, low, high) for name, (low, high) in ends.items()
    }
    is_same = not differing_keys(env, _unrandomized(training.config))
    is_trained = is_same and training.contains(ranges)
    return Condition(perturbation, strength, env, sampled, ranges, is_trained)


class _Training(NamedTuple):
    """The worlds of a policy's training."""

    config: WorldConfig
    neutral: dict[str, Bounds]
    """Neutral range of each of its terms that has one; not of an interval, as the change that comes
    after it may be none."""

    @classmethod
    def of(cls, config: WorldConfig) -> "_Training":
        """The training with a config."""
        neutral = {}
        for name in config.randomization.terms:
            bounds = neutral_range(name, config)
            if bounds is not None and name not in _INTERVALS:
                neutral[name] = bounds
        return cls(config, neutral)

    def contains(self, ranges: dict[str, Bounds]) -> bool:
        """Whether it contains a condition with these ranges, whose other terms are neutral."""
        needed = self.neutral | ranges
        return all(self._contains(name, bounds) for name, bounds in needed.items())

    def _contains(self, name: str, bounds: Bounds) -> bool:
        """Whether it contains the range of a term or of a goal."""
        if name in self.config.goals:
            return _is_within(bounds, goal_ranges(self.config)[name])
        randomization = self.config.randomization
        sampled = getattr(randomization, name)
        if sampled is None:
            neutral = neutral_range(name, self.config)
            return neutral is not None and _is_within(bounds, neutral)
        share = (randomization.shares or {}).get(name, randomization.share)
        if share < 1.0 and name in self.neutral and _is_within(bounds, self.neutral[name]):
            # The other episodes have the neutral value.
            return True
        return _is_within(bounds, sampled)


def _unrandomized(config: WorldConfig) -> WorldConfig:
    return config.in_world(RandomizationConfig())


def _with_changes(env: WorldConfig, settings: dict[str, Any], source: str) -> WorldConfig:
    """A config with changed settings."""
    values = env.model_dump()
    for name, value in settings.items():
        if name.partition(".")[0] == "randomization":
            raise UserError(f"{source}: give {shorten(name)} under terms, without its group")
        values = merged(values, nested(name, value))
    changed = validate(type(env), values, source)
    if changed.layout != env.layout:
        raise UserError(f"{source}: it changes the observation, which the policy fixes; remove it")
    return changed


def _fill_in(value: Any, strength: float | None) -> Any:
    """A value from the suite with the number in place of each word strength."""
    if isinstance(value, dict):
        return {key: _fill_in(inner, strength) for key, inner in value.items()}
    if isinstance(value, list):
        return [_fill_in(inner, strength) for inner in value]
    return _SIGNS[value] * strength if isinstance(value, str) and value in _SIGNS else value


def _ends(entry: Any, source: str) -> tuple[Any, Any]:
    """Both ends of a range from its entry in the suite: a value, a list with one value for each
    entry of the term, or a mapping {from, to} of either."""
    ends = entry if isinstance(entry, dict) else {"from": entry, "to": entry}
    if ends.keys() != {"from", "to"}:
        raise UserError(f"{source}: a range has other keys than from and to; give both")
    return ends["from"], ends["to"]


def _broadcast(term: str, num_joints: int, low: Any, high: Any) -> Bounds:
    """Ends of a range in the term's shape."""
    # A goal is a number.
    shape = TERMS[term].shape(num_joints) if term in TERMS else ()
    return tuple(np.broadcast_to(np.asarray(end, np.float64), shape) for end in (low, high))


def _is_within(bounds: Bounds, sampled: tuple[Any, Any]) -> bool:
    """Whether a range is within another one."""
    low, high = map(np.asarray, sampled)
    lowest, highest = bounds
    tolerance = 1e-9
    return bool(np.all(low <= lowest + tolerance) and np.all(highest <= high + tolerance))
