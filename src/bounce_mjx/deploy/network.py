"""The network of a policy's ONNX file, with what its task remembers of the measurements."""

import math
from typing import Any

import numpy as np

from bounce_mjx.deploy.metadata import (
    IS_FIRST,
    MEASURED,
    NEXT,
    Input,
    Metadata,
    from_entries,
    measurement_sizes,
)
from bounce_mjx.errors import UserError, needed

_LOG_ERRORS_ONLY = 3
_FLOAT = "tensor(float)"
_TYPES = {_FLOAT: np.float32, "tensor(int32)": np.int32, "tensor(bool)": np.bool_}
# Numbers that a network may remember; a file states how many it does.
_LARGEST_MEMORY = 1_000_000


class OnnxNetwork:
    """A network and its memory: what the output `next/<name>` gives is the input `<name>` of the
    next step."""

    def __init__(self, model: bytes):
        """Loads an ONNX file; any exception means that it is not a policy."""
        self._model, self._session = model, _session(model)
        entries = self._session.get_modelmeta().custom_metadata_map
        self.metadata: Metadata = from_entries(entries)
        self._inputs = {i.name: (i.type, i.shape[1:]) for i in self._session.get_inputs()}
        outputs = {o.name: (o.type, o.shape[1:]) for o in self._session.get_outputs()}
        joints = [len(self.metadata.joint_names)]
        if outputs.pop("action", None) != (_FLOAT, joints):
            raise ValueError("its action is not as its metadata states")
        self._remembered = {name.removeprefix(NEXT): kind for name, kind in outputs.items()}
        self._check()
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
        memory = dict(zip(self.memory, values, strict=True))
        is_kept = all(memory[name].shape == past.shape for name, past in self.memory.items())
        if not (is_kept and np.all(np.isfinite(action))):
            raise UserError(
                "the network returned an action that is not finite, or memory of the wrong shape; "
                "stop the robot"
            )
        self._is_first, self.memory = False, memory
        return action[0].astype(float)

    def _check(self) -> None:
        """Raises ValueError if the inputs and the memory do not fit to the metadata."""
        metadata, remembered = self.metadata, self._remembered
        sizes = measurement_sizes(metadata) | {"paddle_position": 3}
        sizes["ball_picture"] = sizes["ball_position"]
        sizes |= dict.fromkeys(("action", "past_actions", "servo_lead"), len(metadata.joint_names))
        stated = {}
        for part in metadata.observation:
            if part.name not in remembered and part.name not in sizes:
                raise ValueError(f"its input {part.name} is unknown here")
            if (size := sizes.get(part.name, part.size)) != part.size:
                raise ValueError(f"its input {part.name} must have the size {size}")
            stated[part.name] = _FLOAT, [part.history, part.size]
        known = {f"{MEASURED}{name}": (_FLOAT, [size]) for name, size in sizes.items()}
        known |= {IS_FIRST: ("tensor(bool)", [])} | remembered | stated
        if (
            len(stated) < len(metadata.observation)
            or not stated.keys() - remembered.keys() <= self._inputs.keys()
            or any(known.get(name) != kind for name, kind in self._inputs.items())
            or any(known[name] != kind for name, kind in remembered.items())
        ):
            raise ValueError("its inputs or outputs are not as its metadata states")
        shapes = [shape for _, shape in remembered.values()]
        is_fixed = all(type(n) is int and n > 0 for shape in shapes for n in shape)
        if not is_fixed or sum(map(math.prod, shapes)) > _LARGEST_MEMORY:
            raise ValueError("its memory has no fixed size, or is too large")


def _session(model: bytes) -> Any:
    """A session of onnxruntime for an ONNX file."""
    with needed("onnxruntime", "onnxruntime"):
        import onnxruntime
    options = onnxruntime.SessionOptions()
    # The network is too small to share between threads.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = _LOG_ERRORS_ONLY
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
