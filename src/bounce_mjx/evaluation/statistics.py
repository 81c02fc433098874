"""Running figures of the episodes of an evaluation, from which the results are computed."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.env.env import Env, State
from bounce_mjx.task.task import Moment, Tally


class Statistics(NamedTuple):
    """Figures over the steps of E episodes, each up to its end."""

    running: jax.Array
    """Whether the episode has not ended [E], bool."""
    steps: jax.Array
    """Steps of the episode [E]."""
    episode_return: jax.Array
    """Sum of the rewards [E]."""
    tally: Tally
    """Sums and greatest values of what the task tallies, each [E]."""


def moment(env: Env, state: State, step: jax.Array) -> Moment:
    """One environment after the control step with this index [], from 0."""
    now = state.pipeline_state
    seconds = (step + 1) * env.dt
    return Moment(
        truth=env.kinematics(now),
        command=now.command,
        state=now.task,
        metrics=state.metrics,
        seconds=seconds,
        command_seconds=seconds if now.redraw is None else now.redraw.age,
    )


def empty_statistics(env: Env, states: State) -> Statistics:
    """Statistics of E episodes (batch last) before their first step."""
    episodes = states.done.shape[-1]
    zeros = jnp.zeros(episodes)
    tally = jax.eval_shape(lambda: _tally(env, states, jnp.int32(0)))
    return Statistics(jnp.ones(episodes, bool), zeros, zeros, jax.tree.map(lambda _: zeros, tally))


def accumulate(env: Env, statistics: Statistics, states: State, step: jax.Array) -> Statistics:
    """Adds one control step of E environments (batch last) to their statistics.

    It reads the true state, not the observation, which may be noisy.

    Args:
      states: the states after the step.
      step: index of the step [], from 0.
    """
    s, now, running = statistics, _tally(env, states, step), statistics.running
    counted = jax.tree.map(lambda value: jnp.where(running, value, 0.0), now)
    return Statistics(
        running=running & (states.done == 0),
        steps=s.steps + running,
        episode_return=s.episode_return + jnp.where(running, states.reward, 0.0),
        tally=Tally(
            sums=jax.tree.map(jnp.add, s.tally.sums, counted.sums),
            maxima=jax.tree.map(jnp.maximum, s.tally.maxima, counted.maxima),
        ),
    )


def _tally(env: Env, states: State, step: jax.Array) -> Tally:
    tally = lambda state: env.task.tally(moment(env, state, step))  # noqa: E731
    return jax.vmap(tally, in_axes=-1, out_axes=-1)(states)
