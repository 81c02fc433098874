"""Controllers of the arm: random, zero or scripted actions, or a trained policy."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from bounce_mjx.env.env import Env
from bounce_mjx.env.state import State
from bounce_mjx.errors import UserError
from bounce_mjx.learning.policy import Networks, Policy, act

Controller = Callable[[Policy | None, State, jax.Array], jax.Array]
"""A controller of N environments: (policy if it is exchangeable; states, batch last; key, which is
consumed) -> actions [n, N]."""


def make_policy_controller(networks: Networks, policy: Policy) -> Controller:
    """The policy's most likely action."""
    return lambda _, states, key: act(networks, policy, states.obs.T).T


def make_exchangeable_controller(networks: Networks) -> Controller:
    """The most likely action of a policy that is an argument."""
    return lambda policy, states, key: act(networks, policy, states.obs.T).T


def make_random_controller(env: Env) -> Controller:
    """Uniform in [-1, 1]."""
    return lambda _, states, key: jax.random.uniform(
        key, (env.action_size, states.obs.shape[-1]), minval=-1.0, maxval=1.0
    )


def make_zero_controller(env: Env) -> Controller:
    """Zero: the servos hold the measured angles."""
    return lambda _, states, key: jnp.zeros((env.action_size, states.obs.shape[-1]))


def make_scripted_controller(env: Env) -> Controller:
    """The task's own hand-written controller, to compare a policy with.

    Raises:
      UserError: the task has none for this robot.
    """
    script = env.task.script()
    if script is None:
        raise UserError(
            "the task has no scripted controller for this robot; choose --actions random or zero"
        )

    def control(_: Policy | None, states: State, key: jax.Array) -> jax.Array:
        now = states.pipeline_state
        truth = jax.vmap(env.kinematics, in_axes=-1, out_axes=-1)(now)
        return jax.vmap(script, in_axes=-1, out_axes=-1)(truth, now.command)

    return control
