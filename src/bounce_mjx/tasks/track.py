"""Tracking: the ball bounces over a point that moves, at a height that moves."""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated, NamedTuple

from bounce_mjx import task
from bounce_mjx.config.settings import Finite, NonNegative, Positive
from bounce_mjx.lazy import jax, jnp, np

PATHS = ("circle", "line", "eight", "steps", "wander")
GRAVITY = 9.81
REST = 0.0225
"""Height of the ball's centre over the paddle's while they touch, m."""
STEP_SECONDS = 4.0


class Flight(NamedTuple):
    """Free flight of the ball down to the paddle's home height."""

    apex: jax.Array
    """Position at the apex of the present flight, which may have passed [3], m."""
    apex_time: jax.Array
    """Time to that apex [], s; negative once it has passed."""
    landing: jax.Array
    """Horizontal position at the landing [2], m."""
    landing_time: jax.Array
    """Time to the landing [], s."""


def fly(ball: jax.Array, velocity: jax.Array, floor: float) -> Flight:
    up = velocity[2] / GRAVITY
    height = ball[2] + 0.5 * GRAVITY * jnp.square(up)
    apex = jnp.concatenate([ball[:2] + up * velocity[:2], height[None]])
    down = up + task.safe_sqrt(2.0 * (height - floor) / GRAVITY)
    return Flight(apex, up, ball[:2] + down * velocity[:2], down)


class Inputs(NamedTuple):
    """What the reward terms depend on."""

    apex_distance: jax.Array
    apex_error: jax.Array
    landing_distance: jax.Array
    paddle_distance: jax.Array
    lift: jax.Array
    action_change: jax.Array
    joint_speed: jax.Array


def peak(error, scale):
    return 1.0 / (1.0 + jnp.square(error / scale))


class ApexReward(task.RewardTerm):
    weight: Finite = 4.0
    scale: Positive = 0.03
    height_scale: Positive = 0.1

    def value(self, inputs):
        return peak(inputs.apex_distance, self.scale) * peak(inputs.apex_error, self.height_scale)


class HeightReward(task.RewardTerm):
    weight: Finite = 2.0
    scale: Positive = 0.05

    def value(self, inputs):
        return peak(inputs.apex_error, self.scale)


class LandingReward(task.RewardTerm):
    weight: Finite = 2.0
    scale: Positive = 0.06
    height_scale: Positive = 0.1

    def value(self, inputs):
        return peak(inputs.landing_distance, self.scale) * peak(inputs.apex_error, self.height_scale)


class PaddleReward(task.RewardTerm):
    weight: Finite = 1.0
    scale: Positive = 0.03

    def value(self, inputs):
        return peak(inputs.paddle_distance, self.scale)


class HomeReward(task.RewardTerm):
    weight: Finite = 1.0
    scale: Positive = 0.05

    def value(self, inputs):
        return peak(inputs.lift, self.scale)


class ActionRateReward(task.RewardTerm):
    weight: Finite = 1e-3

    def value(self, inputs):
        return -inputs.action_change


class JointVelocityReward(task.RewardTerm):
    weight: Finite = 1e-3

    def value(self, inputs):
        return -inputs.joint_speed


class Rewards(task.StrictModel):
    apex: ApexReward = ApexReward()
    height: HeightReward = HeightReward()
    landing: LandingReward = LandingReward()
    paddle: PaddleReward = PaddleReward()
    home: HomeReward = HomeReward()
    action_rate: ActionRateReward = ActionRateReward()
    joint_velocity: JointVelocityReward = JointVelocityReward()


class Observation(task.ObservationConfig):
    ball_quaternion: task.History = 0
    ball_angular_velocity: task.History = 0
    target_x: Annotated[task.History, task.Quantity(1, "m", "command")] = 1
    target_y: Annotated[task.History, task.Quantity(1, "m", "command")] = 1
    target_height: Annotated[task.History, task.Quantity(1, "m", "command")] = 1
    aim: Annotated[task.History, task.Quantity(2, "m")] = 1
    landing: Annotated[task.History, task.Quantity(2, "m")] = 0


class Config(task.WorldConfig):
    middle: tuple[Finite, Finite] = (0.58856, 0.0)
    home_height: Finite = 0.05
    target_height_range: tuple[float, float] = (0.45, 0.55)
    target_speed_range: tuple[float, float] = (0.05, 0.3)
    size: Positive = 0.15
    height_size: NonNegative = 0.05
    min_ball_height: Finite = 0.05
    max_height_above_target: Positive = 0.5
    max_distance: Positive = 0.5
    observation: Observation = Observation()
    reward: Rewards = Rewards()

    @property
    def commands(self):
        x, y = self.middle
        return {
            "target_x": task.Command(x, x, "m", span=(x - 0.15, x + 0.15), step=0.01),
            "target_y": task.Command(y, y, "m", span=(y - 0.15, y + 0.15), step=0.01),
            "target_height": task.Command(*self.target_height_range, "m", least=1e-3, span=(0.3, 0.8)),
            "target_speed": task.Command(*self.target_speed_range, "m/s", 0.0, span=(0.0, 0.3)),
            "path": task.Command(0, len(PATHS), "", 0, len(PATHS), step=1),
            "course": task.Command(0, 1, "turns", 0, 1),
            "phase": task.Command(0, 1, "turns", 0, 1),
        }


def choose(path, *values):
    chosen = values[0]
    for i, value in enumerate(values[1:], start=1):
        chosen = jnp.where(path >= i, value, chosen)
    return chosen


def curve(path, course, phase, size, height_size):
    """Displacement [3] of the point from the middle of its path, and the greatest speed in m per turn"""
    wave = lambda n, shift=0.0: jnp.sin(2.0 * math.pi * (n * phase + shift * course))
    cosine = lambda a: jnp.cos(2.0 * math.pi * a)
    corner = jnp.floor(6.0 * phase) / 6.0
    r = size
    xs = [r * cosine(phase), r * wave(1), r * wave(1), 0.1 * cosine(corner), r / 1.5 * (wave(1, 3) + wave(2, 5) / 2.0)]
    ys = [r * wave(1), 0.0 * phase, r * wave(2) / 2.0, 0.1 * jnp.sin(2 * math.pi * corner), r / 1.5 * (wave(1, 7) + wave(3, 11) / 3.0)]
    x, y = choose(path, *xs), choose(path, *ys)
    c, s = cosine(course), jnp.sin(2 * math.pi * course)
    return jnp.stack([c * x - s * y, s * x + c * y, height_size * wave(1, 2)])


def turns_per_second(path, speed, size):
    longest = 2.0 * math.pi * size * choose(path, 1.0, 1.0, math.sqrt(2.0), 1.0, 2.0 * math.sqrt(2.0) / 1.5)
    return jnp.where((path >= 3) & (path < 4), (speed > 0) / (6.0 * STEP_SECONDS), speed / longest)


class TrackState(NamedTuple):
    rising: jax.Array
    offset: jax.Array


class Motion(NamedTuple):
    point: jax.Array
    velocity: jax.Array


class Track(task.Task):
    """The ball bounces over a point that moves, at a height that moves."""

    Config = Config
    curves = (
        task.Curve("task/apex_distance", "apex_distance", "apexes", "apex from the point, cm", 100.0),
        task.Curve("task/apex_error", "apex_error", "apexes", "|apex - height|, cm", 100.0),
    )

    @property
    def floor(self):
        return self.config.home_height + REST

    def rate(self, command):
        return turns_per_second(command["path"], command["target_speed"], self.config.size)

    def offset(self, command, seconds=0.0):
        phase = command["phase"] + self.rate(command) * seconds
        return curve(command["path"], command["course"], phase, self.config.size, self.config.height_size)

    def reset(self, start):
        zero = jnp.zeros_like(start.truth.ball_position)
        return TrackState(zero[0] > 0, zero)

    def next_command(self, state, command):
        path = jnp.floor(command["path"])
        phase = command["phase"] + self.rate(command) * self.config.control_dt
        command = command | {"path": path, "phase": phase - jnp.floor(phase)}
        names = ("target_x", "target_y", "target_height")
        moved = self.offset(command) - state.offset
        return command | {name: command[name] + moved[i] for i, name in enumerate(names)}

    def step(self, state, step):
        config, truth, command = self.config, step.truth, step.command
        ball = truth.ball_position
        point = jnp.stack([command[n] for n in ("target_x", "target_y", "target_height")])
        offset = self.offset(command)
        flight = fly(ball, truth.ball_velocity, self.floor)
        at = lambda seconds: point + self.offset(command, seconds) - offset
        then = at(flight.apex_time)
        distance = task.horizontal_distance(flight.apex, then)
        inputs = Inputs(
            apex_distance=distance,
            apex_error=flight.apex[2] - then[2],
            landing_distance=task.horizontal_distance(flight.landing, at(flight.landing_time)),
            paddle_distance=task.horizontal_distance(flight.landing, truth.paddle_position),
            lift=truth.paddle_position[2] - config.home_height,
            action_change=jnp.sum(jnp.square(step.action - step.last_action)),
            joint_speed=jnp.sum(jnp.square(truth.joint_velocities)),
        )
        rising = truth.ball_velocity[2] > 0.0
        apex = state.rising & ~rising & (ball[2] > self.floor + 0.1)
        away = task.horizontal_distance(ball, point)
        is_step = (command["path"] >= 3) & (command["path"] < 4)
        since = (6.0 * command["phase"]) % 1.0 * STEP_SECONDS
        return task.TaskStep(
            state=TrackState(rising, offset),
            reward=task.weighted_terms(config.reward, inputs),
            ended=(ball[2] < config.min_ball_height)
            | (ball[2] > point[2] + config.max_height_above_target)
            | (away > config.max_distance),
            metrics={
                "apexes": apex,
                "apex_distance": jnp.where(apex, away, 0.0),
                "apex_error": jnp.where(apex, jnp.abs(ball[2] - point[2]), 0.0),
                "settled": ~is_step | (since > 1.0),
            },
        )

    def aim(self, motion, acceleration, measured):
        ball = measured["ball_position"]
        flight = fly(ball, measured["ball_velocity"], self.floor)
        rise = measured["target_height"][0] - self.floor
        t = flight.landing_time + task.safe_sqrt(2.0 * rise / GRAVITY)
        point = motion.point + t * motion.velocity + 0.5 * jnp.square(t) * acceleration
        return {"aim": point - flight.landing, "landing": flight.landing - measured["paddle_position"][:2]}

    def first_quantities(self, measured):
        point = jnp.concatenate([measured["target_x"], measured["target_y"]])
        motion = Motion(point, jnp.zeros_like(point))
        return motion, self.aim(motion, motion.velocity, measured)

    def next_quantities(self, memory, seen, measured):
        dt = self.config.control_dt
        point = jnp.concatenate([measured["target_x"], measured["target_y"]])
        velocity = calm((point - memory.point) / dt, 1.0)
        acceleration = calm((velocity - memory.velocity) / dt, 3.0)
        motion = Motion(point, velocity)
        new = self.aim(motion, acceleration, measured)
        every = jnp.array(True)
        return motion, {n: jnp.concatenate([new[n][None], past[:-1]]) for n, past in seen.items()}

    def tally(self, moment):
        metrics, command = moment.metrics, moment.command
        apex = (metrics["apexes"] > 0) & (moment.command_seconds > 2.0)
        path, speed = command["path"], command["target_speed"]
        is_step = (path >= 3) & (path < 4)
        square = jnp.square(100.0 * metrics["apex_distance"])
        slow = apex & ~is_step & (speed < 0.1001)
        fast = apex & ~is_step & (speed > 0.2499)
        stepped = apex & is_step & (metrics["settled"] > 0)
        sums = {
            "apexes": apex,
            "high": apex & (metrics["apex_error"] <= 0.1),
            "slow": slow, "slow_squares": slow * square,
            "fast": fast, "fast_squares": fast * square,
            "steps": stepped, "near": stepped & (metrics["apex_distance"] <= 0.03),
        }
        for i, name in enumerate(PATHS):
            it = (path == i) & apex & (metrics["settled"] > 0)
            sums[name] = it
            sums[name + "_squares"] = it * square
        return task.Tally(sums)

    def results(self, episodes):
        s = episodes.sums
        rms = lambda name, words, most: _root(task.mean_of_events(name, words, s[name + "_squares"], s[name], (0.0, most**2), "" if s[name].sum() else "none"), most)
        return (
            rms("slow", "RMS distance of the apexes, cm", 1.5),
            rms("fast", "RMS distance of the apexes, cm", 3.0),
            task.share_of_events("after a step", "apexes within 3 cm", s["near"], s["steps"], 0.95),
            task.share_of_events("height", "apexes within 0.1 m", s["high"], s["apexes"], 0.95),
            task.share_of_episodes("stable", "episodes that last", episodes.lasted, 0.99),
        )

    def details(self, episodes):
        s = episodes.sums
        return {f"{n}_rms_cm": math.sqrt(s[n + "_squares"].sum() / max(s[n].sum(), 1)) for n in PATHS}


def calm(x, limit):
    return jnp.where(jnp.abs(x) <= limit, x, 0.0)


def _root(result, most):
    return dataclasses.replace(result, value=None if result.value is None else math.sqrt(result.value), bound=f"<= {most:g}")
