"""What an arm does with its commands, and what is seen of its ball: each fault here is a row of the
table in docs/real-robot.md."""

import math
from collections.abc import Iterator

import numpy as np

from bounce_mjx.deploy.metadata import Metadata, largest_term, least_term
from bounce_mjx.deploy.motion import paddle_position
from bounce_mjx.deploy.samples import Measurements

# Share of `action_scale` by which an arm must have been asked to move, to be stuck if it rests.
_STUCK_SHARE = 0.25
# Time for which it rests at least, and for which the latest commands have arrived by then, s.
_STUCK_SECONDS, _ASKED_SECONDS = 0.3, 0.25
# Range of an angle at rest without noise, rad.
_STILL = 1e-3
# What a resting joint may be off its command beside the encoder's bias: its load, rad.
_SAG = 0.01
# Time by which an arm may be later than in the training's worlds, s.
_LATER = 0.05
# Largest noise, in standard deviations.
_LARGEST_NOISE = 8.0
# What a joint may move away from all its commands, rad.
_ASTRAY = 0.08
# A ball so far below the paddle, or beside it without coming nearer, is lost; one so far above it
# flies, m.
_BELOW, _BESIDE, _FLYING = 0.1, 0.9, 0.05
# Pictures in which the noise is smaller than the motion of a ball that comes nearer.
_EARLIER = 5
# Difference of two clocks, s.
_SYNCHRONOUS = 1e-3

Fault = tuple[str, str]
"""Code and reason."""


def picture_age(metadata: Metadata) -> float:
    """Age beyond which a picture is too old: the training's largest latency and five of its longest
    intervals, s."""
    rate = least_term(metadata, "camera_rate", 1.0 / metadata.control_dt)
    return min(max(largest_term(metadata, "ball_latency") + 5.0 / rate, 0.1), 1.0)


class Watch:
    """Compares the control steps of an arm and its balls with what the training's worlds can hold.
    The functions that yield faults take the steps one after another."""

    def __init__(self, metadata: Metadata, max_picture_age: float):
        """Bounds of a policy's worlds.

        Args:
          max_picture_age: of the ball's picture, s.
        """
        self._metadata, self._max_age, dt = metadata, max_picture_age, metadata.control_dt
        self.offset = _SAG + largest_term(metadata, "encoder_bias")
        """Distance of a resting joint from its command, rad."""
        # What the slowest arm of the training's worlds would have done; any faster one moves more.
        self._still = _STILL + 0.8 * _LARGEST_NOISE * largest_term(metadata, "joint_angle_noise")
        visible = max(_STUCK_SHARE * metadata.action_scale, 0.6 * self._still)
        slow = largest_term(metadata, "servo_damping", 1.0) / least_term(
            metadata, "servo_gain", 1.0
        )
        lag = slow * np.max(np.divide(metadata.servo_damping, metadata.servo_stiffness))
        kept = math.exp(-dt / (lag + largest_term(metadata, "servo_lag") + 1e-6))
        late = math.ceil((largest_term(metadata, "action_latency") + _LATER) / dt - 1e-6)
        steps = max(round(_STUCK_SECONDS / dt) - late, math.ceil(_ASKED_SECONDS / dt))
        since = np.arange(steps)[:, None] - np.arange(steps)
        pull = np.tril((1.0 - kept) * kept ** np.abs(since))
        settled = np.sum(pull, axis=1)
        # The mean command that moves this arm until each of the window's first K steps, as weights
        # of those steps [K, K], and its distance from the angle by which no arm moves visibly [K].
        self._weights, self._room = pull / settled[:, None], visible / settled
        # Control steps that a stuck joint rests.
        self._window = steps + late

    def rest(self, angles: np.ndarray, command: np.ndarray) -> None:
        """The arm has rested at these angles [J], commanded to be there [J]."""
        self._past = np.repeat([[angles], [command]], self._window + 1, axis=1)
        self._astray = np.zeros(len(angles))

    def begin(self) -> None:
        """An episode begins."""
        self._time = 0.0
        self._pictures: list[tuple[np.ndarray, float]] = []

    def arm_faults(self, angles: np.ndarray, command: np.ndarray) -> Iterator[Fault]:
        """A joint that moves away from its commands, or rests though no arm of the training would
        have rested, whatever its offset.

        Args:
          angles: measured [J], rad.
          command: at the end of the step before [J], rad.
        """
        before = self._past[0, -1]
        self._past = np.concatenate([self._past[:, 1:], [[angles], [command]]], axis=1)
        angles, commands = self._past
        now, high, low = angles[-1], np.max(commands, axis=0), np.min(commands, axis=0)
        away = np.where(now > high, now - before, np.where(now < low, before - now, -np.inf))
        self._astray = np.maximum(self._astray + away, 0.0)
        if np.max(self._astray) > _ASTRAY:
            joint = int(np.argmax(self._astray))
            yield (
                "joint_astray",
                f"{self._metadata.joint_names[joint]} moves away from its commands",
            )
        # Later commands have not reached the latest arm.
        lead = (commands[1 : len(self._room) + 1] - np.mean(angles, axis=0)).T
        mean = lead @ self._weights.T
        least, most = np.max(mean - self._room, axis=1), np.min(mean + self._room, axis=1)
        is_explained = np.maximum(least, -self.offset) <= np.minimum(most, self.offset)
        is_stuck = (np.ptp(angles, axis=0) < self._still) & ~is_explained
        if np.any(is_stuck):
            largest = np.max(np.abs(lead), axis=1, where=is_stuck[:, None], initial=0.0)
            joint = int(np.argmax(largest))
            name = self._metadata.joint_names[joint]
            yield "joint_stuck", f"{name} is stuck {largest[joint]:.3g} rad from its command"

    def faults(self, measured: Measurements, command: np.ndarray) -> Iterator[Fault]:
        """The faults of a control step of an episode.

        Args:
          measured: `joint_angles` and what else a policy measures, as for `OnnxNetwork.step`, and
            `time` [1].
          command: see `arm_faults`.
        """
        if "time" in measured:
            self._time = float(measured["time"][0])
        else:
            self._time += self._metadata.control_dt
        if "ball_position" in measured:
            age = float(measured["ball_age"][0]) if "ball_age" in measured else None
            paddle = paddle_position(self._metadata, measured["joint_angles"])
            yield from self._ball_faults(measured["ball_position"].reshape(-1, 3), age, paddle)
        yield from self.arm_faults(measured["joint_angles"], command)

    def _ball_faults(
        self, balls: np.ndarray, age: float | None, paddle: np.ndarray
    ) -> Iterator[Fault]:
        """The faults in the newest picture of the balls [B, 3], whose age may not be known."""
        if not self._pictures or np.any(balls != self._pictures[-1][0]):
            self._pictures = [*self._pictures[-_EARLIER:], (balls, self._time - (age or 0.0))]
        seen = self._pictures
        # A ball in flight that does not move is an old picture, whatever its age is said to be.
        if age is None or np.max(balls[:, 2]) > paddle[2] + _FLYING:
            age = max(self._time - seen[-1][1], age or 0.0)
        if not -_SYNCHRONOUS <= age <= self._max_age:
            yield "old_picture", f"the picture of the ball is {1e3 * age:.0f} ms old"
        beside, before = (
            np.linalg.norm((picture - paddle)[:, :2], axis=1) for picture in (balls, seen[0][0])
        )
        leaves = (beside > _BESIDE) & (beside >= before) & (len(seen) > _EARLIER)
        if np.any((paddle[2] - balls[:, 2] > _BELOW) | leaves):
            yield "ball_lost", "the ball is lost"
