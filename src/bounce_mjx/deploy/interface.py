"""What a policy and the environment in which it acts must have in common.

A policy gets numbers and gives numbers, so nothing in an array says that they mean something else.
"""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import NamedTuple

from bounce_mjx.deploy.metadata import Metadata
from bounce_mjx.errors import UserError
from bounce_mjx.task.registry import task_name
from bounce_mjx.world.config import WorldConfig

OWN_ROBOT = "AIR4-560"
"""Name of the project's own arm, which has no file of a user."""

_UNITS = {"control step": " s", "action scale": " rad", "largest lead": " rad"}


class Interface(NamedTuple):
    """The meaning of a policy's observations and actions. What bounds the commands, such as the
    arm's limits, is not in it, as the same numbers mean the same with and without."""

    task: str
    """Name of the task."""
    robot: str
    """Name of the arm, as its MJCF file states it."""
    start_pose: tuple[float, ...]
    """Joint angles at the start of an episode, rad."""
    control_step: float
    """Time between two actions, s."""
    action_base: str
    """What an action adds to: measured or target."""
    action_scale: float
    """Change of the servo target at the action 1, rad."""
    largest_lead: float | None
    """Largest distance of the last target from the measured angle, rad; None without one."""
    observation: tuple[str, ...]
    """Each quantity of the observation, and how many of its values, in their order."""


def interface_of(env: WorldConfig) -> Interface:
    """The interface of an environment with these settings, and of a policy trained in it.

    Raises:
      UserError: the MJCF file is missing or wrong.
    """
    return Interface(
        task=task_name(env.task),
        robot=robot_name(env.mjcf),
        start_pose=env.default_joint_angles,
        control_step=env.control_dt,
        action_base=env.action.base,
        action_scale=env.action_scale,
        largest_lead=env.action.max_lead if env.action.base == "target" else None,
        observation=_quantities(
            [(part.name, part.count) for part in env.layout.parts], env.observation.velocity
        ),
    )


def interface_in(metadata: Metadata) -> Interface:
    """The interface of an exported policy."""
    names = {"past_actions": "action"}
    parts = [(names.get(part.name, part.name), part.history) for part in metadata.observation]
    return Interface(
        task=metadata.task,
        robot=metadata.robot,
        start_pose=metadata.default_joint_angles,
        control_step=metadata.control_dt,
        action_base=metadata.action_base,
        action_scale=metadata.action_scale,
        largest_lead=metadata.max_lead,
        observation=_quantities(parts, metadata.velocity),
    )


def check_interface(policy: Interface, env: Interface, name: str, advice: str) -> None:
    """Refuses a policy in an environment that means something else by the same numbers.

    Args:
      name: of the policy, for the error.
      advice: what to do about it.

    Raises:
      UserError: they differ.
    """
    differences = []
    for field in Interface._fields:
        of_policy = getattr(policy, field)
        of_env = getattr(env, field)
        if not _is_same(of_policy, of_env):
            differences.append(_difference(field.replace("_", " "), of_policy, of_env))
    if differences:
        raise UserError(
            f"the policy {name} is of another environment ({'; '.join(differences)}); {advice}"
        )


def robot_name(mjcf: Path | None) -> str:
    """Name of an arm, as its MJCF file states it; None is the project's own.

    Raises:
      UserError: the file is missing or wrong.
    """
    if mjcf is None:
        return OWN_ROBOT
    # Imports MuJoCo, which a policy on a robot does not need.
    from bounce_mjx.robot.config import RobotConfig
    from bounce_mjx.robot.model import scene_spec

    return scene_spec(mjcf, RobotConfig())[0].modelname


def _quantities(parts: list[tuple[str, int]], velocity: str) -> tuple[str, ...]:
    """The parts of an observation in words."""
    words = []
    for name, count in parts:
        source = " by differences" if (name, velocity) == ("ball_velocity", "differences") else ""
        words.append(f"{count} x {name}{source}")
    return tuple(words)


def _is_same(of_policy: object, of_env: object) -> bool:
    if isinstance(of_policy, float) and isinstance(of_env, float):
        return math.isclose(of_policy, of_env, rel_tol=1e-6)
    if isinstance(of_policy, tuple) and isinstance(of_env, tuple):
        if len(of_policy) != len(of_env):
            return False
        pairs = zip(of_policy, of_env, strict=True)
        return all(_is_same_entry(first, second) for first, second in pairs)
    return of_policy == of_env


def _is_same_entry(first: object, second: object) -> bool:
    """Whether two entries of tuples are alike; angles may differ by rounding."""
    if isinstance(first, float):
        return math.isclose(first, second, abs_tol=1e-6)
    return first == second


def _difference(field: str, of_policy: object, of_env: object) -> str:
    """A difference in words."""
    if field == "start pose":
        return f"its start pose is {_angles(of_policy)}, there {_angles(of_env)}"
    if field == "observation":
        pairs = itertools.zip_longest(of_policy, of_env, fillvalue="nothing more")
        first, other = next((a, b) for a, b in pairs if a != b)
        return f"its observation has {first} where there is {other}"
    unit = _UNITS.get(field, "")
    return f"its {field} is {_value(of_policy, unit)}, there {_value(of_env, unit)}"


def _angles(pose: tuple[float, ...]) -> str:
    return f"{' '.join(f'{angle:.3g}' for angle in pose)} rad"


def _value(value: object, unit: str) -> str:
    """A value in words."""
    if isinstance(value, float):
        return f"{value:g}{unit}"
    return str(value or "none")
