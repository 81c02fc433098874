"""A training that starts with the networks of an earlier one."""

from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
from rich.console import Console

from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.learning.ppo import Params, names_of_critic_metrics
from bounce_mjx.learning.statistics import RunningStatistics
from bounce_mjx.resources import POLICIES
from bounce_mjx.runs.config import (
    TrainConfig,
    in_world,
    load_run_config,
    read_preset,
    runs_folder,
)
from bounce_mjx.runs.folders import Checkpoint, choose_checkpoint
from bounce_mjx.runs.reading import policy_shapes, read_networks
from bounce_mjx.task.task import Task
from bounce_mjx.tasks.registry import DEFAULT, find_task

_NETWORKS = ("hidden_layers", "critic_layers", "shared_critic", "activation")


def warm_config(
    policy: Path,
    presets: Sequence[Path],
    task: str | None,
    world: Path | None,
    machine: Path | None,
    algorithm: str | None,
) -> TrainConfig:
    """The config of a training that starts with a policy: its environment and networks, and the
    other settings of a preset.

    Args:
      policy: a run or a policy; `latest` is the newest run in the folder of the task's runs.
      presets: see `preset_files`, as for `machine`.
      task: the policy's task as the user names it, as for `algorithm`.
      world: a named world in place of the policy's.

    Raises:
      UserError: the policy, the preset or the world is missing or wrong.
    """
    checkpoint = _checkpoint(policy, find_task(task or DEFAULT))
    own = load_run_config(checkpoint.run, task)
    base = read_preset(presets, task=own.task, machine=machine, algorithm=algorithm)
    networks = {key: getattr(own.ppo, key) for key in (*_NETWORKS, "critic_metrics")}
    ppo = base.ppo.model_copy(update=networks)
    start = policy if str(policy) in POLICIES else checkpoint.folder
    config = base.model_copy(update={"env": own.env, "ppo": ppo, "warm_start": start})
    return config if world is None else in_world(config, world)[0]


def read_start(config: TrainConfig, env: Env) -> tuple[Params, RunningStatistics]:
    """The networks with which a training starts, and the statistics of their inputs.

    The value network keeps the critic metrics that both trainings have, by name; to a new one, such
    as a term that only the new world has, it is blind at first.

    Raises:
      UserError: the checkpoint is missing, damaged or without a value network, or its observation
        or hidden layers are not those of the training.
    """
    checkpoint = _checkpoint(config.warm_start, config.env.task)
    own = load_run_config(checkpoint.run)
    networks = [[getattr(ppo, key) for key in _NETWORKS] for ppo in (own.ppo, config.ppo)]
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
        size = len(array) - len(names)
        known = np.array([True] * size + [name in names for name in wanted])
        rows = [*range(size), *(size + names.index(n) if n in names else 0 for n in wanted)]
        array = np.asarray(array)[rows]
        return np.where(
            known.reshape(-1, *[1] * (array.ndim - 1)), array, array.dtype.type(default)
        )

    count, mean, summed_variance, std = statistics
    seen = RunningStatistics(
        count, moved(mean, 0.0), moved(summed_variance, float(count)), moved(std, 1.0)
    )
    first = params.value["params"]["hidden_0"]
    first["kernel"] = moved(first["kernel"], 0.0)
    return params, seen


def _checkpoint(policy: Path, task: type[Task]) -> Checkpoint:
    return choose_checkpoint(policy, runs_folder(task), Console(quiet=True))
