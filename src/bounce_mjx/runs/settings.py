"""The settings of a training, from wherever they come.

They are layers, and a later one wins:

    1. the defaults of the task and of the algorithm
    2. the preset for this machine
    3. what the user's own algorithm changes of PPO's defaults
    4. a preset that the user names, in place of the machine's
    5. --warm-start: the environment and the networks of a policy, whether a flag or a file of the
       user's names it
    6. the user's files and further presets, each on those before it
    7. --robot, or the robot of --world
    8. --world
    9. what the user says: flags of the command, or arguments of `train`

A resumed run has two: its own config, and what the user says; more steps end its
`stop_when_solved` where that had ended it (`Stack._go_on`). `stack` finds the layers below the
user's. `Stack.config` merges all of them and validates the result, once; the config then knows what
set each of its values (`TrainConfig.sources`).
"""

import dataclasses
import functools
import itertools
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import pydantic
from pydantic.fields import FieldInfo

from bounce_mjx.config.command_line import Flag
from bounce_mjx.config.files import differing_keys, flat
from bounce_mjx.config.settings import Layer, StrictModel, default_of, has_default, merged, nested
from bounce_mjx.config.user_code import is_file, is_same_code
from bounce_mjx.config.validation import describe, groups_of, path_of, validate
from bounce_mjx.errors import UserError, shorten
from bounce_mjx.learning.config import PPO_NAME, PPOConfig
from bounce_mjx.learning.registry import find_algorithm
from bounce_mjx.resources import policy_folder
from bounce_mjx.runs.config import (
    CONFIG_FILE,
    DEFAULT_SOURCE,
    RESUMABLE_KEYS,
    TrainConfig,
    fields_of,
    load_run_config,
    runs_folder,
    unnamed_code,
)
from bounce_mjx.runs.presets import BASE, SOURCES, preset_files, read_config_file, shown_file
from bounce_mjx.runs.worlds import robot_and_world
from bounce_mjx.task.registry import DEFAULT, find_task
from bounce_mjx.task.task import Task
from bounce_mjx.world.named import without_idle_curriculum

FLAGS = "flags"
"""Source of the settings on a command line."""
PYTHON = "train"
"""Source of the arguments of `train`."""


class Choice(StrictModel):
    """What decides which layers there are: flags of the command, and arguments of `train`."""

    config: Annotated[tuple[Path, ...], Flag(metavar="NAME|FILE", is_repeated=True)] = ()
    """Preset, such as cpu or finetune (a YAML file in configs/), or a YAML file of yours. A task's
    own preset of that name, such as configs/track/cpu.yaml, has priority. The default is default on
    an accelerator, and cpu on a CPU. A file of yours lies on that default, or on the preset that
    its key base names. Given again, each file lies on those before it."""
    robot: Annotated[Path | None, Flag(metavar="NAME|FILE")] = None
    """Config of a robot on top of the preset: the file that bounce-mjx adopt wrote, or the name of
    one in configs/robots/ (ur5e, panda or iiwa)."""
    world: Annotated[Path | None, Flag(metavar="NAME|FILE")] = None
    """Named world in place of the preset's: a YAML file, or the name of one in configs/worlds/
    (ur5e_rtde, panda_fci, iiwa_fri or fast_servo). It may have a robot."""
    resume: Path | None = None
    """Folder of a run, or latest for the newest run, to continue in place from its newest
    checkpoint; or a checkpoint in it, which then counts as the newest. The other flags may then
    change only total-steps, eval-every, save-every, eval-episodes, screening-episodes, eval-seed,
    stop-when-solved, num-devices and log-dir. With total-steps, a run that has met all results
    continues."""

    # Keys of the config too, where their docstrings are. The folder is asked only for `latest`.
    task: str | None = None
    algorithm: str | None = None
    warm_start: Path | None = None
    log_dir: Path | None = None


# Reading: what lies on what ---------------------------------------------------------------------


def stack(
    choice: Choice, machine: Path | None = None, whole_config: TrainConfig | None = None
) -> "Stack":
    """The layers of a choice, without what the user says.

    Args:
      machine: the machine's preset; None asks JAX, which starts its devices.
      whole_config: a config that takes the place of files, and stands alone.

    Raises:
      UserError: a file or a run is missing or wrong, two parts of the choice exclude each other, or
        a task or an algorithm is a file that the user has not named.
    """
    if choice.resume is not None:
        return _stack_of_run(choice, whole_config)
    # The task decides which file a preset's name stands for, so that only a path can name a task or
    # a warm start. These files are read again below, in their places.
    paths = [file for file in choice.config if os.path.isfile(file)]
    from_paths = _layers_of_files(paths) if whole_config is None else [_layer_of(whole_config)]
    policy = _policy(choice, from_paths, whole_config)
    task_name, task = _task(choice, from_paths, policy, whole_config)
    machines: list[Layer] = []
    named: list[Layer] = []
    files = from_paths
    if whole_config is None:
        found = preset_files(choice.config, task_name, machine)
        machines = _layers_of_files([found.machine])
        named = _layers_of_files([found.named])
        files = _layers_of_files(found.own)
    algorithm_name, algorithm = _algorithm(choice, [*machines, *named, *files], whole_config)
    changed = _changed_defaults(algorithm)
    start = [] if policy is None else [policy.layer(is_in_world=choice.world is not None)]
    policy_notes = () if policy is None else policy.notes
    trained = None if policy is None else policy.config.env
    robot, world = robot_and_world(choice.robot, choice.world, task, trained)
    decided = {"task": task_name, "algorithm": algorithm_name}
    if policy is not None:
        decided["warm_start"] = policy.start
    return Stack(
        task=task,
        algorithm=algorithm,
        layers=(*machines, *changed, *named, *start, *files, *robot, *world),
        decided=decided,
        notes=(*policy_notes, *_notes(changed, named, "ppo."), *_notes(named, start, "env.")),
    )


def _stack_of_run(choice: Choice, whole_config: TrainConfig | None) -> "Stack":
    """The layer of a run that is resumed."""
    from bounce_mjx.runs.folders import find_run, is_newest, named_run

    excluded = {
        "config": choice.config or whole_config is not None,
        "robot": choice.robot,
        "world": choice.world,
    }
    for name, is_given in excluded.items():
        if is_given:
            raise UserError(f"{name} and resume cannot be combined; leave one out")
    if choice.log_dir is not None and not is_newest(choice.resume):
        raise UserError(
            f"log_dir is where the newest run is looked for, and {choice.resume} is named; omit "
            "one of them"
        )
    log_dir = choice.log_dir or runs_folder(find_task(choice.task or DEFAULT))
    resume = named_run(choice.resume, log_dir)
    run = find_run(resume)
    # First, since the run's settings are no settings of another task or algorithm.
    stored = {"task": DEFAULT, "algorithm": PPO_NAME} | read_config_file(run / CONFIG_FILE)
    for key in ("task", "algorithm"):
        asked = getattr(choice, key)
        if asked is not None and not is_same_code(stored[key], asked):
            raise UserError(
                f"--resume cannot change the {key}, and {asked} differs from {stored[key]}; "
                "restore it, name the run's copy, or start a new run"
            )
    config = load_run_config(run, choice.task, choice.algorithm)
    if is_file(config.algorithm) and choice.algorithm is None:
        raise unnamed_code(f"the run {run}", "algorithm", config.algorithm)
    return Stack(
        task=config.env.task,
        algorithm=type(config.ppo),
        layers=(Layer(f"the run {run}", config.model_dump()),),
        decided={"task": config.task, "algorithm": config.algorithm},
        resume=resume,
        resumed=config,
    )


def _layers_of_files(files: Iterable[Path | None]) -> list[Layer]:
    """A layer of each file; none for None."""
    layers = []
    for file in files:
        if file is not None:
            values = read_config_file(file)
            values.pop(BASE, None)
            values.pop(SOURCES, None)
            layers.append(Layer(shown_file(file), values))
    return layers


def _layer_of(config: TrainConfig) -> Layer:
    return Layer("config", config.model_dump(), whole=("env", "ppo"))


def _last(layers: Sequence[Layer], key: str) -> Any:
    """The value of a key in the last layer that has it; None without one."""
    return next((layer.values[key] for layer in reversed(layers) if key in layer.values), None)


def _last_path(layers: Sequence[Layer], key: str) -> Path | None:
    """`_last` of a path of the config, which is needed before the config is validated.

    Raises:
      UserError: it is no path.
    """
    layer = next((layer for layer in reversed(layers) if key in layer.values), None)
    if layer is None or layer.values[key] is None:
        return None
    config = validate(TrainConfig, {key: layer.values[key]}, layer.source)
    return getattr(config, key)


def _task(
    choice: Choice,
    files: Sequence[Layer],
    policy: "_Policy | None",
    whole_config: TrainConfig | None,
) -> tuple[str, type[Task]]:
    """Name and class of the task: the user's, the files', or that of the policy.

    Raises:
      UserError: there is none, or it is a file that the user has not named.
    """
    if whole_config is not None:
        if choice.task is not None and not is_same_code(choice.task, whole_config.task):
            raise UserError(
                f"the config is of the task {whole_config.task}, and task is {choice.task}; leave "
                "it out"
            )
        return whole_config.task, whole_config.env.task
    if choice.task is not None:
        return choice.task, find_task(choice.task)
    name = _last(files, "task")
    if name is not None:
        if is_file(name):
            raise unnamed_code(_title_of(files), "task", name)
        return name, find_task(name)
    if policy is not None:
        return policy.config.task, policy.config.env.task
    return DEFAULT, find_task(DEFAULT)


def _algorithm(
    choice: Choice, layers: Sequence[Layer], whole_config: TrainConfig | None
) -> tuple[str, type[PPOConfig]]:
    """Name and settings of the algorithm.

    Raises:
      UserError: there is none, or it is a file that the user has not named.
    """
    if whole_config is not None and choice.algorithm is None:
        settings = _settings_of(whole_config.algorithm)
        # Code that was imported otherwise has another class of the same name.
        if settings.__qualname__ != type(whole_config.ppo).__qualname__:
            raise UserError(
                f"the config's ppo is {type(whole_config.ppo).__qualname__}, and its algorithm "
                f"{whole_config.algorithm} has {settings.__qualname__}; name the algorithm that "
                "has them"
            )
        return whole_config.algorithm, type(whole_config.ppo)
    name = choice.algorithm or _last(layers, "algorithm") or PPO_NAME
    if choice.algorithm is None and is_file(name):
        raise unnamed_code(_title_of(layers), "algorithm", name)
    return name, _settings_of(name)


def _settings_of(algorithm: str) -> type[PPOConfig]:
    """The settings of an algorithm by its name; PPO's without the import of JAX."""
    return PPOConfig if algorithm == PPO_NAME else find_algorithm(algorithm).Config


def _title_of(layers: Sequence[Layer]) -> str:
    """The sources of the layers in words, the last first."""
    return " on ".join(layer.source for layer in reversed(layers))


def _changed_defaults(algorithm: type[PPOConfig]) -> list[Layer]:
    """What an algorithm of the user's changes of PPO's defaults: it means these values, unlike a
    preset that was made for PPO. They are a layer, so that they lie above the machine's preset."""
    changed = {}
    for key, field in PPOConfig.model_fields.items():
        own_field = algorithm.model_fields[key]
        # A narrower type without a default says nothing of the value.
        if has_default(own_field) and default_of(own_field) != field.default:
            changed[key] = default_of(own_field)
    return [Layer(f"defaults of {algorithm.__qualname__}", {"ppo": changed})] if changed else []


def _notes(below: list[Layer], above: list[Layer], prefix: str) -> list[str]:
    """A line where a layer changes settings, whose keys begin with a prefix, of one below it."""
    notes = []
    for lower, upper in itertools.product(below, above):
        after = flat(upper.values)
        changed = []
        for key, before in flat(lower.values).items():
            if key.startswith(prefix) and key in after:
                if _as_in_yaml(before) != _as_in_yaml(after[key]):
                    changed.append(key)
        if changed:
            notes.append(f"{upper.source} wins over {lower.source}: {', '.join(changed)}")
    return notes


def _as_in_yaml(value: Any) -> Any:
    """A value with lists in place of tuples, which YAML does not have."""
    return list(map(_as_in_yaml, value)) if isinstance(value, list | tuple) else value


class _Policy(NamedTuple):
    """The policy of a warm start."""

    start: Path
    """Its name, or its checkpoint's folder."""
    config: TrainConfig
    """The config of its run."""
    notes: tuple[str, ...]
    """Which run latest stands for."""

    def layer(self, is_in_world: bool) -> Layer:
        """Its task, environment and networks. A named world replaces the randomisation."""
        from bounce_mjx.runs.checkpoints import NETWORK_KEYS

        env = self.config.env.model_dump()
        if is_in_world:
            del env["randomization"]
        networks = self.config.ppo.model_dump(include={*NETWORK_KEYS, "critic_metrics"})
        values = {"task": self.config.task, "env": env, "ppo": networks}
        whole = tuple(f"env.{key}" for key in env)
        return Layer(f"the warm start {self.start}", values, whole=whole)


def _policy(
    choice: Choice, files: Sequence[Layer], whole_config: TrainConfig | None
) -> _Policy | None:
    """The policy of the warm start that the user or a file asks for.

    Raises:
      UserError: there is none, or a robot is given too.
    """
    if "warm_start" in choice.model_fields_set:
        path = choice.warm_start
    else:
        # A whole config has its environment already.
        path = _last_path(files, "warm_start") if whole_config is None else None
    if path is None:
        return None
    if choice.robot:
        raise UserError(
            "warm_start and robot cannot be combined, as the policy brings its arm; leave robot out"
        )
    from bounce_mjx.runs.folders import find_choice, runs_in

    task = choice.task or _last(files, "task")
    if choice.task is None and task is not None and is_file(task) and whole_config is None:
        raise unnamed_code(_title_of(files), "task", task)
    log_dir = choice.log_dir or _last_path(files, "log_dir")
    # A new folder has no run yet that latest could stand for.
    if log_dir is None or not runs_in(log_dir):
        log_dir = runs_folder(whole_config.env.task if whole_config else find_task(task or DEFAULT))
    checkpoint, note = find_choice(path, log_dir)
    config = load_run_config(checkpoint.run, task)
    start = path if policy_folder(path) else checkpoint.folder
    return _Policy(start, config, () if note is None else (note,))


# Merging and validating -------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Stack:
    """The layers below what the user says, the lowest first."""

    task: type[Task]
    algorithm: type[PPOConfig]
    """The settings of the algorithm."""
    layers: tuple[Layer, ...]
    decided: dict[str, Any]
    """Values that no layer changes any more, such as the checkpoint that a warm start found."""
    notes: tuple[str, ...] = ()
    """Which run latest stands for, and where a layer wins over another one that a user may have
    expected to win."""
    resume: Path | None = None
    """The resumed run's folder, or a checkpoint in it."""
    resumed: TrainConfig | None = None
    """Its config."""

    @functools.cached_property
    def fields(self) -> dict[str, FieldInfo]:
        """The settings that there are, by dotted key."""
        return fields_of(self.task.Config, self.algorithm)

    @property
    def title(self) -> str:
        """The sources of the layers in words, the last first."""
        return _title_of(self.layers)

    def config(
        self,
        said: Mapping[str, Any] | None = None,
        flags: Mapping[str, str] | None = None,
        prog: str = "",
    ) -> TrainConfig:
        """The typed config, with what the user says on top.

        Args:
          said: values by their keys. A key may be dotted, and one of `env` or `ppo` stand alone:
            num_envs for ppo.num_envs.
          flags: the flags of a command line by dotted key, for errors; None in Python.
          prog: the command, for errors.

        Raises:
          UserError: a key is unknown, a value is out of range, or it must be that of the resumed
            run. The error names the layer that set it.
        """
        user = self._layer_of_user(PYTHON if flags is None else FLAGS, said or {})
        above = [*self._go_on(user), user]
        layers = [*self.layers, *above]
        for layer in layers:
            self._check_groups(layer)
        values, sources = _merge(layers)
        values = merged(values, self.decided)
        try:
            config = self._validated(values)
        except _Mistake as mistake:
            source = _setter_of(mistake.path, layers)
            if flags is not None and source == FLAGS:
                text = describe(mistake.error, self.fields, flags, mistake.group)
                raise UserError(f"{text} (see {prog} --help)") from mistake.error
            text = describe(mistake.error, self.fields, group=mistake.group)
            if source != PYTHON and mistake.path in (["robot"], ["world"], ["resume"]):
                (name,) = mistake.path
                text = f"{name} is no setting; leave it out, and give --{name} or train({name}=...)"
            raise UserError(f"{shorten(source)}: {text}") from mistake.error
        if self.resumed is not None:
            _check_resumable(self.resumed, config)
            _, changed = _merge(above)
            sources = self.resumed.sources | changed
        config.set_sources(sources)
        return config

    def _check_groups(self, layer: Layer) -> None:
        """A group that is one value, such as `ppo:` with nothing below it, would end the group of
        the layers below, unseen where a later layer has keys of it.

        Raises:
          UserError: a group is one value.
        """
        # In this order, a group comes before those in it, so that the outermost is named.
        for group in sorted(groups_of(self.fields)):
            part: Any = layer.values
            for name in group.split("."):
                part = part.get(name, {}) if isinstance(part, dict) else {}
            if not isinstance(part, dict | pydantic.BaseModel):
                raise UserError(
                    f"{shorten(layer.source)}: {group} is {shorten(str(part))}, but must be a "
                    "group of settings; remove it, or nest keys in it"
                )

    def _layer_of_user(self, source: str, said: Mapping[str, Any]) -> Layer:
        """The user's values in their groups."""
        values: dict[str, Any] = {}
        whole = []
        for key, value in said.items():
            full_key = self._full_key(key)
            plain = value
            if isinstance(value, pydantic.BaseModel):
                plain = value.model_dump()
                whole.append(full_key)
            values = merged(values, nested(full_key, plain))
        return Layer(source, values, whole=tuple(whole))

    def _full_key(self, key: str) -> str:
        """The dotted key of a setting or a group that stands alone, the training's own first; an
        unknown key stays."""
        for full in (key, f"env.{key}", f"ppo.{key}"):
            if any(field == full or field.startswith(f"{full}.") for field in self.fields):
                return full
        return key

    def _go_on(self, user: Layer) -> list[Layer]:
        """A layer for a run that has met all results, where a number of steps is asked for: it goes
        on to that number."""
        if self.resume is None or "total_steps" not in user.values:
            return []
        from bounce_mjx.runs.folders import find_run, latest_checkpoint
        from bounce_mjx.runs.progress import Progress, are_solved
        from bounce_mjx.runs.records import verify

        checkpoint = latest_checkpoint(find_run(self.resume), self.resume)
        progress = verify(checkpoint).progress
        seeds = [Progress.model_validate(seed) for seed in progress.get("seeds", [progress])]
        if are_solved(seeds):
            return [Layer(user.source, {"stop_when_solved": False})]
        return []

    def _validated(self, values: dict[str, Any]) -> TrainConfig:
        groups = {"env": self.task.Config, "ppo": self.algorithm}
        typed = dict(values)
        for name, kind in groups.items():
            try:
                typed[name] = kind.model_validate(values.get(name, {}))
            except pydantic.ValidationError as error:
                raise _Mistake(error, name) from error
        try:
            return TrainConfig.model_validate(typed)
        except pydantic.ValidationError as error:
            raise _Mistake(error, "") from error


class _Mistake(Exception):
    """A validation error of a group of settings."""

    def __init__(self, error: pydantic.ValidationError, group: str):
        self.error = error
        self.group = group
        self.path = path_of(error, group)


def _merge(layers: Sequence[Layer]) -> tuple[dict[str, Any], dict[str, str]]:
    """The values of the layers, of which a later one wins; and the source of each by its dotted
    key."""
    values: dict[str, Any] = {}
    sources: dict[str, str] = {}
    for layer in layers:
        for key in layer.whole:
            # The layer has the key, so that the None does not remain.
            values = merged(values, nested(key, None))
        values = merged(values, layer.values)
        if layer.is_world:
            randomization = without_idle_curriculum(values["env"]["randomization"])
            values["env"] = values["env"] | {"randomization": randomization}
        for key in flat(layer.values):
            # The last source of its keys is that of a mapping (`TrainConfig.sources`).
            sources.pop(key, None)
            sources[key] = layer.source
    # A later layer may end a value, or replace a mapping by None.
    remaining = flat(values)
    return values, {key: source for key, source in sources.items() if key in remaining}


def _setter_of(path: Sequence[str], layers: Sequence[Layer]) -> str:
    """The last layer that set a key; a guess for a rule that joins several settings of a group: the
    last layer with any of them. Without such a layer, it is the default that is wrong."""
    # A layer with a value first; an unknown key, as in `foo: {}`, may be an empty group.
    for may_be_empty in (False, True):
        for layer in reversed(layers):
            if _has(layer.values, path, may_be_empty):
                return layer.source
    return DEFAULT_SOURCE


def _has(values: dict[str, Any], path: Sequence[str], may_be_empty: bool) -> bool:
    """Whether nested values have a value at a path, or a group there, which may be empty."""
    part: Any = values
    for name in path:
        if not isinstance(part, dict):
            # The mistake is in a part of this value.
            return True
        if name not in part:
            return False
        part = part[name]
    return may_be_empty or not isinstance(part, dict) or bool(flat(part))


def _check_resumable(resumed: TrainConfig, config: TrainConfig) -> None:
    if changed := differing_keys(resumed, config) - RESUMABLE_KEYS:
        raise UserError(
            f"--resume cannot change {', '.join(sorted(changed))}; leave those flags out, or "
            "start a new run"
        )


# Where no training follows ----------------------------------------------------------------------


def read_preset(
    config: Path | Sequence[Path] | None,
    robot: Path | None = None,
    task: str | None = None,
    world: Path | None = None,
    machine: Path | None = None,
) -> TrainConfig:
    """The config of presets, files, a robot and a world: see `Choice` and `stack`.

    Raises:
      UserError: as `stack` and `Stack.config`.
    """
    files = (config,) if isinstance(config, Path) else tuple(config or ())
    choice = Choice(config=files, robot=robot, world=world, task=task)
    return stack(choice, machine).config()
