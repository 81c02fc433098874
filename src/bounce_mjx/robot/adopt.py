"""Search of the settings of an arm that is in the task's scene (`arm.py`): its pose, its servos,
and what follows from them."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from bounce_mjx.config.validation import validate
from bounce_mjx.errors import UserError
from bounce_mjx.robot import arm as arms
from bounce_mjx.robot.actuators import ServoSettings
from bounce_mjx.robot.config import PaddleConfig, RobotConfig
from bounce_mjx.robot.model import Addresses, find_addresses
from bounce_mjx.robot.names import BALL_BODY_NAME, PADDLE_BODY_NAME
from bounce_mjx.robot.pose import PaddlePose, clearance, mounts, rank_poses

# Velocity of a joint that the action 1 commands: rad/s of a hinge, m/s of a slide. The package's
# own arm has the action scale 0.02 rad, kp 20000 and kv 200, which give 2 rad/s.
_HINGE_SPEED = 2.0
_SLIDE_SPEED = 0.6
# A kept servo is at least this well damped.
_LEAST_DAMPING_RATIO = 0.5
# One action scale serves all kept servos: those that would suit each alone differ by this factor at
# most.
_LARGEST_SPREAD = 4.0
# Largest difference of an arm in the scene from its file compiled alone, as a share of the largest
# number of the field: MuJoCo rounds frames that are almost the same.
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
    servos: tuple[ServoSettings, ...]
    """The servo of each acting joint in the scene: the file's own, which is then also in
    `arm.actuators`, or a made one."""


def adopt(mjcf: Path, config: RobotConfig, control_dt: float, is_mount_given: bool) -> Adoption:
    """Adopts the arm of an MJCF file.

    Args:
      mjcf: the file, as for `locate`.
      config: the site, and the joints and the paddle if they are chosen. Its servos are ignored,
        and its limits and gravity compensation have no part in the search.
      control_dt: time between two actions, s.
      is_mount_given: whether the paddle's position and orientation are chosen; if not, the search
        also turns the paddle about the site's z, and lays it flat.

    Raises:
      UserError: the arm cannot do the task.
    """
    path = arms.locate(mjcf)
    config = _with_servos(config, None)
    with arms.naming(path):
        arm = arms.build_arm(path, config)
        # Every body must stay, as the search moves the paddle's.
        arm.spec.compiler.fusestatic = False
        with_shapes = arms.compile_spec(arm.spec, path)
        # The search needs no shapes, and is faster without them.
        arm.spec.compiler.discardvisual = True
        model = arms.compile_spec(arm.spec, path)
        addresses = find_addresses(model)
        check_as_alone(arm, model)
        choices = [config.paddle] if is_mount_given else mounts(config.paddle)
        poses = _ranked_poses(model, addresses, arm, choices)
        pose, distance = _clear_pose(with_shapes, poses)
        config = config.model_copy(update={"paddle": pose.mount})
        scale = _scale_of_kept_servos(model, addresses, arm, pose)
        servos = arm.actuators
        if scale is None:
            servos, scale = _made_servos(model, addresses, arm, pose, control_dt)
            config = _with_servos(config, servos)
            # `model_copy` checks nothing. The doubt is in place of a file: "the MJCF file X has
            # servos of another size than robots have, perhaps by wrong units: ... is ...".
            doubt = "servos of another size than robots have, perhaps by wrong units"
            config = validate(RobotConfig, config.model_dump(), doubt)
        return Adoption(
            config=config,
            action_scale=_four_digits(scale),
            pose=pose,
            clearance=distance,
            arm=arms.build_arm(path, config),
            servos=servos,
        )


def _with_servos(config: RobotConfig, servos: Sequence[ServoSettings] | None) -> RobotConfig:
    """The config with other servos of all joints; None for the MJCF's own."""
    columns: dict[str, tuple | None] = {
        "servo_stiffness": None,
        "servo_damping": None,
        "servo_force_limit": None,
    }
    if servos is not None:
        columns["servo_stiffness"] = tuple(servo.stiffness for servo in servos)
        columns["servo_damping"] = tuple(servo.damping for servo in servos)
        columns["servo_force_limit"] = tuple(servo.force_limit for servo in servos)
    return config.model_copy(update=columns)


def _ranked_poses(
    model: mujoco.MjModel, addresses: Addresses, arm: arms.Arm, choices: Sequence[PaddleConfig]
) -> list[PaddlePose]:
    """`rank_poses`; an error names what narrows the joints' ranges.

    Args:
      model: the compiled scene.
      addresses: of its parts.
      arm: of which it is the scene.
      choices: mounts of the paddle to try.
    """
    force_limits = [servo.force_limit for servo in arm.actuators]
    try:
        return rank_poses(model, addresses, force_limits, choices)
    except UserError as error:
        if not arm.narrowed:
            raise
        narrowed = ", ".join(arm.narrowed)
        raise UserError(
            f"{error}; or widen the ctrlrange of the servos, which narrows {narrowed}"
        ) from error


def _clear_pose(
    with_shapes: mujoco.MjModel, poses: Sequence[PaddlePose]
) -> tuple[PaddlePose, float]:
    """The first pose in which the paddle keeps clear of the arm, and its distance, m; if there is
    none, the best one, of whose touch the command tells."""
    addresses = find_addresses(with_shapes)
    for pose in poses:
        distance = clearance(with_shapes, addresses, pose)
        if distance >= _LEAST_CLEARANCE:
            return pose, distance
    return poses[0], clearance(with_shapes, addresses, poses[0])


def _scale_of_kept_servos(
    model: mujoco.MjModel, addresses: Addresses, arm: arms.Arm, pose: PaddlePose
) -> float | None:
    """The action scale (rad, m) with the MJCF's own servos; None if these do not suit.

    Args:
      model: the compiled scene.
      addresses: of its parts.
      arm: with its own actuators.
      pose: in which the servos must hold the arm and be damped.
    """
    if any(servo.stiffness is None for servo in arm.actuators):
        return None
    stiffness = np.array([servo.stiffness for servo in arm.actuators])
    servo_damping = np.array([servo.damping for servo in arm.actuators])
    damping = servo_damping + model.dof_damping[list(addresses.arm_qvel)]
    # A target that is ahead by this much moves the joint at its speed.
    scales = _speeds(model, addresses) * damping / stiffness
    mean_scale = float(np.exp(np.mean(np.log(np.maximum(scales, 1e-9)))))
    damping_ratio = damping / (2.0 * np.sqrt(stiffness * pose.inertia))
    is_damped = np.min(damping_ratio) >= _LEAST_DAMPING_RATIO
    is_even = np.max(scales) <= _LARGEST_SPREAD * np.min(scales)
    holds = np.all(stiffness * mean_scale >= _LEAST_HOLD * np.abs(pose.holding))
    return mean_scale if is_damped and is_even and holds else None


def _made_servos(
    model: mujoco.MjModel,
    addresses: Addresses,
    arm: arms.Arm,
    pose: PaddlePose,
    control_dt: float,
) -> tuple[tuple[ServoSettings, ...], float]:
    """Servos for the inertias of a pose, and the action scale, rad or m.

    A hinge is critically damped, by its servo and its own damping together, at the natural
    frequency 1 / control_dt: 4 % of an error are left after five control steps, and physics steps
    of a fifth of a control step are stable. The same action commands less of a slide, whose servo
    is softer: its damping ratio is 1.8. Where the joint's own damping is larger than that, the
    servo adds none, and is stiff enough for the commanded velocity.

    Args:
      model: the compiled scene.
      addresses: of its parts.
      arm: whose force limits stay.
      pose: in which the inertias are those of the arm.
      control_dt: time between two actions, s.
    """
    frequency = 1.0 / control_dt
    scale = 2.0 * _HINGE_SPEED / frequency
    joint_damping = model.dof_damping[list(addresses.arm_qvel)]
    damping = np.maximum(2.0 * frequency * pose.inertia, joint_damping)
    servo_damping = damping - joint_damping
    # At its velocity, a target that is ahead by the scale balances the damping.
    stiffness = damping * _speeds(model, addresses) / scale
    servos = []
    for i, servo in enumerate(arm.actuators):
        servos.append(
            ServoSettings(
                stiffness=_four_digits(stiffness[i]),
                damping=_four_digits(servo_damping[i]),
                force_limit=servo.force_limit,
            )
        )
    return tuple(servos), scale


def _speeds(model: mujoco.MjModel, addresses: Addresses) -> np.ndarray:
    """Velocity of each acting joint [n] that the action 1 commands, rad/s or m/s."""
    kinds = model.jnt_type[list(addresses.arm_joints)]
    return np.where(kinds == mujoco.mjtJoint.mjJNT_HINGE, _HINGE_SPEED, _SLIDE_SPEED)


def check_as_alone(arm: arms.Arm, model: mujoco.MjModel) -> None:
    """Compares the bodies of an arm in the task's scene to those of its file compiled alone.

    Args:
      arm: from the file.
      model: the compiled scene, with all bodies.

    Raises:
      UserError: a body's pose, mass or inertia differs, or a joint's axis.
    """
    added = (BALL_BODY_NAME, PADDLE_BODY_NAME)
    bodies = [body for body in range(1, model.nbody) if model.body(body).name not in added]
    joints = list(find_addresses(model).arm_joints)
    for field, expected in arm.file_numbers.items():
        rows = bodies if field in arms.BODY_FIELDS else joints
        in_scene = getattr(model, field)[rows]
        error = np.max(np.abs(in_scene - expected))
        if error > _EQUAL * np.max(np.abs(expected)):
            raise UserError(
                f"an arm that changes in the task's scene, where its {field} differs by "
                f"{error:.2g}; write the MJCF in a plainer way, with angles as quaternions"
            )


def _four_digits(value: float) -> float:
    """The value with four digits."""
    return float(f"{value:.4g}")
