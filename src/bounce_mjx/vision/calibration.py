"""Both cameras in the frame of the robot's base, found by the arm with a ball on its paddle."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import least_squares

from bounce_mjx.deploy.metadata import Metadata
from bounce_mjx.errors import UserError
from bounce_mjx.vision.camera import Camera, triangulate
from bounce_mjx.vision.circles import Colour, Expected, find_circles
from bounce_mjx.vision.poses import ball_positions, nominal_ball

# Standard deviations of what is known before a calibration: focal length (share), principal point
# (pixels), k1 and k2, and the place of the ball on the paddle (m).
_PRIOR_FOCAL = 0.05
_PRIOR_CENTRE = 10.0
_PRIOR_LENS = 0.2
_PRIOR_BALL = 0.005
# Noise of a circle's centre, pixels, and how many times the typical residual a pose may be off.
_PIXEL_NOISE = 0.3
_BAD_RATIO = 4.0
# Distance at which a pose agrees with cameras whose lens and ball are known roughly, pixels.
_ROUGH_REPROJECTION = 15.0
# Largest error of a calibration along an axis, m (root mean square).
_MAX_ERROR = 0.01
# Parts into which the poses are divided to measure the error with poses that were not used.
_FOLDS = 4
# How far the ball may be from where cameras that were measured with a tape expect it, pixels.
_TAPE_MARGIN = 90.0


class Calibration(NamedTuple):
    """Both cameras in the frame of the robot's base, and how well they are known."""

    cameras: tuple[Camera, ...]
    ball: np.ndarray
    """Centre of the ball that was fixed to the paddle, from the paddle's centre [3], m, in the axes
    of the robot's frame at the joints' reference angles."""
    errors: np.ndarray
    """Triangulated place less that of the forward kinematics [N, 3], m, of each pose, by cameras
    that were fitted without it and without the rest of its quarter; NaN for a pose that is not
    used."""
    bad: tuple[int, ...]
    """Poses that do not fit the others, and were left out."""

    def report(self) -> str:
        """How well the cameras are known, in words."""
        used = self.errors[np.all(np.isfinite(self.errors), axis=1)]
        x, y, z = 1e3 * np.sqrt(np.mean(used**2, axis=0))
        text = f"{len(used)} poses; error x {x:.2f}, y {y:.2f}, z {z:.2f} mm (root mean square)"
        if self.bad:
            numbers = ", ".join(str(pose + 1) for pose in self.bad)
            text += f"; left out, as they do not fit: pose {numbers}"
        return text


def find_fixed_ball(
    metadata: Metadata,
    rough: Camera,
    joint_angles: np.ndarray,
    picture: np.ndarray,
    colour: Colour,
    background: np.ndarray | None = None,
) -> np.ndarray:
    """Pixel [2] of the ball that is fixed to the paddle at joint angles [J]; NaN if it is not seen.

    Args:
      rough: this camera, roughly known.

    The other arguments are those of `find_circles`.
    """
    place = ball_positions(metadata, joint_angles, nominal_ball(metadata))
    radius = rough.radius_at(place)
    expected = Expected(rough.project(place)[0], radius, np.zeros(2), _TAPE_MARGIN)
    circles = find_circles(picture, colour, background, expected, count=1)
    return circles[0].centre if circles else np.full(2, np.nan)


def calibrate(
    metadata: Metadata, rough: Sequence[Camera], joint_angles: np.ndarray, pixels: np.ndarray
) -> Calibration:
    """Both cameras in the frame of the base, from pictures of a ball that is fixed to the paddle.

    `cv2.solvePnP` starts each camera, and a bundle adjustment finds both with their lenses and the
    place of the ball on the paddle. A pose that does not fit is left out.

    Args:
      metadata: of the policy for this arm.
      rough: the cameras as `rough_camera` gives them; of these the intrinsics count.
      joint_angles: of the arm in each pose [N, J], rad.
      pixels: the ball's centre in each camera's pictures [2, N, 2]; NaN where it was not seen.
    """
    ball = nominal_ball(metadata)
    is_seen = np.all(np.isfinite(pixels), axis=(0, 2))
    used = _agreeing_poses(ball_positions(metadata, joint_angles, ball), rough, pixels, is_seen)
    bad = np.flatnonzero(is_seen & ~used).tolist()
    while True:
        if np.count_nonzero(used) < 8:
            raise UserError(
                f"{np.count_nonzero(used)} poses are left, but 8 are needed; check that the ball "
                "is fixed, that both cameras see it, and that the arm is the policy's"
            )
        cameras, adjusted, residuals = _adjust(metadata, rough, ball, joint_angles, pixels, used)
        worst = int(np.argmax(residuals))
        typical = max(_PIXEL_NOISE, 1.5 * float(np.median(residuals[used])))
        if residuals[worst] < _BAD_RATIO * typical:
            break
        bad.append(worst)
        used[worst] = False
    errors = np.full((len(joint_angles), 3), np.nan)
    numbers = np.flatnonzero(used)
    for fold in range(_FOLDS):
        left_out = numbers[fold::_FOLDS]
        others = used.copy()
        others[left_out] = False
        fold_cameras, fold_ball, _ = _adjust(metadata, rough, ball, joint_angles, pixels, others)
        truth = ball_positions(metadata, joint_angles, fold_ball)
        for pose in left_out:
            place = triangulate(fold_cameras, pixels[:, pose])
            errors[pose] = place - truth[pose]
    calibration = Calibration(cameras, adjusted, errors, tuple(sorted(bad)))
    typical_errors = np.sqrt(np.nanmean(errors**2, axis=0))
    if np.any(typical_errors > _MAX_ERROR):
        raise UserError(
            f"the poses do not agree ({calibration.report()}), but {1e3 * _MAX_ERROR:g} mm is the "
            "most that a policy bears; check that the ball is fixed, that nothing else in the "
            "pictures looks like it, and that the arm reached each pose"
        )
    return calibration


def _agreeing_poses(
    places: np.ndarray, rough: Sequence[Camera], pixels: np.ndarray, is_seen: np.ndarray
) -> np.ndarray:
    """Which poses [N] agree roughly with most others in the pictures of every camera.

    Another thing that was taken for the ball is tens of pixels away from it. The bundle adjustment
    would bend a lens to meet it, and then leave out other poses.

    Args:
      places: nominal places of the ball [N, 3], m.
      rough: the cameras, of which the intrinsics count.
      pixels: [2, N, 2].
      is_seen: whether both cameras saw the ball [N].
    """
    numbers = np.flatnonzero(is_seen)
    agrees = is_seen.copy()
    for camera, seen in zip(rough, pixels, strict=True):
        is_inlier = np.zeros(len(numbers), bool)
        # OpenCV's least number of points.
        if len(numbers) >= 4:
            is_solved, _, _, inliers = cv2.solvePnPRansac(
                places[numbers],
                seen[numbers],
                camera.matrix,
                None,
                iterationsCount=1000,
                reprojectionError=_ROUGH_REPROJECTION,
                confidence=0.9999,
                flags=cv2.SOLVEPNP_SQPNP,
            )
            if is_solved:
                is_inlier[inliers.ravel()] = True
        agrees[numbers[~is_inlier]] = False
    return agrees


def _adjust(
    metadata: Metadata,
    rough: Sequence[Camera],
    ball: np.ndarray,
    joint_angles: np.ndarray,
    pixels: np.ndarray,
    used: np.ndarray,
) -> tuple[tuple[Camera, ...], np.ndarray, np.ndarray]:
    """Bundle adjustment: the cameras, the ball's place on the paddle, and each pose's residual
    [N] (pixels; 0 for one that is not used)."""
    places = ball_positions(metadata, joint_angles, ball)
    starts = []
    for camera, seen in zip(rough, pixels, strict=True):
        _, rotation, translation = cv2.solvePnP(
            places[used], seen[used], camera.matrix, None, flags=cv2.SOLVEPNP_SQPNP
        )
        starts.append([*rotation.ravel(), *translation.ravel(), 1.0, 0.0, 0.0, 0.0, 0.0])
    size = len(starts[0])

    def cameras_of(unknowns: np.ndarray) -> tuple[Camera, ...]:
        cameras = []
        for k, camera in enumerate(rough):
            values = unknowns[k * size : (k + 1) * size]
            matrix = camera.matrix.copy()
            matrix[0, 0] *= values[6]
            matrix[1, 1] *= values[6]
            matrix[:2, 2] += values[7:9]
            distortion = np.array([values[9], values[10], 0.0, 0.0, 0.0])
            rotation, _ = cv2.Rodrigues(values[:3])
            cameras.append(Camera(matrix, distortion, rotation, values[3:6]))
        return tuple(cameras)

    def reprojections(unknowns: np.ndarray) -> np.ndarray:
        points = ball_positions(metadata, joint_angles, unknowns[-3:])
        errors = []
        for camera, seen in zip(cameras_of(unknowns), pixels, strict=True):
            errors.append(camera.project(points) - seen)
        return np.stack(errors)

    def residuals(unknowns: np.ndarray) -> np.ndarray:
        priors = [(unknowns[-3:] - ball) / _PRIOR_BALL]
        for k in range(len(rough)):
            values = unknowns[k * size : (k + 1) * size]
            priors.append([(values[6] - 1.0) / _PRIOR_FOCAL])
            priors.append(values[7:9] / _PRIOR_CENTRE)
            priors.append(values[9:11] / _PRIOR_LENS)
        seen = reprojections(unknowns)[:, used] / _PIXEL_NOISE
        return np.concatenate([seen.ravel(), *priors])

    start = np.concatenate([*starts, ball])
    unknowns = least_squares(residuals, start, loss="soft_l1", x_scale="jac").x
    distances = np.linalg.norm(reprojections(unknowns), axis=2).max(axis=0)
    return cameras_of(unknowns), unknowns[-3:], np.where(used, distances, 0.0)
