"""The learning curves of runs, read from their TensorBoard logs, and the runs that differ only in
their seed as one group."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.runs.config import TrainConfig, load_run_config
from bounce_mjx.runs.progress import load_results

# What may differ in a group: the seed, where the run lies, and when it ended.
_FREE_KEYS = frozenset(("seed", "log_dir", "total_steps", "stop_when_solved", "num_devices"))
# Settings that a label names.
_MAX_NAMED = 3


class Curve(NamedTuple):
    """One quantity over the training; N points."""

    steps: np.ndarray
    """Environment steps [N], rising."""
    values: np.ndarray
    """[N]."""


class RunCurves(NamedTuple):
    """The curves of one run."""

    run: Path
    curves: dict[str, Curve]
    """By the name of the scalar, such as "episode/return"."""
    solved_steps: int | None
    """Environment steps at the first evaluation that met all five results."""


class Group(NamedTuple):
    """Runs whose configs differ in nothing but the seed, and how long they went on."""

    label: str
    """The first settings in which the groups differ, and the number of seeds."""
    runs: list[RunCurves]


def read_curves(run: Path) -> RunCurves:
    """Reads the scalars that a run has logged so far.

    Raises:
      UserError: there are none.
    """
    # As an import at the top it would slow down the start of a training.
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    # 0 keeps every point; the default drops points beyond 10,000.
    log = EventAccumulator(str(run), size_guidance={"scalars": 0}).Reload()
    curves = {}
    for name in log.Tags()["scalars"]:
        # A resumed run may have logged a step twice; the later value is of the state that went on.
        values = {event.step: event.value for event in log.Scalars(name)}
        steps = sorted(values)
        curves[name] = Curve(np.array(steps), np.array([values[step] for step in steps]))
    if not curves:
        raise UserError(
            f"{run} holds no TensorBoard scalars; train longer, or give another run's folder"
        )
    results = load_results(run)
    return RunCurves(run, curves, results["solved_steps"] if results else None)


def group_runs(runs: Sequence[Path]) -> list[Group]:
    """Reads the runs' curves and puts those together whose configs differ only in the seed.

    Raises:
      UserError: a run has no config or no scalars.
    """
    groups: dict[str, list[Path]] = {}
    settings: dict[str, dict[str, Any]] = {}
    for run in runs:
        flat = _settings(load_run_config(run))
        key = json.dumps(flat)
        groups.setdefault(key, []).append(run)
        settings[key] = flat
    labels = _differences(list(settings.values()))
    return [
        Group(_label(differences, len(members)), [read_curves(run) for run in members])
        for differences, members in zip(labels, groups.values(), strict=True)
    ]


def mean_and_band(curves: Sequence[Curve]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean and standard deviation over runs, at the steps [N] that all of them have.

    Returns:
      The steps, the means and the standard deviations, each [N].
    """
    steps = curves[0].steps
    for curve in curves[1:]:
        steps = np.intersect1d(steps, curve.steps)
    values = np.stack([curve.values[np.isin(curve.steps, steps)] for curve in curves])
    return steps, values.mean(axis=0), values.std(axis=0)


def _settings(config: TrainConfig) -> dict[str, Any]:
    """The settings that shape the learning, by dotted name."""
    flat: dict[str, Any] = {}

    def flatten(group: dict[str, Any], prefix: str) -> None:
        for name, value in group.items():
            if isinstance(value, dict):
                flatten(value, f"{prefix}{name}.")
            else:
                flat[prefix + name] = value

    flatten(config.model_dump(mode="json", exclude=set(_FREE_KEYS)), "")
    return flat


def _differences(settings: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of each the settings that are not the same in all."""
    first = settings[0]
    names = [name for name in first if any(each[name] != first[name] for each in settings)]
    return [{name: each[name] for name in names} for each in settings]


def _label(differences: dict[str, Any], runs: int) -> str:
    named = [f"{name.split('.')[-1]} {value}" for name, value in differences.items()]
    values = ", ".join(named[:_MAX_NAMED]) + (" …" if len(named) > _MAX_NAMED else "")
    seeds = f"{runs} seeds" if runs > 1 else "one seed"
    return f"{values} ({seeds})" if values else seeds
