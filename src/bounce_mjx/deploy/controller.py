"""A policy as a function: `step(memory, measured) -> memory, action`. The memory is a value, so
that a refused sample changes nothing, and two programs with a memory each do not disturb each
other."""

from typing import NamedTuple

import numpy as np

from bounce_mjx.deploy.clock import PAUSE, is_pause
from bounce_mjx.deploy.metadata import Metadata
from bounce_mjx.deploy.motion import Course, Motion
from bounce_mjx.deploy.network import History, OnnxNetwork
from bounce_mjx.deploy.samples import ImpossibleMeasurement, Measurements, Samples, Seen


class Memory(NamedTuple):
    """What a policy knows between two samples."""

    seen: Seen
    """The samples until now."""
    history: History
    """What the network saw in the control steps."""
    action: np.ndarray
    """Of the last control step [J]."""
    measured: Measurements
    """In the last control step; empty before it."""
    course: Course | None
    """The commands of the last control step; None before there is one."""


class Controller:
    """A policy's network, what its worlds can hold, and how its commands may move. Nothing in it
    changes; the joints have the policy's order."""

    def __init__(self, network: OnnxNetwork, metadata: Metadata):
        """The controller of an arm.

        Args:
          network: of the policy.
          metadata: the network's, with the names of the joints for messages.
        """
        self.metadata = metadata
        self.network = network
        self.samples = Samples(metadata)
        self.motion = Motion(metadata)

    def begin(self, targets: np.ndarray | None = None) -> Memory:
        """The memory before the first sample.

        Args:
          targets: servo targets [J] (rad) at which the arm rests; None for the measured angles.
        """
        course = None if targets is None else self.motion.resting(targets)
        return self.episode(Seen(), course)

    def episode(self, seen: Seen, course: Course | None) -> Memory:
        """The memory before the first control step of an episode."""
        still = np.zeros(len(self.metadata.joint_names))
        return Memory(seen, self.network.begin(), still, {}, course)

    def step(self, memory: Memory, measured: Measurements) -> tuple[Memory, np.ndarray]:
        """A control step: the memory after a sample, and the action [J].

        Args:
          memory: before the sample.
          measured: arrays by name, as `Driver.check` returns them.

        Raises:
          UserError: as `DeployedPolicy.step`.
        """
        memory, measured, steps = self.take(memory, measured)
        memory = self.act(memory, measured, steps)
        return memory, memory.action

    def take(
        self, memory: Memory, measured: Measurements, waited: float | None = None
    ) -> tuple[Memory, Measurements, int]:
        """The memory with a new sample; the sample, with the last values in place of those that
        cannot be true; and the control steps since the last one.

        Args:
          memory: before the sample.
          measured: the sample.
          waited: as for `clock.advance`.

        Raises:
          ImpossibleMeasurement: as `Samples.take`; or it comes a second or more after the last one.
        """
        last = memory.seen.clock.time
        if "time" in measured and last is not None:
            elapsed = float(measured["time"][0]) - last
            if elapsed > 0.0 and is_pause(elapsed):
                raise ImpossibleMeasurement(
                    "late_step",
                    f"the time {last + elapsed} s is {elapsed:.3g} s after the last one; call "
                    f"reset after a pause of {PAUSE:g} s, and give seconds",
                )
        rests_at = None
        if memory.course is not None and not memory.seen.has_arm:
            rests_at = self.motion.target(memory.course)
        seen, measured, steps = self.samples.take(memory.seen, measured, rests_at, waited)
        return memory._replace(seen=seen), measured, steps

    def act(self, memory: Memory, measured: Measurements, steps: int) -> Memory:
        """The memory after the control step of a sample that was taken.

        Args:
          memory: with the sample (`take`).
          measured: the sample.
          steps: control steps since the last one; after 0, nothing is done.

        Raises:
          NoAction: the network gives no finite action.
        """
        if steps == 0:
            return memory
        course = memory.course
        angles = measured.get("joint_angles")
        if course is None and angles is not None:
            course = self.motion.resting(angles)
        if memory.seen.clock.has_waited and course is not None:
            course = self.motion.stopped(course)
        if course is not None and angles is not None and self.metadata.max_lead is not None:
            measured = measured | {"servo_lead": course.end.position - angles}
        history = memory.history
        action = memory.action
        earlier = memory.measured
        # In the missed steps the robot went on with the last action.
        for left in reversed(range(steps)):
            between = measured
            if left:
                between = {
                    name: value + left / steps * (earlier.get(name, value) - value)
                    for name, value in measured.items()
                }
            seen = None if left else memory.seen
            history, new_action = self.network.step(history, between, action, seen)
        if angles is not None:
            course = self.course_of(course, angles, new_action)
        return Memory(memory.seen, history, new_action, measured, course)

    def course_of(self, course: Course, angles: np.ndarray, action: np.ndarray) -> Course:
        """The commands after others, under an action.

        Args:
          course: of the control step before.
          angles: measured [J], rad.
          action: [J], from -1 to 1.
        """
        base = angles
        lead = self.metadata.max_lead
        if lead is not None:
            base = np.minimum(np.maximum(course.end.position, angles - lead), angles + lead)
        return self.motion.aim(course, base + self.metadata.action_scale * action)
