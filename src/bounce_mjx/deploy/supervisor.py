"""A supervisor between a policy and an arm."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from bounce_mjx.deploy.faults import Fault, Watch, picture_age
from bounce_mjx.deploy.motion import paddle_position
from bounce_mjx.deploy.samples import UnconfirmedSample, check_mapping
from bounce_mjx.errors import UserError

if TYPE_CHECKING:
    from bounce_mjx.deploy.policy import DeployedPolicy

State = Literal["homing", "ready", "running", "braking", "stopped"]
Box = tuple[Sequence[float], Sequence[float]]

_HOME_TOLERANCE = 2e-3
# On the way home, rad/s.
_HOME_SPEED = 0.3


class Supervisor:
    """Gives an arm's commands, and stops the arm when a measurement cannot be true
    (`deploy.samples`), when the arm does not follow, or the ball is lost (`deploy.faults`), or when
    the paddle would leave the box; `DeployedPolicy.supervise` creates it.

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
        self._policy = policy
        self._rate = rate
        metadata = policy.metadata
        age = picture_age(metadata) if max_picture_age is None else max_picture_age
        for name, value, most in (
            ("max_picture_age", age, 1.0),
            ("max_steps_late", max_steps_late, 1.0 / metadata.control_dt),
        ):
            if not 0.0 < value <= most:
                raise UserError(f"{name} is {value}; give a number above 0 and at most {most:g}")
        self._box = np.array(box, float)
        self._most_idle = max_steps_late
        if self._box.shape != (2, 3) or not np.all(self._box[0] < self._box[1]):
            raise UserError(f"the box is {box}; give its lowest and its highest x, y and z, m")
        self._has_box = bool(np.any(np.isfinite(self._box)))
        self._watch = Watch(metadata, age)
        self.state: State = "homing"
        self.fault: str | None = None
        """Code of the rule that was broken, such as `ball_lost`; `measurement` for a measurement
        that the policy refuses, `stopped` after `stop`."""
        self.reason: str | None = None
        """Why the arm has stopped or brakes, or what it waits for before it goes home."""
        self._is_moving_home = False

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
        self._watch.begin()
        self._idle = 0
        self.state = "running"

    def stop(self, reason: str, fault: str = "stopped") -> None:
        """Brakes, from any state."""
        if self.state not in ("braking", "stopped"):
            self.state = "braking"
            self.fault = fault
            self.reason = reason

    def restart(self) -> None:
        """Goes home after a stop, from where the arm then is, for the next `start`.

        Raises:
          UserError: the arm has not stopped.
        """
        if self.state != "stopped":
            raise UserError(f"the arm is {self.state}; restart it when it has stopped")
        self.state = "homing"
        self.fault = None
        self.reason = None
        self._is_moving_home = False
        self._policy.samples.forget(self._policy.targets)

    def commands(self, measurements: Mapping[str, Any]) -> np.ndarray:
        """Commands [M, J] of a control step at the robot's rate, rad; none ([0, J]) until a first
        sample is believed (`Samples`), so that nothing is sent.

        Args:
          measurements: as for `DeployedPolicy.step`. Before `start`, only the joint angles are
            needed, and none while the arm brakes and after. Without `time` no step is late, and
            without `ball_age` a picture is as old as the time since the ball's position last
            changed.

        Raises:
          UserError: the first joint angles are wrong, so that no command is known.
        """
        policy = self._policy
        try:
            if self.state == "running":
                self._follow(measurements)
            elif self.state in ("homing", "ready"):
                self._go_home(measurements)
            elif policy.targets is None:
                self._find_arm(measurements)
        except UserError as error:
            if policy.targets is None:
                raise
            self.stop(str(error), getattr(error, "fault", "measurement"))
        if policy.targets is None:
            return np.zeros((0, len(policy.metadata.joint_names)))
        if self.state in ("braking", "stopped"):
            policy.motion.hold()
            if self.state == "braking" and policy.motion.is_still:
                self.state = "stopped"
        return policy.commands(self._rate)

    def _angles(self, measurements: Mapping[str, Any]) -> np.ndarray:
        """The joint angles [J], whatever else is measured."""
        check_mapping(measurements)
        of_arm = {
            name: value for name, value in measurements.items() if name in ("joint_angles", "time")
        }
        return self._policy.read(of_arm, ("joint_angles",))["joint_angles"]

    def _find_arm(self, measurements: Mapping[str, Any]) -> np.ndarray | None:
        """The joint angles [J] from which the arm goes home, and at which its commands then rest;
        None before they are believed."""
        policy = self._policy
        try:
            angles = self._angles(measurements)
        except UnconfirmedSample as error:
            self.reason = str(error)
            return None
        # A small distance is the arm's load, and needs no step of the command.
        if policy.targets is None or not self._are_near(policy.targets, angles):
            policy.reset(angles)
        return angles

    def _stop_at(self, faults: Iterable[Fault]) -> bool:
        """Brakes at the first of the faults, and says whether there is one."""
        for code, reason in faults:
            self.stop(reason, code)
            return True
        return False

    def _go_home(self, measurements: Mapping[str, Any]) -> None:
        """A step of the way home."""
        policy = self._policy
        home = np.array(policy.metadata.default_joint_angles)
        if self._is_moving_home:
            angles = self._angles(measurements)
        else:
            angles = self._find_arm(measurements)
            if angles is None:
                if policy.targets is not None:
                    policy.motion.hold()
                return
            self._watch.rest(angles, policy.targets)
            self._is_moving_home = True
            self.reason = None
        is_bridged = policy.samples.is_arm_bridged
        if self._stop_at(self._watch.arm_faults(angles, policy.targets, is_bridged)):
            return
        if np.abs(policy.targets - home).max() > _HOME_TOLERANCE:
            policy.motion.move(home, _HOME_SPEED)
            return
        policy.motion.hold()
        is_home = policy.motion.is_still and self._are_near(angles, home)
        self.state = "ready" if is_home else "homing"

    def _are_near(self, one: np.ndarray, other: np.ndarray) -> bool:
        return bool(np.max(np.abs(one - other)) <= self._watch.offset)

    def _follow(self, measurements: Mapping[str, Any]) -> None:
        """A step of the policy."""
        policy = self._policy
        measured = policy.read(measurements, (*policy.needs, "joint_angles"))
        late = policy.steps_since(measured) - 1
        if late > self._most_idle:
            self.stop(f"a control step came {late} steps late", "late_step")
            return
        is_bridged = policy.samples.is_arm_bridged
        if self._stop_at(self._watch.faults(measured, policy.targets, is_bridged)):
            return
        last = policy.step_number
        policy.act(measured)
        self._idle = self._idle + 1 if policy.step_number == last else 0
        if self._idle:
            policy.motion.hold()
        outside = self._outside()
        if self._idle > self._most_idle:
            self.stop(f"{self._idle} calls in a row are no new step", "no_step")
        elif outside > 0.0:
            self.stop(f"the paddle would come to rest {outside:.3g} m outside the box", "box")
        else:
            return
        policy.motion.withdraw()

    def _outside(self) -> float:
        """How far the paddle would be outside of the box if the commands braked from the end of
        this control step, m."""
        if not self._has_box:
            return -math.inf
        path = paddle_position(self._policy.metadata, self._policy.motion.braking_path())
        return float(np.max([self._box[0] - path, path - self._box[1]]))
