"""Dribbling as a task of one's own (docs/tasks.md): many low bounces."""

import math
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx import task

SETTLING_SECONDS = 2.0
"""The start of an episode, which the results leave out."""


class Inputs(NamedTuple):
    """What the reward terms depend on."""

    reach: jax.Array
    """Height over the paddle that the ball's energy allows [], m."""
    target: jax.Array
    """Target height [], m."""
    distance: jax.Array
    """Horizontal distance of the ball from its start [], m."""


class ApexReward(task.RewardTerm):
    """Apex: the ball's energy is that of a bounce to the target height."""

    weight: float = 4.0
    """Weight of the term."""
    scale: float = 0.02
    """Width of the Gaussian, m."""

    def value(self, inputs: Inputs) -> jax.Array:
        return task.gaussian(inputs.reach - inputs.target, self.scale)


class CentreReward(task.RewardTerm):
    """Centre: the ball stays over the point where it started."""

    weight: float = 2.0
    """Weight of the term."""
    scale: float = 0.05
    """Width of the Gaussian, m."""

    def value(self, inputs: Inputs) -> jax.Array:
        return task.gaussian(inputs.distance, self.scale)


class Rewards(task.StrictModel):
    """The reward terms."""

    apex: ApexReward = ApexReward()
    centre: CentreReward = CentreReward()


class Observation(task.ObservationConfig):
    """The world's quantities, and the target apex."""

    apex: Annotated[task.History, task.Quantity(1, "m", "goal")] = 1
    """Target height of the apexes above the paddle."""


class Config(task.WorldConfig):
    """The world, with a ball that starts low, and the settings of dribbling."""

    ball_init_pos: tuple[float, float, float] = (0.58856, 0.0, 0.25)
    """Ball position at a reset, before noise, m."""
    apex_range: tuple[float, float] = (0.065, 0.085)
    """Range of the target apex height above the paddle, m."""
    observation: Observation = Observation()
    """The quantities that the policy sees."""
    reward: Rewards = Rewards()
    """The reward terms."""

    @property
    def goals(self) -> dict[str, task.Goal]:
        low, high = self.apex_range
        return {"apex": task.Goal(low, high, "m", least=0.01, step=0.005)}


class Dribble(task.Task):
    """Many low bounces: apexes 5 to 10 cm over the paddle, more than three a second, for 20 s."""

    Config = Config
    curves = (task.Curve("task/apex_error", "apex_error", "apexes", "|apex − wish|", 100.0, "cm"),)

    def reset(self, start: task.Start) -> jax.Array:
        # The task's state: whether the ball rose after the last step [], bool.
        return jnp.zeros((), bool)

    def step(self, rose: jax.Array, step: task.Step) -> task.TaskStep:
        ball_position = step.truth.ball_position
        velocity_z = step.truth.ball_velocity[2]
        height_over_paddle = ball_position[2] - step.truth.paddle_position[2]
        height = height_over_paddle - self.geometry.rest_height
        distance = task.horizontal_distance(ball_position, self.config.ball_init_pos)
        target = step.goal["apex"]
        # The height at which the ball's speed would be 0.
        reach = height + jnp.square(velocity_z) / (2.0 * task.GRAVITY)
        inputs = Inputs(reach=reach, target=target, distance=distance)
        is_apex = rose & (velocity_z <= 0.0)
        is_low = (height > 0.05) & (height < 0.1)
        is_lost = (height < -0.03) | (height > 0.5) | (distance > 0.3)
        return task.TaskStep(
            state=velocity_z > 0.0,
            reward=task.weighted_terms(self.config.reward, inputs),
            ended=is_lost,
            metrics={
                "apexes": is_apex,
                "apex_error": jnp.where(is_apex, jnp.abs(height - target), 0.0),
                "low_apexes": is_apex & is_low,
            },
        )

    def tally(self, moment: task.Moment) -> task.Tally:
        has_settled = moment.seconds > SETTLING_SECONDS
        sums = {
            "apexes": moment.metrics["apexes"] * has_settled,
            "low_apexes": moment.metrics["low_apexes"] * has_settled,
            "seconds": self.config.control_dt * has_settled,
        }
        return task.Tally(sums)

    def results(self, episodes: task.Episodes) -> tuple[task.Result, ...]:
        apexes = episodes.sums["apexes"]
        low_apexes = episodes.sums["low_apexes"]
        seconds = episodes.sums["seconds"]
        return (
            task.share_of_events("height", "apexes 5 to 10 cm high", low_apexes, apexes, 0.95),
            task.mean_of_events("rate", "apexes a second", apexes, seconds, (3.0, math.inf)),
            task.share_of_episodes("stable", "episodes that last 20 s", episodes.lasted, 0.99),
        )
