"""Algorithms by name: that of the package, and those of imported code."""

from bounce_mjx.config.user_code import class_named
from bounce_mjx.errors import UserError, shorten
from bounce_mjx.learning.algorithm import Algorithm
from bounce_mjx.learning.config import PPO_NAME


def find_algorithm(name: str) -> type[Algorithm]:
    """The algorithm of a name: ppo, or a subclass of `PPO` or `Algorithm` in imported code.

    Raises:
      UserError: there is none.
    """
    if name == PPO_NAME:
        # A command line is read without JAX.
        from bounce_mjx.learning.ppo import PPO

        return PPO
    algorithm = own_algorithm(name)
    if algorithm is None:
        raise UserError(
            f"there is no algorithm {shorten(name)!r}; give ppo, or --import the file of your own"
        )
    return algorithm


def own_algorithm(name: str) -> type[Algorithm] | None:
    """The algorithm of imported code that has a name; None for that of the package, and where no
    imported code has one of that name."""
    return None if name == PPO_NAME else class_named(name, Algorithm)
