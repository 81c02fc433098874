"""Bouncing with the paddle left of a line that moves: bouncing, extended by a goal, a reward term,
a metric and a result (docs/tutorial.md)."""

from typing import Annotated

import jax
import jax.numpy as jnp

from bounce_mjx import task
from bounce_mjx.config.settings import Coordinate, Range
from bounce_mjx.task import bounce, bounce_rewards

SETTLING_SECONDS = 1.0
"""Time since the line moved that the result leaves out, s."""


class LeftOfLine(task.RewardTerm):
    """0 if the paddle is left of the line by the margin, else minus what is missing."""

    weight: float = 2.0
    """Weight of the term."""
    margin: float = 0.01
    """Distance left of the line from which there is no penalty, m."""
    scale: float = 0.03
    """Distance that costs the weight, m."""

    def value(self, inputs: bounce_rewards.RewardInputs) -> jax.Array:
        left_by = inputs.paddle_position[1] - inputs.goal["line_y"]
        return -jnp.maximum(0.0, self.margin - left_by) / self.scale


class Rewards(bounce_rewards.Rewards):
    """The terms of bouncing, and the line's."""

    left_of_line: LeftOfLine = LeftOfLine()


class Observation(bounce.Observation):
    """What bouncing sees, and the line."""

    line_y: Annotated[task.History, task.Quantity(1, "m", "goal")] = 1
    """Place of the line along y."""


class Config(bounce.Config):
    """The settings of bouncing, and a line that moves every 3 s."""

    line_range: Range[Coordinate] = (-0.03, 0.03)
    """Range of the line's y, m."""
    observation: Observation = Observation()
    """What the policy sees."""
    reward: Rewards = Rewards()
    """The reward terms."""
    randomization: task.RandomizationConfig = task.RandomizationConfig(goal_interval=(3.0, 3.0))
    """The world that each episode samples, and how often the line moves."""

    @property
    def goals(self) -> dict[str, task.Goal]:
        low, high = self.line_range
        return super().goals | {"line_y": task.Goal(low, high, "m", step=0.01)}


class Line(bounce.Bounce):
    """The ball bounces while the paddle stays left of a line."""

    Config = Config

    def step(self, state: bounce.State, step: task.Step) -> task.TaskStep:
        left_by = step.truth.paddle_position[1] - step.goal["line_y"]
        return super().step(state, step).plus(metrics={"left_of_line": left_by > 0.0})

    def tally(self, moment: task.Moment) -> task.Tally:
        has_settled = moment.goal_seconds > SETTLING_SECONDS
        left = moment.metrics["left_of_line"] * has_settled
        return super().tally(moment).plus({"line_steps": has_settled, "left_steps": left})

    def results(self, episodes: task.Episodes) -> tuple[task.Result, ...]:
        sums = episodes.sums
        left = task.share_of_events(
            "left of the line",
            "steps left of it, from 1 s after it moved",
            sums["left_steps"],
            sums["line_steps"],
            0.9,
        )
        return (*super().results(episodes), left)
