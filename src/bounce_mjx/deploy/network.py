"""The network of a policy's ONNX file, with what its task remembers of the measurements."""

from typing import Any

import numpy as np

from bounce_mjx.deploy.metadata import (
    IS_FIRST,
    MEASURED,
    NEXT,
    Input,
    Metadata,
    from_entries,
)
from bounce_mjx.errors import UserError, needed

_LOG_ERRORS_ONLY = 3
_TYPES = {"tensor(float)": np.float32, "tensor(int32)": np.int32, "tensor(bool)": np.bool_}


class OnnxNetwork:
    """A network and its memory: what the output `next/<name>` gives is the input `<name>` of the
    next step."""

    def __init__(self, model: bytes):
        """Loads an ONNX file; any exception means that it is not a policy."""
        self._model, self._session = model, _session(model)
        entries = self._session.get_modelmeta().custom_metadata_map
        self.metadata: Metadata = from_entries(entries)
        self._inputs = [i.name for i in self._session.get_inputs()]
        self._remembered = {
            output.name.removeprefix(NEXT): (output.type, output.shape[1:])
            for output in self._session.get_outputs()
            if output.name != "action"
        }
        self.observed: tuple[Input, ...] = tuple(
            part for part in self.metadata.observation if part.name not in self._remembered
        )
        """Inputs that are histories of measured quantities."""
        self.reads = {part.name for part in self.observed}
        """Names of the quantities that the action depends on."""
        self.reads |= {n.removeprefix(MEASURED) for n in self._inputs if n.startswith(MEASURED)}
        self.reset()

    def __getstate__(self) -> dict:
        return self.__dict__ | {"_session": None}

    def __setstate__(self, state: dict) -> None:
        self.__dict__ = state | {"_session": _session(state["_model"])}

    def reset(self) -> None:
        """Forgets the past."""
        self._is_first = True
        self.memory = {
            name: np.zeros((1, *shape), _TYPES[dtype])
            for name, (dtype, shape) in self._remembered.items()
        }
        """Numbers [1, ...] that the last step gave for the next one, by name."""

    def step(self, histories: dict[str, np.ndarray], newest: dict[str, np.ndarray]) -> np.ndarray:
        """Action [J] of a control step.

        Args:
          histories: values [history, size] of the inputs `observed`, the newest first.
          newest: newest value [size] of each quantity in `reads`.

        Raises:
          UserError: the network gives no finite action.
        """
        rows = histories | {f"{MEASURED}{name}": value for name, value in newest.items()}
        rows = {name: row[None].astype(np.float32) for name, row in rows.items()}
        rows |= {IS_FIRST: np.array([self._is_first])} | self.memory
        names = ["action", *(f"{NEXT}{name}" for name in self.memory)]
        action, *values = self._session.run(names, {name: rows[name] for name in self._inputs})
        if not np.all(np.isfinite(action)):
            raise UserError("the network returned an action that is not finite; stop the robot")
        self._is_first, self.memory = False, dict(zip(self.memory, values, strict=True))
        return action[0].astype(float)


def _session(model: bytes) -> Any:
    """A session of onnxruntime for an ONNX file."""
    with needed("onnxruntime", "onnxruntime"):
        import onnxruntime
    options = onnxruntime.SessionOptions()
    # The network is too small to share between threads.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = _LOG_ERRORS_ONLY
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
