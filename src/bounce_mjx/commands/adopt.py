"""Writes the config of an unknown arm: `bounce-mjx adopt my_arm.xml`."""

import math
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import yaml

from bounce_mjx.config.command_line import Flag, parse
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.config.user_code import import_flags_of_classes
from bounce_mjx.config.validation import validate
from bounce_mjx.errors import UserError
from bounce_mjx.resources import ARM_POLICIES, resource_path
from bounce_mjx.robot.config import PaddleConfig, RobotConfig
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.presets import ROBOTS
from bounce_mjx.task.registry import DEFAULT, find_task
from bounce_mjx.task.task import Task
from bounce_mjx.world.config import WorldConfig

if TYPE_CHECKING:
    import mujoco
    import numpy as np

    from bounce_mjx.robot.adopt import Adoption

# Servos that `adopt` makes have a time constant of two control steps; slower ones are told.
_SLOW_STEPS = 2.5


class AdoptCommand(StrictModel):
    """Finds the start pose and the servos of an arm, and writes its config."""

    mjcf: Annotated[Path, Flag(metavar="MJCF", is_positional=True)]
    """MJCF or URDF file of the arm; package:NAME/FILE for a file of an installed Python package, or
    menagerie:NAME for a model of MuJoCo Menagerie."""
    site: str = "attachment_site"
    """Site or body that holds the paddle; its z points away from the arm."""
    joints: tuple[str, ...] | None = None
    """Acting joints; all hinges and slides from the world to the site by default."""
    task: str = DEFAULT
    """Task whose settings are written; other tasks can use the file too."""
    out: Path | None = None
    """File for the config; by default, my_arm.yaml for my_arm.xml."""
    paddle: PaddleConfig = PaddleConfig()
    """The paddle; a given position or quaternion fixes the mount, which is searched otherwise."""


def main(args: Sequence[str]) -> None:
    """Runs the command line; exits with 2 on a mistake."""
    command = parse(AdoptCommand, args, prog="bounce-mjx adopt")
    from bounce_mjx.env.env import Env
    from bounce_mjx.robot.adopt import adopt
    from bounce_mjx.runs.storage import write_output
    from bounce_mjx.training.setup import set_up_jax

    set_up_jax()
    task = find_task(command.task)
    robot = RobotConfig(site=command.site, joints=command.joints, paddle=command.paddle)
    chosen = command.paddle.model_dump(exclude_defaults=True)
    is_mount_given = "position" in chosen or "quaternion" in chosen
    # The servos must follow within the control steps of the task.
    adoption = adopt(command.mjcf, robot, task.Config().control_dt, is_mount_given)
    settings = _settings(command, adoption, task)
    config = validate(TrainConfig, settings, str(command.mjcf))
    env = Env(config.env)
    for line in describe(adoption):
        print(line)
    for line in warnings(adoption, env.mj_model, config.env):
        print(f"warning: {line}")
    print(f"physics: {env.engine.name} ({env.engine.reason})")
    # Of menagerie:NAME, the name.
    out = command.out or Path(f"{command.mjcf.stem.rpartition(':')[2]}.yaml")
    write_output(out, _as_yaml(args, settings))
    print(f"config: {out}")
    flags = ["--robot", str(out), *import_flags_of_classes(task)]
    viewed = flags
    trained = flags
    if command.task != DEFAULT:
        viewed = ["--task", command.task, *flags]
        trained = [command.task, *flags]
    print(f"see it: bounce-mjx view {shlex.join(viewed)} --actions zero")
    print(f"rehearse its first motions: bounce-mjx rehearse {out}")
    print(f"train it: bounce-mjx train {shlex.join(trained)}")


def warnings(adoption: "Adoption", model: "mujoco.MjModel", config: WorldConfig) -> Iterator[str]:
    """Sentences about what a simulation of an adopted arm lacks to be that of a real one.

    Args:
      model: the compiled scene.
      config: that is written.
    """
    import numpy as np

    name = known_arm(model, config)
    if name is not None:
        policy = f", and bounce-mjx play {name} a policy" if name in ARM_POLICIES else ""
        yield (
            f"this is a {name}: --robot {name} has its manufacturer's limits and servos like the "
            f"real ones{policy}; what is written here has neither"
        )
    slow = []
    for joint, servo in zip(adoption.arm.joint_names, adoption.servos, strict=True):
        damping = servo.damping + float(np.max(model.joint(joint).damping))
        seconds = damping / servo.stiffness
        if seconds > _SLOW_STEPS * config.control_dt:
            slow.append((seconds, joint))
    if slow:
        seconds, joint = max(slow)
        yield (
            f"{len(slow)} of the file's servos follow slowly, {joint} with a time constant of "
            f"{seconds:.2g} s, which are {seconds / config.control_dt:.0f} control steps; if the "
            "real ones are faster, give theirs as env.robot.servo_stiffness, servo_damping and "
            "servo_force_limit"
        )
    stated = "the file says no limits of velocity and acceleration"
    velocities = adoption.arm.velocities
    if velocities is not None:
        numbers = ", ".join(f"{velocity:g}" for velocity in velocities)
        stated = (
            f"the file's limits of velocity, {numbers} rad/s, do not act without those of "
            "acceleration, which no URDF has"
        )
    yield (
        f"{stated}, and a target may jump by {adoption.action_scale:g} rad in a control step; "
        "before a real arm, give the manufacturer's as env.robot.limits, with env.action.base: "
        "target"
    )


def known_arm(model: "mujoco.MjModel", config: WorldConfig) -> str | None:
    """The name in configs/robots/ of an arm with the same lengths and axes; None if there is none,
    or the package with its file is not installed."""
    from bounce_mjx.robot.likeness import are_alike
    from bounce_mjx.runs.worlds import OWN, settings_in_world
    from bounce_mjx.world.model import world_model

    for file in sorted(resource_path(ROBOTS).glob("*.yaml")):
        try:
            known = settings_in_world(config.task, OWN, file)
            if known.num_joints == config.num_joints and are_alike(
                world_model(known, visual=False), model
            ):
                return file.stem
        except UserError:
            # Its file is in a package that is not installed.
            continue
    return None


def _settings(command: AdoptCommand, adoption: "Adoption", task: type[Task]) -> dict[str, Any]:
    """The settings of a training that follow from an adopted arm."""
    env = {
        "mjcf": str(WorldConfig(mjcf=command.mjcf).mjcf),
        "robot": adoption.config.model_dump(mode="json", exclude_defaults=True),
        "action_scale": adoption.action_scale,
        "default_joint_angles": [round(angle, 5) for angle in adoption.pose.angles.tolist()],
    }
    x, y, z = _rounded(adoption.pose.paddle, 4)
    env |= task.Config.settings_at((x, y, z))
    if command.task == DEFAULT:
        return {"env": env}
    return {"task": command.task, "env": env}


def _as_yaml(args: Sequence[str], settings: dict[str, Any]) -> str:
    """The config file, which begins with the command that wrote it."""
    head = f"An arm with a paddle: {shlex.join(['bounce-mjx', 'adopt', *args])}"
    # A path may have a line break, which would end the comment.
    head = " ".join(head.splitlines())
    text = yaml.safe_dump(settings, sort_keys=False, default_flow_style=None, width=100)
    return f"# {head}\n{text}"


def _rounded(numbers: "np.ndarray", digits: int) -> list[float]:
    """Numbers [N], such as the coordinates of a position, without a minus before a 0."""
    return [round(number, digits) + 0.0 for number in numbers.tolist()]


def describe(adoption: "Adoption") -> list[str]:
    """Lines about an adopted arm: its pose, its servos, and the changes to the user's model."""
    import mujoco

    pose = adoption.pose
    names = adoption.arm.joint_names
    slides = []
    for name in names:
        if adoption.arm.spec.joint(name).type == mujoco.mjtJoint.mjJNT_SLIDE:
            slides.append(name)
    x, y, z = _rounded(pose.paddle, 3)
    strength = f"{pose.acceleration:.0f} m/s^2 upward in addition to holding the arm"
    if math.isinf(pose.acceleration):
        strength = "no force limit"
    clearance = f"{adoption.clearance:.3f} m between the paddle and the arm's other links"
    if adoption.clearance <= 0.0:
        clearance = "none; the paddle touches another link, so choose --paddle.position yourself"
    scale_unit = "rad"
    if len(slides) == len(names):
        scale_unit = "m"
    elif slides:
        scale_unit = "rad (a slide: m)"
    kind = "kept" if adoption.config.servo_stiffness is None else "made from the reflected inertia"
    lines = [
        f"paddle: level at x {x:.3f}, y {y:.3f}, z {z:.3f} m; the reach is {pose.reach:.2f} m",
        f"manipulability: {pose.manipulability:.3f} (smallest singular value, 0.25 m per radian)",
        f"strength: {strength}",
        f"clearance: {clearance}",
        f"servos: {kind}; action scale {adoption.action_scale:g} {scale_unit}",
    ]
    positions = _rounded(pose.angles, 3)
    for name, position, inertia, servo in zip(
        names, positions, pose.inertia, adoption.servos, strict=True
    ):
        is_slide = name in slides
        unit = "m" if is_slide else "rad"
        force = "N" if is_slide else "N m"
        mass = "kg" if is_slide else "kg m²"
        limit = "no force limit"
        if servo.force_limit is not None:
            limit = f"force limit {servo.force_limit:.4g} {force}"
        lines.append(
            f"  {name}: {position:+.3f} {unit}, inertia {inertia:.3g} {mass}, "
            f"kp {servo.stiffness:.4g} {force}/{unit}, kv {servo.damping:.4g} {force} s/{unit}, "
            f"{limit}"
        )
    if slides:
        lines.append(
            f"export: a policy of an arm with a slide ({', '.join(slides)}) runs in JAX alone, not "
            "as ONNX yet"
        )
    lines.append("changes to the model:")
    lines += [f"  {change}" for change in adoption.arm.changes]
    return lines
