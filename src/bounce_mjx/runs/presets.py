"""Files of settings by name: presets, robots and worlds; and which preset this machine has."""

import importlib.metadata
import importlib.util
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from bounce_mjx.config.files import read_mapping
from bounce_mjx.errors import UserError, shorten
from bounce_mjx.lazy import jax
from bounce_mjx.resources import resource_path
from bounce_mjx.robot.config import is_packaged

BASE = "base"
"""Key of a config file with the name of the preset on which it lies, or null for none."""
SOURCES = "sources"
"""Key of a run's config with the settings that each layer set."""
PRESETS = "configs"
"""Folder of the package with presets; a folder in it, of a task's name, has the task's own."""
ROBOTS = "configs/robots"
"""Folder of the package with configs of robots."""
WORLDS = "configs/worlds"
"""Folder of the package with named worlds."""

_EXAMPLE = "configs/default.yaml"


class ConfigFile(NamedTuple):
    """A config file, which is read once."""

    path: Path
    values: dict[str, Any]


class PresetFiles(NamedTuple):
    """The files of a config; each lies on those before it."""

    machine: list[ConfigFile]
    """The preset for this machine, where the user names no other one; else none."""
    preset: list[ConfigFile]
    """The preset that the user names; or none."""
    files: list[ConfigFile]
    """The user's files, and further presets."""


def preset_files(config: Sequence[Path], task: str, machine: Path | None = None) -> PresetFiles:
    """The files of a config.

    A file lies on the preset for this machine, or on the one that its key `base` names; with `base:
    null`, as in the presets and in a run's config, it stands alone.

    Args:
      config: YAML files, or names of files in configs/. A task may have its own preset of a name,
        in the folder of configs/ that has the task's name. A file in configs/ is a preset, also if
        it is given as a path.
      machine: the machine's preset; None asks JAX, which starts its devices.

    Raises:
      UserError: a file is missing or invalid, or names a base that is not used.
    """
    of_task = f"{PRESETS}/{task}"
    paths = []
    for word in config:
        # The task's own first; a word that is none of these is one of the presets of all tasks.
        own = named_file(word, of_task)
        paths.append(named_file(own, PRESETS, "preset"))
    files = [ConfigFile(path, read_config_file(path)) for path in paths]
    for file in files[1:]:
        if file.values.get(BASE) is not None:
            raise UserError(
                f"{file.path} lies on {paths[0]}, so its {BASE} is not used; give it first"
            )
    if not files or BASE not in files[0].values:
        # The first file does not say on what it lies: on the machine's preset.
        base = machine or default_preset(has_accelerator())
        return PresetFiles(_preset(str(base), of_task), [], files)
    base = files[0].values[BASE]
    if base is not None:
        # On the one that it names.
        preset = _preset(str(base), of_task)
        if not preset:
            raise UserError(
                f"{paths[0]}: {BASE} is {shorten(repr(base))}; give the name of a preset, or null"
            )
        return PresetFiles([], preset, files)
    # On nothing (`base: null`): it is a preset of the package, or a file of the user's.
    if paths[0].resolve().is_relative_to(resource_path(PRESETS).resolve()):
        return PresetFiles([], files[:1], files[1:])
    return PresetFiles([], [], files)


def _preset(name: str, of_task: str) -> list[ConfigFile]:
    """The preset of a name, of two the task's own one; empty without one."""
    for folder in (of_task, PRESETS):
        path = resource_path(f"{folder}/{name}.yaml")
        if os.path.isfile(path):
            return [ConfigFile(path, read_config_file(path))]
    return []


def named_file(path: Path, folder: str, kind: str | None = None) -> Path:
    """The YAML file in a folder of the package that a word names; the path itself if there is none,
    or if it is a file.

    Args:
      kind: kind of the file, to refuse a word that is neither a file nor a name.
    """
    if str(path) != path.stem or os.path.isfile(path):
        return path
    named = resource_path(f"{folder}/{path}.yaml")
    if os.path.isfile(named):
        return named
    if kind is None:
        return path
    names = sorted(file.stem for file in resource_path(folder).glob("*.yaml"))
    # Conditions of `bounce-mjx robustness` lie there too.
    names = [name for name in names if not name.startswith("robustness")]
    raise UserError(
        f"no {kind} is named {shorten(str(path))}; give one of {', '.join(names)}, or a YAML file"
    )


def shown_file(file: Path) -> str:
    """A config file for the user's eyes: one of the package's without the package's folder."""
    package = resource_path(PRESETS).parent
    return str(file.relative_to(package) if file.is_relative_to(package) else file)


def read_config_file(
    path: Path, kind: str = "config file", example: str = _EXAMPLE
) -> dict[str, Any]:
    """The values of a config file (`read_mapping`), in which the MJCF file starts at the folder of
    the file.

    Raises:
      UserError: the file is missing, is no mapping, or names a task or an algorithm by no text.
    """
    values = read_mapping(path, kind, example)
    for key in {"task", "algorithm"} & values.keys():
        if not isinstance(values[key], str):
            given = "null" if values[key] is None else values[key]
            raise UserError(f"{shown_file(path)}: {key} is {given}, but must be a name")
    env = values.get("env")
    mjcf = env.get("mjcf") if isinstance(env, dict) else None
    if isinstance(mjcf, str) and not mjcf.startswith("~") and not is_packaged(Path(mjcf)):
        values = values | {"env": env | {"mjcf": str(path.parent / mjcf)}}
    return values


def default_preset(accelerator: bool) -> Path:
    """The preset for a machine with an accelerator, or without one."""
    return Path("default" if accelerator else "cpu")


def has_accelerator() -> bool:
    """Whether JAX computes on an accelerator by default. This starts JAX's devices if a plugin for
    one is installed."""
    return has_plugin() and jax.default_backend() != "cpu"


def has_plugin() -> bool:
    """Whether a plugin of JAX's for an accelerator is installed."""
    plugins = importlib.metadata.entry_points(group="jax_plugins")
    names = ("jax_plugins", "libtpu")
    return bool(plugins) or any(importlib.util.find_spec(name) for name in names)
