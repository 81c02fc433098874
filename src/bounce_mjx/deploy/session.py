"""The program around a policy, or a motion, and an arm. The same code drives a simulated arm and a
real one: only the `Arm` differs."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from bounce_mjx.deploy.faults import picture_age
from bounce_mjx.deploy.policy import DeployedPolicy
from bounce_mjx.deploy.recorder import Recorder
from bounce_mjx.deploy.supervisor import Supervisor
from bounce_mjx.deploy.trajectory import Trajectory
from bounce_mjx.errors import UserError

BALL_GONE = ("ball_lost", "ball_flight")
"""Faults after which the operator may start another episode."""
SETTLING = 0.5
"""Time that a stopped arm has to come to rest before it goes home again, s."""
# A motion begins where the arm is, and stops where a joint is too far from its target, rad.
_AT_START = 0.05
_TOO_FAR = 0.2
# Time after the last command in which a joint may still be elsewhere than its target, s.
_LATE = 0.3


class Arm(Protocol):
    """A driver: what a program needs of an arm and of the camera that sees its ball. A control step
    begins with `measure` and ends with `send`. Arrays are in the order of the policy's joints
    (`load_policy(..., joint_names=...)`)."""

    rate: float
    """Commands a second, Hz."""

    def targets(self) -> np.ndarray | None:
        """Servo targets [J] at which the controller holds the arm, rad; None if the driver does not
        know them."""

    def measure(self) -> dict[str, Any]:
        """The newest measurements by name, as `DeployedPolicy.step` takes them, with `time`."""

    def send(self, commands: np.ndarray) -> None:
        """Sends commands [M, J] (rad), one in each period, and returns after M periods; of [0, J],
        nothing, after one period."""

    def stop(self) -> None:
        """Ends the sending, so that the arm does not go on toward its last command."""


class Episode(NamedTuple):
    """From the operator's word to a stop, or to the end of the time."""

    start: float
    """Time of the driver's clock, s."""
    seconds: float
    fault: str | None = None
    """Code of the fault that stopped the arm; None for the end of the time."""
    reason: str | None = None


class Session(NamedTuple):
    """What happened while a program ran."""

    episodes: tuple[Episode, ...]
    """Those that began."""
    fault: str | None
    """Code of the fault that ended it; None for the end of the time."""
    reason: str | None
    """Why it ended, or what it still waited for."""


def heed_word(supervisor: Supervisor, ball_age: float, max_age: float) -> str | None:
    """What the operator's word does: it starts an episode where the arm is ready, and sends it home
    where it has stopped. Without a word, neither moves.

    Args:
      supervisor: of the arm.
      ball_age: of the newest picture of the ball, s.
      max_age: largest one with which an episode starts, s.

    Returns:
      Why nothing has begun, to be said; the arm rests on. None if it has.
    """
    if supervisor.state == "stopped":
        supervisor.restart()
        return None
    if supervisor.state != "ready":
        return f"the arm is {supervisor.state}"
    if not ball_age <= max_age:
        return f"no picture of the ball is newer than {max_age:g} s"
    try:
        supervisor.start()
    except UserError as error:
        # The ball is not over the paddle.
        return str(error)
    return None


def play(
    policy: DeployedPolicy,
    arm: Arm,
    seconds: float,
    is_told: Callable[[str], bool],
    goals: Callable[[float], Mapping[str, float]],
    box: Mapping[str, Any],
    recorder: Recorder | None = None,
) -> Session:
    """Plays for a time, again on the operator's word after each lost ball, until another fault.

    Args:
      policy: for this arm.
      arm: on which it plays.
      seconds: by the steps of the policy.
      is_told: whether the operator gives the word to start; asked once a control step, with the
        supervisor's state. A word that comes before the arm is ready does not count.
      goals: time since the begin (s) -> what the task asks for, such as the target height, m.
      box: the settings `box` and others of `DeployedPolicy.supervise`.
      recorder: of a log; None for none.

    Raises:
      UserError: the arm is measured elsewhere than its controller holds it, or the settings do not
        fit; whatever is raised, the arm is stopped first.
    """
    # Where the controller holds the arm, which no reading of the encoders tells wrongly.
    policy.reset(arm.targets())
    supervisor = policy.supervise(arm.rate, **box)
    dt = policy.metadata.control_dt
    # An older picture would stop the arm at once.
    max_age = picture_age(policy.metadata)
    held = arm.targets()
    episodes = []
    start: float | None = None
    stopped_at: float | None = None
    reason = None
    try:
        for step in range(round(seconds / dt)):
            measured = arm.measure() | goals(step * dt)
            commands = supervisor.commands(measured)
            arm.send(commands)
            if len(commands):
                held = commands[-1]
            if recorder is not None and held is not None:
                # After the commands, which a full disk must not keep back.
                recorder.step(measured, held)
            has_word = is_told(supervisor.state)
            reason = supervisor.reason
            if supervisor.state == "ready" and has_word:
                reason = heed_word(supervisor, measured.get("ball_age", np.inf), max_age)
                if reason is None:
                    start = measured["time"]
            elif supervisor.state == "stopped" and stopped_at is None:
                stopped_at = measured["time"]
                if start is not None:
                    episodes.append(Episode(start, stopped_at - start, supervisor.fault, reason))
                start = None
                if supervisor.fault not in BALL_GONE:
                    return Session(tuple(episodes), supervisor.fault, reason)
            elif supervisor.state == "stopped" and measured["time"] - stopped_at > SETTLING:
                stopped_at = None
                supervisor.restart()
        if start is not None:
            episodes.append(Episode(start, measured["time"] - start))
    finally:
        arm.stop()
    return Session(tuple(episodes), None, reason)


def replay(arm: Arm, trajectory: Trajectory, recorder: Recorder | None = None) -> None:
    """Moves an arm along a trajectory, without a policy and without a ball, such as that of
    `bounce-mjx excite`. Each period has its target, between those of the two times around it.

    Args:
      arm: at the begin of the trajectory, with the trajectory's order of the joints.
      trajectory: of the servo targets.
      recorder: of a log with a row for each period; None for none.

    Raises:
      UserError: the arm is not at the begin of the trajectory, or a joint does not follow it; the
        arm is stopped first.
    """
    names = trajectory.joint_names
    sent: list[np.ndarray] = []
    try:
        _check_start(trajectory, np.array(arm.measure()["joint_angles"]))
        for time in np.arange(0.0, trajectory.times[-1], 1.0 / arm.rate):
            measured = arm.measure()
            sent.append(trajectory.at(time))
            recent = np.array(sent[-round(_LATE * arm.rate) :])
            _check_following(names, np.array(measured["joint_angles"]), recent)
            arm.send(sent[-1][None])
            if recorder is not None:
                recorder.step(measured, sent[-1])
    finally:
        arm.stop()


def _check_start(trajectory: Trajectory, angles: np.ndarray) -> None:
    """Raises UserError for an arm at angles [J] (rad) that are not those of the begin."""
    first = trajectory.targets[0]
    away = np.abs(angles - first)
    if np.max(away) > _AT_START:
        joint = int(np.argmax(away))
        pose = " ".join(f"{angle:.3f}" for angle in first)
        raise UserError(
            f"{trajectory.joint_names[joint]} is {away[joint]:.2g} rad from the begin of the "
            f"motion; move the arm to {pose} rad first"
        )


def _check_following(names: tuple[str, ...], angles: np.ndarray, recent: np.ndarray) -> None:
    """Raises UserError for angles [J] that are too far from all recent targets [N, J], rad."""
    away = np.maximum(angles - np.max(recent, axis=0), np.min(recent, axis=0) - angles)
    if np.max(away) > _TOO_FAR:
        joint = int(np.argmax(away))
        raise UserError(
            f"{names[joint]} is {away[joint]:.2g} rad from where its targets take it; look for "
            "what holds it, and check its name, its sign and its zero"
        )
