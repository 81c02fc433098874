"""Adoption of an unknown arm: its pose, its servos, and the settings that follow from them."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.robot.arm import (
    Arm,
    ServoSettings,
    build_arm,
    compile_spec,
    find_site,
    is_below,
    locate,
)
from bounce_mjx.robot.config import RobotConfig
from bounce_mjx.robot.model import find_addresses, named
from bounce_mjx.robot.pose import Mount, PaddlePose, find_pose, mounts

# Velocity of a joint that the action 1 commands: rad/s of a hinge, m/s of a slide. The Peitian
# arm's servos give 0.02 rad x 20000 / 200 = 2 rad/s.
_HINGE_SPEED, _SLIDE_SPEED = 2.0, 0.6
# A kept servo is at least this well damped, and answers within a factor of the others.
_LEAST_DAMPING_RATIO = 0.5
_LARGEST_SPREAD = 4.0
# Largest difference of an arm in the scene from its file compiled alone: MuJoCo rounds frames that
# are almost the same.
_EQUAL = 1e-6
# Torque of a kept servo at the action 1, in multiples of the torque that holds the arm.
_LEAST_HOLD = 1.5


class Adoption(NamedTuple):
    """An adopted arm, and what the search found."""

    config: RobotConfig
    action_scale: float
    """Change of the servo target for an action of 1, rad; of a slide, m."""
    pose: PaddlePose
    arm: Arm
    servos: tuple[ServoSettings, ...]
    """The servo of each acting joint."""
    are_kept: bool
    """Whether the servos are the MJCF's own."""


def adopt(mjcf: Path, config: RobotConfig, control_dt: float, is_mount_given: bool) -> Adoption:
    """Adopts the arm of an MJCF file.

    Args:
      mjcf: the file, as for `locate`.
      config: the site, and wishes about the joints and the paddle; its servos are ignored.
      control_dt: time between two actions, s.
      is_mount_given: whether the paddle's position and orientation are wishes; if not, the search
        also turns the paddle about the site's z, and lays it flat.

    Raises:
      UserError: the arm cannot do the task.
    """
    path = locate(mjcf)
    config = config.model_copy(update={f"servo_{name}": None for name in ServoSettings._fields})
    try:
        arm = build_arm(path, config)
        arm.spec.compiler.discardvisual = True
        # So the paddle keeps its own body, which the search turns.
        arm.spec.compiler.fusestatic = False
        model = compile_spec(arm.spec, path)
        asked = Mount(config.paddle.position, config.paddle.quaternion)
        pose = find_pose(model, arm.force_limits, (asked,) if is_mount_given else mounts())
        servos, scale, are_kept = _servos(model, arm, pose, control_dt)
        update = {"paddle": config.paddle.model_copy(update=pose.mount._asdict())}
        if not are_kept:
            columns = zip(ServoSettings._fields, zip(*servos, strict=True), strict=True)
            update |= {f"servo_{name}": column for name, column in columns}
        adopted = RobotConfig.model_validate(config.model_copy(update=update).model_dump())
        result = build_arm(path, adopted)
        _check_as_alone(result, compile_spec(result.spec, path), adopted, pose.angles)
        return Adoption(adopted, scale, pose, result, servos, are_kept)
    except UserError as error:
        raise named(path, error) from error


def _servos(
    model: mujoco.MjModel, arm: Arm, pose: PaddlePose, control_dt: float
) -> tuple[tuple[ServoSettings, ...], float, bool]:
    """The servos, the action scale, and whether the servos are the MJCF's own."""
    addresses = find_addresses(model)
    joints = list(addresses.arm_joints)
    hinge = model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_HINGE
    speed = np.where(hinge, _HINGE_SPEED, _SLIDE_SPEED)
    passive = model.dof_damping[list(addresses.arm_qvel)]
    own = [servo for servo in arm.servos if servo is not None]
    if len(own) == len(joints):
        stiffness = np.array([servo.stiffness for servo in own])
        damping = np.array([servo.damping for servo in own]) + passive
        scales = speed * damping / stiffness
        scale = float(np.exp(np.mean(np.log(np.maximum(scales, 1e-9)))))
        ratio = damping / (2.0 * np.sqrt(stiffness * np.array(pose.inertia)))
        suits = (
            np.min(ratio) >= _LEAST_DAMPING_RATIO
            and np.max(scales) <= _LARGEST_SPREAD * np.min(scales)
            and np.all(stiffness * scale >= _LEAST_HOLD * np.abs(pose.holding))
        )
        if suits:
            return tuple(own), _rounded(scale), True
    # Critical damping at the natural frequency 1 / control_dt: within a control step a joint comes
    # to rest, and physics steps of a fifth of it are stable.
    frequency = 1.0 / control_dt
    scale = 2.0 * _HINGE_SPEED / frequency
    damping = 2.0 * frequency * np.array(pose.inertia)
    stiffness = damping * speed / scale
    limits = arm.force_limits
    made = zip(stiffness, damping, limits, strict=True)
    servos = tuple(ServoSettings(_rounded(k), _rounded(d), limit) for k, d, limit in made)
    return servos, _rounded(scale), False


def _check_as_alone(
    arm: Arm, model: mujoco.MjModel, config: RobotConfig, angles: Sequence[float]
) -> None:
    """Compares an arm in the task's scene to its file compiled alone, at the start pose.

    Raises:
      UserError: the paddle is not at its site, or a link's pose, mass or inertia differs.
    """
    at, own, blade = find_addresses(model), arm.own, config.paddle
    here, alone = _at(model, at.arm_joints, angles), _at(own.model, own.joints, angles)
    body, position, quaternion = find_site(own.model, config)
    turned = alone.xmat[body].reshape(3, 3)
    site = turned @ _rotation(quaternion)
    centre = alone.xpos[body] + turned @ position + site @ blade.position
    paddle, rotation = at.paddle_geom, site @ _rotation(blade.quaternion)
    found = {
        "the pose of the site": (
            [*here.geom_xpos[paddle], *here.geom_xmat[paddle]],
            [*centre, *rotation.ravel()],
        )
    }
    squared = np.square(blade.half_size)
    principal = blade.mass / 3.0 * (np.sum(squared) - squared)
    added = _inertia(blade.mass, principal, centre, rotation)
    for name, i, j in zip(arm.joint_names, at.arm_joints, own.joints, strict=True):
        link, alike = model.jnt_bodyid[i], own.model.jnt_bodyid[j]
        bodies = _welded(model, at.arm_joints, link)
        inertia = _summed(model, here, bodies) - added * (model.geom_bodyid[paddle] in bodies)
        others = _welded(own.model, own.joints, alike, own.gripper)
        found[f"the pose of the link of {name}"] = (
            [*here.xpos[link], *here.xmat[link], *here.xaxis[i]],
            [*alone.xpos[alike], *alone.xmat[alike], *alone.xaxis[j]],
        )
        found[f"the mass or inertia of the link of {name}"] = (
            inertia,
            _summed(own.model, alone, others),
        )
    for words, pair in found.items():
        if not np.allclose(*pair, rtol=0.0, atol=_EQUAL * np.max(np.abs(pair))):
            raise UserError(
                f"an arm that changes in the task's scene: {words} at the start pose differs by "
                f"{np.max(np.abs(np.subtract(*pair))):.2g}; write the MJCF in a plainer way, with "
                "angles as quaternions"
            )


def _at(model: mujoco.MjModel, joints: Sequence[int], angles: Sequence[float]) -> mujoco.MjData:
    """The kinematics of a model with these joints at these angles, rad."""
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[list(joints)]] = angles
    mujoco.mj_kinematics(model, data)
    return data


def _welded(
    model: mujoco.MjModel, joints: Sequence[int], link: int, gripper: Sequence[int] = ()
) -> list[int]:
    """A link's bodies, with no other acting joint between, without the gripper's."""
    acting, bodies = {0, *model.jnt_bodyid[list(joints)].tolist()}, []
    for body in range(1, model.nbody):
        owner = body
        while owner not in acting:
            owner = int(model.body_parentid[owner])
        if owner == link and not is_below(model, body, gripper):
            bodies.append(body)
    return bodies


def _summed(model: mujoco.MjModel, data: mujoco.MjData, bodies: Sequence[int]) -> np.ndarray:
    """`_inertia` of several bodies together."""
    mass, inertia, centres, frames = model.body_mass, model.body_inertia, data.xipos, data.ximat
    return sum(_inertia(mass[b], inertia[b], centres[b], frames[b].reshape(3, 3)) for b in bodies)


def _inertia(mass: float, principal: np.ndarray, at: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Mass, first moment and inertia matrix about the world's origin [13] of a body with these
    principal moments [3] about the point `at` [3], along the columns of `axes` [3, 3]."""
    about = axes @ np.diag(principal) @ axes.T + mass * (at @ at * np.eye(3) - np.outer(at, at))
    return np.array([mass, *(mass * at), *about.ravel()])


def _rotation(quaternion: Sequence[float]) -> np.ndarray:
    """Rotation matrix [3, 3] of a quaternion [w, x, y, z]."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.array(quaternion) / np.linalg.norm(quaternion))
    return matrix.reshape(3, 3)


def _rounded(value: float) -> float:
    """The value with four digits."""
    return float(f"{value:.4g}")
