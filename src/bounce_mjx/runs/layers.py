"""The settings of a training, from wherever they come.

The first word, --algorithm and --warm-start fix the classes (`start.py`): which task, which
algorithm and which policy or run a training begins with. Everything else is values. They are layers
(`Layer`), in the order of `Rank`, and a later one wins. Those of the environment alone, of a
policy, a robot and a world, are in `worlds.py`.

`layers_on` reads the layers below what is said as values, each file once. `Layers.config` puts the
user's on top, merges all of them and validates the result, once; the config then knows what set
each of its values (`TrainConfig.sources`).

A resumed run has two layers: its own config, and what the user says; any `total_steps` that is said
switches its `stop_when_solved` off where that had ended it (`Layers._beyond_results`). A whole
config, of Python, has no presets below it.
"""

import dataclasses
import enum
import functools
import itertools
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pydantic
from pydantic.fields import FieldInfo

from bounce_mjx.config.files import differing_keys, flat
from bounce_mjx.config.settings import default_of, has_default, merged, nested
from bounce_mjx.config.validation import describe, groups_of, path_of
from bounce_mjx.errors import UserError, shorten
from bounce_mjx.learning.config import NETWORK_KEYS, PPOConfig
from bounce_mjx.runs.config import DEFAULT_SOURCE, RESUMABLE_KEYS, TrainConfig
from bounce_mjx.runs.presets import (
    BASE,
    SOURCES,
    ConfigFile,
    preset_files,
    read_config_file,
    shown_file,
)
from bounce_mjx.runs.start import Choice, FileFlags, Start, check_not_given, find_start
from bounce_mjx.runs.worlds import Layer, layers_of_environment
from bounce_mjx.world.named import without_idle_curriculum


class Rank(enum.StrEnum):
    """The kinds of layers of a new training, the lowest first: a layer wins over those of a lower
    rank. The first and the last are not among `Layers.below`. Each is in the words of
    docs/config.md. A robot's file may say something of the training, too. A warm start brings its
    own robot, beside which only a world may name one, the same (`layers_of_environment`)."""

    DEFAULTS = "the defaults of the task and of the algorithm"
    """No layer: what the types of the settings say."""
    MACHINE = "the preset for this machine"
    ALGORITHM = "again the defaults of your own algorithm, where they differ from PPO's"
    PRESET = "a preset that you name, in place of the machine's"
    WARM_START = "the policy of a warm start: its environment and its networks' settings"
    FILES = "your files and further presets, each on those before it"
    ROBOT = "a robot: `--robot`, or that of `--world`"
    WORLD = "a world: `--world`"
    USER = "what you say: flags, or arguments of `train`"
    """`Layers.config` adds it."""


FLAGS = "flags"
"""Source of the settings on a command line."""
PYTHON = "train()"
"""Source of the arguments of `train` in Python."""
BEYOND_RESULTS = "total_steps, said after the results had ended the run"
"""Source of a `stop_when_solved` that is switched off (`Layers._beyond_results`)."""


# Reading: what lies on what ---------------------------------------------------------------------


def read_layers(choice: Choice, machine: Path | None = None) -> "Layers":
    """The layers of a choice, without what the user says.

    Args:
      machine: see `layers_on`.

    Raises:
      UserError: as `find_start` and `layers_on`.
    """
    return layers_on(find_start(choice.word, choice), choice, machine)


def layers_on(start: Start, files: FileFlags, machine: Path | None = None) -> "Layers":
    """The layers on a start, without what the user says.

    Args:
      machine: the machine's preset; None asks JAX, which starts its devices.

    Raises:
      UserError: a file is missing, wrong, or of another start.
    """
    if start.resumed_config is not None:
        given = {"config": files.config, "robot": files.robot, "world": files.world}
        check_not_given(start.place, given)
        return Layers(start, (Layer(f"the run {start.place}", start.resumed_config.model_dump()),))
    layers: dict[Rank, list[Layer]] = {rank: [] for rank in Rank}
    if start.whole is None:
        read = preset_files(files.config, start.task_name, machine)
        layers[Rank.MACHINE] = _layers_of_files(read.machine)
        layers[Rank.PRESET] = _layers_of_files(read.preset)
        layers[Rank.FILES] = _layers_of_files(read.files)
        for layer in (*layers[Rank.PRESET], *layers[Rank.FILES]):
            _check_start(layer, start)
    else:
        # Its warm start is the checkpoint that was found for it.
        whole = start.whole.model_dump() | {"warm_start": start.warm_start}
        layers[Rank.FILES] = [Layer("config", whole, replaces=("env", "ppo"))]
    layers[Rank.ALGORITHM] = _changed_defaults(start.algorithm_config)
    trained = None if start.warm_config is None else start.warm_config.env
    of_env = layers_of_environment(start.task, trained, files.robot, files.world)
    for layer in of_env.robot:
        _check_start(layer, start)
    layers[Rank.WARM_START] = [_with_networks(layer, start) for layer in of_env.policy]
    layers[Rank.ROBOT] = of_env.robot
    layers[Rank.WORLD] = of_env.world
    notes = (
        *start.notes,
        *_notes(layers[Rank.ALGORITHM], layers[Rank.PRESET], "ppo."),
        *_notes(layers[Rank.PRESET], layers[Rank.WARM_START], "env."),
    )
    return Layers(start, tuple(layer for rank in Rank for layer in layers[rank]), notes)


def _check_start(layer: Layer, start: Start) -> None:
    """Checks that a file, which has values alone, is of what the training begins with: no file
    chooses the task, and one that names it must name this one. An algorithm or a warm start that
    the user names wins over the file's, as any flag does.

    Raises:
      UserError: it is of another task, or of an algorithm or a warm start that the user does not
        name.
    """
    begun = {
        "task": (start.task_name, "{} as the first word"),
        "algorithm": (start.algorithm_name, "--algorithm {}"),
        "warm_start": (start.warm_start, "--warm-start {}"),
    }
    for key, (ours, remedy) in begun.items():
        theirs = layer.values.get(key)
        wins = key != "task" and key in start.named
        if theirs is not None and theirs != ours and not wins:
            raise UserError(
                f"{layer.source} is of the {key} {theirs}, and this training of {ours or 'none'}; "
                f"give {remedy.format(theirs)}, or remove the key"
            )


def _layers_of_files(files: Iterable[ConfigFile]) -> list[Layer]:
    """A layer of each file, with its settings alone."""
    layers = []
    for path, values in files:
        settings = {key: value for key, value in values.items() if key not in (BASE, SOURCES)}
        layers.append(Layer(shown_file(path), settings))
    return layers


def _changed_defaults(algorithm_config: type[PPOConfig]) -> list[Layer]:
    """The defaults of an algorithm of the user's that differ from PPO's (`Rank.ALGORITHM`): it
    means these values, and the machine's preset below them was made for PPO."""
    changed = {}
    for key, field in PPOConfig.model_fields.items():
        own_field = algorithm_config.model_fields[key]
        # A narrower type without a default says nothing of the value.
        if has_default(own_field) and default_of(own_field) != field.default:
            changed[key] = default_of(own_field)
    if not changed:
        return []
    return [Layer(f"defaults of {algorithm_config.__qualname__}", {"ppo": changed})]


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


def _with_networks(of_env: Layer, start: Start) -> Layer:
    """The layer of the policy of a warm start: its environment, its task and its networks."""
    networks = start.warm_config.ppo.model_dump(include={*NETWORK_KEYS, "critic_metrics"})
    values = of_env.values | {"task": start.warm_config.task, "ppo": networks}
    return of_env._replace(source=f"the warm start {start.warm_start}", values=values)


# Merging and validating -------------------------------------------------------------------------


class CommandLine(NamedTuple):
    """A command's own words for the settings, which its errors use."""

    prog: str
    """Such as bounce-mjx train."""
    flags: Mapping[str, str]
    """The flag of each setting, by dotted key."""


@dataclasses.dataclass(frozen=True)
class Layers:
    """The layers below what the user says, the lowest first."""

    start: Start
    below: tuple[Layer, ...]
    notes: tuple[str, ...] = ()
    """Which run latest stands for, and where a layer wins over another one that a user may have
    expected to win."""

    @functools.cached_property
    def fields(self) -> dict[str, FieldInfo]:
        """The settings that there are, by dotted key."""
        return self.start.fields

    @property
    def title(self) -> str:
        """The sources of the layers in words, the last first."""
        return " on ".join(layer.source for layer in reversed(self.below))

    def config(
        self, said: Mapping[str, Any] | None = None, command: CommandLine | None = None
    ) -> TrainConfig:
        """The typed config, with what the user says on top.

        Args:
          said: values by their keys. A key may be dotted, and one of `env` or `ppo` stand alone:
            num_envs for ppo.num_envs.
          command: where the user says it, which its errors and the source of its values name; None
            in Python.

        Raises:
          UserError: a key is unknown, a value is out of range, or it must be that of the resumed
            run. The error names the layer that set it.
        """
        user_source = PYTHON if command is None else FLAGS
        # The policy of a warm start is the checkpoint that was found, not the word for it.
        user = self._layer_of_user(user_source, {**(said or {}), **self.start.named})
        above = [*self._beyond_results(user), user]
        layers = [*self.below, *above]
        for layer in layers:
            self._check_groups(layer)
        values, sources = _merge(layers)
        # As the word says it, also where a warm start is of the task that this one extends.
        values["task"] = self.start.task_name
        try:
            config = self._validated(values)
        except _Mistake as mistake:
            setter = _setter_of(mistake.path, layers)
            if command is not None and setter == FLAGS:
                text = describe(mistake.error, self.fields, command.flags, mistake.group)
                raise UserError(f"{text} (see {command.prog} --help)") from mistake.error
            text = describe(mistake.error, self.fields, group=mistake.group)
            if setter != PYTHON and mistake.path in (["robot"], ["world"]):
                (name,) = mistake.path
                text = f"{name} is no setting; leave it out, and give --{name} or train({name}=...)"
            raise UserError(f"{shorten(setter)}: {text}") from mistake.error
        if self.start.resumed_config is not None:
            _check_resumable(self.start.resumed_config, config)
            _, changed = _merge(above)
            sources = self.start.resumed_config.sources | changed
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
        replaced = []
        for key, value in said.items():
            full_key = self._full_key(key)
            plain = value
            if isinstance(value, pydantic.BaseModel):
                plain = value.model_dump()
                replaced.append(full_key)
            values = merged(values, nested(full_key, plain))
        return Layer(source, values, replaces=tuple(replaced))

    def _full_key(self, key: str) -> str:
        """The dotted key of a setting or a group that stands alone, the training's own first; an
        unknown key stays."""
        for full in (key, f"env.{key}", f"ppo.{key}"):
            if any(field == full or field.startswith(f"{full}.") for field in self.fields):
                return full
        return key

    def _beyond_results(self, user: Layer) -> list[Layer]:
        """A layer for a resumed run that its results have ended (`all_may_end`), where a number of
        steps is said: it goes on to that number."""
        resumed = self.start.resumed_config
        if resumed is None or not resumed.stop_when_solved or "total_steps" not in user.values:
            return []
        from bounce_mjx.runs.folders import latest_checkpoint, run_of
        from bounce_mjx.runs.progress import Progress, all_may_end
        from bounce_mjx.runs.records import verify

        checkpoint = latest_checkpoint(run_of(self.start.place), self.start.place)
        progress = verify(checkpoint).progress
        seeds = [Progress.model_validate(seed) for seed in progress.get("seeds", [progress])]
        if all_may_end(seeds):
            return [Layer(BEYOND_RESULTS, {"stop_when_solved": False})]
        return []

    def _validated(self, values: dict[str, Any]) -> TrainConfig:
        """The typed config of nested values.

        Raises:
          _Mistake: a key is unknown, or a value is out of range.
        """
        groups = {"env": self.start.task.Config, "ppo": self.start.algorithm_config}
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
        for key in layer.replaces:
            values = _without(values, key)
        values = merged(values, layer.values)
        if layer.is_world:
            randomization = without_idle_curriculum(values["env"]["randomization"])
            values["env"] = values["env"] | {"randomization": randomization}
        its_keys = flat(layer.values)
        kept = {key: source for key, source in sources.items() if key not in its_keys}
        # The newest keys come last. A mapping such as `shares` may have entries of several sources,
        # and `TrainConfig.sources` gives the last one for it.
        sources = kept | dict.fromkeys(its_keys, layer.source)
    # A later layer may end a value, or replace a mapping by None.
    remaining = flat(values)
    return values, {key: source for key, source in sources.items() if key in remaining}


def _without(values: dict[str, Any], key: str) -> dict[str, Any]:
    """Nested mappings without a value or a group, by its dotted key."""
    name, _, rest = key.partition(".")
    if not rest:
        return {other: value for other, value in values.items() if other != name}
    if not isinstance(values.get(name), dict):
        return values
    return values | {name: _without(values[name], rest)}


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
    """Raises UserError where a resumed run would be another training."""
    if changed := differing_keys(resumed, config) - RESUMABLE_KEYS:
        raise UserError(
            f"a resumed run cannot change {', '.join(sorted(changed))}; leave those out, or start "
            "a new run"
        )


# Where no training follows ----------------------------------------------------------------------


def read_preset(
    config: Path | Sequence[Path] | None,
    robot: Path | None = None,
    task: str | None = None,
    world: Path | None = None,
    machine: Path | None = None,
) -> TrainConfig:
    """The config of a preset, on which further presets, files, a robot and a world may lie: see
    `Choice` and `read_layers`.

    Args:
      task: by default, the one that the last file names.

    Raises:
      UserError: as `read_layers` and `Layers.config`.
    """
    files = (config,) if isinstance(config, Path) else tuple(config or ())
    if task is None:
        # In place of the word, which no user says here.
        for file in filter(os.path.isfile, files):
            task = read_config_file(file).get("task", task)
    choice = Choice(word=task, config=files, robot=robot, world=world)
    return read_layers(choice, machine).config()
