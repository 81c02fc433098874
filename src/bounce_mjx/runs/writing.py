"""Writing of checkpoints with orbax."""

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
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.files import seal, to_plain, writable
from bounce_mjx.runs.folders import CHECKPOINTS, create_run
from bounce_mjx.runs.reading import POLICY, RECORD

# Where orbax moves the checkpoints that are not kept any more.
_REPLACED = "replaced"


def write_run(config: TrainConfig, steps: int, policy: Policy) -> Path:
    """Writes a new run whose checkpoint holds only a policy; its folder.

    Args:
      steps: environment steps trained.

    Raises:
      UserError: the folder cannot be written.
    """
    run = create_run(config)
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
      items: pytrees of arrays by the names in `runs.reading`.
      progress: the evaluations so far, plain data.
      score: quality of the policy (`Report.score`); empty if it was not evaluated.

    Raises:
      OSError: the checkpoint could not be written.
    """
    import orbax.checkpoint as ocp
    from orbax.checkpoint.checkpoint_managers import preservation_policy as keep

    folder = (run / CHECKPOINTS).absolute()
    folder.mkdir(exist_ok=True)
    alone = {jax.process_index()}
    options = ocp.CheckpointManagerOptions(
        # Without it, orbax writes no metrics.
        best_fn=_score_in,
        preservation_policy=keep.AnyPreservationPolicy(
            [
                keep.LatestN(1),
                keep.BestN(get_metric_fn=_score_in, n=1, keep_checkpoints_without_metrics=False),
            ]
        ),
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
