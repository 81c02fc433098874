"""The fifteen reward terms of the seed document, in its order and with its symbols."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.task.reward_config import RewardConfig


class RewardInputs(NamedTuple):
    """What the reward of one environment depends on, after a control step."""

    ball_position: jax.Array
    """World position [3], m."""
    ball_velocity: jax.Array
    """World velocity [3], m/s."""
    paddle_position: jax.Array
    """World position of the paddle's centre [3], m."""
    target_height: jax.Array
    """Target height [], m."""
    n_bounces: jax.Array
    """Bounce count [] with this step's bounce."""
    bounced: jax.Array
    """Whether this step is a bounce [], bool."""
    action: jax.Array
    """Clipped action [6]."""
    last_action: jax.Array
    """Clipped action of the step before [6]."""
    joint_velocity: jax.Array
    """Arm joint velocities [6], rad/s."""


class _Geometry(NamedTuple):
    """Quantities that several terms share."""

    err_xy: jax.Array
    """Horizontal distance of the ball from the target point, m."""
    d_vert: jax.Array
    """Vertical distance ball-paddle, m."""
    delta_h: jax.Array
    """Target height minus ball height, m."""
    vz: jax.Array
    """Vertical velocity of the ball, m/s."""
    err_home: jax.Array
    """Distance of the paddle's height from home, m."""


def gaussian(error: jax.Array, scale: jax.Array | float) -> jax.Array:
    """exp(-error^2 / (2 scale^2))."""
    return jnp.exp(-jnp.square(error) / (2.0 * jnp.square(scale)))


def position(config: RewardConfig, inputs: RewardInputs, geometry: _Geometry) -> jax.Array:
    c = config.position
    w_vert = jnp.exp(-geometry.d_vert / c.vertical_scale)
    return gaussian(geometry.err_xy, c.base_scale * (1.0 + c.proximity_gain * w_vert))


def out_of_position(config: RewardConfig, inputs: RewardInputs, geometry: _Geometry) -> jax.Array:
    c = config.out_of_position
    return -c.magnitude * jax.nn.sigmoid((geometry.err_xy - c.threshold) / c.scale)


def velocity_matching(config: RewardConfig, inputs: RewardInputs, geometry: _Geometry) -> jax.Array:
    """The velocity of each case is 0 outside the case's own condition."""
    c = config.velocity_matching
    vz, delta_h = geometry.vz, geometry.delta_h
    rising_below = (vz > 0.0) & (delta_h > 0.0)
    squared_up = jnp.square(vz) - 2.0 * config.gravity * delta_h
    v_up = jnp.where(rising_below, jnp.sqrt(jnp.maximum(0.0, squared_up)), 0.0)
    falling_above = (vz < 0.0) & (delta_h < 0.0)
    squared_down = jnp.square(vz) + 2.0 * config.gravity * jnp.abs(delta_h)
    v_down = jnp.where(falling_above, -jnp.sqrt(squared_down), 0.0)
    v_near = jnp.where(jnp.abs(delta_h) < c.near_distance, vz, 0.0)

    s_up = jax.nn.sigmoid(vz / c.rising_scale)
    s_below = jax.nn.sigmoid(delta_h / c.below_scale)
    w_near = gaussian(delta_h, c.near_scale)
    v_at_target = v_up * s_up * s_below + v_down * (1.0 - s_up) * (1.0 - s_below) + v_near * w_near
    return gaussian(v_at_target - c.desired_velocity, c.error_scale)


def height(config: RewardConfig, inputs: RewardInputs, geometry: _Geometry) -> jax.Array:
    return gaussian(geometry.delta_h, config.height.scale)


def height_progress(config: RewardConfig, inputs: RewardInputs, geometry: _Geometry) -> jax.Array:
    c = config.height_progress
    return jnp.maximum(0.0, inputs.ball_position[2] - c.base_height) * c.gain


def controlled_upward(config: RewardConfig, inputs: RewardInputs, geometry: _Geometry) -> jax.Array:
    c = config.controlled_upward
    v_ideal = jnp.sqrt(2.0 * config.gravity * jnp.maximum(0.0, geometry.delta_h))
    v_ideal = jnp.clip(v_ideal, c.min_ideal_velocity, c.max_ideal_velocity)
    q_pos = gaussian(geometry.err_xy, c.position_scale)
    q_vel = gaussian(geometry.vz - v_ideal, c.velocity_scale)
    s_up = jax.nn.sigmoid(geometry.vz / c.rising_scale)
    return q_pos * q_vel * s_up * jnp.clip(geometry.vz, 0.0, c.velocity_limit)


def consecutive_bounces(
    config: RewardConfig, inputs: RewardInputs, geometry: _Geometry
) -> jax.Array:
    """The count's indicator of the seed is the logarithm's own zero at n = 0."""
    c = config.consecutive_bounces
    return c.gain * jnp.log1p(inputs.n_bounces) * gaussian(geometry.err_xy, c.position_scale)


def high_bounce_count(config: RewardConfig, inputs: RewardInputs, geometry: _Geometry) -> jax.Array:
    c = config.high_bounce_count
    s_high = jax.nn.sigmoid((inputs.n_bounces - c.threshold) / c.scale)
    return inputs.n_bounces * c.gain * gaussian(geometry.err_xy, c.position_scale) * s_high


def alignment(config: RewardConfig, inputs: RewardInputs, geometry: _Geometry) -> jax.Array:
    c = config.alignment
    err_align = jnp.linalg.norm(inputs.ball_position[:2] - inputs.paddle_position[:2])
    w_prox = jnp.exp(-geometry.d_vert / c.vertical_scale)
    q_align = gaussian(err_align, c.scale) * (1.0 + c.proximity_gain * w_prox)
    return q_align * jnp.where(inputs.bounced, c.bounce_boost, 1.0) * c.gain


def paddle_home(config: RewardConfig, inputs: RewardInputs, geometry: _Geometry) -> jax.Array:
    c = config.paddle_home
    far = jax.nn.sigmoid((geometry.d_vert - c.distance_threshold) / c.distance_scale)
    return gaussian(geometry.err_home, c.scale) * (1.0 + c.distance_gain * far)


def excessive_upward(config: RewardConfig, inputs: RewardInputs, geometry: _Geometry) -> jax.Array:
    c = config.excessive_upward
    return -c.magnitude * jax.nn.sigmoid((geometry.vz - c.threshold) / c.scale)


def downward_velocity(config: RewardConfig, inputs: RewardInputs, geometry: _Geometry) -> jax.Array:
    """Positive for a falling ball, as the seed's formula stands, though the seed calls it a
    penalty; the sign of the weight decides."""
    c = config.downward_velocity
    magnitude = -geometry.vz * jnp.clip(-geometry.vz * c.gain, 0.0, c.limit)
    return magnitude * jax.nn.sigmoid(-(geometry.vz + c.threshold) / c.scale)


def paddle_height_violation(
    config: RewardConfig, inputs: RewardInputs, geometry: _Geometry
) -> jax.Array:
    c = config.paddle_height_violation
    return -c.gain * jnp.maximum(0.0, geometry.err_home - c.tolerance)


def action_rate(config: RewardConfig, inputs: RewardInputs, geometry: _Geometry) -> jax.Array:
    return -jnp.sum(jnp.square(inputs.action - inputs.last_action))


def joint_velocity(config: RewardConfig, inputs: RewardInputs, geometry: _Geometry) -> jax.Array:
    return -jnp.sum(jnp.square(inputs.joint_velocity))


_Term = Callable[[RewardConfig, RewardInputs, _Geometry], jax.Array]
TERMS: dict[str, _Term] = {
    "position": position,
    "out_of_position": out_of_position,
    "velocity_matching": velocity_matching,
    "height": height,
    "height_progress": height_progress,
    "controlled_upward": controlled_upward,
    "consecutive_bounces": consecutive_bounces,
    "high_bounce_count": high_bounce_count,
    "alignment": alignment,
    "paddle_home": paddle_home,
    "excessive_upward": excessive_upward,
    "downward_velocity": downward_velocity,
    "paddle_height_violation": paddle_height_violation,
    "action_rate": action_rate,
    "joint_velocity": joint_velocity,
}
TERM_NAMES = tuple(TERMS)


def weighted_terms(config: RewardConfig, inputs: RewardInputs) -> dict[str, jax.Array]:
    """The fifteen terms [] of one environment, each times its weight; their sum is the reward."""
    ball, paddle = inputs.ball_position, inputs.paddle_position
    target = jnp.array([config.target_x, config.target_y], ball.dtype)
    geometry = _Geometry(
        err_xy=jnp.linalg.norm(ball[:2] - target),
        d_vert=jnp.abs(ball[2] - paddle[2]),
        delta_h=inputs.target_height - ball[2],
        vz=inputs.ball_velocity[2],
        err_home=jnp.abs(paddle[2] - config.paddle_home_height),
    )
    inputs = inputs._replace(n_bounces=inputs.n_bounces.astype(ball.dtype))
    return {
        name: getattr(config, name).weight * term(config, inputs, geometry)
        for name, term in TERMS.items()
    }
