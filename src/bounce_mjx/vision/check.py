"""The check before play: a ball on the paddle is where the arm's forward kinematics has it.

Cameras that were moved, or that have each other's place, may still agree with one another: the arm
is the measure. At the middle of the view exchanged cameras see a ball nearly in its place, so that
the check is at poses where they would be farthest off.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bounce_mjx.deploy.metadata import Metadata
from bounce_mjx.errors import UserError
from bounce_mjx.vision.camera import Camera, triangulate
from bounce_mjx.vision.circles import Colour
from bounce_mjx.vision.poses import ball_positions, nominal_ball, plan_poses
from bounce_mjx.vision.rig import Rig
from bounce_mjx.vision.tracker import Tracker

# Distance of a ball from where the arm has it: what a calibration may be off, and a person with a
# strip of tape, m.
_FARTHEST = 0.02
# Poses of a check.
_POSES = 3


class Seen(NamedTuple):
    """A pose of a check."""

    joint_angles: np.ndarray
    """[J], rad."""
    pictures: Sequence[np.ndarray]
    """Of each camera, with the ball on the middle of the paddle, BGR [H, W, 3]."""


def plan_check(metadata: Metadata, rig: Rig) -> np.ndarray:
    """Joint angles [3, J] (rad) of a check, of which the first are those at which exchanged cameras
    would see the ball farthest from its place.

    Raises:
      UserError: exchanged cameras would see it near its place everywhere.
    """
    poses = plan_poses(metadata, rig.cameras, rig.size)
    places = ball_positions(metadata, poses, nominal_ball(metadata))
    first, second = (camera.project(places) for camera in rig.cameras)
    exchanged = [triangulate(rig.cameras, pair) for pair in zip(second, first, strict=True)]
    errors = np.linalg.norm(np.array(exchanged) - places, axis=1)
    chosen = np.argsort(-errors)[:_POSES]
    if errors[chosen[0]] < 2.0 * _FARTHEST:
        raise UserError(
            f"cameras in each other's place would see the ball {1e3 * errors[chosen[0]]:.0f} mm "
            "from its place at most, which no check can tell; put them farther apart"
        )
    return poses[chosen]


def check_rig(
    metadata: Metadata,
    rig: Rig,
    poses: Sequence[Seen],
    backgrounds: Sequence[np.ndarray],
    colour: Colour,
) -> np.ndarray:
    """How far the ball is seen from where the arm has it [N, 3], m.

    Args:
      poses: such as those of `plan_check`.
      backgrounds: a picture of each camera without the ball.
      colour: of the ball.

    Raises:
      UserError: the cameras are in each other's place, or moved, or do not see the ball.
    """
    errors = []
    for number, seen in enumerate(poses, start=1):
        place = ball_positions(metadata, seen.joint_angles, nominal_ball(metadata))
        found = _find(rig.cameras, seen, backgrounds, colour)
        if found is not None and _is_near(found, place):
            errors.append(found - place)
            continue
        turned = _find(rig.cameras[::-1], seen, backgrounds, colour)
        if turned is not None and _is_near(turned, place):
            raise UserError(
                f"the cameras are in each other's place: {rig.devices[0]} sees what "
                f"{rig.devices[1]} saw at the calibration; exchange their cables, or the two "
                "devices in the file"
            )
        if found is None:
            raise UserError(
                f"in pose {number} the cameras see no ball together; check that it is on the "
                "paddle, and that neither camera was moved; else calibrate again"
            )
        raise UserError(
            f"in pose {number} the cameras see the ball at {_vector(found)} m, "
            f"{1e3 * np.linalg.norm(found - place):.0f} mm from where the arm has it, "
            f"{_vector(place)}; check that it is on the middle of the paddle and the arm in the "
            "pose; else a camera was moved: calibrate again"
        )
    return np.array(errors)


def _find(
    cameras: Sequence[Camera], seen: Seen, backgrounds: Sequence[np.ndarray], colour: Colour
) -> np.ndarray | None:
    """The place [3] (m) of the ball in a pair of pictures, wherever it is in them; None if it is
    not seen for sure."""
    tracker = Tracker(cameras, colour, exposure=0.0)
    tracker.learn_background([backgrounds])
    fix = tracker.update(seen.pictures, 0.0)
    return None if fix is None else fix.position


def _is_near(found: np.ndarray, place: np.ndarray) -> bool:
    return float(np.linalg.norm(found - place)) <= _FARTHEST


def _vector(values: np.ndarray) -> str:
    return " ".join(f"{value:.3f}" for value in values)
