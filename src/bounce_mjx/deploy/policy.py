"""A trained policy on a robot: measurements in, actions out, with only NumPy and onnxruntime."""

from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any

import numpy as np

from bounce_mjx.deploy.controller import Controller
from bounce_mjx.deploy.driver import LARGEST, Driver
from bounce_mjx.deploy.metadata import Metadata, measurement_sizes
from bounce_mjx.deploy.motion import Course
from bounce_mjx.deploy.network import OnnxNetwork
from bounce_mjx.deploy.samples import Measurements
from bounce_mjx.deploy.supervisor import Supervisor
from bounce_mjx.errors import MissingPackage, UserError

# What a network may need to be measured, beside the goals; the rest has a default, or is looked
# at by a supervisor alone.
_MEASURED = (
    "joint_angles",
    "joint_velocities",
    "ball_position",
    "ball_velocity",
    "ball_age",
)


class DeployedPolicy:
    """A policy with its memory; `load_policy` creates it.

    Call `reset` before each ball and `step` once each control step; under a supervisor, its `start`
    and `commands` do both. Positions are in the robot's frame: x forward, z upward, the floor at
    z = 0.
    """

    def __init__(self, model: bytes, source: str):
        """Loads an ONNX file.

        Args:
          model: content of the file.
          source: name of the file, for messages.

        Raises:
          UserError: the file is not a policy from `bounce-mjx export`, or onnxruntime is missing.
        """
        try:
            self._network = OnnxNetwork(model)
            self._use(Driver(self._network.metadata, self._needs()))
            # A network that fails or gives no numbers fails here, and not on the robot.
            memory = self.controller.begin()
            trial = self._trial()
            for _ in range(2):
                memory, _ = self.controller.step(memory, trial)
        except MissingPackage:
            raise
        # onnxruntime raises exceptions of many types for a damaged file.
        except Exception as error:
            reason = (str(error).strip().splitlines() or [repr(error)])[0][:200]
            raise UserError(
                f"{source} is not a policy of this version of the package ({reason}); give a file "
                "that bounce-mjx export wrote"
            ) from error

    def _trial(self) -> Measurements:
        """A sample that every policy accepts."""
        metadata = self._network.metadata
        trial = {name: np.zeros(size) for name, size in measurement_sizes(metadata).items()}
        trial |= {name: np.array([c.range[0]]) for name, c in metadata.goals.items()}
        # Each is a control step after the last one.
        del trial["time"]
        return trial | {"joint_angles": np.array(metadata.default_joint_angles)}

    def _use(self, driver: Driver) -> None:
        """Reads and commands the joints by a driver from now on, and forgets the past."""
        self.driver = driver
        """The names and the order in which measurements come."""
        self.controller = Controller(self._network, driver.policy_metadata)
        """The policy as a function of a memory, with the joints in its own order."""
        self._memory = self.controller.begin()

    @property
    def metadata(self) -> Metadata:
        """What the file says, with the joints in the driver's order."""
        return self.driver.metadata

    @property
    def needs(self) -> tuple[str, ...]:
        """Measurements required in every step."""
        return self.driver.needs

    @property
    def units(self) -> dict[str, str]:
        """Measurements that a step accepts, and their units."""
        return self.driver.units

    def use_joints(self, names: Sequence[str] | Mapping[str, str]) -> None:
        """Takes and gives the joints in a driver's order from now on, and resets the policy.

        Args:
          names: as `joint_names` of `load_policy`, which calls it.

        Raises:
          UserError: they are not those of the policy's robot.
        """
        self._use(Driver(self._network.metadata, self.needs, names))

    def use_observations(self, places: Mapping[str, slice], size: int) -> None:
        """Lets a step take observations of an environment in place of measurements.

        Args:
          places: entries of each quantity's newest value in an observation.
          size: length of an observation.

        Raises:
          UserError: an observation lacks a measurement that the policy needs.
        """
        self.driver.use_observations(places, size)

    def reset(self, targets: np.ndarray | None = None) -> None:
        """Forgets the past. The next step fills the whole history with its measurements.

        Args:
          targets: servo targets [J] (rad) at which the arm rests, and from which the next command
            moves; by default, the joint angles of the next step, near the start pose.

        Raises:
          UserError: the targets are not J finite numbers, or 0.5 rad outside the joint ranges;
            nothing is forgotten.
        """
        self._memory = self.controller.begin(self._resting(targets))

    def _resting(self, targets: np.ndarray | None) -> np.ndarray | None:
        """Targets [J] at which an arm is said to rest, in the policy's order."""
        if targets is None:
            return None
        values = self.driver.read_joints("the targets", targets, "rad", LARGEST)
        self.controller.samples.check_range("target", values)
        return values

    def step(self, measurements: Mapping[str, Any] | np.ndarray) -> np.ndarray:
        """Action of a control step.

        Args:
          measurements: `joint_angles` [J] (rad) and `joint_velocities` [J] (rad/s) in the order of
            `metadata.joint_names`; from the newest picture of the ball `ball_position` [3] (m),
            `ball_velocity` [3] (m/s), `ball_age` (time since the picture was taken, s),
            `ball_quaternion` [4] (w, x, y, z; default 1, 0, 0, 0) and `ball_angular_velocity` [3]
            (rad/s; default 0); each goal in `metadata.goals`; `time` of any clock (s). The
            measurements in `needs` are required. Without `time`, a step is one control step after
            the last one. Of several balls (`metadata.num_balls`), each quantity has one row per
            ball [B, 3], or the rows one after another. A supervisor also looks at `joint_targets`
            [J] (rad), the controller's own, and at `tool_position` [3] (m) and `tool_normal` [3],
            the paddle's centre and upper normal by its kinematics.

            With `time`, a call may come at any rate: the time since the first step is rounded to
            control steps. A call whose step is not a new one returns the last action, and its
            sample is only one to compare the next with. A call several control steps late fills the
            missed steps with interpolated measurements and the last action.

            A sample that cannot be true is bridged (`Samples`): the last one holds.

            With an environment (`load_policy(..., env=env)`), its observation [N].

        Returns:
          Action [J], from -1 to 1; `servo_targets` converts it.

        Raises:
          UserError: a required measurement is missing; a measurement is unknown, has the wrong
            shape, is not finite, or is what no world of the training can hold, mostly in another
            unit or frame; more than a third of the last 0.1 s, or the first sample, cannot be
            true; or the time is 1 s or more from the last; or the network gives no finite action.
            Nothing changes then, as if the call had not been.
        """
        measured = self.driver.check(measurements)
        self._memory, action = self.controller.step(self._memory, measured)
        return self.driver.to_driver(action).copy()

    @property
    def step_number(self) -> int:
        """Number of the last step, from 0; -1 before the first one."""
        return self._memory.seen.clock.step

    def servo_targets(self, action: np.ndarray) -> np.ndarray:
        """Takes an action [J] for the last step's: its servo targets [J] (rad). They are the joint
        angles measured in that step plus the scaled action, clipped to `metadata.largest_step` from
        the last targets and to the joint ranges. With `metadata.max_lead`, the action adds to the
        last targets, within that distance of the measured angles. With `metadata.limits`, they are
        the last of the `commands`. Of another action than the policy's, the next step knows the
        targets, but has the policy's own as its past action.

        Raises:
          UserError: there was no step since the reset, or it had no measured joint angles; or the
            action is not J numbers from -1 to 1.
        """
        memory = self._memory
        if "joint_angles" not in memory.measured:
            raise UserError(
                "the servo targets start from the measured joint angles, and there are none; call "
                "step with joint_angles first"
            )
        values = self.driver.read_joints("the action", action, "from -1 to 1", 1.0)
        # The control step begins where it did for the policy's own action.
        before = Course(end=memory.course.start)
        course = self.controller.course_of(before, memory.measured["joint_angles"], values)
        self._memory = memory._replace(course=course)
        return self.targets

    def commands(self, rate: float) -> np.ndarray:
        """Commands [M, J] (rad) of the control step at a rate (Hz): the servo targets for the times
        1 / rate, 2 / rate, ... until the next step. With `metadata.limits` they move within these
        limits, else they are alike.

        Raises:
          UserError: there was no step since the reset; or the rate is not 1 to 10,000 commands in a
            control step.
        """
        if self._memory.course is None:
            raise UserError("there are no commands before the first step; call step first")
        times = np.arange(1, self.commands_per_step(rate) + 1) / rate
        return self.driver.to_driver(self.controller.motion.at(self._memory.course, times))

    def commands_per_step(self, rate: float) -> int:
        """Number of `commands` of a control step at a rate (Hz); UserError as there."""
        dt = self.metadata.control_dt
        count = rate * dt if isinstance(rate, Real) else 0.0
        if not (0.999 < count < 10_000.5 and abs(count - round(count)) < 1e-3):
            raise UserError(
                f"the rate is {rate!r} Hz, but must be a multiple of {1.0 / dt:g} Hz, one command "
                "for each control step"
            )
        return round(count)

    @property
    def targets(self) -> np.ndarray | None:
        """Servo targets [J] at the end of the control step, rad; None before the first step."""
        if self._memory.course is None:
            return None
        return self.driver.to_driver(self.controller.motion.target(self._memory.course))

    def supervise(self, rate: float, **settings: Any) -> Supervisor:
        """A supervisor that gives the commands of this policy at the robot's rate (Hz). It has a
        memory of its own, which begins at the targets that the policy has now (`reset`).

        Args:
          settings: `box`, the lowest and the highest x, y and z of the paddle's centre, m (each
            infinite, or at most 30 from the base);
            `max_picture_age`, s (at most 1; by default the file's largest latency and five of its
            longest camera intervals, at least 0.1); `max_steps_late`, control steps that one may
            come late (2).

        Raises:
          UserError: the rate is not a multiple of the policy's, or a setting is wrong.
        """
        # Since the start of a control step, s.
        times = np.arange(1, self.commands_per_step(rate) + 1) / rate
        course = self._memory.course
        rests_at = None if course is None else self.controller.motion.target(course)
        return Supervisor(self.controller, self.driver, times, rests_at, **settings)

    @property
    def observation(self) -> np.ndarray:
        """Inputs of the network at the last step in one vector, with the newest value of each
        quantity first; empty before the first step."""
        return self._network.observation(self._memory.history)

    def _needs(self) -> tuple[str, ...]:
        """The measurements of which the network's inputs are made, but those with a default."""
        reads = self._network.reads
        metadata = self._network.metadata
        names = (*_MEASURED, *metadata.goals)
        inputs_of = {name: {name} for name in names}
        inputs_of["joint_angles"] |= {"paddle_position", "servo_lead"}
        inputs_of["ball_position"].add("ball_picture")
        if metadata.velocity != "measured":
            inputs_of["ball_position"] |= inputs_of.pop("ball_velocity")
        return tuple(name for name, inputs in inputs_of.items() if inputs & reads)
