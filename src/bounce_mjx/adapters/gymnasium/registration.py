"""Registers the environments with Gymnasium, before or after Gymnasium is imported."""

import sys

from bounce_mjx.lazy import around_import

ENV_ID = "bounce_mjx/BounceBall-v0"
"""Name of the specification's environment."""
TASK_ID = "bounce_mjx/Task-v0"
"""Name of any other one, with the argument `task`."""
MAX_EPISODE_STEPS = 2000
"""Steps of their episodes. Constants, because reading a config takes time at each import of
Gymnasium."""
EPISODE_STEPS = {"balance": 2000, "catch": 300, "juggle": 2000, "track": 2000}
"""Steps of an episode of the package's other tasks, which have names such as
bounce_mjx/Juggle-v0."""
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
        around_import("gymnasium", after=lambda module: register())


def register() -> None:
    """Adds the environments to Gymnasium's registry; their classes are imported on first use."""
    import gymnasium

    environments = dict.fromkeys((ENV_ID, TASK_ID), (MAX_EPISODE_STEPS, {}))
    for task, steps in EPISODE_STEPS.items():
        environments[f"bounce_mjx/{task.title()}-v0"] = steps, {"task": task}
    for name, (steps, arguments) in environments.items():
        gymnasium.register(
            name,
            entry_point=f"{_MODULE}:TaskEnv",
            vector_entry_point=f"{_MODULE}:TaskVectorEnv",
            max_episode_steps=steps,
            kwargs=arguments,
        )
