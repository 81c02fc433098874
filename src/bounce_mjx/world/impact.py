"""Restitution that falls with the speed of an impact.

The damping of the contact is constant in a control step: that of the speed with which the ball and
the paddle approached each other at the last control step before they touched.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bounce_mjx.physics import Engine, PhysicsParameters
from bounce_mjx.physics.edited import direct_solref
from bounce_mjx.robot.model import find_addresses
from bounce_mjx.world.observation import Kinematics
from bounce_mjx.world.randomization import IMPACT_SPEED, World, contact_damping

# Impact speeds between which the damping is linear, m/s.
_SLOW, _MIDDLE, _FAST = 1.0, IMPACT_SPEED, 4.0
# A ball whose gap to the paddle is smaller may touch it: the gap is that of a level paddle, m.
_NEAR = 0.01


class Impact(NamedTuple):
    """What the damping of the next contact depends on."""

    speed: jax.Array
    """Speed of approach [] at the last control step before a contact, m/s."""
    damping: jax.Array
    """Damping [3] of the contact in a slow, a medium and a fast impact, 1/s."""


def first_impact(world: World, mj_model: mujoco.MjModel) -> Impact | None:
    """What the damping depends on after a reset; None if the sampled restitution is the same at all
    speeds."""
    if "restitution_slope" not in world:
        return None
    stiffness, _ = direct_solref(mj_model)
    speeds = jnp.array([_SLOW, _MIDDLE, _FAST], world["restitution"].dtype)
    restitution = world["restitution"] - world["restitution_slope"] * (speeds - IMPACT_SPEED)
    return Impact(jnp.zeros_like(restitution[0]), contact_damping(restitution, stiffness))


def next_impact(
    impact: Impact,
    mj_model: mujoco.MjModel,
    engine: Engine,
    parameters: PhysicsParameters,
    qpos: jax.Array,
    truth: Kinematics,
) -> Impact:
    """What the damping depends on after a control step or a reset that ended at qpos [nq]."""
    addresses = find_addresses(mj_model)
    moving = [jnp.zeros_like(qpos[0])] * mj_model.nq
    for i, address in enumerate(addresses.arm_qpos):
        moving[address] = truth.joint_velocities[i]
    paddle_position = lambda qpos: engine.paddle_position(parameters, qpos)  # noqa: E731
    _, paddle_velocity = jax.jvp(paddle_position, (qpos,), (jnp.stack(moving),))
    geom, radius = addresses.ball_geom, parameters.ball_radius
    radius = mj_model.geom_size[geom, 0] if radius is None else radius
    radius = (parameters.entries or {}).get(f"geom_size[{geom}, 0]", radius)
    height = radius + np.min(mj_model.geom_size[addresses.paddle_geom])
    gap = truth.ball_position[..., 2] - truth.paddle_position[2] - height
    # The lowest ball counts.
    lowest = jnp.min(gap)
    approach = paddle_velocity[2] - truth.ball_velocity[..., 2]
    speed = jnp.max(jnp.where(gap <= lowest, approach, 0.0))
    return impact._replace(speed=jnp.where(lowest > _NEAR, speed, impact.speed))


def damping(impact: Impact) -> jax.Array:
    """Damping [] of the contact, 1/s."""
    slow, middle, fast = (impact.damping[i] for i in range(3))
    faster = impact.speed - _MIDDLE
    rise = jnp.where(
        faster < 0.0, (middle - slow) / (_MIDDLE - _SLOW), (fast - middle) / (_FAST - _MIDDLE)
    )
    return jnp.maximum(middle + faster * rise, 0.0)
