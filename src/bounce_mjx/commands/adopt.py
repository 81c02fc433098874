"""Writes the config of an unknown arm: `bounce-mjx adopt my_arm.xml`."""

import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import yaml
from rich.console import Console

from bounce_mjx.config.command_line import Flag, parse
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.config.validation import validate
from bounce_mjx.errors import exit_on_user_error
from bounce_mjx.robot.config import PaddleConfig, RobotConfig
from bounce_mjx.runs.config import train_config
from bounce_mjx.tasks.registry import DEFAULT, find_task
from bounce_mjx.world.config import WorldConfig

if TYPE_CHECKING:
    from bounce_mjx.robot.adopt import Adoption

DEFAULT_SITE = "attachment_site"


class AdoptCommand(StrictModel):
    """Finds the start pose and the servos of an arm, and writes its config."""

    mjcf: Annotated[Path, Flag(metavar="MJCF", is_positional=True)]
    """MJCF file of the arm; package:NAME/FILE for a file of an installed Python package, or
    menagerie:NAME for a model of MuJoCo Menagerie."""
    site: str = DEFAULT_SITE
    """Site or body that holds the paddle; its z points away from the arm."""
    joints: tuple[str, ...] | None = None
    """Acting joints; all hinges and slides from the world to the site by default."""
    task: str = DEFAULT
    """Task whose settings are written; other tasks can use the file too."""
    out: Path | None = None
    """File for the config; by default, my_arm.yaml for my_arm.xml."""
    paddle: PaddleConfig = PaddleConfig()
    """The paddle; a given position or quaternion fixes the mount, which is searched otherwise."""


@exit_on_user_error()
def main(args: Sequence[str]) -> None:
    """Runs the command line; exits with 2 on a mistake."""
    command = parse(AdoptCommand, args, prog="bounce-mjx adopt")
    from bounce_mjx.env.env import Env
    from bounce_mjx.robot.adopt import adopt
    from bounce_mjx.runs.files import write_output
    from bounce_mjx.training.setup import set_up_jax

    set_up_jax()
    task = find_task(command.task)
    console = Console(soft_wrap=True, highlight=False)
    given = command.paddle.model_dump(exclude_defaults=True)
    fixed = not {"position", "quaternion"}.isdisjoint(given)
    robot = RobotConfig(site=command.site, joints=command.joints, paddle=command.paddle)
    adoption = adopt(command.mjcf, robot, WorldConfig().control_dt, fixed)
    values = {"env": env_values(command.mjcf, adoption, task.Config)}
    if command.task != DEFAULT:
        values = {"task": command.task, **values}
    config = validate(train_config(task), values, str(command.mjcf))
    env = Env(config.env)
    for line in describe(adoption):
        console.print(line, markup=False)
    console.print(f"physics: {env.engine.name} ({env.engine.reason})", markup=False)
    out = command.out or Path(f"{command.mjcf.stem}.yaml")
    head = f"An arm with a paddle: bounce-mjx adopt {command.mjcf} --site {adoption.config.site}"
    text = yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=100)
    write_output(out, f"# {head}\n{text}")
    console.print(f"config: {out}", markup=False)
    named = [] if command.task == DEFAULT else ["--task", command.task]
    flags = [*named, "--robot", str(out)]
    shown = shlex.join([*flags, "--actions", "zero"])
    console.print(f"see it: bounce-mjx view {shown}", markup=False)
    console.print(f"train it: bounce-mjx train {shlex.join(flags)}", markup=False)


def env_values(mjcf: Path, adoption: "Adoption", config_class: type[WorldConfig]) -> dict[str, Any]:
    """The settings of a task that belong to an adopted arm.

    Args:
      config_class: the settings' class.
    """
    pose = adoption.pose
    x, y, z = (round(coordinate, 4) + 0.0 for coordinate in pose.paddle.tolist())
    return {
        "mjcf": str(WorldConfig(mjcf=mjcf).mjcf),
        "robot": adoption.config.model_dump(mode="json", exclude_defaults=True),
        "action_scale": adoption.action_scale,
        "default_joint_angles": [round(angle, 5) for angle in pose.angles.tolist()],
        **config_class.settings_at((x, y, z)),
    }


def describe(adoption: "Adoption") -> list[str]:
    """Lines about an adopted arm: its pose, its servos, and the changes to the user's model."""
    pose, arm = adoption.pose, adoption.arm
    x, y, z = (round(coordinate, 6) + 0.0 for coordinate in pose.paddle)
    strength = f"{pose.acceleration:.0f} m/s^2 upward in addition to holding the arm"
    is_kept = adoption.config.servo_stiffness is None
    kind = "kept" if is_kept else "made from the reflected inertia"
    lines = [
        f"paddle: level at x {x:.3f}, y {y:.3f}, z {z:.3f} m; the reach is {pose.reach:.2f} m",
        f"manipulability: {pose.manipulability:.3f} (smallest singular value, 0.25 m per radian)",
        f"strength: {strength if math.isfinite(pose.acceleration) else 'no force limit'}",
        f"servos ({kind}), action scale {adoption.action_scale:g} rad:",
    ]
    for name, angle, inertia, servo in zip(
        arm.joint_names, pose.angles, pose.inertia, adoption.servos, strict=True
    ):
        most = servo.force_limit
        limit = "no force limit" if most is None else f"force limit {most:.4g}"
        lines.append(
            f"  {name}: {angle:+.3f} rad, inertia {inertia:.3g}, kp {servo.stiffness:.4g}, "
            f"kv {servo.damping:.4g}, {limit}"
        )
    return [*lines, "changes to the model:", *(f"  {change}" for change in arm.changes)]
