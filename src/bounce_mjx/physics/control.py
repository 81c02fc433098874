"""The inputs of the physics over one control step."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.robot.setpoints import Setpoint, command

Scalar = float | jax.Array


class Moving(NamedTuple):
    """Servo targets that move within an arm's limits (`robot.setpoints`); times are in physics
    steps."""

    velocity: Any
    """Velocities [nu] at the start of the control step."""
    acceleration: Any
    """Accelerations [nu] in the control step."""
    before: Any
    """Accelerations [nu] in the one before."""
    smoothing: Any = None
    """Time [nu] of the mean that limits the jerk."""
    earlier: Any = None
    """Accelerations [nu] two control steps before, for targets that are late and smoothed."""
    duration: Any = None
    """Physics steps [] in a control step, with `earlier`."""


class Control(NamedTuple):
    """Servo targets and disturbances over N physics steps; None leaves a disturbance out.

    All engines apply it the same way: `servo_targets` gives the `ctrl` of each physics step, the
    push changes the ball's velocity before the first step, and every step has the drag of its
    velocity.
    """

    ctrl: Any
    """Servo targets [nu]; those at the start of the control step if they are moving."""
    moving: Moving | None = None
    """How the targets move."""
    previous: Any = None
    """Servo targets [nu] until the physics step `switch`, if they do not move."""
    switch: Any = None
    """Number [] of physics steps with earlier targets, a whole number."""
    filtered: Any = None
    """Outputs [nu] of the servos' first-order lags before the first step."""
    lag: Any = None
    """Time constant [] of the lags in physics steps."""
    air_drag: Any = None
    """Deceleration of a ball by the air divided by its squared speed [], 1/m."""
    ball_push: Any = None
    """Velocity [3] added to the ball's before the first step, m/s; [B, 3] with several balls."""


def servo_target(control: Control, step: Scalar) -> Scalar:
    """Target of a servo during one physics step.

    The lag is the exact solution of a first-order filter whose input is constant during a step.

    Args:
      control: `ctrl`, `previous` and `filtered` of one servo or of several.
      step: index of the physics step, from 0.
    """
    if control.moving is not None:
        return _moving_target(control, control.moving, step)
    late = control.previous is not None
    before = control.switch if late else 0.0
    if control.lag is None:
        return jnp.where(step < before, control.previous, control.ctrl) if late else control.ctrl
    # A filter with a time constant of 0 has no memory.
    rate = -1.0 / jnp.maximum(control.lag, 1e-3)
    held = jnp.minimum(step + 1.0, before) if late else 0.0
    at_switch = control.filtered
    if late:
        at_switch = control.previous + (at_switch - control.previous) * jnp.exp(rate * held)
    since = jnp.maximum(step + 1.0 - before, 0.0)
    settled = control.ctrl + (at_switch - control.ctrl) * jnp.exp(rate * since)
    return jnp.where(step < before, at_switch, settled) if late else settled


def _moving_target(control: Control, moving: Moving, step: Scalar) -> Scalar:
    """`servo_target` of a target that moves: its position at the end of the physics step."""
    start = Setpoint(control.ctrl, moving.velocity, moving.before)
    earlier = None if moving.earlier is None else (moving.duration, moving.earlier)
    since = step + 1.0
    time = since if control.switch is None else since - control.switch

    def target(time: Scalar, lag: Scalar | None = None) -> Scalar:
        return command(start, moving.acceleration, time, jnp, moving.smoothing, lag, earlier)

    if control.lag is None:
        return target(time)
    lag = jnp.maximum(control.lag, 1e-3)
    behind = control.filtered - target(time - since, lag)
    return target(time, lag) + behind * jnp.exp(-since / lag)


def servo_targets(control: Control, num_steps: int) -> jax.Array:
    """Targets [num_steps, nu] of all servos in each physics step."""
    steps = jnp.arange(num_steps, dtype=control.ctrl.dtype)
    return jax.vmap(lambda step: servo_target(control, step))(steps)


def drag(air_drag: Scalar, velocity: Any) -> tuple[Scalar, ...]:
    """Acceleration of a ball with this velocity (x, y, z; m/s) by the drag of the air, m/s^2."""
    squared = sum(v * v for v in velocity)
    speed = squared * jax.lax.rsqrt(jnp.where(squared > 0.0, squared, 1.0))
    return tuple(-air_drag * speed * v for v in velocity)
