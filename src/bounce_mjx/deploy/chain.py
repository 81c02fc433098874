"""Forward kinematics of the paddle in NumPy."""

import numpy as np

from bounce_mjx.deploy.metadata import Metadata

# [k, i, j]: the matrix of the cross product with the unit vector k.
_CROSS = np.cross(np.eye(3), np.eye(3)[:, None])


def paddle_pose(metadata: Metadata, joint_angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World position [..., 3] (m) of the paddle's centre, and upward unit normal [..., 3] of the
    paddle, at joint angles [..., J] (rad), by Rodrigues' formula for the hinges' rotations."""
    position, normal = np.array(metadata.paddle), np.array(metadata.paddle_normal)
    for link in reversed(metadata.chain):
        angles = (joint_angles[..., link.joint] - link.reference)[..., None, None]
        turn = np.tensordot(link.axis, _CROSS, 1)
        rotation = np.eye(3) + np.sin(angles) * turn + (1.0 - np.cos(angles)) * (turn @ turn)
        position = link.position + (rotation @ position[..., None])[..., 0]
        normal = (rotation @ normal[..., None])[..., 0]
    return position, normal
