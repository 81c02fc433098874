"""The settings of a training run, and their YAML file."""

import functools
import importlib.metadata
import importlib.util
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import pydantic
from pydantic import Field

from bounce_mjx.config.files import read_mapping
from bounce_mjx.config.settings import Count, NonNegativeInt, Steps, StrictModel, merged
from bounce_mjx.config.validation import validate
from bounce_mjx.errors import UserError, shorten
from bounce_mjx.lazy import jax
from bounce_mjx.learning.config import PPO_NAME, PPOConfig, find_algorithm
from bounce_mjx.resources import PRETRAINED, resource_path
from bounce_mjx.robot.config import is_packaged
from bounce_mjx.runs.files import check_integrity
from bounce_mjx.task.task import Task
from bounce_mjx.tasks import registry
from bounce_mjx.tasks.registry import DEFAULT, find_task, is_file
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.named import NamedWorld, read_world

CONFIG_FILE = "config.yaml"
BASE = "base"
"""Key of a config file with the name of the preset on which it lies, or null for none."""
ROBOT = "robot"
"""Folder of a run with a copy of its robot."""
ROBOTS = "configs/robots"
"""Folder of the package with configs of robots."""
WORLDS = "configs/worlds"
"""Folder of the package with named worlds."""

_EXAMPLE = "configs/default.yaml"

ConfigT = TypeVar("ConfigT", bound=StrictModel)


class TrainConfig(StrictModel):
    """A training run: the task, the trainer, the length and the evaluations."""

    task: str = DEFAULT
    """Name of the task, or FILE.py:CLASS for your own."""
    env: pydantic.SerializeAsAny[WorldConfig]
    """The world and the task."""
    algorithm: str = PPO_NAME
    """ppo, or FILE.py:CLASS for a subclass of `bounce_mjx.learning.ppo.PPO`."""
    ppo: pydantic.SerializeAsAny[PPOConfig] = PPOConfig()
    """The trainer."""
    seed: NonNegativeInt = 0
    """Seed of the run."""
    num_seeds: Count = 1
    """Independent training runs in one program, with the seeds `seed`, `seed` + 1, ... and a folder
    for each."""
    num_devices: Count | None = None
    """Devices that share the environments (with several seeds: the seeds); null for one, or all on
    several hosts."""
    total_steps: Steps = 50_000_000
    """Environment steps to train for, rounded to whole blocks, at least one."""
    block_steps: Steps = 1_000_000
    """Environment steps between two progress reports, rounded to whole iterations."""
    eval_every: Steps = 2_000_000
    """Environment steps between two evaluations, rounded to whole blocks."""
    eval_episodes: Count = 1024
    """Episodes of an evaluation of the results."""
    screening_episodes: NonNegativeInt = 0
    """Episodes of a cheap first evaluation, which must pass before the full one; 0 for none."""
    eval_seed: NonNegativeInt = 10_000
    """Seed of the evaluations during training."""
    stop_when_solved: bool = False
    """End once an evaluation meets all results with a margin. Then 64 other episodes should meet
    them too. It ends at the latest after 1.5 times the steps of the first one that meets all."""
    warm_start: Path | None = None
    """Run, or policy of the package, from whose networks and environment the training starts."""
    log_dir: Path
    """Folder in which the run creates its own, named by the time (UTC)."""

    def __eq__(self, other: object) -> bool:
        """Equal settings are equal, whichever class of `train_config` has them."""
        return isinstance(other, TrainConfig) and dict(self) == dict(other)

    @pydantic.field_validator("task", "algorithm")
    @classmethod
    def _make_absolute(cls, name: str) -> str:
        """A run's config is read from other folders too."""
        return f"{registry.source_file(name)}:{name.rpartition(':')[2]}" if is_file(name) else name

    @pydantic.model_validator(mode="before")
    @classmethod
    def _complete(cls, values: Any) -> Any:
        """The task and the settings that belong to it determine each other. Whatever acts with a
        policy needs no settings of its own algorithm, whose code is not run."""
        if not isinstance(values, dict):
            return values
        ppo, name = values.get("ppo"), str(values.get("algorithm"))
        if cls.model_fields["ppo"].annotation is PPOConfig and is_file(name):
            if isinstance(ppo, dict):
                values = values | {"ppo": {k: ppo[k] for k in ppo if k in PPOConfig.model_fields}}
        if not cls.model_fields["env"].is_required():
            return values
        env = values.get("env")
        if "task" not in values and isinstance(env, WorldConfig) and env.task is not None:
            values = values | {"task": registry.task_name(env.task)}
        task = env.task if isinstance(env, WorldConfig) else find_task(values.get("task", DEFAULT))
        values = {"env": {}, "log_dir": runs_folder(task)} | values
        return values | {"env": task.Config.model_validate(values["env"])}


@functools.cache
def train_config(
    task: type[Task], base: type[ConfigT] = TrainConfig, ppo: type[PPOConfig] = PPOConfig
) -> type[ConfigT]:
    """The class `base` with the settings of a task and of an algorithm: the fields `env` and `ppo`,
    and defaults of others.

    Args:
      task: the task, as from `find_task`.
      base: `TrainConfig`, or the command line that trains.
      ppo: settings of the algorithm.
    """
    own = {"task": (str, registry.task_name(task)), "log_dir": (Path, runs_folder(task))}
    own |= {"env": (task.Config, task.Config()), "ppo": (ppo, ppo())}
    fields = {}
    for name, (kind, default) in own.items():
        if (field := base.model_fields.get(name)) is not None:
            kind = Annotated[kind, *field.metadata] if field.metadata else kind
            fields[name] = kind, Field(default, description=field.description)
    return pydantic.create_model(
        base.__name__, __base__=base, __module__=base.__module__, __doc__=base.__doc__, **fields
    )


def runs_folder(task: type[Task]) -> Path:
    """Default folder of a task's runs."""
    # A task that extends another one has its own folder.
    return Path("runs") / (vars(task).get("folder") or task.__name__.lower())


def load_run_config(
    run: Path, task: str | None = None, algorithm: str | None = None
) -> TrainConfig:
    """Reads the resolved config of a run.

    Args:
      task: the task as the user names it. A run whose task is a file needs the name once in a
        process, because the file is code.
      algorithm: the algorithm as the user names it; needed only to train on.

    Raises:
      UserError: the file is missing or damaged, the run's copy of its robot was edited, or its task
        is a file that the user has not named.
    """
    path = run / CONFIG_FILE
    values = {"task": DEFAULT} | _read(path)
    values.pop(BASE, None)
    ppo = PPOConfig if algorithm is None else find_algorithm(algorithm).Config
    its_task = _task_of_run(values["task"], run, task)
    config = validate(train_config(its_task, ppo=ppo), values, str(path))
    if config.env.mjcf is not None and not is_packaged(config.env.mjcf):
        try:
            check_integrity(run / ROBOT)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise UserError(
                f"{run / ROBOT} is not the robot of the training ({reason}); restore that folder"
            ) from error
    return config


def _task_of_run(name: str, run: Path, given: str | None) -> type[Task]:
    """The task of a run; its copy of a task's file is not run unless the user has named code with
    the same content.

    Args:
      name: name in the run's config.
      given: name that the user gave, or None. Another file's task is taken with a warning.

    Raises:
      UserError: the user has not named the file; or the run has another task.
    """
    if given is not None:
        if not registry.is_same_code(name, given):
            if not is_file(name):
                raise UserError(f"{run} has the task {name}, and --task is {given}; leave it out")
            note = f"{given} differs from the task that {run} was trained with, {name}"
            print(f"warning: {note}", file=sys.stderr)
        if is_file(name):
            registry.admit(name, find_task(given))
    return _task_in(f"the run {run}", name)


def _task_in(source: str, name: str) -> type[Task]:
    """The task that a file or a run names.

    Raises:
      UserError: there is none, or it is in a file that the user has not named.
    """
    task = registry.known_task(name) if is_file(name) else find_task(name)
    if task is None:
        raise unnamed_code(source, "task", name)
    return task


def unnamed_code(source: str, key: str, name: str) -> UserError:
    """The refusal to run the file of a task or an algorithm that the user has not named."""
    return UserError(
        f"{source} has its {key} in a file, which is code; name it to run it: --{key} "
        f"{shlex.quote(name)}"
    )


def read_preset(
    path: Path | Sequence[Path] | None,
    robot: Path | None = None,
    task: str | None = None,
    world: Path | None = None,
    machine: Path | None = None,
    algorithm: str | None = None,
) -> TrainConfig:
    """Reads the config of the files in `preset_files`, with defaults for missing keys. A relative
    path of an MJCF file starts at the folder of its YAML file.

    Args:
      path: see `preset_files`.
      robot: config of a robot, whose keys win over the preset's: a YAML file, or the name of a file
        in configs/robots/.
      task: the task as the user names it; by default, the files'.
      world: a named world, which replaces the preset's and may have a robot: a YAML file, or the
        name of a file in configs/worlds/.
      machine: see `preset_files`.
      algorithm: the algorithm as the user names it; by default, the files'.

    Raises:
      UserError: a file is missing, is not a YAML mapping, has an unknown key or a bad value, or its
        task or algorithm is a file that the user has not named.
    """
    files = preset_files(path, task, machine)
    source = " on ".join(map(shown_file, reversed(files)))
    values = functools.reduce(merged, map(_read, files), {})
    values.pop(BASE, None)
    for key, given, default in (("task", task, DEFAULT), ("algorithm", algorithm, PPO_NAME)):
        name = values[key] = given or values.get(key, default)
        if given is None and is_file(name):
            raise unnamed_code(source, key, name)
    algorithm = values["algorithm"]
    ppo = PPOConfig if algorithm == PPO_NAME else find_algorithm(algorithm).Config
    config_class = train_config(find_task(values["task"]), ppo=ppo)
    robot = robot and named_file(robot, ROBOTS, "robot")
    world = world and named_file(world, WORLDS, "world")
    named = None if world is None else read_world(world)
    if named is not None and named.robot is not None:
        if robot is not None:
            raise UserError(
                f"{world} is for the robot {named.robot}, and a robot is given too; leave it out"
            )
        robot = _robot_of(named, world)
    if robot is not None:
        values = merged(values, _robot_for(config_class().env.task, robot))
        source = f"{source} with {robot}"
    config = validate(config_class, values, source)
    if named is None:
        return config
    values["env"] = named.applied(values.get("env") or {}, training=True)
    return validate(config_class, values, f"{source} in the world {world}")


def in_world(config: TrainConfig, world: Path) -> tuple[TrainConfig, NamedWorld]:
    """A run's config in a named world, with the observation and the actions of its policy.

    Args:
      world: a file, or the name of a file in configs/worlds/.

    Raises:
      UserError: the world is wrong, or of another robot than the run.
    """
    path = named_file(world, WORLDS, "world")
    named, env = read_world(path), config.env
    values = env.model_dump()
    if named.robot is not None:
        robot = _robot_of(named, path)
        own = read_preset(resource_path(_EXAMPLE), robot).env
        files = {(arm.mjcf or Path()).name for arm in (own, env)}
        if len(files) > 1 or own.default_joint_angles != env.default_joint_angles:
            raise UserError(
                f"the world {world} is for the robot {named.robot}, and the policy was trained "
                "with another arm or start pose; give a world without a robot, such as fast_servo"
            )
        values["robot"] = merged(values["robot"], own.robot.model_dump(exclude_unset=True))
    changed = validate(type(env), named.applied(values), f"the world {path}")
    return config.model_copy(update={"env": changed}), named


def _robot_of(world: NamedWorld, path: Path) -> Path:
    """The file of a world's robot: one of the package's, or one relative to the world's file."""
    robot = named_file(Path(world.robot), ROBOTS)
    return robot if robot != Path(world.robot) else path.parent / robot


def _robot_for(task: type[Task], robot: Path) -> dict[str, Any]:
    """The values of a robot's config for a task. Those of another task are replaced by the task's
    own for an arm with this paddle."""
    values = _read(robot, "robot's config file", f"{ROBOTS}/ur5e.yaml")
    name = values.pop("task", DEFAULT)
    its_task = _task_in(str(robot), name)
    known = validate(train_config(its_task), values, str(robot)).env
    if issubclass(task, its_task):
        return values
    world_keys = {k: v for k, v in values.get("env", {}).items() if k in WorldConfig.model_fields}
    # Imports JAX, which a command line alone does not need.
    from bounce_mjx.robot.model import paddle_home

    home = paddle_home(known.mjcf, known.robot, known.default_joint_angles)
    return values | {"env": world_keys | task.Config.settings_at(home)}


def preset_files(
    path: Path | Sequence[Path] | None, task: str | None = None, machine: Path | None = None
) -> list[Path]:
    """The files of a config, each of which lies on those before it.

    A preset of the package stands alone. A file of the user's lies on the preset for this machine,
    or on the one that its key `base` names; with `base: null`, as in a run's config, it stands
    alone.

    Args:
      path: a YAML file or the name of a file in configs/, or several, each of which lies on those
        before it; by default, the preset for this machine. A task may have its own preset of a
        name, in the folder of configs/ that has the task's name.
      task: the task as the user names it; by default, the files'.
      machine: name of the preset for this machine, where JAX's devices may not start yet.

    Raises:
      UserError: a file is missing or invalid, or names a base that is not used.
    """
    given = [path] if isinstance(path, Path) else list(path or ())
    known = functools.reduce(merged, map(_read, filter(os.path.exists, given)), {})
    names = f"configs/{task or known.get('task', DEFAULT)}"
    files = [named_file(named_file(file, names), "configs", "preset") for file in given]
    bases = {file: values[BASE] for file in files if BASE in (values := _read(file))}
    if unused := bases.keys() - files[:1]:
        raise UserError(
            f"{min(unused)} lies on {files[0]}, so its {BASE} is not used; give it first"
        )
    own = [resource_path(name).resolve() for name in ("configs", PRETRAINED)]
    is_preset = any(files[0].resolve().is_relative_to(folder) for folder in own if files)
    if is_preset or (files and bases.get(files[0], "") is None):
        return files
    base = bases[files[0]] if bases else machine or default_preset(has_accelerator())
    presets = [resource_path(f"{folder}/{base}.yaml") for folder in (names, "configs")]
    if not (found := list(filter(os.path.isfile, presets))):
        raise UserError(
            f"{files[0]}: {BASE} is {shorten(repr(base))}; give the name of a preset, or null"
        )
    return [found[0], *files]


def shown_file(file: Path) -> str:
    """A config file for the user's eyes: one of the package's without the package's folder."""
    package = resource_path("configs").parent
    return str(file.relative_to(package) if file.is_relative_to(package) else file)


def default_preset(accelerator: bool) -> Path:
    """The preset for a machine with an accelerator, or without one; both have the same task."""
    return Path("default" if accelerator else "cpu")


def named_file(path: Path, folder: str, kind: str | None = None) -> Path:
    """The YAML file in a folder of the package that a word names; the path itself if there is none,
    or if it is a file.

    Args:
      kind: kind of the file, to refuse a word that is neither a file nor a name.
    """
    if str(path) != path.stem or os.path.isfile(path):
        return path
    named = resource_path(f"{folder}/{path}.yaml")
    if kind is None or os.path.isfile(named):
        return named if os.path.isfile(named) else path
    names = sorted(file.stem for file in resource_path(folder).glob("*.yaml"))
    names = [name for name in names if not name.startswith("robustness")]
    raise UserError(
        f"no {kind} is named {shorten(str(path))}; give one of {', '.join(names)}, or a YAML file"
    )


def has_accelerator() -> bool:
    """Whether JAX computes on an accelerator by default. This starts JAX's devices if a plugin for
    one is installed."""
    return has_plugin() and jax.default_backend() != "cpu"


def has_plugin() -> bool:
    """Whether a plugin of JAX's for an accelerator is installed."""
    plugins = importlib.metadata.entry_points(group="jax_plugins")
    names = ("jax_plugins", "libtpu")
    return bool(plugins) or any(importlib.util.find_spec(name) for name in names)


def _read(path: Path, kind: str = "config file", example: str = _EXAMPLE) -> dict[str, Any]:
    """The values of a config file (`read_mapping`), with absolute paths of the MJCF file and of the
    files of the task and the algorithm."""
    values = read_mapping(path, kind, example)
    for key in {"task", "algorithm"} & values.keys():
        name = str(values[key])
        own = is_file(name) and not name.startswith("~")
        values = values | {key: str((path.parent / name).absolute()) if own else name}
    env = values.get("env")
    mjcf = env.get("mjcf") if isinstance(env, dict) else None
    if isinstance(mjcf, str) and not mjcf.startswith("~") and not is_packaged(Path(mjcf)):
        values = values | {"env": env | {"mjcf": str(path.parent / mjcf)}}
    return values
