"""Whether two arms are the same make, by their lengths and axes alone."""

import mujoco
import numpy as np

from bounce_mjx.robot.model import find_addresses

_SAME_LENGTH = 2e-3
"""Difference of lengths of one make, m: files round them."""
_SAME_COSINE = 1e-3


def joint_geometry(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """What the zero positions, the frames and the names of a file have no part in: the distances
    [n - 1] (m) of the axes of each two joints in a row, and the cosines [n - 1] between these, both
    without a sign."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    joints = list(find_addresses(model).arm_joints)
    axes = data.xaxis[joints]
    points = data.xanchor[joints]
    cosines = np.abs(np.sum(axes[1:] * axes[:-1], axis=1))
    apart = points[1:] - points[:-1]
    normals = np.cross(axes[1:], axes[:-1])
    sizes = np.linalg.norm(normals, axis=1)
    crossing = np.abs(np.sum(apart * normals, axis=1)) / np.maximum(sizes, 1e-9)
    parallel = np.linalg.norm(np.cross(apart, axes[:-1]), axis=1)
    return np.where(sizes > 1e-3, crossing, parallel), cosines


def are_alike(first: mujoco.MjModel, second: mujoco.MjModel) -> bool:
    """Whether two arms have the same number of joints, with axes alike."""
    lengths, cosines = joint_geometry(first)
    other_lengths, other_cosines = joint_geometry(second)
    if len(lengths) != len(other_lengths):
        return False
    same_lengths = np.all(np.abs(lengths - other_lengths) < _SAME_LENGTH)
    return bool(same_lengths and np.all(np.abs(cosines - other_cosines) < _SAME_COSINE))
