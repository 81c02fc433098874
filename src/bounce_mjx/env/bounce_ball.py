"""The environment of the task bounce, in a file of its own: `task/bounce.py`, with the settings,
does not import JAX."""

from typing import Any

from bounce_mjx.env.env import Env
from bounce_mjx.task.bounce import Config


class BounceBall(Env):
    """The environment of the original specification."""

    def __init__(self, config: Config | None = None, randomize: Any = None):
        """See `Env`; without a config, the specification's."""
        super().__init__(config or Config(), randomize)
