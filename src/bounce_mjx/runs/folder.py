"""A run's folder: its config, its checkpoints, its log and its results.

    runs/bounce_ball/<time stamp>/
        config.yaml                     the resolved config
        events.out.tfevents.*           TensorBoard scalars
        results.json                    all evaluations, the best whole, and where the time went
        checkpoints/latest/<steps>/     the newest state
        checkpoints/best/<steps>/       the state of the best evaluation

With several seeds, checkpoints/latest/ has the state of all, and each seed has a folder in the
run's, such as seed_003/, which is like that of a run of one seed.

A checkpoint (checkpoints.py) has two items: `policy` (what acting needs) and `training` (what going
on needs; left out where there is only a policy). It also holds the run's config and its
evaluations so far, so that going on depends on one folder that is whole or not there.
"""

import concurrent.futures
import datetime
import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from bounce_mjx.config.files import differing_keys, dump_config
from bounce_mjx.config.validation import validate
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.results import Report
from bounce_mjx.learning.policy import OBSOLETE_ARRAYS, Policy, make_networks
from bounce_mjx.learning.ppo import TrainingState
from bounce_mjx.learning.statistics import init_normalizer
from bounce_mjx.robot.model import JOINT_NAMES
from bounce_mjx.runs import checkpoint as checkpoints
from bounce_mjx.runs.checkpoint import stored_checkpoints
from bounce_mjx.runs.config import TrainConfig, load_config
from bounce_mjx.task.observation import OBSERVATION

CheckpointName = Literal["latest", "best"]
CONFIG_FILE = "config.yaml"
RESULTS_FILE = "results.json"
_CHECKPOINTS = "checkpoints"
_SEED = "seed_"

# What may differ between a checkpoint and the training that goes on from it: everything else
# shapes its state. The MJCF file may have moved, but must describe the same model.
RESUMABLE_KEYS = frozenset(
    {
        "total_steps",
        "eval_every",
        "eval_episodes",
        "screening_episodes",
        "eval_seed",
        "stop_when_solved",
        "log_dir",
        "num_devices",
        "env.mjcf",
    }
)


class Checkpoint(NamedTuple):
    """Where a checkpoint lies."""

    run: Path
    """The run's folder."""
    folder: Path
    """The folder of the step, which holds the items."""
    steps: int
    """Environment steps trained."""


def create_run(config: TrainConfig) -> Path:
    """Makes a new run's folder, named by the time, with the config in it.

    Raises:
      UserError: the folder cannot be written.
    """
    stamp = datetime.datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    try:
        config.log_dir.mkdir(parents=True, exist_ok=True)
        folder = config.log_dir / stamp
        copies = 1
        while folder.exists():
            copies += 1
            folder = config.log_dir / f"{stamp}_{copies}"
        folder.mkdir()
        save_config(folder, config)
    except OSError as error:
        raise UserError(
            f"the run's folder cannot be made in {config.log_dir} ({error.strerror}); choose a "
            "folder that can be written with --log-dir"
        ) from error
    return folder


def find_checkpoint(path: Path | None, log_dir: Path) -> Checkpoint:
    """Finds a checkpoint.

    Args:
      path: a run's folder (its best checkpoint, or else its latest), a folder of checkpoints in
        it or one of their steps; None for the newest run in `log_dir`.

    Raises:
      UserError: there is none.
    """
    path = newest_run(log_dir) if path is None else path
    run = find_run(path)
    at = Path(os.path.abspath(path))
    if at.parent.parent.name == _CHECKPOINTS and at in stored_checkpoints(at.parent).values():
        return Checkpoint(run, at, int(at.name))
    if at == Path(os.path.abspath(run)):
        run = _best_seed(run)
        at = Path(os.path.abspath(run))
    for folder in (at, at / _CHECKPOINTS / "best", at / _CHECKPOINTS / "latest"):
        stored = stored_checkpoints(folder)
        if stored:
            return Checkpoint(run, stored[max(stored)], max(stored))
    raise UserError(f"{path} holds no checkpoint; train longer or give another run's folder")


def find_run(path: Path) -> Path:
    """The run's folder that a path is or lies in.

    Raises:
      UserError: there is none.
    """
    # Unlike Path.is_dir, false for a name that is too long.
    if not os.path.isdir(path):
        raise UserError(
            f"there is no checkpoint folder {path}; give a run's folder such as "
            "runs/bounce_ball/<time stamp>"
        )
    above = Path(os.path.abspath(path)).parents
    run = next((p for p in (path, *above) if (p / CONFIG_FILE).is_file()), None)
    if run is None:
        raise UserError(
            f"{path} is no run's folder nor in one, as no {CONFIG_FILE} is there; give a folder "
            "that train_jax.py made"
        )
    return run


def seed_folders(run: Path, seeds: Iterable[int]) -> list[Path]:
    """The folders of the seeds of a run, each like the folder of a run of one seed."""
    return [run / f"{_SEED}{seed:03d}" for seed in seeds]


def runs_of_seeds(run: Path) -> list[Path]:
    """The folders of a run's seeds that there are; the run itself if it has one seed."""
    return sorted(run.glob(f"{_SEED}*")) or [run]


def _best_seed(run: Path) -> Path:
    """The folder of a run's best seed; the run itself if it has one seed."""
    seeds = [(folder, load_results(folder)) for folder in runs_of_seeds(run) if folder != run]
    scores = {folder: Report.from_dict(r).score for folder, r in seeds if r is not None}
    return max(scores, key=scores.get) if scores else run


def latest_checkpoint(run: Path) -> Checkpoint:
    """The newest state of a run, from which its training goes on.

    Raises:
      UserError: there is none.
    """
    return find_checkpoint(run / _CHECKPOINTS / "latest", run)


def newest_run(log_dir: Path) -> Path:
    """The newest run's folder that holds a checkpoint.

    Raises:
      UserError: there is none.
    """
    found = (p for p in log_dir.glob(f"*/{_CHECKPOINTS}/*") if stored_checkpoints(p))
    runs = sorted(p.parent.parent for p in found)
    if not runs:
        raise UserError(
            f"there is no run with a checkpoint in {log_dir}; train one with train_jax.py or give "
            "a run's folder"
        )
    return runs[-1]


def has_checkpoint(run: Path, name: CheckpointName, steps: int) -> bool:
    """Whether a run holds that checkpoint."""
    return steps in stored_checkpoints(run / _CHECKPOINTS / name)


def best_checkpoint(run: Path) -> Checkpoint:
    """That of the best evaluation of a run.

    Raises:
      UserError: there is none.
    """
    return find_checkpoint(run / _CHECKPOINTS / "best", run)


def load_run_config(run: Path) -> TrainConfig:
    """The resolved config of a run.

    Raises:
      UserError: it is missing or damaged.
    """
    return load_config(run / CONFIG_FILE)


def load_policy(checkpoint: Checkpoint, config: TrainConfig) -> Policy:
    """Restores the policy of a checkpoint.

    Raises:
      UserError: the checkpoint is damaged or of another network.
    """
    networks = make_networks(config.ppo, OBSERVATION.size, len(JOINT_NAMES))

    def template() -> Policy:
        params = networks.policy_network.init(jax.random.PRNGKey(0))
        return Policy(init_normalizer(OBSERVATION.size), params)

    return _restore(checkpoint, "policy", jax.eval_shape(template), OBSOLETE_ARRAYS)[0]


def load_training_state(
    checkpoint: Checkpoint, template: TrainingState
) -> tuple[TrainingState, dict[str, Any]]:
    """Restores the whole training state of a checkpoint, and the evaluations up to it.

    Args:
      template: its shapes, as from `jax.eval_shape`.

    Raises:
      UserError: the checkpoint is damaged or of another config, or holds only a policy.
    """
    if not (checkpoint.folder / "training").is_dir():
        raise UserError(
            f"the checkpoint {checkpoint.folder} holds no training state to go on from, only a "
            "policy; give a run of train_jax.py"
        )
    state, record = _restore(checkpoint, "training", template)
    return state, record["progress"]


def load_progress(checkpoint: Checkpoint) -> dict[str, Any]:
    """The evaluations up to a checkpoint, as they were given to the writer.

    Raises:
      UserError: the checkpoint is damaged.
    """
    return _read_record(checkpoint)["progress"]


def load_results(run: Path) -> dict[str, Any] | None:
    """The run's results; None if it has none yet.

    Raises:
      UserError: the file is damaged.
    """
    path = run / RESULTS_FILE
    if not path.is_file():
        return None
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise UserError(f"{path} is damaged ({error}); delete it to go on without it") from error


def save_config(run: Path, config: TrainConfig) -> None:
    """Writes the run's resolved config."""
    checkpoints.write_atomically(run / CONFIG_FILE, dump_config(config))


class _Snapshot(NamedTuple):
    """What one checkpoint is to hold."""

    steps: int
    items: dict[str, Any]
    record: dict[str, Any]


class CheckpointWriter:
    """Saves the latest and the best checkpoint of a run, each replacing the one before, and its
    results, beside the training.

    What could not be saved is kept until it is, or until something newer takes its place.
    """

    def __init__(self, run: Path, config: TrainConfig):
        self._run = run
        self._config = config.model_dump(mode="json")
        self._pending: dict[CheckpointName, _Snapshot] = {}
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
          training: left out where the checkpoint is only to act.
          progress: the evaluations up to this checkpoint, plain data.
          results: the run's results, plain data.
        """
        # A copy, as the training reuses the memory of its state while the writer still writes.
        items = jax.tree.map(np.array, {"policy": policy, "training": training})
        items = {name: tree for name, tree in items.items() if tree is not None}
        record = {"steps": steps, "config": self._config, "progress": progress or {}}
        self.problem()
        # Plain data is not copied, so it is turned into text at once.
        record = json.loads(json.dumps(record))
        self._pending |= dict.fromkeys(names, _Snapshot(steps, items, record))
        if results is not None:
            self._results = json.dumps(results, indent=2) + "\n"
        self.retry()

    def retry(self) -> None:
        """Starts to save what could not be saved."""
        self._writing = self._pool.submit(self._write)

    def problem(self, wait: bool = True) -> str | None:
        """Why the last save failed, as part of a sentence; None if it did not.

        Args:
          wait: for a save that is going on; otherwise it is about the one before.
        """
        if self._writing is not None and (wait or self._writing.done()):
            self._problem = None
            try:
                self._writing.result()
            except OSError as error:
                self._problem = f"{self._run} cannot be written ({error.strerror})"
        return self._problem

    def close(self) -> None:
        """Waits until the save that is going on has ended."""
        self._pool.shutdown()

    def _write(self) -> None:
        # The older first, so that no checkpoint on the disk names a best one that is not there
        # yet, unless it holds that state itself.
        order = sorted(self._pending, key=lambda name: (self._pending[name].steps, name == "best"))
        for name in order:
            steps, items, record = self._pending[name]
            folder = self._run / _CHECKPOINTS / name / str(steps)
            checkpoints.write_checkpoint(folder, items, record)
            del self._pending[name]
            for other in stored_checkpoints(folder.parent).values():
                if other != folder:
                    checkpoints.discard(other)
        if self._results is not None:
            checkpoints.write_atomically(self._run / RESULTS_FILE, self._results)
            self._results = None


def _read_record(checkpoint: Checkpoint) -> dict[str, Any]:
    """The plain data of a checkpoint that is whole and belongs to its run."""
    try:
        checkpoints.check_integrity(checkpoint.folder)
        record = checkpoints.read_record(checkpoint.folder)
        if record["steps"] != checkpoint.steps:
            raise ValueError(f"it was written after {record['steps']:d} steps")
        if not isinstance(record["progress"], dict):
            raise ValueError("its progress is no mapping")
        config = record["config"]
    # A damaged file raises many types; all of them mean the same here.
    except Exception as error:
        raise _damaged(checkpoint, error) from error
    config = validate(TrainConfig, config, str(checkpoint.folder / checkpoints.RECORD_FILE))
    differing = differing_keys(load_run_config(checkpoint.run), config) - RESUMABLE_KEYS
    if differing:
        raise UserError(
            f"the checkpoint {checkpoint.folder} is of another config than "
            f"{checkpoint.run / CONFIG_FILE}, which differs in {', '.join(sorted(differing))}; "
            "restore that file or give another checkpoint"
        )
    return record


def _restore(
    checkpoint: Checkpoint, item: str, template: Any, dropped: frozenset[str] = frozenset()
) -> tuple[Any, dict[str, Any]]:
    """An item in the structure of `template`, without its arrays `dropped`, and the record."""
    record = _read_record(checkpoint)
    try:
        stored = checkpoints.open_item(checkpoint.folder, item)
        stored = {name: array for name, array in stored.items() if name not in dropped}
    except Exception as error:
        raise _damaged(checkpoint, error) from error
    leaves, tree = jax.tree_util.tree_flatten_with_path(template)
    wanted = {jax.tree_util.keystr(p, simple=True, separator="."): leaf for p, leaf in leaves}
    for name in sorted(wanted.keys() | stored.keys()):
        has, needs = (
            f"{x[name].dtype.name}{list(x[name].shape)}" if name in x else "nothing"
            for x in (stored, wanted)
        )
        if has != needs:
            raise UserError(
                f"the checkpoint {checkpoint.folder} is damaged or of another config, as its "
                f"{name} is {has} where {checkpoint.run / CONFIG_FILE} needs {needs}; restore "
                "that file or give another checkpoint"
            )
    try:
        arrays = checkpoints.read_arrays(stored)
    except Exception as error:
        raise _damaged(checkpoint, error) from error
    leaves = [jax.numpy.asarray(arrays[name]) for name in wanted]
    return jax.tree_util.tree_unflatten(tree, leaves), record


def _damaged(checkpoint: Checkpoint, error: Exception) -> UserError:
    reason = (str(error).strip().splitlines() or [repr(error)])[0][:200]
    return UserError(
        f"the checkpoint {checkpoint.folder} is damaged ({reason}); give another checkpoint"
    )
