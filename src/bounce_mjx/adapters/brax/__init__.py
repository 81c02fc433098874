"""brax: importing this package registers the environment as "bounce_ball".

Then `brax.envs.get_environment("bounce_ball", control_dt=0.02)` returns a
`BraxTaskEnv` with these settings. brax's wrappers and trainers accept it, and also every
`Env`.
"""

from bounce_mjx.errors import needed
from bounce_mjx.lazy import import_mjx

with needed("brax", "bounce_mjx"):
    import_mjx()
    import brax.envs

from bounce_mjx.adapters.brax.environment import ENV_NAME, BraxTaskEnv, make_env
from bounce_mjx.adapters.brax.ppo import (
    device_put_replicated,
    load_brax_policy,
    network_settings,
    ppo_settings,
)
from bounce_mjx.env.env import Env

__all__ = [
    "ENV_NAME",
    "BraxTaskEnv",
    "device_put_replicated",
    "load_brax_policy",
    "network_settings",
    "ppo_settings",
]

# An Env has the interface of brax's Env; this lets it pass brax's isinstance checks.
brax.envs.Env.register(Env)
brax.envs.register_environment(ENV_NAME, make_env)
