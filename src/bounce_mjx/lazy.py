"""JAX, NumPy and MuJoCo, each imported at its first use, and MJX, imported in silence.

The modules of the settings import them from here, so that a command line is read, and its `--help`
printed, without the seconds that JAX takes to import. Such a module has
`from __future__ import annotations`, which keeps `jax.Array` in a signature from being a use.
"""

import contextlib
import importlib
import io
import types
from typing import TYPE_CHECKING, Any


class _Lazy(types.ModuleType):
    """Stands for the module of its name."""

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module(self.__name__), name)


def import_mjx() -> types.ModuleType:
    """MJX; it would print a line for each optional package that is missing."""
    with contextlib.redirect_stdout(io.StringIO()):
        return importlib.import_module("mujoco.mjx")


if TYPE_CHECKING:
    import jax
    import jax.numpy as jnp
    import mujoco
    import numpy as np
else:
    jax, jnp, mujoco, np = map(_Lazy, ("jax", "jax.numpy", "mujoco", "numpy"))

__all__ = ["import_mjx", "jax", "jnp", "mujoco", "np"]
