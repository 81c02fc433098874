"""Registers the environment with Gymnasium, before or after Gymnasium is imported."""

import importlib.abc
import importlib.machinery
import importlib.util
import sys
import types
from collections.abc import Sequence

ENV_ID = "bounce_mjx/BounceBall-v0"
"""Name of the specification's environment."""
TASK_ID = "bounce_mjx/Task-v0"
"""Name of any other one, with the argument `task`."""
MAX_EPISODE_STEPS = 2000
"""The tasks' episode of 20 s. A constant, because reading a config would import JAX."""
_MODULE = "bounce_mjx.adapters.gymnasium.environments"


def register_when_imported() -> None:
    """Makes `gymnasium.make` and `gymnasium.make_vec` work for `ENV_ID` and `TASK_ID`.

    Gymnasium is optional and takes half a second to import, so it is not imported here. If it is
    not loaded yet, the registration follows its import.
    """
    if "gymnasium" in sys.modules:
        register()
    else:
        sys.meta_path.insert(0, _RegisterAfterImport())


def register() -> None:
    """Adds the environment to Gymnasium's registry; its classes are imported on first use."""
    import gymnasium

    for name in (ENV_ID, TASK_ID):
        gymnasium.register(
            name,
            entry_point=f"{_MODULE}:TaskEnv",
            vector_entry_point=f"{_MODULE}:TaskVectorEnv",
            max_episode_steps=MAX_EPISODE_STEPS,
        )


class _RegisterAfterImport(importlib.abc.MetaPathFinder):
    """Import hook that finds nothing itself, but runs `register` after Gymnasium's import."""

    def find_spec(
        self,
        fullname: str,
        path: Sequence[str] | None,
        target: types.ModuleType | None = None,
    ) -> importlib.machinery.ModuleSpec | None:
        """Gymnasium's own spec, with a loader that registers the environment at its end."""
        if fullname != "gymnasium":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec is not None and spec.loader is not None:
            load = spec.loader.exec_module

            def load_and_register(module: types.ModuleType) -> None:
                load(module)
                register()

            spec.loader.exec_module = load_and_register
        return spec
