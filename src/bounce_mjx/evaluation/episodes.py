"""Compiled evaluations on the environment's own physics engine."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bounce_mjx.env.env import Env, State
from bounce_mjx.evaluation import statistics
from bounce_mjx.evaluation.statistics import Measured
from bounce_mjx.learning.policy import Actor, Policy
from bounce_mjx.task.task import Recording
from bounce_mjx.world.randomization import Ranges

BLOCK = 64
"""Evaluations are filled up to a multiple of it, and a film on a CPU is one block: the CPU's vector
instructions then have no remainder, and an episode is the same bit for bit in any of them."""

Evaluator = Callable[..., Measured]
"""Measures E episodes without action noise: (policy, key, optional ranges as for `reset_episodes`)
-> `Measured`. A filmer measures one."""


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
    is reached.

    They are simulated in whole blocks (`_lanes`), so that on a CPU an episode is the same in any
    number of them, and a film shows it as it was. Fewer than a block in MJX are not filled up, and
    their last bits may depend on their number.
    """
    lanes = _lanes(env, episodes)

    def evaluate(policy: Policy, key: jax.Array, ranges: Ranges | None = None) -> Measured:
        states = _reset_lanes(env, key, episodes, lanes, ranges)
        shown = min(recorded, episodes)
        statistics, recording = run_episodes(env, actor, policy, states, shown)
        return jax.tree.map(lambda x: x[:episodes], statistics), recording

    return jax.jit(evaluate)


def make_filmer(env: Env, actor: Actor, episodes: int, episode: int) -> Evaluator:
    """A jitted simulation of one of `episodes` episodes, as `make_evaluator` simulates it, with a
    recording of this episode alone [T, ..., 1].

    On a CPU its block alone is simulated, and it is the same bit for bit. On other devices the
    batch is the evaluation's own, but the episode has another place in it, which may change the
    last bits of its actions.
    """
    lanes = _lanes(env, episodes)
    simulated = np.arange(len(lanes))
    if jax.default_backend() != "cpu":
        simulated = np.roll(simulated, -episode)
        place = 0
    else:
        first = episode // BLOCK * BLOCK
        simulated = simulated[first : first + BLOCK]
        place = episode - first
    # A recording is of the first ones.
    recorded = place + 1

    def evaluate(policy: Policy, key: jax.Array, ranges: Ranges | None = None) -> Measured:
        # All of them, as in the evaluation: a smaller batch may differ in the last bits.
        states = _reset_lanes(env, key, episodes, lanes, ranges)
        states = jax.tree.map(lambda x: x[..., simulated], states)
        statistics, recording = run_episodes(env, actor, policy, states, recorded)
        its_statistics = jax.tree.map(lambda x: x[place : place + 1], statistics)
        return its_statistics, jax.tree.map(lambda x: x[..., place : place + 1], recording)

    return jax.jit(evaluate)


def _lanes(env: Env, episodes: int) -> np.ndarray:
    """Which episode each place of the batch simulates: all in order, then the last one again up to
    whole blocks."""
    total = -(-episodes // BLOCK) * BLOCK
    if env.engine.name != "fused" and episodes < BLOCK:
        # A copy in MJX takes as long as an episode. Without, the last bits may differ.
        total = episodes
    return np.minimum(np.arange(total), episodes - 1)


def run_episodes(env: Env, actor: Actor, policy: Policy, states: State, recorded: int) -> Measured:
    """Runs one episode without action noise from each of E initial states (batch last), until all
    have ended or their time limit is reached, and records the first `recorded`."""
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
    return _reset_lanes(env, key, episodes, np.arange(episodes), ranges)


def _reset_lanes(
    env: Env, key: jax.Array, episodes: int, lanes: np.ndarray, ranges: Ranges | None
) -> State:
    """`reset_episodes` of the episodes with some indices, which may repeat.

    With JAX's default keys, which are partitionable, the i-th is the same for any number of them.
    """
    if ranges is None:
        return jax.vmap(env.reset, out_axes=-1)(jax.random.split(key, episodes)[lanes])
    conditions = len(jax.tree.leaves(ranges)[0])
    per_condition = episodes // conditions
    keys = jax.random.split(key, per_condition)[lanes % per_condition]
    ranges = jax.tree.map(lambda end: jnp.asarray(end)[lanes // per_condition], ranges)
    return jax.vmap(env.reset, out_axes=-1)(keys, ranges)
