"""Compiled evaluations on the environment's own physics engine."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.env.env import Env, State
from bounce_mjx.evaluation import statistics
from bounce_mjx.evaluation.statistics import Measured
from bounce_mjx.learning.policy import Actor, Policy
from bounce_mjx.task.task import Recording
from bounce_mjx.world.randomization import Ranges

Evaluator = Callable[..., Measured]
"""Measures E deterministic episodes from a policy, a key and optional ranges."""


class Batch(NamedTuple):
    """E episodes that are being simulated, batch last."""

    states: State
    statistics: statistics.Statistics
    recording: Recording
    step: jax.Array
    """Control steps so far [], int32."""


def make_evaluator(env: Env, actor: Actor, episodes: int, recorded: int = 0) -> Evaluator:
    """A jitted evaluation of `episodes` episodes, each from its own reset (`reset_episodes`), with
    a recording of the first `recorded`. It stops when all episodes have ended or their time limit
    is reached."""

    def evaluate(policy: Policy, key: jax.Array, ranges: Ranges | None = None) -> Measured:
        states = reset_episodes(env, key, episodes, ranges)
        return run_episodes(env, actor, policy, states, recorded)

    return jax.jit(evaluate)


def run_episodes(env: Env, actor: Actor, policy: Policy, states: State, recorded: int) -> Measured:
    """Runs one deterministic episode from each of E initial states (batch last), until all have
    ended or their time limit is reached, and records the first `recorded`."""
    first = begin(env, states, recorded)
    last = run_until(env, actor, policy, first, env.config.episode_steps)
    return last.statistics, last.recording


def begin(env: Env, states: State, recorded: int) -> Batch:
    """Episodes before their first step, from initial states (batch last)."""
    return Batch(
        states=states,
        statistics=statistics.empty_statistics(env, states),
        recording=statistics.empty_recording(env, states, min(recorded, states.done.shape[-1])),
        step=jnp.int32(0),
    )


def run_until(
    env: Env, actor: Actor, policy: Policy | None, now: Batch, last_step: int | jax.Array
) -> Batch:
    """Continues until all episodes have ended or `last_step` is reached."""

    def unfinished(now: Batch) -> jax.Array:
        return jnp.any(now.statistics.running) & (now.step < last_step)

    def advance(now: Batch) -> Batch:
        actions = actor.act(policy, now.states.obs.T)
        states = jax.vmap(env.step, in_axes=-1, out_axes=-1)(now.states, actions.T)
        return add_step(env, now, states)

    return jax.lax.while_loop(unfinished, advance, now)


def add_step(env: Env, before: Batch, states: State) -> Batch:
    """The batch after one more control step.

    Args:
      states: the states after it.
    """
    running = before.statistics.running
    return Batch(
        states=states,
        statistics=statistics.accumulate(env, before.statistics, states, before.step),
        recording=statistics.record(env, before.recording, states, running, before.step),
        step=before.step + 1,
    )


def reset_episodes(env: Env, key: jax.Array, episodes: int, ranges: Ranges | None = None) -> State:
    """The initial states of N episodes, batch last; consumes the key.

    Args:
      ranges: the ranges of C conditions, each end [C, ...], as for `Env.reset`. Every condition has
        N / C episodes, and all conditions use the same keys, so that they differ only in their
        ranges. The default is one condition with the config's ranges.
    """
    if ranges is None:
        return jax.vmap(env.reset, out_axes=-1)(jax.random.split(key, episodes))
    conditions = len(jax.tree.leaves(ranges)[0])
    each = episodes // conditions
    index = jnp.arange(episodes)
    keys = jax.random.split(key, each)[index % each]
    ranges = jax.tree.map(lambda end: jnp.asarray(end)[index // each], ranges)
    return jax.vmap(env.reset, out_axes=-1)(keys, ranges)
