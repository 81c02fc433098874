"""Checkpoints, which orbax reads and writes; one sentence refuses a damaged one.

Arrays are numbers in OCDBT and zarr, and the rest is JSON: nothing in a checkpoint is executable.
Every function that reads raises a `UserError` if the checkpoint is damaged or its config differs
from the run's.
"""

import logging
import os
import re
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pydantic

from bounce_mjx.baselines.mirror import MirrorLaw
from bounce_mjx.config.files import differing_keys
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError, reason_of, shorten
from bounce_mjx.learning.policy import Actor, Policy, make_networks, networks_of, untrained_policy
from bounce_mjx.learning.ppo import Params, names_of_critic_metrics
from bounce_mjx.learning.statistics import RunningStatistics, init_statistics
from bounce_mjx.runs import folders
from bounce_mjx.runs.config import CONFIG_FILE, TrainConfig, load_run_config, runs_folder
from bounce_mjx.runs.files import MANIFEST_FILE, check_integrity, seal, to_plain, writable
from bounce_mjx.tasks.registry import is_file

# Where orbax moves the checkpoints that are not kept any more.
_REPLACED = "replaced"
POLICY, TRAINING, NETWORKS, RECORD = "policy", "training", "networks", "record"
"""Items of a checkpoint: what acts; what a training continues from; both networks, with which
another training can start; steps, config and evaluations."""

NETWORK_KEYS = ("hidden_layers", "critic_layers", "shared_critic", "activation")
"""Keys of `ppo` that shape the networks."""

# Keys that may differ between a checkpoint and the training that resumes from it. All other keys
# shape the training's state.
RESUMABLE_KEYS = frozenset(
    "total_steps eval_every eval_episodes screening_episodes eval_seed stop_when_solved log_dir "
    "num_devices".split()
)
# Version 0.1 wrote a checkpoint's plain data into this file, and arrays of one chunk in OCDBT and
# zarr without orbax's own metadata.
_OLD_RECORD = "run.json"


class Record(pydantic.BaseModel):
    """The plain data of a checkpoint."""

    steps: int
    config: dict[str, Any]
    progress: dict[str, Any]


def read_policy(checkpoint: folders.Checkpoint, config: TrainConfig) -> Policy:
    """Restores the policy of a checkpoint."""
    read_record(checkpoint)
    policy = _read_arrays(checkpoint, POLICY, policy_shapes(config))
    for path, array in jax.tree_util.tree_leaves_with_path(policy):
        if not np.all(np.isfinite(array)):
            name = jax.tree_util.keystr(path, simple=True, separator=".")
            raise UserError(
                f"the policy of the checkpoint {checkpoint.folder} holds a number that is not "
                f"finite, in {name}; give another checkpoint"
            )
    return jax.tree.map(jax.numpy.asarray, policy)


def read_actor(
    checkpoint: folders.Checkpoint, config: TrainConfig
) -> tuple[folders.Checkpoint, Policy | None, Callable[[Env], Actor]]:
    """The policy of a checkpoint and what acts with it, or the mirror law, which has no policy; and
    the checkpoint that was read: the next one, if a training replaces it meanwhile."""
    if checkpoint is folders.MIRROR_LAW:
        return checkpoint, None, MirrorLaw
    while True:
        try:
            return checkpoint, read_policy(checkpoint, config), networks_of(config.ppo)
        except UserError:
            if checkpoint.folder.exists():
                raise
            checkpoint = folders.best_checkpoint(checkpoint.run)


def policy_shapes(config: TrainConfig) -> Policy:
    """Shapes and dtypes of the policy of one seed."""
    size = config.env.layout.size
    networks = make_networks(config.ppo, size, config.env.num_joints)
    return jax.eval_shape(lambda: untrained_policy(networks, size, jax.random.PRNGKey(0)))


def read_training(checkpoint: folders.Checkpoint, template: Any) -> tuple[Any, Record]:
    """Restores the whole training state of a checkpoint as NumPy arrays, and its record.

    Args:
      template: shapes and dtypes of the state, as from `jax.eval_shape`.
    """
    if not (checkpoint.folder / TRAINING).is_dir() or _is_old(checkpoint.folder):
        raise UserError(f"{checkpoint.folder} has no state of this version; use --warm-start")
    record = read_record(checkpoint)
    return _read_arrays(checkpoint, TRAINING, template), record


def read_networks(
    checkpoint: folders.Checkpoint, config: TrainConfig
) -> tuple[Params, RunningStatistics, tuple[str, ...]]:
    """Restores both networks of a checkpoint, the statistics of their inputs, and the names of the
    critic metrics among these."""
    read_record(checkpoint)
    items = [item for item in (NETWORKS, TRAINING) if (checkpoint.folder / item).is_dir()]
    if not items:
        raise UserError(
            f"{checkpoint.folder} is without its value network; give robust_small, or a run"
        )
    size, names = config.env.layout.size, names_of_critic_metrics(config.ppo, Env(config.env))
    networks = make_networks(config.ppo, size, config.env.num_joints, len(names))

    def initial() -> dict[str, Any]:
        params = Params(*(network.init(jax.random.PRNGKey(0)) for network in networks[:2]))
        return {"params": params, "statistics": init_statistics(size + len(names))}

    stored = _read_arrays(checkpoint, items[0], jax.eval_shape(initial))
    return stored["params"], stored["statistics"], names


def read_start(config: TrainConfig, env: Env) -> tuple[Params, RunningStatistics]:
    """The networks with which a training starts, and the statistics of their inputs.

    The value network keeps the critic metrics that both trainings have, by name; to a new one, such
    as a term that only the new world has, it is blind at first.

    Raises:
      UserError: the checkpoint is missing, damaged or without a value network, or its observation
        or hidden layers are not those of the training.
    """
    checkpoint = folders.choose_checkpoint(config.warm_start, runs_folder(config.env.task))
    own = load_run_config(checkpoint.run)
    networks = [[getattr(ppo, key) for key in NETWORK_KEYS] for ppo in (own.ppo, config.ppo)]
    same = networks[0] == networks[1] and policy_shapes(own) == policy_shapes(config)
    if own.env.layout != config.env.layout or not same:
        raise UserError(
            f"the policy {config.warm_start} has another observation, other actions or other "
            "hidden layers than this training; leave out the flags that change them"
        )
    params, statistics, names = read_networks(checkpoint, own)
    wanted = names_of_critic_metrics(config.ppo, env)

    def moved(array: jax.Array, default: float) -> np.ndarray:
        """The rows of the new inputs; `default` in those of unknown ones."""
        array = np.asarray(array)
        size = len(array) - len(names)
        known = dict(zip(names, array[size:], strict=True))
        new = (known.get(name, np.full_like(array[0], default)) for name in wanted)
        return np.stack([*array[:size], *new])

    count, mean, summed_variance, std = statistics
    seen = RunningStatistics(
        count, moved(mean, 0.0), moved(summed_variance, float(count)), moved(std, 1.0)
    )
    first = params.value["params"]["hidden_0"]
    first["kernel"] = moved(first["kernel"], 0.0)
    return params, seen


def read_record(checkpoint: folders.Checkpoint) -> Record:
    """Verifies every file of a checkpoint and reads its plain data."""
    run_config, folder = load_run_config(checkpoint.run), checkpoint.folder
    try:
        if (folder / MANIFEST_FILE).exists():
            check_integrity(folder)
        else:
            # Its training was killed before it wrote the manifest.
            print(f"warning: {folder} has no {MANIFEST_FILE} to find damage by", file=sys.stderr)
        name = _OLD_RECORD if _is_old(folder) else f"{RECORD}/metadata"
        record = Record.model_validate_json((folder / name).read_bytes())
        config = type(run_config).model_validate(record.config)
    # One of pydantic's is a ValueError.
    except (OSError, ValueError) as error:
        raise _damaged(checkpoint, error) from error
    # The checkpoint has the paths of the original files, and the run's config those of its copies.
    files = {key for key in ("task", "algorithm") if is_file(getattr(config, key))}
    if differing := differing_keys(run_config, config) - RESUMABLE_KEYS - files - {"env.mjcf"}:
        raise UserError(
            f"{folder} has a different config from {checkpoint.run / CONFIG_FILE}, which differs "
            f"in {', '.join(sorted(differing))}; restore that file"
        )
    return record


def _read_arrays(checkpoint: folders.Checkpoint, item: str, template: Any) -> Any:
    """Reads an item of a checkpoint with exactly the structure, shapes and dtypes of `template`."""
    folder = (checkpoint.folder / item).absolute()
    try:
        if _is_old(checkpoint.folder):
            return _read_old(folder, template)
        # Imported here, as the import takes half a second.
        import orbax.checkpoint as ocp

        handler = ocp.PyTreeCheckpointHandler()
        expected, found = _forms(template), _forms(handler.metadata(folder).tree)
        for name in sorted(expected.keys() | found.keys()):
            given, wanted = (x.get(name, "missing") for x in (found, expected))
            if given != wanted:
                raise ValueError(f"{item}.{name} is {given}, and should be {wanted}")
        as_numpy = jax.tree.map(lambda _: ocp.RestoreArgs(restore_type=np.ndarray), template)
        arguments = ocp.args.PyTreeRestore(item=template, restore_args=as_numpy)
        return handler.restore(folder, args=arguments)
    # Damaged files raise exceptions of many types.
    except Exception as error:
        raise _damaged(checkpoint, error) from error


def _is_old(folder: Path) -> bool:
    return (folder / _OLD_RECORD).is_file()


def _read_old(folder: Path, template: Any) -> Any:
    import tensorstore

    def read(path: tuple, leaf: jax.ShapeDtypeStruct) -> np.ndarray:
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        files = {"driver": "file", "path": f"{folder}/"}
        database = {"driver": "ocdbt", "base": files, "path": f"{name}/"}
        form = {"shape": leaf.shape, "chunks": leaf.shape, "dtype": leaf.dtype.str}
        spec = {"driver": "zarr", "kvstore": database, "metadata": form}
        return tensorstore.open(spec, open=True, read=True).result().read().result()

    return jax.tree_util.tree_map_with_path(read, template)


def _forms(tree: Any) -> dict[str, str]:
    """The dtype and the shape of each array, by its path."""
    return {
        jax.tree_util.keystr(path, simple=True, separator="."): f"{leaf.dtype}{list(leaf.shape)}"
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }


def _damaged(checkpoint: folders.Checkpoint, error: Exception) -> UserError:
    return UserError(
        f"the checkpoint {checkpoint.folder} is damaged or of another version "
        f"({shorten(reason_of(error), 200)}); give another checkpoint"
    )


def write_run(config: TrainConfig, steps: int, policy: Policy) -> Path:
    """Writes a new run whose checkpoint holds only a policy; its folder.

    Args:
      steps: environment steps trained.

    Raises:
      UserError: the folder cannot be written.
    """
    run = folders.create_run(config)
    with writable(run, "choose another folder"):
        save_checkpoint(run, config, steps, {POLICY: policy})
    return run


def save_checkpoint(
    run: Path,
    config: TrainConfig,
    steps: int,
    items: dict[str, Any],
    progress: dict[str, Any] | None = None,
    score: Sequence[float] = (),
) -> None:
    """Writes a checkpoint; of the others, orbax keeps the best one. A process that is killed at any
    moment leaves the others as they were.

    Its number is that of its steps, or the next one if it was saved before without an evaluation.

    Args:
      run: the run's folder.
      config: the run's config.
      steps: environment steps trained.
      items: pytrees of arrays by their names above.
      progress: the evaluations so far, plain data.
      score: quality of the policy (`Report.score`); empty if it was not evaluated.

    Raises:
      OSError: the checkpoint could not be written.
    """
    import orbax.checkpoint as ocp
    from orbax.checkpoint.checkpoint_managers import preservation_policy as keep

    folder = (run / folders.CHECKPOINTS).absolute()
    folder.mkdir(exist_ok=True)
    alone = {jax.process_index()}
    best = keep.BestN(get_metric_fn=_score_in, n=1, keep_checkpoints_without_metrics=False)
    options = ocp.CheckpointManagerOptions(
        # Without it, orbax writes no metrics.
        best_fn=_score_in,
        preservation_policy=keep.AnyPreservationPolicy([keep.LatestN(1), best]),
        create=False,
        cleanup_tmp_directories=True,
        enable_async_checkpointing=False,
        todelete_subdir=_REPLACED,
        multiprocessing_options=ocp.options.MultiprocessingOptions(
            primary_host=jax.process_index(), active_processes=alone, barrier_sync_key_prefix="run"
        ),
    )
    items = jax.tree.map(np.asarray, items)
    given = {name: tree for name, tree in items.items() if jax.tree.leaves(tree)}
    arguments = {name: ocp.args.StandardSave(tree) for name, tree in given.items()}
    record = {"steps": steps, "config": config.model_dump(mode="json"), "progress": progress or {}}
    arguments[RECORD] = ocp.args.JsonSave(to_plain(record))
    # After an error, orbax would log a traceback.
    log = logging.getLogger("absl")
    log.disabled = True
    try:
        # A new manager each time: one that failed would take the checkpoint for written.
        with ocp.CheckpointManager(folder, options=options) as manager:
            latest = manager.latest_step()
            number = steps if latest is None else max(steps, latest + 1)
            metrics = {"score": list(score)}
            manager.save(number, args=ocp.args.Composite(**arguments), metrics=metrics)
        seal(folder / str(number))
    except Exception as error:
        # tensorstore reports a full disk as a ValueError.
        code = re.search(r"os_error_code='(\d+)'", str(error))
        if code is None:
            raise
        raise OSError(int(code[1]), os.strerror(int(code[1]))) from error
    finally:
        log.disabled = False
        shutil.rmtree(folder / _REPLACED, ignore_errors=True)


def _score_in(metrics: dict[str, Any]) -> tuple[float, ...]:
    return tuple(metrics["score"])
