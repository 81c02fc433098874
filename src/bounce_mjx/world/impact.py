"""Restitution that falls with the speed of an impact.

The damping of the contact is constant in a control step: that of the speed with which the ball and
the paddle approached each other at the last control step before they touched.
"""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.physics import Engine
from bounce_mjx.robot.model import find_addresses, scatter
from bounce_mjx.world.observation import Kinematics
from bounce_mjx.world.randomization import impact_damping

# A ball whose gap to the paddle is smaller may touch it: the gap is that of a level paddle, m.
_NEAR = 0.01


def with_impact(state: Any, mj_model: mujoco.MjModel, engine: Engine, truth: Kinematics) -> Any:
    """The state (`env.EnvState`) after a control step or a reset with the speed of approach at the
    last control step before a contact, and the damping of that speed.

    Args:
      state: its `impact` is the speed until then; 0 at a reset.
    """
    if state.impact is None:
        return state
    addresses, parameters, qpos = find_addresses(mj_model), state.parameters, state.physics.qpos
    moving = scatter(np.zeros(mj_model.nq), addresses.arm_qpos, truth.joint_velocities)
    paddle_position = lambda qpos: engine.paddle_position(parameters, qpos)  # noqa: E731
    _, paddle_velocity = jax.jvp(paddle_position, (qpos,), (moving,))
    geom, radius = addresses.balls[0].geom, parameters.ball_radius
    radius = mj_model.geom_size[geom, 0] if radius is None else radius
    radius = (parameters.entries or {}).get(f"geom_size[{geom}, 0]", radius)
    height = radius + np.min(mj_model.geom_size[addresses.paddle_geom])
    gap = truth.ball_position[..., 2] - truth.paddle_position[2] - height
    # The lowest ball counts.
    lowest = jnp.min(gap)
    approach = paddle_velocity[2] - truth.ball_velocity[..., 2]
    speed = jnp.max(jnp.where(gap <= lowest, approach, 0.0))
    speed = jnp.where(lowest > _NEAR, speed, state.impact)
    damping = impact_damping(state.world, mj_model, speed)
    return state._replace(impact=speed, parameters=parameters._replace(contact_damping=damping))
