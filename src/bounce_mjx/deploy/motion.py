"""The commands that a robot gets between two actions."""

import numpy as np

from bounce_mjx.deploy.metadata import Metadata
from bounce_mjx.robot.setpoints import JointLimits, Setpoint, command, next_setpoint


class Motion:
    """Commands of the joints, one control step after the other: within the arm's limits if the
    policy has them, else a target for the whole control step."""

    def __init__(self, metadata: Metadata):
        limits, self._duration = metadata.limits, metadata.control_dt
        self.ranges = np.array(
            [(-np.inf, np.inf) if x is None else x for x in metadata.joint_ranges]
        ).T
        """Lower and upper ends [2, J] of the joints' ranges, rad."""
        self._limits = None
        if limits is not None:
            velocity, acceleration = np.array(limits.velocity), np.array(limits.acceleration)
            smoothing = None if limits.jerk is None else 2.0 * acceleration / np.array(limits.jerk)
            self._limits = JointLimits(velocity, acceleration, smoothing, tuple(self.ranges))
        self._start = self._end = None

    def rest(self, angles: np.ndarray | None) -> None:
        """The arm rests, with its servos at these angles [J]; None: at those of the next step."""
        still = np.zeros(self.ranges.shape[1])
        self._start = None
        self._end = None if angles is None else Setpoint(np.array(angles, float), still, still)

    def begin(self, angles: np.ndarray | None = None) -> None:
        """Begins a control step where the last one ended, the first one at the measured angles
        [J]."""
        if self._end is None:
            self.rest(np.clip(angles, *self.ranges))
        self._start = self._end

    def withdraw(self) -> None:
        """Takes back the commands of the control step."""
        self._end = self._start

    def hold(self) -> None:
        """A control step in which the commands brake, within the limits, or rest."""
        self.begin()
        self.aim(self.position)

    def move(self, target: np.ndarray, speed: float) -> None:
        """A control step in which the commands move toward joint angles [J] (rad), at most at a
        speed (rad/s) from which half of the acceleration stops there."""
        self.begin()
        left = target - self.position
        if self._limits is not None:
            speed = np.minimum(speed, np.sqrt(self._limits.acceleration * np.abs(left)))
        step = speed * self._duration
        self.aim(self.position + np.clip(left, -step, step))

    @property
    def is_known(self) -> bool:
        """Whether there is a command."""
        return self._end is not None

    @property
    def position(self) -> np.ndarray:
        """Command [J] at the start of the control step, before the mean that limits the jerk."""
        return self._start.position

    @property
    def end(self) -> np.ndarray:
        """Command [J] at the end of the control step, before that mean."""
        return self._end.position

    @property
    def is_still(self) -> bool:
        """Whether the command rests at the end of the control step."""
        return not (np.any(self._end.velocity) or np.any(self._end.acceleration))

    def aim(self, target: np.ndarray) -> None:
        """Moves the joints toward a target [J], to be there at the end of the control step."""
        # An arm beyond its range comes back by its own speed.
        low, high = self.ranges
        low, high = np.minimum(low, self.position), np.maximum(high, self.position)
        target = np.clip(target, low, high)
        if self._limits is None:
            still = np.zeros(len(target))
            self._end = Setpoint(target, still, still)
        else:
            self._end = next_setpoint(self._limits, self._start, target, self._duration, np)

    def at(self, times: np.ndarray) -> np.ndarray:
        """Commands [M, J] at times [M] since the start of the control step, s."""
        if self._limits is None or self._start is None:
            return np.tile(self._end.position, (len(times), 1))
        acceleration, smoothing = self._end.acceleration, self._limits.smoothing
        return command(self._start, acceleration, np.asarray(times)[:, None], np, smoothing)
