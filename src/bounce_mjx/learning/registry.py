"""Algorithms by name: that of the package, and those in a file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bounce_mjx.config.user_code import class_in_file, is_file
from bounce_mjx.errors import UserError, shorten
from bounce_mjx.learning.config import PPO_NAME

if TYPE_CHECKING:
    from bounce_mjx.learning.ppo import PPO


def find_algorithm(name: str) -> type[PPO]:
    """The algorithm of a name: ppo, or a subclass of `PPO` in FILE.py:CLASS.

    Raises:
      UserError: there is none.
    """
    # A command line is read without JAX.
    from bounce_mjx.learning.ppo import PPO

    if is_file(name):
        return class_in_file(name, PPO)
    if name != PPO_NAME:
        raise UserError(f"there is no algorithm {shorten(name)!r}; give ppo or FILE.py:CLASS")
    return PPO
