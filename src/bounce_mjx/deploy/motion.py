"""The commands that a robot gets between two actions, and where they bring the paddle."""

import numpy as np

from bounce_mjx.deploy.metadata import Metadata, joint_ends
from bounce_mjx.robot.setpoints import Setpoint, joint_limits, next_setpoint, position_at


class Motion:
    """Commands of the joints, one control step after the other: within the arm's limits
    (`Metadata.limits`), or without them a target for the whole control step.

    `rest` says where the arm rests; every other command is made by `aim`, which no target moves
    farther than `Metadata.largest_step` from the last one.
    """

    def __init__(self, metadata: Metadata):
        self._duration = metadata.control_dt
        self._largest_step = np.array(metadata.largest_step)
        self.ranges = joint_ends(metadata)
        """Lower and upper ends [2, J] of the joints' ranges, rad."""
        self._limits = joint_limits(metadata.limits, *self.ranges)
        self._still = np.zeros(len(metadata.joint_names))
        self.start: Setpoint | None = None
        """The command at the start of the control step, before the mean that limits the jerk
        (`at` gives the one that is sent)."""
        self.end: Setpoint | None = None
        """That at its end; None before there is a command."""

    def rest(self, angles: np.ndarray | None) -> None:
        """The arm rests, with its servos at these angles [J]; None: `begin` takes the measured
        ones of the next step."""
        self.start = None
        self.end = None if angles is None else self._resting(np.array(angles, float))

    def _resting(self, position: np.ndarray) -> Setpoint:
        return Setpoint(position, self._still, self._still)

    def begin(self, angles: np.ndarray | None = None) -> None:
        """Begins a control step where the last one ended, the first one at the measured angles
        [J]."""
        if self.end is None:
            self.rest(angles)
        self.start = self.end

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
        """Moves the joints toward a target [J], as far as the largest step, the range and the
        limits allow; a robot without limits gets the target itself."""
        start = self.start.position
        target = np.minimum(
            np.maximum(target, start - self._largest_step), start + self._largest_step
        )
        # An arm beyond its range comes back by its own speed.
        low, high = self.ranges
        lowest = np.minimum(low, start)
        highest = np.maximum(high, start)
        target = np.minimum(np.maximum(target, lowest), highest)
        if self._limits is None:
            self.end = self._resting(target)
        else:
            self.end = next_setpoint(self._limits, self.start, target, self._duration, np)

    def braking_path(self) -> np.ndarray:
        """Joint angles [K, J] (rad) at the ends of the control steps in which the commands brake
        from the end of this one, and at this one's; the last are those where they rest."""
        position, velocity, _ = self.end
        if self._limits is None or not np.any(velocity):
            return position[None]
        slower = self._limits.acceleration * self._duration
        steps = int(np.ceil(np.max(np.abs(velocity) / slower)))
        speeds = np.abs(velocity) - slower * np.arange(steps + 1)[:, None]
        velocities = np.sign(velocity) * np.maximum(speeds, 0.0)
        moved = np.cumsum(0.5 * self._duration * (velocities[1:] + velocities[:-1]), axis=0)
        return position + np.vstack([self._still, moved])

    def at(self, times: np.ndarray) -> np.ndarray:
        """Commands [M, J] at times [M] since the start of the control step, s."""
        if self._limits is None or self.start is None:
            return np.tile(self.end.position, (len(times), 1))
        since_start = np.asarray(times)[:, None]
        return position_at(
            self.start, self.end.acceleration, since_start, np, self._limits.smoothing
        )


def paddle_position(metadata: Metadata, joint_angles: np.ndarray) -> np.ndarray:
    """World position [..., 3] (m) of the paddle's centre at joint angles [..., J] (rad), by
    Rodrigues' formula for the hinges' rotations."""
    joints = [link.joint for link in metadata.chain]
    turned = joint_angles[..., joints] - [link.reference for link in metadata.chain]
    # One number for each hinge, or one array of a batch.
    cosines = np.moveaxis(np.cos(turned), -1, 0)
    sines = np.moveaxis(np.sin(turned), -1, 0)
    if turned.ndim == 1:
        # Python's numbers are the fastest.
        cosines = cosines.tolist()
        sines = sines.tolist()
    x, y, z = metadata.paddle
    for i in reversed(range(len(joints))):
        a, b, c = metadata.chain[i].axis
        left, ahead, up = metadata.chain[i].position
        cosine = cosines[i]
        sine = sines[i]
        along = (1.0 - cosine) * (a * x + b * y + c * z)
        x, y, z = (
            left + cosine * x + sine * (b * z - c * y) + along * a,
            ahead + cosine * y + sine * (c * x - a * z) + along * b,
            up + cosine * z + sine * (a * y - b * x) + along * c,
        )
    return np.stack([x, y, z], axis=-1)
