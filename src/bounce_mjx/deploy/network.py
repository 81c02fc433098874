"""The network of a policy's ONNX file, with the histories of its inputs and what its task remembers
of the measurements. The world's quantities are the NumPy twin of `world/sensing.py`; a test
compares the two."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from bounce_mjx.deploy.metadata import IS_FIRST, MEASURED, NEXT, Metadata, from_entries
from bounce_mjx.deploy.motion import paddle_position
from bounce_mjx.deploy.samples import Measurements
from bounce_mjx.errors import UserError, needed

_LOG_ERRORS_ONLY = 3
_TYPES = {"tensor(float)": np.float32, "tensor(int32)": np.int32, "tensor(bool)": np.bool_}
_PER_JOINT = {"joint_angles", "joint_velocities", "servo_lead", "past_actions"}
# Smallest difference between the times of two pictures, s.
_SAME_PICTURE = 1e-4
# Pictures of the same position are two if they are farther apart than this share of a control step:
# the newest ones of two steps are half of it apart or more, whatever the camera's rate.
_APART = 0.4
# Shortest time between two pictures in a difference quotient, s.
_SHORTEST = 1e-3


class NoAction(UserError):
    """A network that gives no finite action."""

    fault = "network"
    """Code, of the table in docs/real-robot.md."""


class Picture(NamedTuple):
    """The balls' last picture, of which velocities are made."""

    position: np.ndarray
    """m, as measured."""
    taken: float
    """Time since the first step, s."""
    velocity: np.ndarray
    """Between it and the picture before, m/s."""


class OnnxNetwork:
    """A network and its inputs: the last values of each observed quantity, and its memory, as what
    the output `next/<name>` gives is the input `<name>` of the next step."""

    def __init__(self, model: bytes):
        """Loads an ONNX file; any exception means that it is not a policy."""
        with needed("onnxruntime", "onnxruntime"):
            import onnxruntime
        options = onnxruntime.SessionOptions()
        # The network is too small to share between threads.
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = _LOG_ERRORS_ONLY
        self._session: Any = onnxruntime.InferenceSession(
            model, options, providers=["CPUExecutionProvider"]
        )
        entries = self._session.get_modelmeta().custom_metadata_map
        self.metadata: Metadata = from_entries(entries)
        self._inputs = {entry.name: entry for entry in self._session.get_inputs()}
        self._outputs = ["action"]
        self._remembered = {}
        for output in self._session.get_outputs():
            if output.name != "action":
                self._outputs.append(output.name)
                self._remembered[output.name.removeprefix(NEXT)] = _zeros(output)
        # A task that does not look at the value before has an output without an input.
        self._read_again = [name for name in self._remembered if name in self._inputs]
        self._sizes = {}
        for part in self.metadata.observation:
            if part.name not in self._remembered:
                self._sizes[part.name] = (part.history, part.size)
        self._measured = []
        for name in self._inputs:
            if name.startswith(MEASURED):
                self._measured.append(name.removeprefix(MEASURED))
        self.reads = {*self._measured, *self._sizes}
        """Names of the quantities that the action depends on."""
        self._order: np.ndarray | None = None
        self.reset()

    def use_order(self, order: Sequence[int]) -> None:
        """Takes and gives the joints in another order.

        Args:
          order: index of each joint among the network's joints.
        """
        self._order = np.array(order)

    def reset(self) -> None:
        """Forgets the past."""
        self._is_first = True
        self._memory = self._remembered
        self._histories = {name: np.zeros(size) for name, size in self._sizes.items()}
        self._rows = {name: _zeros(entry) for name, entry in self._inputs.items()}
        balls = np.zeros(3 * self.metadata.num_balls)
        self._now = 0.0
        self._time: float | None = None
        self._picture: Picture | None = None
        self._unknown = {
            "joint_angles": np.zeros(len(self.metadata.joint_names)),
            "ball_position": balls,
            "ball_velocity": balls,
        }

    def step(self, measured: Measurements, action: np.ndarray) -> np.ndarray:
        """Action [J] of a control step. The first one fills the whole history.

        Args:
          measured: arrays by name, as many as the policy needs: `joint_angles` [J],
            `joint_velocities` [J], `ball_position` [3], `ball_velocity` [3], `ball_age` [1],
            commands [1], and so on; of several balls one after another, [6] or [9]; units m, rad
            and s. With `time` [1], a velocity from differences has the real time between two
            pictures; without it, a control step is as long as `control_dt`.
          action: that of the step before [J].

        Raises:
          NoAction: the network gives no finite action.
        """
        self._take_time(measured)
        newest = self._newest(measured, action)
        for name, history in self._histories.items():
            if self._is_first:
                history[:] = newest[name]
            else:
                history[1:] = history[:-1]
                history[0] = newest[name]
            self._rows[name][0] = history
        for name in self._measured:
            self._rows[MEASURED + name][0] = newest[name]
        if IS_FIRST in self._rows:
            self._rows[IS_FIRST][0] = self._is_first
        result, *values = self._session.run(self._outputs, self._rows)
        self._is_first = False
        if not np.isfinite(result).all():
            raise NoAction("the network returned an action that is not finite; stop the robot")
        self._memory = dict(zip(self._memory, values, strict=True))
        for name in self._read_again:
            self._rows[name] = self._memory[name]
        action = result[0].astype(float)
        return action if self._order is None else action[self._order]

    def _take_time(self, measured: Measurements) -> None:
        """Passes the time since the first step, s."""
        last = self._time
        self._time = float(measured["time"][0]) if "time" in measured else None
        if not self._is_first:
            is_known = last is not None and self._time is not None
            self._now += self._time - last if is_known else self.metadata.control_dt

    def _newest(self, measured: Measurements, action: np.ndarray) -> Measurements:
        """The newest value of each quantity, with the joints in the network's order."""
        newest = self._unknown | measured | {"past_actions": action}
        if self._order is not None:
            for name in newest.keys() & _PER_JOINT:
                ordered = np.empty_like(newest[name])
                ordered[self._order] = newest[name]
                newest[name] = ordered
        # Their names in the graph: the action as a measurement, and the picture's position, which
        # the training tells from the true one.
        newest["action"] = newest["past_actions"]
        newest["ball_picture"] = newest["ball_position"]
        if "paddle_position" in self.reads:
            paddle = paddle_position(self.metadata, newest["joint_angles"])
            newest["paddle_position"] = paddle
        if self.metadata.velocity == "differences":
            newest["ball_velocity"] = self._difference(newest)
        return newest

    @property
    def observation(self) -> np.ndarray:
        """Inputs of the network at the last step in one vector, with the newest value of each
        quantity first; empty before the first step."""
        if self._is_first:
            return np.zeros(0)
        values = self._histories | self._memory
        return np.concatenate([values[part.name].ravel() for part in self.metadata.observation])

    def _difference(self, measured: Measurements) -> np.ndarray:
        """Velocity of the ball by the difference of its last two pictures, of which the newest is
        remembered. A picture is new if it was taken later than the last one; without a measured
        age, as soon as the position differs, and then it was taken now."""
        position = measured["ball_position"]
        age = float(measured["ball_age"][0]) if "ball_age" in measured else 0.0
        taken = self._now - age
        last = self._picture
        if last is None:
            self._picture = Picture(position, taken, self._unknown["ball_velocity"])
            return self._picture.velocity
        interval = taken - last.taken
        if np.any(position != last.position):
            is_new = interval > _SAME_PICTURE
        else:
            # The age of the same picture may have errors, by which it seems to be later.
            is_new = "ball_age" in measured and interval > _APART * self.metadata.control_dt
        if is_new:
            velocity = (position - last.position) / max(interval, _SHORTEST)
            self._picture = Picture(position, taken, velocity)
        return self._picture.velocity


def _zeros(entry: Any) -> np.ndarray:
    """One row of an input or an output of the graph, filled with 0."""
    return np.zeros((1, *entry.shape[1:]), _TYPES[entry.type])
