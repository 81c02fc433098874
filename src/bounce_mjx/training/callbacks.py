"""What a training tells: an event for each block and evaluation, to functions of the user's."""

import dataclasses
import hashlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bounce_mjx.errors import UserError, needed, reason_of
from bounce_mjx.evaluation.results import Report
from bounce_mjx.learning.policy import Policy
from bounce_mjx.runs.config import TrainConfig


@dataclasses.dataclass(frozen=True)
class Event:
    """The end of a block of iterations, or an evaluation, of one seed."""

    run: Path
    """Folder of the seed's run."""
    config: TrainConfig
    """The seed's config."""
    steps: int
    """Environment steps so far."""
    metrics: dict[str, float]
    """The finite points of the learning curves by name, such as "episode/return" of a block and
    "results/stable" of an evaluation."""
    report: Report | None = None
    """The results of an evaluation; None at the end of a block."""
    policy: Policy | None = None
    """The policy that was evaluated, as NumPy arrays."""


Callback = Callable[[Event], bool | None]
"""The training waits for it, and ends, as after its last step, once it returns False. On several
hosts it is called where the run is written. It may have two methods: `start(run, config)` is called
for each seed before the training, and `close()` after it."""


def block_points(metrics: dict[str, np.ndarray]) -> list[dict[str, float]]:
    """The finite points of each seed's curves in a block, from metrics of its iterations, each
    [S, I]. NaN stands for nothing to measure."""
    means = {n: np.ma.masked_invalid(x).mean(axis=1).filled(math.nan) for n, x in metrics.items()}
    # A sum, because a mean would hide a single event in many iterations.
    means["task/non_finite"] = np.nansum(metrics["task/non_finite"], axis=1)
    seeds = range(len(means["task/non_finite"]))
    return [{name: float(x[i]) for name, x in means.items() if np.isfinite(x[i])} for i in seeds]


def points_of(report: Report) -> dict[str, float]:
    """The points of an evaluation's curves."""
    values = {result.name.replace(" ", "_"): result.value for result in report.results}
    values |= report.details
    known = {name: x for name, x in values.items() if x is not None and math.isfinite(x)}
    return {f"results/{name}": x for name, x in known.items()}


class WeightsAndBiases:
    """A callback that logs to Weights & Biases, to one run for each seed. A resumed training
    continues its run."""

    def __init__(self, project: str):
        self._project, self._runs = project, {}

    def start(self, run: Path, config: TrainConfig) -> None:
        """
        Raises:
          UserError: the package is missing, or Weights & Biases refuses the run, for example
            without an account.
        """
        # Imported only when it is asked for; it takes seconds.
        with needed("wandb", "bounce_mjx[wandb]"):
            import wandb
        try:
            self._runs[run] = wandb.init(
                project=self._project,
                name=run.name,
                id=hashlib.sha256(str(run.absolute()).encode()).hexdigest()[:16],
                resume="allow",
                reinit="create_new",
                dir=run,
                config=config.model_dump(mode="json"),
            )
        except Exception as error:
            raise UserError(
                f"--wandb {self._project} is refused ({reason_of(error)}); run wandb login, or set "
                "WANDB_MODE to offline"
            ) from error

    def __call__(self, event: Event) -> None:
        self._runs[event.run].log(event.metrics, step=event.steps)

    def close(self) -> None:
        for run in self._runs.values():
            run.finish()


def call_all(callbacks: list[Any], method: str, *arguments: Any) -> None:
    """Calls a method of the callbacks that have it."""
    for callback in callbacks:
        getattr(callback, method, lambda *_: None)(*arguments)
