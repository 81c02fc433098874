"""The network of a policy's ONNX file, with the histories of its inputs and what its task remembers
of the measurements. The world's quantities are the NumPy twin of `world/sensing.py`; a test
compares the two."""

from typing import Any

import numpy as np

from bounce_mjx.deploy.metadata import IS_FIRST, MEASURED, NEXT, Metadata, from_entries
from bounce_mjx.deploy.motion import paddle_position
from bounce_mjx.deploy.samples import Measurements
from bounce_mjx.errors import UserError, needed

_LOG_ERRORS_ONLY = 3
_TYPES = {"tensor(float)": np.float32, "tensor(int32)": np.int32, "tensor(bool)": np.bool_}
# Smallest difference between the times of two pictures, s.
_SAME_PICTURE = 1e-4
# Shortest time between two pictures in a difference quotient, s.
_SHORTEST = 1e-3


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
        self._inputs = [i.name for i in self._session.get_inputs()]
        self._remembered = {
            output.name.removeprefix(NEXT): np.zeros((1, *output.shape[1:]), _TYPES[output.type])
            for output in self._session.get_outputs()
            if output.name != "action"
        }
        own = [part for part in self.metadata.observation if part.name not in self._remembered]
        self._lengths = {part.name: part.history for part in own}
        measured = {n.removeprefix(MEASURED) for n in self._inputs if n.startswith(MEASURED)}
        self.reads = measured | self._lengths.keys()
        """Names of the quantities that the action depends on."""
        self.reset()

    def reset(self) -> None:
        """Forgets the past."""
        self._histories: Measurements | None = None
        self._memory = self._remembered
        balls = np.zeros(3 * self.metadata.num_balls)
        self._picture: tuple[np.ndarray, np.ndarray, float] | None = None
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
            and s.
          action: that of the step before [J].

        Raises:
          UserError: the network gives no finite action.
        """
        known = self._unknown | measured
        newest = known | {
            "action": action,
            "past_actions": action,
            "paddle_position": paddle_position(self.metadata, known["joint_angles"]),
            "ball_picture": known["ball_position"],
        }
        if self.metadata.velocity == "differences":
            newest["ball_velocity"] = self._difference(known)
        past = self._histories
        self._histories = {
            name: np.tile(newest[name], (length, 1))
            if past is None
            else np.concatenate([newest[name][None], past[name][:-1]])
            for name, length in self._lengths.items()
        }
        rows = self._histories | {f"{MEASURED}{name}": value for name, value in newest.items()}
        rows = {name: row[None].astype(np.float32) for name, row in rows.items()}
        rows |= {IS_FIRST: np.array([past is None])} | self._memory
        names = ["action", *(f"{NEXT}{name}" for name in self._memory)]
        result, *values = self._session.run(names, {name: rows[name] for name in self._inputs})
        if not np.all(np.isfinite(result)):
            raise UserError("the network returned an action that is not finite; stop the robot")
        self._memory = dict(zip(self._memory, values, strict=True))
        return result[0].astype(float)

    @property
    def observation(self) -> np.ndarray:
        """Inputs of the network at the last step in one vector, with the newest value of each
        quantity first; empty before the first step."""
        if self._histories is None:
            return np.zeros(0)
        values = self._histories | self._memory
        return np.concatenate([values[part.name].ravel() for part in self.metadata.observation])

    def _difference(self, measured: Measurements) -> np.ndarray:
        """Velocity of the ball by the difference of its last two pictures; updates the last one.
        Without a measured age, a picture is new as soon as the position differs."""
        position, age = measured["ball_position"], measured.get("ball_age")
        if self._picture is None:
            self._picture = position, self._unknown["ball_velocity"], 0.0 if age is None else age[0]
            return self._picture[1]
        ball, velocity, last_age = self._picture
        held_age = last_age + self.metadata.control_dt
        is_new = np.any(position != ball) if age is None else held_age - age[0] > _SAME_PICTURE
        now = (0.0 if is_new else held_age) if age is None else age[0]
        if is_new:
            velocity, ball = (position - ball) / max(held_age - now, _SHORTEST), position
        self._picture = ball, velocity, now
        return velocity
