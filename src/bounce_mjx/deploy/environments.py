"""A policy and its environment, in every library: the environment that a policy brings, and the
environment in another library's, for which a policy is refused unless it is its own."""

import importlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pydantic

from bounce_mjx.config.settings import merged
from bounce_mjx.config.user_code import is_file, is_same_code
from bounce_mjx.config.validation import validate
from bounce_mjx.deploy.interface import check_interface, interface_of
from bounce_mjx.errors import UserError, shorten, suggest
from bounce_mjx.resources import POLICIES, policy_folder
from bounce_mjx.robot.config import is_packaged
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.runs.folders import find_run
from bounce_mjx.runs.worlds import env_in_world
from bounce_mjx.task.registry import DEFAULT, task_config, task_name
from bounce_mjx.task.task import Task
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.randomization import RandomizationConfig

ONNX = ".onnx"
NOMINAL = "nominal"
"""World of a policy: the model's own."""
TRAINING = "training"
"""World of a policy: each that its training sampled."""


def environment_config(
    title: str,
    task: str | type[Task] | None,
    policy: str | os.PathLike | None,
    world: str | os.PathLike | None,
    settings: dict[str, Any],
) -> WorldConfig:
    """The settings of an environment of a task, or of a policy.

    Args:
      title: of the environment, for errors.
      task: its class, its name, or FILE.py:CLASS; None for the policy's, or the default one.
      policy: a name, a run's folder, a checkpoint in it or an .onnx file, whose environment it is;
        None for the task's own settings.
      world: of a policy, as for `policy_environment`.
      settings: fields of the config, on top. A group that is given in part keeps the other values.

    Raises:
      UserError: a setting is wrong, or the policy would not be this environment's.
    """
    if policy is None:
        if world is not None:
            raise UserError(f"{title}: world is that of a policy, and none is given; give policy")
        return validate(task_config(task or DEFAULT), settings, title)
    trained = policy_environment(policy, task, world, settings.get("mjcf"))
    config = with_settings(trained, settings, title)
    check_interface(
        interface_of(trained),
        interface_of(config),
        str(policy),
        "leave these settings out, or make the environment without the policy",
    )
    return config


def with_settings(config: WorldConfig, settings: dict[str, Any], title: str) -> WorldConfig:
    """A config with fields on top. A group that is given in part keeps the other values.

    Raises:
      UserError: a setting is wrong.
    """
    on_top = {}
    for key, value in settings.items():
        is_group = isinstance(value, pydantic.BaseModel)
        on_top[key] = value.model_dump() if is_group else value
    return validate(type(config), merged(config.model_dump(), on_top), title)


def refuse_beside(given: str, **others: Any) -> None:
    """Refuses arguments that say the environment beside the one that is `given`.

    Args:
      others: arguments by name, None where they are not given.

    Raises:
      UserError: another one is given.
    """
    for name, value in others.items():
        if value is not None:
            raise UserError(f"{given} and {name} both say the environment; give one of them")


def refuse_warmup(config: WorldConfig, title: str) -> None:
    """Refuses the settings of a warm-up in an environment that has no count of a training's steps,
    over which its ranges would grow.

    Raises:
      UserError: they have one.
    """
    if config.randomization.warmup_steps:
        raise UserError(
            f"{title}: the randomisation has warmup_steps, but its ranges do not grow here; set "
            "warmup_steps to 0 and first_command_range to 1, or train with TorchVectorEnv"
        )


def settings_class(
    task: str | type[Task] | None, policy: str | os.PathLike | None, settings: dict[str, Any]
) -> type[WorldConfig]:
    """The class of the settings of `environment_config` with these arguments."""
    if policy is None:
        return task_config(task or DEFAULT)
    return type(policy_environment(policy, task, None, settings.get("mjcf")))


def policy_environment(
    policy: str | os.PathLike,
    task: str | type[Task] | None = None,
    world: str | os.PathLike | None = None,
    mjcf: Any = None,
) -> WorldConfig:
    """The settings of the environment of a policy's training, in the nominal world or another.

    Args:
      task: its class, or as the user names it: a policy of a task in a file, which is code, needs
        it.
      world: training for the worlds that the training sampled, without its curriculum; or a named
        world's file or name in configs/worlds/; None or nominal for the model's own.
      mjcf: the arm's file, for an .onnx file of an arm that no package has.

    Raises:
      UserError: there is no such policy, it is of another task, or its file is not enough.
    """
    path = policy_path(policy)
    if not os.path.exists(path):
        advice = suggest(str(policy), POLICIES)
        advice = advice or f"give {', '.join(POLICIES)}, a run's folder or an .onnx file"
        raise UserError(f"there is no policy {shorten(str(policy))}; {advice}")
    name = task
    if task is not None and not isinstance(task, str):
        name = task_name(task)
    its_file = name if name is not None and is_file(name) else None
    if path.suffix == ONNX:
        trained = _environment_in_file(path, its_file, mjcf)
    else:
        trained = load_run_config(find_run(path), its_file).env
    name_of_policy = task_name(trained.task)
    if name is not None and not is_same_code(name, name_of_policy):
        raise UserError(
            f"the policy {policy} is of the task {name_of_policy}, and the environment of the task "
            f"{name}; leave one of them out"
        )
    if world not in (None, NOMINAL, TRAINING):
        return env_in_world(trained, Path(world))[0]
    randomization = RandomizationConfig()
    if world == TRAINING:
        ended = {"warmup_steps": 0, "first_command_range": 1.0}
        randomization = trained.randomization.model_copy(update=ended)
    return trained.model_copy(update={"randomization": randomization})


def policy_path(policy: str | os.PathLike) -> Path:
    """The path of a policy that a user names: that of one of the package, unless there is a folder
    of its name."""
    return policy_folder(policy) or Path(policy)


def in_library(act: Callable[[jax.Array], jax.Array], size: int) -> Callable[[Any], Any]:
    """A policy for the arrays of any library.

    Args:
      act: observations [..., N] -> actions [..., A].
      size: length N of an observation.

    Returns:
      The same for arrays of NumPy, tensors of PyTorch, or arrays of JAX, of which it gives the same
      kind; UserError for observations of another length.
    """

    def policy(observation: Any) -> Any:
        if observation.shape[-1:] != (size,):
            raise UserError(
                f"the observation has the shape {list(observation.shape)}, but the last axis must "
                f"have {size} entries"
            )
        if isinstance(observation, np.ndarray):
            return np.array(act(jnp.asarray(observation, jnp.float32)))
        if isinstance(observation, jax.Array):
            return act(observation)
        # A tensor, whose library need not be installed.
        actions = act(jax.dlpack.from_dlpack(observation.detach().contiguous()))
        return importlib.import_module("torch").from_dlpack(actions)

    return policy


def _environment_in_file(path: Path, task: str | None, mjcf: Any) -> WorldConfig:
    """The environment in a policy's ONNX file.

    Raises:
      UserError: the file is older, or its arm or its task is in a file that it does not hold.
    """
    # Needs onnxruntime.
    from bounce_mjx.deploy.loading import load_policy

    metadata = load_policy(path).metadata
    values = metadata.environment
    if values is None:
        raise UserError(
            f"{path} says nothing of its environment, as an earlier version exported it; give the "
            "run's folder or the name of the policy, or export it again"
        )
    name = task or metadata.task
    if task is None and is_file(name):
        raise UserError(
            f"{path} has its task in a file, which is code; name it to run it: "
            f"task='FILE.py:{name.rpartition(':')[2]}'"
        )
    if values["mjcf"] is not None and not is_packaged(values["mjcf"]):
        if mjcf is None:
            raise UserError(
                f"{path} is for the arm {metadata.robot}, whose MJCF file it does not hold; give "
                "it as mjcf=FILE, or give the run's folder as the policy"
            )
        values = dict(values) | {"mjcf": mjcf}
    return validate(task_config(name), values, str(path))
