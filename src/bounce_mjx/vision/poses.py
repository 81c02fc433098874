"""A ball on the paddle by the arm's forward kinematics, and poses at which both cameras see it."""

from collections.abc import Sequence

import numpy as np

from bounce_mjx.deploy.metadata import Metadata, joint_ends
from bounce_mjx.deploy.motion import paddle_position
from bounce_mjx.errors import UserError
from bounce_mjx.vision.camera import RADIUS, Camera

# Half of the paddle's thickness, m.
_HALF_THICKNESS = 0.0035


def ball_positions(metadata: Metadata, joint_angles: np.ndarray, ball: np.ndarray) -> np.ndarray:
    """Places [N, 3] (m) of a ball that is fixed to the paddle, by the forward kinematics.

    Args:
      metadata: of the policy for this arm.
      joint_angles: [N, J], rad.
      ball: as `Calibration.ball`.
    """
    fixed = metadata._replace(paddle=tuple(np.array(metadata.paddle) + ball))
    return paddle_position(fixed, joint_angles)


def nominal_ball(metadata: Metadata) -> np.ndarray:
    """`Calibration.ball` of a ball on the middle of the paddle's upper face."""
    return np.array(metadata.paddle_normal) * (RADIUS + _HALF_THICKNESS)


def plan_poses(
    metadata: Metadata,
    cameras: Sequence[Camera],
    size: tuple[int, int],
    count: int = 20,
    seed: int = 0,
) -> np.ndarray:
    """Joint angles [count, J] (rad) at which both cameras see the paddle, spread over their views.

    Of many random poses around the start pose, those are kept whose paddle is in both pictures, at
    most 5 cm below its home, and with its upper face upward (within 53 degrees) and toward both
    cameras; then each pose that is farthest from all chosen ones is added.

    Args:
      cameras: roughly known, such as `rough_camera` gives.
      size: width and height of the pictures, pixels.
    """
    rng = np.random.default_rng(seed)
    home = np.array(metadata.default_joint_angles)
    low, high = joint_ends(metadata)
    angles = home + rng.uniform(-0.5, 0.5, (20_000, len(home)))
    angles = np.clip(angles, low + 0.05, high - 0.05)
    places = paddle_position(metadata, angles)
    normal = np.array(metadata.paddle_normal)
    upward = ball_positions(metadata, angles, normal) - places
    home_place = paddle_position(metadata, home)
    is_good = (places[:, 2] > home_place[2] - 0.05) & (upward[:, 2] > 0.6)
    for camera in cameras:
        pixels = camera.project(places)
        margin = 0.08 * np.array(size)
        is_good &= np.all((pixels > margin) & (pixels < size - margin), axis=1)
        toward = camera.centre - places
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        is_good &= np.sum(toward * upward, axis=1) > 0.25
    angles = angles[is_good]
    places = places[is_good]
    if len(angles) < count:
        raise UserError(
            f"both cameras see the paddle in {len(angles)} of 20,000 poses around the start pose, "
            f"but {count} are needed; move them so that both see the paddle around its home"
        )
    chosen = [int(np.argmin(np.linalg.norm(places - home_place, axis=1)))]
    distances = np.linalg.norm(places - places[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distances)))
        distances = np.minimum(distances, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return angles[chosen]
