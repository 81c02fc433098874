"""A training that starts with the networks of an earlier one."""

from pathlib import Path

import jax
import numpy as np
from rich.console import Console

from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.learning.ppo import Params, names_of_critic_metrics
from bounce_mjx.learning.statistics import RunningStatistics
from bounce_mjx.runs.config import TrainConfig, load_run_config, runs_folder
from bounce_mjx.runs.folders import Checkpoint, choose_checkpoint
from bounce_mjx.runs.reading import policy_shapes, read_networks
from bounce_mjx.task.task import Task

NETWORKS = ("hidden_layers", "critic_layers", "shared_critic", "activation")


def read_start(config: TrainConfig, env: Env) -> tuple[Params, RunningStatistics]:
    """The networks with which a training starts, and the statistics of their inputs.

    The value network keeps the critic metrics that both trainings have, by name; to a new one, such
    as a term that only the new world has, it is blind at first.

    Raises:
      UserError: the checkpoint is missing, damaged or without a value network, or its observation
        or hidden layers are not those of the training.
    """
    checkpoint = find_start(config.warm_start, config.env.task)
    own = load_run_config(checkpoint.run)
    networks = [[getattr(ppo, key) for key in NETWORKS] for ppo in (own.ppo, config.ppo)]
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


def find_start(policy: Path, task: type[Task]) -> Checkpoint:
    """The checkpoint of a run or a policy; `latest` is the newest run in the folder of the task's
    runs.

    Raises:
      UserError: there is none.
    """
    return choose_checkpoint(policy, runs_folder(task), Console(quiet=True))
