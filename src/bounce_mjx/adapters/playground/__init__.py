"""MuJoCo Playground: importing this package registers the environment as "BounceBall", and those
of the other tasks, such as "BounceMjxCatch".

`python -m bounce_mjx.adapters.playground --env_name=BounceBall` is Playground's `train-jax-ppo`.
"""

import contextlib
import sys

from bounce_mjx.errors import exit_on_user_error

# As long as Python looks for the program of `python -m`, the first argument is -m.
_is_program = sys.argv[:1] == ["-m"]
with exit_on_user_error() if _is_program else contextlib.nullcontext():
    from bounce_mjx.adapters.playground.environment import PlaygroundTaskEnv
    from bounce_mjx.adapters.playground.registration import register

    register()

__all__ = ["PlaygroundTaskEnv"]
