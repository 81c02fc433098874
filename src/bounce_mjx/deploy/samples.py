"""What cannot be true is no measurement: a robot's sample against the last one that can be true.

One sample that cannot be true is bridged: the last values hold for a step. The second one in a row
raises. What no single sample explains raises at once: first angles, a range that the arm has left
little by little, a clock that stands or has jumped by a second, a picture of the future. Each
reason here is a row of the table in docs/real-robot.md. What is no number at all is refused before
(`DeployedPolicy.check`).
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from bounce_mjx.deploy.metadata import Metadata, joint_ends, largest_term
from bounce_mjx.errors import UserError

Measurements = dict[str, np.ndarray]

# Distances that are too far: of an angle from its range, and of the first one from where the arm
# starts, rad.
_OUTSIDE = 0.5
_NEAR = 0.1
# The start pose in another order or with other signs, beside the noise of a start, rad.
_SAME = 0.1
# Share of an arm's own limit of velocity that no joint reaches.
_OVERSPEED = 1.2
# Largest noise in standard deviations.
_LARGEST_NOISE = 8.0
_MOST_STANDING = 50
"""Calls at one time."""

PAUSE = 1.0
"""Time between two samples that is no step of one clock, s."""

SYNCHRONOUS = 1e-3
"""How far in the future a picture may be, as two clocks differ, s."""

RESOLUTION = 2e-3
"""Largest count of an encoder, rad; one of 4,096 counts a turn has 1.5e-3."""

_OF_ARM = ("joint_angles", "joint_velocities")
_OF_BALL = (
    "ball_position",
    "ball_velocity",
    "ball_age",
    "ball_quaternion",
    "ball_angular_velocity",
)


class ImpossibleMeasurement(UserError):
    """A measurement that cannot be true."""

    def __init__(self, fault: str, reason: str):
        super().__init__(reason)
        self.fault = fault
        """Code of what is wrong, of the table in docs/real-robot.md."""


class UnconfirmedSample(ImpossibleMeasurement):
    """First joint angles that the next sample has to confirm."""

    def __init__(self, reason: str):
        super().__init__("first_sample", reason)


class Samples:
    """The last sample that can be true, with which the next one is compared."""

    def __init__(self, metadata: Metadata):
        """Bounds of what a policy's worlds can hold."""
        self._metadata = metadata
        if metadata.limits is None:
            self._fastest = np.full(len(metadata.joint_names), metadata.max_joint_velocity)
        else:
            self._fastest = _OVERSPEED * np.array(metadata.limits.velocity)
        largest = math.sqrt(2.0) * _LARGEST_NOISE
        self._noise = RESOLUTION + largest * largest_term(metadata, "joint_angle_noise")
        self._ball_noise = 1e-3 + largest * largest_term(metadata, "ball_position_noise")
        self._low, self._high = joint_ends(metadata)
        self._start = np.array(metadata.default_joint_angles)
        self._still = np.zeros(len(self._start))
        self.forget()

    def forget(self, near: np.ndarray | None = None) -> None:
        """Forgets the last sample; the next one is a first one.

        Args:
          near: commands [J] (rad) at which the arm has rested; by default, the start pose.
        """
        if near is None:
            self._place = self._start
            self._room = _NEAR + self._metadata.start_noise
            self._place_name = "where the arm starts"
        else:
            self._place = near
            self._room = _NEAR
            self._place_name = "the commands at which the arm is said to rest"
        self._last: Measurements = {}
        self._bridged: set[str] = set()
        self._unconfirmed: np.ndarray | None = None
        self._standing = 0
        # Times since here, s: of the last call, of the arm's last sample that was believed, and at
        # which the ball's last believed picture was taken.
        self._now = 0.0
        self._arm_time = 0.0
        self._taken = -math.inf
        # The newest picture, with its velocities, what speaks against it, and whether the one
        # before holds in its place already: one picture is bridged in all of its steps.
        self._seen: bytes | None = None
        self._doubt: tuple[str, str] | None = None
        self._is_held = False

    def rest(self, angles: np.ndarray) -> None:
        """The arm rests at angles [J], rad; everything else is forgotten."""
        self.forget()
        self._last = {"joint_angles": angles, "joint_velocities": np.zeros(len(angles))}

    @property
    def is_arm_bridged(self) -> bool:
        """Whether the joint angles of the last step are those of the step before."""
        return _OF_ARM[0] in self._bridged

    def take(self, measured: Measurements) -> Measurements:
        """The sample, with the last values in place of those that cannot be true.

        Args:
          measured: arrays by name, as for `OnnxNetwork.step`, and `time` [1].

        Raises:
          ImpossibleMeasurement: it cannot be true, and nor could the one before, or there is none.
        """
        measured = dict(measured)
        if "time" in measured:
            self._take_time(measured)
        else:
            self._now += self._metadata.control_dt
        if "joint_angles" in measured:
            self._take_angles(measured)
        if "ball_position" in measured:
            self._take_picture(measured)
        return measured

    def _take_time(self, measured: Measurements) -> None:
        """Passes the time, which goes on."""
        time = measured["time"]
        last = self._last.get("time")
        if last is None:
            self._last["time"] = time
            return
        elapsed = float(time[0] - last[0])
        self._standing = self._standing + 1 if elapsed == 0.0 else 0
        if self._standing >= _MOST_STANDING:
            raise ImpossibleMeasurement(
                "time",
                f"the time has stood at {time[0]:.10g} s for {self._standing} calls; give the "
                "time of each sample, or none",
            )
        if elapsed < -self._metadata.control_dt:
            reason = (
                f"the time went back by {-elapsed:.3g} s; give seconds of one clock, and call "
                "reset if it starts again"
            )
            if elapsed <= -PAUSE:
                raise ImpossibleMeasurement("time", reason)
            self._bridge(measured, ("time",), "time", reason)
            return
        self._bridged.discard("time")
        if elapsed > 0.0:
            self._last["time"] = time
            self._now += elapsed

    def _take_angles(self, measured: Measurements) -> None:
        """Believes the arm's sample, or bridges it."""
        angles = measured["joint_angles"]
        last = self._last.get("joint_angles")
        if last is None:
            self._check_first(angles)
            last = angles
        elapsed = max(self._now - self._arm_time, self._metadata.control_dt)
        moved = np.abs(angles - last) - (self._fastest * elapsed + self._noise)
        if moved.max() > 0.0:
            joint = int(np.argmax(moved))
            turned = abs(abs(angles[joint] - last[joint]) - 2.0 * math.pi) < 0.2
            reason = (
                f"the angle of {self._metadata.joint_names[joint]} is {angles[joint]:.3g} rad, "
                f"{abs(angles[joint] - last[joint]):.3g} rad from {1e3 * elapsed:.0f} ms before, "
                "farther than it moves; "
            )
            remedy = "give unwrapped angles" if turned else "check the encoder, or call reset"
            self._bridge(measured, _OF_ARM, "joint_jump", reason + remedy)
            return
        # Not left by a jump, so that the next sample will say the same.
        self.check_range("angle", angles)
        velocities = measured.get("joint_velocities", self._still)
        too_fast = np.abs(velocities) - self._fastest
        if too_fast.max() > 0.0:
            joint = int(np.argmax(too_fast))
            reason = (
                f"{self._metadata.joint_names[joint]} has {velocities[joint]:.3g} rad/s, and moves "
                f"at most at {self._fastest[joint]:.3g} (rad/s); stop the arm"
            )
            self._bridge(measured, _OF_ARM, "joint_speed", reason)
            return
        self._believe(measured, _OF_ARM)
        self._arm_time = self._now

    def check_range(self, label: str, angles: np.ndarray) -> None:
        """Refuses angles [J] (rad) far outside of their ranges. Whole turns are not removed: a
        joint that counts them would be commanded a turn away, and another one is really there.

        Args:
          label: what each is of its joint, for the message.

        Raises:
          ImpossibleMeasurement: one is 0.5 rad outside.
        """
        outside = np.maximum(self._low - angles, angles - self._high)
        if outside.max() > _OUTSIDE:
            joint = int(np.argmax(outside))
            raise ImpossibleMeasurement(
                "joint_range",
                f"the {label} of {self._metadata.joint_names[joint]} is {angles[joint]:.3g}, but "
                f"the training had {self._low[joint]:.3g} to {self._high[joint]:.3g} (rad); give "
                "this unit, the policy's order, and no whole turns",
            )

    def _check_first(self, angles: np.ndarray) -> None:
        """A first sample is believed near the start pose, or if the next one agrees with it."""
        metadata = self._metadata
        if not np.any(angles) and np.any(self._start):
            raise UnconfirmedSample(
                "all joint angles are 0, as of a driver without data; wait for its first sample"
            )
        self.check_range("angle", angles)
        far = float(np.max(np.abs(angles - self._place)))
        if far <= self._room:
            return
        in_order = np.max(np.abs(angles - self._start))
        start_room = _NEAR + metadata.start_noise
        reordered = np.max(np.abs(np.sort(np.abs(angles)) - np.sort(np.abs(self._start))))
        if in_order > start_room and reordered <= min(_SAME + metadata.start_noise, 0.5 * in_order):
            raise ImpossibleMeasurement(
                "joint_order",
                "the joint angles fit the start pose in another order or with other signs; give "
                f"those of {', '.join(metadata.joint_names)}, or load_policy the driver's "
                "joint_names",
            )
        last = self._unconfirmed
        self._unconfirmed = angles
        reach = self._fastest * metadata.control_dt + self._noise
        if last is None or np.any(np.abs(angles - last) > reach):
            raise UnconfirmedSample(
                f"the first joint angles are {far:.3g} rad from {self._place_name}; they count "
                "when the next sample confirms them"
            )

    def _take_picture(self, measured: Measurements) -> None:
        """Believes the picture of the balls, or bridges it until the next one."""
        balls = measured["ball_position"].reshape(-1, 3)
        age = float(measured["ball_age"][0]) if "ball_age" in measured else 0.0
        if age < -SYNCHRONOUS:
            raise ImpossibleMeasurement(
                "old_picture",
                f"the picture of the ball is {1e3 * age:.0f} ms old; give the time since it was "
                "taken, by one clock",
            )
        taken = self._now - age
        velocities = measured.get("ball_velocity")
        # Bytes are compared faster than arrays.
        seen = balls.tobytes() + (b"" if velocities is None else velocities.tobytes())
        if seen != self._seen:
            self._seen = seen
            self._is_held = False
            self._doubt = self._doubt_of(balls, velocities, taken)
        if self._doubt is None:
            # A velocity may come between two pictures.
            last = self._last.get("ball_position")
            if last is None or (measured["ball_position"] != last).any():
                self._taken = max(taken, self._taken)
            self._believe(measured, _OF_BALL)
        elif self._is_held:
            self._hold(measured, _OF_BALL)
        else:
            self._bridge(measured, _OF_BALL, *self._doubt)
            self._is_held = True

    def _doubt_of(
        self, balls: np.ndarray, velocities: np.ndarray | None, taken: float
    ) -> tuple[str, str] | None:
        """Fault and reason of a new picture of the balls [B, 3] that cannot be true, else None."""
        bounds = self._metadata.ball
        last = self._last.get("ball_position")
        if (distance := _longest(balls)) > bounds.distance:
            return "ball_place", (
                f"the distance of ball_position is {distance:.3g}, but the training had 0 to "
                f"{bounds.distance:.3g} (m); give this unit, and the robot's frame"
            )
        if velocities is not None:
            speed = _longest(velocities.reshape(-1, 3))
            if speed > bounds.speed:
                return "ball_speed", (
                    f"the ball has {speed:.3g} m/s, but the training had at most "
                    f"{bounds.speed:.3g} (m/s); give this unit"
                )
        if last is not None:
            if (earlier := self._taken - taken) > self._metadata.control_dt:
                return "old_picture", (
                    f"the picture of the ball was taken {1e3 * earlier:.0f} ms before the last "
                    "one; give the newest, and ages by one clock"
                )
            between = max(taken - self._taken, self._metadata.control_dt)
            flown = _longest(balls - last.reshape(-1, 3))
            if flown > bounds.speed * between + self._ball_noise:
                return "ball_speed", (
                    f"the ball is {flown:.3g} m from {1e3 * between:.0f} ms before, farther than "
                    "it flies; check the camera, or call reset before a new ball"
                )
        return None

    def _believe(self, measured: Measurements, names: tuple[str, ...]) -> None:
        self._bridged.discard(names[0])
        self._last |= {name: measured[name] for name in names if name in measured}

    def _bridge(
        self, measured: Measurements, names: tuple[str, ...], fault: str, reason: str
    ) -> None:
        """Puts the last values of some measurements in place, once in a row."""
        if names[0] in self._bridged or names[0] not in self._last:
            raise ImpossibleMeasurement(fault, reason)
        self._bridged.add(names[0])
        self._hold(measured, names)

    def _hold(self, measured: Measurements, names: tuple[str, ...]) -> None:
        """Puts the last values in place; what came for the first time is left out."""
        for name in names:
            value = measured.pop(name, None)
            if value is None:
                continue
            if name == "ball_age":
                measured[name] = np.array([self._now - self._taken])
            elif name in self._last:
                measured[name] = self._last[name]


def check_mapping(measurements: Any) -> None:
    """Raises UserError for measurements without names."""
    if not isinstance(measurements, Mapping):
        raise UserError(
            f"the measurements are {str(measurements)[:100]!r}; give a mapping of their names, "
            "such as joint_angles"
        )


def _longest(vectors: np.ndarray) -> float:
    """Length of the longest of vectors [B, 3]."""
    return max(math.hypot(*vector) for vector in vectors.tolist())
