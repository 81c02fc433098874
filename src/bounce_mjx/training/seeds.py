"""The seeds of a training run, and what each has reached."""

import dataclasses
from pathlib import Path

from bounce_mjx.errors import warn_once
from bounce_mjx.evaluation.results import Report
from bounce_mjx.learning.policy import Policy
from bounce_mjx.runs import checkpoints, folders
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.progress import Progress
from bounce_mjx.runs.records import Checkpoint, DamagedCheckpoint


@dataclasses.dataclass(frozen=True)
class Best:
    """The best policy of a seed."""

    policy: Policy
    report: Report
    steps: int
    number: int | None = None
    """Of its checkpoint, once it is saved."""


@dataclasses.dataclass
class SeedRun:
    """One seed of a training run; its number is `config.seed`."""

    run: Path
    """Folder of the seed's best checkpoint and log; with one seed, the run's folder itself."""
    config: TrainConfig
    """The config of this seed, as for a training of one seed."""
    seconds: dict[str, float]
    """Seconds by phase, for all seeds together."""
    progress: Progress = dataclasses.field(default_factory=Progress)
    report: Report | None = None
    """The evaluation of the current policy; None before it."""
    best: Best | None = None
    """The best policy so far. `progress.best` is its report, until that of the final evaluation, on
    fresh resets, takes its place."""
    saved_best: Best | None = None
    """The best policy of those that were saved."""
    saved_progress: Progress = dataclasses.field(default_factory=Progress)
    """The evaluations that were saved."""

    @property
    def has_unsaved_best(self) -> bool:
        """Whether the best policy is not saved yet. It is the current policy then: the next save
        starts before the next block."""
        return self.best is not self.saved_best

    def add_report(self, report: Report, policy: Policy, steps: int, seconds: float) -> None:
        """Adds the evaluation of the current policy.

        Args:
          seconds: see `Progress.add`.
        """
        self.report = report
        is_best = self.progress.add(report, steps, seconds)
        if is_best:
            self.best = Best(policy, report, steps)

    def end_save(self, number: int | None, is_saved: bool, has_failed: bool) -> None:
        """Takes note of a save. What could not be saved counts no more: neither the best policy nor
        an evaluation, which might end the training.

        Args:
          number: that of the checkpoint in the seed's own folder, if one was written.
          is_saved: whether the evaluations so far are in a checkpoint that was written: this one,
            or of several seeds the one of their states.
          has_failed: whether something could not be written; of several, the rest may be.
        """
        if number is not None and self.has_unsaved_best:
            self.best = dataclasses.replace(self.best, number=number)
            self.saved_best = self.best
        if is_saved:
            self.saved_progress = self.progress.copy_so_far()
        elif has_failed:
            fault = self.progress.fault
            self.progress = self.saved_progress.copy_so_far()
            self.progress.fault = fault
        if has_failed:
            self._take_best(self.saved_best)

    def recall(self, progress: Progress) -> None:
        """Takes over the evaluations of a checkpoint from which a training resumes."""
        self.progress = progress
        self.saved_progress = progress.copy_so_far()

    def recall_best(self, newest: Checkpoint | None) -> None:
        """Takes for the best what the best intact checkpoint of the run says. Where there is none,
        a warning names the damaged one.

        Args:
          newest: the newest checkpoint that counts; None if all do.

        Raises:
          UserError: the checkpoint's config is not that of the seed's folder.
        """
        self.saved_best = None
        # A seed may have diverged before its first evaluation.
        if folders.stored_checkpoints(self.run):
            try:
                self.saved_best = self._read_best(folders.best_checkpoint(self.run, newest=newest))
            except DamagedCheckpoint as error:
                warn_once(f"{error.damage}; another policy takes its place")
        self._take_best(self.saved_best)

    def _read_best(self, checkpoint: Checkpoint) -> Best | None:
        """The policy of a checkpoint with its evaluation; None if it has none."""
        record = checkpoints.read_record(checkpoint)
        if record.report is None:
            return None
        policy = checkpoints.read_policy(checkpoint, self.config)
        return Best(policy, record.report, record.steps, checkpoint.number)

    def _take_best(self, best: Best | None) -> None:
        self.best = best
        self.progress.best = None if best is None else best.report
        self.progress.best_steps = 0 if best is None else best.steps
