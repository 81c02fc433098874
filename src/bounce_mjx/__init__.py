"""A robot arm that learns to bounce a ball: an environment on JAX and MuJoCo, with PPO."""

import contextlib
import io

# MJX prints a line to stdout for each of its optional parts that is not installed.
with contextlib.redirect_stdout(io.StringIO()):
    import mujoco.mjx  # noqa: F401

from bounce_mjx.adapters.registration import register as _register
from bounce_mjx.task.config import EnvConfig
from bounce_mjx.task.env import BounceBall

__all__ = ["BounceBall", "EnvConfig"]

_register()
