"""The evaluations of a run, as its checkpoints and results.json store them."""

from pathlib import Path
from typing import Annotated, Any

import pydantic
from pydantic import ConfigDict, Field

from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.results import Report
from bounce_mjx.runs.files import first_mistake, read_json

RESULTS_FILE = "results.json"

_Finite = Annotated[float, Field(allow_inf_nan=False)]
# Null where there was nothing to measure, as the apex error without a bounce.
_Figure = _Finite | None
_Steps = Annotated[int, Field(ge=0, lt=2**63)]


class _Figures(pydantic.BaseModel):
    """Figures by name, which include the fields of the class."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, _Figure]


class Evaluation(_Figures):
    """An evaluation in the list of all: the value of each result by its name."""

    steps: _Steps
    passed: bool
    screening: bool = False
    """Whether the policy failed in the few episodes of the screening, and had no others."""


class _Details(_Figures):
    episodes: _Finite
    mean_consecutive_bounces: _Finite
    mean_apex_error_m: _Figure
    mean_return: _Finite
    mean_length_s: _Finite


class _Result(pydantic.BaseModel):
    name: str
    measured: str
    value: _Figure
    bound: str
    passed: bool | None


class _StoredReport(pydantic.BaseModel):
    results: Annotated[list[_Result], Field(min_length=1)]
    details: _Details
    screening: bool = False


class _Results(_StoredReport):
    """results.json: the best evaluation, all evaluations, and where the time went."""

    device: str
    best_steps: _Steps
    solved_steps: _Steps | None = None
    trained_steps: _Steps = 0
    seconds: dict[str, _Finite] = {}
    evaluations: list[Evaluation] = []
    fresh_resets: bool = False
    """Whether the five results are of resets that did not select the best checkpoint."""

    @pydantic.model_validator(mode="after")
    def _check_names(self) -> "_Results":
        names = {result.name for result in self.results}
        if any(names - evaluation.model_extra.keys() for evaluation in self.evaluations):
            raise ValueError("an evaluation lacks a result")
        return self


def load_results(run: Path) -> dict[str, Any] | None:
    """The run's results, with the keys of `_Results`; None if there are none yet.

    Raises:
      UserError: the file is damaged.
    """
    path = run / RESULTS_FILE
    if not path.is_file():
        return None
    try:
        return read_json(path, _Results).model_dump()
    except (OSError, ValueError) as error:
        raise UserError(f"{path} is damaged ({error}); delete it to go on without it") from error


class Progress(pydantic.BaseModel):
    """The evaluations of a training so far."""

    best: Annotated[
        Report | None,
        pydantic.PlainValidator(lambda plain: None if plain is None else _report(plain)),
        pydantic.PlainSerializer(lambda report: None if report is None else report.to_dict()),
    ] = None
    best_steps: _Steps = 0
    solved_steps: _Steps | None = None
    evaluations: list[Evaluation] = []
    fault: str | None = None
    """The first quantity that was not finite, and when, once the training diverged."""

    @classmethod
    def from_dict(cls, plain: dict[str, Any], checkpoint: Path) -> "Progress":
        """Reads the `model_dump` that the folder of a checkpoint holds.

        Raises:
          UserError: it is damaged.
        """
        try:
            return cls.model_validate(plain)
        except pydantic.ValidationError as error:
            raise UserError(
                f"the evaluations in the checkpoint {checkpoint} are damaged "
                f"({first_mistake(error)}); give another checkpoint"
            ) from error

    def results(
        self, trained_steps: int, seconds: dict[str, float], device: str
    ) -> dict[str, Any] | None:
        """The content of results.json; None before any evaluation."""
        if self.best is None:
            return None
        run = {"trained_steps": trained_steps, "seconds": seconds, "device": device}
        return self.best.to_dict() | self.model_dump(exclude={"best", "fault"}) | run

    def has(self, steps: int) -> bool:
        """Whether the state after so many steps was evaluated."""
        return any(evaluation.steps == steps for evaluation in self.evaluations)

    def improves(self, report: Report, steps: int) -> bool:
        """Adds an evaluation; whether it is the best so far."""
        values = {result.name: result.value for result in report.results}
        kind = {"screening": report.screening}
        # Not validated: a figure that is not finite is stored as null.
        new = Evaluation.model_construct(steps=steps, passed=report.passed, **kind, **values)
        self.evaluations.append(new)
        if report.passed and self.solved_steps is None:
            self.solved_steps = steps
        if self.best is not None and report.score < self.best.score:
            return False
        self.best, self.best_steps = report, steps
        return True


def _report(plain: Any) -> Report:
    return Report.from_dict(_StoredReport.model_validate(plain).model_dump())
