"""Every number that a user may change: the task, its reward, the trainer, the run.

The models are immutable and reject unknown keys and values out of range. The comments beside a
field (its docstring) give the unit; they are also the help text of the command line.
"""

from pathlib import Path
from typing import Annotated

import pydantic
from pydantic import Field

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


Finite = Annotated[float, Field(allow_inf_nan=False)]


UnitInterval = Annotated[float, Field(ge=0.0, le=1.0)]


def _check_path(path: Path) -> Path:
    if "\0" in str(path):
        raise ValueError("a path cannot hold the character 0; leave it out")
    return path


PlainPath = Annotated[Path, pydantic.AfterValidator(_check_path)]


Count = Annotated[int, Field(ge=1, lt=2**31)]


Steps = Annotated[int, Field(ge=1, le=10**12)]


class StrictModel(pydantic.BaseModel):
    """An immutable, strict group of settings."""

    model_config = pydantic.ConfigDict(
        frozen=True, extra="forbid", use_attribute_docstrings=True, validate_default=True
    )
