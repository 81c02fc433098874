"""JAX, NumPy and MuJoCo, each imported at its first use, and hooks for the imports of others.

The modules of the settings import them from here, so that a command line is read, and its `--help`
printed, without the seconds that JAX takes to import. Such a module has
`from __future__ import annotations`, which keeps `jax.Array` in a signature from being a use.
"""

import functools
import importlib
import importlib.abc
import importlib.machinery
import sys
import types
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any


class _Lazy(types.ModuleType):
    """Stands for the module of its name."""

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module(self.__name__), name)


class _WrappedImport(importlib.abc.MetaPathFinder):
    """Finds one module, whose code another function runs."""

    def __init__(self, name: str, run: Callable[[Callable, types.ModuleType], None]):
        self._name, self._run = name, run

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """The spec of the module; None for others."""
        if name != self._name:
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path)
        if spec is not None and spec.loader is not None:
            spec.loader.exec_module = functools.partial(self._run, spec.loader.exec_module)
        return spec


def wrap_import(name: str, run: Callable[[Callable, types.ModuleType], None]) -> None:
    """Lets `run(load, module)` do the later import of a module, in place of `load(module)`."""
    sys.meta_path.insert(0, _WrappedImport(name, run))


@functools.cache
def silence_mjx() -> None:
    """Lets a later import of MJX print nothing; otherwise it prints a line for each optional
    package that is missing."""

    def load_in_silence(load: Callable, module: types.ModuleType) -> None:
        module.print = lambda *_, **__: None
        load(module)

    wrap_import("mujoco.mjx.warp", load_in_silence)


if TYPE_CHECKING:
    import jax
    import jax.numpy as jnp
    import mujoco
    import numpy as np
else:
    jax, jnp, mujoco, np = map(_Lazy, ("jax", "jax.numpy", "mujoco", "numpy"))

__all__ = ["jax", "jnp", "mujoco", "np", "silence_mjx", "wrap_import"]
