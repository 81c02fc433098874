"""The settings of a training run, and their YAML file."""

import importlib.metadata
import importlib.util
import sys
from pathlib import Path

from bounce_mjx.config.files import read_mapping
from bounce_mjx.config.settings import Count, NonNegativeInt, PlainPath, Steps, StrictModel
from bounce_mjx.config.validation import validate
from bounce_mjx.lazy import jax
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.resources import resource_path
from bounce_mjx.task.config import EnvConfig

CONFIG_FILE = "config.yaml"


class TrainConfig(StrictModel):
    """A training run: the task, the trainer, the length and the evaluations."""

    env: EnvConfig = EnvConfig()
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
    """End at the first evaluation that meets all five results."""
    log_dir: PlainPath = Path("runs/bounce_ball")
    """Folder in which the run makes its own, named by the time."""


def load_run_config(run: Path) -> TrainConfig:
    """Reads the resolved config of a run.

    Raises:
      UserError: the file is missing or damaged.
    """
    return load_config(run / CONFIG_FILE)


def load_config(path: Path) -> TrainConfig:
    """Reads a run's config from a YAML file, with defaults for missing keys.

    Raises:
      UserError: the file is missing, is not a YAML mapping, or has an unknown key or a bad value.
    """
    values = read_mapping(path, "config file", "configs/default.yaml")
    return validate(TrainConfig, values, str(path))


def read_preset(path: Path | None) -> TrainConfig:
    """Reads a preset from configs/; without a path, the preset for this machine.

    Raises:
      UserError: the file is missing or invalid.
    """
    if path is None:
        preset = "default" if has_accelerator() else "cpu"
        path = resource_path(f"configs/{preset}.yaml")
    return load_config(path)


def has_accelerator() -> bool:
    """Whether JAX computes on an accelerator by default. JAX is imported only if a plugin for one
    is installed."""
    plugins = importlib.metadata.entry_points(group="jax_plugins") or any(
        importlib.util.find_spec(name) for name in ("jax_plugins", "libtpu")
    )
    return bool(plugins or "jax" in sys.modules) and jax.default_backend() != "cpu"
