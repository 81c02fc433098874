"""Evaluations of a run, as stored in its checkpoints and in results.json."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pydantic

from bounce_mjx.evaluation.results import Report
from bounce_mjx.runs.storage import read_stored

RESULTS_FILE = "results.json"

PATIENCE = 1.5
"""A training that waits in vain for a margin ends after this many times the steps of the first
trained policy that met all results."""


class Progress(pydantic.BaseModel):
    """Evaluations of a run so far."""

    best: Report | None = None
    """The best evaluation so far."""
    fault: str | None = None
    """Which quantity was not finite first, and at which iteration, as a sentence; None unless the
    training diverged."""
    best_steps: int = 0
    solved_steps: int | None = None
    """Steps at the first evaluation that met all results, with a margin or without: the end of the
    time "to all five results" (of bounce) in every measurement. `stop_when_solved` ends the
    training later, see `may_end`."""
    solved_seconds: float | None = None
    """Seconds from the setup of this training, or of its last resumption, to the end of that
    evaluation."""
    margin_steps: int | None = None
    """Steps at the first evaluation that met all with a margin
    (`Report.passed_with_margin`): as far inside each bound as `task/results.py` asks."""
    evaluations: list[dict[str, Any]] = []
    """Of each, the value of each result by its name, its `steps`, whether a full evaluation
    `passed`, and whether it ended with the `screening`, as the policy could not be the best."""

    def copy_so_far(self) -> "Progress":
        """A copy to which no later evaluation is added."""
        return self.model_copy(update={"evaluations": list(self.evaluations)})

    @property
    def may_end(self) -> bool:
        """Whether `stop_when_solved` ends the training: a margin has come, also to the policy of a
        warm start at step 0, or the wait for it has been `PATIENCE` long."""
        if self.margin_steps is not None:
            return True
        # The wait is counted from a trained policy: from step 0 it would be over at once.
        met = [e["steps"] for e in self.evaluations if e["passed"] and e["steps"] > 0]
        return bool(met) and self.evaluations[-1]["steps"] >= PATIENCE * met[0]

    def may_be_best(self, report: Report) -> bool:
        """Whether the policy of a report of a few episodes may be the best one: it meets all
        results and, once a trained policy has met them, with a larger margin than the best one."""
        has_met = self.best is not None and self.best.passed and self.best_steps > 0
        return report.passed and (not has_met or report.margin > self.best.margin)

    def results(self, **run: Any) -> dict[str, Any]:
        """Content of results.json, after an evaluation.

        Args:
          run: the other fields of `Results`, such as device and seconds.
        """
        return self.best.to_dict() | self.model_dump(exclude={"best", "fault"}) | run

    def has(self, steps: int) -> bool:
        """Whether the state after this number of steps was evaluated."""
        return any(evaluation["steps"] == steps for evaluation in self.evaluations)

    def add(self, report: Report, steps: int, seconds: float) -> bool:
        """Adds an evaluation; returns whether it is the best so far. Of equal ones the newest is.

        Args:
          seconds: see `solved_seconds`.
        """
        values = {result.name: result.value for result in report.results}
        passed = report.passed and not report.screening
        about = {"steps": steps, "passed": passed, "screening": report.screening}
        self.evaluations.append(about | values)
        if passed and self.solved_steps is None:
            self.solved_steps = steps
            self.solved_seconds = seconds
        if passed and report.passed_with_margin and self.margin_steps is None:
            self.margin_steps = steps
        if self.best is not None and report.score < self.best.score:
            return False
        self.best = report
        self.best_steps = steps
        return True


def all_may_end(seeds: Sequence[Progress]) -> bool:
    """Whether `stop_when_solved` ends the training of these seeds (`Progress.may_end`). Those that
    have diverged do not count."""
    return all(seed.may_end for seed in seeds if seed.fault is None)


class Results(Progress):
    """results.json: the best evaluation, all evaluations, and the time of each activity. In the
    file, the keys of the best evaluation are at the top level."""

    best: Report
    device: str
    version: str = ""
    """Version of this package that trained last."""
    trained_steps: int = 0
    seconds: dict[str, float] = {}
    fresh_resets: bool = False
    """Whether the results of `best` come from other resets than the selection of the checkpoint."""

    @pydantic.model_validator(mode="before")
    @classmethod
    def _nest(cls, plain: Any) -> Any:
        return plain | {"best": plain} if isinstance(plain, dict) else plain


def load_results(run: Path) -> Results | None:
    """Results of a run; None if there are none yet.

    Raises:
      UserError: the file is damaged.
    """
    return read_stored(run / RESULTS_FILE, Results)
