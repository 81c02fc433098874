"""Algorithms by name: that of the package, and those of imported code."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from bounce_mjx.config.user_code import class_of
from bounce_mjx.errors import UserError, shorten
from bounce_mjx.learning.config import PPO_NAME

if TYPE_CHECKING:
    from bounce_mjx.learning.ppo import PPO


def find_algorithm(name: str) -> type[PPO]:
    """The algorithm of a name: ppo, or a subclass of `PPO` in imported code.

    Raises:
      UserError: there is none.
    """
    # A command line is read without JAX.
    from bounce_mjx.learning.ppo import PPO

    algorithm = PPO if name == PPO_NAME else own_algorithm(name)
    if algorithm is None:
        raise UserError(
            f"there is no algorithm {shorten(name)!r}; give ppo, or --import the file of your own"
        )
    return algorithm


def own_algorithm(name: str) -> type[PPO] | None:
    """The algorithm of imported code that has a name; None for that of the package."""
    # Whoever has written one has imported it.
    module = sys.modules.get("bounce_mjx.learning.ppo")
    return None if module is None or name == PPO_NAME else class_of(name, module.PPO)
