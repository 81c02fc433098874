"""What version 0.1.0 wrote. The policies of its runs are read, and their trainings do not go on:
their checkpoints lie in `best` and `latest`. A config file, also one of the user's, may have
settings that moved since then, or that ended and would change nothing."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bounce_mjx.config.settings import merged, nested
from bounce_mjx.config.user_code import plain_name
from bounce_mjx.lazy import jax

RECORD_FILE = "run.json"
"""The plain data of a checkpoint."""
BEST = "best"
"""Folder of the best checkpoint."""

_NOTHING = object()
_ANY = object()
_ENDED = {
    # It ran only where `env.observation.position` asked for it.
    "env.estimator": _ANY,
    "env.observation.position": "measured",
    "env.randomization.restitution_slope": None,
    "env.randomization.air_lift": None,
}
"""Settings that ended, with the value that changes nothing today."""
_MOVED = {
    "env.joint_angle_noise": "env.reset.joint_angles",
    "env.joint_velocity_noise": "env.reset.joint_velocities",
    "env.ball_position_noise": "env.reset.ball_position",
    "ppo.min_noise_std": "ppo.mean_noise_bound",
    "env.randomization.command_interval": "env.randomization.goal_interval",
    "env.randomization.first_command_range": "env.randomization.first_goal_range",
}
"""Settings that moved, with their present keys."""


def present_settings(config: dict[str, Any]) -> dict[str, Any]:
    """A config's plain values with the present keys. A setting that ended stays, and is refused as
    unknown, where it would change something."""
    for key, harmless in _ENDED.items():
        value = _value(config, key)
        if value is not _NOTHING and (harmless is _ANY or harmless == value):
            config = _without(config, key)
    for key in {"task", "algorithm"} & config.keys():
        if isinstance(config[key], str):
            config = config | {key: plain_name(config[key])}
    for key, present in _MOVED.items():
        value = _value(config, key)
        if value is not _NOTHING:
            config = merged(nested(present, value), _without(config, key))
    return config


def _value(config: Any, key: str) -> Any:
    """The value of a dotted key."""
    for name in key.split("."):
        if not isinstance(config, dict) or name not in config:
            return _NOTHING
        config = config[name]
    return config


def _without(config: dict[str, Any], key: str) -> dict[str, Any]:
    """The mapping without a dotted key that it has."""
    name, _, rest = key.partition(".")
    if rest:
        return config | {name: _without(config[name], rest)}
    return {other: value for other, value in config.items() if other != name}


def checkpoints_in(folder: Path) -> Iterator[Path]:
    """The checkpoints in a run's folder of checkpoints."""
    for name in (BEST, "latest"):
        for path in folder.glob(f"{name}/*"):
            if path.name.isdecimal():
                yield path


def with_report(record: Any) -> Any:
    """A checkpoint's plain data with the evaluation of its policy, which stands in its progress if
    it is the best one."""
    if not isinstance(record, dict):
        return record
    progress = record.get("progress")
    is_best = isinstance(progress, dict) and progress.get("best_steps") == record.get("steps")
    return record | {"report": progress.get("best") if is_best else None}


def read_arrays(folder: Path, template: Any) -> Any:
    """The NumPy arrays of an item of a checkpoint, whose structure orbax does not know."""
    # Orbax has imported it where a checkpoint is read.
    import tensorstore

    def read(path: tuple, leaf: Any) -> Any:
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        files = {"driver": "file", "path": f"{folder}/"}
        database = {"driver": "ocdbt", "base": files, "path": f"{name}/"}
        form = {"shape": leaf.shape, "chunks": leaf.shape, "dtype": leaf.dtype.str}
        spec = {"driver": "zarr", "kvstore": database, "metadata": form}
        return tensorstore.open(spec, open=True, read=True).result().read().result()

    return jax.tree_util.tree_map_with_path(read, template)
