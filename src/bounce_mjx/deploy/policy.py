"""A trained policy on a robot: measurements in, actions out, with only NumPy and onnxruntime."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from bounce_mjx.deploy.histories import OF_BOUNCES, Histories, Measurements
from bounce_mjx.deploy.metadata import Metadata, from_entries
from bounce_mjx.errors import UserError, needed

_MAX_PAUSE = 1.0
# Measurements beyond it are not of a robot.
_LARGEST = 1e6
_LOG_ERRORS_ONLY = 3

UNITS = {
    "joint_angles": "rad",
    "joint_velocities": "rad/s",
    "ball_position": "m",
    "ball_velocity": "m/s",
    "ball_age": "s",
    "ball_quaternion": "w, x, y, z",
    "ball_angular_velocity": "rad/s",
    "target_height": "m",
    "time": "s",
}
"""Measurements accepted by a step, and their units."""


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
        with needed("onnxruntime", "onnxruntime"):
            import onnxruntime
        options = onnxruntime.SessionOptions()
        # The network is too small to share between threads.
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = _LOG_ERRORS_ONLY
        try:
            self._session = onnxruntime.InferenceSession(
                model, options, providers=["CPUExecutionProvider"]
            )
            entries = self._session.get_modelmeta().custom_metadata_map
            self.metadata: Metadata = from_entries(entries)
            self._shapes = _shapes(len(self.metadata.joint_names))
            self._check_inputs()
            self.reset()
            # A network that fails or gives no numbers fails here, and not on the robot.
            self._act({p.name: np.zeros((p.history, p.size)) for p in self.metadata.observation})
        # onnxruntime raises exceptions of many types for a damaged file.
        except Exception as error:
            reason = (str(error).strip().splitlines() or [repr(error)])[0][:200]
            raise UserError(
                f"{source} is no policy of this version of the package ({reason}); give a file "
                "that bounce-mjx export wrote"
            ) from error
        self.needs = self._needs()
        """Measurements required in every step; `UNITS` has their units."""
        self.reset()

    def reset(self) -> None:
        """Forgets the past. The next step fills the whole history with its measurements."""
        self._histories: Histories | None = None
        self._measured: Measurements = {}
        self._time: float | None = None
        self._action = np.zeros(len(self.metadata.joint_names))

    def step(self, measurements: Mapping[str, Any]) -> np.ndarray:
        """Action of a control step.

        Args:
          measurements: `joint_angles` [J] (rad) and `joint_velocities` [J] (rad/s) in the order of
            `metadata.joint_names`; from the newest picture of the ball `ball_position` [3] (m),
            `ball_velocity` [3] (m/s), `ball_age` (time since the picture was taken, s),
            `ball_quaternion` [4] (w, x, y, z; default 1, 0, 0, 0) and `ball_angular_velocity` [3]
            (rad/s; default 0); `target_height` (m); `time` of any clock (s). The measurements in
            `needs` are required. Without `time`, a step is one control step after the last one.

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
        measured = self._checked(measurements)
        time = float(measured.pop("time")[0]) if "time" in measured else None
        steps = self._steps_since(time)
        if steps == 0:
            return self._action.copy()
        if self._histories is None:
            self._histories = Histories(self.metadata, measured)
        else:
            for i in range(1, steps + 1):
                share = i / steps
                between = {
                    name: (1.0 - share) * self._measured[name] + share * value
                    for name, value in measured.items()
                    if name in self._measured
                }
                last = i == steps
                self._histories.add(measured if last else measured | between, self._action, last)
        action = self._act(self._histories.values)
        self._measured, self._time, self._action = measured, time, action
        return self._action.copy()

    def servo_targets(self, action: np.ndarray) -> np.ndarray:
        """Servo targets [J] (rad) for the last step's action [J]: the joint angles measured in that
        step plus the scaled action, clipped to the joint ranges.

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
        low = [-np.inf if limits is None else limits[0] for limits in ranges]
        high = [np.inf if limits is None else limits[1] for limits in ranges]
        targets = self._measured["joint_angles"] + self.metadata.action_scale * action
        return np.clip(targets, low, high)

    def _act(self, values: dict[str, np.ndarray]) -> np.ndarray:
        """Action [J] of the network for values [history, size] by name."""
        inputs = {name: value[None].astype(np.float32) for name, value in values.items()}
        (actions,) = self._session.run(["action"], inputs)
        if not np.all(np.isfinite(actions)):
            raise UserError("the network gives an action that is not finite; stop the robot")
        return actions[0].astype(float)

    @property
    def observation(self) -> np.ndarray:
        """Inputs of the network at the last step in one vector, with the newest value of each
        quantity first; empty before the first step."""
        values = [] if self._histories is None else self._histories.values.values()
        return np.concatenate([np.zeros(0), *(value.ravel() for value in values)])

    def _check_inputs(self) -> None:
        """Raises ValueError if the network does not match its metadata."""
        stated = {p.name: [p.history, p.size] for p in self.metadata.observation}
        actual = {i.name: i.shape[1:] for i in self._session.get_inputs()}
        outputs = {o.name: o.shape[1:] for o in self._session.get_outputs()}
        sizes = self._sizes()
        if unknown := stated.keys() - sizes:
            raise ValueError(f"its input {min(unknown)} is unknown here")
        if wrong := [name for name, (_, size) in stated.items() if size != sizes[name]]:
            raise ValueError(f"its input {wrong[0]} must have the size {sizes[wrong[0]]}")
        expected = {"action": [len(self.metadata.joint_names)]}
        if stated != actual or outputs != expected or len(stated) < len(self.metadata.observation):
            raise ValueError("its inputs or outputs are not as its metadata states")

    def _sizes(self) -> dict[str, int]:
        """Number of entries of one value of each input that a network may have."""
        sizes = {name: shape[0] for name, shape in self._shapes.items() if name != "time"}
        derived = {
            "paddle_position": 3,
            "apex_error": 1,
            "bounce_position": 2,
            "bounce_interval": 1,
        }
        joints = ("past_actions", "bounce_joint_angles", "bounce_joint_velocities")
        return sizes | derived | dict.fromkeys(joints, len(self.metadata.joint_names))

    def _needs(self) -> tuple[str, ...]:
        seen = {part.name for part in self.metadata.observation}
        needs = {
            "joint_angles": {"joint_angles", "paddle_position"} | OF_BOUNCES,
            "joint_velocities": {"joint_velocities", "bounce_joint_velocities"},
            "ball_position": {"ball_position"} | OF_BOUNCES,
            "ball_velocity": {"ball_velocity"},
            "ball_age": {"ball_age"},
            "target_height": {"target_height", "apex_error"},
        }
        if self.metadata.velocity != "measured":
            needs["ball_position"] |= needs.pop("ball_velocity")
        if self.metadata.estimator is not None:
            needs["joint_angles"] |= needs["ball_position"]
        return tuple(name for name, users in needs.items() if users & seen)

    def _checked(self, measurements: Mapping[str, Any]) -> Measurements:
        """Copies of the measurements as arrays, with defaults for optional ones."""
        for name in measurements:
            if name not in self._shapes:
                raise UserError(f"{name} is no measurement; a step takes {', '.join(self._shapes)}")
        missing = [name for name in self.needs if name not in measurements]
        if missing:
            raise UserError(
                f"the measurement {missing[0]} is missing; this policy needs "
                f"{', '.join(self.needs)} in every step"
            )
        checked = {"ball_quaternion": np.array([1.0, 0.0, 0.0, 0.0])}
        checked["ball_angular_velocity"] = np.zeros(3)
        for name, value in measurements.items():
            limit = np.inf if name == "time" else _LARGEST
            label = f"the measurement {name}"
            checked[name] = _array(label, value, self._shapes[name], UNITS[name], limit)
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


def _shapes(num_joints: int) -> dict[str, tuple[int, ...]]:
    """Shapes of the measurements, in the order of `UNITS`."""
    shapes = dict.fromkeys(UNITS, (1,))
    shapes |= {"joint_angles": (num_joints,), "joint_velocities": (num_joints,)}
    shapes |= dict.fromkeys(("ball_position", "ball_velocity", "ball_angular_velocity"), (3,))
    return shapes | {"ball_quaternion": (4,)}


def _array(label: str, value: Any, shape: tuple[int, ...], unit: str, limit: float) -> np.ndarray:
    """A user's numbers as an array; UserError for another shape or numbers beyond a limit."""
    count = "one number" if shape == (1,) else f"{shape[0]} numbers"
    try:
        array = np.array(value, float)
    except (TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{label} is {str(value)[:100]!r}; give {count} ({unit})") from error
    if array.shape != shape and not (shape == (1,) and array.shape == ()):
        raise UserError(f"{label} has the shape {list(array.shape)}; give {count} ({unit})")
    wrong = ~(np.isfinite(array) & (np.abs(array) <= limit + 1e-6))
    if np.any(wrong):
        raise UserError(f"{label} holds {array[wrong].flat[0]}; give finite numbers ({unit})")
    return array.reshape(shape)
