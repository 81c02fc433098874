"""Forward kinematics of the paddle in NumPy."""

import numpy as np

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
        cross = np.array([_cross(link.axis) for link in links])
        self._fixed = np.array([_matrix(link.quaternion) for link in links])
        self._sine_term = self._fixed @ cross
        self._cosine_term = self._sine_term @ cross

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


def _matrix(quaternion: tuple[float, ...]) -> np.ndarray:
    """Rotation matrix [3, 3] of a unit quaternion [w, x, y, z]."""
    w, *v = quaternion
    cross = _cross(v)
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def _cross(vector: tuple[float, ...]) -> np.ndarray:
    """Matrix [3, 3] of the cross product with a vector [3]."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
