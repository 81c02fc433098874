"""Juggling: balls bounce alternately at the target height on one paddle, each in a column."""

from __future__ import annotations

import itertools
from typing import Annotated, Any

from pydantic import Field

from bounce_mjx import task
from bounce_mjx.config.settings import Coordinate, Finite, Length, Positive, Range
from bounce_mjx.errors import UserError
from bounce_mjx.lazy import jax, jnp
from bounce_mjx.task import flights

FLOWN = 0.125
"""Share of its flight that the ball of the highest number has flown at a reset."""
MIN_EPISODE_SHARE = 0.99
"""Least share of episodes that keep all balls, and of those in which none touch."""
MIN_TURN_SHARE = 0.99
"""Least share of hits that alternate."""
MIN_HEIGHT_SHARE = 0.95
"""Least share of accurate apexes."""
Height = Annotated[Finite, Field(ge=flights.MIN_TARGET_HEIGHT, le=10.0)]


class NearByBall(task.Near):
    """A term that falls with the length of each ball's error: the mean of `task.Near`."""

    def value(self, errors: jax.Array) -> jax.Array:
        """The unweighted term [] for a row of errors for each ball [B, ...]."""
        return jnp.mean(jax.vmap(super().value)(errors))


class Rewards(task.StrictModel):
    """The reward terms. Those of the balls are means over them, whose flights are rated at each of
    their steps."""

    apex: NearByBall = NearByBall(weight=6.0)
    """The flight's apex is in the column at the height, of which 0.1 m count as 0.03 m."""
    landing: NearByBall = NearByBall(weight=2.0)
    """The flight ends in the column."""
    turn: NearByBall = NearByBall(weight=4.0)
    """The ball of the next number lands one turn later, s."""
    home: task.Near = task.Near(scale=0.05)
    """The paddle is at home."""
    calm: task.Near = task.Near(weight=0.1, scale=10.0)
    """The joints and the actions change slowly."""


class Observation(task.ObservationConfig):
    """The world's quantities, the height, and the next ball."""

    target_height: Annotated[task.History, task.Quantity(1, "m", "goal")] = 1
    next_ball: Annotated[task.History, task.Quantity(9)] = 1
    """Of the ball that lands next: its landing from the paddle and from the column (m), its
    horizontal velocity (m/s), its apex from the height (m), the time until it lands, and from then
    until the mean of all landings (s)."""


class Config(task.WorldConfig):
    """The world with two or three balls, their columns, the ends and the reward."""

    num_balls: task.NumBalls = 2
    """Number of balls, 2 or 3."""
    home: tuple[Coordinate, Coordinate, Coordinate] = task.PADDLE_HOME
    """Home of the paddle, m; the columns stand side by side over it."""
    spacing: Annotated[Positive, Field(le=1.0)] = 0.065
    """Distance between columns, m."""
    height_range: Range[Height] = (0.35, 0.55)
    """Range of the target height over home, m."""
    max_distance: Length = 0.7
    """The episode ends when a ball is this far from the top of its column, m; or when it is lower
    than home, or two touch."""
    action: task.ActionConfig = task.ActionConfig(base="target")
    """What an action adds to."""
    observation: Observation = Observation(ball_quaternion=0, ball_angular_velocity=0)
    """The quantities that the policy sees."""
    reward: Rewards = Rewards()
    """The reward terms."""

    @classmethod
    def settings_at(cls, paddle: tuple[float, float, float]) -> dict[str, Any]:
        return super().settings_at(paddle) | {"home": paddle}

    @property
    def heights(self) -> dict[str, float]:
        # Not ball_init_pos, as the balls are thrown.
        return {"height_range": self.home[2] + self.height_range[0]}

    @property
    def limits(self) -> task.Limits:
        return (
            task.Limit("home", "lowest", self.home[2]),
            task.Limit("max_distance", "distance", self.max_distance),
        )

    @property
    def goals(self) -> dict[str, task.Goal]:
        """The height of the apexes."""
        home_height = self.home[2]
        lowest, highest = self.height_range
        heights = task.target_heights(self.limits, min_flight=flights.MIN_TARGET_HEIGHT)
        return {
            "target_height": task.Goal(
                home_height + lowest,
                home_height + highest,
                "m",
                least=heights.least,
                greatest=heights.greatest,
                setting="height_range",
                reason=heights.reason,
            )
        }

    def columns(self, height: Any) -> list[tuple[Any, Any, Any]]:
        """The top of each ball's column: its target apex (x, y, z), m.

        Args:
          height: the target height [], m.
        """
        x, y, _ = self.home
        middle = 0.5 * (self.num_balls - 1)
        return [(x, y + self.spacing * (ball - middle), height) for ball in range(self.num_balls)]


class Juggle(task.Task):
    """Balls bounce alternately at the target height on one paddle, each in a column."""

    Config = Config
    config: Config
    num_balls = (2, 3)
    ball_rests = False
    curves = (
        task.Curve("task/turns", "in_turn", "hits", "alternating hits", 100.0, "%"),
        task.Curve("task/height_error", "height_error", "apexes", "|apex − height|", 100.0, "cm"),
    )

    # Places and times.

    @property
    def ground(self) -> float:
        """Height of a ball that touches the paddle at home, m."""
        return flights.ground(self.config.home, self.geometry)

    def _columns(self, height: jax.Array) -> jax.Array:
        """The tops of the columns [B, 3] at the target height [], m."""
        tops = []
        for x, y, z in self.config.columns(height):
            tops.append(jnp.stack([jnp.asarray(x), jnp.asarray(y), jnp.asarray(z)]))
        return jnp.stack(tops)

    def _period(self, height: jax.Array) -> jax.Array:
        """Time from one hit of a ball to its next one [], s, with an apex at the height [], m:
        2 sqrt(2 h / g) for an apex h over the ground."""
        return 2.0 * task.safe_sqrt(2.0 * (height - self.ground) / task.GRAVITY)

    # The start.

    def check(self) -> None:
        """Refuses columns in which the balls touch as they pass each other."""
        _, largest = self.config.randomization.ball_radius or (1.0, 1.0)
        radii = [radius * largest for radius in self.geometry.ball_radii]
        for i, j in itertools.combinations(range(len(radii)), 2):
            apart = (j - i) * self.config.spacing
            if apart <= radii[i] + radii[j]:
                raise UserError(
                    f"spacing is {self.config.spacing:g} m, but balls of the radii {radii[i]:.4g} "
                    f"and {radii[j]:.4g} m touch in columns that are {apart:g} m apart; give more"
                )

    def throw(self, draws: jax.Array, goal: task.Values) -> tuple[jax.Array, jax.Array]:
        """The balls are in their columns and land alternately, in the order of their numbers."""
        height = goal["target_height"]
        period = self._period(height)
        count = self.config.num_balls
        # Share of a period that each ball has flown more than that of the highest number.
        flown_more = jnp.arange(count)[::-1, None] / count
        # Time until each ball's apex along z; negative after it.
        rise = (0.5 - FLOWN - flown_more) * period * jnp.array([0.0, 0.0, 1.0])
        positions = self._columns(height) - 0.5 * task.GRAVITY * jnp.square(rise)
        velocities = task.GRAVITY * rise
        return positions, velocities

    def reset(self, start: task.Start) -> tuple[jax.Array, jax.Array]:
        """Whether each ball rises [B], bool, and the number of the ball that was hit last []: the
        highest, so that ball 0 is next in turn."""
        rising = start.truth.ball_velocity[:, 2] > 0.0
        last_hit = jnp.full((), self.config.num_balls - 1.0)
        return rising, last_hit

    # A control step: events, reward, end, metrics.

    def step(self, state: tuple[jax.Array, jax.Array], step: task.Step) -> task.TaskStep:
        rose, last_hit = state
        truth = step.truth
        balls = truth.ball_position
        height = step.goal["target_height"]
        columns = self._columns(height)
        flight = task.flight(balls, truth.ball_velocity, self.ground)

        rising = truth.ball_velocity[:, 2] > 0.0
        hits = rising & ~rose
        apexes = flights.is_apex(rose, rising, balls[:, 2], self.config.home)

        is_lost = task.is_beyond(self.config.limits, balls, columns)
        touched = self._touched(step)

        ball_numbers = jnp.arange(self.config.num_balls)
        next_in_turn = jnp.mod(last_hit + 1.0, self.config.num_balls)
        height_errors = jnp.abs(balls[:, 2] - height)
        next_landing = _next(flight.end, flight.fall)
        return task.TaskStep(
            state=(
                rising,
                jnp.where(jnp.any(hits), jnp.max(ball_numbers * hits), last_hit),
            ),
            reward=task.weighted_terms(
                self.config.reward,
                apex=flights.apex_error(flight, columns),
                landing=flights.landing_error(flight, columns),
                turn=self._turn_errors(flight, self._period(height)),
                home=truth.paddle_position - jnp.array(self.config.home),
                calm=task.changes(truth.joint_velocities, step.action, step.last_action),
            ),
            ended=jnp.any(is_lost) | touched,
            metrics={
                "hits": jnp.sum(hits),
                "in_turn": jnp.sum(hits & (ball_numbers == next_in_turn)),
                "apexes": jnp.sum(apexes),
                "accurate": jnp.sum(apexes & (height_errors <= flights.MAX_HEIGHT_ERROR)),
                "height_error": jnp.sum(apexes * height_errors),
                "touched": touched,
                # For the marker, and logged as every metric.
                "landing_x": next_landing[0],
                "landing_y": next_landing[1],
            },
        )

    def _touched(self, step: task.Step) -> jax.Array:
        """Whether two balls touched during the step [], bool."""
        geometry = self.geometry
        first = geometry.ball_radius if step.ball_radius is None else step.ball_radius
        radii = [first * (radius / geometry.ball_radius) for radius in geometry.ball_radii]
        distance = task.closest(
            step.truth.ball_position, step.truth.ball_velocity, self.config.control_dt, radii
        )
        return distance < 0.0

    # The reward: the error of its own term.

    def _turn_errors(self, flight: task.Flight, period: jax.Array) -> jax.Array:
        """From a turn, `period` / B, to the time from the landing of each ball to that of the ball
        of the next number [B, 1], s.

        A ball lands again after a period, so whole periods do not count: of the landings, the error
        is that of the nearest one, within half a period.
        """
        between = jnp.roll(flight.fall, -1) - flight.fall
        late = between - period / self.config.num_balls
        nearest = jnp.mod(late + 0.5 * period, period) - 0.5 * period
        return nearest[:, None]

    # The observation: the next ball, from the measurements.

    def first_quantities(self, measured: task.Values) -> tuple[Any, task.Values]:
        height = measured["target_height"][0]
        velocities = measured["ball_velocity"]
        flight = task.flight(measured["ball_position"], velocities, self.ground)
        quantities = [
            (flight.end - measured["paddle_position"])[:, :2],
            (flight.end - self._columns(height))[:, :2],
            velocities[:, :2],
            (flight.top[:, 2] - height)[:, None],
            flight.fall[:, None],
            (jnp.mean(flight.fall) - flight.fall)[:, None],
        ]
        next_ball = _next(jnp.concatenate(quantities, axis=1), flight.fall)
        return (), {"next_ball": next_ball}

    def next_quantities(
        self, memory: Any, histories: task.Values, measured: task.Values
    ) -> tuple[Any, task.Values]:
        _, newest = self.first_quantities(measured)
        return (), {name: task.latest(old, newest[name]) for name, old in histories.items()}

    # The results.

    def tally(self, moment: task.Moment) -> task.Tally:
        metrics = moment.metrics
        settled = moment.goal_seconds > flights.SETTLING_SECONDS
        return task.Tally(
            sums={
                "hits": metrics["hits"],
                "in_turn": metrics["in_turn"],
                "apexes": settled * metrics["apexes"],
                "accurate": settled * metrics["accurate"],
            },
            maxima={"touched": metrics["touched"]},
        )

    def results(self, episodes: task.Episodes) -> tuple[task.Result, ...]:
        sums = episodes.sums
        apart = episodes.maxima["touched"] == 0.0
        return (
            task.share_of_episodes(
                "kept", "episodes that keep all balls", episodes.lasted, MIN_EPISODE_SHARE
            ),
            task.share_of_events(
                "turns", "alternating hits", sums["in_turn"], sums["hits"], MIN_TURN_SHARE
            ),
            task.share_of_episodes(
                "apart", "episodes without touching balls", apart, MIN_EPISODE_SHARE
            ),
            task.share_of_events(
                "height", "apexes within 0.1 m", sums["accurate"], sums["apexes"], MIN_HEIGHT_SHARE
            ),
        )

    # What is shown.

    def markers(self, goal: Any, metrics: Any) -> tuple[task.Marker, ...]:
        """A disc on top of each column, and a frame where the next ball lands."""
        markers = []
        for number, top in enumerate(self.config.columns(goal["target_height"]), start=1):
            markers.append(
                task.Marker(
                    f"target height {number}",
                    position=top,
                    size=(0.02, 0.001, 0.0),
                    rgba=(0.15, 0.9, 0.3, 0.6),
                    shape="cylinder",
                )
            )
        markers.append(
            task.Marker(
                "next ball",
                position=(metrics["landing_x"], metrics["landing_y"], self.ground),
                size=(0.021, 0.021, 0.001),
                rgba=(1.0, 0.8, 0.1, 0.9),
                shape="frame",
            )
        )
        return tuple(markers)

    def readings(self, goal: dict[str, float], metrics: dict[str, float]) -> dict[str, str]:
        return {"target": f"{goal['target_height']:.2f} m"}


def _next(values: jax.Array, falls: jax.Array) -> jax.Array:
    """The row of values [B, n] of the ball that lands next, after the shortest of the falls [B]
    (s)."""
    # Not values[argmin]: the exported graph takes fixed indices alone.
    chosen = values[0]
    soonest = jnp.min(falls)
    for ball_values, fall in zip(values[1:], falls[1:], strict=True):
        chosen = jnp.where(fall <= soonest, ball_values, chosen)
    return chosen
