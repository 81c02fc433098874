"""An environment for a user of Python: of a task, of a policy or of a run, in a world
(`settings_in_world`), with settings on top. Every adapter takes the `Env` that `environment` gives.
A command makes its own: `eval`, `play` and `robustness` of the config that `WhichPolicy.config_of`
gives, `rehearse` of `environment_config`, `export` and `report` of the run's, as trained.

It is among the exported policies because an .onnx file is a policy with its environment, too.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pydantic

from bounce_mjx.config.settings import merged
from bounce_mjx.config.user_code import not_imported
from bounce_mjx.config.validation import validate
from bounce_mjx.deploy.interface import check_interface, interface_of
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UnexpectedArgument, UserError, shorten, suggest
from bounce_mjx.resources import POLICIES, policy_path
from bounce_mjx.robot.config import is_packaged
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.runs.folders import run_of
from bounce_mjx.runs.worlds import NOMINAL, OWN, World, settings_in_world
from bounce_mjx.task.registry import (
    DEFAULT,
    find_task,
    is_task,
    registered_tasks,
    task_config,
    task_name,
)
from bounce_mjx.task.task import Task
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.randomization import RandomizationConfig

ONNX = ".onnx"

EnvironmentOf = str | os.PathLike | type[Task] | WorldConfig
"""What an environment is made of: the name or the class of a task; a policy, which is the name of
one of the package, a run's folder, a checkpoint in it or an .onnx file; or a whole config."""


def environment(
    start: EnvironmentOf | None = None,
    world: str | os.PathLike | None = None,
    *,
    policy: str | os.PathLike | None = None,
    robot: str | os.PathLike | Mapping[str, Any] | None = None,
    **settings: Any,
) -> Env:
    """An environment of a task, or that in which a policy was trained.

        environment()                                     # the task bounce
        environment("catch", target_height_range=(0.4, 0.5))
        environment("bounce", world="ur5e_rtde")
        environment("robust", world="training")
        environment("runs/bounce_ball/2026-01-31_12-00-00", episode_seconds=60)

    Args:
      start: see `EnvironmentOf`; by default, the task bounce. A word that is both a task and a
        policy, such as catch, is the task.
      world: nominal for the model's own, which is that of a policy by default; training for the
        worlds that a policy's training sampled, without its curriculum; own for these as they
        were, and for that of a task or a config, of which it is the default; or a named world's
        file or name in configs/worlds/.
      policy: a policy in place of `start`, or beside its task.
      robot: of a task, a config's file or its name in configs/robots/; or the settings `env.robot`.
      settings: fields of the task's config, on top. A group that is given in part keeps the other
        values.

    Raises:
      UserError: there is no such thing, a setting is wrong, or a policy relies on another value of
        it; an unknown setting is a TypeError too.
    """
    return Env(environment_config(start, world, policy=policy, robot=robot, **settings))


def environment_config(
    start: EnvironmentOf | None = None,
    world: str | os.PathLike | None = None,
    *,
    policy: str | os.PathLike | None = None,
    robot: str | os.PathLike | Mapping[str, Any] | None = None,
    **settings: Any,
) -> WorldConfig:
    """The settings of `environment`, with the same arguments and errors."""
    if isinstance(robot, Mapping | pydantic.BaseModel):
        settings["robot"] = robot
        robot = None
    if policy is None and not _is_task_or_config(start):
        policy = start
        start = None
    if policy is not None:
        if isinstance(start, WorldConfig):
            raise UserError("a config and a policy both say the environment; give one of them")
        return _of_policy(policy, start, world or NOMINAL, _path(robot), settings)
    own = start or DEFAULT
    task_or_config = find_task(own) if isinstance(own, str) else own
    config = settings_in_world(task_or_config, world or OWN, _path(robot))
    return with_settings(config, settings)


def with_settings(config: WorldConfig, settings: Mapping[str, Any]) -> WorldConfig:
    """A config with fields on top. A group that is given in part keeps the other values.

    Raises:
      UserError: a setting is wrong; one that is unknown is a TypeError too.
    """
    known = type(config).model_fields
    on_top = {}
    for key, value in settings.items():
        if key not in known:
            advice = suggest(key, known) or f"give {', '.join(known)}"
            raise UnexpectedArgument(f"got an unexpected keyword argument {key!r}; {advice}")
        is_group = isinstance(value, pydantic.BaseModel)
        on_top[key] = value.model_dump() if is_group else value
    return validate(type(config), merged(config.model_dump(), on_top), "the environment")


def refuse_warmup(randomization: RandomizationConfig, title: str) -> None:
    """Refuses the settings of a warm-up where there is no count of a training's steps, over which
    its ranges would grow.

    Args:
      title: of the environment or the function, for the error.

    Raises:
      UserError: they have one.
    """
    if randomization.warmup_steps:
        raise UserError(
            f"{title}: the randomisation has warmup_steps, but its ranges do not grow here; set "
            "warmup_steps to 0 and first_goal_range to 1, or train with TorchVectorEnv"
        )


def _is_task_or_config(start: Any) -> bool:
    """Whether a start is no policy; nothing is the default task."""
    if start is None or isinstance(start, WorldConfig):
        return True
    if isinstance(start, type):
        return issubclass(start, Task)
    return is_task(str(start))


def _path(robot: str | os.PathLike | None) -> Path | None:
    return None if robot is None else Path(robot)


def _of_policy(
    policy: str | os.PathLike,
    task: str | type[Task] | None,
    world: World,
    robot: Path | None,
    settings: Mapping[str, Any],
) -> WorldConfig:
    """The settings of the environment of a policy's training, in a world, with settings on top.

    Args:
      task: its class or its name, if the user has named it.

    Raises:
      UserError: there is no such policy, it is of another task, its file is not enough, or it would
        not be its environment.
    """
    path = policy_path(policy)
    if not os.path.exists(path):
        known = (*POLICIES, *registered_tasks())
        advice = suggest(str(policy), known)
        advice = advice or f"give {', '.join(POLICIES)}, a run's folder or an .onnx file"
        raise UserError(f"there is no policy {shorten(str(policy))}; {advice}")
    if path.suffix == ONNX:
        trained = _environment_in_file(path, settings.get("mjcf"))
    else:
        trained = load_run_config(run_of(path)).env
    name = task_name(task) if isinstance(task, type) else task
    name_of_policy = task_name(trained.task)
    if name is not None and name != name_of_policy:
        raise UserError(
            f"the policy {policy} is of the task {name_of_policy}, and the environment of the task "
            f"{name}; leave one of them out"
        )
    config = with_settings(settings_in_world(trained, world, robot), settings)
    check_interface(
        interface_of(trained),
        interface_of(config),
        str(policy),
        "leave these settings out, or make the environment without the policy",
    )
    return config


def _environment_in_file(path: Path, mjcf: Any) -> WorldConfig:
    """The environment in a policy's ONNX file.

    Raises:
      UserError: its arm or its task is in a file that it does not hold.
    """
    # Needs onnxruntime.
    from bounce_mjx.deploy.loading import load_policy

    metadata = load_policy(path).metadata
    values = metadata.environment
    name = metadata.task
    if not is_task(name):
        raise not_imported(str(path), "task", name, None)
    if values["mjcf"] is not None and not is_packaged(values["mjcf"]):
        if mjcf is None:
            raise UserError(
                f"{path} is for the arm {metadata.robot}, whose MJCF file it does not hold; give "
                "it as mjcf=FILE, or give the run's folder as the policy"
            )
        values = dict(values) | {"mjcf": mjcf}
    return validate(task_config(name), values, str(path))
