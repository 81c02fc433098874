"""A checkpoint, and what it says about itself: its steps, its config and its evaluation.

A `UserError` refuses a checkpoint of which a file is damaged.
"""

from pathlib import Path
from typing import Any, NamedTuple

import pydantic

from bounce_mjx.errors import UserError, reason_of, shorten, warn_once
from bounce_mjx.evaluation.results import Report
from bounce_mjx.runs.storage import MANIFEST_FILE, check_integrity

RECORD = "record"
"""Item of a checkpoint with its `Record`."""


class Checkpoint(NamedTuple):
    """Location of a checkpoint."""

    run: Path
    """The run's folder."""
    folder: Path
    """The checkpoint's own folder."""
    number: int
    """The name of its folder: the environment steps trained; where the run has a number as large,
    one more than its largest. So the newest checkpoint has the largest number."""

    @property
    def steps(self) -> int:
        """Environment steps trained, as its record says; its number where that is not readable."""
        try:
            return _read_record(self).steps
        except (OSError, ValueError):
            return self.number


class Record(pydantic.BaseModel):
    """The plain data of a checkpoint."""

    steps: int
    """Environment steps trained."""
    config: dict[str, Any]
    progress: dict[str, Any]
    """The evaluations so far (`Progress`); with several seeds, a list of them under "seeds"."""
    report: Report | None = None
    """The evaluation of its policy; None if it was not evaluated."""


class DamagedCheckpoint(UserError):
    """A file of a checkpoint is damaged, missing, or of another version."""

    def __init__(self, checkpoint: Checkpoint, error: Exception):
        reason = shorten(reason_of(error), 200)
        self.damage = (
            f"the checkpoint {checkpoint.folder} is damaged or of another version ({reason})"
        )
        super().__init__(f"{self.damage}; give another checkpoint")


def verify(checkpoint: Checkpoint) -> Record:
    """Compares every file of a checkpoint with its manifest, and reads its record.

    Raises:
      DamagedCheckpoint: a file is not as it was written.
    """
    folder = checkpoint.folder
    try:
        if (folder / MANIFEST_FILE).exists():
            check_integrity(folder)
        else:
            # A copy by another program may lack it.
            warn_once(f"{folder} has no {MANIFEST_FILE} to find damage by")
        return _read_record(checkpoint)
    # One of pydantic's is a ValueError.
    except (OSError, ValueError) as error:
        raise DamagedCheckpoint(checkpoint, error) from error


def _read_record(checkpoint: Checkpoint) -> Record:
    """Raises OSError or ValueError if it is missing or damaged."""
    return Record.model_validate_json((checkpoint.folder / RECORD / "metadata").read_bytes())
