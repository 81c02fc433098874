"""The commands that a robot gets between two actions, and where they bring the paddle."""

import math
from typing import NamedTuple

import numpy as np

from bounce_mjx.deploy.metadata import Metadata, joint_ends
from bounce_mjx.robot.setpoints import Setpoint, joint_limits, next_setpoint, position_at


class Course(NamedTuple):
    """The commands of a control step."""

    end: Setpoint
    """The command at its end, before the mean that limits the jerk (`Motion.at` gives the one that
    is sent)."""
    start: Setpoint | None = None
    """That at its start; None for commands that rest at the end."""


class Motion:
    """How the commands of an arm may move from one control step to the next: within its limits
    (`Metadata.limits`), or without them a target for the whole control step.

    Every course but that of `resting` ends where `aim` says, which no target moves farther than
    `Metadata.largest_step` from its start.
    """

    def __init__(self, metadata: Metadata):
        self._duration = metadata.control_dt
        self._largest_step = np.array(metadata.largest_step)
        self._range = joint_ends(metadata)
        self._limits = joint_limits(metadata.limits, *self._range)
        self._still = np.zeros(len(metadata.joint_names))

    def resting(self, angles: np.ndarray) -> Course:
        """Commands that rest at angles [J], rad."""
        return Course(self._still_at(np.array(angles, float)))

    def _still_at(self, position: np.ndarray) -> Setpoint:
        return Setpoint(position, self._still, self._still)

    def hold(self, last: Course) -> Course:
        """The control step after the last one, in which the commands brake within the limits, or
        rest; also outside of the range, where the arm was found."""
        start = last.end.position
        limits = self._limits
        if limits is None:
            return Course(self._still_at(start), last.end)
        low, high = self._range
        around = (np.minimum(low, start), np.maximum(high, start))
        limits = limits._replace(range=around)
        return Course(next_setpoint(limits, last.end, start, self._duration, np), last.end)

    def move(self, last: Course, target: np.ndarray, speed: float) -> Course:
        """A control step in which the commands move toward joint angles [J] (rad), at most at a
        speed (rad/s) from which half of the acceleration stops there."""
        left = target - last.end.position
        if self._limits is not None:
            speed = np.minimum(speed, np.sqrt(self._limits.acceleration * np.abs(left)))
        step = speed * self._duration
        return self.aim(last, last.end.position + np.clip(left, -step, step))

    def is_still(self, course: Course) -> bool:
        """Whether the command rests at the end of the control step."""
        return not (np.any(course.end.velocity) or np.any(course.end.acceleration))

    def stopped(self, last: Course) -> Course:
        """The last commands as those of a robot that has come to their end and rests there, as no
        others came in time."""
        return self.resting(self.target(last))

    def aim(self, last: Course, target: np.ndarray) -> Course:
        """The control step after the last one, in which the joints move toward a target [J], as far
        as the largest step, the range and the limits allow; a robot without limits gets the target
        itself."""
        start = last.end.position
        target = np.minimum(
            np.maximum(target, start - self._largest_step), start + self._largest_step
        )
        # An arm beyond its range comes back by its own speed.
        low, high = self._range
        lowest = np.minimum(low, start)
        highest = np.maximum(high, start)
        target = np.minimum(np.maximum(target, lowest), highest)
        if self._limits is None:
            return Course(self._still_at(target), last.end)
        end = next_setpoint(self._limits, last.end, target, self._duration, np)
        return Course(end, last.end)

    def braking_path(self, course: Course) -> np.ndarray:
        """Joint angles [K, J] (rad) at the ends of the control steps in which the commands brake
        from the end of this one, and at this one's; the last are those where they rest."""
        position, velocity, _ = course.end
        if self._limits is None or not np.any(velocity):
            return position[None]
        slower = self._limits.acceleration * self._duration
        steps = int(np.ceil(np.max(np.abs(velocity) / slower)))
        speeds = np.abs(velocity) - slower * np.arange(steps + 1)[:, None]
        velocities = np.sign(velocity) * np.maximum(speeds, 0.0)
        moved = np.cumsum(0.5 * self._duration * (velocities[1:] + velocities[:-1]), axis=0)
        return position + np.vstack([self._still, moved])

    def at(self, course: Course, times: np.ndarray) -> np.ndarray:
        """Commands [M, J] at times [M] since the start of the control step, s."""
        if self._limits is None or course.start is None:
            return np.tile(course.end.position, (len(times), 1))
        since_start = np.asarray(times)[:, None]
        acceleration = course.end.acceleration
        return position_at(course.start, acceleration, since_start, np, self._limits.smoothing)

    def target(self, course: Course) -> np.ndarray:
        """The command [J] at the end of the control step, rad."""
        return self.at(course, np.array([self._duration]))[0]


def paddle_position(metadata: Metadata, joint_angles: np.ndarray) -> np.ndarray:
    """World position [..., 3] (m) of the paddle's centre at joint angles [..., J] (rad), by
    Rodrigues' formula for the hinges' rotations."""
    # One number for each joint, which Python computes the fastest, or one array of a batch.
    is_batch = joint_angles.ndim > 1
    angles = np.moveaxis(joint_angles, -1, 0) if is_batch else joint_angles.tolist()
    cos = np.cos if is_batch else math.cos
    sin = np.sin if is_batch else math.sin
    x, y, z = metadata.paddle
    for link in reversed(metadata.chain):
        a, b, c = link.axis
        left, ahead, up = link.position
        turned = angles[link.joint] - link.reference
        cosine = cos(turned)
        sine = sin(turned)
        along = (1.0 - cosine) * (a * x + b * y + c * z)
        x, y, z = (
            left + cosine * x + sine * (b * z - c * y) + along * a,
            ahead + cosine * y + sine * (c * x - a * z) + along * b,
            up + cosine * z + sine * (a * y - b * x) + along * c,
        )
    return np.stack([x, y, z], axis=-1) if is_batch else np.array([x, y, z])


def paddle_normal(metadata: Metadata, joint_angles: np.ndarray) -> np.ndarray:
    """Unit normal [..., 3] of the paddle's upper face at joint angles [..., J] (rad)."""
    tip = tuple(np.add(metadata.paddle, metadata.paddle_normal).tolist())
    above = paddle_position(metadata._replace(paddle=tip), joint_angles)
    return above - paddle_position(metadata, joint_angles)
