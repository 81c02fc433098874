"""Juggling: balls bounce alternately at the commanded height on one paddle, each in a column."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from bounce_mjx import task
from bounce_mjx.config.settings import Ascending, Coordinate, Finite, Length, Positive
from bounce_mjx.lazy import jax, jnp

FLOWN = 0.125
"""Share of its flight that the last ball has flown at a reset."""
SETTLING, MAX_HEIGHT_ERROR = 2.0, 0.1
"""Time since the height was commanded after which apexes count, s; and how near they are, m."""
LEAST_HEIGHT = 0.1
"""Least height of the apexes over home, m: a lower flight has no time."""
Height = Annotated[Finite, Field(ge=LEAST_HEIGHT, le=10.0)]


class Rewards(task.StrictModel):
    """The reward terms: means over the balls, whose flights are rated at each of their steps."""

    apex: task.Near = task.Near(weight=6.0)
    """The flight's apex is in the column at the height, of which 0.1 m count as 0.03 m."""
    landing: task.Near = task.Near(weight=2.0)
    """The flight ends in the column."""
    turn: task.Near = task.Near(weight=4.0)
    """The next ball lands one turn later, s."""
    home: task.Near = task.Near(scale=0.05)
    """The paddle is at home."""
    calm: task.Near = task.Near(weight=0.1, scale=10.0)
    """The joints and the actions change slowly."""


class Observation(task.ObservationConfig):
    """The world's quantities, the height, and the next ball."""

    target_height: Annotated[task.History, task.Quantity(1, "m", "command")] = 1
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
    height_range: Annotated[tuple[Height, Height], Ascending] = (0.35, 0.55)
    """Range of the target height over home, m."""
    max_distance: Length = 0.7
    """The episode ends when a ball is this far from the top of its column, m; or when two touch."""
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
        return {"height_range": self.home[2] + self.height_range[0]}

    @property
    def commands(self) -> dict[str, task.Command]:
        """The height of the apexes."""
        low, high = (self.home[2] + height for height in self.height_range)
        return {"target_height": task.Command(low, high, "m", least=self.home[2] + LEAST_HEIGHT)}

    def columns(self, height: Any) -> list[tuple[Any, Any, Any]]:
        """The commanded apex of each ball, m."""
        (x, y, _), middle = self.home, 0.5 * (self.num_balls - 1)
        return [(x, y + self.spacing * (i - middle), height) for i in range(self.num_balls)]


class Juggle(task.Task):
    """Balls bounce alternately at the commanded height on one paddle, each in a column."""

    Config = Config
    num_balls = (2, 3)
    curves = (
        task.Curve("task/turns", "in_turn", "hits", "alternating hits, %", 100.0),
        task.Curve("task/height_error", "height_error", "apexes", "|apex − height|, cm", 100.0),
    )

    def _columns(self, height: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The commanded apexes [B, 3] (m) and the time of a whole flight to them [] (s)."""
        fall = task.safe_sqrt(2.0 * (height - self._ground()) / task.GRAVITY)
        columns = [jnp.stack([*map(jnp.asarray, top)]) for top in self.config.columns(height)]
        return jnp.stack(columns), 2.0 * fall

    def _ground(self) -> float:
        """Height of a ball that touches the paddle at home, m."""
        return self.config.home[2] + self.geometry.rest_height

    def throw(self, draws: jax.Array, command: task.Values) -> tuple[jax.Array, jax.Array]:
        """The balls are in their columns and land alternately, the first one first."""
        columns, period = self._columns(command["target_height"])
        turns = jnp.arange(self.config.num_balls)[::-1, None] / self.config.num_balls
        rise = (0.5 - FLOWN - turns) * period * jnp.array([0.0, 0.0, 1.0])
        return columns - 0.5 * task.GRAVITY * jnp.square(rise), task.GRAVITY * rise

    def reset(self, start: task.Start) -> Any:
        # Whether each ball rises, and the number of the ball that was hit last.
        return start.truth.ball_velocity[:, 2] > 0.0, jnp.full((), self.config.num_balls - 1.0)

    def step(self, state: Any, step: task.Step) -> task.TaskStep:
        (rose, last), reward = state, self.config.reward
        terms = {name: getattr(reward, name) for name in task.term_names(type(reward))}
        truth, height, count = step.truth, step.command["target_height"], self.config.num_balls
        balls, velocities, home = truth.ball_position, truth.ball_velocity, self.config.home
        flights = task.flight(balls, velocities, self._ground())
        columns, period = self._columns(height)
        early = jnp.roll(flights.fall, -1) - flights.fall - period / count
        errors = {
            "apex": (flights.top - columns) * jnp.array([1.0, 1.0, 0.3]),
            "landing": (flights.end - columns)[:, :2],
            "turn": (jnp.mod(early + 0.5 * period, period) - 0.5 * period)[:, None],
            "home": (truth.paddle_position - jnp.array(home))[None],
            "calm": jnp.concatenate([truth.joint_velocities, step.action - step.last_action])[None],
        }
        rising, numbers = velocities[:, 2] > 0.0, jnp.arange(count)
        hits, apexes = rising & ~rose, rose & ~rising & (balls[:, 2] > home[2] + MAX_HEIGHT_ERROR)
        height_errors = jnp.abs(balls[:, 2] - height)
        far = jnp.sum(jnp.square(balls - columns), axis=1) > self.config.max_distance**2
        closest = task.closest(balls, velocities, self.config.control_dt)
        radius = self.geometry.ball_radius if step.ball_radius is None else step.ball_radius
        touched = closest < 2.0 * radius
        landing = _next(flights.end, flights.fall)
        return task.TaskStep(
            state=(rising, jnp.where(jnp.any(hits), jnp.max(numbers * hits), last)),
            reward={n: t.weight * jnp.mean(jax.vmap(t.value)(errors[n])) for n, t in terms.items()},
            ended=jnp.any(far | (balls[:, 2] < home[2])) | touched,
            metrics={
                "hits": jnp.sum(hits),
                "in_turn": jnp.sum(hits & (numbers == jnp.mod(last + 1.0, count))),
                "apexes": jnp.sum(apexes),
                "high": jnp.sum(apexes & (height_errors <= MAX_HEIGHT_ERROR)),
                "height_error": jnp.sum(apexes * height_errors),
                "touched": touched,
                "landing_x": landing[0],
                "landing_y": landing[1],
            },
        )

    def first_quantities(self, measured: task.Values) -> tuple[Any, task.Values]:
        height, velocities = measured["target_height"][0], measured["ball_velocity"]
        ground, (columns, _) = self._ground(), self._columns(height)
        top, end, _, fall = task.flight(measured["ball_position"], velocities, ground)
        parts = (
            (end - measured["paddle_position"])[:, :2],
            (end - columns)[:, :2],
            velocities[:, :2],
            jnp.stack([top[:, 2] - height, fall, jnp.mean(fall) - fall], axis=1),
        )
        return (), {"next_ball": _next(jnp.concatenate(parts, axis=1), fall)}

    def next_quantities(
        self, memory: Any, histories: Any, measured: Any
    ) -> tuple[Any, task.Values]:
        newest = self.first_quantities(measured)[1]
        return (), {name: task.latest(h, newest[name]) for name, h in histories.items()}

    def tally(self, moment: task.Moment) -> task.Tally:
        metrics, settled = moment.metrics, moment.command_seconds > SETTLING
        counts = {"hits": 1.0, "in_turn": 1.0, "apexes": settled, "high": settled}
        sums = {name: counted * metrics[name] for name, counted in counts.items()}
        return task.Tally(sums, {"touched": metrics["touched"]})

    def results(self, episodes: task.Episodes) -> tuple[task.Result, ...]:
        sums, apart = episodes.sums, episodes.maxima["touched"] == 0.0
        return (
            task.share_of_episodes("kept", "episodes that keep all balls", episodes.lasted, 0.99),
            task.share_of_events("turns", "alternating hits", sums["in_turn"], sums["hits"], 0.99),
            task.share_of_episodes("apart", "episodes without touching balls", apart, 0.99),
            task.share_of_events(
                "height", "apexes within 0.1 m", sums["high"], sums["apexes"], 0.95
            ),
        )

    def markers(self, command: Any, metrics: Any) -> tuple[task.Marker, ...]:
        """A disc on top of each column, and a frame where the next ball lands."""
        look = ((0.02, 0.001, 0.0), (0.15, 0.9, 0.3, 0.6), "cylinder")
        tops = enumerate(self.config.columns(command["target_height"]), start=1)
        place = (metrics["landing_x"], metrics["landing_y"], self._ground())
        return (
            *(task.Marker(f"target height {i}", top, *look) for i, top in tops),
            task.Marker("next ball", place, (0.021, 0.021, 0.001), (1.0, 0.8, 0.1, 0.9), "frame"),
        )

    def readings(self, command: dict[str, float], metrics: dict[str, float]) -> dict[str, str]:
        return {"target": f"{command['target_height']:.2f} m"}


def _next(values: jax.Array, falls: jax.Array) -> jax.Array:
    """The row of values [B, n] of the ball that lands next."""
    chosen, soonest = values[0], jnp.min(falls)
    for value, fall in zip(values[1:], falls[1:], strict=True):
        chosen = jnp.where(fall <= soonest, value, chosen)
    return chosen
