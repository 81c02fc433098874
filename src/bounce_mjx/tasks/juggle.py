"""Juggling: balls bounce in turns at the commanded height on one paddle, each in a column."""

from __future__ import annotations

import itertools
from typing import Annotated, Any, NamedTuple

from bounce_mjx import task
from bounce_mjx.config.settings import Finite, Positive
from bounce_mjx.lazy import jax, jnp

REST = 0.0225
"""Height of a ball's centre over the paddle's while they touch, m."""
FLOWN = 0.125
"""Share of its flight that the last ball has flown at a reset."""
SETTLING, MAX_HEIGHT_ERROR = 2.0, 0.1
"""Time since the height was commanded after which apexes count, s, and how near they are, m."""


class Rewards(task.StrictModel):
    """The reward terms: means over the balls, whose flights are rated at each of their steps."""

    apex: task.Near = task.Near(weight=6.0)
    """The flight's apex is in the column at the height, of which 0.1 m count as 0.03 m."""
    landing: task.Near = task.Near(weight=2.0)
    """The flight ends in the column."""
    turn: task.Near = task.Near(weight=4.0)
    """The flight ends a turn after that of the ball before it, s."""
    home: task.Near = task.Near(scale=0.05)
    """The paddle is at home."""
    calm: task.Near = task.Near(weight=0.1, scale=10.0)
    """The joints and the actions change slowly."""


class Observation(task.ObservationConfig):
    """The world's quantities without the balls' rotation; the height; and the ball that lands
    next."""

    ball_quaternion: task.History = 0
    ball_angular_velocity: task.History = 0
    target_height: Annotated[task.History, task.Quantity(1, "m", "command")] = 1
    next_ball: Annotated[task.History, task.Quantity(9)] = 1
    """Of the ball that lands next: from the paddle and from the column to its landing (m), its
    horizontal velocity (m/s), its apex over the height (m), the time until it lands, and until the
    mean of all landings after that (s)."""


class Config(task.WorldConfig):
    """The world with two or three balls, their columns, the ends and the reward."""

    num_balls: task.NumBalls = 2
    """Number of balls, 2 or 3."""
    home: tuple[Finite, Finite, Finite] = (0.59356, 0.0, 0.0498)
    """Home of the paddle, m; the columns are beside each other over it."""
    spacing: Positive = 0.065
    """Distance between columns, m."""
    height_range: tuple[Finite, Finite] = (0.35, 0.55)
    """Range of the target height over home, m."""
    max_distance: Positive = 0.5
    """The episode ends when a ball is this far from the top of its column, m."""
    reset: task.ResetConfig = task.ResetConfig(joint_angles=0.02)
    """The noise of a reset."""
    action: task.ActionConfig = task.ActionConfig(base="target")
    """What an action adds to."""
    observation: Observation = Observation()
    """The quantities that the policy sees."""
    reward: Rewards = Rewards()
    """The reward terms."""

    @classmethod
    def settings_at(cls, paddle: tuple[float, float, float]) -> dict[str, Any]:
        return super().settings_at(paddle) | {"home": paddle}

    @property
    def commands(self) -> dict[str, task.Command]:
        """The height of the apexes."""
        low, high = (self.home[2] + height for height in self.height_range)
        return {"target_height": task.Command(low, high, "m", self.home[2] + 0.1)}


class State(NamedTuple):
    """What the task keeps of an episode: whether each ball rises [B], and the number of the ball
    that the paddle hit last []."""

    rising: jax.Array
    last: jax.Array


class Juggle(task.Task):
    """Balls bounce in turns at the commanded height on one paddle, each in a column."""

    Config = Config
    num_balls = (2, 3)
    curves = (
        task.Curve("task/alternate", "alternating", "hits", "hits in turns, %", 100.0),
        task.Curve("task/height_error", "height_error", "apexes", "|apex − height|, cm", 100.0),
    )

    def columns(self, height: jax.Array) -> jax.Array:
        """The wished apexes [B, 3], m."""
        (x, y, _), count = self.config.home, self.config.num_balls
        places = y + self.config.spacing * (jnp.arange(count) - 0.5 * (count - 1))
        return jnp.stack([jnp.full_like(places, x), places, height + 0.0 * places], axis=1)

    def period(self, height: jax.Array) -> jax.Array:
        """Time of a flight to the height [], s."""
        return 2.0 * task.safe_sqrt(2.0 * (height - self.config.home[2] - REST) / task.GRAVITY)

    def throw(self, draws: jax.Array, command: task.Values) -> tuple[jax.Array, jax.Array]:
        """The balls are in their columns and land in turns, the first one first."""
        columns, count = self.columns(command["target_height"]), self.config.num_balls
        period, turns = self.period(command["target_height"]), jnp.arange(count)[::-1] / count
        rise = (0.5 - FLOWN - turns) * period
        up = jnp.array([0.0, 0.0, 1.0])
        drop = 0.5 * task.GRAVITY * jnp.square(rise)
        return columns - drop[:, None] * up, task.GRAVITY * rise[:, None] * up

    def reset(self, start: task.Start) -> State:
        rising = start.truth.ball_velocity[:, 2] > 0.0
        return State(rising, jnp.full((), self.config.num_balls - 1.0))

    def step(self, state: State, step: task.Step) -> task.TaskStep:
        truth, height, home = step.truth, step.command["target_height"], jnp.array(self.config.home)
        balls, velocities, count = truth.ball_position, truth.ball_velocity, self.config.num_balls
        flights, columns = task.flight(balls, velocities, home[2] + REST), self.columns(height)
        period = self.period(height)
        waits = jnp.roll(flights.fall, -1) - flights.fall - period / count
        waits = jnp.mod(waits + 0.5 * period, period) - 0.5 * period
        action_change = step.action - step.last_action
        errors = {
            "apex": (flights.top - columns) * jnp.array([1.0, 1.0, 0.3]),
            "landing": (flights.end - columns)[:, :2],
            "turn": waits[:, None],
            "home": (truth.paddle_position - home)[None],
            "calm": jnp.concatenate([truth.joint_velocities, action_change])[None],
        }
        rising = velocities[:, 2] > 0.0
        hits, turns = rising & ~state.rising, jnp.arange(count)
        alternating = hits & (turns == jnp.mod(state.last + 1.0, count))
        tops = state.rising & ~rising & (balls[:, 2] > home[2] + MAX_HEIGHT_ERROR)
        far = jnp.sum(jnp.square(balls - columns), axis=1) > self.config.max_distance**2
        touched = self._closest(balls, velocities) < 2.0 * self.config.robot.ball.radius
        last = jnp.where(jnp.any(hits), jnp.max(turns * hits), state.last)
        return task.TaskStep(
            state=State(rising, last),
            reward={
                name: term.weight * jnp.mean(jax.vmap(term.value)(errors[name]))
                for name, term in self.config.reward
            },
            ended=jnp.any(far | (balls[:, 2] < home[2])) | touched,
            metrics={
                "hits": jnp.sum(hits),
                "alternating": jnp.sum(alternating),
                "apexes": jnp.sum(tops),
                "high": jnp.sum(tops & (jnp.abs(balls[:, 2] - height) <= MAX_HEIGHT_ERROR)),
                "height_error": jnp.sum(jnp.where(tops, jnp.abs(balls[:, 2] - height), 0.0)),
                "touched": touched,
            },
        )

    def _closest(self, balls: jax.Array, velocities: jax.Array) -> jax.Array:
        """Smallest distance between two balls during the step [], m, which may be within it: they
        pass each other at 3 m/s. In free flight, a ball seen from another one moves straight on."""
        distances = []
        for i, j in itertools.combinations(range(self.config.num_balls), 2):
            way, speed = balls[i] - balls[j], velocities[i] - velocities[j]
            since = jnp.sum(way * speed) / jnp.maximum(jnp.sum(speed * speed), 1e-6)
            since = jnp.clip(since, 0.0, self.config.control_dt)
            distances.append(task.length(way - since * speed))
        return jnp.min(jnp.stack(distances))

    def first_quantities(self, measured: task.Values) -> tuple[Any, task.Values]:
        return (), {"next_ball": self._next_ball(measured)}

    def next_quantities(
        self, memory: Any, seen: task.Values, measured: task.Values
    ) -> tuple[Any, task.Values]:
        newest = self._next_ball(measured)
        return memory, {n: task.latest(h, True, True, newest) for n, h in seen.items()}

    def _next_ball(self, measured: task.Values) -> jax.Array:
        height, velocities = measured["target_height"][0], measured["ball_velocity"]
        ground = self.config.home[2] + REST
        flights = task.flight(measured["ball_position"], velocities, ground)
        parts = (
            (flights.end - measured["paddle_position"])[:, :2],
            (flights.end - self.columns(height))[:, :2],
            velocities[:, :2],
            (flights.top[:, 2] - height)[:, None],
            flights.fall[:, None],
            (jnp.mean(flights.fall) - flights.fall)[:, None],
        )
        first, *others = jnp.concatenate(parts, axis=1)
        for other in others:
            first = jnp.where(other[7] < first[7], other, first)
        return first

    def tally(self, moment: task.Moment) -> task.Tally:
        metrics, settled = moment.metrics, moment.command_seconds > SETTLING
        sums = {name: metrics[name] for name in ("hits", "alternating")}
        sums |= {name: settled * metrics[name] for name in ("apexes", "high")}
        return task.Tally(sums, {"touched": metrics["touched"]})

    def results(self, episodes: task.Episodes) -> tuple[task.Result, ...]:
        sums, length = episodes.sums, f"{self.config.episode_seconds:g} s"
        apart, lasted = episodes.maxima["touched"] == 0.0, episodes.lasted
        hits, alternating = sums["hits"], sums["alternating"]
        words = "apexes within 0.1 m of the height"
        return (
            task.share_of_episodes("kept", f"episodes that keep all balls {length}", lasted, 0.99),
            task.share_of_events("turns", "hits in turns", alternating, hits, 0.99),
            task.share_of_episodes("apart", "episodes without touching balls", apart, 0.99),
            task.share_of_events("height", words, sums["high"], sums["apexes"], 0.95),
        )
