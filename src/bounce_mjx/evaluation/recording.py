"""Recordings of an evaluation's episodes, for the figures."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.robot.model import find_addresses
from bounce_mjx.task.env import BounceBall
from bounce_mjx.task.state import State

RECORDED_EPISODES = 32


class Recording(NamedTuple):
    """T control steps of K episodes; entries after the end of an episode are undefined."""

    joint_angles: jax.Array
    """Positions of the acting joints after the step [T, n, K], rad."""
    ball: jax.Array
    """Ball positions after the step [T, 3, K], m."""
    paddle: jax.Array
    """Positions of the paddle's centre after the step [T, 3, K], m."""
    target_height: jax.Array
    """Target heights [T, K], m."""
    bounced: jax.Array
    """Whether the step was a bounce [T, K], bool."""
    apex: jax.Array
    """Highest ball position since the last bounce, after the step [T, K], m."""
    running: jax.Array
    """Whether the episode had not ended before the step [T, K], bool."""


def empty_recording(steps: int, num_joints: int, episodes: int) -> Recording:
    """A recording before the first step."""
    return Recording(
        joint_angles=jnp.zeros((steps, num_joints, episodes)),
        ball=jnp.zeros((steps, 3, episodes)),
        paddle=jnp.zeros((steps, 3, episodes)),
        target_height=jnp.zeros((steps, episodes)),
        bounced=jnp.zeros((steps, episodes), bool),
        apex=jnp.zeros((steps, episodes)),
        running=jnp.zeros((steps, episodes), bool),
    )


def record(
    env: BounceBall, recording: Recording, states: State, running: jax.Array, step: jax.Array
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
    states, running = jax.tree.map(lambda x: x[..., :episodes], (states, running))
    kinematics = jax.vmap(env.kinematics, in_axes=-1, out_axes=-1)(states.pipeline_state)
    now = Recording(
        joint_angles=kinematics.joint_angles,
        ball=kinematics.ball_position,
        paddle=kinematics.paddle_position,
        target_height=states.pipeline_state.task.target_height,
        bounced=states.metrics["bounced"] > 0,
        apex=states.pipeline_state.task.apex,
        running=running,
    )
    return jax.tree.map(lambda kept, new: kept.at[step].set(new), recording, now)


def settled_bounces(recording: Recording, first_step: int) -> np.ndarray:
    """Bounces that count for the height result [T, K], bool: the bounces of running episodes from
    `first_step` on."""
    bounces = np.array(recording.bounced & recording.running)
    bounces[: max(1, first_step)] = False
    return bounces


def apex_errors(recording: Recording, bounces: np.ndarray) -> np.ndarray:
    """Apex before each bounce minus the target height [N], m.

    Args:
      bounces: whether each step is a bounce to measure [T, K]; N are true.
    """
    before = np.roll(np.asarray(recording.apex), 1, axis=0)
    return (before - recording.target_height)[bounces]


def hit_points(env: BounceBall, recording: Recording, bounces: np.ndarray) -> np.ndarray:
    """Ball position over the paddle at each bounce: x and y in the paddle's own frame, from its
    centre [N, 2], m.

    Args:
      bounces: whether each step is a bounce to measure [T, K]; N are true.
    """
    model, addresses = env.mj_model, find_addresses(env.mj_model)
    data = mujoco.MjData(model)
    joint_angles, offsets = (
        np.moveaxis(np.asarray(values), 1, 2)[bounces]
        for values in (recording.joint_angles, recording.ball - recording.paddle)
    )
    points = np.zeros((len(offsets), 2))
    for i, (angles, offset) in enumerate(zip(joint_angles, offsets, strict=True)):
        data.qpos[list(addresses.arm_qpos)] = angles
        mujoco.mj_kinematics(model, data)
        rotation = data.geom_xmat[addresses.paddle_geom].reshape(3, 3)
        points[i] = (rotation.T @ offset)[:2]
    return points
