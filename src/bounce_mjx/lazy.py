"""JAX, NumPy and MuJoCo, each imported at its first use, and MJX, imported in silence.

The modules of the settings import them from here, so that a command line is read, and its `--help`
printed, without the seconds that JAX takes to import. Such a module has
`from __future__ import annotations`, which keeps `jax.Array` in a signature from being a use.
"""

import contextlib
import importlib
import io
import sys
import threading
import types
from typing import TYPE_CHECKING, Any


class _Lazy(types.ModuleType):
    """Stands for the module of its name."""

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module(self.__name__), name)


class _OthersOutput(io.TextIOBase):
    """Standard output for all threads but the one that made it, whose lines are dropped."""

    def __init__(self):
        self._thread, self._stdout = threading.get_ident(), sys.stdout

    def write(self, text: str) -> int:
        """Writes a text of another thread."""
        if threading.get_ident() == self._thread:
            return len(text)
        return self._stdout.write(text)


_importing = threading.Lock()


def import_mjx() -> types.ModuleType:
    """MJX; it would print a line for each optional package that is missing. What other threads
    print meanwhile is printed."""
    # Two threads that redirect the output at once may not restore it.
    with _importing, contextlib.redirect_stdout(_OthersOutput()):
        return importlib.import_module("mujoco.mjx")


if TYPE_CHECKING:
    import jax
    import jax.numpy as jnp
    import mujoco
    import numpy as np
else:
    jax, jnp, mujoco, np = map(_Lazy, ("jax", "jax.numpy", "mujoco", "numpy"))

__all__ = ["import_mjx", "jax", "jnp", "mujoco", "np"]
