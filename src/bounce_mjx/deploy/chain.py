"""Forward kinematics of the paddle in NumPy."""

import numpy as np

from bounce_mjx.deploy.metadata import Metadata


def paddle_position(metadata: Metadata, joint_angles: np.ndarray) -> np.ndarray:
    """World position [3] of the paddle's centre at joint angles [J] (rad), m."""
    position, rotation = np.zeros(3), np.eye(3)
    for link in metadata.chain:
        position = position + rotation @ link.position
        angle = 0.5 * (joint_angles[link.joint] - link.reference)
        turn = (np.cos(angle), *(np.sin(angle) * np.asarray(link.axis)))
        rotation = rotation @ _matrix(link.quaternion) @ _matrix(turn)
    return position + rotation @ metadata.paddle


def _matrix(quaternion: tuple[float, ...]) -> np.ndarray:
    """Rotation matrix [3, 3] of a unit quaternion [w, x, y, z]."""
    w, *v = quaternion
    x, y, z = v
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross
