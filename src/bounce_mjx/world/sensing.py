"""Measured quantities from the true state: a camera with latency, noisy sensors, and their
history."""

import math
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import mujoco

from bounce_mjx.physics import Engine
from bounce_mjx.physics.parameters import MODEL_PARAMETERS
from bounce_mjx.robot.model import Addresses, scatter
from bounce_mjx.robot.setpoints import Setpoint
from bounce_mjx.world import noise
from bounce_mjx.world.actuation import entry_at, with_newest
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.noise import Clock
from bounce_mjx.world.observation import Kinematics
from bounce_mjx.world.randomization import World

_PADDLE_TERMS = {"encoder_bias", "joint_angle_noise", "paddle_offset", "paddle_tilt"}
"""Terms that make the forward kinematics of the measured joint angles differ from the truth."""

_TERMS = _PADDLE_TERMS | {
    "ball_latency",
    "camera_rate",
    "frame_drop",
    "ball_position_noise",
    "ball_position_bias",
    "ball_velocity_noise",
    "ball_velocity_bias",
    "joint_velocity_noise",
    "joint_velocity_bias",
}
"""Terms that make measurements differ from the truth; those of a new sensor go here too."""

# Older than any picture of an episode, s. Its negative, as a number of pictures, is below that of
# any.
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
    """Number of the newest picture that was due, lost or not []; the pictures are counted from the
    reset, and negative before it."""


class Sensing(NamedTuple):
    """Memory of the sensors."""

    balls: jax.Array
    """True position and velocity of the ball in the last control steps [K, 6], the newest first;
    [K, B, 6] with several balls."""
    picture: Picture
    histories: dict[str, jax.Array]
    """Last values of each observed quantity [H, size], the newest first; of several balls
    [H, B, size]."""
    task: Any
    """What the task remembers of the measurements (`Task.next_quantities`); what it keeps of the
    true states is `EnvState.task`."""


class Instant(NamedTuple):
    """What the sensors depend on, at a reset or after a control step."""

    truth: Kinematics
    """True positions and velocities."""
    goal: dict[str, jax.Array]
    """Value [] of each goal."""
    last_action: jax.Array
    """Clipped action of the control step [n]."""
    setpoint: Setpoint | None
    """Memory of the servo targets (`ActuationMemory.setpoint`)."""
    world: World
    """The values that the episode sampled."""
    clock: Clock


class Remembering(Protocol):
    """The part of a `Task` that remembers measurements; its methods say what each argument is."""

    def first_quantities(
        self, measured: dict[str, jax.Array]
    ) -> tuple[Any, dict[str, jax.Array]]: ...

    def next_quantities(
        self, memory: Any, histories: dict[str, jax.Array], measured: dict[str, jax.Array]
    ) -> tuple[Any, dict[str, jax.Array]]: ...


class Sensors:
    """The sensors of a world."""

    def __init__(
        self,
        config: WorldConfig,
        mj_model: mujoco.MjModel,
        addresses: Addresses,
        engine: Engine,
        task: Remembering,
    ):
        """Chooses what has to be simulated.

        Args:
          config: of the world, with its observation and its randomisation.
          mj_model: its model.
          addresses: of the model's parts.
          engine: computes where the paddle seems to be.
          task: has quantities of its own.
        """
        self._config = config
        self._engine = engine
        self._task = task
        self._qpos = mj_model.qpos0
        self._arm_qpos = addresses.arm_qpos
        terms = set(config.randomization.terms)
        self.are_needed = bool(_TERMS & terms) or not config.observation.is_momentary
        """Whether the observation may differ from the true state of a single instant."""
        sees_paddle = config.observation.paddle_position or config.observation.counts("task")
        self._misjudges_paddle = bool(sees_paddle and _PADDLE_TERMS & terms)

    def first(self, now: Instant) -> Sensing:
        """Memory at a reset: the histories repeat the first measurements, and the ball counts as
        having been where it starts, with the velocity of its start. A picture from before the reset
        shows a thrown ball beside that place by less than a tenth of its velocity times
        `control_dt`, as the path between two equal places bends by that (`_ball_at`).

        Raises:
          UserError: the task's quantities are not those of its observation.
        """
        ball = _position_and_velocity(now.truth)
        balls = jnp.broadcast_to(ball, (self._num_remembered(), *ball.shape))
        zero = jnp.zeros((), ball.dtype)
        # So long ago that the first velocity from a difference is 0.
        last_picture = Picture(
            position=now.truth.ball_position,
            velocity=now.truth.ball_velocity,
            age=zero + _LONG_AGO,
            number=zero - _LONG_AGO,
        )
        picture = take_picture(self._config, now.world, now.clock, balls, last_picture)
        measured = self._measure(now, picture)
        task, quantities = self._task.first_quantities(measured)
        values = measured | quantities
        histories = {}
        for name, count in self._config.observation.counts().items():
            histories[name] = jnp.broadcast_to(values[name], (count, *values[name].shape))
        return Sensing(balls, picture, histories, task)

    def _num_remembered(self) -> int:
        """Control steps of which the ball is remembered: as old as the last picture can be if none
        is lost."""
        randomization = self._config.randomization
        oldest = 0.0
        if randomization.ball_latency is not None:
            oldest = randomization.ball_latency[1]
        if randomization.camera_rate is not None:
            oldest += 1.0 / randomization.camera_rate[0]
        return math.ceil(oldest / self._config.control_dt - 1e-6) + 1

    def next(self, before: Sensing, now: Instant) -> Sensing:
        """Memory after a control step, from that before it."""
        balls = with_newest(before.balls, _position_and_velocity(now.truth))
        picture = take_picture(self._config, now.world, now.clock, balls, before.picture)
        measured = self._measure(now, picture)
        histories = {}
        of_task = {}
        for name, history in before.histories.items():
            if name in measured:
                histories[name] = with_newest(history, measured[name])
            else:
                of_task[name] = history
        task, next_of_task = self._task.next_quantities(before.task, of_task, measured)
        return Sensing(balls, picture, histories | next_of_task, task)

    def _measure(self, now: Instant, picture: Picture) -> dict[str, jax.Array]:
        """The measured value [size] of each quantity of the world and of each goal; of each ball
        [B, size] if there are several. The ball's quaternion and spin are the present truth, and so
        is the paddle's position unless a term of `_PADDLE_TERMS` acts and somebody sees it."""
        world = now.world
        angles, velocities = measured_joints(world, now.clock.counter, now.truth)
        measured = now.truth._asdict()
        measured |= {name: value[None] for name, value in now.goal.items()}
        measured |= {
            "action": now.last_action,
            "joint_angles": angles,
            "joint_velocities": velocities,
            "ball_position": picture.position,
            "ball_velocity": picture.velocity,
            "ball_age": picture.age[None],
            # The same as ball_position, by the name that exported policies have.
            "ball_picture": picture.position,
        }
        if now.setpoint is not None:
            # The servo shares the offset of the encoder's zero.
            servo_angles = angles - world.get("encoder_bias", 0.0)
            measured["servo_lead"] = now.setpoint.position - servo_angles
        if self._misjudges_paddle:
            qpos = scatter(self._qpos, self._arm_qpos, angles)
            measured["paddle_position"] = self._engine.paddle_position(MODEL_PARAMETERS, qpos)
        return measured


def measured_joints(
    world: World, counter: jax.Array, truth: Kinematics
) -> tuple[jax.Array, jax.Array]:
    """The measured angles [n] (rad) and velocities [n] (rad/s) of the acting joints.

    Args:
      counter: of the clock [], int32.
    """
    angles = truth.joint_angles
    angle_noise, velocity_noise = noise.joints(counter, len(angles), angles.dtype)
    if "joint_angle_noise" in world:
        angles = angles + world["joint_angle_noise"] * angle_noise
    if "encoder_bias" in world:
        angles = angles + world["encoder_bias"]
    velocities = _add_errors(world, "joint_velocity", truth.joint_velocities, velocity_noise)
    return angles, velocities


def _position_and_velocity(truth: Kinematics) -> jax.Array:
    """Position and velocity of the ball [6], or of each ball [B, 6]."""
    return jnp.concatenate([truth.ball_position, truth.ball_velocity], axis=-1)


def take_picture(
    config: WorldConfig, world: World, clock: Clock, balls: jax.Array, last: Picture
) -> Picture:
    """Last picture that has arrived at a control step.

    A camera takes pictures at its own rate, independent of the control steps. A picture arrives
    after the latency, or is lost; that of the reset is not lost. Of several that arrive in one
    control step, only the newest counts: if it is lost, so are the others of the step.

    Args:
      config: of the world.
      world: the values that the episode sampled.
      clock: at the control step.
      balls: `Sensing.balls`, including the ball of this control step.
      last: the last picture at the control step before.
    """
    control_dt = config.control_dt
    dtype = balls.dtype
    number, age_steps = _newest_picture(world, clock, control_dt, dtype)
    age = age_steps * control_dt
    last_age = last.age + control_dt

    position, velocity = _ball_at(balls, age_steps, control_dt)
    noises = noise.normal(clock.counter, noise.BALL, balls.shape[1:], dtype)
    position = _add_errors(world, "ball_position", position, noises[..., :3])
    if config.observation.velocity == "differences":
        # It has the errors of the positions, and no sensor of its own.
        velocity = (position - last.position) / jnp.maximum(last_age - age, 1e-3)
    else:
        velocity = _add_errors(world, "ball_velocity", velocity, noises[..., 3:])

    is_new = number > last.number
    arrives = is_new
    if "frame_drop" in world:
        chance = noise.uniform(clock.counter, noise.FRAME_DROP, (), dtype)
        arrives = is_new & ((chance >= world["frame_drop"]) | (clock.step == 0))
    new = Picture(position, velocity, age, number)
    # A lost picture stays lost.
    older = last._replace(age=last_age, number=jnp.where(is_new, number, last.number))
    return jax.tree.map(lambda new, older: jnp.where(arrives, new, older), new, older)


def _newest_picture(
    world: World, clock: Clock, control_dt: float, dtype: jnp.dtype
) -> tuple[jax.Array, jax.Array]:
    """Number [] of the newest picture that can have arrived, and its age [] in control steps.

    Args:
      control_dt: time of one control step, s.
      dtype: of the results.
    """
    steps = clock.step.astype(dtype)
    latency = world.get("ball_latency", jnp.zeros((), dtype)) / control_dt
    if "camera_rate" in world:
        interval = 1.0 / (world["camera_rate"] * control_dt)
        phase = clock.camera_phase
        # The 1e-4 lets a picture that is due at exactly this instant arrive despite rounding.
        number = jnp.floor((steps - latency) / interval - phase + 1e-4)
        age = steps - (number + phase) * interval
    else:
        number = steps
        age = latency
    return number, jnp.maximum(age, 0.0)


def _ball_at(balls: jax.Array, age: jax.Array, control_dt: float) -> tuple[jax.Array, jax.Array]:
    """Position [..., 3] and velocity [..., 3] of the ball some time ago.

    Between two control steps, the ball's path is the cubic with the true positions and velocities
    at both (Hermite interpolation), which is exact in free flight; the velocity is interpolated
    linearly.

    Args:
      balls: `Sensing.balls` [K, ..., 6].
      age: the time in control steps [].
      control_dt: time of one control step, s.
    """
    whole = jnp.floor(age)
    share = age - whole
    newer = entry_at(balls, whole)
    older = entry_at(balls, whole + 1.0)
    new_position, new_velocity = newer[..., :3], newer[..., 3:]
    old_position, old_velocity = older[..., :3], older[..., 3:]
    change = old_position - new_position
    start_slope = -control_dt * new_velocity
    end_slope = -control_dt * old_velocity
    curve = (1.0 - share) * (start_slope - change) - share * (end_slope - change)
    position = new_position + share * (change + (1.0 - share) * curve)
    velocity = new_velocity + share * (old_velocity - new_velocity)
    return position, velocity


def _add_errors(world: World, name: str, value: jax.Array, noises: jax.Array) -> jax.Array:
    """A measured value: the true one with the bias and the noise of the terms with its name.

    Args:
      world: the values that the episode sampled.
      name: of the terms, before `_bias` and `_noise`.
      value: true value [...].
      noises: normally distributed numbers of its shape, with mean 0 and variance 1.
    """
    if f"{name}_bias" in world:
        value = value + world[f"{name}_bias"]
    if f"{name}_noise" in world:
        value = value + world[f"{name}_noise"] * noises
    return value
