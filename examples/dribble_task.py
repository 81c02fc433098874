"""Dribbling as a task of one's own (docs/tasks.md): many low bounces."""

import math
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx import task


class Inputs(NamedTuple):
    """What the reward terms depend on."""

    reach: jax.Array
    """Height over the paddle that the ball's energy allows [], m."""
    target: jax.Array
    """Commanded height [], m."""
    distance: jax.Array
    """Horizontal distance of the ball from its start [], m."""


class ApexReward(task.RewardTerm):
    """Apex: the ball's energy is that of a bounce to the commanded height."""

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
    """The world's quantities, and the commanded apex."""

    apex: Annotated[task.History, task.Quantity(1, "m", "command")] = 1
    """Commanded height of the apexes above the paddle."""


class Config(task.WorldConfig):
    """The world, with a ball that starts low, and the settings of dribbling."""

    ball_init_pos: tuple[float, float, float] = (0.58856, 0.0, 0.25)
    """Ball position at a reset, before noise, m."""
    apex_range: tuple[float, float] = (0.065, 0.085)
    """Range of the commanded apex height above the paddle, m."""
    observation: Observation = Observation()
    """The quantities that the policy sees."""
    reward: Rewards = Rewards()
    """The reward terms."""

    @property
    def commands(self) -> dict[str, task.Command]:
        return {"apex": task.Command(*self.apex_range, "m", least=0.01, step=0.005)}


class Dribble(task.Task):
    """Many low bounces: apexes 5 to 10 cm over the paddle, more than three a second, for 20 s."""

    Config = Config
    curves = (task.Curve("task/apex_error", "apex_error", "apexes", "|apex − wish|, cm", 100.0),)

    def reset(self, start: task.Start) -> jax.Array:
        # The task's state: whether the ball rose after the last step.
        return jnp.zeros((), bool)

    def step(self, rose: jax.Array, step: task.Step) -> task.TaskStep:
        ball, speed = step.truth.ball_position, step.truth.ball_velocity[2]
        height = ball[2] - step.truth.paddle_position[2] - self.geometry.rest_height
        distance = task.horizontal_distance(ball, self.config.ball_init_pos)
        wish = step.command["apex"]
        inputs = Inputs(height + jnp.square(speed) / (2.0 * 9.81), wish, distance)
        apex = rose & (speed <= 0.0)
        return task.TaskStep(
            state=speed > 0.0,
            reward=task.weighted_terms(self.config.reward, inputs),
            ended=(height < -0.03) | (height > 0.5) | (distance > 0.3),
            metrics={
                "apexes": apex,
                "apex_error": jnp.where(apex, jnp.abs(height - wish), 0.0),
                "low_apexes": apex & (height > 0.05) & (height < 0.1),
            },
        )

    def tally(self, moment: task.Moment) -> task.Tally:
        settled = moment.seconds > 2.0
        counted = {name: moment.metrics[name] * settled for name in ("apexes", "low_apexes")}
        return task.Tally({**counted, "seconds": settled * self.config.control_dt})

    def results(self, episodes: task.Episodes) -> tuple[task.Result, ...]:
        apexes, low, seconds = (episodes.sums[n] for n in ("apexes", "low_apexes", "seconds"))
        return (
            task.share_of_events("height", "apexes 5 to 10 cm high", low, apexes, 0.95),
            task.mean_of_events("rate", "apexes a second", apexes, seconds, (3.0, math.inf)),
            task.share_of_episodes("stable", "episodes that last 20 s", episodes.lasted, 0.99),
        )
