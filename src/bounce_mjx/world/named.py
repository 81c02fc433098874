"""Named worlds: the numbers of a real robot and its camera in a YAML file, each with its source."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pydantic

from bounce_mjx.config.files import flat, read_mapping
from bounce_mjx.config.settings import StrictModel, nested
from bounce_mjx.config.validation import validate
from bounce_mjx.errors import shorten
from bounce_mjx.lazy import np
from bounce_mjx.world.config import WorldSettings
from bounce_mjx.world.randomization import TERMS, RandomizationConfig

CURRICULUM = RandomizationConfig.model_fields.keys() - TERMS.keys()
"""Keys of the randomisation that describe the training, not the world. A world's file may have
them, for a training in it; they need no source, as they are no numbers of the robot."""

_LESS_IS_HARDER = {
    "max_joint_velocity",
    "robot.servo_force_limit",
    "robot.gravity_compensation",
}


class NamedWorld(StrictModel):
    """The content of a world's file."""

    robot: str | None = None
    """Name of a robot in configs/robots/, or its file, relative to the world's folder; null for any
    robot. (`env.robot` has settings of an arm: its adoption, its limits.)"""
    env: WorldSettings = WorldSettings()
    """Settings of the environment (`runs.worlds` puts them in place of the config's). A term of the
    randomisation that it does not have is as in the task's defaults."""
    sources: dict[str, str] = {}
    """Where each setting comes from, a sentence, by its dotted key in `env` or that of a group."""
    assumed: tuple[str, ...] = ()
    """Keys whose numbers nobody has measured; their source is the reason for the number."""

    @pydantic.model_validator(mode="after")
    def _check_sources(self):
        """Each setting has a source, itself or with its group; no source is of another setting."""
        given = flat(self.settings)
        groups = set()
        for key in given:
            *parents, _ = key.split(".")
            groups |= {".".join(parents[:depth]) for depth in range(1, len(parents) + 1)}
        for key, source in self.sources.items():
            if key not in given and key not in groups:
                raise ValueError(
                    f"sources has {shorten(key)}, but env has no such key; give env that key, or "
                    "remove the source"
                )
            if not source.strip():
                raise ValueError(f"{key} has an empty source; write one sentence")
        for key in self.assumed:
            if key not in given:
                raise ValueError(
                    f"assumed has {shorten(key)}, but env has no such key; give env that key, or "
                    "remove it"
                )
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

    def double_assumed(self, nominals: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
        """For each assumed key, as "twice KEY" or "half KEY", the nested settings of `env` in which
        alone its number is doubled.

        A term of the randomisation goes twice as far from its nominal value, within its bounds. A
        number of which less is harder is halved instead: a term without a nominal value
        (`torque_limit`, `camera_rate`, the intervals), `max_joint_velocity`, and the robot's
        `limits`, `servo_force_limit` and `gravity_compensation`. Whoever builds a config with
        these settings refuses a number beyond the bounds of a setting that is no term.

        Args:
          nominals: the values of all terms without randomisation (`world.model.model_nominals`).
        """
        numbers = flat(self.settings)
        doubled = {}
        for key in self.assumed:
            factor = _factor(key, nominals)
            name = f"half {key}" if factor < 1.0 else f"twice {key}"
            doubled[name] = nested(key, _double(key, numbers[key], factor, nominals))
        return doubled


def without_idle_curriculum(randomization: dict[str, Any]) -> dict[str, Any]:
    """Settings of a randomisation without the parts of the curriculum that act on none of its
    terms, which `RandomizationConfig` refuses: `shares` of other terms, and `share` and
    `warmup_steps` without a term to share."""
    terms = [name for name in TERMS if randomization.get(name) is not None]
    acting = dict(randomization)
    if not any(TERMS[name].has_nominal for name in terms):
        acting.pop("share", None)
        if acting.get("first_goal_range", 1.0) == 1.0:
            acting.pop("warmup_steps", None)
    # Values of a file, which are validated later.
    if isinstance(acting.get("shares"), dict):
        acting["shares"] = {name: p for name, p in acting["shares"].items() if name in terms}
    return acting


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
    if group.startswith("randomization."):
        return False
    if group == "randomization" and name not in TERMS:
        return False
    for number in np.ravel(np.array(value, object)).tolist():
        if isinstance(number, bool) or not isinstance(number, int | float):
            return False
    return True


def _factor(key: str, nominals: Mapping[str, Any]) -> float:
    """By how much `double_assumed` multiplies an assumed setting, or how far a term goes from its
    nominal value."""
    group, _, name = key.rpartition(".")
    if group == "randomization":
        is_less_harder = name not in nominals
    else:
        is_less_harder = group == "robot.limits" or key in _LESS_IS_HARDER
    return 0.5 if is_less_harder else 2.0


def _double(key: str, value: Any, factor: float, nominals: Mapping[str, Any]) -> Any:
    """The value of an assumed setting in `double_assumed`."""
    group, _, name = key.rpartition(".")
    if group == "randomization":
        return [_double_end(name, end, factor, nominals) for end in value]
    return (factor * np.array(value)).tolist()


def _double_end(term: str, end: Any, factor: float, nominals: Mapping[str, Any]) -> Any:
    """An end of a term's range in `double_assumed`; one number for all entries becomes one for
    each, because each has its own nominal value."""
    centre = nominals.get(term, 0.0)
    doubled = centre + factor * (np.array(end) - centre)
    least, greatest = TERMS[term].bounds
    return np.clip(doubled, least, greatest).tolist()
