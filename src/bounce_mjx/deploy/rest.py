"""An arm at rest is where its controller's target is: what is measured of it has to agree with
that, and the tool's place by the controller's own kinematics with that of the policy's arm."""

from typing import NamedTuple

import numpy as np

from bounce_mjx.deploy.metadata import Metadata
from bounce_mjx.deploy.motion import paddle_normal, paddle_position
from bounce_mjx.deploy.samples import Measurements

# Two numbers of one reading, rad, and the samples in a row in which a target has to stand still: a
# reading has noise.
_SAME_READING = 1e-6
_STANDING = 3
# Of the tool from where the policy's arm has it, m, and of its normal, rad.
_TOOL = 0.03
_TILT = 0.1


class Target(NamedTuple):
    """The controller's own target of the arm."""

    angles: np.ndarray | None = None
    """Last given [J], rad."""
    standing: int = 0
    """Samples in a row in which it was this one."""


class Unknown(Exception):
    """Why it is not known where the arm rests."""

    def __init__(self, reason: str, fault: str = "joint_astray"):
        super().__init__(reason)
        self.fault = fault
        """Code of an arm that is so for longer than it takes to settle, of the table in
        docs/real-robot.md."""


def follow_target(target: Target, measured: Measurements) -> Target:
    """The controller's target with a new sample."""
    angles = measured.get("joint_targets")
    if angles is None:
        return Target()
    if target.angles is None or np.any(angles != target.angles):
        return Target(angles, 1)
    return Target(angles, target.standing + 1)


def place_of(target: Target, angles: np.ndarray) -> np.ndarray | None:
    """Where the controller holds the arm [J], rad; None if the driver does not say it.

    Args:
      target: of the last samples.
      angles: measured [J], rad.

    Raises:
      Unknown: it is to be said by the next samples.
    """
    if target.angles is None or np.max(np.abs(target.angles - angles)) < _SAME_READING:
        # No target, or a copy of the reading that it is to confirm.
        return None
    if target.standing < _STANDING:
        raise Unknown(
            "the controller's targets (joint_targets) do not stand still, as those of a resting "
            "arm do; give the controller's own, and no measured angles"
        )
    return target.angles


def check_place(
    metadata: Metadata, angles: np.ndarray, place: np.ndarray, room: float, where: str
) -> None:
    """Compares the measured angles [J] of a resting arm with its place [J], rad.

    Args:
      room: distance of a joint that is no error, rad.
      where: the place in words.

    Raises:
      Unknown: the arm is elsewhere.
    """
    away = np.abs(angles - place)
    joint = int(np.argmax(away))
    if away[joint] <= room:
        return
    zeros = "" if np.any(angles) else "all joint angles are 0, as of a driver without data: "
    raise Unknown(
        f"{zeros}{metadata.joint_names[joint]} is {away[joint]:.2g} rad from {where}; check its "
        "load, sign, zero, unit and place in the order, and where the arm is said to rest; if it "
        "was moved with its servos off, call restart(moved=True)"
    )


def check_tool(metadata: Metadata, measured: Measurements) -> None:
    """Compares the paddle by the controller's kinematics with the policy's arm, if it is given.

    Raises:
      Unknown: they differ.
    """
    angles = measured["joint_angles"]
    if "tool_position" in measured:
        given = measured["tool_position"]
        own = paddle_position(metadata, angles)
        off = float(np.linalg.norm(given - own))
        if off > _TOOL:
            raise Unknown(
                f"the controller has the paddle at {_vector(given)} m, {off:.2g} m from where "
                f"{metadata.robot} has it at these angles, {_vector(own)}; check that the policy "
                "is of this arm, the joints' signs, zeros and order, and the tool's centre point",
                "tool",
            )
    if "tool_normal" in measured:
        given = measured["tool_normal"]
        size = float(np.linalg.norm(given))
        cosine = given @ paddle_normal(metadata, angles) / max(size, 1e-9)
        tilt = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
        if tilt > _TILT:
            raise Unknown(
                f"the controller has the paddle's normal {tilt:.2g} rad from that of "
                f"{metadata.robot} at these angles; check that the policy is of this arm, the "
                "joints' signs, zeros and order, and the tool's orientation",
                "tool",
            )


def _vector(values: np.ndarray) -> str:
    return " ".join(f"{value:.3f}" for value in values)
