"""A robot arm that learns to bounce a ball: an environment on JAX and MuJoCo, with PPO."""

import importlib
import sys
from typing import TYPE_CHECKING, Any

from bounce_mjx.resources import VERSION as __version__

if TYPE_CHECKING:
    from bounce_mjx.deploy.loading import load_policy
    from bounce_mjx.env.bounce_ball import BounceBall
    from bounce_mjx.task.bounce import Config as EnvConfig
    from bounce_mjx.training.run import Run, train

__all__ = ["BounceBall", "EnvConfig", "Run", "__version__", "load_policy", "train"]

_PUBLIC = {
    "BounceBall": ("bounce_mjx.env.bounce_ball", "BounceBall"),
    "EnvConfig": ("bounce_mjx.task.bounce", "Config"),
    "Run": ("bounce_mjx.training.run", "Run"),
    "load_policy": ("bounce_mjx.deploy.loading", "load_policy"),
    "train": ("bounce_mjx.training.run", "train"),
}

if "gymnasium" in sys.modules:
    # So that Gymnasium's own form, "bounce_mjx:bounce_mjx/BounceBall-v0", finds the environments.
    importlib.import_module("bounce_mjx.adapters.gymnasium")


def __getattr__(name: str) -> Any:
    """Imports the public names on first use (PEP 562): JAX takes two seconds to import, and a
    deployed policy does not need it."""
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _PUBLIC[name]
    return getattr(importlib.import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
