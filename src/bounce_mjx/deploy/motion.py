"""The commands that a robot gets between two actions, and where they bring the paddle."""

import numpy as np

from bounce_mjx.deploy.metadata import Metadata
from bounce_mjx.robot.setpoints import Setpoint, command, joint_limits, next_setpoint

# [k, i, j]: the matrix of the cross product with the unit vector k.
_CROSS = np.cross(np.eye(3), np.eye(3)[:, None])


class Motion:
    """Commands of the joints, one control step after the other: within the arm's limits if the
    policy has them, else a target for the whole control step."""

    def __init__(self, metadata: Metadata):
        self._duration = metadata.control_dt
        self.ranges = np.array(
            [(-np.inf, np.inf) if x is None else x for x in metadata.joint_ranges]
        ).T
        """Lower and upper ends [2, J] of the joints' ranges, rad."""
        self._limits = joint_limits(metadata.limits, *self.ranges)
        self.start: Setpoint | None = None
        """The command at the start of the control step, before the mean that limits the jerk."""
        self.end: Setpoint | None = None
        """That at its end; None before there is a command."""

    def rest(self, angles: np.ndarray | None) -> None:
        """The arm rests, with its servos at these angles [J]; None: at those of the next step."""
        still = np.zeros(self.ranges.shape[1])
        self.start = None
        self.end = None if angles is None else Setpoint(np.array(angles, float), still, still)

    def begin(self, angles: np.ndarray | None = None) -> None:
        """Begins a control step where the last one ended, the first one at the measured angles
        [J]."""
        if self.end is None:
            self.rest(np.clip(angles, *self.ranges))
        self.start = self.end

    def withdraw(self) -> None:
        """Takes back the commands of the control step."""
        self.end = self.start

    def hold(self) -> None:
        """A control step in which the commands brake, within the limits, or rest."""
        self.begin()
        self.aim(self.start.position)

    def move(self, target: np.ndarray, speed: float) -> None:
        """A control step in which the commands move toward joint angles [J] (rad), at most at a
        speed (rad/s) from which half of the acceleration stops there."""
        self.begin()
        left = target - self.start.position
        if self._limits is not None:
            speed = np.minimum(speed, np.sqrt(self._limits.acceleration * np.abs(left)))
        step = speed * self._duration
        self.aim(self.start.position + np.clip(left, -step, step))

    @property
    def is_still(self) -> bool:
        """Whether the command rests at the end of the control step."""
        return not (np.any(self.end.velocity) or np.any(self.end.acceleration))

    def aim(self, target: np.ndarray) -> None:
        """Moves the joints toward a target [J], to be there at the end of the control step."""
        # An arm beyond its range comes back by its own speed.
        low, high = self.ranges
        low, high = np.minimum(low, self.start.position), np.maximum(high, self.start.position)
        target = np.clip(target, low, high)
        if self._limits is None:
            still = np.zeros(len(target))
            self.end = Setpoint(target, still, still)
        else:
            self.end = next_setpoint(self._limits, self.start, target, self._duration, np)

    def at(self, times: np.ndarray) -> np.ndarray:
        """Commands [M, J] at times [M] since the start of the control step, s."""
        if self._limits is None or self.start is None:
            return np.tile(self.end.position, (len(times), 1))
        acceleration, smoothing = self.end.acceleration, self._limits.smoothing
        return command(self.start, acceleration, np.asarray(times)[:, None], np, smoothing)


def paddle_position(metadata: Metadata, joint_angles: np.ndarray) -> np.ndarray:
    """World position [..., 3] (m) of the paddle's centre at joint angles [..., J] (rad), by
    Rodrigues' formula for the hinges' rotations."""
    position = np.array(metadata.paddle)
    for link in reversed(metadata.chain):
        angles = (joint_angles[..., link.joint] - link.reference)[..., None, None]
        turn = np.tensordot(link.axis, _CROSS, 1)
        rotation = np.eye(3) + np.sin(angles) * turn + (1.0 - np.cos(angles)) * (turn @ turn)
        position = link.position + (rotation @ position[..., None])[..., 0]
    return position
