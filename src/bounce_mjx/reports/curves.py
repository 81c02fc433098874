"""Learning curves from the TensorBoard logs of runs, grouped by config (ignoring the seed)."""

import functools
import json
import math
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bounce_mjx.config.files import flat
from bounce_mjx.errors import UserError, reason_of, shorten
from bounce_mjx.learning.config import PPO_NAME
from bounce_mjx.runs.config import (
    CONFIG_FILE,
    RESUMABLE_KEYS,
    ROBOT,
    TrainConfig,
    copied_code,
    load_run_config,
)
from bounce_mjx.runs.presets import read_config_file
from bounce_mjx.runs.progress import load_results
from bounce_mjx.runs.storage import MANIFEST_FILE
from bounce_mjx.task.task import Curve

# Settings that may differ within a group: the seed, and what may differ within a run.
_FREE_KEYS = RESUMABLE_KEYS | {"seed"}
_LEARNING_RATE = "ppo.learning_rate"
# Maximum number of settings in a label.
_MAX_NAMED = 3


class LoggedCurve(NamedTuple):
    """N points of one quantity over the training."""

    steps: np.ndarray
    """Environment steps [N], in ascending order."""
    values: np.ndarray
    """Values at these steps [N]."""


class RunCurves(NamedTuple):
    """The curves of one run."""

    run: Path
    curves: dict[str, LoggedCurve]
    """Curves by the scalar's name, such as "episode/return"."""
    solved_steps: int | None
    """Environment steps at the first evaluation that met all results."""


class Group(NamedTuple):
    """Runs whose configs differ only in `_FREE_KEYS`."""

    label: str
    """The first settings that distinguish this group from the others, and the number of runs."""
    runs: list[RunCurves]
    task_curves: tuple[Curve, ...] = ()
    """What the runs' task logs."""


class _File(NamedTuple):
    """A setting that is a file."""

    name: str
    code: str
    """Of its content."""


def read_curves(run: Path) -> RunCurves:
    """Reads the finite scalars in the log of a run.

    Raises:
      UserError: the log is damaged or has no scalars.
    """
    # At the top of the module, this import would delay the start of training.
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    # 0 keeps every point; by default, at most 10,000 points are kept.
    log = EventAccumulator(str(run), size_guidance={"scalars": 0})
    try:
        log.Reload()
    # Damaged files raise exceptions of many types.
    except Exception as error:
        raise UserError(
            f"the TensorBoard log in {run} is damaged ({shorten(reason_of(error))}); remove it"
        ) from error
    curves = {}
    for name in log.Tags()["scalars"]:
        # A resumed run may have logged a step twice; the later value belongs to the final policy.
        values = {event.step: event.value for event in log.Scalars(name)}
        finite = {step: value for step, value in values.items() if math.isfinite(value)}
        if finite:
            steps, points = zip(*sorted(finite.items()), strict=True)
            curves[name] = LoggedCurve(np.array(steps), np.array(points))
    if not curves:
        raise UserError(
            f"{run} has no learning curves, as its training ended before its first block or "
            "diverged; start again, or give another run"
        )
    results = load_results(run)
    return RunCurves(run, curves, results.solved_steps if results else None)


def group_runs(runs: Sequence[Path]) -> list[Group]:
    """Reads the curves of runs, grouped by config (ignoring the seed).

    Raises:
      UserError: a run has no config or no scalars.
    """
    configs = [load_run_config(run) for run in runs]
    settings = [_settings(run, config) for run, config in zip(runs, configs, strict=True)]
    _name_files(settings)
    shown = _telling_first(settings)
    members_of: dict[str, list[int]] = {}
    for i, of_run in enumerate(settings):
        members_of.setdefault(json.dumps(of_run), []).append(i)
    groups = []
    for members in members_of.values():
        # All members have its settings.
        first = members[0]
        config = configs[first]
        group = Group(
            label=_label(config, settings[first], shown, len(members)),
            runs=[read_curves(runs[i]) for i in members],
            task_curves=config.env.task.curves,
        )
        groups.append(group)
    return groups


def _settings(run: Path, config: TrainConfig) -> dict[str, Any]:
    """The settings of a run that affect its training, by dotted name; files by their content, as
    the paths of the run's own copies would put every run in a separate group."""
    settings = flat(config.model_dump(mode="json", exclude=set(_FREE_KEYS)))
    contents = {}
    for key in ("task", "algorithm"):
        code = copied_code(run, key)
        if code is not None:
            contents[key] = code.read_bytes()
    if settings["env.mjcf"] is not None:
        contents["env.mjcf"] = (run / ROBOT / MANIFEST_FILE).read_bytes()
    for key, content in contents.items():
        settings[key] = _File(Path(settings[key]).name, f"{zlib.crc32(content):08x}")
    if config.algorithm != PPO_NAME:
        settings |= _own_settings(run, settings)
    return settings


def _own_settings(run: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """The settings of a user's own algorithm, which the config has only where its code is run."""
    stored = flat({"ppo": read_config_file(run / CONFIG_FILE).get("ppo", {})})
    return {name: value for name, value in stored.items() if name not in settings}


def _name_files(settings: Sequence[dict[str, Any]]) -> None:
    """Puts its name in place of each file, with the code of its content only where the name alone
    would not tell the runs apart.

    Args:
      settings: of each run, which are changed.
    """
    names_of: dict[str, list[str]] = {}
    for key in (key for of_run in settings for key in of_run if isinstance(of_run[key], _File)):
        values = {of_run.get(key) for of_run in settings}
        names_of[key] = [value.name if isinstance(value, _File) else value for value in values]
    for of_run in settings:
        for key, names in names_of.items():
            file = of_run.get(key)
            if isinstance(file, _File):
                is_told = names.count(file.name) == 1
                of_run[key] = file.name if is_told else f"{file.name} {file.code}"


def _telling_first(settings: Sequence[dict[str, Any]]) -> list[str]:
    """The names of the settings that differ, first those that a label needs to tell the runs
    apart."""

    def num_told_apart(names: Sequence[str]) -> int:
        different = set()
        for values in settings:
            different.add(json.dumps([values.get(name) for name in names]))
        return len(different)

    # In the order of the settings; an algorithm of one's own may have more.
    names: dict[str, None] = {}
    for values in settings:
        names |= dict.fromkeys(values)
    rest = [name for name in names if num_told_apart([name]) > 1]

    needed = []
    while num_told_apart(needed) < num_told_apart(rest + needed):
        best = max(rest, key=lambda name: num_told_apart([*needed, name]))
        needed.append(best)
        rest.remove(best)
    return needed + rest


def mean_and_band(curves: Sequence[LoggedCurve]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean and standard deviation over runs, at the steps [N] that all runs have.

    Returns:
      The steps, the means and the standard deviations, each [N].
    """
    steps = functools.reduce(np.intersect1d, [curve.steps for curve in curves])
    values = np.stack([curve.values[np.isin(curve.steps, steps)] for curve in curves])
    return steps, values.mean(axis=0), values.std(axis=0)


def _label(config: TrainConfig, settings: dict[str, Any], shown: Sequence[str], count: int) -> str:
    """The label of a group of a number of runs of a config.

    Args:
      settings: of the group, by dotted name.
      shown: names of the settings that tell the groups apart; the group may lack some.
    """
    names = {key: _short_name(key, settings) for key in shown if key in settings}
    if config.adapts_learning_rate and _LEARNING_RATE in names:
        names[_LEARNING_RATE] = "first learning_rate"
    named = [f"{name} {settings[key]}" for key, name in names.items()]
    values = ", ".join(named[:_MAX_NAMED]) + (" …" if len(named) > _MAX_NAMED else "")
    members = "one run" if count == 1 else f"{count} runs"
    return f"{values} ({members})" if values else members


def _short_name(key: str, settings: dict[str, Any]) -> str:
    """The fewest last words of a setting's dotted name that no other setting ends with, such as
    num_envs; two of one in a group's group, such as that of a reward term: height.weight."""
    words = key.split(".")
    fewest = 2 if len(words) > 3 else 1
    for count in range(fewest, len(words)):
        name = ".".join(words[-count:])
        if sum(other == name or other.endswith(f".{name}") for other in settings) == 1:
            return name
    return key
