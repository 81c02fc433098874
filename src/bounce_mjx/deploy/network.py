"""The network of a policy's ONNX file, with the histories of its inputs and what its task remembers
of the measurements. The world's quantities are the NumPy twin of `world/sensing.py`; a test
compares the two."""

import math
from typing import Any, NamedTuple

import numpy as np

from bounce_mjx.deploy.metadata import IS_FIRST, NEWEST, NEXT, Metadata, from_entries
from bounce_mjx.deploy.motion import paddle_position
from bounce_mjx.deploy.samples import Measurements, Picture, Seen
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
    values: np.ndarray
    """The last values of the measured inputs (`_Windows`); empty before the first step."""
    view: View | None = None


class _Windows:
    """The inputs that are measured, in one array of values: one input after another, each with its
    quantity's last values, the newest first."""

    def __init__(self, shapes: dict[str, tuple[int, ...]]):
        """Windows of the inputs' shapes: [history, size], or [size] of a newest value alone."""
        sizes = {name.removeprefix(NEWEST): shape[-1] for name, shape in shapes.items()}
        self.quantities = tuple(sizes)
        """Their names, in the order of the newest values."""
        starts = dict(zip(sizes, np.cumsum([0, *sizes.values()]), strict=False))
        num_newest = sum(sizes.values())
        self._places = {}
        filled = []
        shifted = []
        start = 0
        for name, shape in shapes.items():
            end = start + math.prod(shape)
            self._places[name] = slice(start, end), (1, *shape)
            newest = starts[name.removeprefix(NEWEST)] + np.arange(shape[-1])
            filled.append(np.resize(newest, end - start))
            shifted += [newest, num_newest + np.arange(start, end - shape[-1])]
            start = end
        # Where each value comes from: the newest ones in a first step; then also the last step's,
        # after them.
        self._filled = np.concatenate(filled)
        self._shifted = np.concatenate(shifted)

    def filled(self, newest: np.ndarray) -> np.ndarray:
        """The values of a first step, which repeats its newest ones."""
        return newest[self._filled]

    def shifted(self, values: np.ndarray, newest: np.ndarray) -> np.ndarray:
        """The values of a step after others."""
        return np.concatenate([newest, values])[self._shifted]

    def parts(self, values: np.ndarray) -> dict[str, np.ndarray]:
        """The inputs [1, history, size] or [1, size] in an array of values."""
        return {name: values[place].reshape(shape) for name, (place, shape) in self._places.items()}


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
        shapes = {}
        for part in self.metadata.observation:
            if part.name not in self._remembered:
                shapes[part.name] = part.history, part.size
        for name, entry in self._inputs.items():
            if name.startswith(NEWEST):
                shapes[name] = tuple(entry.shape[1:])
        self._windows = _Windows(shapes)
        self.reads = frozenset(self._windows.quantities)
        """Names of the quantities that the action depends on."""
        balls = np.zeros(3 * self.metadata.num_balls)
        self._unknown = {
            "joint_angles": np.zeros(len(self.metadata.joint_names)),
            "ball_position": balls,
            "ball_velocity": balls,
        }

    def begin(self) -> History:
        """The history before the first step."""
        return History(is_first=True, remembered=self._remembered, values=np.zeros(0))

    def step(
        self,
        history: History,
        measured: Measurements,
        action: np.ndarray,
        seen: Seen | None = None,
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
          seen: what the samples say, the measured one included: the paddle's place, and the balls'
            newest picture, of which a velocity from differences is made. None for a step between
            two samples.

        Raises:
          NoAction: the network gives no finite action.
        """
        view = history.view
        if self.metadata.velocity == "differences":
            if seen is not None and seen.picture is not None:
                view = self._look(view, seen.picture)
            if view is not None:
                measured = measured | {"ball_velocity": view.velocity}
        quantities = self._newest(measured, action, seen)
        newest = np.concatenate([quantities[name] for name in self._windows.quantities])
        if history.is_first:
            values = self._windows.filled(newest)
        else:
            values = self._windows.shifted(history.values, newest)
        rows = self._windows.parts(values.astype(np.float32))
        rows |= {name: history.remembered[name] for name in self._read_again}
        if IS_FIRST in self._inputs:
            rows[IS_FIRST] = np.array([history.is_first])
        result, *remembered = self._session.run(self._outputs, rows)
        if not np.isfinite(result).all():
            raise NoAction("the network returned an action that is not finite; stop the robot")
        remembered = dict(zip(self._remembered, remembered, strict=True))
        return History(False, remembered, values, view), result[0].astype(float)

    def _newest(
        self, measured: Measurements, action: np.ndarray, seen: Seen | None
    ) -> Measurements:
        """The newest value of each quantity."""
        newest = self._unknown | measured | {"past_actions": action}
        # Their names in the graph: the action as a measurement, and the picture's position, which
        # the training tells from the true one.
        newest["action"] = action
        newest["ball_picture"] = newest["ball_position"]
        if "paddle_position" in self.reads:
            if seen is None:
                paddle = paddle_position(self.metadata, newest["joint_angles"])
            else:
                paddle = seen.paddle[-1][1]
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
        values = self._windows.parts(history.values) | history.remembered
        return np.concatenate([values[part.name].ravel() for part in self.metadata.observation])


def _zeros(entry: Any) -> np.ndarray:
    """One row of an input or an output of the graph, filled with 0."""
    return np.zeros((1, *entry.shape[1:]), _TYPES[entry.type])
