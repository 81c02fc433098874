"""A trained policy on a robot: measurements in, actions out, with only NumPy and onnxruntime."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from bounce_mjx.deploy.histories import Histories, Measurements
from bounce_mjx.deploy.metadata import PER_BALL, UNITS, Metadata, measurement_sizes
from bounce_mjx.deploy.network import OnnxNetwork
from bounce_mjx.errors import MissingPackage, UserError

_MAX_PAUSE = 1.0
# Measurements beyond it are not of a robot.
_LARGEST = 1e6


class DeployedPolicy:
    """A policy with the histories of its inputs; `load_policy` creates it.

    Call `reset` before each ball and `step` once each control step. Positions are in the robot's
    frame: x forward, z upward, the floor at z = 0.
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
            self.units = UNITS | {
                name: c.unit or "no unit" for name, c in self.metadata.commands.items()
            }
            """Measurements that a step accepts, and their units."""
            self._sizes = measurement_sizes(self.metadata)
            self.needs = self._needs()
            """Measurements required in every step."""
            # A network that fails or gives no numbers fails here, and not on the robot.
            self.reset()
            for _ in range(2):
                self.step({name: np.zeros(self._sizes[name]) for name in self.needs})
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

    def reset(self) -> None:
        """Forgets the past. The next step fills the whole history with its measurements."""
        self._histories: Histories | None = None
        self._network.reset()
        self._measured: Measurements = {}
        self._time: float | None = None
        self._action = np.zeros(len(self.metadata.joint_names))
        # The last servo targets, and what an action adds to, if that is not the measured angles.
        self._targets: np.ndarray | None = None
        self._base: np.ndarray | None = None

    def step(self, measurements: Mapping[str, Any]) -> np.ndarray:
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

            With `time`, the elapsed time is rounded to control steps. A call less than half a
            control step after the last one, or before it, is a repetition: it changes nothing and
            returns the last action. A call several control steps late fills the missed steps with
            interpolated measurements and the last action.

        Returns:
          Action [J], from -1 to 1; `servo_targets` converts it.

        Raises:
          UserError: a required measurement is missing; a measurement is unknown, has the wrong
            shape or is not finite; or the time is more than 1 s from the last. The policy's
            state does not change. Or the network gives no finite action; then call `reset`.
        """
        measured = self._with_lead(self._checked(measurements))
        time = float(measured.pop("time")[0]) if "time" in measured else None
        steps = self._steps_since(time)
        if steps == 0:
            return self._action.copy()
        if self._histories is None:
            self._histories = Histories(self.metadata, self._network.observed, measured)
        else:
            for i in range(1, steps):
                share = i / steps
                between = {
                    name: (1.0 - share) * self._measured[name] + share * value
                    for name, value in measured.items()
                    if name in self._measured
                }
                self._histories.add(measured | between, self._action, is_real=False)
                if self._network.memory:
                    self._network.step(self._histories.values, self._histories.newest)
            self._histories.add(measured, self._action)
        action = self._network.step(self._histories.values, self._histories.newest)
        self._measured, self._time, self._action = measured, time, action
        if self.metadata.max_lead is not None and "joint_angles" in measured:
            lead, angles = self.metadata.max_lead, measured["joint_angles"]
            last = angles if self._targets is None else self._targets
            self._base = np.clip(last, angles - lead, angles + lead)
            self._targets = self._targets_of(action)
        return self._action.copy()

    def servo_targets(self, action: np.ndarray) -> np.ndarray:
        """Servo targets [J] (rad) for the last step's action [J]: the joint angles measured in that
        step plus the scaled action, clipped to the joint ranges. With `metadata.max_lead`, the
        action adds to the last targets, within that distance of the measured angles; another
        action than the policy's then counts as sent.

        Raises:
          UserError: there was no step since the reset, or it had no measured joint angles; or the
            action is not J numbers from -1 to 1.
        """
        if "joint_angles" not in self._measured:
            raise UserError(
                "the servo targets start from the measured joint angles, and there are none; call "
                "step with joint_angles first"
            )
        ranges = self.metadata.joint_ranges
        action = _array("the action", action, (len(ranges),), "from -1 to 1", 1.0)
        targets = self._targets_of(action)
        if self.metadata.max_lead is not None:
            self._targets = targets
        return targets.copy()

    def _targets_of(self, action: np.ndarray) -> np.ndarray:
        """Servo targets [J] (rad) of an action [J] in the last step."""
        ranges = self.metadata.joint_ranges
        low = [-np.inf if limits is None else limits[0] for limits in ranges]
        high = [np.inf if limits is None else limits[1] for limits in ranges]
        base = self._measured["joint_angles"] if self._base is None else self._base
        return np.clip(base + self.metadata.action_scale * action, low, high)

    @property
    def observation(self) -> np.ndarray:
        """Inputs of the network at the last step in one vector, with the newest value of each
        quantity first; empty before the first step."""
        if self._histories is None:
            return np.zeros(0)
        values = self._histories.values | self._network.memory
        return np.concatenate([values[i.name].ravel() for i in self.metadata.observation])

    def _needs(self) -> tuple[str, ...]:
        reads = self._network.reads
        optional = ("ball_quaternion", "ball_angular_velocity")
        users = {name: {name} for name in self.units if name not in optional}
        users["joint_angles"] |= {"paddle_position", "servo_lead"}
        users["ball_position"].add("ball_picture")
        if self.metadata.velocity != "measured":
            users["ball_position"] |= users.pop("ball_velocity")
        if self.metadata.estimator is not None:
            users["joint_angles"] |= users["ball_position"]
        return tuple(name for name in users if users[name] & reads)

    def _with_lead(self, measured: Measurements) -> Measurements:
        """The measurements, and how far the last servo targets lead the measured angles."""
        if self.metadata.max_lead is None or "joint_angles" not in measured:
            return measured
        angles = measured["joint_angles"]
        last = angles if self._targets is None else self._targets
        return measured | {"servo_lead": last - angles}

    def _checked(self, measurements: Mapping[str, Any]) -> Measurements:
        """Copies of the measurements as arrays, with defaults for optional ones."""
        for name in measurements:
            if name not in self.units:
                raise UserError(
                    f"{name} is not a measurement; a step takes {', '.join(self.units)}"
                )
        missing = [name for name in self.needs if name not in measurements]
        if missing:
            raise UserError(
                f"the measurement {missing[0]} is missing; this policy needs "
                f"{', '.join(self.needs)} in every step"
            )
        count = self.metadata.num_balls
        checked = {"ball_quaternion": np.tile([1.0, 0.0, 0.0, 0.0], count)}
        checked["ball_angular_velocity"] = np.zeros(3 * count)
        for name, value in measurements.items():
            limit = np.inf if name == "time" else _LARGEST
            label = f"the measurement {name}"
            size, rows = self._sizes[name], count if name in PER_BALL else 1
            checked[name] = _array(label, value, (size,), self.units[name], limit, rows)
        if self.metadata.velocity != "measured":
            checked.pop("ball_velocity", None)
        return checked

    def _steps_since(self, time: float | None) -> int:
        """Control steps since the last step, at least 0."""
        if time is None or self._time is None:
            return 1
        elapsed = time - self._time
        if abs(elapsed) > _MAX_PAUSE:
            raise UserError(
                f"the time {time} s is {elapsed:.3g} s after the last step's; call reset after a "
                f"pause of more than {_MAX_PAUSE:g} s, and give seconds"
            )
        return max(0, round(elapsed / self.metadata.control_dt))


def _array(
    label: str, value: Any, shape: tuple[int], unit: str, limit: float, rows: int = 1
) -> np.ndarray:
    """A user's numbers, which may come in rows, as an array; UserError for another shape or numbers
    beyond a limit."""
    count = "one number" if shape == (1,) else f"{shape[0]} numbers"
    try:
        array = np.array(value, float)
    except (TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{label} is {str(value)[:100]!r}; give {count} ({unit})") from error
    if rows > 1 and array.shape == (rows, shape[0] // rows):
        array = array.ravel()
    if array.shape != shape and not (shape == (1,) and array.shape == ()):
        raise UserError(f"{label} has the shape {list(array.shape)}; give {count} ({unit})")
    wrong = ~(np.isfinite(array) & (np.abs(array) <= limit + 1e-6))
    if np.any(wrong):
        raise UserError(f"{label} holds {array[wrong].flat[0]}; give finite numbers ({unit})")
    return array.reshape(shape)
