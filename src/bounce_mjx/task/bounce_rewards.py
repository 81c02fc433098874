"""The reward terms of bouncing, as in the original specification, in the same order and with the
same symbols.

Each term is a class: its weight (1 where it gives none), its constants, and the formula `value`. In
the formulas, G(x, s) = exp(-x^2 / (2 s^2)), S is the logistic sigmoid, g is gravity, and the other
symbols are properties of `RewardInputs`: err_xy, d_vert, delta_h and err_home in m, vz in m/s.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Annotated

import pydantic
from pydantic import Field

from bounce_mjx.config import settings
from bounce_mjx.lazy import jax, jnp
from bounce_mjx.task import RewardTerm, Values, gaussian, horizontal_distance, safe_sqrt


@dataclasses.dataclass(frozen=True)
class RewardInputs:
    """What the terms depend on after a control step."""

    ball_position: jax.Array
    """World position [3], m."""
    ball_velocity: jax.Array
    """World velocity [3], m/s."""
    paddle_position: jax.Array
    """World position of the paddle's centre [3], m."""
    target_height: jax.Array
    """Target height [], m."""
    n_bounces: jax.Array
    """Bounce count [], including this step's bounce."""
    bounced: jax.Array
    """Whether this step is a bounce [], bool."""
    action: jax.Array
    """Clipped action [n]."""
    last_action: jax.Array
    """Clipped action of the previous step [n]."""
    joint_velocity: jax.Array
    """Arm joint velocities [n], rad/s."""
    reward: Rewards
    """Settings of all terms: the target point, the paddle's home height and gravity."""
    goal: Values = dataclasses.field(default_factory=dict)
    """Value [] of each goal, also of a task that extends bouncing by one."""

    @functools.cached_property
    def err_xy(self) -> jax.Array:
        """Horizontal distance of the ball from the target point, m."""
        return horizontal_distance(self.ball_position, (self.reward.target_x, self.reward.target_y))

    @functools.cached_property
    def d_vert(self) -> jax.Array:
        """Vertical distance between ball and paddle, m."""
        return jnp.abs(self.ball_position[2] - self.paddle_position[2])

    @functools.cached_property
    def delta_h(self) -> jax.Array:
        """Target height minus ball height, m."""
        return self.target_height - self.ball_position[2]

    @functools.cached_property
    def vz(self) -> jax.Array:
        """Vertical velocity of the ball, m/s."""
        return self.ball_velocity[2]

    @functools.cached_property
    def err_home(self) -> jax.Array:
        """Distance of the paddle's height from home, m."""
        return jnp.abs(self.paddle_position[2] - self.reward.paddle_home_height)


class PositionReward(RewardTerm):
    """Horizontal position: keep the ball above the target point, most exactly while it is far from
    the paddle."""

    weight: settings.Finite = 2.0
    """Weight of the term."""
    vertical_scale: settings.Length = 0.15
    """Decay of the additional width with the vertical distance between ball and paddle, m."""
    base_scale: settings.Length = 0.1
    """Width of the Gaussian far from the paddle, m."""
    proximity_gain: settings.NonNegative = 3.0
    """Additional width of the Gaussian at the paddle, in widths far from it."""

    def value(self, inputs: RewardInputs) -> jax.Array:
        """G(err_xy, base_scale (1 + proximity_gain exp(-d_vert / vertical_scale)))."""
        w_vert = jnp.exp(-inputs.d_vert / self.vertical_scale)
        return gaussian(inputs.err_xy, self.base_scale * (1.0 + self.proximity_gain * w_vert))


class OutOfPositionReward(RewardTerm):
    """Out of position: a smooth penalty for a large horizontal error."""

    magnitude: settings.NonNegative = 2.0
    """Largest penalty."""
    threshold: settings.Distance = 0.05
    """Horizontal error at half the penalty, m."""
    scale: settings.Length = 0.03
    """Width of the sigmoid, m."""

    def value(self, inputs: RewardInputs) -> jax.Array:
        """-magnitude S((err_xy - threshold) / scale)."""
        return -self.magnitude * jax.nn.sigmoid((inputs.err_xy - self.threshold) / self.scale)


class VelocityMatchingReward(RewardTerm):
    """Velocity matching: pass the target height at the desired speed."""

    weight: settings.Finite = 2.0
    """Weight of the term."""
    desired_velocity: settings.Velocity = 0.5
    """Vertical velocity wanted at the target height, m/s."""
    near_distance: settings.Length = 0.05
    """Height error below which the current velocity is used, m."""
    rising_scale: settings.Speed = 0.2
    """Width of the sigmoid between falling and rising, m/s."""
    below_scale: settings.Length = 0.02
    """Width of the sigmoid between above and below the target, m."""
    near_scale: settings.Length = 0.01
    """Width of the Gaussian around the target height, m."""
    error_scale: settings.Speed = 0.8
    """Width of the Gaussian of the velocity error, m/s."""

    def value(self, inputs: RewardInputs) -> jax.Array:
        """G(v_target - desired_velocity, error_scale) for the velocity at the target height, m/s:

        v_target = v_up S_up S_below + v_down (1 - S_up) (1 - S_below)
                   + v_near G(delta_h, near_scale)

        with S_up = S(vz / rising_scale) and S_below = S(delta_h / below_scale). By the conservation
        of energy v_up = sqrt(vz^2 - 2 g delta_h) rising below the target, and
        v_down = -sqrt(vz^2 + 2 g |delta_h|) falling above it; v_near = vz near it. Each is 0 where
        its condition does not hold.
        """
        vz = inputs.vz
        delta_h = inputs.delta_h
        rising_below = (vz > 0.0) & (delta_h > 0.0)
        squared_up = jnp.square(vz) - 2.0 * inputs.reward.gravity * delta_h
        v_up = jnp.where(rising_below, safe_sqrt(squared_up), 0.0)
        falling_above = (vz < 0.0) & (delta_h < 0.0)
        squared_down = jnp.square(vz) + 2.0 * inputs.reward.gravity * jnp.abs(delta_h)
        v_down = jnp.where(falling_above, -safe_sqrt(squared_down), 0.0)
        v_near = jnp.where(jnp.abs(delta_h) < self.near_distance, vz, 0.0)

        s_up = jax.nn.sigmoid(vz / self.rising_scale)
        s_below = jax.nn.sigmoid(delta_h / self.below_scale)
        w_near = gaussian(delta_h, self.near_scale)
        v_target = v_up * s_up * s_below + v_down * (1.0 - s_up) * (1.0 - s_below) + v_near * w_near
        return gaussian(v_target - self.desired_velocity, self.error_scale)


class HeightReward(RewardTerm):
    """Height: be near the target height."""

    weight: settings.Finite = 4.5
    """Weight of the term."""
    scale: settings.Length = 0.15
    """Width of the Gaussian of the height error, m."""

    def value(self, inputs: RewardInputs) -> jax.Array:
        """G(delta_h, scale)."""
        return gaussian(inputs.delta_h, self.scale)


class HeightProgressReward(RewardTerm):
    """Height progress: get the ball high at all, so that the policy discovers hitting early."""

    base_height: settings.Coordinate = 0.2
    """Ball height above which the term grows, m."""
    gain: settings.NonNegative = 2.0
    """Reward for each metre above the base height, 1/m."""

    def value(self, inputs: RewardInputs) -> jax.Array:
        """gain max(0, z - base_height) for the ball's height z."""
        return jnp.maximum(0.0, inputs.ball_position[2] - self.base_height) * self.gain


class ControlledUpwardReward(RewardTerm):
    """Controlled upward velocity: rise at the speed that reaches the target, in position."""

    weight: settings.Finite = 1.5
    """Weight of the term."""
    position_scale: settings.Length = 0.02
    """Width of the Gaussian of the horizontal error, m."""
    min_ideal_velocity: Annotated[settings.NonNegative, Field(le=100.0)] = 0.5
    """Lower limit of the ideal launch velocity, m/s."""
    max_ideal_velocity: Annotated[settings.NonNegative, Field(le=100.0)] = 3.0
    """Upper limit of the ideal launch velocity, m/s."""
    velocity_scale: settings.Speed = 0.5
    """Width of the Gaussian of the velocity error, m/s."""
    rising_scale: settings.Speed = 0.1
    """Width of the sigmoid between falling and rising, m/s."""
    velocity_limit: settings.Speed = 1.5
    """Upward velocity above which the term no longer grows, m/s."""

    @pydantic.model_validator(mode="after")
    def _check_order(self):
        """The limits of the ideal velocity have their order."""
        if self.min_ideal_velocity > self.max_ideal_velocity:
            raise ValueError(
                f"max_ideal_velocity {self.max_ideal_velocity:g} is below min_ideal_velocity "
                f"{self.min_ideal_velocity:g}; give the greater one as max_ideal_velocity"
            )
        return self

    def value(self, inputs: RewardInputs) -> jax.Array:
        """G(err_xy, position_scale) G(vz - v_ideal, velocity_scale) S(vz / rising_scale)
        clip(vz, 0, velocity_limit), with v_ideal = sqrt(2 g max(0, delta_h)) within its limits."""
        v_ideal = safe_sqrt(2.0 * inputs.reward.gravity * inputs.delta_h)
        v_ideal = jnp.clip(v_ideal, self.min_ideal_velocity, self.max_ideal_velocity)
        q_pos = gaussian(inputs.err_xy, self.position_scale)
        q_vel = gaussian(inputs.vz - v_ideal, self.velocity_scale)
        s_up = jax.nn.sigmoid(inputs.vz / self.rising_scale)
        return q_pos * q_vel * s_up * jnp.clip(inputs.vz, 0.0, self.velocity_limit)


class ConsecutiveBouncesReward(RewardTerm):
    """Consecutive bounces: the logarithm of the count, in position."""

    weight: settings.Finite = 0.8
    """Weight of the term."""
    gain: settings.NonNegative = 0.5
    """Factor of the logarithm."""
    position_scale: settings.Length = 0.05
    """Width of the Gaussian of the horizontal error, m."""

    def value(self, inputs: RewardInputs) -> jax.Array:
        """gain log(1 + n) G(err_xy, position_scale) for the bounce count n. The specification's
        indicator n > 0 is implied, as the logarithm is 0 at n = 0."""
        return (
            self.gain * jnp.log1p(inputs.n_bounces) * gaussian(inputs.err_xy, self.position_scale)
        )


class HighBounceCountReward(RewardTerm):
    """High bounce count: proportional to the count once it passes the threshold, in position."""

    weight: settings.Finite = 0.3
    """Weight of the term."""
    gain: settings.NonNegative = 0.15
    """Reward per bounce."""
    position_scale: settings.Length = 0.05
    """Width of the Gaussian of the horizontal error, m."""
    threshold: settings.Finite = 2.0
    """Number of bounces at half the activation."""
    scale: settings.Positive = 0.5
    """Width of the sigmoid, bounces."""

    def value(self, inputs: RewardInputs) -> jax.Array:
        """gain n G(err_xy, position_scale) S((n - threshold) / scale) for the bounce count n."""
        s_high = jax.nn.sigmoid((inputs.n_bounces - self.threshold) / self.scale)
        return inputs.n_bounces * self.gain * gaussian(inputs.err_xy, self.position_scale) * s_high


class AlignmentReward(RewardTerm):
    """Alignment: keep the paddle under the ball, especially when it hits the ball."""

    weight: settings.Finite = 0.6
    """Weight of the term."""
    vertical_scale: settings.Length = 0.1
    """Decay of the proximity weight with the vertical distance between ball and paddle, m."""
    scale: settings.Length = 0.03
    """Width of the Gaussian of the horizontal distance between ball and paddle, m."""
    proximity_gain: settings.NonNegative = 2.0
    """Factor of the proximity weight."""
    bounce_boost: settings.NonNegative = 3.0
    """Factor on the step of a bounce."""
    gain: settings.NonNegative = 0.3
    """Overall factor."""

    def value(self, inputs: RewardInputs) -> jax.Array:
        """gain b G(err_align, scale) (1 + proximity_gain exp(-d_vert / vertical_scale)) for the
        horizontal distance err_align of ball and paddle (m); b is bounce_boost on the step of a
        bounce, else 1."""
        err_align = horizontal_distance(inputs.ball_position, inputs.paddle_position)
        w_prox = jnp.exp(-inputs.d_vert / self.vertical_scale)
        q_align = gaussian(err_align, self.scale) * (1.0 + self.proximity_gain * w_prox)
        return q_align * jnp.where(inputs.bounced, self.bounce_boost, 1.0) * self.gain


class PaddleHomeReward(RewardTerm):
    """Paddle home: return to the home height while the ball is away."""

    weight: settings.Finite = 1.5
    """Weight of the term."""
    scale: settings.Length = 0.05
    """Width of the Gaussian of the paddle's height error, m."""
    distance_gain: settings.NonNegative = 0.5
    """Extra reward while the ball is far."""
    distance_threshold: settings.Coordinate = 0.15
    """Vertical distance between ball and paddle at half the extra reward, m."""
    distance_scale: settings.Length = 0.03
    """Width of the sigmoid, m."""

    def value(self, inputs: RewardInputs) -> jax.Array:
        """G(err_home, scale)
        (1 + distance_gain S((d_vert - distance_threshold) / distance_scale))."""
        far = jax.nn.sigmoid((inputs.d_vert - self.distance_threshold) / self.distance_scale)
        return gaussian(inputs.err_home, self.scale) * (1.0 + self.distance_gain * far)


class ExcessiveUpwardReward(RewardTerm):
    """Excessive upward velocity: a smooth penalty for a ball hit too hard."""

    magnitude: settings.NonNegative = 1.0
    """Largest penalty."""
    threshold: settings.Velocity = 3.5
    """Upward velocity at half the penalty, m/s."""
    scale: settings.Speed = 0.3
    """Width of the sigmoid, m/s."""

    def value(self, inputs: RewardInputs) -> jax.Array:
        """-magnitude S((vz - threshold) / scale)."""
        return -self.magnitude * jax.nn.sigmoid((inputs.vz - self.threshold) / self.scale)


class DownwardVelocityReward(RewardTerm):
    """Downward velocity: positive for a falling ball, according to the specification's formula. The
    specification's text calls the term a penalty; a negative weight makes it one."""

    weight: settings.Finite = 1.0
    """Weight of the term; its sign chooses between the specification's formula and its text."""
    gain: settings.NonNegative = 0.3
    """Slope of the clipped factor, s/m."""
    limit: settings.NonNegative = 0.5
    """Upper limit of the clipped factor."""
    threshold: settings.Velocity = 0.2
    """Downward speed at half the activation, m/s."""
    scale: settings.Speed = 0.2
    """Width of the sigmoid, m/s."""

    def value(self, inputs: RewardInputs) -> jax.Array:
        """-vz clip(-gain vz, 0, limit) S(-(vz + threshold) / scale)."""
        magnitude = -inputs.vz * jnp.clip(-inputs.vz * self.gain, 0.0, self.limit)
        return magnitude * jax.nn.sigmoid(-(inputs.vz + self.threshold) / self.scale)


class PaddleHeightViolationReward(RewardTerm):
    """Paddle height violation: a linear penalty beyond the tolerance around home."""

    gain: settings.NonNegative = 20.0
    """Penalty for each metre beyond the tolerance, 1/m."""
    tolerance: settings.Distance = 0.1
    """Height error of the paddle that costs nothing, m."""

    def value(self, inputs: RewardInputs) -> jax.Array:
        """-gain max(0, err_home - tolerance)."""
        return -self.gain * jnp.maximum(0.0, inputs.err_home - self.tolerance)


class ActionRateReward(RewardTerm):
    """Action rate: minus the squared change of the action."""

    weight: settings.Finite = 1e-4
    """Weight of the term."""

    def value(self, inputs: RewardInputs) -> jax.Array:
        """-sum((action - last action)^2)."""
        return -jnp.sum(jnp.square(inputs.action - inputs.last_action))


class JointVelocityReward(RewardTerm):
    """Joint velocity: minus the sum of the squared joint velocities."""

    weight: settings.Finite = 1e-4
    """Weight of the term."""

    def value(self, inputs: RewardInputs) -> jax.Array:
        """-sum(joint velocity^2), (rad/s)^2."""
        return -jnp.sum(jnp.square(inputs.joint_velocity))


class Rewards(settings.StrictModel):
    """The reward: numbers that several terms use, and the terms, each with a weight and the
    constants of its formula."""

    target_x: settings.Coordinate = 0.58856
    """Target point of the ball, x, m."""
    target_y: settings.Coordinate = 0.0
    """Target point of the ball, y, m."""
    paddle_home_height: settings.Coordinate = 0.05
    """Home height of the paddle, m."""
    gravity: Annotated[settings.Positive, Field(le=100.0)] = 9.81
    """Gravity in the ballistic formulas, m/s^2 (the simulated gravity is the MJCF's)."""
    position: PositionReward = PositionReward()
    out_of_position: OutOfPositionReward = OutOfPositionReward()
    velocity_matching: VelocityMatchingReward = VelocityMatchingReward()
    height: HeightReward = HeightReward()
    height_progress: HeightProgressReward = HeightProgressReward()
    controlled_upward: ControlledUpwardReward = ControlledUpwardReward()
    consecutive_bounces: ConsecutiveBouncesReward = ConsecutiveBouncesReward()
    high_bounce_count: HighBounceCountReward = HighBounceCountReward()
    alignment: AlignmentReward = AlignmentReward()
    paddle_home: PaddleHomeReward = PaddleHomeReward()
    excessive_upward: ExcessiveUpwardReward = ExcessiveUpwardReward()
    downward_velocity: DownwardVelocityReward = DownwardVelocityReward()
    paddle_height_violation: PaddleHeightViolationReward = PaddleHeightViolationReward()
    action_rate: ActionRateReward = ActionRateReward()
    joint_velocity: JointVelocityReward = JointVelocityReward()
