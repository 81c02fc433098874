"""How high two cameras see, beside how high a policy plays."""

from collections.abc import Sequence

import numpy as np

from bounce_mjx.deploy.metadata import Metadata
from bounce_mjx.deploy.motion import paddle_position
from bounce_mjx.errors import UserError
from bounce_mjx.vision.camera import Camera

# How far over its target an apex may be, m.
_OVERSHOOT = 0.1


def highest_seen(cameras: Sequence[Camera], size: tuple[int, int], place: np.ndarray) -> float:
    """Height of the ball (m) up to which all pictures show all of it straight above a place [3].

    Args:
      size: width and height of the pictures, pixels.
    """
    heights = np.arange(0.0, 2.0, 0.005)
    positions = place + heights[:, None] * np.array([0.0, 0.0, 1.0])
    is_seen = np.ones(len(heights), bool)
    for camera in cameras:
        pixels = camera.project(positions)
        radii = np.array([camera.radius_at(position) for position in positions])[:, None]
        is_seen &= np.all((pixels > radii) & (pixels < np.array(size) - radii), axis=1)
    if not np.any(is_seen):
        raise UserError(f"no place above {np.round(place, 3)} m is in all pictures")
    first = int(np.argmax(is_seen))
    # A strong lens bends what is far outside back into the picture.
    after = np.flatnonzero(~is_seen[first:])
    last = first + int(after[0]) - 1 if len(after) else len(heights) - 1
    return float(positions[last, 2])


def report_height(cameras: Sequence[Camera], size: tuple[int, int], metadata: Metadata) -> str:
    """In words, whether the cameras see as high as a policy plays."""
    home = paddle_position(metadata, np.array(metadata.default_joint_angles))
    highest = highest_seen(cameras, size, home)
    text = f"all cameras see the ball up to a height of {highest:.2f} m"
    target = metadata.goals.get("target_height")
    if target is None:
        return text
    apex = target.range[1]
    text += f"; the policy's apexes are at {apex:.2f} m at most"
    if highest < apex + _OVERSHOOT:
        text += f": aim higher, or play with targets of at most {highest - _OVERSHOOT:.2f} m"
    return text
