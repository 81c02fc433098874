"""JAX, NumPy and MuJoCo, each imported at its first use.

The modules of the settings import them from here, so that a command line is read, and its `--help`
printed, without the seconds that JAX takes to import. Such a module has
`from __future__ import annotations`, which keeps `jax.Array` in a signature from being a use.
"""

import importlib
import importlib.abc
import importlib.machinery
import sys
import types
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any


class _Lazy(types.ModuleType):
    """Stands for the module of its name."""

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module(self.__name__), name)


def silence_mjx() -> None:
    """Lets a later import of MJX print nothing; otherwise it prints a line for each optional
    package that is missing. The output of other threads is left alone."""
    if _SILENCED not in sys.modules:
        sys.meta_path.insert(0, _SilentMJX())


_SILENCED = "mujoco.mjx.warp"


class _SilentMJX(importlib.abc.MetaPathFinder):
    """Gives the module of MJX that prints a `print` of its own."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """The module's own spec, with a loader that first replaces `print`."""
        if fullname != _SILENCED:
            return None
        sys.meta_path.remove(self)
        spec = importlib.machinery.PathFinder.find_spec(fullname, path)
        if spec is not None and spec.loader is not None:
            load = spec.loader.exec_module

            def load_silently(module: types.ModuleType) -> None:
                module.print = lambda *_, **__: None
                load(module)

            spec.loader.exec_module = load_silently
        return spec


if TYPE_CHECKING:
    import jax
    import jax.numpy as jnp
    import mujoco
    import numpy as np
else:
    jax, jnp, mujoco, np = map(_Lazy, ("jax", "jax.numpy", "mujoco", "numpy"))

__all__ = ["jax", "jnp", "mujoco", "np", "silence_mjx"]
