"""Adoption of an unknown arm: its pose, its servos, and the settings that follow from them."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.robot import arm as arms
from bounce_mjx.robot.config import RobotConfig
from bounce_mjx.robot.model import find_addresses
from bounce_mjx.robot.pose import PaddlePose, clearance, mounts, rank_poses

# Velocity of a joint that the action 1 commands: rad/s of a hinge, m/s of a slide. The Peitian
# arm's servos give 0.02 rad x 20000 / 200 = 2 rad/s.
_HINGE_SPEED, _SLIDE_SPEED = 2.0, 0.6
# A kept servo is at least this well damped, and answers within a factor of the others.
_LEAST_DAMPING_RATIO = 0.5
_LARGEST_SPREAD = 4.0
# Largest difference of an arm in the scene from its file compiled alone: MuJoCo rounds frames that
# are almost the same.
_EQUAL = 1e-6
# Distance of the paddle from the arm's other links in the start pose, m.
_LEAST_CLEARANCE = 0.01
# Torque of a kept servo at the action 1, in multiples of the torque that holds the arm.
_LEAST_HOLD = 1.5


class Adoption(NamedTuple):
    """An adopted arm, and what the search found."""

    config: RobotConfig
    action_scale: float
    """Change of the servo target for an action of 1, rad; of a slide, m."""
    pose: PaddlePose
    clearance: float
    """Distance of the paddle from the arm's other links in the pose, m; negative inside one."""
    arm: arms.Arm
    servos: tuple[arms.ServoSettings, ...]
    """The servo of each acting joint."""


def adopt(mjcf: Path, config: RobotConfig, control_dt: float, is_mount_given: bool) -> Adoption:
    """Adopts the arm of an MJCF file.

    Args:
      mjcf: the file, as for `locate`.
      config: the site, and the joints and the paddle if they are chosen; its servos are ignored.
      control_dt: time between two actions, s.
      is_mount_given: whether the paddle's position and orientation are chosen; if not, the search
        also turns the paddle about the site's z, and lays it flat.

    Raises:
      UserError: the arm cannot do the task.
    """
    path = arms.locate(mjcf)
    config = config.model_copy(
        update={f"servo_{name}": None for name in arms.ServoSettings._fields}
    )
    with arms.naming(path):
        arm = arms.build_arm(path, config)
        # So every body stays: the search turns the paddle's.
        arm.spec.compiler.fusestatic = False
        with_shapes = arms.compile_spec(arm.spec, path)
        arm.spec.compiler.discardvisual = True
        model = arms.compile_spec(arm.spec, path)
        check_as_alone(arm, model)
        choices = [config.paddle] if is_mount_given else mounts(config.paddle)
        force_limits = [servo.force_limit for servo in arm.servos]
        try:
            poses = rank_poses(model, force_limits, choices)
        except UserError as error:
            if not arm.narrowed:
                raise
            narrowed = ", ".join(arm.narrowed)
            raise UserError(
                f"{error}; or widen the ctrlrange of the servos, which narrows {narrowed}"
            ) from error
        pose, distance = _clear_pose(with_shapes, poses)
        servos, scale = _servos(model, arm, pose, control_dt)
        update = {"paddle": pose.mount}
        if servos is not arm.servos:
            columns = zip(arms.ServoSettings._fields, zip(*servos, strict=True), strict=True)
            update |= {f"servo_{name}": column for name, column in columns}
        adopted = RobotConfig.model_validate(config.model_copy(update=update).model_dump())
        return Adoption(
            config=adopted,
            action_scale=scale,
            pose=pose,
            clearance=distance,
            arm=arms.build_arm(path, adopted),
            servos=servos,
        )


def _clear_pose(
    with_shapes: mujoco.MjModel, poses: Sequence[PaddlePose]
) -> tuple[PaddlePose, float]:
    """The first pose in which the paddle keeps clear of the arm, and its distance, m; the best one
    if there is none."""
    for pose in poses:
        distance = clearance(with_shapes, pose)
        if distance >= _LEAST_CLEARANCE:
            return pose, distance
    return poses[0], clearance(with_shapes, poses[0])


def _servos(
    model: mujoco.MjModel, arm: arms.Arm, pose: PaddlePose, control_dt: float
) -> tuple[tuple[arms.ServoSettings, ...], float]:
    """The servos, which are the MJCF's own if these suit, and the action scale."""
    addresses = find_addresses(model)
    joints = list(addresses.arm_joints)
    hinge = model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_HINGE
    speed = np.where(hinge, _HINGE_SPEED, _SLIDE_SPEED)
    passive = model.dof_damping[list(addresses.arm_qvel)]
    stiffnesses, dampings, limits = zip(*arm.servos, strict=True)
    if None not in stiffnesses:
        stiffness, damping = np.array(stiffnesses), np.array(dampings) + passive
        scales = speed * damping / stiffness
        scale = float(np.exp(np.mean(np.log(np.maximum(scales, 1e-9)))))
        ratio = damping / (2.0 * np.sqrt(stiffness * pose.inertia))
        suits = (
            np.min(ratio) >= _LEAST_DAMPING_RATIO
            and np.max(scales) <= _LARGEST_SPREAD * np.min(scales)
            and np.all(stiffness * scale >= _LEAST_HOLD * np.abs(pose.holding))
        )
        if suits:
            return arm.servos, _four_digits(scale)
    # Critical damping at the natural frequency 1 / control_dt: within a control step a joint comes
    # to rest, and physics steps of a fifth of it are stable.
    frequency = 1.0 / control_dt
    scale = 2.0 * _HINGE_SPEED / frequency
    damping = 2.0 * frequency * pose.inertia
    stiffness = damping * speed / scale
    made = zip(stiffness, damping, limits, strict=True)
    servos = tuple(
        arms.ServoSettings(_four_digits(k), _four_digits(d), limit) for k, d, limit in made
    )
    return servos, _four_digits(scale)


def check_as_alone(arm: arms.Arm, model: mujoco.MjModel) -> None:
    """Compares the bodies of an arm in the task's scene to those of its file compiled alone.

    Args:
      model: the compiled scene, with all bodies.

    Raises:
      UserError: a body's pose, mass or inertia differs, or a joint's axis.
    """
    added = (arms.BALL_BODY_NAME, arms.PADDLE_BODY_NAME)
    bodies = [b for b in range(1, model.nbody) if model.body(b).name not in added]
    joints = list(find_addresses(model).arm_joints)
    for field, expected in arm.alone.items():
        here = getattr(model, field)[bodies if field in arms.BODY_FIELDS else joints]
        error = np.max(np.abs(here - expected))
        if error > _EQUAL * np.max(np.abs(expected)):
            raise UserError(
                f"an arm that changes in the task's scene, where its {field} differs by "
                f"{error:.2g}; write the MJCF in a plainer way, with angles as quaternions"
            )


def _four_digits(value: float) -> float:
    """The value with four digits."""
    return float(f"{value:.4g}")
