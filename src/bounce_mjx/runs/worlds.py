"""Robots and worlds: as layers of a training's settings, and the environment of a training in
another world."""

import os
from pathlib import Path
from typing import Any

from bounce_mjx.config.settings import Layer, merged
from bounce_mjx.config.validation import validate
from bounce_mjx.errors import UserError
from bounce_mjx.runs.config import task_in
from bounce_mjx.runs.presets import ROBOTS, WORLDS, named_file, read_config_file, shown_file
from bounce_mjx.task.registry import DEFAULT
from bounce_mjx.task.task import Task
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.named import CURRICULUM, NamedWorld, read_world
from bounce_mjx.world.randomization import RandomizationConfig

NOMINAL = "nominal"
"""World: the model's own."""
TRAINING = "training"
"""World: each that a policy's training sampled."""


def robot_and_world(
    robot: Path | None, world: Path | None, task: type[Task], trained: WorldConfig | None
) -> tuple[list[Layer], list[Layer]]:
    """The layers of a robot, which may be that of the world, and of a world: none or one of each.

    Args:
      robot: a file, or a name in configs/robots/.
      world: a file, or a name in configs/worlds/.
      trained: the environment of a policy that goes into the world, with its own robot.

    Raises:
      UserError: one of them is missing or wrong, or the world is of another robot.
    """
    robots = []
    if robot is not None:
        robots.append(_layer_of_robot(task, named_file(robot, ROBOTS, "robot")))
    if world is None:
        return robots, []
    path = named_file(world, WORLDS, "world")
    named = read_world(path)
    if named.robot is not None:
        if robots:
            raise UserError(
                f"{path} is for the robot {named.robot}, and a robot is given too; leave it out"
            )
        if trained is None:
            robots.append(_layer_of_robot(task, _robot_of(named, path)))
        else:
            robots.append(_layer_of_same_robot(trained, named, path))
    return robots, [_layer_of_world(task, named, path)]


def env_of_task(
    task: type[Task], robot: Path | None = None, world: str | os.PathLike | None = None
) -> WorldConfig:
    """The environment of a task with a robot, in a world.

    Args:
      robot: a file, or a name in configs/robots/.
      world: as for `trained_in`, but for that of a training.

    Raises:
      UserError: one of them is missing or wrong, or the world is of another robot.
    """
    if world == TRAINING:
        raise UserError(
            f"the world {TRAINING} is that of a policy; give a policy, or a named world"
        )
    named = None if world in (None, NOMINAL) else Path(world)
    robots, worlds = robot_and_world(robot, named, task, None)
    values: dict[str, Any] = {}
    for layer in (*robots, *worlds):
        values = merged(values, layer.values)
    source = " on ".join(layer.source for layer in (*worlds, *robots)) or task.__name__
    return validate(task.Config, values.get("env", {}), source, "env")


def trained_in(trained: WorldConfig, world: str | os.PathLike | None) -> WorldConfig:
    """The environment of a training in a world, with the observation and the actions of its policy.

    Args:
      world: None for each world that the training sampled, as it did; training for the same without
        its curriculum; nominal for the model's own; or a named world's file or name in
        configs/worlds/.

    Raises:
      UserError: the world is missing or wrong, or of another robot than the training.
    """
    if world is None:
        return trained
    if world == NOMINAL:
        return trained.in_world(RandomizationConfig())
    if world == TRAINING:
        ended = {"warmup_steps": 0, "first_goal_range": 1.0}
        randomization = trained.randomization.model_copy(update=ended)
        return trained.model_copy(update={"randomization": randomization})
    return in_named_world(trained, Path(world))[0]


def in_named_world(trained: WorldConfig, world: Path) -> tuple[WorldConfig, NamedWorld]:
    """`trained_in` of a named world, and the world itself.

    Raises:
      UserError: the world is wrong, or of another robot than the training.
    """
    path = named_file(world, WORLDS, "world")
    named = read_world(path)
    values = trained.model_dump()
    # The curriculum of the training goes too.
    del values["randomization"]
    if named.robot is not None:
        values = merged(values, _layer_of_same_robot(trained, named, path).values["env"])
    values = merged(values, _settings_for(type(trained).task, named))
    return validate(type(trained), values, f"the world {shown_file(path)}", "env"), named


def in_sampled_world(trained: WorldConfig, randomization: RandomizationConfig) -> WorldConfig:
    """The environment of a training with the terms of the world that a user gives, if any, in place
    of its own.

    Raises:
      UserError: a term does not fit the arm, or what is given has no term to act on.
    """
    if randomization.terms:
        given = dict(trained.in_world(randomization))
        return validate(type(trained), given, "the flags --randomization")
    if randomization != RandomizationConfig():
        raise UserError(
            "--randomization is given without a term of the world, such as "
            "--randomization.air-drag 0 0.2; give one, or omit it"
        )
    return trained


def _layer_of_world(task: type[Task], world: NamedWorld, path: Path) -> Layer:
    """A named world's settings. Its randomisation is the whole one, but for the curriculum, which
    describes the training: a term that it does not have is as in the task."""
    default = task.Config().randomization.model_dump(exclude=set(CURRICULUM))
    values = merged({"env": {"randomization": default}}, {"env": _settings_for(task, world)})
    return Layer(f"the world {shown_file(path)}", values, is_world=True)


def _settings_for(task: type[Task], world: NamedWorld) -> dict[str, Any]:
    """A named world's settings of `env`, without how well a person drops the ball if the task's
    ball is not dropped."""
    settings = world.settings
    randomization = settings.get("randomization", {})
    if task.ball_dropped or "ball_start" not in randomization:
        return settings
    others = {key: value for key, value in randomization.items() if key != "ball_start"}
    return settings | {"randomization": others}


def robot_in_world(robot: Path, world: Path) -> str:
    """How a world's file names its robot: one of the package's by its name, a file relative to the
    world's.

    Args:
      robot: a file, or a name in configs/robots/.
      world: the world's file.
    """
    if named_file(robot, ROBOTS) != robot or robot.is_absolute():
        return str(robot)
    return os.path.relpath(robot, world.parent)


def _robot_of(world: NamedWorld, path: Path) -> Path:
    """The file of a world's robot: one of the package's, or one relative to the world's file."""
    robot = named_file(Path(world.robot), ROBOTS)
    return robot if robot != Path(world.robot) else path.parent / robot


def _read_robot(robot: Path) -> tuple[dict[str, Any], type[Task], WorldConfig]:
    """The values of a robot's config but for its task, that task, and its environment."""
    values = read_config_file(robot, "robot's config file", f"{ROBOTS}/ur5e.yaml")
    task = task_in(str(robot), values.pop("task", DEFAULT))
    return values, task, validate(task.Config, values.get("env", {}), str(robot), "env")


def _layer_of_robot(task: type[Task], robot: Path) -> Layer:
    """A robot's settings for a task. Of a file that was written for another task, the keys of the
    world count alone; the task's own settings follow from where the arm holds the paddle."""
    source = f"the robot {shown_file(robot)}"
    values, its_task, env = _read_robot(robot)
    if issubclass(task, its_task):
        return Layer(source, values)
    of_task = values.get("env", {})
    of_world = {key: value for key, value in of_task.items() if key in WorldConfig.model_fields}
    # Imports JAX, which a command line alone does not need.
    from bounce_mjx.robot.model import paddle_home

    home = paddle_home(env.mjcf, env.robot, env.default_joint_angles, env.physics_dt, env.num_balls)
    return Layer(source, values | {"env": of_world | task.Config.settings_at(home)})


def _layer_of_same_robot(trained: WorldConfig, world: NamedWorld, path: Path) -> Layer:
    """What a world's robot has, of a policy that was trained with it, such as its limits.

    Raises:
      UserError: the policy was trained with another robot.
    """
    robot = _robot_of(world, path)
    _, _, own = _read_robot(robot)
    files = {(arm.mjcf or Path()).name for arm in (own, trained)}
    if len(files) > 1 or own.default_joint_angles != trained.default_joint_angles:
        raise UserError(
            f"the world {path} is for the robot {world.robot}, and the policy was trained "
            "with another arm or start pose; give a world without a robot, such as fast_servo"
        )
    values = {"env": {"robot": own.robot.model_dump(exclude_unset=True)}}
    return Layer(f"the robot {shown_file(robot)}", values)
