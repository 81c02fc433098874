"""A calibrated camera, and the place where the rays of several meet."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

RADIUS = 0.019
"""Radius of the ball, m."""


class Camera(NamedTuple):
    """A calibrated camera, in OpenCV's convention: x right, y down, z forward."""

    matrix: np.ndarray
    """Intrinsic matrix [3, 3], pixels."""
    distortion: np.ndarray
    """k1, k2, p1, p2, k3 of the lens [5]."""
    rotation: np.ndarray
    """From the robot's frame to the camera's [3, 3]."""
    translation: np.ndarray
    """The robot's origin in the camera's frame [3], m."""

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels [N, 2] of points [N, 3] (m) in the robot's frame."""
        rotation_vector, _ = cv2.Rodrigues(self.rotation)
        pixels, _ = cv2.projectPoints(
            np.reshape(points, (-1, 1, 3)).astype(float),
            rotation_vector,
            self.translation,
            self.matrix,
            self.distortion,
        )
        return pixels.reshape(-1, 2)

    @property
    def centre(self) -> np.ndarray:
        """Place of the camera in the robot's frame [3], m."""
        return -self.rotation.T @ self.translation

    def ray(self, pixel: Sequence[float]) -> np.ndarray:
        """Unit vector [3] in the robot's frame from the camera toward a pixel."""
        point = np.array(pixel, float).reshape(1, 1, 2)
        x, y = cv2.undistortPoints(point, self.matrix, self.distortion).ravel()
        direction = self.rotation.T @ np.array([x, y, 1.0])
        return direction / np.linalg.norm(direction)

    def radius_at(self, position: np.ndarray) -> float:
        """Radius of the ball at a position [3] (m) in the picture, pixels."""
        depth = (self.rotation @ position + self.translation)[2]
        return float(self.matrix[0, 0] * RADIUS / max(depth, 0.05))


# Sine of an angle to the vertical at which a horizon is not level, but unknown.
_VERTICAL = 1e-6


def rough_camera(
    place: Sequence[float], gaze: Sequence[float], size: tuple[int, int], field_of_view: float
) -> Camera:
    """A camera with a level horizon, measured with a tape; the pictures of one straight above its
    gaze have x at the top.

    Args:
      place: of the camera [3], m, in the robot's frame.
      gaze: the point at which it looks [3], m.
      size: width and height of its pictures, pixels.
      field_of_view: horizontal, degrees.
    """
    width, height = size
    forward = np.array(gaze, float) - np.array(place, float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < _VERTICAL:
        right = np.cross(forward, [1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    focal_length = 0.5 * width / np.tan(0.5 * np.radians(field_of_view))
    matrix = np.array(
        [[focal_length, 0.0, width / 2], [0.0, focal_length, height / 2], [0.0, 0.0, 1.0]]
    )
    return Camera(matrix, np.zeros(5), rotation, -rotation @ np.array(place, float))


def triangulate(cameras: Sequence[Camera], pixels: Sequence[np.ndarray]) -> np.ndarray:
    """The place [3] (m) with the least sum of squared distances from the rays of all cameras."""
    matrix = np.zeros((3, 3))
    vector = np.zeros(3)
    for camera, pixel in zip(cameras, pixels, strict=True):
        ray = camera.ray(pixel)
        across = np.eye(3) - np.outer(ray, ray)
        matrix += across
        vector += across @ camera.centre
    return np.linalg.solve(matrix, vector)
