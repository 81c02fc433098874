"""A task without any event: the ball rests on the paddle. The tests train it by every command."""

import jax
import jax.numpy as jnp

from bounce_mjx import task


class StillReward(task.RewardTerm):
    """Still: the ball is slow."""

    def value(self, speed: jax.Array) -> jax.Array:
        return task.gaussian(speed, 0.1)


class Rewards(task.StrictModel):
    """The reward terms."""

    still: StillReward = StillReward()


class Config(task.WorldConfig):
    """The world, with a ball that starts on the paddle."""

    ball_init_pos: tuple[float, float, float] = (0.58856, 0.0, 0.075)
    """Ball position at a reset, before noise, m."""
    reset: task.ResetConfig = task.ResetConfig(ball_position=0.0, joint_angles=0.0)
    """The noise of a reset."""
    reward: Rewards = Rewards()
    """The reward terms."""


class Rest(task.Task):
    """The ball rests on the paddle."""

    Config = Config

    def reset(self, start: task.Start) -> tuple[()]:
        return ()

    def step(self, state: tuple[()], step: task.Step) -> task.TaskStep:
        speed = task.safe_sqrt(jnp.sum(jnp.square(step.truth.ball_velocity)))
        return task.TaskStep(
            state=(),
            reward=task.weighted_terms(self.config.reward, speed),
            ended=step.truth.ball_position[2] < 0.0,
            metrics={"speed": speed},
        )

    def results(self, episodes: task.Episodes) -> tuple[task.Result, ...]:
        return (task.share_of_episodes("rests", "episodes", episodes.lasted, 0.5),)
