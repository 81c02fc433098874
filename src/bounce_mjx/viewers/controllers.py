"""Controllers of the arm: random, zero or scripted actions, or a trained policy."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.env.env import Env
from bounce_mjx.env.state import State
from bounce_mjx.errors import UserError
from bounce_mjx.learning.policy import Memory, Networks, Policy, act_with_memory


class Controller(NamedTuple):
    """A controller of N environments."""

    act: Callable[[Policy | None, State, jax.Array, Memory], tuple[jax.Array, Memory]]
    """(policy if it is exchangeable; states, batch last; key, which is consumed; memory) ->
    actions [n, N], memory."""
    start_memory: Callable[[tuple[int, ...]], Memory]
    """Shape of the batch -> memory at the start of an episode."""


def make_policy_controller(networks: Networks, policy: Policy) -> Controller:
    """The policy's most likely action."""
    exchangeable = make_exchangeable_controller(networks)
    return exchangeable._replace(act=lambda _, *args: exchangeable.act(policy, *args))


def make_exchangeable_controller(networks: Networks) -> Controller:
    """The most likely action of a policy that is an argument."""

    def control(
        policy: Policy, states: State, key: jax.Array, memory: Memory
    ) -> tuple[jax.Array, Memory]:
        actions, memory = act_with_memory(networks, policy, states.obs.T, memory)
        return actions.T, memory

    return Controller(control, networks.policy_network.start_memory)


def make_random_controller(env: Env) -> Controller:
    """Uniform in [-1, 1]."""
    return _without_memory(
        lambda states, key: jax.random.uniform(
            key, (env.action_size, states.obs.shape[-1]), minval=-1.0, maxval=1.0
        )
    )


def make_zero_controller(env: Env) -> Controller:
    """Zero: the servos hold the measured angles."""
    return _without_memory(lambda states, key: jnp.zeros((env.action_size, states.obs.shape[-1])))


def make_scripted_controller(env: Env) -> Controller:
    """The task's own hand-written controller, to compare a policy with.

    Raises:
      UserError: the task has none for this robot.
    """
    act = env.task.script()
    if act is None:
        raise UserError(
            "the task has no scripted controller for this robot; choose --actions random or zero"
        )

    def control(states: State, key: jax.Array) -> jax.Array:
        now = states.pipeline_state
        truth = jax.vmap(env.kinematics, in_axes=-1, out_axes=-1)(now)
        return jax.vmap(act, in_axes=-1, out_axes=-1)(truth, now.command)

    return _without_memory(control)


def _without_memory(control: Callable[[State, jax.Array], jax.Array]) -> Controller:
    return Controller(
        act=lambda _, states, key, memory: (control(states, key), memory),
        start_memory=lambda batch: (),
    )
