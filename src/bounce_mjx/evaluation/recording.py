"""Recordings of an evaluation's episodes, for the figures."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.env.env import Env, State
from bounce_mjx.evaluation.statistics import moment
from bounce_mjx.task.shown import Recording

RECORDED_EPISODES = 32


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
            command=now.command,
            running=running,
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
    joint_angles, offsets = (
        np.moveaxis(np.asarray(values), 1, 2)[steps]
        for values in (recording.joint_angles, recording.ball - recording.paddle)
    )
    points = np.zeros((len(offsets), 2))
    for i, (angles, offset) in enumerate(zip(joint_angles, offsets, strict=True)):
        data.qpos[list(addresses.arm_qpos)] = angles
        mujoco.mj_kinematics(model, data)
        rotation = data.geom_xmat[addresses.paddle_geom].reshape(3, 3)
        points[i] = (rotation.T @ offset)[:2]
    return points
