"""A supervisor between a policy and an arm."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from bounce_mjx.deploy.chain import Chain
from bounce_mjx.deploy.histories import Measurements
from bounce_mjx.errors import UserError

if TYPE_CHECKING:
    from bounce_mjx.deploy.policy import DeployedPolicy

State = Literal["homing", "ready", "running", "braking", "stopped"]
Box = tuple[Sequence[float], Sequence[float]]

# Of a joint, for a policy without limits: the training ends an episode there, rad/s.
_FASTEST = 6.283
_HOME_TOLERANCE = 2e-3
# Below the paddle, a ball is lost, m.
_LOST = 0.1


class Supervisor:
    """Gives an arm's commands, and stops the arm when a measurement or a command is wrong;
    `DeployedPolicy.supervise` creates it.

    Call `commands` once each control step, in every state:

    - homing: the arm goes slowly to the policy's first posture, then it is
    - ready: it rests there until `start`;
    - running: it follows the policy, until a fault or `stop`;
    - braking: the commands slow down within the arm's limits, then it is
    - stopped: it rests, and `reason` says why, until `restart`.
    """

    def __init__(
        self,
        policy: "DeployedPolicy",
        rate: float,
        box: Box | None = None,
        max_picture_age: float = 0.1,
        max_steps_late: float = 2.0,
        max_error: float = 0.4,
        home_speed: float = 0.3,
    ):
        """See `DeployedPolicy.supervise`."""
        self._policy, self._rate = policy, rate
        self._box = None if box is None else np.array(box, float)
        if self._box is not None and (
            self._box.shape != (2, 3) or np.any(np.diff(self._box, axis=0) <= 0.0)
        ):
            raise UserError(f"the box is {box}; give its lowest and its highest x, y and z, m")
        self._max_age, self._max_late = max_picture_age, max_steps_late
        self._max_error, self._home_speed = max_error, home_speed
        self._chain = Chain(policy.metadata)
        limits = policy.metadata.limits
        self._fastest = _FASTEST if limits is None else 1.2 * np.array(limits.velocity)
        self.state: State = "homing"
        self.reason: str | None = None
        """Why the arm has stopped or brakes."""
        self._time: float | None = None
        self._picture: np.ndarray | None = None
        self._pictured = 0.0

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
        self._time = self._picture = None
        self.state = "running"

    def stop(self, reason: str) -> None:
        """Brakes, from any state."""
        if self.state not in ("braking", "stopped"):
            self.state, self.reason = "braking", reason

    def restart(self) -> None:
        """Goes home after a stop, such as a loss of the ball, for the next `start`.

        Raises:
          UserError: the arm has not stopped.
        """
        if self.state != "stopped":
            raise UserError(f"the arm is {self.state}; restart it when it has stopped")
        self.state, self.reason = "homing", None

    def commands(self, measurements: Mapping[str, Any]) -> np.ndarray:
        """Commands [M, J] of a control step at the robot's rate, rad.

        Args:
          measurements: as for `DeployedPolicy.step`. Without `time` no step is late, and without
            `ball_age` a picture is as old as the time since the ball's position last changed.

        Raises:
          UserError: the first joint angles are wrong, so that no command is known.
        """
        policy = self._policy
        if self.state == "running":
            fault = self._step(measurements)
            if fault is None:
                return policy.commands(self._rate)
            self.stop(fault)
        angles = None
        if policy.targets is None:
            # Only the first command starts from the measured angles; no camera is needed for it.
            given = {k: v for k, v in measurements.items() if k == "joint_angles"}
            angles = policy.checked(given, ("joint_angles",))["joint_angles"]
        if self.state == "homing":
            self._go_home(angles)
        else:
            policy.hold(angles)
            if self.state == "braking" and policy.is_still:
                self.state = "stopped"
        return policy.commands(self._rate)

    def _step(self, measurements: Mapping[str, Any]) -> str | None:
        """A step of the policy; what is wrong with it, if anything is."""
        try:
            measured = self._policy.checked(measurements)
            fault = self._fault(measured)
            if fault is None:
                self._policy.step(measurements)
                fault = self._wrong_target()
        except UserError as error:
            fault = str(error)
        return fault

    def _go_home(self, angles: np.ndarray | None) -> None:
        policy = self._policy
        home = np.array(policy.metadata.default_joint_angles)
        at = angles if policy.targets is None else policy.targets
        if np.abs(at - home).max() > _HOME_TOLERANCE:
            policy.move(home, self._home_speed, angles)
            return
        policy.hold(angles)
        if policy.is_still:
            self.state = "ready"

    def _fault(self, measured: Measurements) -> str | None:
        """What is wrong with the measurements of a running episode."""
        control_dt = self._policy.metadata.control_dt
        time = float(measured["time"][0]) if "time" in measured else None
        last, self._time = self._time, time
        if time is not None and last is not None and time - last > self._max_late * control_dt:
            return f"a control step came after {1e3 * (time - last):.0f} ms"
        if "ball_position" in measured:
            ball = measured["ball_position"]
            if self._picture is None or np.any(ball != self._picture):
                self._picture, self._pictured = ball, 0.0
            else:
                self._pictured += control_dt if None in (time, last) else time - last
            age = float(measured["ball_age"][0]) if "ball_age" in measured else self._pictured
            if age > self._max_age:
                return f"the picture of the ball is {1e3 * age:.0f} ms old"
        angles, speeds = measured.get("joint_angles"), measured.get("joint_velocities")
        if angles is not None:
            paddle, _ = self._chain.paddle(angles)
            if "ball_position" in measured:
                lowest = np.min(measured["ball_position"].reshape(-1, 3)[:, 2])
                if lowest < paddle[2] - _LOST:
                    return "the ball is lost"
            if np.abs(self._policy.targets - angles).max() > self._max_error:
                return f"a joint is more than {self._max_error:g} rad behind its command"
        if speeds is not None and np.any(np.abs(speeds) > self._fastest):
            return f"a joint has {np.abs(speeds).max():.3g} rad/s"
        return None

    def _wrong_target(self) -> str | None:
        """What is wrong with the command at the end of the control step."""
        if self._box is None:
            return None
        paddle, _ = self._chain.paddle(self._policy.targets)
        if np.any(paddle < self._box[0]) or np.any(paddle > self._box[1]):
            place = ", ".join(f"{x:.3f}" for x in paddle)
            return f"the command would bring the paddle to ({place}) m, outside the box"
        return None
