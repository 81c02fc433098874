"""Balancing: the ball rests on the paddle and follows a target point on it, despite pushes."""

from __future__ import annotations

from typing import Annotated, Any

from bounce_mjx import task
from bounce_mjx.config.settings import HOLLOW, BallInertia, Coordinate, Friction
from bounce_mjx.lazy import jax, jnp

REACH = 0.03
"""Largest distance of the point from the paddle's centre, m."""
MAX_SPEED = 0.05
"""Greatest speed of the point, m/s."""
MIN_RADIUS = 0.01
"""Radius of the point's circle below which the point is slower than `point_speed`, m."""
LIFT = 0.003
"""Height of the ball over its rest on the paddle at a reset, m, because the noise of the joint
angles lifts the paddle by up to 2.5 mm."""
START_HEIGHT = 0.0225 + LIFT
"""Height of the ball over the paddle's centre at a reset, for the project's own ball and paddle,
m."""
LOST_DISTANCE = 0.1
"""The episode ends when the ball is farther from the paddle's centre, m."""
LOST_DEPTH = 0.02
"""The episode ends when the ball is farther below the paddle's centre, m."""
SETTLING_SECONDS = 1.0
"""Time at the start of an episode in which the error does not count, s."""
MAX_ERROR = 0.01
"""Greatest RMS error without pushes, m."""
MAX_PUSHED_ERROR = 0.015
"""Greatest RMS error with pushes, m."""
MIN_STABLE = 0.99
"""Least share of episodes that last."""


class Rewards(task.StrictModel):
    """The reward terms."""

    point: task.Gaussian = task.Gaussian(weight=2.0, scale=0.015)
    """The ball is at the point."""
    home: task.Gaussian = task.Gaussian(scale=0.05)
    """The paddle stays where it is held at a reset."""
    action_rate: task.Proportional = task.Proportional(weight=-0.2)
    """The mean squared change of the action: it does not jump."""


class Observation(task.ObservationConfig):
    """The world's quantities, and the point."""

    point_x: Annotated[task.History, task.Quantity(1, "m", "goal")] = 1
    """Point on the paddle, from its centre along the world's x."""
    point_y: Annotated[task.History, task.Quantity(1, "m", "goal")] = 1
    """The same along the world's y."""


class Config(task.WorldConfig):
    """The world, with a rough paddle and pushes, and the settings of balancing."""

    ball_init_pos: tuple[Coordinate, Coordinate, Coordinate] = (
        *task.PADDLE_HOME[:2],
        task.PADDLE_HOME[2] + START_HEIGHT,
    )
    """Mean ball position at a reset, m; higher where a larger ball would be within the paddle."""
    reset: task.ResetConfig = task.ResetConfig(joint_angles=0.002, ball_position=0.0)
    """The noise of a reset."""
    friction: Friction | None = 0.3
    """Coefficient of sliding friction between ball and paddle; null for the MJCF's."""
    ball_inertia: BallInertia | None = HOLLOW
    """Moment of inertia of the ball per mass and squared radius: 0.667 of a hollow ball, 0.4 of a
    solid one; null for the MJCF's."""
    observation: Observation = Observation(ball_quaternion=0, ball_angular_velocity=0)
    """The quantities that the policy sees: what a robot with a camera measures, and the point."""
    randomization: task.RandomizationConfig = task.RandomizationConfig(
        push_speed=(0.1, 0.1), push_interval=(2.0, 2.0)
    )
    """The world that each episode samples."""
    reward: Rewards = Rewards()
    """The reward terms."""

    @classmethod
    def settings_at(cls, paddle: tuple[float, float, float]) -> dict[str, Any]:
        """The ball on the paddle, in place of the world's start over it."""
        x, y, z = paddle
        return {"ball_init_pos": [x, y, round(z + START_HEIGHT, 4)]}

    @property
    def limits(self) -> task.Limits:
        """Relative to the paddle's centre."""
        return (
            task.Limit("LOST_DEPTH", "below", LOST_DEPTH),
            task.Limit("LOST_DISTANCE", "distance", LOST_DISTANCE),
        )

    @property
    def goals(self) -> dict[str, task.Goal]:
        """The point from the paddle's centre along the world's x and y, and its speed."""
        coordinate = task.Goal(-REACH, REACH, "m", least=-REACH, greatest=REACH, step=0.005)
        speed = task.Goal(
            -MAX_SPEED,
            MAX_SPEED,
            "m/s",
            least=-MAX_SPEED,
            greatest=MAX_SPEED,
            step=0.01,
            hidden=True,
        )
        return {"point_x": coordinate, "point_y": coordinate, "point_speed": speed}


class Balance(task.Task):
    """The ball rests on the paddle and follows the point (point_x, point_y) on it. The point moves
    on a circle with `point_speed`, anticlockwise if it is positive; 0 keeps it where it is."""

    Config = Config
    config: Config
    curves = (task.Curve("task/error", "error", title="ball to point", scale=100.0, unit="cm"),)
    num_draws = 4
    ball_thrown = False
    ball_dropped = False

    # The start.

    def throw(self, draws: jax.Array, goal: task.Values) -> tuple[jax.Array, jax.Array]:
        """The ball lies still within half the reach of `ball_init_pos`, higher where a larger ball
        would be within the paddle."""
        x, y, z = self.config.ball_init_pos
        rest = self.geometry.paddle_home[2] + self.geometry.rest_height
        if z < rest:
            z = rest + LIFT
        offset_x, offset_y = REACH * (draws[:2] - 0.5)
        position = jnp.stack([x + offset_x, y + offset_y, jnp.full_like(x, z)])
        return position, jnp.zeros(3)

    def reset(self, start: task.Start) -> jax.Array:
        """The centre [2] of the point's circle, from the paddle's centre, m."""
        return 0.7 * REACH * (2.0 * start.draws[2:] - 1.0)

    # The point.

    def next_goal(self, centre: jax.Array, goal: task.Values) -> task.Values:
        """The point turns about its sampled centre, from where it is or a user has set it, and
        stays within reach."""
        arm = _point(goal) - centre
        way = goal["point_speed"] * self.config.control_dt
        angle = way / jnp.maximum(task.length(arm), MIN_RADIUS)
        sideways = jnp.stack([-arm[1], arm[0]])
        point = centre + jnp.cos(angle) * arm + jnp.sin(angle) * sideways
        x, y = point * REACH / jnp.maximum(task.length(point), REACH)
        return goal | {"point_x": x, "point_y": y}

    # A control step: reward, end, metrics.

    def step(self, centre: jax.Array, step: task.Step) -> task.TaskStep:
        truth = step.truth
        offset = truth.ball_position - truth.paddle_position
        point_error = task.length(offset[:2] - _point(step.goal))
        home = jnp.array(self.geometry.paddle_home)
        return task.TaskStep(
            state=centre,
            reward=task.weighted_terms(
                self.config.reward,
                point=point_error,
                home=task.length(truth.paddle_position - home),
                action_rate=jnp.mean(jnp.square(step.action - step.last_action)),
            ),
            ended=task.is_beyond(self.config.limits, truth.ball_position, truth.paddle_position),
            metrics={"error": point_error},
        )

    # The results.

    def tally(self, moment: task.Moment) -> task.Tally:
        # Between two steps, so that rounding does not decide.
        is_judged = moment.seconds > SETTLING_SECONDS + 0.5 * self.config.control_dt
        return task.Tally(
            sums={
                "steps": is_judged,
                "squares": is_judged * moment.metrics["error"] ** 2,
            }
        )

    def results(self, episodes: task.Episodes) -> tuple[task.Result, ...]:
        """Stable episodes, and the error; whether the pushes are on decides on its bound."""
        _, greatest_push = self.config.randomization.push_speed or (0.0, 0.0)
        max_error = MAX_PUSHED_ERROR if greatest_push > 0.0 else MAX_ERROR
        return (
            task.share_of_episodes("stable", "episodes that last", episodes.lasted, MIN_STABLE),
            task.root_mean_square(
                "error",
                "RMS distance of ball and point, cm",
                1e4 * episodes.sums["squares"],
                episodes.sums["steps"],
                100.0 * max_error,
            ),
        )

    # What is shown.

    def markers(self, goal: Any, metrics: Any) -> tuple[task.Marker, ...]:
        """A frame around the ball at the point."""
        x, y, z = self.focus()
        radius = self.geometry.ball_radius
        face = z + self.geometry.rest_height - radius
        return (
            task.Marker(
                "point",
                position=(x + goal["point_x"], y + goal["point_y"], face + 0.0005),
                size=(radius + 0.002, radius + 0.002, 0.001),
                rgba=(0.15, 0.9, 0.3, 0.9),
                shape="frame",
            ),
        )

    def readings(self, goal: dict[str, float], metrics: dict[str, float]) -> dict[str, str]:
        return {"from the point": f"{1000.0 * metrics['error']:.0f} mm"}

    def focus(self) -> tuple[float, float, float]:
        """Where the paddle is held at a reset."""
        return self.geometry.paddle_home


def _point(goal: task.Values) -> jax.Array:
    """The point from the paddle's centre [2], m."""
    return jnp.stack([goal["point_x"], goal["point_y"]])
