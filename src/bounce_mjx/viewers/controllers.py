"""Controllers of the arm: random, zero or scripted actions, or a trained policy."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from bounce_mjx.errors import UserError
from bounce_mjx.learning.policy import Networks, Policy, act
from bounce_mjx.task.env import BounceBall
from bounce_mjx.task.state import State

Controller = Callable[[Policy | None, State, jax.Array], jax.Array]
"""A controller of N environments: (policy if it is exchangeable; states, batch last; key, which is
consumed) -> actions [n, N]."""

# Gains of the scripted controller, found by a scan: it keeps 64 of 64 balls up for 10 s, with
# a mean apex error of 8 cm.
_LIFT = 0.03
_LIFT_PER_METRE = 0.2
_TILT_PER_METRE = 0.3
_TILT_PER_SPEED = 0.15
_MAX_TILT = 0.15
_STRIKE_DISTANCE = 0.03
_STRIKE_WIDTH = 0.08
_FALLING_WIDTH = 0.2


def make_policy_controller(networks: Networks, policy: Policy) -> Controller:
    """The policy's most likely action."""
    return lambda _, states, key: act(networks, policy, states.obs.T).T


def make_exchangeable_controller(networks: Networks) -> Controller:
    """The most likely action of a policy that is an argument."""
    return lambda policy, states, key: act(networks, policy, states.obs.T).T


def make_random_controller(env: BounceBall) -> Controller:
    """Uniform in [-1, 1]."""
    return lambda _, states, key: jax.random.uniform(
        key, (env.action_size, states.obs.shape[-1]), minval=-1.0, maxval=1.0
    )


def make_zero_controller(env: BounceBall) -> Controller:
    """Zero: the servos hold the measured angles."""
    return lambda _, states, key: jnp.zeros((env.action_size, states.obs.shape[-1]))


def make_scripted_controller(env: BounceBall) -> Controller:
    """A hand-written juggler for the project's own arm, to compare a policy with.

    The arm holds the configured posture. As the ball comes down, Joint3 lifts the paddle while
    Joint5 keeps it level; the lift grows with the target height's distance above the apex that the
    ball's energy allows. Joint5 and Joint6 tilt the paddle against the ball's horizontal error and
    velocity.

    Raises:
      UserError: the robot is an adopted arm.
    """
    config = env.config
    if config.robot.site is not None:
        raise UserError(
            "the scripted juggler moves the package's own arm only; choose --actions random or zero"
        )
    home = jnp.array(config.default_joint_angles)[:, None]

    def control(_: Policy | None, states: State, key: jax.Array) -> jax.Array:
        kinematics = jax.vmap(env.kinematics, in_axes=-1, out_axes=-1)(states.pipeline_state)
        x, y, z = kinematics.ball_position
        vx, vy, vz = kinematics.ball_velocity
        paddle_z = kinematics.paddle_position[2]
        target = states.pipeline_state.task.target_height
        apex = z + vz**2 / (2.0 * config.reward.gravity)
        near = jnp.exp(-(((z - paddle_z - _STRIKE_DISTANCE) / _STRIKE_WIDTH) ** 2))
        falling = jax.nn.sigmoid(-vz / _FALLING_WIDTH)
        lift = near * falling * (_LIFT + _LIFT_PER_METRE * (target - apex))
        pitch = _TILT_PER_METRE * (x - config.reward.target_x) + _TILT_PER_SPEED * vx
        roll = _TILT_PER_METRE * (y - config.reward.target_y) + _TILT_PER_SPEED * vy
        pitch, roll = (jnp.clip(tilt, -_MAX_TILT, _MAX_TILT) for tilt in (pitch, roll))
        zero = jnp.zeros_like(lift)
        posture = home + jnp.stack([zero, zero, -lift, zero, lift - pitch, roll])
        return jnp.clip((posture - kinematics.joint_angles) / config.action_scale, -1.0, 1.0)

    return control
