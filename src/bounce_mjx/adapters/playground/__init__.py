"""MuJoCo Playground: importing this package registers the environment as "BounceBall".

`python -m bounce_mjx.adapters.playground --env_name=BounceBall` is Playground's `train-jax-ppo`.
"""

from bounce_mjx.adapters.playground.environment import PlaygroundBounceBall
from bounce_mjx.adapters.playground.registration import register

__all__ = ["PlaygroundBounceBall"]

register()
