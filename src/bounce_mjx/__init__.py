"""A robot arm that learns to bounce a ball: an environment on JAX and MuJoCo, with PPO."""

from typing import TYPE_CHECKING, Any

from bounce_mjx.adapters.gymnasium.registration import register_when_imported

if TYPE_CHECKING:
    from bounce_mjx.task.config import EnvConfig
    from bounce_mjx.task.env import BounceBall

__all__ = ["BounceBall", "EnvConfig"]

register_when_imported()


def __getattr__(name: str) -> Any:
    """Imports the public classes on first use, as JAX takes two seconds to import (PEP 562)."""
    if name == "BounceBall":
        from bounce_mjx.task.env import BounceBall

        return BounceBall
    if name == "EnvConfig":
        from bounce_mjx.task.config import EnvConfig

        return EnvConfig
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
