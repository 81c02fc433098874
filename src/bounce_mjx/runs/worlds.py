"""The settings of the environment of a task, or of a policy's training, in a world:
`settings_in_world`. Whoever names a world asks it: `deploy.environments`, which makes the `Env` of
Python and of the adapters, and the commands. What acts with a policy where it was trained, such as
`export`, takes the settings of its run as they are (`load_run_config`).

They are layers (`Layer`), the lowest first: what the policy was trained in, its robot, and
its world (`layers_of_environment`). A training has further layers between them (`runs/layers.py`).

A world (`World`) is a part of these settings (`WorldConfig`): the randomisation, and what else a
named world's file sets of `WorldSettings`, such as friction.
"""

import os
from pathlib import Path
from typing import Any, NamedTuple

from bounce_mjx.config.settings import merged
from bounce_mjx.config.validation import validate
from bounce_mjx.errors import UserError
from bounce_mjx.runs.config import task_named_by
from bounce_mjx.runs.presets import ROBOTS, WORLDS, named_file, read_config_file, shown_file
from bounce_mjx.task.registry import DEFAULT
from bounce_mjx.task.task import Task
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.named import CURRICULUM, NamedWorld, read_world
from bounce_mjx.world.randomization import RandomizationConfig

OWN = "own"
"""World: the own one, as it is: of a policy, each that its training sampled; of a task, that of its
defaults, such as the pushes of balance."""
TRAINING = "training"
"""World: each that a policy's training sampled, without its curriculum."""
NOMINAL = "nominal"
"""World: the model's; the goals stay as they are. (`EvaluationOptions.nominal`, the flag --nominal
of `eval`, is this world and fixed goals: `evaluation.policy_evaluation.setup_of`.)"""

World = str | os.PathLike | RandomizationConfig
"""`OWN`, `TRAINING` or `NOMINAL`; the file of a named world, or its name in configs/worlds/;
or, of a policy, the terms of a user's own. Where a user may leave the world out, `None` is replaced
by one of these at once: of a policy, `environment` and `Run.env` take `NOMINAL`, `eval` and `play`
`OWN`, `rehearse` `TRAINING`."""


class Layer(NamedTuple):
    """The settings of one source."""

    source: str
    """For people, such as configs/cpu.yaml."""
    values: dict[str, Any]
    """Nested, with the keys of `TrainConfig`."""
    is_world: bool = False
    """Whether its values are of all terms of the randomisation. A preset's curriculum of terms that
    this world does not have is dropped (`without_idle_curriculum`)."""
    replaces: tuple[str, ...] = ()
    """Dotted keys of which nothing remains of the layers below, also where they are mappings, such
    as `shares`."""


class EnvironmentLayers(NamedTuple):
    """The settings of an environment, the lowest first; each is one layer or none."""

    policy: list[Layer]
    """What the policy was trained in; in a named world, without its randomisation."""
    robot: list[Layer]
    """The user's robot, or that of the world."""
    world: list[Layer]
    """A named world."""


def settings_in_world(
    task_or_config: type[Task] | WorldConfig, world: World, robot: Path | None = None
) -> WorldConfig:
    """The settings of the environment of a task, or of a policy's training with its observation and
    its actions, in a world.

    Args:
      task_or_config: a task, or the config of a policy's environment.
      robot: of a task: a file, or a name in configs/robots/.

    Raises:
      UserError: the robot or the world is missing or wrong, the world is of another robot, a policy
        or a term does not fit the arm, or a task has no training's worlds.
    """
    if world == NOMINAL:
        return settings_in_world(task_or_config, OWN, robot).in_world(RandomizationConfig())
    if not isinstance(task_or_config, WorldConfig):
        task = task_or_config
        if world == TRAINING:
            raise UserError(
                f"the world {TRAINING} is that of a policy; give a policy, or a named world"
            )
        named = None if world == OWN else Path(world)
        return _merged(task.Config, layers_of_environment(task, None, robot, named))
    config = task_or_config
    _check_one_robot(config, robot)
    if world == OWN:
        return config
    if world == TRAINING:
        ended = {"warmup_steps": 0, "first_goal_range": 1.0}
        randomization = config.randomization.model_copy(update=ended)
        return config.model_copy(update={"randomization": randomization})
    if isinstance(world, RandomizationConfig):
        return validate(type(config), dict(config.in_world(world)), "the randomization")
    layers = layers_of_environment(type(config).task, config, None, Path(world))
    return _merged(type(config), layers)


def _check_one_robot(trained: WorldConfig | None, robot: Path | None) -> None:
    """Raises UserError for a robot beside that of a policy or a config."""
    if trained is not None and robot is not None:
        raise UserError(
            f"the robot {robot} is given, and a policy or a config brings its own; leave robot out"
        )


def _merged(config_class: type[WorldConfig], layers: EnvironmentLayers) -> WorldConfig:
    """The environment of layers."""
    values: dict[str, Any] = {}
    for layer in (*layers.policy, *layers.robot, *layers.world):
        values = merged(values, layer.values)
    sources = [layer.source for layer in (*layers.world, *layers.robot)]
    source = " on ".join(sources) or config_class.__qualname__
    return validate(config_class, values.get("env", {}), source, "env")


def layers_of_environment(
    task: type[Task], trained: WorldConfig | None, robot: Path | None, world: Path | None
) -> EnvironmentLayers:
    """The layers of an environment.

    Args:
      trained: the environment of a policy, which has its own robot.
      robot: a file, or a name in configs/robots/.
      world: a file, or a name in configs/worlds/.

    Raises:
      UserError: one of them is missing or wrong, or the world is of another robot.
    """
    _check_one_robot(trained, robot)
    policies = [] if trained is None else [_layer_of_policy(trained, world is not None)]
    robots = []
    if robot is not None:
        robots.append(_layer_of_robot(task, named_file(robot, ROBOTS, "robot")))
    if world is None:
        return EnvironmentLayers(policies, robots, [])
    path, named = read_named_world(world)
    if named.robot is not None:
        if robots:
            raise UserError(
                f"{path} is for the robot {named.robot}, and a robot is given too; leave it out"
            )
        if trained is None:
            robots.append(_layer_of_robot(task, _robot_of(named, path)))
        else:
            robots.append(_layer_of_same_robot(trained, named, path))
    return EnvironmentLayers(policies, robots, [_layer_of_world(task, named, path)])


def read_named_world(world: Path) -> tuple[Path, NamedWorld]:
    """The file of a named world, and the world.

    Args:
      world: a file, or a name in configs/worlds/.

    Raises:
      UserError: it is missing or wrong.
    """
    path = named_file(world, WORLDS, "world")
    return path, read_world(path)


def _layer_of_policy(trained: WorldConfig, is_in_world: bool) -> Layer:
    """What a policy was trained in. A named world replaces the randomisation, with its
    curriculum."""
    env = trained.model_dump()
    if is_in_world:
        del env["randomization"]
    return Layer("the policy", {"env": env}, replaces=tuple(f"env.{key}" for key in env))


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
    task = task_named_by(str(robot), values.pop("task", DEFAULT))
    return values, task, validate(task.Config, values.get("env", {}), str(robot), "env")


def _layer_of_robot(task: type[Task], robot: Path) -> Layer:
    """A robot's settings for a task. If its file was written for another task, only those keys of
    its `env` count that every task has, and the task's own follow from where the arm holds the
    paddle; what it says of the training, such as `ppo`, counts for any task."""
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
