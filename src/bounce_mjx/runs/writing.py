"""Checkpoints are written under another name and brought to the disk, the manifest last; only then
the older ones are removed. A process that is killed leaves one or the other whole."""

import concurrent.futures
import logging
import os
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from bounce_mjx.learning.policy import Policy
from bounce_mjx.learning.ppo import TrainingState
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.files import PARTIAL, seal, sync, to_json, write_atomically
from bounce_mjx.runs.folders import CHECKPOINTS, CheckpointName, stored_checkpoints
from bounce_mjx.runs.progress import RESULTS_FILE
from bounce_mjx.runs.reading import RECORD_FILE

_DISCARDED = ".discarded"


class CheckpointWriter:
    """Saves the latest and the best checkpoint of a run, each replacing the one before, and the
    run's results, in a thread while the training goes on.

    What cannot be saved is kept until it can, or until something newer takes its place.
    """

    def __init__(self, run: Path, config: TrainConfig):
        self._run = run
        self._config = config.model_dump(mode="json")
        self._pending: dict[CheckpointName, tuple[int, dict[str, Any], str]] = {}
        self._results: str | None = None
        self._pool = concurrent.futures.ThreadPoolExecutor(1)
        self._writing: concurrent.futures.Future | None = None
        self._problem: str | None = None

    def save(
        self,
        names: Sequence[CheckpointName],
        steps: int,
        policy: Policy,
        training: TrainingState | None = None,
        progress: dict[str, Any] | None = None,
        results: dict[str, Any] | None = None,
    ) -> None:
        """Starts to save; waits only for the save before.

        Args:
          names: the checkpoints to write.
          steps: environment steps trained.
          training: None for a checkpoint that cannot be resumed.
          progress: the evaluations up to this checkpoint, plain data.
          results: the run's results, plain data.
        """
        items = {"policy": policy} | ({} if training is None else {"training": training})
        # A copy, as the training reuses the memory of its state while the writer still writes.
        items = jax.tree.map(np.array, items)
        record = {"steps": steps, "config": self._config, "progress": progress or {}}
        self.problem()
        self._pending |= dict.fromkeys(names, (steps, items, to_json(record)))
        if results is not None:
            self._results = to_json(results)
        self.retry()

    def retry(self) -> None:
        """Starts to save again after a failed save."""
        self._writing = self._pool.submit(self._write)

    def problem(self, wait: bool = True) -> str | None:
        """Why the last save failed, as part of a sentence; None if it did not.

        Args:
          wait: for a save in progress; otherwise the answer is about the save before.
        """
        if self._writing is not None and (wait or self._writing.done()):
            self._problem = None
            try:
                self._writing.result()
            except OSError as error:
                self._problem = f"{self._run} cannot be written ({error.strerror})"
        return self._problem

    def close(self) -> None:
        """Waits until the save in progress has ended."""
        self._pool.shutdown()

    def _write(self) -> None:
        # The older first, so that no checkpoint on the disk names a best one that is not there
        # yet, unless it holds that state itself.
        order = sorted(self._pending, key=lambda name: (self._pending[name][0], name == "best"))
        for name in order:
            steps, items, record = self._pending[name]
            folder = self._run / CHECKPOINTS / name / str(steps)
            _write_checkpoint(folder, items, record)
            del self._pending[name]
        if self._results is not None:
            write_atomically(self._run / RESULTS_FILE, self._results)
            self._results = None


def _write_checkpoint(folder: Path, items: dict[str, Any], record: str) -> None:
    """Writes a checkpoint in place of all others in its parent folder.

    Args:
      items: pytrees of numpy arrays by name.
      record: the text of run.json.

    Raises:
      OSError: it could not be written; nothing of it is left, and the others are as they were.
    """
    partial = folder.with_name(folder.name + PARTIAL)
    _remove_leftovers(folder.parent)
    others = stored_checkpoints(folder.parent).values()
    try:
        partial.mkdir(parents=True)
        _check_room(partial, sum(leaf.nbytes for leaf in jax.tree.leaves(items)))
        _save_arrays(partial, items)
        (partial / RECORD_FILE).write_text(record, encoding="utf-8")
        for path in partial.rglob("*"):
            sync(path)
        seal(partial)
        for path in (partial, folder.parent):
            sync(path)
    except Exception as error:
        shutil.rmtree(partial, ignore_errors=True)
        # tensorstore reports a full disk as a ValueError.
        number = re.search(r"os_error_code='(\d+)'", str(error))
        if number is None:
            raise
        raise OSError(int(number[1]), os.strerror(int(number[1]))) from error
    # From here on the checkpoint counts, so the others may go.
    for other in others:
        # Renamed first, so that it is at no moment there in part.
        shutil.rmtree(other.rename(other.with_name(other.name + _DISCARDED)))
    partial.rename(folder)
    sync(folder.parent)


def _save_arrays(folder: Path, items: dict[str, Any]) -> None:
    """Writes each item with orbax, on this host alone."""
    # It takes a third of a second to import, and only writing needs it.
    import orbax.checkpoint as ocp

    only_here = ocp.options.MultiprocessingOptions(
        primary_host=jax.process_index(), active_processes={jax.process_index()}
    )
    checkpointer = ocp.Checkpointer(
        ocp.PyTreeCheckpointHandler(multiprocessing_options=only_here),
        multiprocessing_options=only_here,
    )
    # It warns of the folder below, once a save.
    logging.getLogger("absl").setLevel(logging.ERROR)
    for name, tree in items.items():
        path = Path(os.path.abspath(folder / name))
        checkpointer.save(path, args=ocp.args.PyTreeSave(tree))
        # orbax looks for its own files by a pattern, and finds none in a path with brackets.
        if not (path / "manifest.ocdbt").exists():
            for file in (path / f"ocdbt.process_{jax.process_index()}").iterdir():
                file.rename(path / file.name)


def _remove_leftovers(folder: Path) -> None:
    """Removes the incomplete checkpoints that a killed process left in a folder."""
    complete = stored_checkpoints(folder).values()
    for path in folder.glob("*"):
        if path.name.endswith(PARTIAL) and path in complete:
            path.rename(path.with_name(path.name.removesuffix(PARTIAL)))
        elif path.name.endswith((PARTIAL, _DISCARDED)):
            shutil.rmtree(path, ignore_errors=True)


def _check_room(folder: Path, size: int) -> None:
    """Raises the OSError of a full disk before orbax meets it, whose threads print tracebacks."""
    room = folder / "room"
    with room.open("wb") as file:
        if hasattr(os, "posix_fallocate"):
            # orbax writes the arrays twice, and some small files.
            os.posix_fallocate(file.fileno(), 0, 2 * size + 2**20)
    room.unlink()
