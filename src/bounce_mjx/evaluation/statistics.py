"""Running sums over the episodes of an evaluation, from which the five results are computed."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.task.env import BounceBall
from bounce_mjx.task.state import State

SETTLING_SECONDS = 2.0
"""Time at the start of an episode that does not count for the horizontal position and the height,
s. For the height, the same time after a change of the target does not count either."""

MAX_X_ERROR = 0.05
"""Largest distance of a centred ball from the target point along x, m."""

MAX_APEX_ERROR = 0.1
"""Largest distance of an accurate apex from the target height, m."""


class Statistics(NamedTuple):
    """Sums over the steps of E episodes, each up to its end."""

    running: jax.Array
    """Whether the episode has not ended [E], bool."""
    steps: jax.Array
    """Steps of the episode [E]."""
    episode_return: jax.Array
    """Sum of the rewards [E]."""
    max_bounces: jax.Array
    """Largest bounce count of the episode [E]."""
    settled_steps: jax.Array
    """Steps after `SETTLING_SECONDS` [E]."""
    centred_steps: jax.Array
    """Settled steps with the ball's x within `MAX_X_ERROR` of the target point [E]."""
    settled_bounces: jax.Array
    """Bounces at least `SETTLING_SECONDS` after the reset and after any change of the target
    [E]."""
    accurate_bounces: jax.Array
    """Settled bounces with an apex within `MAX_APEX_ERROR` of the target height [E]."""
    apex_error: jax.Array
    """Sum of |apex - target height| over the settled bounces [E], m."""
    rising_steps: jax.Array
    """Steps on which the ball rose [E]."""
    rising_speed: jax.Array
    """Sum of the ball's vertical velocity over the rising steps [E], m/s."""


def empty_statistics(episodes: int) -> Statistics:
    """Statistics before the first step."""
    zeros = jnp.zeros(episodes)
    return Statistics(jnp.ones(episodes, bool), *[zeros] * (len(Statistics._fields) - 1))


def accumulate(
    env: BounceBall, statistics: Statistics, states: State, step: jax.Array
) -> Statistics:
    """Adds one control step of E environments (batch last) to their statistics.

    It reads the true state, not the observation, which may be noisy.

    Args:
      states: the states after the step.
      step: index of the step [], from 0.
    """
    s, metrics = statistics, states.metrics
    running = s.running
    settling_steps = round(SETTLING_SECONDS / env.dt)
    settled = running & (step >= settling_steps)
    kinematics = jax.vmap(env.kinematics, in_axes=-1, out_axes=-1)(states.pipeline_state)
    x, vz = kinematics.ball_position[0], kinematics.ball_velocity[2]
    centred = jnp.abs(x - env.config.reward.target_x) <= MAX_X_ERROR
    bounced = settled & (metrics["bounced"] > 0)
    if "target_interval" in states.pipeline_state.world:
        age = states.pipeline_state.memory.target_age / env.dt
        bounced &= jnp.round(age) > settling_steps
    accurate = metrics["apex_error"] <= MAX_APEX_ERROR
    rising = running & (vz > 0.0)
    return Statistics(
        running=running & (states.done == 0),
        steps=s.steps + running,
        episode_return=s.episode_return + jnp.where(running, states.reward, 0.0),
        max_bounces=jnp.maximum(s.max_bounces, jnp.where(running, metrics["n_bounces"], 0.0)),
        settled_steps=s.settled_steps + settled,
        centred_steps=s.centred_steps + (settled & centred),
        settled_bounces=s.settled_bounces + bounced,
        accurate_bounces=s.accurate_bounces + (bounced & accurate),
        apex_error=s.apex_error + jnp.where(bounced, metrics["apex_error"], 0.0),
        rising_steps=s.rising_steps + rising,
        rising_speed=s.rising_speed + jnp.where(rising, vz, 0.0),
    )
