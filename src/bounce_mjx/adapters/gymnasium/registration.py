"""Registers the environment with Gymnasium, before or after Gymnasium is imported."""

import sys

from bounce_mjx.lazy import around_import

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
        around_import("gymnasium", after=lambda module: register())


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
