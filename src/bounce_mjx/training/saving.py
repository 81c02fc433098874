"""The saves of a training, in the background."""

import concurrent.futures
import dataclasses
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from bounce_mjx.errors import reason_of
from bounce_mjx.evaluation.results import Report
from bounce_mjx.runs import checkpoints
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.progress import RESULTS_FILE
from bounce_mjx.runs.storage import to_json, write_atomically
from bounce_mjx.training import hosts
from bounce_mjx.training.seeds import SeedRun
from bounce_mjx.training.trainer import Snapshot


@dataclasses.dataclass(frozen=True)
class Save:
    """A checkpoint to write; see `checkpoints.save_checkpoint`."""

    run: Path
    config: TrainConfig
    steps: int
    items: dict[str, Any]
    progress: dict[str, Any]
    report: Report | None = None
    kept: frozenset[int] = frozenset()


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a save has written."""

    numbers: dict[str, int]
    """Those of the checkpoints, by the name of the folder of the run or the seed, which with one
    seed are the same."""
    problem: str | None = None
    """Why something could not be written; None if everything was."""


class Saver:
    """Writes checkpoints and results in the background, one save after another.

    A save that fails is lost, with a best policy in it, as the next one has newer data; of several
    seeds, those that were written before it failed keep theirs. The first that fails is said at the
    next evaluation or save, and so is the first that succeeds again; a failure of the last one is
    the caller's to tell. On several hosts the leader alone writes, and all know what was written.
    """

    def __init__(
        self,
        run: Path,
        config: TrainConfig,
        seeds: Sequence[SeedRun],
        pool: concurrent.futures.Executor,
        say: Callable[[str], None],
    ) -> None:
        self._run = run
        self._config = config
        self._seeds = seeds
        self._pool = pool
        self._say = say
        self._saving: concurrent.futures.Future[Outcome] | None = None
        self._steps = 0
        self._is_failing = False
        self._written: list[int] = []

    def recall(self, numbers: Iterable[int]) -> None:
        """Takes over the checkpoints of a resumed run that count, by number: those that were
        trained before the one from which it resumes, and this one. The next save removes others."""
        self._written = sorted(numbers)

    def start(self, snapshot: Snapshot | None, steps: int, about: dict[str, Any]) -> None:
        """Starts to save; the save before must have ended.

        Args:
          snapshot: the state; None saves the results alone.
          steps: environment steps so far.
          about: what results.json says in addition, see `Progress.results`.
        """
        if not hosts.is_leader():
            return
        self._steps = steps
        saves = [] if snapshot is None else self._checkpoints(snapshot)
        results = {
            seed.run / RESULTS_FILE: to_json(seed.progress.results(**about))
            for seed in self._seeds
            if seed.progress.best is not None
        }
        self._saving = self._pool.submit(_write, saves, results)

    def wait(self) -> None:
        """Waits until nothing is being written."""
        if self._saving is not None:
            concurrent.futures.wait([self._saving])

    def collect(self, is_last: bool = False) -> str | None:
        """Waits for the save that was started last, and tells the seeds what it has written. On
        several hosts, every process must call this at the same point (`hosts.exchange`).

        Args:
          is_last: whether no other save follows, so that a problem is the caller's to tell.

        Returns:
          Why something could not be written; None if everything was.
        """
        outcome = Outcome({})
        if self._saving is not None:
            outcome = self._saving.result()
            self._saving = None
            if not is_last:
                self._say_change(outcome.problem)
        # The leader's, as it alone writes.
        numbers, problem = hosts.exchange([outcome.numbers, outcome.problem])[0]
        if self._run.name in numbers:
            self._written.append(numbers[self._run.name])
        for seed in self._seeds:
            number = numbers.get(seed.run.name)
            # The state of all seeds has the evaluations of each.
            is_saved = number is not None or self._run.name in numbers
            seed.end_save(number, is_saved, has_failed=problem is not None)
        return problem

    def _say_change(self, problem: str | None) -> None:
        """Says that saving fails from now on, or that it succeeds again."""
        if problem and not self._is_failing:
            self._say(
                f"the state is not saved, as {self._run} cannot be written ({problem}); training "
                "continues, and tries again at the next save"
            )
        if self._is_failing and not problem:
            self._say(f"the state is saved again, after {self._steps:,} steps")
        self._is_failing = problem is not None

    def _checkpoints(self, snapshot: Snapshot) -> list[Save]:
        """The checkpoints to write. With one seed, the state and its policy; with several, each
        policy that is the best of its seed, and then the state, whose record refers to them."""
        # On a CPU the snapshot is a view of the training's buffers, which keeps JAX from reusing
        # them while they are written; a copy takes less memory.
        snapshot = jax.tree.map(np.array, snapshot)
        training = {checkpoints.TRAINING: snapshot.state}
        progress = [seed.progress.model_dump() for seed in self._seeds]
        if len(self._seeds) == 1:
            # The best checkpoint stays beside the newest ones, unless this one is the best.
            (seed,) = self._seeds
            is_best_kept = seed.saved_best is not None and not seed.has_unsaved_best
            best = {seed.saved_best.number} if is_best_kept else set()
            return [self._save_of(0, snapshot, progress[0], training, self._kept() | best)]
        saves = []
        for i, seed in enumerate(self._seeds):
            if seed.has_unsaved_best:
                saves.append(self._save_of(i, snapshot, progress[i]))
        record = {"seeds": progress}
        newest = Save(self._run, self._config, self._steps, training, record, kept=self._kept())
        return [*saves, newest]

    def _kept(self) -> frozenset[int]:
        """The checkpoints that stay beside the one that is written next, by number."""
        count = self._config.keep_checkpoints
        if count == "all":
            return frozenset(self._written)
        first = max(0, len(self._written) - (count - 1))
        return frozenset(self._written[first:])

    def _save_of(
        self,
        i: int,
        snapshot: Snapshot,
        progress: dict[str, Any],
        training: dict[str, Any] | None = None,
        kept: frozenset[int] = frozenset(),
    ) -> Save:
        """The checkpoint of seed number i, with what a training continues from if it is given."""
        seed = self._seeds[i]
        items = {checkpoints.POLICY: snapshot.policies[i]} | (training or {})
        if snapshot.networks is not None:
            items[checkpoints.NETWORKS] = snapshot.networks[i]
        return Save(seed.run, seed.config, self._steps, items, progress, seed.report, kept)


def _write(saves: Sequence[Save], results: dict[Path, str]) -> Outcome:
    """Writes checkpoints, and then files by name."""
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
        return Outcome(numbers, error.strerror or reason_of(error))
    return Outcome(numbers)
