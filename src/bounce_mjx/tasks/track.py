"""Tracking: the ball bounces over a point that moves along a path (`paths`), at its height."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any

from pydantic import Field

from bounce_mjx import task
from bounce_mjx.config.settings import Ascending, Coordinate, Finite, Length, Positive
from bounce_mjx.lazy import jax, jnp
from bounce_mjx.tasks import paths

SETTLING, STEP_SETTLING = 2.0, 1.0
"""Time since a reset, and since a step of the point, after which apexes count, s."""
BANDS = {"slow error": (0.0, 0.1, 1.5), "fast error": (0.25, 0.3, 3.0)}
"""Speeds of a point without steps that a result judges (m/s), and the largest RMS error (cm)."""
MAX_STEP_ERROR, MAX_HEIGHT_ERROR = 0.03, 0.1
JUMP_SPEED, JUMP_ACCELERATION = 1.0, 3.0
"""A point that is faster (m/s) or accelerates more (m/s^2) has jumped."""
Height = Annotated[Finite, Field(ge=0.1, le=10.0)]
"""Over home, m; the point sways around it, and stays above a resting ball."""
PointSpeed = Annotated[Finite, Field(ge=0.0, le=JUMP_SPEED)]


class Rewards(task.StrictModel):
    """The reward terms. For its apexes alone the ball would swing across the point: what brings one
    apex back to the point aims the next landing as far beyond it."""

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

    target_x: Annotated[task.History, task.Quantity(1, "m", "command")] = 1
    target_y: Annotated[task.History, task.Quantity(1, "m", "command")] = 1
    target_height: Annotated[task.History, task.Quantity(1, "m", "command")] = 1
    aim: Annotated[task.History, task.Quantity(2, "m")] = 1
    """From the flight's end to the point at the next apex, if the point keeps its acceleration."""


class Config(task.WorldConfig):
    """The world, the point, the ends and the reward."""

    # Not `task.PADDLE_HOME`: the shipped policy was trained here. The next one moves it.
    home: tuple[Coordinate, Coordinate, Coordinate] = (0.58856, 0.0, 0.05)
    """Home of the paddle, m."""
    height_range: Annotated[tuple[Height, Height], Ascending] = (0.4, 0.5)
    """Range of the target height over home, around which it sways, m."""
    speed_range: Annotated[tuple[PointSpeed, PointSpeed], Ascending] = (0.05, 0.3)
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
    def commands(self) -> dict[str, task.Command]:
        """The point, sampled as the middle of its path, its speed, and its path."""
        (x, y, z), (low, high) = self.home, self.height_range
        return {
            "target_x": task.Command(x - 0.02, x + 0.02, "m", span=(x - 0.15, x + 0.15), step=0.01),
            "target_y": task.Command(y - 0.02, y + 0.02, "m", span=(y - 0.15, y + 0.15), step=0.01),
            "target_height": task.Command(z + low, z + high, "m", span=(z + 0.3, z + 0.7)),
            "point_speed": task.Command(
                *self.speed_range, "m/s", 0.0, span=(0.0, 0.3), hidden=True
            ),
        } | paths.COMMANDS


class Track(task.Task):
    """The ball bounces over a point that moves along a path, at its height."""

    Config = Config
    curves = (
        task.Curve("task/error", "error", "apexes", "distance of apex and point, cm", 100.0),
        task.Curve("task/height_error", "height_error", "apexes", "|apex − height|, cm", 100.0),
    )

    def _ground(self) -> float:
        """Height of a ball that touches the paddle at home, m."""
        return self.config.home[2] + self.geometry.rest_height

    def reset(self, start: task.Start) -> jax.Array:
        """Whether the ball rises [], bool."""
        return jnp.array(False)

    def first_command(self, command: task.Values) -> task.Values:
        """The point on its path, whose middle is sampled."""
        offset = paths.offset(command, self.config.path_size, command["phase"])
        return paths.at_point(command, paths.point(command) + offset)

    def next_command(self, state: Any, command: task.Values) -> task.Values:
        """The path moves the point on from where it is, which a user may have set."""
        size = self.config.path_size
        phase = paths.phase_in(self.config.control_dt, command, size)
        before = paths.offset(command, size, command["phase"])
        after = paths.offset(command, size, phase)
        command = paths.at_point(command, paths.point(command) + after - before)
        return command | {"path": jnp.floor(command["path"]), "phase": phase - jnp.floor(phase)}

    def step(self, rose: jax.Array, step: task.Step) -> task.TaskStep:
        truth, command, home = step.truth, step.command, self.config.home[2]
        ball, velocity, paddle = truth.ball_position, truth.ball_velocity, truth.paddle_position
        flight, size = task.flight(ball, velocity, self._ground()), self.config.path_size
        offset = paths.offset(command, size, command["phase"])

        def point(seconds: jax.Array) -> jax.Array:
            phase = paths.phase_in(seconds, command, size)
            return paths.point(command) + paths.offset(command, size, phase) - offset

        errors = {
            "apex": (flight.top - point(flight.rise)) * jnp.array([1.0, 1.0, 0.3]),
            "landing": (flight.end - point(flight.fall))[:2],
            "paddle": (flight.end - paddle)[:2],
            "home": paddle[2] - home,
            "calm": jnp.concatenate([truth.joint_velocities, step.action - step.last_action]),
        }
        is_apex = rose & (velocity[2] <= 0.0) & (ball[2] > home + MAX_HEIGHT_ERROR)
        x, y, z = jnp.square(ball - paths.point(command))
        return task.TaskStep(
            state=velocity[2] > 0.0,
            reward=task.weighted_terms(self.config.reward, **errors),
            ended=(ball[2] < home) | (x + y + z > self.config.max_distance**2),
            metrics={
                "apexes": is_apex,
                "error": jnp.where(is_apex, task.safe_sqrt(x + y), 0.0),
                "height_error": jnp.where(is_apex, task.safe_sqrt(z), 0.0),
            },
        )

    def first_quantities(self, measured: dict[str, jax.Array]) -> Any:
        memory = paths.point(measured)[:2, 0], jnp.zeros_like(measured["ball_position"][:2])
        memory, histories = self.next_quantities(memory, {"aim": memory[1][None]}, measured)
        return memory, {"aim": histories["aim"][0]}

    def next_quantities(self, memory: Any, histories: Any, measured: dict[str, jax.Array]) -> Any:
        """It remembers the point [2] and its velocity [2]."""

        def rate(change: jax.Array, limit: float) -> jax.Array:
            change = change / self.config.control_dt
            return jnp.where(jnp.abs(change) <= limit, change, 0.0)

        ground, target = self._ground(), paths.point(measured)[:, 0]
        flight = task.flight(measured["ball_position"], measured["ball_velocity"], ground)
        time = flight.fall + task.safe_sqrt(2.0 * (target[2] - ground) / task.GRAVITY)
        velocity = rate(target[:2] - memory[0], JUMP_SPEED)
        acceleration = rate(velocity - memory[1], JUMP_ACCELERATION)
        then = target[:2] + time * velocity + 0.5 * jnp.square(time) * acceleration
        aim = then - flight.end[:2]
        return (target[:2], velocity), {n: task.latest(h, aim) for n, h in histories.items()}

    def tally(self, moment: task.Moment) -> task.Tally:
        error, command = moment.metrics["error"], moment.command
        apex = (moment.metrics["apexes"] > 0) & (moment.command_seconds > SETTLING)
        steps, speed = command["path"] == paths.STEPS, command["point_speed"]
        late = apex & steps & (paths.seconds_at_corner(command) > STEP_SETTLING)
        high = apex & (moment.metrics["height_error"] <= MAX_HEIGHT_ERROR)
        sums = {
            "apexes": apex,
            "high": high,
            "late": late,
            "near": late & (error <= MAX_STEP_ERROR),
        }
        kinds = {"after steps": steps}
        for name, (low, top, _) in BANDS.items():
            kinds[name] = ~steps & (speed > low - 1e-6) & (speed < top + 1e-6)
            sums[name] = apex & kinds[name]
            sums[f"{name}^2"] = sums[name] * jnp.square(100.0 * error)
        return task.Tally(sums, maxima=kinds)

    def results(self, episodes: task.Episodes) -> tuple[task.Result, ...]:
        sums, had, words = episodes.sums, episodes.maxima, "apexes within 3 cm, 1 s after a step"
        found = [task.share_of_events("after steps", words, sums["near"], sums["late"], 0.95)]
        for name, (low, top, most) in BANDS.items():
            words = f"RMS distance of apex and point at {low:g} to {top} m/s, cm"
            found += [task.root_mean_square(name, words, sums[f"{name}^2"], sums[name], most)]
        words, length = "apexes within 0.1 m of their height", f"{self.config.episode_seconds:g} s"
        return (
            # Episodes of other paths or speeds do not judge.
            *(r if had[r.name].any() else replace(r, passed=None, margin=None) for r in found),
            task.share_of_events("height", words, sums["high"], sums["apexes"], 0.95),
            task.share_of_episodes("stable", f"episodes that last {length}", episodes.lasted, 0.99),
        )

    def markers(self, command: Any, metrics: Any) -> tuple[task.Marker, ...]:
        return paths.markers(command, self.config.path_size)

    def readings(self, command: dict[str, float], metrics: dict[str, float]) -> dict[str, str]:
        return {"path": f"{paths.name(command)}, {command['point_speed']:.2f} m/s"}
