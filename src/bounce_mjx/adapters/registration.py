"""Puts the environment into the registries of brax and of Gymnasium."""

import contextlib

import brax.envs

from bounce_mjx.task.env import BounceBall


def register() -> None:
    """Makes `brax.envs.get_environment("bounce_ball")` and, where Gymnasium is installed,
    `gymnasium.make` and `gymnasium.make_vec("bounce_mjx/BounceBall-v0")` work. MuJoCo Playground,
    whose import takes seconds, is served by `import
    bounce_mjx.adapters.playground`."""
    brax.envs.register_environment("bounce_ball", BounceBall)
    with contextlib.suppress(ImportError):
        import gymnasium

        gymnasium.register(
            "bounce_mjx/BounceBall-v0",
            entry_point="bounce_mjx.adapters.gymnasium.environments:BounceBallEnv",
            vector_entry_point="bounce_mjx.adapters.gymnasium.environments:BounceBallVectorEnv",
        )
