"""Controllers of the arm: random or zero actions, a trained policy, or a law."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from bounce_mjx.env.env import Env
from bounce_mjx.env.state import State
from bounce_mjx.learning.policy import Actor, Policy

Controller = Callable[[Policy | None, State, jax.Array], jax.Array]
"""A controller of N environments: (policy if it is exchangeable; states, batch last; key, which is
consumed) -> actions [n, N]."""


def make_policy_controller(actor: Actor, policy: Policy | None) -> Controller:
    """The policy's most likely action."""
    return lambda _, states, key: actor.act(policy, states.obs.T).T


def make_exchangeable_controller(actor: Actor) -> Controller:
    """The most likely action of a policy that is an argument."""
    return lambda policy, states, key: actor.act(policy, states.obs.T).T


def make_random_controller(env: Env) -> Controller:
    """Uniform in [-1, 1]."""
    return lambda _, states, key: jax.random.uniform(
        key, (env.action_size, states.obs.shape[-1]), minval=-1.0, maxval=1.0
    )


def make_zero_controller(env: Env) -> Controller:
    """Zero: the servos hold the measured angles."""
    return lambda _, states, key: jnp.zeros((env.action_size, states.obs.shape[-1]))
