"""Joint commands of recorded episodes at the rate of an arm's controller, against the arm's
limits."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from bounce_mjx.robot.setpoints import Setpoint, joint_limits, position_at
from bounce_mjx.task.task import Recording
from bounce_mjx.world.config import WorldConfig


class LimitShare(NamedTuple):
    """The most that the commands of recorded episodes use of a limit."""

    quantity: str
    """velocity, acceleration or jerk."""
    share: float
    """Largest size, of the limit of its joint."""
    joint: int
    """The joint with this share, from 1 at the base."""


def limit_shares(config: WorldConfig, recording: Recording, rate: float = 1000) -> list[LimitShare]:
    """The largest velocity, acceleration and jerk of recorded commands, of each one's limit: the
    differences of the commands that a controller gets at a rate, one to three times.

    The commands are computed in float64 from the recorded velocities, as a deployed policy does it
    (`robot.setpoints`).

    Args:
      config: of an arm with limits of velocity and acceleration.
      rate: of the controller, Hz; rounded to whole commands in a control step.
    """
    limits = config.robot.limits
    # In the order of their differences; an arm with one of them has those before it.
    bounds = {}
    for name in ("velocity", "acceleration", "jerk"):
        bound = getattr(limits, name)
        if bound is not None:
            bounds[name] = np.array(bound)[:, None]
    smoothing = joint_limits(limits).smoothing
    smoothing = None if smoothing is None else smoothing[:, None]
    velocities = np.asarray(recording.command_velocity, np.float64)
    running = np.asarray(recording.running)
    duration = config.control_dt
    count = max(1, round(duration * rate))
    tick = duration / count
    times = tick * np.arange(1, count + 1)
    still = np.zeros(velocities.shape[1:])
    start = Setpoint(still, still, still)
    # A difference of order k needs k commands before the first one of a step; before an episode the
    # arm was still.
    earlier = [still] * len(bounds)
    largest = {name: still for name in bounds}
    for after, is_running in zip(velocities, running, strict=True):
        acceleration = (after - start.velocity) / duration
        sent = [position_at(start, acceleration, time, np, smoothing) for time in times]
        sent = [*earlier, *sent]
        change = np.array(sent)
        for name, bound in bounds.items():
            change = np.diff(change, axis=0) / tick
            most = np.max(np.abs(change[-count:]), axis=0) / bound
            largest[name] = np.maximum(largest[name], np.where(is_running, most, 0.0))
        earlier = sent[-len(bounds) :]
        position = start.position + 0.5 * (start.velocity + after) * duration
        start = Setpoint(position, after, acceleration)
    shares = []
    for name, by_episode in largest.items():
        by_joint = np.max(by_episode, axis=1)
        joint = int(by_joint.argmax())
        shares.append(LimitShare(name, share=float(by_joint[joint]), joint=joint + 1))
    return shares


def describe_limits(shares: Iterable[LimitShare], episodes: int) -> str:
    """Shares in one line."""
    each = [f"{quantity} {100 * share:.1f}% (joint {joint})" for quantity, share, joint in shares]
    largest = ", ".join(each)
    return f"most of the arm's limits that commands at 1 kHz use in {episodes} episodes: {largest}"
