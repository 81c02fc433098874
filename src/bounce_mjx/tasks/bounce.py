"""Bouncing: the arm keeps a ball bouncing on the paddle at a chosen height.

It is the task of the original specification: its settings, bounces, reward, ends and observation.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, NamedTuple

import pydantic

from bounce_mjx.config.settings import Finite, NonNegative, Positive
from bounce_mjx.env.env import Env
from bounce_mjx.lazy import jax, jnp
from bounce_mjx.task import (
    Command,
    History,
    ObservationConfig,
    Quantity,
    Start,
    Step,
    Task,
    TaskStep,
    WorldConfig,
    latest,
    weighted_terms,
)
from bounce_mjx.tasks.bounce_rewards import BounceReward, RewardInputs


class BounceObservation(ObservationConfig):
    """The quantities that the policy sees, and how many values of each: 0 for none, 1 for the
    newest, N for the last N, the newest first."""

    target_height: Annotated[History, Quantity(1, "m", "command")] = 1
    """Target height."""
    apex_error: Annotated[History, Quantity(1, "m")] = 0
    """Highest measured ball position minus the target height, of the flights before the last
    bounces."""
    bounce_position: Annotated[History, Quantity(2, "m")] = 0
    """Measured horizontal position of the ball at the lowest point of the last bounces."""
    bounce_interval: Annotated[History, Quantity(1, "s")] = 0
    """Time between the last bounces."""
    bounce_joint_angles: Annotated[History, Quantity(None, "rad")] = 0
    """Measured joint angles at the lowest points of the last bounces."""
    bounce_joint_velocities: Annotated[History, Quantity(None, "rad/s")] = 0
    """Measured joint velocities at the lowest points of the last bounces."""


class BounceConfig(WorldConfig):
    """The world, and the task of bouncing: target heights, bounces, ends and reward."""

    target_height_range: tuple[float, float] = (0.4, 0.6)
    """Range of the target height, m; equal ends fix it."""
    bounce_min_velocity: NonNegative = 0.01
    """Vertical velocity above which the ball counts as rising, m/s."""
    bounce_max_distance: Positive = 0.12
    """Vertical distance between ball and paddle within which a reversal is a bounce, m."""
    apex_tolerance: NonNegative = 0.1
    """Distance below the target up to which an apex continues the bounce count, m."""
    min_ball_height: Finite = 0.05
    """The episode ends when the ball is below this height, m."""
    max_height_above_target: Positive = 1.0
    """The episode ends when the ball is higher than this above the target height, m."""
    max_horizontal_distance: Positive = 1.5
    """The episode ends when |x| or |y| of the ball exceeds this, m."""
    observation: BounceObservation = BounceObservation()
    """The quantities that the policy sees."""
    reward: BounceReward = BounceReward()
    """The reward terms."""

    @pydantic.model_validator(mode="before")
    @classmethod
    def _read_former_keys(cls, values: Any) -> Any:
        """Earlier configs have the target height among the terms of the randomisation."""
        terms = values.get("randomization") if isinstance(values, dict) else None
        if not isinstance(terms, dict) or not terms.keys() & {"target_height", "target_interval"}:
            return values
        terms = dict(terms)
        heights, interval = terms.pop("target_height", None), terms.pop("target_interval", None)
        if interval is not None:
            terms["command_interval"] = interval
        moved = {} if heights is None else {"target_height_range": heights}
        return values | {"randomization": terms} | moved

    @pydantic.field_validator("target_height_range")
    @classmethod
    def _check_heights(cls, heights: tuple[float, float]) -> tuple[float, float]:
        low, high = heights
        if not 0.0 < low <= high < math.inf:
            raise ValueError(
                f"target_height_range {heights} is not 0 < low <= high; give two heights in "
                "metres, the lower first"
            )
        return heights

    @property
    def commands(self) -> dict[str, Command]:
        """The target height."""
        return {"target_height": Command(*self.target_height_range, "m", least=1e-3)}


class BounceState(NamedTuple):
    """What the task keeps of an episode."""

    rising: jax.Array
    """Whether the ball moved upward after the last step [], bool."""
    n_bounces: jax.Array
    """Consecutive bounces [], float."""
    apex: jax.Array
    """Highest ball position since the last bounce [], m."""


class MeasuredFlight(NamedTuple):
    """What the measurements tell of the present flight."""

    apex: jax.Array
    """Highest measured position since the ball was last near the paddle [], m."""
    is_low: jax.Array
    """Whether the ball was measured near the paddle [], bool."""
    lowest: jax.Array
    """Lowest measured position while the ball is near the paddle [], m."""
    time: jax.Array
    """Time since the first measurement near the paddle in the last bounce [], s."""


class Bounce(Task):
    """The ball bounces on the paddle at the commanded height."""

    Config = BounceConfig
    config: BounceConfig

    def reset(self, start: Start) -> BounceState:
        """No bounce yet; the first apex is the height at which the ball starts."""
        height = start.truth.ball_position[2]
        return BounceState(jnp.zeros((), bool), jnp.zeros_like(height), apex=height)

    def step(self, state: BounceState, step: Step) -> TaskStep:
        """A bounce or none, the specification's reward, and whether the ball is lost."""
        target, truth, reward = step.command["target_height"], step.truth, self.config.reward
        after, bounced = self.detect(
            state, target, truth.ball_position, truth.ball_velocity, truth.paddle_position
        )
        inputs = RewardInputs(
            ball_position=truth.ball_position,
            ball_velocity=truth.ball_velocity,
            paddle_position=truth.paddle_position,
            target_height=target,
            n_bounces=after.n_bounces,
            bounced=bounced,
            action=step.action,
            last_action=step.last_action,
            joint_velocity=truth.joint_velocities,
            home=reward,
        )
        return TaskStep(
            state=after,
            reward=weighted_terms(reward, inputs),
            ended=self.is_lost(truth.ball_position, target),
            metrics={
                "bounced": bounced,
                "n_bounces": after.n_bounces,
                "ball_xy_error": inputs.err_xy,
                "apex_error": jnp.where(bounced, jnp.abs(state.apex - target), 0.0),
            },
        )

    def detect(
        self,
        state: BounceState,
        target_height: jax.Array,
        ball: jax.Array,
        ball_velocity: jax.Array,
        paddle: jax.Array,
    ) -> tuple[BounceState, jax.Array]:
        """Detects a bounce and counts it.

        A bounce is the first step on which the ball rises, near the paddle. It adds to the count if
        the apex before it was above the target height minus the tolerance; otherwise the count
        restarts at 1, which is also the count after the first bounce of an episode.

        Args:
          ball, ball_velocity, paddle: positions [3] (m) and velocity [3] (m/s) after the step.

        Returns:
          The new state, and whether this step is a bounce [] (bool).
        """
        config = self.config
        rising = ball_velocity[2] > config.bounce_min_velocity
        near = jnp.abs(ball[2] - paddle[2]) < config.bounce_max_distance
        bounced = rising & ~state.rising & near
        continues = state.apex > target_height - config.apex_tolerance
        counted = jnp.where(continues, state.n_bounces + 1.0, 1.0)
        after = BounceState(
            rising=rising,
            n_bounces=jnp.where(bounced, counted, state.n_bounces),
            apex=jnp.where(bounced, ball[2], jnp.maximum(state.apex, ball[2])),
        )
        return after, bounced

    def is_lost(self, ball: jax.Array, target_height: jax.Array) -> jax.Array:
        """Whether the ball [3] fell, flew too high or too far [], bool."""
        config = self.config
        fell = ball[2] < config.min_ball_height
        too_high = ball[2] > target_height + config.max_height_above_target
        too_far = jnp.any(jnp.abs(ball[:2]) > config.max_horizontal_distance)
        return fell | too_high | too_far

    def first_quantities(
        self, measured: dict[str, jax.Array]
    ) -> tuple[MeasuredFlight, dict[str, jax.Array]]:
        """Before the first bounce, its quantities are those of the start."""
        height = measured["ball_position"][2]
        zero = jnp.zeros_like(height)
        flight = MeasuredFlight(height, jnp.zeros((), bool), lowest=height, time=zero)
        return flight, {
            "apex_error": zero[None],
            "bounce_position": measured["ball_position"][:2],
            "bounce_interval": zero[None],
            "bounce_joint_angles": measured["joint_angles"],
            "bounce_joint_velocities": measured["joint_velocities"],
        }

    def next_quantities(
        self,
        memory: MeasuredFlight,
        seen: dict[str, jax.Array],
        measured: dict[str, jax.Array],
    ) -> tuple[MeasuredFlight, dict[str, jax.Array]]:
        """A measured bounce starts when the ball is first measured near the paddle. Its position
        and joints are taken at the ball's lowest measured point."""
        height = measured["ball_picture"][2]
        is_low = height < measured["paddle_position"][2] + self.config.bounce_max_distance
        starts = is_low & ~memory.is_low
        at_lowest = starts | (is_low & (height < memory.lowest))
        time = memory.time + self.config.control_dt
        new = {
            "apex_error": (starts, memory.apex - measured["target_height"]),
            "bounce_interval": (starts, time[None]),
            "bounce_position": (at_lowest, measured["ball_picture"][:2]),
            "bounce_joint_angles": (at_lowest, measured["joint_angles"]),
            "bounce_joint_velocities": (at_lowest, measured["joint_velocities"]),
        }
        flight = MeasuredFlight(
            apex=jnp.where(is_low, height, jnp.maximum(memory.apex, height)),
            is_low=is_low,
            lowest=jnp.where(at_lowest, height, memory.lowest),
            time=jnp.where(starts, 0.0, time),
        )
        return flight, {name: latest(past, starts, *new[name]) for name, past in seen.items()}


class BounceBall(Env):
    """The environment of the original specification."""

    def __init__(self, config: BounceConfig | None = None, randomize: Any = None):
        """See `Env`; without a config, the specification's."""
        super().__init__(config or BounceConfig(), randomize)
