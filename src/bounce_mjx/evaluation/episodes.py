"""Compiled evaluations on the environment's own physics engine."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from bounce_mjx.evaluation.recording import Recording, empty_recording, record
from bounce_mjx.evaluation.statistics import Statistics, accumulate, empty_statistics
from bounce_mjx.learning.policy import Networks, Policy, act
from bounce_mjx.task.env import BounceBall


def make_evaluator(
    env: BounceBall, networks: Networks, episodes: int
) -> Callable[[Policy, jax.Array], Statistics]:
    """A jitted function (policy, key) -> statistics of `episodes` deterministic episodes, each
    from its own reset; it stops when all have ended or the time is over."""
    recording_evaluator = make_recording_evaluator(env, networks, episodes, recorded=0)

    def evaluate(policy: Policy, key: jax.Array) -> Statistics:
        return recording_evaluator(policy, key)[0]

    return jax.jit(evaluate)


def make_recording_evaluator(
    env: BounceBall, networks: Networks, episodes: int, recorded: int
) -> Callable[[Policy, jax.Array], tuple[Statistics, Recording]]:
    """Like `make_evaluator`, with a recording of the first `recorded` episodes too."""

    def evaluate(policy: Policy, key: jax.Array) -> tuple[Statistics, Recording]:
        states = jax.vmap(env.reset, out_axes=-1)(jax.random.split(key, episodes))

        def unfinished(carry):
            _, statistics, _, step = carry
            return jnp.any(statistics.running) & (step < env.config.episode_steps)

        def advance(carry):
            states, statistics, recording, step = carry
            actions = act(networks, policy, states.obs.T)
            states = jax.vmap(env.step, in_axes=-1, out_axes=-1)(states, actions.T)
            recording = record(env, recording, states, statistics.running, step)
            return states, accumulate(env, statistics, states, step), recording, step + 1

        recording = empty_recording(env.config.episode_steps, min(recorded, episodes))
        carry = (states, empty_statistics(episodes), recording, jnp.int32(0))
        _, statistics, recording, _ = jax.lax.while_loop(unfinished, advance, carry)
        return statistics, recording

    return jax.jit(evaluate)
