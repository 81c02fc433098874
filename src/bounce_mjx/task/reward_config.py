"""Reward configs."""

from bounce_mjx.config.settings import Finite, NonNegative, Positive, StrictModel


class PositionReward(StrictModel):
    """Horizontal position: stay above the target point, most of all when the ball is near."""

    weight: Finite = 2.0
    """Weight of the term."""
    vertical_scale: Positive = 0.15
    """Decay of the proximity weight with the vertical distance ball-paddle, m."""
    base_scale: Positive = 0.1
    """Width of the Gaussian far from the paddle, m."""
    proximity_gain: NonNegative = 3.0
    """How much wider the Gaussian is at the paddle, as a factor."""


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


class VelocityMatchingReward(StrictModel):
    """Velocity matching: pass the target height at the desired speed."""

    weight: Finite = 2.0
    """Weight of the term."""
    desired_velocity: Finite = 0.5
    """Vertical velocity wanted at the target height, m/s."""
    near_distance: Positive = 0.05
    """Height error under which the current velocity counts, m."""
    rising_scale: Positive = 0.2
    """Width of the sigmoid between falling and rising, m/s."""
    below_scale: Positive = 0.02
    """Width of the sigmoid between above and below the target, m."""
    near_scale: Positive = 0.01
    """Width of the Gaussian around the target height, m."""
    error_scale: Positive = 0.8
    """Width of the Gaussian of the velocity error, m/s."""


class HeightReward(StrictModel):
    """Height: be near the target height."""

    weight: Finite = 4.5
    """Weight of the term."""
    scale: Positive = 0.15
    """Width of the Gaussian of the height error, m."""


class HeightProgressReward(StrictModel):
    """Height progress: be high at all, so that hitting is found early."""

    weight: Finite = 1.0
    """Weight of the term."""
    base_height: Finite = 0.2
    """Ball height above which the term grows, m."""
    gain: NonNegative = 2.0
    """Reward for each metre above the base height, 1/m."""


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
    """Upward velocity above which the term grows no more, m/s."""


class ConsecutiveBouncesReward(StrictModel):
    """Consecutive bounces: the logarithm of the count, in position."""

    weight: Finite = 0.8
    """Weight of the term."""
    gain: NonNegative = 0.5
    """Factor of the logarithm."""
    position_scale: Positive = 0.05
    """Width of the Gaussian of the horizontal error, m."""


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


class AlignmentReward(StrictModel):
    """Alignment: keep the paddle under the ball, most of all at the hit."""

    weight: Finite = 0.6
    """Weight of the term."""
    vertical_scale: Positive = 0.1
    """Decay of the proximity weight with the vertical distance ball-paddle, m."""
    scale: Positive = 0.03
    """Width of the Gaussian of the horizontal distance ball-paddle, m."""
    proximity_gain: NonNegative = 2.0
    """Factor of the proximity weight."""
    bounce_boost: NonNegative = 3.0
    """Factor on the step of a bounce."""
    gain: NonNegative = 0.3
    """Overall factor."""


class PaddleHomeReward(StrictModel):
    """Paddle home: return to the home height while the ball is away."""

    weight: Finite = 1.5
    """Weight of the term."""
    scale: Positive = 0.05
    """Width of the Gaussian of the paddle's height error, m."""
    distance_gain: NonNegative = 0.5
    """Extra reward while the ball is far."""
    distance_threshold: Finite = 0.15
    """Vertical distance ball-paddle at half the extra reward, m."""
    distance_scale: Positive = 0.03
    """Width of the sigmoid, m."""


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


class DownwardVelocityReward(StrictModel):
    """Downward velocity: positive for a falling ball as the seed's formula stands, though its
    text calls the term a penalty; a negative weight makes it one."""

    weight: Finite = 1.0
    """Weight of the term; its sign chooses between the seed's formula and the seed's text."""
    gain: NonNegative = 0.3
    """Slope of the clipped factor, s/m."""
    limit: NonNegative = 0.5
    """Upper limit of the clipped factor."""
    threshold: Finite = 0.2
    """Downward speed at half the activation, m/s."""
    scale: Positive = 0.2
    """Width of the sigmoid, m/s."""


class PaddleHeightViolationReward(StrictModel):
    """Paddle height violation: a linear penalty beyond the tolerance around home."""

    weight: Finite = 1.0
    """Weight of the term."""
    gain: NonNegative = 20.0
    """Penalty for each metre beyond the tolerance, 1/m."""
    tolerance: NonNegative = 0.1
    """Height error of the paddle that costs nothing, m."""


class ActionRateReward(StrictModel):
    """Action rate: minus the squared change of the action."""

    weight: Finite = 1e-4
    """Weight of the term."""


class JointVelocityReward(StrictModel):
    """Joint velocity: minus the sum of the squared joint velocities."""

    weight: Finite = 1e-4
    """Weight of the term."""


class RewardConfig(StrictModel):
    """The fifteen reward terms: each a weight and the constants of its formula."""

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
    target_x: Finite = 0.58856
    """Target point of the ball, x, m."""
    target_y: Finite = 0.0
    """Target point of the ball, y, m."""
    paddle_home_height: Finite = 0.05
    """Home height of the paddle, m."""
    gravity: Positive = 9.81
    """Gravity in the ballistic formulas, m/s^2 (the simulated gravity is the MJCF's)."""
