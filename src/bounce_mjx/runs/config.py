"""The settings of a training run, and their YAML file."""

import importlib.metadata
import importlib.util
import os
from pathlib import Path
from typing import Any

from bounce_mjx.config.files import read_mapping
from bounce_mjx.config.settings import Count, NonNegativeInt, PlainPath, Steps, StrictModel
from bounce_mjx.config.validation import validate
from bounce_mjx.lazy import jax
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.resources import resource_path
from bounce_mjx.robot.config import is_packaged
from bounce_mjx.runs.robot import check_robot
from bounce_mjx.world.config import WorldConfig

CONFIG_FILE = "config.yaml"
ROBOTS = "configs/robots"
"""Folder of the package with configs of robots."""


class TrainConfig(StrictModel):
    """A training run: the task, the trainer, the length and the evaluations."""

    env: WorldConfig = WorldConfig()
    """The task."""
    ppo: PPOConfig = PPOConfig()
    """The trainer."""
    seed: NonNegativeInt = 0
    """Seed of the whole training."""
    num_seeds: Count = 1
    """Independent trainings in one program, with the seeds `seed`, `seed` + 1, ... and a folder for
    each."""
    num_devices: Count | None = None
    """Devices that share the environments (with several seeds: the seeds). The default is one, or
    all on several hosts. It does not affect the training's result."""
    total_steps: Steps = 50_000_000
    """Environment steps to train for, rounded up to whole blocks."""
    block_steps: Steps = 1_000_000
    """Environment steps between two progress reports, rounded to whole iterations."""
    eval_every: Steps = 2_000_000
    """Environment steps between two evaluations, rounded to whole blocks."""
    eval_episodes: Count = 1024
    """Episodes of an evaluation of the five results."""
    screening_episodes: NonNegativeInt = 0
    """Episodes of a cheap first evaluation, which must pass before the full one; 0 for none."""
    eval_seed: NonNegativeInt = 10_000
    """Seed of the evaluations during the training."""
    stop_when_solved: bool = False
    """End once an evaluation meets all five results with a margin, so that 64 other episodes should
    meet them too: means over steps and bounces by two standard errors of 64 episodes, shares of
    episodes with at most half of the failures that are allowed. At the latest it ends after 1.5
    times the steps of the first evaluation that meets all five."""
    log_dir: PlainPath = Path("runs/bounce_ball")
    """Folder in which the run makes its own, named by the time."""


def load_run_config(run: Path) -> TrainConfig:
    """Reads the resolved config of a run.

    Raises:
      UserError: the file is missing or damaged, or the run's copy of its robot was edited.
    """
    config = load_config(run / CONFIG_FILE)
    if config.env.mjcf is not None:
        check_robot(config.env.mjcf, run)
    return config


def load_config(path: Path, robot: Path | None = None) -> TrainConfig:
    """Reads a run's config from a YAML file, with defaults for missing keys. A relative path of an
    MJCF file starts at the folder of the YAML file.

    Args:
      robot: config of a robot, whose keys win over those of the file.

    Raises:
      UserError: the file is missing, is not a YAML mapping, or has an unknown key or a bad value.
    """
    values = read_mapping(path, "config file", "configs/default.yaml")
    values = _with_mjcf_from(path.parent, values)
    if robot is None:
        return validate(TrainConfig, values, str(path))
    own = read_mapping(robot, "robot's config file", "configs/robots/ur5e.yaml")
    own = _with_mjcf_from(robot.parent, own)
    validate(TrainConfig, own, str(robot))
    return validate(TrainConfig, _merged(values, own), f"{path} with {robot}")


def _merged(values: dict[str, Any], others: dict[str, Any]) -> dict[str, Any]:
    """Nested mappings in which the others' keys win."""
    merged = dict(values)
    for key, value in others.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = _merged(merged[key], value) if both else value
    return merged


def read_preset(path: Path | None, robot: Path | None = None) -> TrainConfig:
    """Reads a preset: a YAML file, or the name of a file in configs/; by default, the preset for
    this machine.

    Args:
      robot: config of a robot, whose keys win over the preset's: a YAML file, or the name of a file
        in configs/robots/.

    Raises:
      UserError: the file is missing or invalid.
    """
    if path is None:
        path = default_preset(has_accelerator())
    return load_config(named_file(path, "configs"), robot and named_file(robot, ROBOTS))


def default_preset(accelerator: bool) -> Path:
    """The preset for a machine with an accelerator, or without one; both have the same task."""
    return Path("default" if accelerator else "cpu")


def named_file(path: Path, folder: str) -> Path:
    """The YAML file in a folder of the package that a path names; the path itself if there is none
    or if the path exists."""
    named = resource_path(f"{folder}/{path.name}.yaml")
    is_name = str(path) == path.name and not os.path.exists(path)
    return named if is_name and os.path.isfile(named) else path


def has_accelerator() -> bool:
    """Whether JAX computes on an accelerator by default. This starts JAX's devices if a plugin for
    one is installed."""
    return has_plugin() and jax.default_backend() != "cpu"


def has_plugin() -> bool:
    """Whether a plugin of JAX's for an accelerator is installed."""
    plugins = importlib.metadata.entry_points(group="jax_plugins")
    names = ("jax_plugins", "libtpu")
    return bool(plugins) or any(importlib.util.find_spec(name) for name in names)


def _with_mjcf_from(folder: Path, values: dict[str, Any]) -> dict[str, Any]:
    """A config's values with an absolute path of the MJCF file."""
    env = values.get("env")
    mjcf = env.get("mjcf") if isinstance(env, dict) else None
    if not isinstance(mjcf, str) or mjcf.startswith("~") or is_packaged(Path(mjcf)):
        return values
    return values | {"env": env | {"mjcf": str(folder / mjcf)}}
