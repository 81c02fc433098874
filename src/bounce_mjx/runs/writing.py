"""Writing of checkpoints. A checkpoint is written under a temporary name and flushed to the disk
before it replaces the older one, so a killed process always leaves one complete checkpoint."""

import concurrent.futures
import contextlib
import os
import re
import shutil
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tensorstore

from bounce_mjx.errors import UserError
from bounce_mjx.learning.policy import Policy
from bounce_mjx.learning.ppo import Params, TrainingState
from bounce_mjx.learning.statistics import RunningStatistics
from bounce_mjx.runs import folders
from bounce_mjx.runs.config import CONFIG_FILE, TrainConfig
from bounce_mjx.runs.files import PARTIAL, seal, sync, to_json, write_atomically
from bounce_mjx.runs.lock import lock_run
from bounce_mjx.runs.progress import RESULTS_FILE
from bounce_mjx.runs.reading import NETWORKS, RECORD_FILE, open_array


class CheckpointWriter:
    """Saves a run's latest checkpoint, best checkpoint and results in a background thread.

    Each checkpoint replaces its predecessor. Data whose saving failed stays in memory until a retry
    succeeds or newer data replaces it.
    """

    def __init__(self, run: Path, config: TrainConfig):
        self._run, self._run_config = run, config
        self._config = config.model_dump(mode="json")
        # Pending writes by name, the oldest first. A checkpoint on the disk thus never refers to
        # a best checkpoint that is not there yet, unless it holds the best state itself.
        self._pending: dict[str, Callable[[], None]] = {}
        self._pool = concurrent.futures.ThreadPoolExecutor(1)
        self._writing: concurrent.futures.Future | None = None
        self._problem: str | None = None
        self._locks = contextlib.ExitStack()

    def save(
        self,
        names: Sequence[folders.CheckpointName],
        steps: int,
        policy: Policy,
        training: TrainingState | None = None,
        progress: dict[str, Any] | None = None,
        results: dict[str, Any] | None = None,
        networks: tuple[Params, RunningStatistics] | None = None,
    ) -> None:
        """Starts a save after waiting for the previous save.

        Args:
          names: the checkpoints to write, "latest" before "best".
          steps: environment steps trained.
          training: None for a checkpoint that cannot be resumed.
          progress: the evaluations so far, plain data.
          results: the run's results, plain data.
          networks: without `training`, the part of it with which another training can start.
        """
        items = {"policy": policy} | ({} if training is None else {"training": training})
        if networks is not None:
            items[NETWORKS] = dict(zip(("params", "statistics"), networks, strict=True))
        # A copy, because the training reuses its buffers while the writer is still busy.
        items = jax.tree.map(np.array, items)
        record = to_json({"steps": steps, "config": self._config, "progress": progress or {}})
        self.problem()
        new = {}
        for name in names:
            folder = self._run / folders.CHECKPOINTS / name / str(steps)
            new[name] = partial(_write_checkpoint, folder, items, record)
        if results is not None:
            path = self._run / RESULTS_FILE
            new[RESULTS_FILE] = partial(write_atomically, path, to_json(results))
        self._pending = {k: v for k, v in self._pending.items() if k not in new} | new
        self.retry()

    def retry(self) -> None:
        """Starts to save again after a failed save."""
        self._writing = self._pool.submit(self._write)

    def problem(self, wait: bool = True) -> str | None:
        """Reason for the last save's failure, as part of a sentence; None if it succeeded.

        Args:
          wait: whether to wait for a save in progress; otherwise the result is of the save before.
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
        self._locks.close()

    def _write(self) -> None:
        for name, write in list(self._pending.items()):
            self._restore_folder()
            write()
            del self._pending[name]
        # Also if it was moved meanwhile: tensorstore makes the folders that it writes to.
        self._restore_folder()

    def _restore_folder(self) -> None:
        """Makes the run's folder again if the user has moved or removed it, so that the new state
        is kept, and can be resumed."""
        if not (self._run / CONFIG_FILE).exists():
            if not self._run.exists():
                self._run.mkdir(parents=True)
            # The training's own lock is that of the folder that was moved; if only the config is
            # missing, it still holds.
            with contextlib.suppress(UserError):
                self._locks.enter_context(lock_run(self._run))
            # The only copy of the robot may have been in the folder.
            with contextlib.suppress(UserError):
                folders.save_config(self._run, self._run_config)


def write_run(config: TrainConfig, steps: int, policy: Policy) -> Path:
    """Writes a new run whose best checkpoint holds only a policy; its folder.

    Args:
      steps: environment steps trained.

    Raises:
      UserError: the folder cannot be written.
    """
    run = folders.create_run(config)
    writer = CheckpointWriter(run, config)
    writer.save(("best",), steps, policy)
    problem = writer.problem()
    writer.close()
    if problem is not None:
        raise UserError(f"{problem}; choose another folder")
    return run


def _write_checkpoint(folder: Path, items: dict[str, Any], record: str) -> None:
    """Writes a checkpoint and replaces all others in its parent folder.

    Args:
      items: pytrees of numpy arrays by name.
      record: text of run.json.

    Raises:
      OSError: the checkpoint could not be written; the folder is unchanged.
    """
    unfinished = folder.with_name(folder.name + PARTIAL)
    _remove_leftovers(folder.parent)
    try:
        unfinished.mkdir(parents=True)
        for name, tree in items.items():
            _save_arrays(unfinished / name, tree)
        (unfinished / RECORD_FILE).write_text(record, encoding="utf-8")
        # By name: tensorstore may have written the arrays of an item elsewhere.
        for path in (*(unfinished / name for name in items), *unfinished.rglob("*")):
            sync(path)
        seal(unfinished)
        sync(unfinished)
    except Exception as error:
        shutil.rmtree(unfinished, ignore_errors=True)
        # tensorstore reports a full disk as a ValueError.
        number = re.search(r"os_error_code='(\d+)'", str(error))
        if number is None:
            raise
        raise OSError(int(number[1]), os.strerror(int(number[1]))) from error
    for steps, other in folders.stored_checkpoints(folder.parent).items():
        other.rename(folder.with_name(f"{steps}{folders.REPLACED}"))
    unfinished.rename(folder)
    sync(folder.parent)
    _remove_leftovers(folder.parent)


def _save_arrays(folder: Path, tree: Any) -> None:
    """Writes a pytree of arrays as `reading.open_array` opens them, all in one go."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    with tensorstore.Transaction() as together:
        # With separate contexts, each array would be written, and flushed, by itself.
        shared = dict(context=tensorstore.Context(), transaction=together)
        options = shared | dict(create=True, write=True)
        opening = [open_array(folder, path, leaf, **options) for path, leaf in leaves]
        writing = [x.result().write(leaf) for x, (_, leaf) in zip(opening, leaves, strict=True)]
        for each in writing:
            each.result()


def _remove_leftovers(folder: Path) -> None:
    """Removes incomplete and replaced checkpoints from a folder."""
    counting = folders.stored_checkpoints(folder).values()
    for path in folder.glob("*"):
        if path.suffix in (PARTIAL, folders.REPLACED) and path not in counting:
            shutil.rmtree(path, ignore_errors=True)
