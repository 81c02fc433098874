"""The evaluations of a run, as its checkpoints and results.json store them."""

import math
from pathlib import Path
from typing import Annotated, Any

import pydantic
from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field

from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.results import Report
from bounce_mjx.runs.files import first_mistake, read_json

RESULTS_FILE = "results.json"


def _not_infinite(value: float) -> float:
    if math.isinf(value):
        raise ValueError("the number is infinite")
    return value


# A null, as the apex error of an evaluation without a bounce, is NaN in memory.
_Number = Annotated[
    float,
    BeforeValidator(lambda value: math.nan if value is None else value),
    AfterValidator(_not_infinite),
]
_Steps = Annotated[int, Field(ge=0, lt=2**63)]


class _Numbers(pydantic.BaseModel):
    """Figures by name: at least those of the class."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, _Number]


class Evaluation(_Numbers):
    """An evaluation in the list of all: the value of each result by its name."""

    steps: _Steps
    passed: bool


class _Details(_Numbers):
    episodes: _Number
    mean_consecutive_bounces: _Number
    mean_apex_error_m: _Number
    mean_return: _Number
    mean_length_s: _Number


class _Result(pydantic.BaseModel):
    name: str
    measured: str
    value: _Number
    bound: str
    passed: bool | None


class _StoredReport(pydantic.BaseModel):
    results: Annotated[list[_Result], Field(min_length=1)]
    details: _Details


class _Results(_StoredReport):
    """results.json: the best evaluation, all evaluations, and where the time went."""

    device: str
    best_steps: _Steps
    solved_steps: _Steps | None = None
    trained_steps: _Steps = 0
    seconds: dict[str, _Number] = {}
    evaluations: list[Evaluation] = []

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
        pydantic.PlainValidator(lambda plain: plain and _report(plain)),
        pydantic.PlainSerializer(lambda report: report and report.to_dict()),
    ] = None
    best_steps: _Steps = 0
    solved_steps: _Steps | None = None
    evaluations: list[Evaluation] = []

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
        return self.best.to_dict() | self.model_dump(exclude={"best"}) | run

    def has(self, steps: int) -> bool:
        """Whether the state after so many steps was evaluated."""
        return any(evaluation.steps == steps for evaluation in self.evaluations)

    def improves(self, report: Report, steps: int) -> bool:
        """Adds an evaluation; whether it is the best so far."""
        values = {result.name: result.value for result in report.results}
        self.evaluations.append(Evaluation(steps=steps, passed=report.passed, **values))
        if report.passed and self.solved_steps is None:
            self.solved_steps = steps
        if self.best is not None and report.score < self.best.score:
            return False
        self.best, self.best_steps = report, steps
        return True


def _report(plain: Any) -> Report:
    return Report.from_dict(_StoredReport.model_validate(plain).model_dump())
