"""Registers the environments with Gymnasium, before or after Gymnasium is imported."""

import importlib.abc
import importlib.machinery
import sys
from collections.abc import Sequence

ENV_ID = "bounce_mjx/BounceBall-v0"
"""Name of the specification's environment."""
TASK_ID = "bounce_mjx/Task-v0"
"""Name of any other one, with the argument `task` or `policy`."""
TASKS = ("balance", "catch", "juggle", "track")
"""The package's other tasks, which have names such as bounce_mjx/Juggle-v0. A constant, because
finding tasks takes time at each import of Gymnasium."""
_MODULE = "bounce_mjx.adapters.gymnasium.environments"


def register_when_imported() -> None:
    """Makes `gymnasium.make` and `gymnasium.make_vec` work for `ENV_ID`, for `TASK_ID`, and for
    each of the package's tasks, such as bounce_mjx/Juggle-v0.

    Gymnasium is optional and takes half a second to import, so it is not imported here. If it is
    not loaded yet, the registration follows its import.
    """
    if "gymnasium" in sys.modules:
        register()
    else:
        sys.meta_path.insert(0, _Finder())


class _Finder(importlib.abc.MetaPathFinder):
    """Finds Gymnasium, after whose import the environments are registered."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: object = None
    ) -> importlib.machinery.ModuleSpec | None:
        if name != "gymnasium":
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path)
        if spec is not None and spec.loader is not None:
            load = spec.loader.exec_module
            spec.loader.exec_module = lambda module: (load(module), register())
        return spec


def register() -> None:
    """Adds the environments to Gymnasium's registry; their classes are imported on first use."""
    import gymnasium

    arguments = {ENV_ID: {"task": "bounce"}, TASK_ID: {}}
    arguments |= {f"bounce_mjx/{task.title()}-v0": {"task": task} for task in TASKS}
    for name, given in arguments.items():
        # Without max_episode_steps, because the environment keeps its config's time limit.
        gymnasium.register(
            name,
            entry_point=f"{_MODULE}:TaskEnv",
            vector_entry_point=f"{_MODULE}:TaskVectorEnv",
            kwargs=given,
        )
