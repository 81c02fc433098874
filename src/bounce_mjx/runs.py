"""A run's folder: its config, its checkpoints, its log and its results.

    runs/bounce_ball/<time stamp>/
        config.yaml                     the resolved config
        events.out.tfevents.*           TensorBoard scalars
        results.json                    all evaluations, the best whole, and where the time went
        checkpoints/latest/<steps>/     orbax; the newest state
        checkpoints/best/<steps>/       orbax; the state of the best evaluation

A checkpoint has two items: `policy` (what acting needs) and `training` (what going on needs).
"""

import datetime
import json
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
import orbax.checkpoint as ocp
import tensorstore

from bounce_mjx.config import TrainConfig, dump_config, load_config
from bounce_mjx.env import OBSERVATION_SIZE
from bounce_mjx.errors import UserError
from bounce_mjx.model import JOINT_NAMES
from bounce_mjx.policy import Policy, init_normalizer, make_networks
from bounce_mjx.ppo import TrainingState, policy_of

CheckpointName = Literal["latest", "best"]
CONFIG_FILE = "config.yaml"
RESULTS_FILE = "results.json"
_CHECKPOINTS = "checkpoints"


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
    if path is None:
        path = newest_run(log_dir)
    if not path.is_dir():
        raise UserError(
            f"there is no checkpoint folder {path}; give a run's folder such as "
            "runs/bounce_ball/<time stamp>"
        )
    run = next((p for p in (path, *path.absolute().parents) if (p / CONFIG_FILE).is_file()), None)
    if run is None:
        raise UserError(
            f"{path} is no run's folder nor in one, as no {CONFIG_FILE} is there; give a folder "
            "that train_jax.py made"
        )
    at = path.absolute()
    for folder in (at, at / _CHECKPOINTS / "best", at / _CHECKPOINTS / "latest"):
        if folder.name.isdigit() and folder.parent.parent.name == _CHECKPOINTS:
            return Checkpoint(run, folder, int(folder.name))
        steps = _steps(folder)
        if steps:
            newest = max(steps, key=lambda p: int(p.name))
            return Checkpoint(run, newest, int(newest.name))
    raise UserError(f"{path} holds no checkpoint; train longer or give another run's folder")


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
    runs = sorted(p.parent.parent for p in log_dir.glob(f"*/{_CHECKPOINTS}/*") if _steps(p))
    if not runs:
        raise UserError(
            f"there is no run with a checkpoint in {log_dir}; train one with train_jax.py or give "
            "a run's folder"
        )
    return runs[-1]


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
    networks = make_networks(config.ppo, OBSERVATION_SIZE, len(JOINT_NAMES))

    def template() -> Policy:
        params = networks.policy_network.init(jax.random.PRNGKey(0))
        return Policy(init_normalizer(OBSERVATION_SIZE), params)

    return _restore(checkpoint, "policy", jax.eval_shape(template))


def load_training_state(checkpoint: Checkpoint, template: TrainingState) -> TrainingState:
    """Restores the whole training state of a checkpoint.

    Args:
      template: its shapes, as from `jax.eval_shape`.

    Raises:
      UserError: the checkpoint is damaged or of another config.
    """
    return _restore(checkpoint, "training", template)


def save_config(run: Path, config: TrainConfig) -> None:
    """Writes the run's resolved config."""
    (run / CONFIG_FILE).write_text(dump_config(config), encoding="utf-8")


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


def save_results(run: Path, results: dict[str, Any]) -> None:
    """Writes the run's results as JSON."""
    text = json.dumps(results, indent=2) + "\n"
    (run / RESULTS_FILE).write_text(text, encoding="utf-8")


class CheckpointWriter:
    """Saves the latest and the best checkpoint of a run, each replacing the one before."""

    def __init__(self, run: Path):
        options = ocp.CheckpointManagerOptions(max_to_keep=1, create=True)
        self._managers = {
            name: ocp.CheckpointManager(
                (run / _CHECKPOINTS / name).absolute(),
                options=options,
                item_names=("policy", "training"),
            )
            for name in ("latest", "best")
        }

    def save(self, name: CheckpointName, steps: int, state: TrainingState) -> None:
        """Starts to save the state after `steps` environment steps; training may go on."""
        # A copy, as the training reuses the memory of its state while orbax still writes.
        state = jax.tree.map(np.array, state)
        items = ocp.args.Composite(
            policy=ocp.args.StandardSave(policy_of(state)),
            training=ocp.args.StandardSave(state),
        )
        self._managers[name].save(steps, args=items, force=True)

    def close(self) -> None:
        """Waits until everything is saved."""
        for manager in self._managers.values():
            manager.wait_until_finished()
            manager.close()


def _steps(folder: Path) -> list[Path]:
    """The checkpoints in a folder; one that is still being written has a longer name."""
    return [p for p in folder.glob("*") if p.name.isdigit() and p.is_dir()]


def _restore(checkpoint: Checkpoint, item: str, template: Any) -> Any:
    try:
        stored = _read_arrays(checkpoint.folder.absolute() / item)
    # A damaged file raises many types; all of them mean the same here.
    except Exception as error:
        reason = (str(error).strip().splitlines() or [repr(error)])[0][:200]
        raise UserError(
            f"the checkpoint {checkpoint.folder} is damaged ({reason}); give another checkpoint"
        ) from error
    leaves, tree = jax.tree_util.tree_flatten_with_path(template)
    wanted = {jax.tree_util.keystr(p, simple=True, separator="."): leaf for p, leaf in leaves}
    for name in sorted(wanted.keys() | stored.keys()):
        has, needs = (getattr(x.get(name), "shape", "nothing") for x in (stored, wanted))
        if has != needs:
            raise UserError(
                f"the checkpoint {checkpoint.folder} is damaged or of another config, as its "
                f"{name} is {has} where {checkpoint.run / CONFIG_FILE} needs {needs}; restore "
                "that file or give another checkpoint"
            )
    arrays = [jax.numpy.asarray(stored[name], leaf.dtype) for name, leaf in wanted.items()]
    return jax.tree_util.tree_unflatten(tree, arrays)


def _read_arrays(folder: Path) -> dict[str, np.ndarray]:
    """The arrays of an item by dotted name.

    Not by orbax, whose readers print tracebacks from their threads where a file is damaged.
    """
    metadata = json.loads((folder / "_METADATA").read_text(encoding="utf-8"))
    driver = "zarr3" if metadata["use_zarr3"] else "zarr"
    database = {"driver": "ocdbt", "base": {"driver": "file", "path": f"{folder}/"}}
    keys = tensorstore.KvStore.open(database).result().list().result()
    opening = {
        name: tensorstore.open(
            {"driver": driver, "kvstore": {**database, "path": f"{name}/"}}, open=True
        )
        for name in {key.decode().rpartition("/")[0] for key in keys}
    }
    reading = {name: array.result().read() for name, array in opening.items()}
    return {name: array.result() for name, array in reading.items()}
