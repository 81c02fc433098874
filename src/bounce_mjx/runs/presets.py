"""The presets in configs/."""

from pathlib import Path

import jax

from bounce_mjx.resources import resource_path
from bounce_mjx.runs.config import TrainConfig, load_config


def read_preset(path: Path | None) -> TrainConfig:
    """The config of a preset; that for the machine at hand if none is given.

    Raises:
      UserError: the file is missing or wrong.
    """
    if path is None:
        preset = "cpu" if jax.default_backend() == "cpu" else "default"
        path = resource_path(f"configs/{preset}.yaml")
    return load_config(path)
