"""The reward terms of the original specification, in the same order and with the same symbols.

A term is a config class with the weight and the constants, and below it the formula, which
`@term` registers under its name. A new term needs nothing else: the config, the metrics
`reward/<name>`, the log and the report's figure follow the registry `TERMS`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

import pydantic

from bounce_mjx.config.settings import Finite, NonNegative, Positive, StrictModel
from bounce_mjx.lazy import jax, jnp


class RewardInputs(NamedTuple):
    """The part of an environment's state after a control step on which the reward depends."""

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


class Geometry(NamedTuple):
    """Quantities that several terms share."""

    err_xy: jax.Array
    """Horizontal distance of the ball from the target point, m."""
    d_vert: jax.Array
    """Vertical distance between ball and paddle, m."""
    delta_h: jax.Array
    """Target height minus ball height, m."""
    vz: jax.Array
    """Vertical velocity of the ball, m/s."""
    err_home: jax.Array
    """Distance of the paddle's height from home, m."""
    gravity: float
    """Gravity in the ballistic formulas, m/s^2."""


class Term(NamedTuple):
    """A registered reward term."""

    config: type[StrictModel]
    """Class of the term's settings, `weight` among them; every setting has a default."""
    formula: Callable[[Any, RewardInputs, Geometry], jax.Array]
    """(settings, inputs, geometry) -> unweighted term []."""


TERMS: dict[str, Term] = {}


def term(config: type[StrictModel]) -> Callable[[Callable], Callable]:
    """Registers the decorated formula as the reward term of the same name."""

    def register(formula: Callable) -> Callable:
        TERMS[formula.__name__] = Term(config, formula)
        return formula

    return register


def gaussian(error: jax.Array, scale: jax.Array | float) -> jax.Array:
    """exp(-error^2 / (2 scale^2))."""
    return jnp.exp(-jnp.square(error) / (2.0 * jnp.square(scale)))


def safe_sqrt(x: jax.Array) -> jax.Array:
    """Square root of max(0, x), whose derivative is 0 for x <= 0.

    The derivative of `jnp.sqrt` is infinite at 0. Multiplied by the zero of a branch that is not
    taken, it would make the whole gradient NaN.
    """
    positive = x > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def horizontal_distance(a: jax.Array, b: jax.Array) -> jax.Array:
    """Distance [] between two points [2 or 3] in x and y; its derivative is 0 where they
    coincide."""
    return safe_sqrt(jnp.square(a[0] - b[0]) + jnp.square(a[1] - b[1]))


class PositionReward(StrictModel):
    """Horizontal position: keep the ball above the target point, especially when it is near the
    paddle."""

    weight: Finite = 2.0
    """Weight of the term."""
    vertical_scale: Positive = 0.15
    """Decay of the proximity weight with the vertical distance between ball and paddle, m."""
    base_scale: Positive = 0.1
    """Width of the Gaussian far from the paddle, m."""
    proximity_gain: NonNegative = 3.0
    """Factor by which the Gaussian is wider at the paddle."""


@term(PositionReward)
def position(config: PositionReward, inputs: RewardInputs, geometry: Geometry) -> jax.Array:
    w_vert = jnp.exp(-geometry.d_vert / config.vertical_scale)
    return gaussian(geometry.err_xy, config.base_scale * (1.0 + config.proximity_gain * w_vert))


class OutOfPositionReward(StrictModel):
    """Out of position: a smooth penalty for a large horizontal error."""

    weight: Finite = 1.0
    """Weight of the term."""
    magnitude: NonNegative = 2.0
    """Largest penalty."""
    threshold: NonNegative = 0.05
    """Horizontal error at half the penalty, m."""
    scale: Positive = 0.03
    """Width of the sigmoid, m."""


@term(OutOfPositionReward)
def out_of_position(
    config: OutOfPositionReward, inputs: RewardInputs, geometry: Geometry
) -> jax.Array:
    return -config.magnitude * jax.nn.sigmoid((geometry.err_xy - config.threshold) / config.scale)


class VelocityMatchingReward(StrictModel):
    """Velocity matching: pass the target height at the desired speed."""

    weight: Finite = 2.0
    """Weight of the term."""
    desired_velocity: Finite = 0.5
    """Vertical velocity wanted at the target height, m/s."""
    near_distance: Positive = 0.05
    """Height error below which the current velocity is used, m."""
    rising_scale: Positive = 0.2
    """Width of the sigmoid between falling and rising, m/s."""
    below_scale: Positive = 0.02
    """Width of the sigmoid between above and below the target, m."""
    near_scale: Positive = 0.01
    """Width of the Gaussian around the target height, m."""
    error_scale: Positive = 0.8
    """Width of the Gaussian of the velocity error, m/s."""


@term(VelocityMatchingReward)
def velocity_matching(
    config: VelocityMatchingReward, inputs: RewardInputs, geometry: Geometry
) -> jax.Array:
    """The velocity of a case is 0 where the condition of that case does not hold."""
    vz, delta_h = geometry.vz, geometry.delta_h
    rising_below = (vz > 0.0) & (delta_h > 0.0)
    squared_up = jnp.square(vz) - 2.0 * geometry.gravity * delta_h
    v_up = jnp.where(rising_below, safe_sqrt(squared_up), 0.0)
    falling_above = (vz < 0.0) & (delta_h < 0.0)
    squared_down = jnp.square(vz) + 2.0 * geometry.gravity * jnp.abs(delta_h)
    v_down = jnp.where(falling_above, -safe_sqrt(squared_down), 0.0)
    v_near = jnp.where(jnp.abs(delta_h) < config.near_distance, vz, 0.0)

    s_up = jax.nn.sigmoid(vz / config.rising_scale)
    s_below = jax.nn.sigmoid(delta_h / config.below_scale)
    w_near = gaussian(delta_h, config.near_scale)
    v_at_target = v_up * s_up * s_below + v_down * (1.0 - s_up) * (1.0 - s_below) + v_near * w_near
    return gaussian(v_at_target - config.desired_velocity, config.error_scale)


class HeightReward(StrictModel):
    """Height: be near the target height."""

    weight: Finite = 4.5
    """Weight of the term."""
    scale: Positive = 0.15
    """Width of the Gaussian of the height error, m."""


@term(HeightReward)
def height(config: HeightReward, inputs: RewardInputs, geometry: Geometry) -> jax.Array:
    return gaussian(geometry.delta_h, config.scale)


class HeightProgressReward(StrictModel):
    """Height progress: get the ball high at all, so that the policy discovers hitting early."""

    weight: Finite = 1.0
    """Weight of the term."""
    base_height: Finite = 0.2
    """Ball height above which the term grows, m."""
    gain: NonNegative = 2.0
    """Reward for each metre above the base height, 1/m."""


@term(HeightProgressReward)
def height_progress(
    config: HeightProgressReward, inputs: RewardInputs, geometry: Geometry
) -> jax.Array:
    return jnp.maximum(0.0, inputs.ball_position[2] - config.base_height) * config.gain


class ControlledUpwardReward(StrictModel):
    """Controlled upward velocity: rise at the speed that reaches the target, in position."""

    weight: Finite = 1.5
    """Weight of the term."""
    position_scale: Positive = 0.02
    """Width of the Gaussian of the horizontal error, m."""
    min_ideal_velocity: NonNegative = 0.5
    """Lower limit of the ideal launch velocity, m/s."""
    max_ideal_velocity: NonNegative = 3.0
    """Upper limit of the ideal launch velocity, m/s."""
    velocity_scale: Positive = 0.5
    """Width of the Gaussian of the velocity error, m/s."""
    rising_scale: Positive = 0.1
    """Width of the sigmoid between falling and rising, m/s."""
    velocity_limit: Positive = 1.5
    """Upward velocity above which the term no longer grows, m/s."""


@term(ControlledUpwardReward)
def controlled_upward(
    config: ControlledUpwardReward, inputs: RewardInputs, geometry: Geometry
) -> jax.Array:
    v_ideal = safe_sqrt(2.0 * geometry.gravity * geometry.delta_h)
    v_ideal = jnp.clip(v_ideal, config.min_ideal_velocity, config.max_ideal_velocity)
    q_pos = gaussian(geometry.err_xy, config.position_scale)
    q_vel = gaussian(geometry.vz - v_ideal, config.velocity_scale)
    s_up = jax.nn.sigmoid(geometry.vz / config.rising_scale)
    return q_pos * q_vel * s_up * jnp.clip(geometry.vz, 0.0, config.velocity_limit)


class ConsecutiveBouncesReward(StrictModel):
    """Consecutive bounces: the logarithm of the count, in position."""

    weight: Finite = 0.8
    """Weight of the term."""
    gain: NonNegative = 0.5
    """Factor of the logarithm."""
    position_scale: Positive = 0.05
    """Width of the Gaussian of the horizontal error, m."""


@term(ConsecutiveBouncesReward)
def consecutive_bounces(
    config: ConsecutiveBouncesReward, inputs: RewardInputs, geometry: Geometry
) -> jax.Array:
    """The specification's indicator n > 0 is implied, as the logarithm is 0 at n = 0."""
    return (
        config.gain * jnp.log1p(inputs.n_bounces) * gaussian(geometry.err_xy, config.position_scale)
    )


class HighBounceCountReward(StrictModel):
    """High bounce count: proportional to the count once it passes the threshold, in position."""

    weight: Finite = 0.3
    """Weight of the term."""
    gain: NonNegative = 0.15
    """Reward per bounce."""
    position_scale: Positive = 0.05
    """Width of the Gaussian of the horizontal error, m."""
    threshold: Finite = 2.0
    """Number of bounces at half the activation."""
    scale: Positive = 0.5
    """Width of the sigmoid, bounces."""


@term(HighBounceCountReward)
def high_bounce_count(
    config: HighBounceCountReward, inputs: RewardInputs, geometry: Geometry
) -> jax.Array:
    s_high = jax.nn.sigmoid((inputs.n_bounces - config.threshold) / config.scale)
    return (
        inputs.n_bounces * config.gain * gaussian(geometry.err_xy, config.position_scale) * s_high
    )


class AlignmentReward(StrictModel):
    """Alignment: keep the paddle under the ball, especially when it hits the ball."""

    weight: Finite = 0.6
    """Weight of the term."""
    vertical_scale: Positive = 0.1
    """Decay of the proximity weight with the vertical distance between ball and paddle, m."""
    scale: Positive = 0.03
    """Width of the Gaussian of the horizontal distance between ball and paddle, m."""
    proximity_gain: NonNegative = 2.0
    """Factor of the proximity weight."""
    bounce_boost: NonNegative = 3.0
    """Factor on the step of a bounce."""
    gain: NonNegative = 0.3
    """Overall factor."""


@term(AlignmentReward)
def alignment(config: AlignmentReward, inputs: RewardInputs, geometry: Geometry) -> jax.Array:
    err_align = horizontal_distance(inputs.ball_position, inputs.paddle_position)
    w_prox = jnp.exp(-geometry.d_vert / config.vertical_scale)
    q_align = gaussian(err_align, config.scale) * (1.0 + config.proximity_gain * w_prox)
    return q_align * jnp.where(inputs.bounced, config.bounce_boost, 1.0) * config.gain


class PaddleHomeReward(StrictModel):
    """Paddle home: return to the home height while the ball is away."""

    weight: Finite = 1.5
    """Weight of the term."""
    scale: Positive = 0.05
    """Width of the Gaussian of the paddle's height error, m."""
    distance_gain: NonNegative = 0.5
    """Extra reward while the ball is far."""
    distance_threshold: Finite = 0.15
    """Vertical distance between ball and paddle at half the extra reward, m."""
    distance_scale: Positive = 0.03
    """Width of the sigmoid, m."""


@term(PaddleHomeReward)
def paddle_home(config: PaddleHomeReward, inputs: RewardInputs, geometry: Geometry) -> jax.Array:
    far = jax.nn.sigmoid((geometry.d_vert - config.distance_threshold) / config.distance_scale)
    return gaussian(geometry.err_home, config.scale) * (1.0 + config.distance_gain * far)


class ExcessiveUpwardReward(StrictModel):
    """Excessive upward velocity: a smooth penalty for a ball hit too hard."""

    weight: Finite = 1.0
    """Weight of the term."""
    magnitude: NonNegative = 1.0
    """Largest penalty."""
    threshold: Finite = 3.5
    """Upward velocity at half the penalty, m/s."""
    scale: Positive = 0.3
    """Width of the sigmoid, m/s."""


@term(ExcessiveUpwardReward)
def excessive_upward(
    config: ExcessiveUpwardReward, inputs: RewardInputs, geometry: Geometry
) -> jax.Array:
    return -config.magnitude * jax.nn.sigmoid((geometry.vz - config.threshold) / config.scale)


class DownwardVelocityReward(StrictModel):
    """Downward velocity: positive for a falling ball, according to the specification's formula. The
    specification's text calls the term a penalty; a negative weight makes it one."""

    weight: Finite = 1.0
    """Weight of the term; its sign chooses between the specification's formula and its text."""
    gain: NonNegative = 0.3
    """Slope of the clipped factor, s/m."""
    limit: NonNegative = 0.5
    """Upper limit of the clipped factor."""
    threshold: Finite = 0.2
    """Downward speed at half the activation, m/s."""
    scale: Positive = 0.2
    """Width of the sigmoid, m/s."""


@term(DownwardVelocityReward)
def downward_velocity(
    config: DownwardVelocityReward, inputs: RewardInputs, geometry: Geometry
) -> jax.Array:
    magnitude = -geometry.vz * jnp.clip(-geometry.vz * config.gain, 0.0, config.limit)
    return magnitude * jax.nn.sigmoid(-(geometry.vz + config.threshold) / config.scale)


class PaddleHeightViolationReward(StrictModel):
    """Paddle height violation: a linear penalty beyond the tolerance around home."""

    weight: Finite = 1.0
    """Weight of the term."""
    gain: NonNegative = 20.0
    """Penalty for each metre beyond the tolerance, 1/m."""
    tolerance: NonNegative = 0.1
    """Height error of the paddle that costs nothing, m."""


@term(PaddleHeightViolationReward)
def paddle_height_violation(
    config: PaddleHeightViolationReward, inputs: RewardInputs, geometry: Geometry
) -> jax.Array:
    return -config.gain * jnp.maximum(0.0, geometry.err_home - config.tolerance)


class ActionRateReward(StrictModel):
    """Action rate: minus the squared change of the action."""

    weight: Finite = 1e-4
    """Weight of the term."""


@term(ActionRateReward)
def action_rate(config: ActionRateReward, inputs: RewardInputs, geometry: Geometry) -> jax.Array:
    return -jnp.sum(jnp.square(inputs.action - inputs.last_action))


class JointVelocityReward(StrictModel):
    """Joint velocity: minus the sum of the squared joint velocities."""

    weight: Finite = 1e-4
    """Weight of the term."""


@term(JointVelocityReward)
def joint_velocity(
    config: JointVelocityReward, inputs: RewardInputs, geometry: Geometry
) -> jax.Array:
    return -jnp.sum(jnp.square(inputs.joint_velocity))


class SharedRewardConfig(StrictModel):
    """The reward terms: each has a weight and the constants of its formula."""

    target_x: Finite = 0.58856
    """Target point of the ball, x, m."""
    target_y: Finite = 0.0
    """Target point of the ball, y, m."""
    paddle_home_height: Finite = 0.05
    """Home height of the paddle, m."""
    gravity: Positive = 9.81
    """Gravity in the ballistic formulas, m/s^2 (the simulated gravity is the MJCF's)."""


TERM_NAMES = tuple(TERMS)
RewardConfig = pydantic.create_model(
    "RewardConfig",
    __base__=SharedRewardConfig,
    __module__=__name__,
    __doc__=SharedRewardConfig.__doc__,
    **{
        name: (
            entry.config,
            pydantic.Field(entry.config(), description=inspect.getdoc(entry.config)),
        )
        for name, entry in TERMS.items()
    },
)


def weighted_terms(config: SharedRewardConfig, inputs: RewardInputs) -> dict[str, jax.Array]:
    """Each term [] of one environment times its weight; their sum is the reward.

    Args:
      config: a `RewardConfig`.
    """
    ball, paddle = inputs.ball_position, inputs.paddle_position
    geometry = Geometry(
        err_xy=horizontal_distance(ball, (config.target_x, config.target_y)),
        d_vert=jnp.abs(ball[2] - paddle[2]),
        delta_h=inputs.target_height - ball[2],
        vz=inputs.ball_velocity[2],
        err_home=jnp.abs(paddle[2] - config.paddle_home_height),
        gravity=config.gravity,
    )
    inputs = inputs._replace(n_bounces=inputs.n_bounces.astype(ball.dtype))
    weighted = {}
    for name, entry in TERMS.items():
        settings = getattr(config, name)
        weighted[name] = settings.weight * entry.formula(settings, inputs, geometry)
    return weighted
