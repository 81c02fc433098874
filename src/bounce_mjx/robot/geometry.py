"""Sizes and places of the compiled model that tasks, policies and controllers need."""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from bounce_mjx.robot.model import Addresses, data_at


class Geometry(NamedTuple):
    """What a task needs of the ball and the paddle, which a model may have in any size."""

    ball_radius: float
    """Radius of the balls, m."""
    rest_height: float
    """Height of a ball's centre over the paddle's while they touch, m."""
    paddle_home: tuple[float, float, float]
    """Centre of the paddle at a reset without noise, m; `model.paddle_home` rounds it."""


def read_geometry(
    mj_model: mujoco.MjModel, addresses: Addresses, joint_angles: Sequence[float]
) -> Geometry:
    """The geometry of a model whose arm starts at joint angles [n], rad."""
    ball_radius = float(mj_model.geom_size[addresses.balls[0].geom, 0])
    _, face_height = upper_face(mj_model, addresses, joint_angles)
    data = data_at(mj_model, addresses, joint_angles)
    paddle_home = tuple(data.geom_xpos[addresses.paddle_geom].tolist())
    return Geometry(ball_radius, ball_radius + face_height, paddle_home)


def upper_face(
    mj_model: mujoco.MjModel, addresses: Addresses, joint_angles: Sequence[float]
) -> tuple[np.ndarray, float]:
    """Unit normal [3] of the paddle's face that is the upper one at these joint angles (rad), in
    the frame of the paddle's body, and the face's distance from the paddle's centre, m."""
    paddle = addresses.paddle_geom
    data = data_at(mj_model, addresses, joint_angles)
    # The height of each of the geom's axes.
    upward = data.geom_xmat[paddle].reshape(3, 3)[2]
    axis = int(np.argmax(abs(upward)))
    normal_in_geom = np.sign(upward[axis]) * np.eye(3)[axis]
    normal = np.zeros(3)
    mujoco.mju_rotVecQuat(normal, normal_in_geom, mj_model.geom_quat[paddle])
    half_thickness = float(mj_model.geom_aabb[paddle, 3 + axis])
    return normal, half_thickness
