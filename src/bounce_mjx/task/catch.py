"""Catching: a ball that is thrown at the arm comes to rest on the paddle after a few bounces."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import pydantic

from bounce_mjx import task
from bounce_mjx.config.settings import HOLLOW, BallInertia, Coordinate, Duration, Finite, Friction
from bounce_mjx.lazy import jax, jnp

SPEEDS = (1.0, 2.0)
"""Range of a throw's horizontal speed, m/s; `MAX_DISTANCE` lowers its upper end and, for a paddle
farther than about 1.3 m from the base, both."""
FLIGHT_SECONDS = (0.6, 0.7)
"""Range of the time until a thrown ball is at its aim, s."""
MAX_DISTANCE = 2.0
"""Greatest horizontal distance of a start from the arm's base, m."""
MAX_DIRECTION = math.radians(30.0)
"""Greatest angle of a throw to the line from the paddle to the base, rad."""
AIM_RADIUS = 0.05
"""Greatest distance of the aim from the ball's rest on the paddle, m."""
REST_HEIGHT = 0.0225
"""Height of a resting ball over the paddle's centre, for the project's own ball and paddle, m."""
REST_SPEED = 0.05
"""A ball that touches the paddle rests on it if it is slower relative to it, m/s."""
REST_SECONDS = 0.5
"""Time for which a ball has to rest to be at rest, s."""
CATCH_SECONDS = 2.0
"""A caught ball is at rest within this time of the first contact, s."""
MIN_CAUGHT = 0.95
"""Least share of caught balls."""
LOST_DEPTH = 0.05
"""The episode ends when the ball is farther below the paddle's centre, m."""
FLOOR = 0.02
"""The episode ends when the paddle's centre is nearer the floor, m."""


class Rest(task.RewardTerm):
    """A term of a ball that rests on the paddle, and more of one that hardly moves against it.

    A ball just below `REST_SPEED` is at rest, but the noise of a training hides for how long: paid
    by rest alone, policies kept twitching there.
    """

    weight: Finite = 3.0
    """Weight of the term."""

    def value(self, inputs: tuple[jax.Array, jax.Array]) -> jax.Array:
        """The unweighted term []: 2 - (speed / REST_SPEED)^2 for a ball at rest, else 0.

        Args:
          inputs: whether the ball rests [], bool, and its speed relative to the paddle [], m/s.
        """
        resting, speed = inputs
        return jnp.where(resting, 2.0 - jnp.square(speed / REST_SPEED), 0.0)


class Rewards(task.StrictModel):
    """The reward terms."""

    centre: task.Gaussian = task.Gaussian(scale=0.05)
    """The ball is over the paddle's centre."""
    fall: task.Gaussian = task.Gaussian(scale=1.5)
    """The ball has little energy: the speed relative to the paddle at which it meets it or would,
    m/s."""
    rest: Rest = Rest()
    """The ball touches the paddle and moves with it, the less against it the better."""
    action_rate: task.Proportional = task.Proportional(weight=-0.1)
    """The mean squared change of the action: it does not jump."""


class Config(task.WorldConfig):
    """The world, with a rough paddle and a thrown ball, and the settings of catching."""

    episode_seconds: Duration = 3.0
    """Length of an episode before it is truncated, s."""
    ball_init_pos: tuple[Coordinate, Coordinate, Coordinate] = (
        *task.PADDLE_HOME[:2],
        task.PADDLE_HOME[2] + REST_HEIGHT,
    )
    """Where the ball would rest on the paddle at a reset, m; throws aim near it, or higher where a
    larger ball rests higher."""
    reset: task.ResetConfig = task.ResetConfig(joint_angles=0.02, ball_position=0.0)
    """The noise of a reset."""
    friction: Friction | None = 0.3
    """Coefficient of sliding friction between ball and paddle; null for the MJCF's."""
    ball_inertia: BallInertia | None = HOLLOW
    """Moment of inertia of the ball per mass and squared radius: 0.667 of a hollow ball, 0.4 of a
    solid one; null for the MJCF's."""
    action: task.ActionConfig = task.ActionConfig(base="target")
    """What an action adds to."""
    observation: task.ObservationConfig = task.ObservationConfig(
        ball_quaternion=0, ball_angular_velocity=0, servo_lead=1
    )
    """The quantities that the policy sees: what a robot with a camera measures, and how far the
    targets lead, to which an action adds."""
    reward: Rewards = Rewards()
    """The reward terms."""

    @pydantic.model_validator(mode="after")
    def _check_throws(self):
        """A throw starts farther out than its aim."""
        distance = math.hypot(*self.ball_init_pos[:2])
        if distance + AIM_RADIUS > MAX_DISTANCE:
            raise ValueError(
                f"ball_init_pos is {distance:.3g} m from the base, but a throw starts farther out, "
                f"at most {MAX_DISTANCE:g} m from it; give at most {MAX_DISTANCE - AIM_RADIUS:g} m"
            )
        return self

    @classmethod
    def settings_at(cls, paddle: tuple[float, float, float]) -> dict[str, Any]:
        """The ball's rest on the paddle, in place of the world's start over it."""
        x, y, z = paddle
        return {"ball_init_pos": [x, y, round(z + REST_HEIGHT, 4)]}

    @property
    def limits(self) -> task.Limits:
        """Relative to the paddle's centre."""
        return (task.Limit("LOST_DEPTH", "below", LOST_DEPTH),)


class State(NamedTuple):
    """What the task keeps of an episode."""

    fall: jax.Array
    """Vertical velocity of the ball after the last step [], m/s (of the reward, `fall` is another
    speed)."""
    offset: jax.Array
    """From the paddle's centre to the ball after the last step [3], m."""
    contact: jax.Array
    """Time since the first contact [], s; 0 before it."""
    rest: jax.Array
    """Time for which the ball has rested on the paddle [], s."""
    caught: jax.Array
    """Whether the ball was at rest in time [], bool."""


class Catch(task.Task):
    """A ball is thrown at the arm, which brings it to rest on the paddle."""

    Config = Config
    config: Config
    # Also of balls that are lost later, unlike the result.
    curves = (task.Curve("episode/caught", "caught", "episodes", "share of balls at rest in time"),)
    num_draws = 5

    # The start.

    def throw(self, draws: jax.Array, goal: task.Values) -> tuple[jax.Array, jax.Array]:
        """The throw starts at the height of its aim, so that the ball falls at 2.9 to 3.4 m/s."""
        x, y, z = self.config.ball_init_pos
        rest_height = self.geometry.paddle_home[2] + self.geometry.rest_height
        home = jnp.array([x, y, max(z, rest_height)])
        # The root makes the aims uniform over the disc.
        aim_offset = AIM_RADIUS * jnp.sqrt(draws[0]) * _direction(2.0 * math.pi * draws[1])

        shortest, longest = FLIGHT_SECONDS
        seconds = shortest + (longest - shortest) * draws[2]

        slowest, fastest = SPEEDS
        speed_from_limit = (MAX_DISTANCE - task.length(home[:2] + aim_offset[:2])) / seconds
        greatest = jnp.minimum(fastest, speed_from_limit)
        least = jnp.minimum(slowest, greatest)
        speed = least + (greatest - least) * draws[3]

        away_from_base = jnp.arctan2(home[1], home[0])
        outward = away_from_base + MAX_DIRECTION * (2.0 * draws[4] - 1.0)
        horizontal_velocity = -speed * _direction(outward)
        # Half the flight rises.
        upward_velocity = jnp.array([0.0, 0.0, 0.5 * task.GRAVITY]) * seconds
        position = home + aim_offset - seconds * horizontal_velocity
        return position, horizontal_velocity + upward_velocity

    def reset(self, start: task.Start) -> State:
        truth = start.truth
        zero = jnp.zeros(())
        return State(
            fall=truth.ball_velocity[2],
            offset=truth.ball_position - truth.paddle_position,
            contact=zero,
            rest=zero,
            caught=zero > 0.0,
        )

    # A control step: contact, rest, reward, end.

    def step(self, state: State, step: task.Step) -> task.TaskStep:
        truth = step.truth
        dt = self.config.control_dt
        offset = truth.ball_position - truth.paddle_position
        # Not that at the end of the step, within which the servos' speed rises and falls.
        velocity = (offset - state.offset) / dt

        # A ball that touches nothing falls freely.
        touches = truth.ball_velocity[2] - state.fall > -0.5 * task.GRAVITY * dt
        speed = task.length(velocity)
        resting = touches & (speed < REST_SPEED)
        contact = jnp.where(touches | (state.contact > 0.0), state.contact + dt, 0.0)
        rest_seconds = jnp.where(resting, state.rest + dt, 0.0)
        in_time = contact < CATCH_SECONDS + 0.5 * dt
        caught = state.caught | (in_time & (rest_seconds > REST_SECONDS - 0.5 * dt))

        is_lost = task.is_beyond(self.config.limits, truth.ball_position, truth.paddle_position)
        hits_floor = truth.paddle_position[2] < FLOOR
        return task.TaskStep(
            state=State(
                fall=truth.ball_velocity[2],
                offset=offset,
                contact=contact,
                rest=rest_seconds,
                caught=caught,
            ),
            reward=task.weighted_terms(
                self.config.reward,
                centre=task.length(offset[:2]),
                fall=self._impact_speed(offset, velocity),
                rest=(resting, speed),
                action_rate=jnp.mean(jnp.square(step.action - step.last_action)),
            ),
            ended=is_lost | hits_floor,
            metrics={"caught": caught},
        )

    def _impact_speed(self, offset: jax.Array, velocity: jax.Array) -> jax.Array:
        """Speed [] relative to the paddle at which the ball meets it, m/s, by its energy:
        sqrt(v^2 + 2 g h) for a ball at the height h over its rest on the paddle.

        Args:
          offset: from the paddle's centre to the ball [3], m.
          velocity: of the ball relative to the paddle [3], m/s.
        """
        height = jnp.maximum(offset[2] - self.geometry.rest_height, 0.0)
        from_fall = 2.0 * task.GRAVITY * height
        return task.safe_sqrt(jnp.sum(jnp.square(velocity)) + from_fall)

    # The results.

    def tally(self, moment: task.Moment) -> task.Tally:
        return task.Tally(sums={}, maxima={"caught": moment.metrics["caught"]})

    def results(self, episodes: task.Episodes) -> tuple[task.Result, ...]:
        measured = (
            f"balls at rest within {CATCH_SECONDS:g} s of the first contact, "
            "and not lost before the end"
        )
        caught = (episodes.maxima["caught"] > 0.0) & episodes.lasted
        return (task.share_of_episodes("caught", measured, caught, MIN_CAUGHT),)

    # What is shown.

    def markers(self, goal: Any, metrics: Any) -> tuple[task.Marker, ...]:
        """A disc around the points at which throws aim."""
        return (
            task.Marker(
                "aim",
                position=self.focus(),
                size=(AIM_RADIUS, 0.0005, 0.0),
                rgba=(0.15, 0.9, 0.3, 0.4),
                shape="cylinder",
            ),
        )

    def readings(self, goal: dict[str, float], metrics: dict[str, float]) -> dict[str, str]:
        return {"caught": "yes" if metrics["caught"] else "no"}

    def focus(self) -> tuple[float, float, float]:
        """Where the paddle is held at a reset."""
        return self.geometry.paddle_home


def _direction(angle: jax.Array) -> jax.Array:
    """Horizontal unit vector [3] at an angle [] to x."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)])
