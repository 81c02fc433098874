"""A supervisor between a policy and an arm."""

import math
import traceback
from collections.abc import Iterable, Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from bounce_mjx.deploy.faults import Fault, Watch, picture_age
from bounce_mjx.deploy.motion import paddle_position
from bounce_mjx.deploy.samples import Measurements, UnconfirmedSample, check_mapping
from bounce_mjx.errors import UserError
from bounce_mjx.robot.setpoints import Setpoint

if TYPE_CHECKING:
    from bounce_mjx.deploy.policy import DeployedPolicy

State = Literal["homing", "ready", "running", "braking", "stopped"]
Box = tuple[Sequence[float], Sequence[float]]

# Of the commands at home, rad.
_HOME_TOLERANCE = 2e-3
# On the way home, rad/s.
_HOME_SPEED = 0.3
_OTHER_ORDER = "the policy's joints have another order than the supervisor's; call supervise again"
_NEWER = "the policy has a newer supervisor; call that one"
_MOVED = "the policy was reset or stepped beside its supervisor; call the supervisor alone"
# Of an end of a box from the base, m.
_FARTHEST_END = 30.0
# In which an arm comes to rest where its commands do, s.
_SETTLING = 1.0


class Stop(NamedTuple):
    """Why an arm stops."""

    fault: str
    reason: str
    is_at_rest: bool = False
    """Whether the commands rest."""


class Supervisor:
    """Gives an arm's commands, and stops the arm when a measurement cannot be true
    (`deploy.samples`), when the arm does not follow, or the ball is lost (`deploy.faults`), when
    the paddle would leave the box, or when anything else fails; `DeployedPolicy.supervise` creates
    it.

    Call `commands` once each control step, in every state:

    - homing: the arm goes slowly to the policy's first posture, also back from a push, then it is
    - ready: it rests there until `start`;
    - running: it follows the policy, until a fault or `stop`;
    - braking: the commands slow down within the arm's limits, then it is
    - stopped: the commands rest, and `fault` and `reason` say why, until `restart`.

    Each commands begin where the last ones ended, whatever happens to the policy meanwhile. Once
    the policy has a newer supervisor, this one gives no commands.
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
        # Since the start of a control step, s.
        self._times = np.arange(1, policy.commands_per_step(rate) + 1) / rate
        self._policy = policy
        self._metadata = policy.metadata
        self._motion = policy.motion
        self._end: Setpoint | None = policy.motion.end
        self._has_begun = policy.motion.end is not None
        age = picture_age(self._metadata) if max_picture_age is None else max_picture_age
        for name, value, most in (
            ("max_picture_age", age, 1.0),
            ("max_steps_late", max_steps_late, 1.0 / self._metadata.control_dt),
        ):
            if not (isinstance(value, Real) and 0.0 < value <= most):
                raise UserError(f"{name} is {value!r}; give a number above 0 and at most {most:g}")
        try:
            self._box = np.array(box, float)
        except (TypeError, ValueError):
            self._box = np.zeros(0)
        self._max_steps_late = max_steps_late
        if self._box.shape != (2, 3) or not np.all(self._box[0] < self._box[1]):
            raise UserError(f"the box is {box}; give its lowest and its highest x, y and z, m")
        farthest = np.max(np.abs(self._box), where=np.isfinite(self._box), initial=0.0)
        if farthest > _FARTHEST_END:
            raise UserError(
                f"the box is {box}, and ends {farthest:g} from the base, but no arm reaches "
                f"{_FARTHEST_END:g} m; give metres, or inf for an end that is not there"
            )
        self._has_box = bool(np.any(np.isfinite(self._box)))
        self._watch = Watch(self._metadata, age)
        # A stop may come within any other call, from another thread or a signal handler: it is one
        # assignment, which `restart` alone takes back.
        self._stop: Stop | None = None
        self._phase: State = "homing"
        """The state unless there is a stop."""
        self._waits_for: str | None = None
        """Why the arm waits on its way home."""
        self._has_found_arm = False
        """Whether the arm has been measured where its commands rest; nothing is sent before, nor
        once a stopped arm is elsewhere."""
        self._is_moving_home = False
        self._waited = 0
        """Control steps in a row in which the arm was not where its commands rest."""
        self._idle = 0
        """Calls in a row that are no new control step."""
        self._due: float | None = None
        """Time at which the last step on the way home was due, s; None before it."""
        self._resting_angles = np.array(self._metadata.default_joint_angles)
        """Measured [J] in the last step at home, rad."""
        # An arm may rest at the last commands, far from the start pose.
        policy.samples.forget(policy.targets)

    @property
    def state(self) -> State:
        stop = self._stop
        if stop is None:
            return self._phase
        return "stopped" if stop.is_at_rest else "braking"

    @property
    def fault(self) -> str | None:
        """Code of the rule that was broken, such as `ball_lost`, of the tables in
        docs/real-robot.md; `stopped` after `stop`."""
        stop = self._stop
        return None if stop is None else stop.fault

    @property
    def reason(self) -> str | None:
        """Why the arm has stopped or brakes, or what it waits for on its way home."""
        stop = self._stop
        return self._waits_for if stop is None else stop.reason

    def start(self) -> None:
        """Starts an episode.

        Raises:
          UserError: the arm is not ready, or the policy is no longer this supervisor's.
        """
        self._check_policy()
        if self.state != "ready":
            raise UserError(
                f"the arm is {self.state}, and an episode starts when it is ready; call restart "
                "after a stop, and commands until the arm is home"
            )
        self._take_back()
        self._policy.reset(self._targets)
        # A load and the servo hold the arm a little beside its command.
        self._policy.samples.rest(self._resting_angles)
        self._end = self._motion.end
        self._watch.begin()
        self._idle = 0
        self._phase = "running"

    def stop(self, reason: str, fault: str = "stopped") -> None:
        """Brakes, from any state. It may be called at any time, also by another thread or a signal
        handler while `commands` works; the commands of the next control step brake, at the
        latest."""
        if self._stop is None:
            self._stop = Stop(fault, reason)

    def restart(self, moved: bool = False) -> None:
        """Goes home after a stop, for the next `start`. The commands go on where they rest, and
        nothing is sent until the arm is there.

        Args:
          moved: whether the arm was moved with its servos off. Its commands then begin anew where
            it is measured, as the first ones did.

        Raises:
          UserError: the arm has not stopped, or the policy is no longer this supervisor's.
        """
        self._check_policy()
        if self.state != "stopped":
            raise UserError(f"the arm is {self.state}; restart it when it has stopped")
        self._take_back()
        self._phase = "homing"
        self._waits_for = None
        # A stop from here on stays.
        self._stop = None
        self._is_moving_home = False
        self._has_found_arm = False
        self._waited = 0
        if moved:
            self._policy.reset()
            self._end = None
        else:
            self._policy.samples.forget(self._targets)

    def commands(self, measurements: Mapping[str, Any]) -> np.ndarray:
        """Commands [M, J] of a control step at the robot's rate, rad; none ([0, J]), so that
        nothing is sent, until a first sample is believed (`Samples`), and the arm is where
        `DeployedPolicy.reset` was told that it rests; after a `restart`, until it is where the
        commands rest; and once a stopped arm that had a second to settle is elsewhere.

        Args:
          measurements: as for `DeployedPolicy.step`. Before `start`, only the joint angles are
            needed, and none while the arm brakes; after that, the joint angles tell whether the
            stopped arm was moved. Without `time` no step is late, and
            without `ball_age` a picture is as old as the time since the ball's position last
            changed.

        Raises:
          Exception: anything fails before the supervisor has given a command, mostly a `UserError`,
            as the first joint angles are wrong. Afterwards nothing is raised, and the arm brakes.
        """
        if self._policy.supervisor is not self:
            self._stop = Stop("error", _NEWER, is_at_rest=True)
            return self._no_commands
        try:
            if self._has_other_order:
                self.stop(_OTHER_ORDER, "error")
            elif self._take_back():
                self.stop(_MOVED, "error")
            elif self.state == "running":
                self._follow(measurements)
            elif self.state in ("homing", "ready"):
                self._go_home(measurements)
            elif self.state == "stopped" and self._has_found_arm:
                self._has_found_arm = self._is_not_moved(measurements)
        except Exception as error:
            if not self._has_begun:
                raise
            self.stop(*_fault_of(error))
        stop = self._stop
        if self._targets is None:
            if stop is not None:
                self._stop = stop._replace(is_at_rest=True)
            return self._no_commands
        if stop is not None:
            if not stop.is_at_rest:
                self._waited = 0
            # What this step was to send is not sent.
            if self._end is not None:
                self._motion.end = self._end
            self._motion.hold()
            if self._motion.is_still:
                self._stop = stop._replace(is_at_rest=True)
        self._end = self._motion.end
        self._has_begun = True
        if not self._has_found_arm:
            return self._no_commands
        return self._motion.at(self._times)

    @property
    def _no_commands(self) -> np.ndarray:
        """An array [0, J], of which nothing is sent."""
        return np.zeros((0, len(self._metadata.joint_names)))

    @property
    def _targets(self) -> np.ndarray | None:
        """Commands [J] at the end of the last control step, rad; None before there is one."""
        if self._motion.end is None:
            return None
        return self._motion.at(np.array([self._metadata.control_dt]))[0]

    def _take_back(self) -> bool:
        """Lets the commands go on where the last ones ended, and says whether anything else has
        moved them since. Those of an arm that was moving go on with `hold`."""
        if self._motion.end is self._end:
            return False
        # Without a start, the commands are those of an arm that rests at the end.
        self._motion.start = None
        self._motion.end = self._end
        return True

    def _check_policy(self) -> None:
        """Raises UserError if the policy is no longer this supervisor's."""
        if self._policy.supervisor is not self:
            raise UserError(_NEWER)
        if self._has_other_order:
            raise UserError(_OTHER_ORDER)

    @property
    def _has_other_order(self) -> bool:
        """Whether the policy's joints have another order than when the supervisor began."""
        return self._policy.motion is not self._motion

    def _read_arm(self, measurements: Mapping[str, Any]) -> Measurements:
        """`joint_angles` [J] and, if it is given, `time` [1], whatever else is measured."""
        check_mapping(measurements)
        of_arm = {
            name: value for name, value in measurements.items() if name in ("joint_angles", "time")
        }
        return self._policy.read(of_arm, ("joint_angles",))

    def _find_arm(self, measurements: Mapping[str, Any]) -> Measurements | None:
        """What is measured (`_read_arm`) of the arm at rest, from which it goes home; None while
        that is not known. The first command is where the arm is; after a stop, the arm has to be
        where its commands rest."""
        policy = self._policy
        try:
            measured = self._read_arm(measurements)
        except UnconfirmedSample as error:
            self._waits_for = str(error)
            return None
        angles = measured["joint_angles"]
        if self._targets is None:
            policy.reset(angles)
            policy.samples.rest(angles)
            return measured
        return measured if self._rests(angles) else None

    def _is_not_moved(self, measurements: Mapping[str, Any]) -> bool:
        """Whether a stopped arm is where its commands rest, has had no time to settle, or is not
        measured."""
        self._waited += 1
        try:
            angles = self._policy.check(
                {"joint_angles": measurements["joint_angles"]}, ("joint_angles",)
            )["joint_angles"]
        except (UserError, KeyError, TypeError):
            return True
        if self._waited * self._metadata.control_dt <= _SETTLING:
            return True
        return bool(np.all(np.abs(angles - self._targets) <= self._watch.offset))

    def _rests(self, angles: np.ndarray) -> bool:
        """Whether the arm is where its commands rest. Else there is a reason for which it waits,
        and the arm is stopped when it has had time to settle."""
        beside = np.abs(angles - self._targets)
        joint = int(np.argmax(beside))
        if beside[joint] <= self._watch.offset:
            self._waited = 0
            self._waits_for = None
            return True
        self._waited += 1
        reason = (
            f"{self._metadata.joint_names[joint]} is {beside[joint]:.2g} rad from where its "
            "commands rest; check its load, its zero and the targets given to reset, or, if the "
            "arm was moved with its servos off, call restart(moved=True)"
        )
        if self._waited * self._metadata.control_dt > _SETTLING:
            self.stop(reason, "joint_astray")
        else:
            self._waits_for = reason
        return False

    def _stop_at(self, faults: Iterable[Fault]) -> bool:
        """Brakes at the first of the faults, and says whether there is one."""
        first = next(iter(faults), None)
        if first is None:
            return False
        code, reason = first
        self.stop(reason, code)
        return True

    def _go_home(self, measurements: Mapping[str, Any]) -> None:
        """A step of the way home."""
        policy = self._policy
        home = np.array(self._metadata.default_joint_angles)
        if self._is_moving_home:
            measured = self._read_arm(measurements)
        else:
            measured = self._find_arm(measurements)
            if measured is None:
                if self._targets is not None:
                    self._motion.hold()
                return
            self._watch.rest(measured["joint_angles"], self._targets)
            self._idle = 0
            self._due = None
            self._has_found_arm = True
            self._is_moving_home = True
            self._waits_for = None
        # Each call moves the commands for a whole control step, so that those of one share its way.
        speed = _HOME_SPEED / (1 + self._idle)
        if not self._is_new_step(self._steps_since_due(measured)):
            return
        angles = measured["joint_angles"]
        is_bridged = policy.samples.is_arm_bridged
        if self._stop_at(self._watch.arm_faults(angles, self._targets, is_bridged)):
            return
        if np.abs(self._targets - home).max() > _HOME_TOLERANCE:
            self._motion.move(home, speed)
            # An arm that starts outside of the box may come in.
            if self._outside(self._motion.start.position) <= 0.0:
                self._keep_in_box()
            return
        self._motion.hold()
        self._resting_angles = angles
        if not self._motion.is_still:
            return
        if self._rests(angles):
            self._phase = "ready"
        else:
            self._phase = "homing"

    def _follow(self, measurements: Mapping[str, Any]) -> None:
        """A step of the policy."""
        policy = self._policy
        # Of a policy that does not see them, the arm needs the angles all the same.
        needs = dict.fromkeys((*policy.needs, "joint_angles"))
        measured = policy.read(measurements, tuple(needs))
        steps = policy.steps_since(measured)
        late = steps - 1
        if late > self._max_steps_late:
            self.stop(f"a control step came {late} steps late", "late_step")
            return
        is_bridged = policy.samples.is_arm_bridged
        if self._stop_at(self._watch.faults(measured, self._targets, is_bridged)):
            return
        if self._is_new_step(steps):
            policy.act(measured)
        self._keep_in_box()

    def _steps_since_due(self, measured: Measurements) -> int:
        """Control steps since the last one on the way home, rounded as those of the policy."""
        if "time" not in measured:
            return 1
        time = float(measured["time"][0])
        if self._due is None:
            self._due = time
            return 1
        dt = self._metadata.control_dt
        steps = max(0, round((time - self._due) / dt))
        self._due += steps * dt
        return steps

    def _is_new_step(self, steps: int) -> bool:
        """Whether a call is a new control step: some steps after the last one. In a call that is
        none the commands brake, and after too many in a row the arm stops."""
        if steps > 0:
            self._idle = 0
            return True
        self._idle += 1
        self._motion.hold()
        if self._idle > self._max_steps_late:
            self.stop(f"{self._idle} calls in a row are no new step", "no_step")
        return False

    def _keep_in_box(self) -> None:
        """Brakes if the paddle would leave the box when the commands braked from the end of this
        control step."""
        outside = self._outside(self._motion.braking_path())
        if outside > 0.0:
            self.stop(f"the paddle would come to rest {outside:.3g} m outside the box", "box")

    def _outside(self, joint_angles: np.ndarray) -> float:
        """How far the paddle is outside of the box at one of the joint angles [..., J], m; negative
        inside."""
        if not self._has_box:
            return -math.inf
        paddle = paddle_position(self._metadata, joint_angles)
        return float(np.max([self._box[0] - paddle, paddle - self._box[1]]))


def _fault_of(error: Exception) -> tuple[str, str]:
    """Reason and code of an exception in a control step."""
    if isinstance(error, UserError):
        return str(error), getattr(error, "fault", "measurement")
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"the program failed: {error!r} ({Path(place.filename).name}:{place.lineno})", "error"
