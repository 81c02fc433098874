"""A supervisor between a policy and an arm."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from bounce_mjx.deploy.chain import paddle_pose
from bounce_mjx.deploy.faults import EARLIER, FLYING, faults, make_bounds, picture_age
from bounce_mjx.deploy.network import Measurements
from bounce_mjx.errors import UserError

if TYPE_CHECKING:
    from bounce_mjx.deploy.policy import DeployedPolicy

State = Literal["homing", "ready", "running", "braking", "stopped"]
Box = tuple[Sequence[float], Sequence[float]]

_HOME_TOLERANCE = 2e-3
# On the way home, rad/s.
_HOME_SPEED = 0.3


class Supervisor:
    """Gives an arm's commands, and stops the arm when a measurement, the arm or a command breaks a
    rule (`deploy.faults`); `DeployedPolicy.supervise` creates it.

    Call `commands` once each control step, in every state:

    - homing: the arm goes slowly to the policy's first posture, then it is
    - ready: it rests there until `start`;
    - running: it follows the policy, until a fault or `stop`;
    - braking: the commands slow down within the arm's limits, then it is
    - stopped: the commands rest, and `fault` and `reason` say why, until `restart`.
    """

    def __init__(
        self,
        policy: "DeployedPolicy",
        rate: float,
        box: Box = ((-math.inf,) * 3, (math.inf,) * 3),
        max_picture_age: float | None = None,
        max_steps_late: float = 2.0,
    ):
        """See `DeployedPolicy.supervise`."""
        policy.commands_per_step(rate)
        self._policy, self._rate = policy, rate
        metadata = policy.metadata
        age = picture_age(metadata) if max_picture_age is None else max_picture_age
        for name, value, most in (
            ("max_picture_age", age, 1.0),
            ("max_steps_late", max_steps_late, 1.0 / metadata.control_dt),
        ):
            if not 0.0 < value <= most:
                raise UserError(f"{name} is {value}; give a number above 0 and at most {most:g}")
        corners = np.array(box, float)
        if corners.shape != (2, 3) or not np.all(corners[0] < corners[1]):
            raise UserError(f"the box is {box}; give its lowest and its highest x, y and z, m")
        self._allowed = make_bounds(metadata, age, max_steps_late, corners)
        self.state: State = "homing"
        self.fault: str | None = None
        """Code of the rule that was broken, such as `ball_lost`; `measurement` for a measurement
        that the policy refuses, `stopped` after `stop`."""
        self.reason: str | None = None
        """Why the arm has stopped or brakes."""
        self._past: np.ndarray | None = None

    def start(self) -> None:
        """Starts an episode.

        Raises:
          UserError: the arm is not ready.
        """
        if self.state != "ready":
            raise UserError(
                f"the arm is {self.state}, and an episode starts when it is ready; call restart "
                "after a stop, and commands until the arm is home"
            )
        self._policy.reset(self._policy.targets)
        self._time: float | None = None
        self._idle = 0
        self._pictures: list[tuple[np.ndarray, float]] = []
        self.state = "running"

    def stop(self, reason: str, fault: str = "stopped") -> None:
        """Brakes, from any state."""
        if self.state not in ("braking", "stopped"):
            self.state, self.fault, self.reason = "braking", fault, reason

    def restart(self) -> None:
        """Goes home after a stop, from where the arm then is, for the next `start`.

        Raises:
          UserError: the arm has not stopped.
        """
        if self.state != "stopped":
            raise UserError(f"the arm is {self.state}; restart it when it has stopped")
        self.state, self.fault, self.reason, self._past = "homing", None, None, None

    def commands(self, measurements: Mapping[str, Any]) -> np.ndarray:
        """Commands [M, J] of a control step at the robot's rate, rad.

        Args:
          measurements: as for `DeployedPolicy.step`. Before `start`, only the joint angles are
            needed, and none while the arm brakes and after. Without `time` no step is late, and
            without `ball_age` a picture is as old as the time since the ball's position last
            changed.

        Raises:
          UserError: the first joint angles are wrong, so that no command is known.
        """
        policy = self._policy
        if self.state not in ("braking", "stopped"):
            step = self._follow if self.state == "running" else self._go_home
            try:
                step(measurements)
            except UserError as error:
                if policy.targets is None:
                    raise
                self.stop(str(error), "measurement")
        if self.state in ("braking", "stopped"):
            if policy.targets is None:
                policy.reset(self._angles(measurements))
            policy.motion.hold()
            if self.state == "braking" and policy.motion.is_still:
                self.state = "stopped"
        return policy.commands(self._rate)

    def _angles(self, measurements: Mapping[str, Any]) -> np.ndarray:
        """The measured joint angles [J], whatever else is measured."""
        given = {k: v for k, v in measurements.items() if k == "joint_angles"}
        return self._policy.check(given, ("joint_angles",))["joint_angles"]

    def _is_fine(self, facts: dict[str, Any]) -> bool:
        """Brakes if the facts break a rule, and says whether they keep all."""
        for rule, is_broken, number in faults(self._allowed, facts):
            if is_broken:
                self.stop(rule.reason.format(number), rule.fault)
                return False
        return True

    def _go_home(self, measurements: Mapping[str, Any]) -> None:
        """A step of the way home."""
        policy, angles = self._policy, self._angles(measurements)
        home = np.array(policy.metadata.default_joint_angles)
        if self._past is None:
            # A small distance is the arm's load, and needs no step of the command.
            if policy.targets is None or not self._are_near(policy.targets, angles):
                policy.reset(angles)
            rest = [[angles], [policy.targets]]
            self._past = np.repeat(rest, self._allowed["angles"].window + 1, axis=1)
        if not self._is_fine(self._window(angles)):
            return
        if np.abs(policy.targets - home).max() > _HOME_TOLERANCE:
            policy.motion.move(home, _HOME_SPEED)
            return
        policy.motion.hold()
        is_home = policy.motion.is_still and self._are_near(angles, home)
        self.state = "ready" if is_home else "homing"

    def _are_near(self, one: np.ndarray, other: np.ndarray) -> bool:
        return bool(np.max(np.abs(one - other)) <= self._allowed["angles"].offset)

    def _follow(self, measurements: Mapping[str, Any]) -> None:
        """A step of the policy."""
        policy = self._policy
        measured = policy.check(measurements, dict.fromkeys((*policy.needs, "joint_angles")))
        if not self._is_fine(self._facts(measured)):
            return
        last = policy.step_number
        policy.step(measurements)
        self._idle = self._idle + 1 if policy.step_number == last else 0
        if self._idle:
            policy.motion.hold()
        target = paddle_pose(policy.metadata, policy.targets)[0]
        if not self._is_fine({"idle": self._idle, "target": target}):
            policy.motion.withdraw()

    def _window(self, angles: np.ndarray) -> dict[str, np.ndarray]:
        """The last angles and commands, with those of this control step."""
        now = [[angles], [self._policy.targets]]
        self._past = np.concatenate([self._past[:, 1:], now], axis=1)
        return {"angles": self._past[0], "commands": self._past[1]}

    def _facts(self, measured: Measurements) -> dict[str, Any]:
        """The facts of a running episode, for the rules."""
        angles, dt = measured["joint_angles"], self._policy.metadata.control_dt
        facts: dict[str, Any] = self._window(angles)
        facts["paddle"] = paddle_pose(self._policy.metadata, angles)[0]
        last = self._time
        self._time = float(measured["time"][0]) if "time" in measured else (last or 0.0) + dt
        if last is not None:
            self._time = max(self._time, last)
            facts["elapsed"] = self._time - last
        if "joint_velocities" in measured:
            facts["velocities"] = measured["joint_velocities"]
        if "ball_velocity" in measured:
            facts["ball_velocity"] = measured["ball_velocity"].reshape(-1, 3)
        if "ball_position" in measured:
            age = float(measured["ball_age"][0]) if "ball_age" in measured else None
            facts |= self._picture(measured["ball_position"].reshape(-1, 3), age, facts["paddle"])
        return facts

    def _picture(self, ball: np.ndarray, age: float | None, paddle: np.ndarray) -> dict[str, Any]:
        """The facts of the ball's newest picture [B, 3] and of the ones before."""
        if not self._pictures or np.any(ball != self._pictures[-1][0]):
            self._pictures = [*self._pictures[-EARLIER:], (ball, self._time - (age or 0.0))]
        seen = self._pictures
        # A ball in flight that does not move is an old picture, whatever its age is said to be.
        if age is None or np.max(ball[:, 2]) > paddle[2] + FLYING:
            age = max(self._time - seen[-1][1], age or 0.0)
        facts = {"ball": ball, "age": age, "earlier_ball": np.full(ball.shape, np.nan)}
        if len(seen) > EARLIER:
            facts["earlier_ball"] = seen[0][0]
        if len(seen) > 1:
            between = max(seen[-1][1] - seen[-2][1], self._policy.metadata.control_dt)
            facts["ball_motion"] = (ball - seen[-2][0]) / between
        return facts
