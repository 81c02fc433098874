"""A robot arm that learns to bounce a ball: an environment on JAX and MuJoCo, with PPO."""

from bounce_mjx.config import EnvConfig
from bounce_mjx.env import BounceBall

__all__ = ["BounceBall", "EnvConfig"]
