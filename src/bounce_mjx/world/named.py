"""Named worlds: the numbers of a real robot and its camera in a YAML file, each with its source."""

import math
from pathlib import Path
from typing import Any

import pydantic

from bounce_mjx.config.files import flat, read_mapping
from bounce_mjx.config.settings import StrictModel, merged, nested
from bounce_mjx.config.validation import validate
from bounce_mjx.errors import shorten
from bounce_mjx.lazy import np
from bounce_mjx.world.config import RobotSettings
from bounce_mjx.world.randomization import TERMS, RandomizationConfig

CURRICULUM = RandomizationConfig.model_fields.keys() - TERMS.keys()
"""Keys of the randomisation that describe the training, not the world."""


class NamedWorld(StrictModel):
    """The content of a world's file."""

    robot: str | None = None
    """Name of a robot in configs/robots/, or its file, relative to the world's folder; null for any
    robot."""
    env: RobotSettings = RobotSettings()
    """Settings of the environment. Its randomisation is the whole one: a term that it does not have
    is as in the model."""
    sources: dict[str, str] = {}
    """Where each number comes from, one sentence, by its dotted key in `env` or that of a group."""
    assumed: tuple[str, ...] = ()
    """Keys whose numbers nobody has measured; their source is the reason for the number."""

    @pydantic.model_validator(mode="after")
    def _check_sources(self):
        given = flat(self.settings)
        groups = {key[:i] for key in given for i, char in enumerate(key) if char == "."}
        for key in (*self.sources, *self.assumed):
            if key not in given and (key in self.assumed or key not in groups):
                raise ValueError(
                    f"sources or assumed has {shorten(key)}, but env has no such key; give env "
                    "that key, or remove it from them"
                )
        for key, source in self.sources.items():
            if not source.strip():
                raise ValueError(f"{key} has an empty source; write one sentence")
        for key in self.assumed:
            if not _can_be_doubled(key, given[key]):
                raise ValueError(f"{key} is assumed, but is no number to double; remove it")
        for key in given:
            if key.startswith("randomization.") and key.split(".")[1] in CURRICULUM:
                continue
            if not any(key == source or key.startswith(f"{source}.") for source in self.sources):
                raise ValueError(
                    f"{key} has no source; say in one sentence where its number comes from, or why "
                    "it is assumed"
                )
        return self

    @property
    def settings(self) -> dict[str, Any]:
        """The given settings of `env`, nested."""
        return self.env.model_dump(exclude_unset=True)

    def applied(self, env: dict[str, Any], training: bool = False) -> dict[str, Any]:
        """The settings of an environment in this world.

        Args:
          env: the settings, nested.
          training: whether the curriculum of their randomisation stays unless the world has one.
        """
        before = env.get("randomization", {}) if training else {}
        kept = {key: value for key, value in before.items() if key in CURRICULUM}
        return merged(env | {"randomization": kept}, self.settings)

    def double_assumed(self) -> dict[str, dict[str, Any]]:
        """For each assumed key, the nested settings of `env` in which alone its number is doubled.

        A term of the randomisation goes twice as far from the model's value, within its limits; a
        rate, an interval, or a limit, of which less is harder, is halved.
        """
        given = flat(self.settings)
        return {key: nested(key, _double(key, given[key])) for key in self.assumed}


def read_world(path: Path) -> NamedWorld:
    """Reads a world's file.

    Raises:
      UserError: the file is missing or wrong.
    """
    values = read_mapping(path, "world", "configs/worlds/ur5e_rtde.yaml")
    return validate(NamedWorld, values, str(path))


def _can_be_doubled(key: str, value: Any) -> bool:
    """Whether a setting is a number, or several; of the randomisation, a term."""
    group, _, name = key.rpartition(".")
    if group == "randomization" and name not in TERMS:
        return False
    numbers = np.ravel(np.array(value, object)).tolist()
    return all(isinstance(x, int | float) and not isinstance(x, bool) for x in numbers)


def _double(key: str, value: Any) -> Any:
    group, _, name = key.rpartition(".")
    factor, centre, (least, most) = 2.0, 0.0, (-math.inf, math.inf)
    if group == "randomization":
        nominal, (least, most) = TERMS[name].nominal, TERMS[name].bounds
        factor, centre = (0.5, 0.0) if nominal is None else (2.0, nominal)
    elif group == "robot.limits":
        factor = 0.5

    return np.clip(centre + factor * (np.array(value) - centre), least, most).tolist()
