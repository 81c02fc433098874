"""What can drive the arm: random, zero or scripted actions, or a trained policy."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from brax.envs.base import State
from brax.training.agents.ppo.networks import PPONetworks

from bounce_mjx.learning.policy import Policy, act
from bounce_mjx.task.env import BounceBall

Controller = Callable[[State, jax.Array], jax.Array]
"""(states of N environments, batch last; key, which is consumed) -> actions [6, N]."""

# The scripted controller's gains, chosen by a scan: it keeps 64 of 64 balls up for 10 s, its
# apexes 8 cm beside the target height on average.
_LIFT = 0.03
_LIFT_PER_METRE = 0.2
_TILT_PER_METRE = 0.3
_TILT_PER_SPEED = 0.15
_MAX_TILT = 0.15
_STRIKE_DISTANCE = 0.03
_STRIKE_WIDTH = 0.08
_FALLING_WIDTH = 0.2


def make_policy_controller(networks: PPONetworks, policy: Policy) -> Controller:
    """The policy's most likely action."""
    return lambda states, key: act(networks, policy, states.obs.T).T


def make_random_controller(env: BounceBall) -> Controller:
    """Uniform in [-1, 1]."""
    return lambda states, key: jax.random.uniform(
        key, (env.action_size, states.obs.shape[-1]), minval=-1.0, maxval=1.0
    )


def make_zero_controller(env: BounceBall) -> Controller:
    """Zero: the servos hold the measured angles."""
    return lambda states, key: jnp.zeros((env.action_size, states.obs.shape[-1]))


def make_scripted_controller(env: BounceBall) -> Controller:
    """A hand-written juggler for the project's own arm, to compare a policy with.

    The arm holds the configured posture. As the ball comes down, Joint3 lifts the paddle (Joint5
    keeps it level), the more the further the apex of the ball's energy is below the target height;
    Joint5 and Joint6 tilt it against the ball's horizontal error and velocity.
    """
    config = env.config
    home = jnp.array(config.default_joint_angles)[:, None]

    def control(states: State, key: jax.Array) -> jax.Array:
        angles, (x, y, z) = states.obs[:6], states.obs[6:9]
        vx, vy, vz = states.obs[19:22]
        paddle_z, target = states.obs[27], states.obs[28]
        apex = z + vz**2 / (2.0 * config.reward.gravity)
        near = jnp.exp(-(((z - paddle_z - _STRIKE_DISTANCE) / _STRIKE_WIDTH) ** 2))
        falling = jax.nn.sigmoid(-vz / _FALLING_WIDTH)
        lift = near * falling * (_LIFT + _LIFT_PER_METRE * (target - apex))
        pitch = _TILT_PER_METRE * (x - config.reward.target_x) + _TILT_PER_SPEED * vx
        roll = _TILT_PER_METRE * (y - config.reward.target_y) + _TILT_PER_SPEED * vy
        pitch, roll = (jnp.clip(tilt, -_MAX_TILT, _MAX_TILT) for tilt in (pitch, roll))
        zero = jnp.zeros_like(lift)
        wanted = home + jnp.stack([zero, zero, -lift, zero, lift - pitch, roll])
        return jnp.clip((wanted - angles) / config.action_scale, -1.0, 1.0)

    return control
