"""Tracking: the ball bounces over a point that moves along a path (`paths`), at its height."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, NamedTuple

from pydantic import Field

from bounce_mjx import task
from bounce_mjx.config.settings import Coordinate, Finite, Length, Positive, Range
from bounce_mjx.lazy import jax, jnp
from bounce_mjx.task import flights, paths

STEP_SETTLING_SECONDS = 1.0
"""Time since a step of the point after which apexes count for the result after steps, s."""


class Band(NamedTuple):
    """Speeds of a point without steps that a result judges."""

    slowest: float
    """m/s."""
    fastest: float
    """m/s."""
    max_error: float
    """Largest RMS error, cm."""


BANDS = {"slow error": Band(0.0, 0.1, 1.5), "fast error": Band(0.25, 0.3, 3.0)}
"""The judged speeds, by the result's name."""
MAX_STEP_ERROR = 0.03
"""Largest distance of apex and point after a step, m."""
MIN_EPISODE_SHARE = 0.99
"""Least share of episodes that last."""
MIN_APEX_SHARE = 0.95
"""Least share of apexes within 0.1 m of their height, and of those near the point after a step."""
MAX_POINT_SPEED = 1.0
"""Greatest speed of a point on a path, m/s."""
JUMP_SPEED = 1.1
"""A point that seems faster has jumped, m/s."""
JUMP_ACCELERATION = 3.0
"""A point that seems to accelerate more has jumped, or changed its path or its speed, m/s^2; tight
and fast paths have a higher limit."""
Height = Annotated[Finite, Field(ge=flights.MIN_TARGET_HEIGHT, le=10.0)]
"""Over home, m; the point sways around it, and stays above a resting ball."""
PointSpeed = Annotated[Finite, Field(ge=0.0, le=MAX_POINT_SPEED)]


class Rewards(task.StrictModel):
    """The reward terms. Rewarded for apexes alone, the ball would swing across the point: a hit
    that brings the apex back to the point sends the next landing as far beyond it."""

    apex: task.Near = task.Near(weight=6.0)
    """The flight's apex is the point at that time; 0.1 m of height count as 0.03 m."""
    landing: task.Near = task.Near(weight=2.0)
    """The flight ends over the point at that time."""
    paddle: task.Near = task.Near()
    """The paddle is where the flight ends."""
    home: task.Near = task.Near(scale=0.05)
    """The paddle is at its home height."""
    calm: task.Near = task.Near(weight=0.1, scale=10.0)
    """The joints and the actions change slowly."""


class Observation(task.ObservationConfig):
    """The world's quantities, the point, and where to aim."""

    target_x: Annotated[task.History, task.Quantity(1, "m", "goal")] = 1
    target_y: Annotated[task.History, task.Quantity(1, "m", "goal")] = 1
    target_height: Annotated[task.History, task.Quantity(1, "m", "goal")] = 1
    aim: Annotated[task.History, task.Quantity(2, "m")] = 1
    """From the flight's end to the point at the next apex, if the point keeps its acceleration."""


class Config(task.WorldConfig):
    """The world, the point, the ends and the reward."""

    # Not `task.PADDLE_HOME`: the shipped policy was trained here. Move it with the next one.
    home: tuple[Coordinate, Coordinate, Coordinate] = (0.58856, 0.0, 0.05)
    """Home of the paddle, m."""
    height_range: Range[Height] = (0.4, 0.5)
    """Range of the target height over home, around which it sways, m."""
    speed_range: Range[PointSpeed] = (0.05, 0.3)
    """Range of the point's greatest speed, m/s."""
    path_size: Annotated[Positive, Field(le=1.0)] = 0.12
    """Radius of the circle, half the length of the line and of the figure of eight, m."""
    max_distance: Length = 0.7
    """The episode ends when the ball is this far from the point, or lower than home, m."""
    action: task.ActionConfig = task.ActionConfig(base="target")
    observation: Observation = Observation(ball_quaternion=0, ball_angular_velocity=0)
    """The quantities that the policy sees."""
    reward: Rewards = Rewards()
    """The reward terms."""

    @classmethod
    def settings_at(cls, paddle: tuple[float, float, float]) -> dict[str, Any]:
        return super().settings_at(paddle) | {"home": paddle}

    @property
    def heights(self) -> dict[str, float]:
        return super().heights | {"height_range": self.home[2] + self.height_range[0]}

    @property
    def limits(self) -> task.Limits:
        return (
            task.Limit("home", "lowest", self.home[2]),
            task.Limit("max_distance", "distance", self.max_distance),
        )

    @property
    def targets(self) -> tuple[tuple[float, float, float], ...]:
        x, y, z = self.home
        lowest, highest = self.height_range
        return (x, y, z + lowest), (x, y, z + highest)

    @property
    def goals(self) -> dict[str, task.Goal]:
        """The point, its speed and its path. The ranges of the point are those of the middle of the
        path, which is sampled; the point itself leaves them (`first_goal`)."""
        x, y, z = self.home
        lowest, highest = self.height_range
        slowest, fastest = self.speed_range
        heights = task.target_heights(
            self.limits, min_flight=flights.MIN_TARGET_HEIGHT, sway=paths.SWAY
        )
        goals = {
            "target_x": task.Goal(x - 0.02, x + 0.02, "m", span=(x - 0.15, x + 0.15), step=0.01),
            "target_y": task.Goal(y - 0.02, y + 0.02, "m", span=(y - 0.15, y + 0.15), step=0.01),
            "target_height": task.Goal(
                z + lowest,
                z + highest,
                "m",
                least=heights.least,
                greatest=heights.greatest,
                span=heights.within(z + 0.3, z + 0.7),
                setting="height_range",
                reason=heights.reason,
            ),
            "point_speed": task.Goal(
                slowest, fastest, "m/s", least=0.0, span=(0.0, 0.3), hidden=True
            ),
        }
        return goals | paths.GOALS


class Track(task.Task):
    """The ball bounces over a point that moves along a path, at its height."""

    Config = Config
    config: Config
    ball_rests = False
    ball_thrown = False
    curves = (
        task.Curve("task/error", "error", "apexes", "distance of apex and point", 100.0, "cm"),
        task.Curve("task/height_error", "height_error", "apexes", "|apex − height|", 100.0, "cm"),
    )

    @property
    def ground(self) -> float:
        """Height of a ball that touches the paddle at home, m."""
        return flights.ground(self.config.home, self.geometry)

    # The point.

    def first_goal(self, goal: task.Values) -> task.Values:
        """The point on its path, whose middle is sampled."""
        offset = paths.offset(goal, self.config.path_size, goal["phase"])
        return paths.at_point(goal, paths.point(goal) + offset)

    def next_goal(self, state: Any, goal: task.Values) -> task.Values:
        """The path moves the point on from where it is, which a user may have set."""
        size = self.config.path_size
        next_phase = paths.phase_in(self.config.control_dt, goal, size)
        offset = paths.offset(goal, size, goal["phase"])
        next_offset = paths.offset(goal, size, next_phase)
        point = paths.point(goal) + next_offset - offset
        return paths.at_point(goal, point) | {
            "path": jnp.floor(goal["path"]),
            "phase": next_phase - jnp.floor(next_phase),
        }

    def _point_in(self, seconds: jax.Array, goal: task.Values) -> jax.Array:
        """The point [3] in some seconds [], m, if the path moves it on."""
        size = self.config.path_size
        offset = paths.offset(goal, size, goal["phase"])
        later = paths.phase_in(seconds, goal, size)
        return paths.point(goal) + paths.offset(goal, size, later) - offset

    # The start, and a control step: reward, end, metrics.

    def reset(self, start: task.Start) -> jax.Array:
        """Whether the ball rises [], bool: it starts at rest."""
        return jnp.array(False)

    def step(self, rose: jax.Array, step: task.Step) -> task.TaskStep:
        truth = step.truth
        ball = truth.ball_position
        rises = truth.ball_velocity[2] > 0.0
        flight = task.flight(ball, truth.ball_velocity, self.ground)
        is_apex = flights.is_apex(rose, rises, ball[2], self.config.home)
        point = paths.point(step.goal)
        x_square, y_square, z_square = jnp.square(ball - point)
        return task.TaskStep(
            state=rises,
            reward=task.weighted_terms(
                self.config.reward,
                # Of an apex before a redraw, it is the point of the new path at that time.
                apex=flights.apex_error(flight, self._point_in(flight.rise, step.goal)),
                landing=flights.landing_error(flight, self._point_in(flight.fall, step.goal)),
                paddle=(flight.end - truth.paddle_position)[:2],
                home=truth.paddle_position[2] - self.config.home[2],
                calm=task.changes(truth.joint_velocities, step.action, step.last_action),
            ),
            ended=task.is_beyond(self.config.limits, ball, point),
            metrics={
                "apexes": is_apex,
                "error": jnp.where(is_apex, task.safe_sqrt(x_square + y_square), 0.0),
                "height_error": jnp.where(is_apex, task.safe_sqrt(z_square), 0.0),
            },
        )

    # The observation: where to aim, from the measurements.

    def first_quantities(self, measured: task.Values) -> tuple[Any, task.Values]:
        """The point has jumped to where it is, so that its velocity is not known yet."""
        point = paths.point(measured)[:2, 0]
        velocity = jnp.zeros_like(measured["ball_position"][:2])
        # Any factor over 1 is a jump.
        before_jump = point - 10.0 * JUMP_SPEED * self.config.control_dt
        unknown_aim = jnp.zeros_like(velocity)[None]
        memory, histories = self.next_quantities(
            (before_jump, velocity), {"aim": unknown_aim}, measured
        )
        return memory, {"aim": histories["aim"][0]}

    def next_quantities(
        self, memory: Any, histories: task.Values, measured: task.Values
    ) -> tuple[Any, task.Values]:
        """It remembers the point [2] (m) and its velocity [2] (m/s). The velocity of a jump is
        remembered as it is, so that the change after it is too large for an acceleration, and is
        dropped.

        A velocity is unknown in the step of a jump, an acceleration in the next one too; either
        counts as 0 then.
        """
        last_point, last_velocity = memory
        dt = self.config.control_dt
        point = paths.point(measured)[:, 0]
        velocity = (point[:2] - last_point) / dt
        acceleration = (velocity - last_velocity) / dt
        known_velocity = _unless_longer(velocity, JUMP_SPEED)
        known_acceleration = _unless_longer(acceleration, self._jump_acceleration())

        flight = task.flight(measured["ball_position"], measured["ball_velocity"], self.ground)
        next_rise = task.safe_sqrt(2.0 * (point[2] - self.ground) / task.GRAVITY)
        seconds = flight.fall + next_rise
        moved = seconds * known_velocity
        point_then = point[:2] + moved + 0.5 * jnp.square(seconds) * known_acceleration
        aim = point_then - flight.end[:2]
        next_memory = (point[:2], velocity)
        return next_memory, {name: task.latest(old, aim) for name, old in histories.items()}

    def _jump_acceleration(self) -> float:
        """Acceleration over which the point has jumped, m/s^2; on its paths it has less."""
        _, fastest = self.config.speed_range
        greatest = paths.SHARPEST * fastest**2 / self.config.path_size
        return max(JUMP_ACCELERATION, 1.1 * greatest)

    # The results.

    def tally(self, moment: task.Moment) -> task.Tally:
        goal = moment.goal
        error = moment.metrics["error"]
        has_steps = goal["path"] == paths.STEPS
        has_settled = moment.goal_seconds > flights.SETTLING_SECONDS
        has_reached = paths.seconds_at_corner(goal) > STEP_SETTLING_SECONDS

        apex = (moment.metrics["apexes"] > 0) & has_settled
        after_step = apex & has_steps & has_reached
        sums = {
            "apexes": apex,
            "accurate": apex & (moment.metrics["height_error"] <= flights.MAX_HEIGHT_ERROR),
            "late": after_step,
            "near": after_step & (error <= MAX_STEP_ERROR),
        }
        # Whether the episode has what a result judges.
        is_judged = {"after steps": has_steps}
        for name, band in BANDS.items():
            is_in_band = _is_in_band(goal["point_speed"], band) & ~has_steps
            is_judged[name] = is_in_band
            sums[name] = apex & is_in_band
            sums[f"{name}^2"] = sums[name] * jnp.square(100.0 * error)
        return task.Tally(sums, maxima=is_judged)

    def results(self, episodes: task.Episodes) -> tuple[task.Result, ...]:
        sums = episodes.sums
        of_point = [
            task.share_of_events(
                "after steps",
                "apexes within 3 cm, 1 s after a step",
                sums["near"],
                sums["late"],
                MIN_APEX_SHARE,
            )
        ]
        for name, band in BANDS.items():
            speeds = f"{band.slowest:g} to {band.fastest} m/s"
            measured = f"RMS distance of apex and point at {speeds}, cm"
            of_point.append(
                task.root_mean_square(name, measured, sums[f"{name}^2"], sums[name], band.max_error)
            )
        # Episodes of other paths or speeds do not judge.
        for i, result in enumerate(of_point):
            if not episodes.maxima[result.name].any():
                of_point[i] = replace(result, passed=None, margin=None)

        lasting = f"episodes that last {self.config.episode_seconds:g} s"
        return (
            *of_point,
            task.share_of_events(
                "height",
                "apexes within 0.1 m of their height",
                sums["accurate"],
                sums["apexes"],
                MIN_APEX_SHARE,
            ),
            task.share_of_episodes("stable", lasting, episodes.lasted, MIN_EPISODE_SHARE),
        )

    # What is shown.

    def markers(self, goal: Any, metrics: Any) -> tuple[task.Marker, ...]:
        return paths.markers(goal, self.config.path_size)

    def readings(self, goal: dict[str, float], metrics: dict[str, float]) -> dict[str, str]:
        return {"path": f"{paths.name(goal)}, {goal['point_speed']:.2f} m/s"}


def _unless_longer(vector: jax.Array, limit: float) -> jax.Array:
    """A vector [2], or 0 where it is longer than a limit."""
    return jnp.where(jnp.sum(jnp.square(vector)) <= limit**2, vector, 0.0)


def _is_in_band(speed: jax.Array, band: Band) -> jax.Array:
    """Whether a speed [] (m/s) is in a band [], bool; its ends are, despite float32."""
    return (speed > band.slowest - 1e-6) & (speed < band.fastest + 1e-6)
