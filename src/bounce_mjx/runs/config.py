"""The settings of a training run, and their YAML file."""

import stat
from pathlib import Path
from typing import Any

import yaml

from bounce_mjx.config.settings import Count, NonNegativeInt, PlainPath, Steps, StrictModel
from bounce_mjx.config.validation import validate
from bounce_mjx.errors import UserError, shorten
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.task.config import EnvConfig

CONFIG_FILE = "config.yaml"
_MAX_CONFIG_BYTES = 2**16
_MAX_ALIASES = 10


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


class _Loader(yaml.SafeLoader):
    """Refuses YAML whose size multiplies, as groups that repeat groups do."""

    _aliases = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node:
        is_alias = self.check_event(yaml.AliasEvent)
        node = super().compose_node(parent, index)
        self._aliases += is_alias and isinstance(node, yaml.CollectionNode)
        if self._aliases > _MAX_ALIASES:
            raise yaml.YAMLError(f"it repeats a group more than {_MAX_ALIASES} times")
        return node


def load_run_config(run: Path) -> TrainConfig:
    """The resolved config of a run.

    Raises:
      UserError: it is missing or damaged.
    """
    return load_config(run / CONFIG_FILE)


def load_config(path: Path) -> TrainConfig:
    """Reads a run's config from a YAML file, missing keys at their defaults.

    Raises:
      UserError: the file is missing, is no YAML mapping, or holds an unknown key or a bad value.
    """
    try:
        # To open a pipe would wait for a writer, and a device may have no end.
        if not stat.S_ISREG(path.stat().st_mode):
            raise ValueError("it is not a regular file")
        data = path.read_bytes()
        if len(data) > _MAX_CONFIG_BYTES:
            raise ValueError(f"it is longer than {_MAX_CONFIG_BYTES} bytes")
        values = _Loader(data.decode("utf-8")).get_single_data()
    # PyYAML raises many types where a value has the form of a number or a date but is none.
    except Exception as error:
        reason = " ".join((getattr(error, "strerror", None) or str(error) or repr(error)).split())
        raise UserError(
            f"the config file {shorten(str(path))} cannot be read ({shorten(reason, 300)}); give a "
            "YAML file such as configs/default.yaml"
        ) from error
    if values is None:
        values = {}
    if not isinstance(values, dict):
        raise UserError(
            f"the config file {shorten(str(path))} holds a {type(values).__name__}, not a mapping "
            "of keys to values; write it like configs/default.yaml"
        )
    return validate(TrainConfig, values, str(path))
