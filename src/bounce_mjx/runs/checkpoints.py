"""Checkpoints, which orbax reads and writes; one sentence refuses a damaged one. `records.py` has
`Checkpoint`, where one is, and `Record`, what it says of itself; `folders.py` finds them.

Arrays are numbers in OCDBT and zarr, and the rest is JSON: nothing in a checkpoint is executable.
Every function that reads raises a `UserError` if the checkpoint is damaged or its config differs
from the run's.

Orbax writes each checkpoint; `training/saving.py` chooses which ones stay. A `CheckpointManager`
would choose by a file of its own, would not open a folder in which one such file is damaged, and
would take a checkpoint for written whose save failed.
"""

import asyncio
import contextlib
import errno
import functools
import logging
import os
import re
import shutil
import sys
import types
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import jax
import numpy as np

from bounce_mjx.baselines.mirror import MirrorLaw
from bounce_mjx.config.files import differing_keys
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError, reason_of, shorten
from bounce_mjx.evaluation.results import Report
from bounce_mjx.learning.config import NETWORK_KEYS, PPO_NAME, PPOConfig
from bounce_mjx.learning.policy import Actor, Policy, make_networks, networks_of, untrained_policy
from bounce_mjx.learning.ppo import PPO, Params, names_of_critic_metrics
from bounce_mjx.learning.registry import find_algorithm
from bounce_mjx.learning.statistics import RunningStatistics, init_statistics
from bounce_mjx.runs import folders
from bounce_mjx.runs.config import (
    CONFIG_FILE,
    RESUMABLE_KEYS,
    TrainConfig,
    load_run_config,
    without_own_settings,
)
from bounce_mjx.runs.creation import create_run
from bounce_mjx.runs.records import RECORD, Checkpoint, DamagedCheckpoint, Record, verify
from bounce_mjx.runs.storage import plain_path, seal, to_plain
from bounce_mjx.task.registry import DEFAULT

POLICY = "policy"
"""Item of a checkpoint: what acts."""
TRAINING = "training"
"""Item of a checkpoint: what a training continues from."""
NETWORKS = "networks"
"""Item of a checkpoint: both networks, with which another training can start."""

# Room for the metadata of a checkpoint.
_MARGIN = 2**20
# What a thread of tensorstore calls once a file is written, or cannot be.
_CALL = asyncio.BaseEventLoop.call_soon_threadsafe
# Folder of what is being written or removed; a killed process leaves it.
_UNFINISHED = ".unfinished"


class NotSavedError(UserError):
    """A checkpoint could not be written."""

    def __init__(self, run: Path, reason: str):
        self.reason = reason
        super().__init__(f"{run} cannot be written ({reason}); choose another folder")


def read_policy(checkpoint: Checkpoint, config: TrainConfig) -> Policy:
    """Restores the policy of a checkpoint."""
    # Refuses a damaged one.
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
    checkpoint: Checkpoint, config: TrainConfig
) -> tuple[Checkpoint, Policy | None, Callable[[Env], Actor]]:
    """The checkpoint that was read, its policy, and what acts with it.

    It is another one than the given one if a training replaces that meanwhile. The mirror law has
    no policy.
    """
    if checkpoint is folders.MIRROR_LAW:
        return checkpoint, None, MirrorLaw
    while True:
        try:
            return checkpoint, read_policy(checkpoint, config), networks_of(config.ppo)
        except UserError:
            if checkpoint.folder.exists():
                raise
            # Another one of the same run, and so of the same config.
            checkpoint = folders.best_checkpoint(checkpoint.run)


def policy_shapes(config: TrainConfig) -> Policy:
    """Shapes and dtypes of the policy of one seed."""
    size = config.env.layout.size
    networks = make_networks(config.ppo, size, config.env.num_joints)
    return jax.eval_shape(lambda: untrained_policy(networks, size, jax.random.PRNGKey(0)))


def read_training(checkpoint: Checkpoint, template: Any) -> tuple[Any, Record]:
    """Restores the whole training state of a checkpoint as NumPy arrays, and its record.

    Args:
      template: shapes and dtypes of the state, as from `jax.eval_shape`.
    """
    if not (checkpoint.folder / TRAINING).is_dir():
        raise UserError(f"{checkpoint.folder} has no state to continue from; use --warm-start")
    record = read_record(checkpoint)
    return _read_arrays(checkpoint, TRAINING, template), record


def read_networks(
    checkpoint: Checkpoint, config: TrainConfig
) -> tuple[Params, RunningStatistics, tuple[str, ...]]:
    """Restores both networks of a checkpoint, the statistics of their inputs, and the names of the
    critic metrics among these."""
    # Refuses a damaged one.
    read_record(checkpoint)
    if not (checkpoint.folder / NETWORKS).is_dir():
        raise UserError(
            f"{checkpoint.folder} is without its value network; give robust_small, or a run"
        )
    size = config.env.layout.size
    names = names_of_critic_metrics(config.ppo, Env(config.env))
    networks = make_networks(config.ppo, size, config.env.num_joints, len(names))

    def initial() -> dict[str, Any]:
        key = jax.random.PRNGKey(0)
        params = Params(networks[0].init(key), networks[1].init(key))
        return {"params": params, "statistics": init_statistics(size + len(names))}

    try:
        stored = _read_arrays(checkpoint, NETWORKS, jax.eval_shape(initial))
    except DamagedCheckpoint as error:
        if config.algorithm == PPO_NAME:
            raise
        raise UserError(
            f"{checkpoint.folder} cannot be read as networks of PPO (its algorithm is "
            f"{config.algorithm}); resume it, or give another run"
        ) from error
    return stored["params"], stored["statistics"], names


def read_warm_start(config: TrainConfig, env: Env) -> tuple[Params, RunningStatistics]:
    """The networks with which a training starts, and the statistics of their inputs.

    The value network keeps the critic metrics that both trainings have, by name; to a new one, such
    as a term that only the new world has, it is blind at first.

    Raises:
      UserError: the checkpoint is missing, damaged or without a value network, or its observation
        or hidden layers are not those of the training, or one of the two makes other networks.
    """
    algorithm = find_algorithm(config.algorithm)
    if getattr(algorithm, "make_networks", None) is not PPO.make_networks:
        raise UserError(
            f"{algorithm.__name__} makes networks of its own, which --warm-start cannot fill; "
            "leave one of them out"
        )
    checkpoint = folders.find_checkpoint(config.warm_start)
    trained = load_run_config(checkpoint.run)
    keys = set(NETWORK_KEYS)
    has_same_networks = trained.ppo.model_dump(include=keys) == config.ppo.model_dump(include=keys)
    has_same_shapes = policy_shapes(trained) == policy_shapes(config)
    has_same_layout = trained.env.layout == config.env.layout
    if not (has_same_networks and has_same_shapes and has_same_layout):
        raise UserError(
            f"the policy {config.warm_start} has another observation, other actions or other "
            "hidden layers than this training; leave out the flags that change them"
        )
    params, statistics, names = read_networks(checkpoint, trained)
    wanted = names_of_critic_metrics(config.ppo, env)

    def moved(array: jax.Array, default: float) -> np.ndarray:
        """The rows of the new inputs; `default` in those of unknown ones."""
        array = np.asarray(array)
        size = len(array) - len(names)
        known = dict(zip(names, array[size:], strict=True))
        rows = list(array[:size])
        for name in wanted:
            rows.append(known.get(name, np.full_like(array[0], default)))
        return np.stack(rows)

    count, mean, summed_variance, std = statistics
    # An unknown input has a mean of 0 and a variance of 1.
    seen = RunningStatistics(
        count, moved(mean, 0.0), moved(summed_variance, float(count)), moved(std, 1.0)
    )
    first = params.value["params"]["hidden_0"]
    first["kernel"] = moved(first["kernel"], 0.0)
    return params, seen


def read_record(checkpoint: Checkpoint) -> Record:
    """Verifies every file of a checkpoint and reads its plain data.

    No code that the record names is looked at: the settings are read with the classes of the run's
    own config, whose task the user has named.
    """
    run_config = load_run_config(checkpoint.run)
    record = verify(checkpoint)
    try:
        differing = _keys_unlike(run_config, record.config)
    # Pydantic's own is one.
    except ValueError as error:
        raise DamagedCheckpoint(checkpoint, error) from error
    if differing:
        raise UserError(
            f"{checkpoint.folder} has a different config from {checkpoint.run / CONFIG_FILE}, "
            f"which differs in {', '.join(sorted(differing))}; restore that file"
        )
    return record


def _keys_unlike(run_config: TrainConfig, stored: dict[str, Any]) -> set[str]:
    """The settings of a record, plain, that are not those of its run's config.

    Raises:
      ValueError: they are no settings of the run's task.
    """
    names = {"task": run_config.task, "algorithm": run_config.algorithm}
    stored = {"task": DEFAULT, "algorithm": PPO_NAME} | stored
    others = {key for key, name in names.items() if stored[key] != name}
    if others:
        return others
    env = type(run_config.env).model_validate(stored.get("env", {}))
    algorithm = type(run_config.ppo)
    if algorithm is PPOConfig:
        stored = without_own_settings(stored)
    ppo = algorithm.model_validate(stored.get("ppo", {}))
    config = TrainConfig.model_validate(stored | names | {"env": env, "ppo": ppo})
    # The record has the path of the original MJCF file, and the run's config that of its copy.
    return differing_keys(run_config, config) - RESUMABLE_KEYS - {"env.mjcf"}


def _read_arrays(checkpoint: Checkpoint, item: str, template: Any) -> Any:
    """Reads an item of a checkpoint with exactly the structure, shapes and dtypes of `template`."""
    try:
        with plain_path(checkpoint.folder) as folder:
            return _read_item(folder / item, template)
    # Damaged files raise exceptions of many types.
    except Exception as error:
        raise DamagedCheckpoint(checkpoint, error) from error


def _read_item(folder: Path, template: Any) -> Any:
    ocp = _orbax()
    handler = ocp.PyTreeCheckpointHandler(multiprocessing_options=_alone())
    expected = _forms(template)
    stored = _forms(handler.metadata(folder).tree)
    for name in sorted(expected.keys() | stored.keys()):
        given = stored.get(name, "missing")
        wanted = expected.get(name, "missing")
        if given != wanted:
            raise ValueError(f"{folder.name}.{name} is {given}, and should be {wanted}")
    as_numpy = jax.tree.map(lambda _: ocp.RestoreArgs(restore_type=np.ndarray), template)
    arguments = ocp.args.PyTreeRestore(item=template, restore_args=as_numpy)
    return handler.restore(folder, args=arguments)


def _forms(tree: Any) -> dict[str, str]:
    """The dtype and the shape of each array, by its path."""
    forms = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        forms[name] = f"{leaf.dtype}{list(leaf.shape)}"
    return forms


def write_run(config: TrainConfig, steps: int, policy: Policy) -> Path:
    """Writes a new run whose checkpoint holds only a policy; its folder.

    Args:
      steps: environment steps trained.

    Raises:
      UserError: the folder cannot be written.
    """
    run = create_run(config)
    save_checkpoint(run, config, steps, {POLICY: policy})
    return run


def save_checkpoint(
    run: Path,
    config: TrainConfig,
    steps: int,
    items: dict[str, Any],
    progress: dict[str, Any] | None = None,
    report: Report | None = None,
    kept: Collection[int] = (),
) -> int:
    """Writes a checkpoint, and then removes the others of the run but for `kept`. A process that is
    killed at any moment leaves a complete one.

    Args:
      run: the run's folder.
      config: the run's config.
      steps: environment steps trained.
      items: pytrees of arrays by their names above.
      progress: the evaluations so far, plain data.
      report: the evaluation of the policy; None if it was not evaluated.
      kept: numbers of other checkpoints that are kept.

    Returns:
      Its number, see `Checkpoint`.

    Raises:
      NotSavedError: it could not be written; the others are as they were.
    """
    folder = run / folders.CHECKPOINTS
    unfinished = folder / _UNFINISHED
    try:
        if not (run / CONFIG_FILE).is_file():
            raise FileNotFoundError("it was moved or removed")
        shutil.rmtree(unfinished, ignore_errors=True)
        folder.mkdir(exist_ok=True)
        unfinished.mkdir()
        _check_room(unfinished, items)
        others = folders.stored_checkpoints(run)
        number = steps
        for other in others:
            # The newest checkpoint has the largest number.
            number = max(number, other.number + 1)
        plain = config.model_dump(mode="json")
        record = Record(steps=steps, config=plain, progress=progress or {}, report=report)
        _write(unfinished / str(number), items, record)
        (unfinished / str(number)).rename(folder / str(number))
        with contextlib.suppress(OSError):
            # It is saved: what cannot be removed stays until the next save.
            for other in others:
                if other.number not in kept:
                    # First out of the way, so that no reader finds a part of it.
                    other.folder.rename(unfinished / other.folder.name)
    # Orbax and tensorstore raise exceptions of many types, also where the disk is full.
    except Exception as error:
        raise NotSavedError(run, _reason_of(error)) from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return number


def _reason_of(error: Exception) -> str:
    """Why a checkpoint could not be written: the system's own words, which tensorstore gives by
    their number."""
    number = re.search(r"os_error_code='(\d+)'", str(error))
    if number is not None:
        return os.strerror(int(number[1]))
    return getattr(error, "strerror", None) or shorten(reason_of(error), 200)


def _check_room(folder: Path, items: dict[str, Any]) -> None:
    """Raises OSError if the file system has too little room for arrays. Tensorstore would find out
    in many threads, each of which would print a traceback."""
    size = sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(items))
    if shutil.disk_usage(folder).free < size + _MARGIN:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _write(folder: Path, items: dict[str, Any], record: Record) -> None:
    """Writes a checkpoint's folder, and checks that its arrays are read as they were given."""
    ocp = _orbax()
    alone = _alone()
    composite = ocp.CompositeOptions(multiprocessing_options=alone)
    handler = ocp.CompositeCheckpointHandler(composite_options=composite)
    arrays = {}
    arguments = {RECORD: ocp.args.JsonSave(to_plain(record.model_dump()))}
    for name, tree in items.items():
        if jax.tree.leaves(tree):
            arrays[name] = jax.tree.map(np.asarray, tree)
            arguments[name] = ocp.args.StandardSave(arrays[name])
    with plain_path(folder.parent) as place:
        with ocp.Checkpointer(handler, multiprocessing_options=alone) as writer:
            writer.save(place / folder.name, args=ocp.args.Composite(**arguments))
        for name, tree in arrays.items():
            stored = _read_item(place / folder.name / name, tree)
            jax.tree.map(np.testing.assert_array_equal, stored, tree)
    seal(folder)


@functools.cache
def _orbax() -> types.ModuleType:
    """The package. Its import takes half a second, and its threads report each error of a save,
    which is raised as well."""
    import orbax.checkpoint

    logging.getLogger("absl").addFilter(lambda record: "orbax" not in record.pathname)
    sys.unraisablehook = functools.partial(_report, sys.unraisablehook)
    return orbax.checkpoint


def _report(report: Callable[[Any], Any], unraisable: Any) -> None:
    """Reports what a thread cannot raise as before, but for a file of a save that has failed
    already: orbax has closed the event loop to which tensorstore's thread gives its result."""
    is_closed = str(unraisable.exc_value) == "Event loop is closed"
    # A program's own mistake with a loop has its own line first.
    trace = unraisable.exc_traceback
    is_of_thread = trace is not None and trace.tb_frame.f_code is _CALL.__code__
    if not (is_closed and is_of_thread):
        report(unraisable)


def _alone() -> Any:
    """Orbax's option for a process that does not wait for those of other hosts."""
    number = jax.process_index()
    return _orbax().options.MultiprocessingOptions(
        primary_host=number, active_processes={number}, barrier_sync_key_prefix="run"
    )
