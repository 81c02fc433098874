"""The network of a policy's ONNX file, with the histories of its inputs and what its task remembers
of the measurements. The world's quantities are the NumPy twin of `world/sensing.py`; a test
compares the two."""

from typing import Any, NamedTuple

import numpy as np

from bounce_mjx.deploy.metadata import IS_FIRST, NEWEST, NEXT, Metadata, from_entries
from bounce_mjx.deploy.motion import paddle_position
from bounce_mjx.deploy.samples import Measurements, Picture
from bounce_mjx.errors import UserError, needed

_LOG_ERRORS_ONLY = 3
_TYPES = {"tensor(float)": np.float32, "tensor(int32)": np.int32, "tensor(bool)": np.bool_}
# Shortest time between two pictures in a difference quotient, s.
_SHORTEST = 1e-3


class NoAction(UserError):
    """A network that gives no finite action."""

    fault = "network"
    """Code, of the table in docs/real-robot.md."""


class View(NamedTuple):
    """The balls' last picture that the network has seen, of which velocities are made."""

    balls: np.ndarray
    """One after another, m."""
    taken: float
    """s."""
    velocity: np.ndarray
    """Between it and the picture before, m/s."""


class History(NamedTuple):
    """What a network has seen."""

    is_first: bool
    """Whether it has seen nothing."""
    remembered: dict[str, np.ndarray]
    """What the task remembers, by the names of the inputs."""
    quantities: dict[str, np.ndarray]
    """The last values [history, size] of the observed quantities, the newest first."""
    view: View | None = None


class OnnxNetwork:
    """A network and its inputs: the last values of each observed quantity, and what the task
    remembers, as what the output `next/<name>` gives is the input `<name>` of the next step."""

    def __init__(self, model: bytes):
        """Loads an ONNX file; any exception means that it is not a policy."""
        with needed("onnxruntime", "bounce_mjx[deploy]"):
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
            if name.startswith(NEWEST):
                self._measured.append(name.removeprefix(NEWEST))
        self.reads = {*self._measured, *self._sizes}
        """Names of the quantities that the action depends on."""
        balls = np.zeros(3 * self.metadata.num_balls)
        self._unknown = {
            "joint_angles": np.zeros(len(self.metadata.joint_names)),
            "ball_position": balls,
            "ball_velocity": balls,
        }

    def begin(self) -> History:
        """The history before the first step."""
        quantities = {name: np.zeros(size) for name, size in self._sizes.items()}
        return History(is_first=True, remembered=self._remembered, quantities=quantities)

    def step(
        self,
        history: History,
        measured: Measurements,
        action: np.ndarray,
        picture: Picture | None = None,
    ) -> tuple[History, np.ndarray]:
        """The history after a control step, and its action [J]. The first step fills the whole
        history.

        Args:
          history: before the step.
          measured: arrays by name, as many as the policy needs: `joint_angles` [J],
            `joint_velocities` [J], `ball_position` [3], `ball_velocity` [3], `ball_age` [1],
            goals [1], and so on; of several balls one after another, [6] or [9]; units m, rad
            and s.
          action: that of the step before [J].
          picture: the balls' newest one, of which a velocity from differences is made.

        Raises:
          NoAction: the network gives no finite action.
        """
        view = history.view
        if self.metadata.velocity == "differences" and picture is not None:
            view = self._look(view, picture)
        if self.metadata.velocity == "differences" and view is not None:
            measured = measured | {"ball_velocity": view.velocity}
        newest = self._newest(measured, action)
        rows = {name: history.remembered[name] for name in self._read_again}
        quantities = {}
        for name, values in history.quantities.items():
            if history.is_first:
                quantities[name] = np.broadcast_to(newest[name], values.shape)
            else:
                quantities[name] = np.concatenate([newest[name][None], values[:-1]])
            rows[name] = quantities[name][None].astype(np.float32)
        for name in self._measured:
            rows[NEWEST + name] = newest[name][None].astype(np.float32)
        if IS_FIRST in self._inputs:
            rows[IS_FIRST] = np.array([history.is_first])
        result, *values = self._session.run(self._outputs, rows)
        if not np.isfinite(result).all():
            raise NoAction("the network returned an action that is not finite; stop the robot")
        remembered = dict(zip(self._remembered, values, strict=True))
        return History(False, remembered, quantities, view), result[0].astype(float)

    def _newest(self, measured: Measurements, action: np.ndarray) -> Measurements:
        """The newest value of each quantity."""
        newest = self._unknown | measured | {"past_actions": action}
        # Their names in the graph: the action as a measurement, and the picture's position, which
        # the training tells from the true one.
        newest["action"] = action
        newest["ball_picture"] = newest["ball_position"]
        if "paddle_position" in self.reads:
            paddle = paddle_position(self.metadata, newest["joint_angles"])
            newest["paddle_position"] = paddle
        return newest

    def _look(self, view: View | None, picture: Picture) -> View:
        """The view of a picture, which may be the last one again: the velocity is that between the
        last two."""
        balls = picture.balls.ravel()
        if view is None:
            return View(balls, picture.taken, self._unknown["ball_velocity"])
        if picture.taken <= view.taken:
            return view
        interval = max(picture.taken - view.taken, _SHORTEST)
        return View(balls, picture.taken, (balls - view.balls) / interval)

    def observation(self, history: History) -> np.ndarray:
        """Inputs of the network at the last step in one vector, with the newest value of each
        quantity first; empty before the first step."""
        if history.is_first:
            return np.zeros(0)
        values = history.quantities | history.remembered
        return np.concatenate([values[part.name].ravel() for part in self.metadata.observation])


def _zeros(entry: Any) -> np.ndarray:
    """One row of an input or an output of the graph, filled with 0."""
    return np.zeros((1, *entry.shape[1:]), _TYPES[entry.type])
