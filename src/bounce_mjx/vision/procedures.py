"""What a person does with the arm and two cameras: calibrate them, and check them before play."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from bounce_mjx.deploy.metadata import Metadata
from bounce_mjx.errors import UserError
from bounce_mjx.vision.calibration import calibrate, find_fixed_ball
from bounce_mjx.vision.camera import Camera
from bounce_mjx.vision.capture import Capture
from bounce_mjx.vision.check import Seen, check_rig, plan_check
from bounce_mjx.vision.circles import Colour
from bounce_mjx.vision.poses import plan_poses
from bounce_mjx.vision.rig import Rig, picture_path, save_rig
from bounce_mjx.vision.view import report_height

Ask = Callable[[str], object]


def calibrate_by_hand(
    metadata: Metadata,
    capture: Capture,
    rough: Sequence[Camera],
    colour: Colour,
    path: Path,
    ask: Ask = input,
) -> str:
    """Asks for one pose after the other, and writes the cameras.

    Args:
      metadata: of the policy for this arm.
      rough: the cameras as they were measured with a tape (`rough_camera`), in the order of
        `capture`.
      colour: of the ball, as `circles.COLOURS`.
      path: of the rig's file; a picture of each camera is written beside it.
      ask: shows a text, and returns when the person has done it.

    Returns:
      How well the cameras are known, in words.

    Raises:
      UserError: the folder is missing; or as `calibrate`.
    """
    if not path.parent.is_dir():
        raise UserError(f"there is no folder {path.parent} for {path.name}; make it")
    poses = plan_poses(metadata, rough, capture.size)
    backgrounds = _without_ball(capture, ask)
    pixels = np.full((2, len(poses), 2), np.nan)
    for pose, angles in enumerate(poses):
        ask(f"{pose + 1} of {len(poses)}: {_request(metadata, angles)}")
        pictures = capture.read_exposed_from_now()
        for k, picture in enumerate(pictures):
            pixels[k, pose] = find_fixed_ball(
                metadata, rough[k], angles, picture, colour, backgrounds[k]
            )
    calibration = calibrate(metadata, rough, poses, pixels)
    rig = Rig(calibration.cameras, capture.size, capture.devices)
    save_rig(path, rig, pictures)
    which = []
    for number, device in enumerate(rig.devices, start=1):
        which.append(f"camera {number} is {device}, which sees {picture_path(path, number)}")
    height = report_height(rig.cameras, rig.size, metadata)
    return "\n".join([calibration.report(), *which, height])


def check_by_hand(
    metadata: Metadata, capture: Capture, rig: Rig, colour: Colour, ask: Ask = input
) -> str:
    """Asks for a few poses with the ball on the paddle, and compares it with forward kinematics.

    Args:
      rig: of the calibration.

    The other arguments are those of `calibrate_by_hand`.

    Returns:
      How far the cameras are off, in words.

    Raises:
      UserError: as `check_rig`.
    """
    poses = plan_check(metadata, rig)
    backgrounds = _without_ball(capture, ask)
    seen = []
    for pose, angles in enumerate(poses):
        ask(f"{pose + 1} of {len(poses)}: {_request(metadata, angles)}")
        seen.append(Seen(angles, capture.read_exposed_from_now()))
    errors = check_rig(metadata, rig, seen, backgrounds, colour)
    off = 1e3 * np.linalg.norm(errors, axis=1).max()
    return f"the cameras see the ball where the arm has it, at most {off:.0f} mm beside"


def _without_ball(capture: Capture, ask: Ask) -> tuple[np.ndarray, ...]:
    """A pair of pictures without the ball, before it is fixed to the paddle."""
    ask("Take the ball away, keep the arm out of the pictures if you can, and press Enter.")
    backgrounds = capture.read_exposed_from_now()
    ask("Fix the ball to the middle of the paddle, and press Enter.")
    return backgrounds


def _request(metadata: Metadata, angles: np.ndarray) -> str:
    """The sentence that asks for a pose [J], rad."""
    text = ", ".join(
        f"{name} {angle:.3f}" for name, angle in zip(metadata.joint_names, angles, strict=True)
    )
    return f"move the arm to {text} (rad), and press Enter."
