"""JAX, NumPy and MuJoCo, each imported at its first use.

The modules of the settings import them from here, so that a command line is read, and its `--help`
printed, without the seconds that JAX takes to import. Such a module has
`from __future__ import annotations`, which keeps `jax.Array` in a signature from being a use.
"""

import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import os
import sys
import types
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

Hook = Callable[[types.ModuleType], None]


class _Lazy(types.ModuleType):
    """Stands for the module of its name."""

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module(self.__name__), name)


def silence_mjx() -> None:
    """Lets a later import of MJX print nothing; otherwise it prints a line for each optional
    package that is missing. The output of other threads is left alone."""

    def give_silent_print(module: types.ModuleType) -> None:
        module.print = lambda *_, **__: None

    around_import("mujoco.mjx.warp", before=give_silent_print)


def spare_opengl() -> None:
    """Lets a later import of MuJoCo load no OpenGL library: where the one that MUJOCO_GL names is
    missing, the import would fail, also in a command that draws nothing (`viewers.offscreen` tries
    the library where something is drawn)."""
    named = os.environ.get("MUJOCO_GL")
    if named is not None:
        around_import(
            "mujoco.rendering.classic.gl_context",
            before=lambda _: os.environ.update(MUJOCO_GL="disabled"),
            after=lambda _: os.environ.update(MUJOCO_GL=named),
        )


def around_import(name: str, before: Hook | None = None, after: Hook | None = None) -> None:
    """Lets the first import of a module call functions with it, before and after its own code; does
    nothing if it is already imported."""
    if name not in sys.modules:
        sys.meta_path.insert(0, _AroundImport(name, before, after))


class _AroundImport(importlib.abc.MetaPathFinder):
    """Finds nothing itself, and changes the loader of one module."""

    def __init__(self, name: str, before: Hook | None, after: Hook | None):
        self._name, self._before, self._after = name, before, after
        self._is_searching = False

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """The module's own spec."""
        if fullname != self._name or self._is_searching:
            return None
        self._is_searching = True
        spec = importlib.util.find_spec(fullname)
        self._is_searching = False
        if spec is not None and spec.loader is not None:
            load = spec.loader.exec_module

            def load_between(module: types.ModuleType) -> None:
                # Not before: a search for the module need not be followed by its import.
                sys.meta_path.remove(self)
                if self._before is not None:
                    self._before(module)
                load(module)
                if self._after is not None:
                    self._after(module)

            spec.loader.exec_module = load_between
        return spec


if TYPE_CHECKING:
    import jax
    import jax.numpy as jnp
    import mujoco
    import numpy as np
else:
    jax, jnp, mujoco, np = map(_Lazy, ("jax", "jax.numpy", "mujoco", "numpy"))

__all__ = ["around_import", "jax", "jnp", "mujoco", "np", "silence_mjx", "spare_opengl"]
