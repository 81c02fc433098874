"""A trained policy on a robot: measurements in, actions out, with only NumPy and onnxruntime."""

from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any

import numpy as np

from bounce_mjx.deploy.metadata import (
    PER_BALL,
    UNITS,
    Metadata,
    in_driver_order,
    measurement_sizes,
)
from bounce_mjx.deploy.motion import Motion
from bounce_mjx.deploy.network import OnnxNetwork
from bounce_mjx.deploy.samples import PAUSE, ImpossibleMeasurement, Measurements, Samples
from bounce_mjx.deploy.supervisor import Supervisor
from bounce_mjx.errors import MissingPackage, UserError

# Measurements and times beyond them are not of a robot.
_LARGEST = 1e6
_LARGEST_TIME = 1e15
# A command that is farther outside its range than the range is long, and than this (in its unit),
# is in another unit.
_ROOM = 0.5
# Two values of a command that are one.
_SAME_COMMAND = 1e-6
# Resolution of a time as a share of a control step.
_FINE = 0.25


class DeployedPolicy:
    """A policy with the histories of its inputs; `load_policy` creates it.

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
            self.metadata: Metadata = self._network.metadata
            commands = self.metadata.commands.items()
            self.units = UNITS | {name: c.unit or "no unit" for name, c in commands}
            """Measurements that a step accepts, and their units."""
            self.motion = Motion(self.metadata)
            """Commands of the joints; a `Supervisor` also moves them without the policy."""
            self.samples = Samples(self.metadata)
            """What a robot may have measured: each sample, compared with the last one."""
            self.supervisor: Supervisor | None = None
            """The one that gives the policy's commands: the last that `supervise` made."""
            self._sizes = measurement_sizes(self.metadata)
            balls = self.metadata.num_balls
            self._defaults = {
                "ball_quaternion": np.tile([1.0, 0.0, 0.0, 0.0], balls),
                "ball_angular_velocity": np.zeros(3 * balls),
            }
            self._places: dict[str, slice] = {}
            self._observation_size = 0
            self.needs = self._needs()
            """Measurements required in every step."""
            # A network that fails or gives no numbers fails here, and not on the robot.
            self.reset()
            trial = {name: np.zeros(size) for name, size in self._sizes.items()}
            trial |= {name: c.range[0] for name, c in commands}
            trial["joint_angles"] = self.metadata.default_joint_angles
            for _ in range(2):
                self.step({name: trial[name] for name in self.needs})
        except MissingPackage:
            raise
        # onnxruntime raises exceptions of many types for a damaged file.
        except Exception as error:
            reason = (str(error).strip().splitlines() or [repr(error)])[0][:200]
            raise UserError(
                f"{source} is not a policy of this version of the package ({reason}); give a file "
                "that bounce-mjx export wrote"
            ) from error
        self.reset()

    def use_joints(self, names: Sequence[str] | Mapping[str, str]) -> None:
        """Takes and gives the joints in a driver's order from now on, and resets the policy. Call
        it before `supervise`.

        Args:
          names: as `joint_names` of `load_policy`, which calls it.

        Raises:
          UserError: they are not those of the policy's robot.
        """
        order = _joint_order(names, self._network.metadata)
        self._network.use_order(order)
        self.metadata = in_driver_order(self._network.metadata, tuple(names), order)
        self.motion = Motion(self.metadata)
        self.samples = Samples(self.metadata)
        self.reset()

    def use_observations(self, places: Mapping[str, slice], size: int) -> None:
        """Lets a step take observations of an environment in place of measurements.

        Args:
          places: entries of each quantity's newest value in an observation.
          size: length of an observation.

        Raises:
          UserError: an observation lacks a measurement that the policy needs.
        """
        if missing := [name for name in self.needs if name not in places]:
            raise UserError(
                f"an observation has no {', '.join(missing)}, which this policy measures; use "
                "Run(...).policy_in(env)"
            )
        self._places = dict(places)
        self._observation_size = size

    def reset(self, targets: np.ndarray | None = None) -> None:
        """Forgets the past. The next step fills the whole history with its measurements.

        Args:
          targets: servo targets [J] (rad) at which the arm rests, and from which the next command
            moves, wherever the arm is measured; by default, the joint angles of the next step.

        Raises:
          UserError: the targets are not J finite numbers, or 0.5 rad outside the joint ranges;
            nothing is forgotten.
        """
        count = len(self.metadata.joint_names)
        if targets is not None:
            targets = _array("the targets", targets, count, "rad", _LARGEST)
            self.samples.check_range("target", targets)
        self._network.reset()
        self.samples.forget(targets)
        self._measured: Measurements = {}
        self._first: float | None = None
        self.step_number = -1
        """Number of the last step, from 0; -1 before the first one."""
        self._action = np.zeros(count)
        self.motion.rest(targets)

    def step(self, measurements: Mapping[str, Any] | np.ndarray) -> np.ndarray:
        """Action of a control step.

        Args:
          measurements: `joint_angles` [J] (rad) and `joint_velocities` [J] (rad/s) in the order of
            `metadata.joint_names`; from the newest picture of the ball `ball_position` [3] (m),
            `ball_velocity` [3] (m/s), `ball_age` (time since the picture was taken, s),
            `ball_quaternion` [4] (w, x, y, z; default 1, 0, 0, 0) and `ball_angular_velocity` [3]
            (rad/s; default 0); each command in `metadata.commands`; `time` of any clock (s). The
            measurements in `needs` are required. Without `time`, a step is one control step after
            the last one. Of several balls (`metadata.num_balls`), each quantity has one row per
            ball [B, 3], or the rows one after another.

            With `time`, a call may come at any rate: the time since the first step is rounded to
            control steps. A call whose step is not a new one returns the last action, and its
            sample is only one to compare the next with. A call several control steps late fills the
            missed steps with interpolated measurements and the last action.

            One sample that cannot be true is bridged (`Samples`): the last one holds.

            With an environment (`load_policy(..., env=env)`), its observation [N].

        Returns:
          Action [J], from -1 to 1; `servo_targets` converts it.

        Raises:
          UserError: a required measurement is missing; a measurement is unknown, has the wrong
            shape, is not finite, or is what no world of the training can hold, mostly in another
            unit or frame; the second sample in a row, or the first one, cannot be true; or the
            time is 1 s or more from the last. What the network has seen does not change, nor the
            command. Or the network gives no finite action; then call `reset`.
        """
        return self.act(self.read(measurements))

    def read(
        self, measurements: Mapping[str, Any], needs: Sequence[str] | None = None
    ) -> Measurements:
        """The measurements of a sample as arrays, with the last ones in place of those that cannot
        be true.

        Args:
          needs: those that may not be missing; by default, `needs`.

        Raises:
          UserError: as `step`.
        """
        return self.samples.take(self.check(measurements, needs))

    def act(self, measured: Measurements) -> np.ndarray:
        """The action of `step` for the measurements of `read`."""
        steps = self.steps_since(measured)
        if steps == 0:
            return self._action.copy()
        angles = measured.get("joint_angles")
        if angles is not None and self.metadata.max_lead is not None:
            last = angles if self.motion.end is None else self.motion.end.position
            measured = measured | {"servo_lead": last - angles}
        # In the missed steps the robot went on with the last action.
        for left in reversed(range(steps)):
            between = {}
            for name, value in measured.items():
                earlier = self._measured.get(name, value)
                between[name] = value + left / steps * (earlier - value) if left else value
            action = self._network.step(between, self._action)
        self._measured = measured
        self._action = action
        self.step_number += steps
        if self._first is None and "time" in measured:
            self._first = float(measured["time"][0]) - self.step_number * self.metadata.control_dt
        if angles is not None:
            self.motion.begin(angles)
            self._act(action)
        return self._action.copy()

    def servo_targets(self, action: np.ndarray) -> np.ndarray:
        """Sends an action [J] in the last step: its servo targets [J] (rad). They are the joint
        angles measured in that step plus the scaled action, clipped to `metadata.largest_step` from
        the last targets and to the joint ranges. With `metadata.max_lead`, the action adds to the
        last targets, within that distance of the measured angles. With `metadata.limits`, they are
        the last of the `commands`. Of another action than the policy's, the next step knows the
        targets, but has the policy's own as its past action.

        Raises:
          UserError: there was no step since the reset, or it had no measured joint angles; or the
            action is not J numbers from -1 to 1.
        """
        if "joint_angles" not in self._measured:
            raise UserError(
                "the servo targets start from the measured joint angles, and there are none; call "
                "step with joint_angles first"
            )
        self._act(_array("the action", action, len(self._action), "from -1 to 1", 1.0))
        return self.targets

    def commands(self, rate: float) -> np.ndarray:
        """Commands [M, J] (rad) of the control step at a rate (Hz): the servo targets for the times
        1 / rate, 2 / rate, ... until the next step. With `metadata.limits` they move within these
        limits, else they are alike.

        Raises:
          UserError: there was no step since the reset; or the rate is not 1 to 10,000 commands in a
            control step.
        """
        if self.targets is None:
            raise UserError("there are no commands before the first step; call step first")
        return self.motion.at(np.arange(1, self.commands_per_step(rate) + 1) / rate)

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
        if self.motion.end is None:
            return None
        return self.motion.at(np.array([self.metadata.control_dt]))[0]

    def supervise(self, rate: float, **settings: Any) -> Supervisor:
        """A supervisor that gives the commands of this policy at the robot's rate (Hz), in place of
        an earlier one.

        Args:
          settings: `box`, the lowest and the highest x, y and z of the paddle's centre, m (each
            infinite, or at most 30 from the base);
            `max_picture_age`, s (at most 1; by default the file's largest latency and five of its
            longest camera intervals, at least 0.1); `max_steps_late`, control steps between two
            steps, and calls in a row without a new step (2).

        Raises:
          UserError: the rate is not a multiple of the policy's, or a setting is wrong; or the arm
            of an earlier supervisor has not stopped, and the policy was not reset since.
        """
        earlier = self.supervisor
        # After a reset there are no commands that could go on.
        if earlier is not None and earlier.state != "stopped" and self.motion.end is not None:
            raise UserError(
                f"the policy has a supervisor, whose arm is {earlier.state}; stop it, and call its "
                "commands until it has stopped; or, if nothing moves the arm any more, reset the "
                "policy"
            )
        self.supervisor = Supervisor(self, rate, **settings)
        return self.supervisor

    def _act(self, action: np.ndarray) -> None:
        """Aims the commands of the control step at the targets of an action [J]."""
        base = self._measured["joint_angles"]
        lead = self.metadata.max_lead
        if lead is not None:
            base = np.clip(self.motion.start.position, base - lead, base + lead)
        self.motion.aim(base + self.metadata.action_scale * action)

    @property
    def observation(self) -> np.ndarray:
        """Inputs of the network at the last step in one vector, with the newest value of each
        quantity first; empty before the first step."""
        return self._network.observation

    def _needs(self) -> tuple[str, ...]:
        """The measurements of which the network's inputs are made, but those with a default."""
        reads = self._network.reads
        optional = ("ball_quaternion", "ball_angular_velocity")
        inputs_of = {name: {name} for name in self.units if name not in optional}
        inputs_of["joint_angles"] |= {"paddle_position", "servo_lead"}
        inputs_of["ball_position"].add("ball_picture")
        if self.metadata.velocity != "measured":
            inputs_of["ball_position"] |= inputs_of.pop("ball_velocity")
        return tuple(name for name, inputs in inputs_of.items() if inputs & reads)

    def check(
        self, measurements: Mapping[str, Any], needs: Sequence[str] | None = None
    ) -> Measurements:
        """Copies of the measurements as arrays, with defaults for optional ones.

        Here what is no measurement at all is refused, at once; `Samples.take` bridges what is one,
        but cannot be true.

        Args:
          needs: as for `read`.

        Raises:
          UserError: they have no names; or one is missing, unknown, of another shape, not finite,
            or a command in another unit.
        """
        if not isinstance(measurements, Mapping):
            measurements = self._in_observation(measurements)
        for name in self.needs if needs is None else needs:
            if name not in measurements:
                raise UserError(
                    f"the measurement {name} is missing; this policy needs "
                    f"{', '.join(self.needs if needs is None else needs)} in every step"
                )
        checked = dict(self._defaults)
        for name, value in measurements.items():
            if name not in self.units:
                raise UserError(
                    f"{name} is not a measurement; a step takes {', '.join(self.units)}"
                )
            limit = _LARGEST_TIME if name == "time" else _LARGEST
            rows = self.metadata.num_balls if name in PER_BALL else 1
            label = "the measurement " + name
            checked[name] = _array(label, value, self._sizes[name], self.units[name], limit, rows)
        if self.metadata.velocity != "measured":
            checked.pop("ball_velocity", None)
        for name, (ends, unit) in self.metadata.commands.items():
            if name in checked:
                _check_command(name, float(checked[name][0]), ends, unit or "no unit")
        if "time" in measurements:
            self._check_resolution(measurements["time"])
        return checked

    def _in_observation(self, observation: Any) -> dict[str, Any]:
        """The newest measurements in an observation.

        Raises:
          UserError: the policy was loaded without the environment; or there is not one observation.
        """
        if not self._places:
            raise UserError(
                f"a step got {type(observation).__name__}, and takes measurements by name; for an "
                "environment's observations, load_policy(..., env=env)"
            )
        array = np.asarray(observation)
        if array.shape != (self._observation_size,):
            raise UserError(
                f"the observation has the shape {list(array.shape)}, but must have "
                f"{[self._observation_size]}; for many at once, use Run(...).policy_in(env)"
            )
        return {name: array[self._places[name]] for name in self.needs}

    def _check_resolution(self, time: Any) -> None:
        """Raises UserError for a time whose type cannot tell one control step from the next."""
        kind = getattr(time, "dtype", None)
        if kind is None or str(kind).endswith("64"):
            return
        spacing = float(np.spacing(np.ravel(np.abs(time))[0]))
        if spacing > _FINE * self.metadata.control_dt:
            raise UserError(
                f"the time {np.ravel(time)[0]} s is a {kind}, whose next number is {spacing:.3g} s "
                "later; give 64 bits, or the seconds since the start"
            )

    def steps_since(self, measured: Measurements) -> int:
        """Control steps from the last step to the time of the measurements, at least 0.

        Raises:
          ImpossibleMeasurement: the time is 1 s or more from the last step's.
        """
        if "time" not in measured or self._first is None:
            return 1
        time = float(measured["time"][0])
        dt = self.metadata.control_dt
        elapsed = time - self._first - self.step_number * dt
        if abs(elapsed) > PAUSE - 1e-6:
            raise ImpossibleMeasurement(
                "late_step" if elapsed > 0.0 else "time",
                f"the time {time} s is {elapsed:.3g} s after the last step's; call reset after a "
                f"pause of {PAUSE:g} s, and give seconds",
            )
        return max(0, round((time - self._first) / dt) - self.step_number)


def _joint_order(names: Sequence[str] | Mapping[str, str], metadata: Metadata) -> list[int]:
    """Index among the policy's joints of each of a driver's joints.

    Raises:
      UserError: the names are not those of the policy's robot.
    """
    joints = metadata.joint_names
    if isinstance(names, Mapping):
        order = [joints.index(name) if name in joints else -1 for name in names.values()]
    else:
        order = [_index_of(joints, name) for name in dict.fromkeys(names)]
    if len(names) != len(joints) or sorted(order) != list(range(len(joints))):
        raise UserError(
            f"joint_names has {', '.join(names)}, but the policy is for {metadata.robot}, whose "
            f"joints are {', '.join(joints)}; give the names of this robot, each once, or a "
            "mapping from the driver's names to these"
        )
    return order


def _index_of(joints: Sequence[str], name: str) -> int:
    """Index of the joint of a driver's name: that of this name, else the only one whose name ends
    it; -1 if there is none."""
    if name in joints:
        return joints.index(name)
    fitting = [i for i, joint in enumerate(joints) if name.endswith(joint)]
    return fitting[0] if len(fitting) == 1 else -1


def _check_command(name: str, value: float, ends: tuple[float, float], unit: str) -> None:
    """Raises UserError for a command that no world of the training can hold, or for another one
    than the only one of the training."""
    low, high = ends
    if low == high:
        # The network has never seen another value, and cannot heed it.
        if abs(value - low) > _SAME_COMMAND:
            raise UserError(
                f"{name} is {value:.3g}, but the training had {low:.3g} alone ({unit}); give that, "
                f"or train with a range of {name}"
            )
        return
    room = max(high - low, _ROOM)
    if not low - room <= value <= high + room:
        raise UserError(
            f"{name} is {value:.3g}, but the training had {low:.3g} to {high:.3g} ({unit}); give "
            "this unit"
        )


def _array(label: str, value: Any, size: int, unit: str, limit: float, rows: int = 1) -> np.ndarray:
    """A copy of a user's numbers, which may come in rows, as an array [size]; UserError for another
    shape or kind, or numbers beyond a limit. Hidden entries of a masked array are not finite."""
    count = "one number" if size == 1 else f"{size} numbers"
    is_masked = isinstance(value, np.ma.MaskedArray)
    try:
        array = value if is_masked else np.asarray(value)
        # Text, truth values, dates and complex numbers are no measurements.
        if array.dtype.kind not in "fiuO":
            raise TypeError
        array = array.astype(float)
    except (TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{label} is {str(value)[:100]!r}; give {count} ({unit})") from error
    if array.shape not in ((size,), (rows, size // rows)) and not (size == 1 and not array.shape):
        raise UserError(f"{label} has the shape {list(array.shape)}; give {count} ({unit})")
    if is_masked:
        array = np.ma.filled(array, np.nan)
    array = array.reshape(size)
    sizes = np.abs(array)
    if not sizes.max() <= limit + 1e-6:
        wrong = array[~(sizes <= limit + 1e-6)]
        raise UserError(f"{label} holds {wrong[0]}; give finite numbers ({unit})")
    return array
