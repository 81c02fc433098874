"""What some episodes of an evaluation went through, kept to be drawn."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from brax.envs.base import State

from bounce_mjx.robot.model import find_addresses
from bounce_mjx.task.env import OBSERVATION_SIZE, BounceBall

RECORDED_EPISODES = 32


class Recording(NamedTuple):
    """T control steps of K episodes; what follows an episode's end means nothing."""

    observation: jax.Array
    """After the step [T, 29, K]."""
    bounced: jax.Array
    """Whether the step was a bounce [T, K], bool."""
    apex: jax.Array
    """Highest ball position since the last bounce, after the step [T, K], m."""
    running: jax.Array
    """Whether the episode had not ended before the step [T, K], bool."""

    @property
    def ball(self) -> jax.Array:
        """Ball positions [T, 3, K], m."""
        return self.observation[:, 6:9]

    @property
    def paddle(self) -> jax.Array:
        """Positions of the paddle's centre [T, 3, K], m."""
        return self.observation[:, 25:28]

    @property
    def target_height(self) -> jax.Array:
        """Target height of each episode [K], m."""
        return self.observation[0, 28]


def empty_recording(steps: int, episodes: int) -> Recording:
    """A recording before the first step."""
    return Recording(
        observation=jnp.zeros((steps, OBSERVATION_SIZE, episodes)),
        bounced=jnp.zeros((steps, episodes), bool),
        apex=jnp.zeros((steps, episodes)),
        running=jnp.zeros((steps, episodes), bool),
    )


def record(recording: Recording, states: State, running: jax.Array, step: jax.Array) -> Recording:
    """Writes one control step of the first K of E environments (batch last) into the recording.

    Args:
      states: after the step.
      running: whether each episode had not ended before it [E], bool.
      step: its index [], from 0.
    """
    now = Recording(
        observation=states.obs,
        bounced=states.metrics["bounced"] > 0,
        apex=states.pipeline_state.task.apex,
        running=running,
    )
    episodes = recording.running.shape[-1]
    return jax.tree.map(lambda kept, new: kept.at[step].set(new[..., :episodes]), recording, now)


def settled_bounces(recording: Recording, first_step: int) -> np.ndarray:
    """Which steps are bounces that count in the result on the height [T, K], bool: those of
    running episodes from `first_step` on."""
    bounces = np.array(recording.bounced & recording.running)
    bounces[: max(1, first_step)] = False
    return bounces


def apex_errors(recording: Recording, bounces: np.ndarray) -> np.ndarray:
    """Apex before each bounce minus the target height [N], m.

    Args:
      bounces: which steps, [T, K] with N true.
    """
    before = np.roll(np.asarray(recording.apex), 1, axis=0)
    return (before - recording.target_height)[bounces]


def hit_points(env: BounceBall, recording: Recording, bounces: np.ndarray) -> np.ndarray:
    """Where the ball was over the paddle at each bounce: x and y in the paddle's own frame, from
    its centre [N, 2], m.

    Args:
      bounces: which steps, [T, K] with N true.
    """
    model, at = env.mj_model, find_addresses(env.mj_model)
    data = mujoco.MjData(model)
    observations = np.moveaxis(np.asarray(recording.observation), 1, 2)[bounces]
    points = np.zeros((len(observations), 2))
    for i, observation in enumerate(observations):
        data.qpos[list(at.arm_qpos)] = observation[:6]
        mujoco.mj_kinematics(model, data)
        rotation = data.geom_xmat[at.paddle_geom].reshape(3, 3)
        points[i] = (rotation.T @ (observation[6:9] - data.geom_xpos[at.paddle_geom]))[:2]
    return points
