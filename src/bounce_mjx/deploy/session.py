"""The program around a policy, or a motion, and an arm. The same code drives a simulated arm and a
real one: only the `Arm` and the `Operator` differ."""

import select
import sys
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from bounce_mjx.deploy.policy import DeployedPolicy
from bounce_mjx.deploy.recorder import Recorder
from bounce_mjx.deploy.supervisor import State, Supervisor
from bounce_mjx.deploy.trajectory import Trajectory
from bounce_mjx.errors import UserError

BALL_GONE = ("ball_lost", "ball_flight")
"""Faults after which the operator may start another episode."""
_OVER = "the time is over"
_WAITING: dict[str, str] = {
    "ready": "the arm is ready; give the word to start",
    "stopped": "stopped as {reason}; give the word to go home, with no hand near",
}
"""What the operator hears of an arm that waits for the word, by its state."""
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
        """The newest measurements by name, as `DeployedPolicy.step` takes them, with `time`.

        Raises:
          UserError: what came is not of this arm, such as a message of another frame; the arm
            brakes, and the program ends. Any other exception ends it at once.
        """

    def send(self, commands: np.ndarray) -> None:
        """Sends commands [M, J] (rad), one in each period, and returns after M periods; of [0, J],
        nothing, after one period."""

    def stop(self) -> None:
        """Ends the sending, so that the arm does not go on toward its last command."""


class Operator(Protocol):
    """Who stands by the arm, and sees that no hand is near when it moves."""

    def has_word(self, state: State) -> bool:
        """Whether they have given the word since the last call: to start where the arm is `ready`,
        to go home where it is `stopped`. Asked once a control step, in every state; a word that
        comes in another one does not count."""

    def hear(self, words: str) -> None:
        """Tells them what the arm waits for."""


class Terminal:
    """An operator at the program's terminal, whose word is the key Enter."""

    def has_word(self, state: State) -> bool:
        """As `Operator.has_word`."""
        has_line, _, _ = select.select([sys.stdin], [], [], 0.0)
        return bool(has_line and sys.stdin.readline())

    def hear(self, words: str) -> None:
        """As `Operator.hear`."""
        print(words, flush=True)


class Episode(NamedTuple):
    """From the operator's word to the begin of the braking, or to the end of the time."""

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


def play(
    policy: DeployedPolicy,
    arm: Arm,
    seconds: float,
    operator: Operator,
    goals: Callable[[float], Mapping[str, float]],
    box: Mapping[str, Any],
    recorder: Recorder | None = None,
) -> Session:
    """Sends the arm home, plays for a time, and brakes. Each episode starts on the operator's word,
    and after a lost ball another word sends the arm home; another fault ends the program.

    Args:
      policy: for this arm.
      arm: on which it plays.
      seconds: by the periods of the commands; infinite for no end.
      operator: who gives the word.
      goals: time since the begin (s) -> what the task asks for, such as the target height, m.
      box: the settings `box` and others of `DeployedPolicy.supervise`.
      recorder: of a log; None for none.

    Raises:
      UserError: the arm is measured elsewhere than its controller holds it, or the settings do not
        fit; whatever is raised, the arm is stopped first.
    """
    # Where the controller holds the arm, which no reading of the encoders tells wrongly.
    held = arm.targets()
    policy.reset(held)
    supervisor = policy.supervise(arm.rate, **box)
    episodes = []
    start: float | None = None
    time = 0.0
    periods = 0
    told: State | None = None
    reason = refusal = None
    # A word of before, as for another session, does not count.
    operator.has_word(supervisor.state)
    try:
        while True:
            elapsed = periods / arm.rate
            is_over = elapsed >= seconds
            measured = _measured(arm, supervisor, goals(elapsed))
            if is_over:
                supervisor.stop(_OVER, _OVER)
            commands = supervisor.commands(measured)
            arm.send(commands)
            periods += max(len(commands), 1)
            if len(commands):
                held = commands[-1]
            if recorder is not None and held is not None and "time" in measured:
                # After the commands, which a full disk must not keep back.
                recorder.step(measured, held)
            time = _time_of(measured, time)
            state = supervisor.state
            fault = None if supervisor.fault == _OVER else supervisor.fault
            if supervisor.fault != _OVER:
                reason = supervisor.reason or refusal
            if start is not None and state != "running":
                why = None if fault is None else reason
                episodes.append(Episode(start, time - start, fault, why))
                start = None
            if state == "stopped" and (is_over or fault not in BALL_GONE):
                ended_by = None if fault in BALL_GONE else fault
                return Session(tuple(episodes), ended_by, reason)
            if state != told and state in _WAITING:
                operator.hear(_WAITING[state].format(reason=reason))
            told = state
            if not operator.has_word(state):
                continue
            if state == "stopped":
                supervisor.restart()
            elif state == "ready":
                refusal = _start(supervisor, measured)
                if refusal is None:
                    start = time
                else:
                    operator.hear(f"nothing starts: {refusal}")
    finally:
        arm.stop()


def _measured(arm: Arm, supervisor: Supervisor, goals: Mapping[str, float]) -> dict[str, Any]:
    """What the arm measures, with the goals; the arm stops where its driver refuses that."""
    try:
        return arm.measure() | goals
    except UserError as error:
        supervisor.stop(str(error))
        return dict(goals)


def _time_of(measured: Mapping[str, Any], last: float) -> float:
    """The driver's time, s; the last one where it is missing or no number."""
    try:
        return float(np.ravel(measured["time"])[0])
    except (KeyError, IndexError, TypeError, ValueError):
        return last


def _start(supervisor: Supervisor, measured: Mapping[str, Any]) -> str | None:
    """Starts an episode of an arm that is ready; returns why it does not begin, and the arm rests
    on, or None."""
    if "ball_position" not in measured:
        return "there is no picture of the ball"
    try:
        supervisor.start()
    except UserError as error:
        return str(error)
    return None


def replay(arm: Arm, trajectory: Trajectory, recorder: Recorder | None = None) -> np.ndarray:
    """Moves an arm along a trajectory, without a policy and without a ball, such as that of
    `bounce-mjx excite`. Each period has its target, between those of the two times around it.

    Args:
      arm: at the begin of the trajectory, with the trajectory's order of the joints.
      trajectory: of the servo targets.
      recorder: of a log with a row for each period; None for none.

    Returns:
      The largest distance of each joint [J] from its target at the time, rad.

    Raises:
      UserError: the arm is not at the begin of the trajectory, or a joint does not follow it; the
        arm is stopped first.
    """
    names = trajectory.joint_names
    sent: list[np.ndarray] = []
    away = np.zeros(len(names))
    try:
        _check_start(trajectory, np.array(arm.measure()["joint_angles"]))
        for time in np.arange(0.0, trajectory.times[-1], 1.0 / arm.rate):
            measured = arm.measure()
            angles = np.array(measured["joint_angles"])
            sent.append(trajectory.at(time))
            recent = np.array(sent[-round(_LATE * arm.rate) :])
            _check_following(names, angles, recent)
            away = np.maximum(away, np.abs(angles - sent[-1]))
            arm.send(sent[-1][None])
            if recorder is not None:
                recorder.step(measured, sent[-1])
    finally:
        arm.stop()
    return away


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
