"""MuJoCo Playground: importing this package puts the environment into its registry."""

from bounce_mjx.adapters.playground.environment import PlaygroundBounceBall

__all__ = ["PlaygroundBounceBall"]
