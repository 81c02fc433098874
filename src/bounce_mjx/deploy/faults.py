"""What must hold in each control step while an arm follows a policy."""

import math
from collections.abc import Iterator

import numpy as np

from bounce_mjx.deploy.metadata import Metadata
from bounce_mjx.deploy.motion import paddle_position
from bounce_mjx.deploy.network import Measurements

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
# Of a joint, for a policy without limits: the training ends an episode there, rad/s.
_FASTEST = 6.283
# A ball so far below the paddle, or beside it without coming nearer, is lost; one so far above it
# flies, m.
_BELOW, _BESIDE, _FLYING = 0.1, 0.9, 0.05
# Pictures in which the noise is smaller than the motion of a ball that comes nearer.
_EARLIER = 5
# Difference of two clocks, s.
_SYNCHRONOUS = 1e-3

Fault = tuple[str, str]
"""Code and reason."""


def largest_term(metadata: Metadata, term: str, default: float = 0.0, end: int = 1) -> float:
    """Largest absolute value of a randomisation term over axes and joints; with the end 0, its
    least one."""
    found = [r for name, r in metadata.randomization.items() if name.split("[")[0] == term]
    values = [max(map(abs, r)) if end else r[0] for r in found]
    return (max if end else min)(values, default=default)


def picture_age(metadata: Metadata) -> float:
    """Age beyond which a picture is too old: the training's largest latency and five of its longest
    intervals, s."""
    rate = largest_term(metadata, "camera_rate", 1.0 / metadata.control_dt, end=0)
    return min(max(largest_term(metadata, "ball_latency") + 5.0 / rate, 0.1), 1.0)


class Watch:
    """Compares the control steps of an arm and its balls with what the training's worlds can hold.
    The functions that yield faults take the steps one after another."""

    def __init__(self, metadata: Metadata, max_picture_age: float, max_seconds: float):
        """Bounds of a policy's worlds.

        Args:
          max_picture_age: of the ball's picture, s.
          max_seconds: time from one control step to the next, s.
        """
        self._metadata, self._max_age, self._max_seconds = metadata, max_picture_age, max_seconds
        limits, dt = metadata.limits, metadata.control_dt
        self._fastest = _FASTEST if limits is None else 1.2 * np.array(limits.velocity)
        noise = 1.5 * _LARGEST_NOISE * largest_term(metadata, "ball_position_noise")
        self._fastest_motion = metadata.ball.speed + noise / dt
        self.offset = _SAG + largest_term(metadata, "encoder_bias")
        """Distance of a resting joint from its command, rad."""
        # What the slowest arm of the training's worlds would have done; any faster one moves more.
        self._still = _STILL + 0.8 * _LARGEST_NOISE * largest_term(metadata, "joint_angle_noise")
        visible = max(_STUCK_SHARE * metadata.action_scale, 0.6 * self._still)
        slow = largest_term(metadata, "servo_damping", 1.0) / largest_term(
            metadata, "servo_gain", 1.0, end=0
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

    def begin(self) -> None:
        """An episode begins."""
        self._time: float | None = None
        self._pictures: list[tuple[np.ndarray, float]] = []

    def arm_faults(self, angles: np.ndarray, command: np.ndarray) -> Iterator[Fault]:
        """A joint that no arm of the training would have rested, whatever its offset.

        Args:
          angles: measured [J], rad.
          command: at the end of the step before [J], rad.
        """
        self._past = np.concatenate([self._past[:, 1:], [[angles], [command]]], axis=1)
        angles, commands = self._past
        # Later commands have not reached the latest arm.
        lead = (commands[1 : len(self._room) + 1] - np.mean(angles, axis=0)).T
        mean = lead @ self._weights.T
        least, most = np.max(mean - self._room, axis=1), np.min(mean + self._room, axis=1)
        is_explained = np.maximum(least, -self.offset) <= np.minimum(most, self.offset)
        is_stuck = (np.ptp(angles, axis=0) < self._still) & ~is_explained
        if np.any(is_stuck):
            largest = np.max(np.abs(lead[is_stuck]))
            yield "joint_stuck", f"a joint is stuck {largest:.3g} rad from its command"

    def faults(self, measured: Measurements, command: np.ndarray) -> Iterator[Fault]:
        """The faults of a control step of an episode.

        Args:
          measured: `joint_angles` and what else a policy measures, as for `OnnxNetwork.step`, and
            `time` [1]. Without `time` no step is late.
          command: see `arm_faults`.
        """
        angles, last = measured["joint_angles"], self._time
        if "time" in measured:
            self._time = max(float(measured["time"][0]), -math.inf if last is None else last)
        else:
            self._time = (last or 0.0) + self._metadata.control_dt
        if last is not None and (elapsed := self._time - last) > self._max_seconds:
            yield "late_step", f"a control step came after {elapsed:.3g} s"
        if "ball_position" in measured:
            age = float(measured["ball_age"][0]) if "ball_age" in measured else None
            paddle = paddle_position(self._metadata, angles)
            yield from self._ball_faults(measured["ball_position"].reshape(-1, 3), age, paddle)
        speed = _longest(measured.get("ball_velocity", np.zeros(3)).reshape(-1, 3))
        if speed > self._metadata.ball.speed:
            yield "ball_speed", f"the ball has {speed:.3g} m/s"
        velocities = np.abs(measured.get("joint_velocities", np.zeros(1)))
        if np.any(velocities > self._fastest):
            yield "joint_speed", f"a joint has {np.max(velocities):.3g} rad/s"
        yield from self.arm_faults(angles, command)

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
        if (distance := _longest(balls)) > self._metadata.ball.distance:
            yield "ball_place", f"the ball is {distance:.3g} m from the base"
        beside, before = (
            np.linalg.norm((picture - paddle)[:, :2], axis=1) for picture in (balls, seen[0][0])
        )
        leaves = (beside > _BESIDE) & (beside >= before) & (len(seen) > _EARLIER)
        if np.any((paddle[2] - balls[:, 2] > _BELOW) | leaves):
            yield "ball_lost", "the ball is lost"
        if len(seen) > 1:
            between = max(seen[-1][1] - seen[-2][1], self._metadata.control_dt)
            if (speed := _longest(balls - seen[-2][0]) / between) > self._fastest_motion:
                yield "ball_speed", f"the ball has {speed:.3g} m/s"


def _longest(vectors: np.ndarray) -> float:
    return float(np.max(np.linalg.norm(vectors, axis=-1)))
