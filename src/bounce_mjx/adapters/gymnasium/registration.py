"""The environments in Gymnasium's registry."""

import gymnasium

from bounce_mjx.resources import TASK_POLICIES

ENV_ID = "bounce_mjx/BounceBall-v0"
"""Name of the default task's environment."""
TASK_ID = "bounce_mjx/Task-v0"
"""Name of any other one, with the argument `task` or `policy`."""
TASKS = TASK_POLICIES
"""The package's other tasks, which have names such as bounce_mjx/Juggle-v0. A constant, because
finding tasks takes time."""
_MODULE = "bounce_mjx.adapters.gymnasium.environments"


def register() -> None:
    """Adds the environments, for `gymnasium.make` and `gymnasium.make_vec`; their modules are
    imported on first use."""
    arguments = {ENV_ID: {"task": "bounce"}, TASK_ID: {}}
    arguments |= {f"bounce_mjx/{task.title()}-v0": {"task": task} for task in TASKS}
    for name, given in arguments.items():
        # Without max_episode_steps, because the environment keeps its config's time limit.
        gymnasium.register(
            name,
            entry_point=f"{_MODULE}:make_env",
            vector_entry_point=f"{_MODULE}:make_vector_env",
            kwargs=given,
        )
