"""The saves of a training, in the background."""

import concurrent.futures
import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from bounce_mjx.evaluation.results import Report
from bounce_mjx.runs import checkpoints
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.files import write_atomically


@dataclasses.dataclass(frozen=True)
class Save:
    """A checkpoint to write; see `checkpoints.save_checkpoint`."""

    run: Path
    config: TrainConfig
    steps: int
    items: dict[str, Any]
    progress: dict[str, Any]
    report: Report | None = None
    kept: int | None = None


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a save has written."""

    numbers: dict[str, int] = dataclasses.field(default_factory=dict)
    """Those of the checkpoints, by the name of the run's folder."""
    problem: str | None = None
    """Why something could not be written; None if everything was."""


class Saver:
    """Writes checkpoints and results in the background, one save after another.

    A save that fails is lost, as the next one has newer data. It is said once, and so is the next
    one that succeeds.
    """

    def __init__(
        self, run: Path, pool: concurrent.futures.Executor, say: Callable[[str], None]
    ) -> None:
        self._run, self._pool, self._say = run, pool, say
        self._saving: concurrent.futures.Future[Outcome] | None = None
        self._is_failing = False

    def start(self, saves: Sequence[Save], results: dict[Path, str], steps: int) -> None:
        """Starts a save; the one before must have ended.

        Args:
          results: files by name, written once all checkpoints are.
          steps: environment steps so far.
        """
        self._steps = steps
        self._saving = self._pool.submit(_write, saves, results)

    def wait(self) -> None:
        """Waits for the end of the save that was started last."""
        if self._saving is not None:
            concurrent.futures.wait([self._saving])

    def end(self) -> Outcome:
        """Waits for the save that was started last, and returns what it has written; asked again,
        nothing."""
        if self._saving is None:
            return Outcome()
        outcome, self._saving = self._saving.result(), None
        return outcome

    def say(self, outcome: Outcome) -> None:
        """Says that saving fails, or that it succeeds again."""
        if outcome.problem and not self._is_failing:
            self._say(
                f"the state is not saved, as {self._run} cannot be written ({outcome.problem}); "
                "training continues, and tries again after each evaluation"
            )
        if self._is_failing and not outcome.problem and outcome.numbers:
            self._say(f"the state is saved again, after {self._steps:,} steps")
        if outcome.problem or outcome.numbers:
            self._is_failing = outcome.problem is not None


def _write(saves: Sequence[Save], results: dict[Path, str]) -> Outcome:
    numbers = {}
    try:
        for save in saves:
            numbers[save.run.name] = checkpoints.save_checkpoint(
                save.run,
                save.config,
                save.steps,
                save.items,
                save.progress,
                save.report,
                save.kept,
            )
        for path, content in results.items():
            write_atomically(path, content)
    except checkpoints.NotSavedError as error:
        return Outcome(numbers, error.reason)
    except OSError as error:
        return Outcome(numbers, error.strerror)
    return Outcome(numbers)
