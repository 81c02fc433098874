"""Forward kinematics of the paddle in NumPy."""

import numpy as np
from numpy.typing import ArrayLike

from bounce_mjx.deploy.metadata import Metadata


class Chain:
    """The chain of hinges from the world to the paddle."""

    def __init__(self, metadata: Metadata):
        links = metadata.chain
        self._paddle, self._normal = np.array(metadata.paddle), np.array(metadata.paddle_normal)
        self._joints = [link.joint for link in links]
        self._references = np.array([link.reference for link in links])
        self._positions = np.array([link.position for link in links])
        # Rodrigues' formula for a hinge's rotation: R (1 + sin(a) K + (1 - cos(a)) K K).
        turn = _cross([link.axis for link in links])
        quaternions = np.array([link.quaternion for link in links])
        cross = _cross(quaternions[:, 1:])
        self._fixed = np.eye(3) + 2.0 * (quaternions[:, :1, None] * cross + cross @ cross)
        self._sine_term = self._fixed @ turn
        self._cosine_term = self._sine_term @ turn

    def paddle(self, joint_angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World position [..., 3] (m) of the paddle's centre, and upward unit normal [..., 3] of
        the paddle, at joint angles [..., J] (rad)."""
        angles = (joint_angles[..., self._joints] - self._references)[..., None, None]
        turned = np.sin(angles) * self._sine_term + (1.0 - np.cos(angles)) * self._cosine_term
        rotations = self._fixed + turned
        position, normal = self._paddle, self._normal
        for i in reversed(range(len(self._joints))):
            rotation = rotations[..., i, :, :]
            position = self._positions[i] + (rotation @ position[..., None])[..., 0]
            normal = (rotation @ normal[..., None])[..., 0]
        return position, normal


def _cross(vectors: ArrayLike) -> np.ndarray:
    """Matrices [N, 3, 3] of the cross products with vectors [N, 3]."""
    return np.cross(np.eye(3), np.array(vectors)[:, None])
