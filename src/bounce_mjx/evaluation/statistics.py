"""Statistics of the episodes of an evaluation, from which the results are computed, and recordings
of the first ones, for pictures and checks."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.env.contract import ENDS
from bounce_mjx.env.env import Env, State
from bounce_mjx.task.task import Moment, Recording, Tally

RECORDED_EPISODES = 32
"""Episodes that a report, a plot and the checks of an evaluation record."""


class Statistics(NamedTuple):
    """Numbers over the steps of E episodes, each up to its end."""

    running: jax.Array
    """Whether the episode has not ended [E], bool; of a whole evaluation, whether it lasted until
    its time limit. (That of a `Recording` is before the step.)"""
    steps: jax.Array
    """Steps of the episode [E]."""
    episode_return: jax.Array
    """Sum of the rewards [E]."""
    tally: Tally
    """Sums and greatest values of what the task tallies, each [E]."""
    ended_by: dict[str, jax.Array] = {}
    """Whether the episode ended by each of `ENDS` [E], bool; of those that ended, the task
    ended the others."""
    world: dict[str, jax.Array] = {}
    """World of the episode: its values of the active terms [E, ...]."""
    goal: dict[str, jax.Array] = {}
    """First value of each goal [E]."""


Measured = tuple[Statistics, Recording]
"""Statistics of all episodes of an evaluation, and a recording of the first ones."""


def moment(env: Env, state: State, step: jax.Array) -> Moment:
    """One environment after the control step with this index [], from 0."""
    now = state.pipeline_state
    seconds = (step + 1) * env.dt
    return Moment(
        truth=env.kinematics(now),
        goal=now.goal,
        state=now.task,
        metrics=state.metrics,
        seconds=seconds,
        goal_seconds=seconds if now.redraw is None else now.redraw.age,
    )


def empty_statistics(env: Env, states: State) -> Statistics:
    """Statistics of E episodes (batch last) before their first step."""
    episodes = states.done.shape[-1]
    zeros = jnp.zeros(episodes)
    tally = jax.eval_shape(lambda: _tallies(env, states, jnp.int32(0)))
    start = states.pipeline_state
    return Statistics(
        running=jnp.ones(episodes, bool),
        steps=zeros,
        episode_return=zeros,
        tally=jax.tree.map(lambda _: zeros, tally),
        ended_by={name: jnp.zeros(episodes, bool) for name in ENDS if name in states.metrics},
        world={name: jnp.moveaxis(value, -1, 0) for name, value in start.world.items()},
        goal=dict(start.goal),
    )


def accumulate(env: Env, statistics: Statistics, states: State, step: jax.Array) -> Statistics:
    """Adds one control step of E environments (batch last) to their statistics.

    It reads the true state, not the observation, which may be noisy.

    Args:
      states: the states after the step.
      step: index of the step [], from 0.
    """
    running = statistics.running
    tallied = _tallies(env, states, step)
    counted = jax.tree.map(lambda figure: jnp.where(running, figure, 0.0), tallied)
    before = statistics.tally
    tally = Tally(
        sums=jax.tree.map(jnp.add, before.sums, counted.sums),
        maxima=jax.tree.map(jnp.maximum, before.maxima, counted.maxima),
    )
    ended_by = {
        name: ended | (running & (states.metrics[name] > 0))
        for name, ended in statistics.ended_by.items()
    }
    return statistics._replace(
        running=running & (states.done == 0),
        steps=statistics.steps + running,
        episode_return=statistics.episode_return + jnp.where(running, states.reward, 0.0),
        tally=tally,
        ended_by=ended_by,
    )


def _tallies(env: Env, states: State, step: jax.Array) -> Tally:
    """What the task tallies of the step in each of E environments, [E]."""

    def tally(state: State) -> Tally:
        return env.task.tally(moment(env, state, step))

    return jax.vmap(tally, in_axes=-1, out_axes=-1)(states)


def empty_recording(env: Env, states: State, episodes: int) -> Recording:
    """A recording of the first K of E environments (batch last) before the first step."""
    states = _part(states, episodes)
    running = jnp.zeros(states.done.shape, bool)
    steps = env.config.episode_steps
    shapes = jax.eval_shape(lambda: _row(env, states, running, jnp.int32(0)))
    return jax.tree.map(lambda x: jnp.zeros((steps, *x.shape), x.dtype), shapes)


def record(
    env: Env, recording: Recording, states: State, running: jax.Array, step: jax.Array
) -> Recording:
    """Writes one control step of the first K of E environments (batch last) into the recording.

    It reads the true state, not the observation, which may be noisy.

    Args:
      states: the states after the step.
      running: whether each episode had not ended before the step [E], bool.
      step: index of the step [], from 0.
    """
    episodes = recording.running.shape[-1]
    if not episodes:
        return recording
    now = _row(env, _part(states, episodes), running[..., :episodes], step)
    return jax.tree.map(lambda kept, new: kept.at[step].set(new), recording, now)


def _part(states: State, episodes: int) -> State:
    return jax.tree.map(lambda x: x[..., :episodes], states)


def _row(env: Env, states: State, running: jax.Array, step: jax.Array) -> Recording:
    """One control step of a recording."""

    def one(state: State, running: jax.Array) -> Recording:
        now = moment(env, state, step)
        setpoint = state.pipeline_state.actuation.setpoint
        return Recording(
            joint_angles=now.truth.joint_angles,
            ball=now.truth.ball_position,
            paddle=now.truth.paddle_position,
            goal=now.goal,
            running=running,
            terminated=running & (state.done > 0),
            command_velocity=None if setpoint is None else setpoint.velocity,
            qpos=state.pipeline_state.physics.qpos,
            metrics=state.metrics,
        )

    return jax.vmap(one, in_axes=-1, out_axes=-1)(states, running)


def paddle_points(env: Env, recording: Recording, steps: np.ndarray) -> np.ndarray:
    """Ball position over the paddle: x and y in the paddle's own frame, from its centre [N, 2], m.

    Args:
      steps: whether each step is one to measure [T, K]; N are true.
    """
    model, addresses = env.mj_model, env.addresses
    data = mujoco.MjData(model)
    joint_angles = np.moveaxis(np.asarray(recording.joint_angles), 1, 2)[steps]
    from_paddle = np.asarray(recording.ball - recording.paddle)
    offsets = np.moveaxis(from_paddle, 1, 2)[steps]
    points = np.zeros((len(offsets), 2))
    for i, (angles, offset) in enumerate(zip(joint_angles, offsets, strict=True)):
        data.qpos[list(addresses.arm_qpos)] = angles
        mujoco.mj_kinematics(model, data)
        rotation = data.geom_xmat[addresses.paddle_geom].reshape(3, 3)
        points[i] = (rotation.T @ offset)[:2]
    return points
