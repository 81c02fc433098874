"""Measured quantities from the true state: a camera with latency, noisy sensors, and their
history."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco

from bounce_mjx.physics import Engine
from bounce_mjx.physics.parameters import MODEL_PARAMETERS
from bounce_mjx.robot.model import find_addresses, scatter
from bounce_mjx.world import noise
from bounce_mjx.world.actuation import entry_at
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.observation import Kinematics
from bounce_mjx.world.randomization import World

_TERMS = frozenset(
    "ball_latency camera_rate frame_drop ball_position_noise ball_position_bias "
    "ball_velocity_noise ball_velocity_bias joint_angle_noise encoder_bias joint_velocity_noise "
    "joint_velocity_bias paddle_offset paddle_tilt".split()
)
"""Terms that make measurements differ from the truth."""

_PADDLE_TERMS = frozenset("encoder_bias joint_angle_noise paddle_offset paddle_tilt".split())
"""Terms that make the forward kinematics of the measured joint angles differ from the truth."""

# Older than any picture of an episode, s; its negative is below any picture's number.
_LONG_AGO = 1e6


class Picture(NamedTuple):
    """Last picture of the ball that arrived and was not lost; it shows all balls ([B, 3])."""

    position: jax.Array
    """Measured position [3], m."""
    velocity: jax.Array
    """Measured velocity or difference quotient of the last two pictures [3], m/s."""
    age: jax.Array
    """Time since the picture was taken [], s."""
    number: jax.Array
    """Number of the last picture due since the reset []; negative for those taken before it."""


class Sensing(NamedTuple):
    """Memory of the sensors."""

    balls: jax.Array
    """True position and velocity of the ball in the last control steps [K, 6], the newest first;
    [K, B, 6] with several balls."""
    picture: Picture
    histories: dict[str, jax.Array]
    """Last values of each observed quantity [H, size], the newest first."""
    task: Any
    """What the task remembers of the measurements."""


class Sensors:
    """The sensors of a world; `now` is the state (`env.EnvState`) after a reset or a control step,
    and `truth` its kinematics."""

    def __init__(self, config: WorldConfig, mj_model: mujoco.MjModel, engine: Engine, task: Any):
        """Chooses what has to be simulated.

        Args:
          task: `task.Task`, which has quantities of its own.
        """
        self._config, self._engine, self._task = config, engine, task
        self._qpos, self._arm = mj_model.qpos0, find_addresses(mj_model).arm_qpos
        observation, terms = config.observation, set(config.randomization.terms)
        self.are_needed = bool(_TERMS & terms) or not observation.is_momentary
        """Whether the observation differs from the true state of a single instant."""
        sees_paddle = observation.paddle_position or observation.lengths("task")
        self._misjudges_paddle = bool(sees_paddle and _PADDLE_TERMS & terms)

    def first(self, now: Any, truth: Kinematics) -> Sensing:
        """Memory at a reset: the histories repeat the first measurements, and the ball has rested
        until then."""
        config, ball = self._config, _position_and_velocity(truth)
        latency = (config.randomization.ball_latency or (0.0, 0.0))[1]
        rate = config.randomization.camera_rate
        # The greatest age of the last picture if none is lost.
        oldest = latency if rate is None else latency + 1.0 / rate[0]
        length = math.ceil(oldest / config.control_dt - 1e-6) + 1
        balls, zero = jnp.broadcast_to(ball, (length, *ball.shape)), jnp.zeros((), ball.dtype)
        # Too long ago for a velocity from the difference to it.
        before = Picture(
            truth.ball_position, truth.ball_velocity, zero + _LONG_AGO, zero - _LONG_AGO
        )
        picture, measured = self._measure(now, truth, balls, before)
        task, own = self._task.first_quantities(measured)
        values = measured | own
        histories = {
            name: jnp.broadcast_to(values[name], (count, *values[name].shape))
            for name, count in config.observation.lengths().items()
        }
        return Sensing(balls, picture, histories, task)

    def next(self, now: Any, truth: Kinematics) -> Sensing:
        """Memory after a control step; that of the state is the one before it."""
        before = now.sensing
        balls = jnp.concatenate([_position_and_velocity(truth)[None], before.balls[:-1]])
        picture, measured = self._measure(now, truth, balls, before.picture)
        own, histories = {}, {}
        for name, past in before.histories.items():
            if name in measured:
                histories[name] = jnp.concatenate([measured[name][None], past[:-1]])
            else:
                own[name] = past
        task, own = self._task.next_quantities(before.task, own, measured)
        return Sensing(balls, picture, histories | own, task)

    def _measure(
        self, now: Any, truth: Kinematics, balls: jax.Array, last: Picture
    ) -> tuple[Picture, dict[str, jax.Array]]:
        """The last picture that has arrived, and the measured value [size] of each quantity of the
        world and of each command."""
        world, picture = now.world, take_picture(self._config, now, balls, last)
        dtype, angles = truth.joint_angles.dtype, truth.joint_angles
        angle_noise, velocity_noise = noise.joints(now.clock.counter, len(angles), dtype)
        if "joint_angle_noise" in world:
            angles = angles + world["joint_angle_noise"] * angle_noise
        if "encoder_bias" in world:
            angles = angles + world["encoder_bias"]
        velocities = truth.joint_velocities
        measured = truth._asdict() | {name: value[None] for name, value in now.command.items()}
        measured |= {
            "action": now.last_action,
            "joint_angles": angles,
            "joint_velocities": _add_errors(world, "joint_velocity", velocities, velocity_noise),
            "ball_position": picture.position,
            "ball_velocity": picture.velocity,
            "ball_age": picture.age[None],
            "ball_picture": picture.position,
        }
        if now.actuation.setpoint is not None:
            # The servo shares the offset of the encoder's zero.
            lead = now.actuation.setpoint.position - (angles - world.get("encoder_bias", 0.0))
            measured["servo_lead"] = lead
        if self._misjudges_paddle:
            qpos = scatter(self._qpos, self._arm, angles)
            measured["paddle_position"] = self._engine.paddle_position(MODEL_PARAMETERS, qpos)
        return picture, measured


def _position_and_velocity(truth: Kinematics) -> jax.Array:
    """Position and velocity of the ball [6], or of each ball [B, 6]."""
    return jnp.concatenate([truth.ball_position, truth.ball_velocity], axis=-1)


def take_picture(config: WorldConfig, now: Any, balls: jax.Array, last: Picture) -> Picture:
    """Last picture that has arrived at a control step.

    A camera takes pictures at its own rate, independent of the control steps. Between two control
    steps, the ball's path is the cubic with the true positions and velocities at both, which is
    exact in free flight; the velocity is interpolated linearly. Each picture arrives after the
    latency or is lost; the first one is not lost.

    Args:
      balls: `Sensing.balls`, including the ball of this control step.
      last: the last picture at the control step before.
    """
    world, clock, dtype, control_dt = now.world, now.clock, balls.dtype, config.control_dt
    steps = clock.step.astype(dtype)
    latency = world.get("ball_latency", jnp.zeros((), dtype)) / control_dt
    if "camera_rate" in world:
        interval, phase = 1.0 / (world["camera_rate"] * control_dt), clock.phases[0]
        # The 1e-4 lets a picture that is due at exactly this instant arrive despite rounding.
        number = jnp.floor((steps - latency) / interval - phase + 1e-4)
        age = steps - (number + phase) * interval
    else:
        number, age = steps, latency
    age = jnp.maximum(age, 0.0)
    whole = jnp.floor(age)
    newer, older = entry_at(balls, whole), entry_at(balls, whole + 1.0)
    position, velocity = _between(newer, older, age - whole, control_dt)

    noises = noise.normal(clock.counter, noise.BALL, balls.shape[1:], dtype)
    position = _add_errors(world, "ball_position", position, noises[..., :3])
    due = number > last.number
    arrived = due
    if "frame_drop" in world:
        chance = noise.uniform(clock.counter, noise.FRAME_DROP, (), dtype)
        arrived = due & ((chance >= world["frame_drop"]) | (clock.step == 0))
    held_age = last.age + control_dt
    if config.observation.velocity == "differences":
        elapsed = jnp.maximum(held_age - age * control_dt, 1e-3)
        velocity = (position - last.position) / elapsed
    velocity = _add_errors(world, "ball_velocity", velocity, noises[..., 3:])
    fresh = Picture(position, velocity, age * control_dt, number)
    # A lost picture stays lost.
    held = last._replace(age=held_age, number=jnp.where(due, number, last.number))
    return jax.tree.map(lambda new, old: jnp.where(arrived, new, old), fresh, held)


def _between(
    newer: jax.Array, older: jax.Array, share: jax.Array, control_dt: float
) -> tuple[jax.Array, jax.Array]:
    """Position [..., 3] and velocity [..., 3] between two control steps (cubic Hermite
    interpolation).

    Args:
      newer, older: position and velocity [..., 6] at each.
      share: time before the newer one as a share of the control step [].
    """
    now, before, velocity, velocity_before = (
        x[..., part] for part in (slice(3), slice(3, 6)) for x in (newer, older)
    )
    change = before - now
    start, end = -control_dt * velocity, -control_dt * velocity_before
    curve = (1.0 - share) * (start - change) - share * (end - change)
    position = now + share * (change + (1.0 - share) * curve)
    return position, velocity + share * (velocity_before - velocity)


def _add_errors(world: World, name: str, value: jax.Array, noises: jax.Array) -> jax.Array:
    if f"{name}_bias" in world:
        value = value + world[f"{name}_bias"]
    if f"{name}_noise" in world:
        value = value + world[f"{name}_noise"] * noises
    return value
