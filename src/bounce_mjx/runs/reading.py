"""Reading of checkpoints; one sentence refuses a damaged or malicious checkpoint.

Arrays are numbers in OCDBT and zarr, and the rest is JSON: nothing in a checkpoint is executable.
Every function raises a `UserError` if the checkpoint is damaged or its config differs from the
run's.
"""

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
import pydantic
import tensorstore

from bounce_mjx.baselines.mirror import MirrorLaw
from bounce_mjx.config.files import differing_keys
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.learning.policy import (
    Actor,
    Policy,
    make_networks,
    networks_of,
    untrained_policy,
)
from bounce_mjx.learning.ppo import Params, TrainingState, names_of_critic_metrics
from bounce_mjx.learning.statistics import RunningStatistics, init_statistics
from bounce_mjx.runs.config import CONFIG_FILE, TrainConfig, load_run_config
from bounce_mjx.runs.files import check_integrity, first_mistake, read_json
from bounce_mjx.runs.folders import MIRROR_LAW, Checkpoint, replacement
from bounce_mjx.tasks.registry import is_file

Result = TypeVar("Result")

RECORD_FILE = "run.json"
NETWORKS = "networks"
"""Item of a checkpoint that comes with the package: the part of a training state from which another
training can start."""

# Keys that may differ between a checkpoint and the training that resumes from it. All other keys
# shape the training's state.
RESUMABLE_KEYS = frozenset(
    "total_steps eval_every eval_episodes screening_episodes eval_seed stop_when_solved log_dir "
    "num_devices".split()
)
# The checkpoint has the path of the original file, and the run's config the path of its own copy.
_MJCF_KEY = "env.mjcf"


class Record(pydantic.BaseModel):
    """Content of run.json."""

    steps: int
    config: dict[str, Any]
    progress: dict[str, Any]


def read_policy(checkpoint: Checkpoint, config: TrainConfig) -> Policy:
    """Restores the policy of a checkpoint."""
    read_record(checkpoint)
    policy = _read_arrays(checkpoint, "policy", policy_shapes(config))
    for path, array in jax.tree_util.tree_leaves_with_path(policy):
        if not np.all(np.isfinite(array)):
            name = jax.tree_util.keystr(path, simple=True, separator=".")
            raise UserError(
                f"the policy of the checkpoint {checkpoint.folder} holds a number that is not "
                f"finite, in {name}; give another checkpoint"
            )
    return policy


def read_newest(
    checkpoint: Checkpoint, read: Callable[[Checkpoint], Result]
) -> tuple[Checkpoint, Result]:
    """Reads a checkpoint, or the next one if a training replaces it meanwhile; also returns which
    one."""
    while True:
        try:
            return checkpoint, read(checkpoint)
        except UserError:
            newest = replacement(checkpoint.folder)
            if newest is None:
                raise
            checkpoint = Checkpoint(checkpoint.run, newest, int(newest.stem))


def read_actor(
    checkpoint: Checkpoint, config: TrainConfig
) -> tuple[Checkpoint, Policy | None, Callable[[Env], Actor]]:
    """The policy of a checkpoint and what acts with it, or the mirror law, which has no policy; and
    the checkpoint that was read (`read_newest`)."""
    if checkpoint is MIRROR_LAW:
        return checkpoint, None, MirrorLaw
    checkpoint, policy = read_newest(checkpoint, partial(read_policy, config=config))
    return checkpoint, policy, networks_of(config.ppo)


def policy_shapes(config: TrainConfig) -> Policy:
    """Shapes and dtypes of the policy of one seed."""
    size = config.env.layout.size
    networks = make_networks(config.ppo, size, config.env.num_joints)
    return jax.eval_shape(lambda: untrained_policy(networks, size, jax.random.PRNGKey(0)))


def load_training_state(
    checkpoint: Checkpoint, template: TrainingState
) -> tuple[TrainingState, dict[str, Any]]:
    """Restores the whole training state of a checkpoint, and the evaluations so far.

    Args:
      template: shapes and dtypes of the state, as from `jax.eval_shape`.
    """
    if not (checkpoint.folder / "training").is_dir():
        raise UserError(
            f"the checkpoint {checkpoint.folder} holds no training state to continue from, only a "
            "policy; give a run that bounce-mjx train made"
        )
    record = read_record(checkpoint)
    return _read_arrays(checkpoint, "training", template), record.progress


def read_networks(
    checkpoint: Checkpoint, config: TrainConfig
) -> tuple[Params, RunningStatistics, tuple[str, ...]]:
    """Restores both networks of a checkpoint, the statistics of their inputs, and the names of the
    critic metrics among these."""
    items = [item for item in (NETWORKS, "training") if (checkpoint.folder / item).is_dir()]
    if not items:
        raise UserError(
            f"the checkpoint {checkpoint.folder} holds a policy without its value network; give "
            "robust_small, or a run that bounce-mjx train made"
        )
    size, names = config.env.layout.size, names_of_critic_metrics(config.ppo, Env(config.env))
    networks = make_networks(config.ppo, size, config.env.num_joints, len(names))

    def initial() -> dict[str, Any]:
        params = Params(*(network.init(jax.random.PRNGKey(0)) for network in networks[:2]))
        return {"params": params, "statistics": init_statistics(size + len(names))}

    stored = _read_arrays(checkpoint, items[0], jax.eval_shape(initial))
    return stored["params"], stored["statistics"], names


def read_record(checkpoint: Checkpoint) -> Record:
    """Verifies every file of a checkpoint and reads its plain data."""
    run_config = load_run_config(checkpoint.run)
    try:
        check_integrity(checkpoint.folder)
        record = read_json(checkpoint.folder / RECORD_FILE, Record)
        if record.steps != checkpoint.steps:
            raise ValueError(f"it was written after {record.steps} steps")
        is_copy = is_file(run_config.task) and is_file(str(record.config.get("task")))
        its_task = {"task": run_config.task} if is_copy else {}
        config = type(run_config).model_validate(record.config | its_task)
    except pydantic.ValidationError as error:
        raise _damaged(checkpoint, ValueError(first_mistake(error))) from error
    except (OSError, ValueError) as error:
        raise _damaged(checkpoint, error) from error
    differing = differing_keys(run_config, config) - RESUMABLE_KEYS - {_MJCF_KEY}
    if differing:
        raise UserError(
            f"the checkpoint {checkpoint.folder} has a different config from "
            f"{checkpoint.run / CONFIG_FILE}, which differs in {', '.join(sorted(differing))}; "
            "restore that file or give another checkpoint"
        )
    return record


def _read_arrays(checkpoint: Checkpoint, item: str, template: Any) -> Any:
    """Reads an item of a checkpoint with exactly the structure, shapes and dtypes of `template`."""
    leaves, tree = jax.tree_util.tree_flatten_with_path(template)
    # JAX's own error, not a damaged file's.
    jax.devices()
    try:
        folder = checkpoint.folder / item
        opening = [open_array(folder, path, leaf, open=True, read=True) for path, leaf in leaves]
        reading = [array.result().read() for array in opening]
        arrays = [jax.numpy.asarray(array.result()) for array in reading]
    # Damaged files raise exceptions of many types.
    except Exception as error:
        raise _damaged(checkpoint, error) from error
    return jax.tree_util.tree_unflatten(tree, arrays)


def open_array(
    folder: Path, path: tuple, leaf: jax.ShapeDtypeStruct, **options: Any
) -> tensorstore.Future:
    """Opens an array of a checkpoint: one chunk, compressed with zstd, as orbax wrote them too.

    A crafted file cannot take more memory than the array: the expected shape fixes the size of the
    chunk, and the zstd reader stops there. (The blosc reader allocates the size that the file
    states.)

    Args:
      folder: of all arrays of an item.
      path: the array's path in its pytree.
      leaf: its shape and type.
      options: of `tensorstore.open`.
    """
    name = jax.tree_util.keystr(path, simple=True, separator=".")
    files = {"driver": "file", "path": f"{os.path.abspath(folder)}/"}
    metadata = {
        "shape": leaf.shape,
        "chunks": leaf.shape,
        "dtype": leaf.dtype.str,
        "compressor": {"id": "zstd", "level": 1},
    }
    database = {"driver": "ocdbt", "base": files, "path": f"{name}/"}
    spec = {"driver": "zarr", "kvstore": database, "metadata": metadata}
    return tensorstore.open(spec, **options)


def _damaged(checkpoint: Checkpoint, error: Exception) -> UserError:
    reason = (str(error).strip().splitlines() or [repr(error)])[0].split(" [tensorstore_spec")[0]
    return UserError(
        f"the checkpoint {checkpoint.folder} is damaged or of another version ({reason[:200]}); "
        "give another checkpoint"
    )
