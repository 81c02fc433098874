"""What an arm does with its commands, and what is seen of its ball: each fault here is a row of the
table in docs/real-robot.md."""

import math
from collections.abc import Iterator

import numpy as np

from bounce_mjx.deploy.metadata import Metadata, largest_term, least_term
from bounce_mjx.deploy.motion import paddle_position
from bounce_mjx.deploy.samples import RESOLUTION, Measurements

# Time of a joint's motion that is compared with the training's arms, s.
_COMPARED = 0.25
# Distance of these arms' latencies, and how much later than the training's the last one is, s.
_APART = 0.01
_LATER = 0.02
_NO_LAG = 1e-9
# Motion beside all these arms that is too much: a share of what the commands moved meanwhile, a
# share of `action_scale`, the encoders' noise in standard deviations, and a count of the encoder.
# In 32 episodes of each of four policies, at most 0.65 of it was beside the nearest arm.
_OF_COMMANDS = 0.25
_OF_SCALE = {"target": 0.2, "measured": 0.05}
_OF_NOISE = 3.0
# The same for a joint whose reading repeats to the last digit all the time: what dry friction
# holds, rad, and counts of the encoder.
_HELD = 1e-3
_COUNTS = 2.0
# Distance from all these arms that is too far, rad.
_TOO_FAR = 0.05
# What a load takes a joint off its command while it rests, beside the arm's own weight, rad.
_SAG = 0.01
# A ball so far below the paddle, or beside it without coming nearer, is lost; one so far above it
# flies, m.
_BELOW = 0.1
_BESIDE = 0.9
_FLYING = 0.05
# Pictures in which the noise is smaller than the motion of a ball that comes nearer.
_EARLIER = 5

Fault = tuple[str, str]
"""Code and reason."""


def picture_age(metadata: Metadata) -> float:
    """Age beyond which a picture is too old: the training's largest latency and five of its longest
    intervals, s."""
    rate = least_term(metadata, "camera_rate", 1.0 / metadata.control_dt)
    return min(max(largest_term(metadata, "ball_latency") + 5.0 / rate, 0.1), 1.0)


def arm_responses(metadata: Metadata) -> np.ndarray:
    """What a policy's commands do in the training's worlds: weights [A, K] of the last K commands,
    the newest first, in the next measured angle, for arms of all latencies and lags.

    An arm is a servo, a first-order lag of the time constant damping / stiffness, behind the lag
    and the latency of the randomisation; or an ideal servo, without any lag. The damping is that of
    the servo and of its joint.
    """
    dt = metadata.control_dt
    latency = largest_term(metadata, "action_latency")
    stiffness = np.array(metadata.servo_stiffness)
    servo_damping = np.array(metadata.servo_damping)
    joint_damping = np.array(metadata.joint_damping or np.zeros(len(stiffness)))
    lag = max(float(np.max((servo_damping + joint_damping) / stiffness)), _NO_LAG)
    most_damping = (
        largest_term(metadata, "servo_damping", 1.0) * servo_damping
        + joint_damping
        + largest_term(metadata, "joint_damping")
    )
    least_stiffness = least_term(metadata, "servo_gain", 1.0) * stiffness
    slowest = float(np.max(most_damping / least_stiffness)) + largest_term(metadata, "servo_lag")
    latencies = np.arange(0.0, latency + _LATER + 1e-9, _APART) / dt
    num_lags = 3 if slowest > 1.5 * lag else 1
    lags = np.concatenate([[_NO_LAG], np.linspace(lag, slowest, num_lags)])
    length = math.ceil(latencies[-1] + 4.0 * slowest / dt) + 1
    steps = np.arange(length)
    responses = []
    for delay in latencies:
        for time_constant in lags:
            # The share of a step of the command that the arm has gone after a number of steps.
            gone = 1.0 - np.exp(-np.maximum(steps + 1.0 - delay, 0.0) * dt / time_constant)
            responses.append(np.diff(gone, prepend=0.0) / gone[-1])
    return np.array(responses)


class Watch:
    """Compares the control steps of an arm and its balls with what the training's worlds can hold.

    Each control step is given to one of the functions that yield faults, whose first fault counts:
    it is read to that, or to its end.
    """

    def __init__(self, metadata: Metadata, max_picture_age: float):
        """Bounds of a policy's worlds.

        Args:
          max_picture_age: of the ball's picture, s.
        """
        self._metadata = metadata
        self._max_age = max_picture_age
        sag = max(metadata.sag, default=0.0) / least_term(metadata, "servo_gain", 1.0)
        # Where the weight and the servos' constant errors take a joint from its command, rad.
        self._beside_command = sag + largest_term(metadata, "servo_offset")
        # A robot's servo may have another zero than its encoder, unlike the training's.
        self.offset = _SAG + largest_term(metadata, "encoder_bias") + self._beside_command
        """Distance of a resting joint from its command, rad."""
        noise = largest_term(metadata, "joint_angle_noise")
        self._least = _OF_SCALE[metadata.action_base] * metadata.action_scale + _OF_NOISE * noise
        self._arms = arm_responses(metadata)
        self._compared = math.ceil(_COMPARED / metadata.control_dt)
        self._settling = self._arms.shape[1] + self._compared

    def rest(self, angles: np.ndarray, command: np.ndarray) -> None:
        """The arm has rested at these angles [J], commanded to be there [J]."""
        arms, length = self._arms.shape
        self._commands = np.tile(command, (length + self._compared, 1))
        self._beside = np.tile(angles - command, (self._compared, arms, 1))
        self._angles = angles
        self._steps = 0
        # Steps in which each reading has repeated, and its smallest change, which is a count of the
        # encoder or more; unknown until the reading changes, so that one that has never changed has
        # no narrower bound than others.
        self._repeats = np.zeros(len(angles), int)
        self._smallest_change = np.full(len(angles), np.inf)

    def begin(self) -> None:
        """An episode begins."""
        self._time = 0.0
        self._pictures: list[tuple[np.ndarray, float]] = []

    def arm_faults(
        self, angles: np.ndarray, command: np.ndarray, is_bridged: bool = False
    ) -> Iterator[Fault]:
        """A joint that does not move as any arm of the training would.

        Args:
          angles: measured [J], rad.
          command: at the end of the step before [J], rad.
          is_bridged: whether the angles are those of the step before, which say nothing of this.
        """
        self._commands = np.concatenate([command[None], self._commands[:-1]])
        self._steps += 1
        if is_bridged:
            return
        beside = angles - self._arms @ self._commands[: self._arms.shape[1]]
        self._beside = np.concatenate([self._beside[1:], beside[None]])
        self._note_change(angles)
        high = np.max(self._beside, axis=0)
        low = np.min(self._beside, axis=0)
        by_motion = (high - low) / self._allowed_motion()
        by_place = np.maximum(high, -low) / (_TOO_FAR + self._beside_command)
        unlike = np.min(np.maximum(by_motion, by_place), axis=0)
        joint = int(np.argmax(unlike))
        if not unlike[joint] <= 1.0:
            name = self._metadata.joint_names[joint]
            distance = np.min(np.abs(beside[:, joint]))
            yield (
                "joint_astray",
                f"{name} does not follow its commands, and is {distance:.2g} rad beside them",
            )

    def _note_change(self, angles: np.ndarray) -> None:
        change = np.abs(angles - self._angles)
        has_changed = change > 0.0
        self._repeats = np.where(has_changed, 0, self._repeats + 1)
        smallest = np.minimum(self._smallest_change, change)
        self._smallest_change = np.where(has_changed, smallest, self._smallest_change)
        self._angles = angles

    def _allowed_motion(self) -> np.ndarray:
        """Motion of each joint beside the training's arms [J] that is no fault, rad."""
        allowed = self._least + np.minimum(self._smallest_change, RESOLUTION)
        allowed += _OF_COMMANDS * np.ptp(self._commands, axis=0)
        if self._steps < self._settling:
            # They go there with the first commands.
            allowed += self._beside_command
        # A moving joint's reading changes by a count, and one with noise in every step.
        of_repeating = np.minimum(allowed, _HELD + _COUNTS * self._smallest_change)
        return np.where(self._repeats >= self._compared, of_repeating, allowed)

    def faults(
        self, measured: Measurements, command: np.ndarray, is_bridged: bool = False
    ) -> Iterator[Fault]:
        """The faults of a control step of an episode.

        Args:
          measured: `joint_angles` and what else a policy measures, as for `OnnxNetwork.step`, and
            `time` [1].
          command: as for `arm_faults`.
          is_bridged: as for `arm_faults`.
        """
        if "time" in measured:
            self._time = float(measured["time"][0])
        else:
            self._time += self._metadata.control_dt
        if "ball_position" in measured:
            age = float(measured["ball_age"][0]) if "ball_age" in measured else None
            paddle = paddle_position(self._metadata, measured["joint_angles"])
            yield from self._ball_faults(measured["ball_position"].reshape(-1, 3), age, paddle)
        yield from self.arm_faults(measured["joint_angles"], command, is_bridged)

    def _ball_faults(
        self, balls: np.ndarray, age: float | None, paddle: np.ndarray
    ) -> Iterator[Fault]:
        """The faults in the newest picture of the balls [B, 3], whose age may not be known."""
        if not self._pictures or np.any(balls != self._pictures[-1][0]):
            taken = self._time - (age or 0.0)
            self._pictures = self._pictures[-_EARLIER:] + [(balls, taken)]
        seen = self._pictures
        # A ball in flight that does not move is an old picture, whatever its age is said to be.
        is_flying = np.max(balls[:, 2]) > paddle[2] + _FLYING
        if age is None:
            age = self._time - seen[-1][1]
        elif is_flying:
            age = max(self._time - seen[-1][1], age)
        # `Samples` refuses a picture of the future.
        if not age <= self._max_age:
            yield "old_picture", f"the picture of the ball is {1e3 * age:.0f} ms old"
        earliest_balls, _ = seen[0]
        beside = np.linalg.norm((balls - paddle)[:, :2], axis=1)
        before = np.linalg.norm((earliest_balls - paddle)[:, :2], axis=1)
        leaves = (beside > _BESIDE) & (beside >= before) & (len(seen) > _EARLIER)
        if np.any((paddle[2] - balls[:, 2] > _BELOW) | leaves):
            yield "ball_lost", "the ball is lost"
