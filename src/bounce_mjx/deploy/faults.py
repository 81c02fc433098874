"""What an arm does with its commands, and what is seen of its ball: each fault here is a row of the
table in docs/real-robot.md."""

import math
from typing import NamedTuple

import numpy as np

from bounce_mjx.deploy.metadata import Metadata, largest_term, least_term
from bounce_mjx.deploy.samples import RESOLUTION
from bounce_mjx.errors import UserError

# Time of a joint's motion that is compared with the training's arms, s.
_COMPARED = 0.25
# Distance of these arms' latencies, and how much later than the training's the last one is, s.
_APART = 0.01
_LATER = 0.02
_NO_LAG = 1e-9
# Motion beside all these arms that is too much: a share of what the commands moved meanwhile, a
# share of `action_scale` or what the arm's own inertia does, the encoders' noise in standard
# deviations, and a count of the encoder.
# In 32 episodes of each of four policies, at most 0.65 of it was beside the nearest arm.
_OF_COMMANDS = 0.25
_OF_SCALE = {"target": 0.2, "measured": 0.05}
# Parts of an arm that accelerate by g load its servos as its weight does. From weightless to twice
# the weight, a joint moves over two of its sags.
_OF_SAG = 2.0
_OF_NOISE = 3.0
# The same for a joint whose reading repeats to the last digit all the time: what dry friction
# holds, rad, and counts of the encoder.
_HELD = 1e-3
_COUNTS = 2.0
# Distance from all these arms that is too far, rad.
_TOO_FAR = 0.05
# What a load takes a joint off its command while it rests, beside the arm's own weight, rad.
_SAG = 0.01
# A ball so far below the paddle is lost, m.
_BELOW = 0.1


class Fault(UserError):
    """What the program of a robot did not expect: its arm stops."""

    def __init__(self, fault: str, reason: str):
        super().__init__(reason)
        self.fault = fault
        """Code, of the table in docs/real-robot.md."""


class Followed(NamedTuple):
    """The last control steps of an arm."""

    commands: np.ndarray
    """At the ends of the last control steps [L, J], the newest last, rad."""
    beside: np.ndarray
    """Measured angles less those of the training's arms in the last 0.25 s [C, A, J], rad."""
    angles: np.ndarray
    """Measured in the last 0.25 s [C, J], the newest last, rad."""
    steps: int
    """Since the arm rested."""
    repeats: np.ndarray
    """Steps in which each reading has repeated [J]."""
    smallest_change: np.ndarray
    """Of each reading [J], which is a count of the encoder or more, rad; infinite until the reading
    changes, so that one that has never changed has no narrower bound than others."""


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
    joint_damping = np.array(metadata.joint_damping)
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
    """Compares the control steps of an arm with what the training's worlds can hold."""

    def __init__(self, metadata: Metadata):
        """Bounds of a policy's worlds."""
        self._metadata = metadata
        sag = np.array(metadata.sag) / least_term(metadata, "servo_gain", 1.0)
        # Where the weight and the servos' constant errors take a joint from its command, rad.
        self._beside_command = float(np.max(sag)) + largest_term(metadata, "servo_offset")
        # A robot's servo may have another zero than its encoder, unlike the training's.
        self.offset = _SAG + largest_term(metadata, "encoder_bias") + self._beside_command
        """Distance of a resting joint from its command, rad."""
        noise = largest_term(metadata, "joint_angle_noise")
        of_scale = _OF_SCALE[metadata.action_base] * metadata.action_scale
        of_noise = _OF_NOISE * noise
        self._in_motion = np.maximum(of_scale, _OF_SAG * sag) + of_noise
        self._after_rest = np.maximum(of_scale + self._beside_command, _OF_SAG * sag) + of_noise
        # The weights of the last commands, the newest last.
        self._arms = np.ascontiguousarray(arm_responses(metadata)[:, ::-1])
        self._compared = math.ceil(_COMPARED / metadata.control_dt)
        self._settling = self._arms.shape[1] + self._compared

    def rest(self, angles: np.ndarray, command: np.ndarray) -> Followed:
        """The arm has rested at these angles [J], commanded to be there [J], rad."""
        arms, length = self._arms.shape
        return Followed(
            commands=np.tile(command, (length + self._compared, 1)),
            beside=np.tile(angles - command, (self._compared, arms, 1)),
            angles=np.tile(angles, (self._compared, 1)),
            steps=0,
            repeats=np.zeros(len(angles), int),
            smallest_change=np.full(len(angles), np.inf),
        )

    def follow(
        self,
        followed: Followed,
        angles: np.ndarray,
        command: np.ndarray,
        steps: int = 1,
        is_bridged: bool = False,
    ) -> Followed:
        """The last control steps with a new sample.

        Args:
          followed: before it.
          angles: measured [J], rad.
          command: at the end of the step before [J], rad, which held since.
          steps: control steps since the last sample.
          is_bridged: whether the angles are those of the step before, which say nothing of this.

        Raises:
          Fault: a joint does not move as any arm of the training would.
        """
        commands = _shifted(followed.commands, command, steps)
        followed = followed._replace(commands=commands, steps=followed.steps + steps)
        if is_bridged:
            return followed
        beside = angles - self._arms @ commands[-self._arms.shape[1] :]
        change = np.abs(angles - followed.angles[-1])
        has_changed = change > 0.0
        smallest = np.minimum(followed.smallest_change, change)
        followed = followed._replace(
            beside=_shifted(followed.beside, beside, steps),
            angles=_shifted(followed.angles, angles, steps),
            repeats=np.where(has_changed, 0, followed.repeats + steps),
            smallest_change=np.where(has_changed, smallest, followed.smallest_change),
        )
        self._check(followed)
        return followed

    def _check(self, followed: Followed) -> None:
        """Raises Fault for a joint that moves as no arm of the training."""
        high = np.max(followed.beside, axis=0)
        low = np.min(followed.beside, axis=0)
        allowed = self._allowed_motion(followed)
        by_motion = (high - low) / allowed
        by_place = np.maximum(high, -low) / (_TOO_FAR + self._beside_command)
        unlike = np.min(np.maximum(by_motion, by_place), axis=0)
        joint = int(np.argmax(unlike))
        if unlike[joint] <= 1.0:
            return
        nearest = int(np.argmin(np.maximum(by_motion, by_place)[:, joint]))
        name = f"{self._metadata.joint_names[joint]} does not follow its commands"
        if by_place[nearest, joint] > by_motion[nearest, joint]:
            distance = np.abs(followed.beside[-1, nearest, joint])
            raise Fault(
                "joint_astray", f"{name}, and is {distance:.2g} rad from where they take it"
            )
        moved = np.ptp(followed.angles[:, joint])
        commanded = np.ptp(followed.commands[:, joint])
        unlike_motion = (high - low)[nearest, joint]
        raise Fault(
            "joint_astray",
            f"{name}: its angle went over {moved:.2g} rad in {_COMPARED:g} s, its commands over "
            f"{commanded:.2g} rad, and it moved {unlike_motion:.2g} rad beside any arm of the "
            f"training, which may be {allowed[joint]:.2g} rad",
        )

    def _allowed_motion(self, followed: Followed) -> np.ndarray:
        """Motion of each joint beside the training's arms [J] that is no fault, rad: that of the
        policy or of the arm's inertia, with its noise, a count of the encoder, a share of what the
        commands moved, and after a rest where weight and servos take the joint; of a reading that
        repeats all the time, what dry friction and its counts hide at most."""
        of_count = np.minimum(followed.smallest_change, RESOLUTION)
        of_commands = _OF_COMMANDS * np.ptp(followed.commands, axis=0)
        is_settling = followed.steps < self._settling
        least = self._after_rest if is_settling else self._in_motion
        moving = least + of_count + of_commands
        # A moving joint's reading changes by a count, and one with noise in every step.
        repeating = np.minimum(moving, _HELD + _COUNTS * followed.smallest_change)
        return np.where(followed.repeats >= self._compared, repeating, moving)


def check_balls(balls: np.ndarray, age: float, max_age: float, paddle: np.ndarray) -> None:
    """Looks at the newest picture of the balls.

    Args:
      balls: [B, 3], m.
      age: of the picture, s.
      max_age: the largest one, s.
      paddle: the paddle's centre [3], m.

    Raises:
      Fault: the picture is old, or a ball is lost.
    """
    if not age <= max_age:
        raise Fault("old_picture", f"the picture of the ball is {1e3 * age:.0f} ms old")
    below = paddle[2] - balls[:, 2].min()
    if below > _BELOW:
        raise Fault("ball_lost", "the ball is lost")


def _shifted(entries: np.ndarray, newest: np.ndarray, steps: int) -> np.ndarray:
    """Entries of control steps [N, ...], the newest last, after some steps with the same entry."""
    steps = min(steps, len(entries))
    return np.concatenate([entries[steps:], np.broadcast_to(newest, (steps, *newest.shape))])
