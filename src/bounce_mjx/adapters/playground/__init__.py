"""MuJoCo Playground: importing this package registers the environment as "BounceBall"."""

from bounce_mjx.adapters.playground.environment import PlaygroundBounceBall

__all__ = ["PlaygroundBounceBall"]
