"""The evaluations of a training so far, as its checkpoints keep them."""

import dataclasses
from typing import Any

from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.results import Report
from bounce_mjx.runs.folder import Checkpoint


@dataclasses.dataclass
class Progress:
    """The evaluations of a run so far."""

    best: Report | None = None
    best_steps: int = 0
    solved_steps: int | None = None
    evaluations: list[dict] = dataclasses.field(default_factory=list)
    fault: str | None = None
    """The first quantity that was not finite, and when, once the training diverged."""

    @classmethod
    def from_dict(cls, plain: dict[str, Any], checkpoint: Checkpoint) -> "Progress":
        """That of `to_dict`, as it was stored in a checkpoint.

        Raises:
          UserError: it is something else.
        """
        try:
            best = None if plain["best"] is None else Report.from_dict(plain["best"])
            progress = cls(
                best,
                int(plain["best_steps"]),
                plain["solved_steps"],
                list(plain["evaluations"]),
                plain.get("fault"),
            )
            if best is not None:
                best.score  # noqa: B018
            for evaluation in progress.evaluations:
                int(evaluation["steps"])
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise UserError(
                f"the evaluations in the checkpoint {checkpoint.folder} are not as train_jax.py "
                "writes them; give another checkpoint"
            ) from error
        return progress

    def to_dict(self) -> dict[str, Any]:
        """Plain data, for JSON."""
        best = None if self.best is None else self.best.to_dict()
        return {
            "best": best,
            "best_steps": self.best_steps,
            "solved_steps": self.solved_steps,
            "evaluations": self.evaluations,
            "fault": self.fault,
        }

    def results(
        self, trained_steps: int, seconds: dict[str, float], device: str
    ) -> dict[str, Any] | None:
        """A run's results, plain data; None before any evaluation."""
        if self.best is None:
            return None
        return {
            "best_steps": self.best_steps,
            "solved_steps": self.solved_steps,
            "trained_steps": trained_steps,
            "seconds": seconds,
            "device": device,
            **self.best.to_dict(),
            "evaluations": self.evaluations,
        }

    def has(self, steps: int) -> bool:
        """Whether the state after so many steps was evaluated."""
        return any(evaluation["steps"] == steps for evaluation in self.evaluations)

    def improves(self, report: Report, steps: int) -> bool:
        """Takes a new evaluation in, and tells whether it is the best."""
        values = {result.name: result.value for result in report.results}
        kind = {"screening": report.screening, "episodes": int(report.details["episodes"])}
        self.evaluations.append({"steps": steps, "passed": report.passed, **kind, **values})
        if report.passed and self.solved_steps is None:
            self.solved_steps = steps
        if self.best is not None and report.score < self.best.score:
            return False
        self.best, self.best_steps = report, steps
        return True
