"""The inputs of the physics over one control step."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.robot.setpoints import Setpoint, position_at

Scalar = float | jax.Array


class Moving(NamedTuple):
    """Servo targets that move within an arm's limits (`robot.setpoints`). The unit of time is the
    physics step in all fields: velocities are in rad per step, accelerations in rad per step^2."""

    velocity: Any
    """Velocities [nu] at the start of the control step."""
    acceleration: Any
    """Accelerations [nu] in the control step."""
    last_acceleration: Any
    """Accelerations [nu] in the control step before."""
    smoothing: Any = None
    """Time [nu] of the mean that limits the jerk."""
    older_acceleration: Any = None
    """Accelerations [nu] two control steps before, for targets that are late and smoothed: their
    mean reaches back that far."""
    num_substeps: Any = None
    """Physics steps [] in a control step, with `older_acceleration`."""


class Control(NamedTuple):
    """Servo targets and disturbances over N physics steps; None leaves a disturbance out.

    All engines apply it the same way: `servo_target` gives the `ctrl` of each physics step
    (`servo_targets` that of all steps, for the C engine), the push changes the ball's velocity
    before the first step, and every step has the drag of its velocity. The unit of time is the
    physics step in all fields but the last two. (`evaluation.c_episodes` has the push and `drag` in
    NumPy.)
    """

    ctrl: Any
    """Servo targets [nu], rad; those at the start of the control step if they are moving."""
    moving: Moving | None = None
    """How the targets move."""
    previous: Any = None
    """Servo targets [nu] until the physics step `switch`, if they do not move."""
    switch: Any = None
    """Number [] of physics steps with the targets of an earlier control step, a whole number. Of
    moving targets, the delay: each step has the target of `switch` steps before."""
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

    Args:
      control: `ctrl`, `previous` and `filtered` of one servo or of several.
      step: index of the physics step, from 0.
    """
    if control.moving is not None:
        return _moving_target(control, control.moving, step)
    if control.lag is not None:
        return _lagging_target(control, step)
    if control.previous is not None:
        return jnp.where(step < control.switch, control.previous, control.ctrl)
    return control.ctrl


def _lagging_target(control: Control, step: Scalar) -> Scalar:
    """`servo_target` behind a lag: the exact solution of a first-order filter whose input is
    constant until the switch and after it."""
    # A filter with a time constant of 0 has no memory.
    rate = -1.0 / jnp.maximum(control.lag, 1e-3)
    # A target of a physics step is the filter's output at the end of the step.
    time = step + 1.0
    if control.previous is None:
        return control.ctrl + (control.filtered - control.ctrl) * jnp.exp(rate * time)
    time_before_switch = jnp.minimum(time, control.switch)
    lead = control.filtered - control.previous
    until_switch = control.previous + lead * jnp.exp(rate * time_before_switch)
    time_after_switch = jnp.maximum(time - control.switch, 0.0)
    lead = until_switch - control.ctrl
    after_switch = control.ctrl + lead * jnp.exp(rate * time_after_switch)
    return jnp.where(step < control.switch, until_switch, after_switch)


def _moving_target(control: Control, moving: Moving, step: Scalar) -> Scalar:
    """`servo_target` of a target that moves: its position at the end of the physics step."""
    start = Setpoint(control.ctrl, moving.velocity, moving.last_acceleration)
    earlier = None
    if moving.older_acceleration is not None:
        earlier = (moving.num_substeps, moving.older_acceleration)
    time = step + 1.0
    # A late target is the setpoint of an earlier time, before the control step if negative.
    setpoint_time = time if control.switch is None else time - control.switch

    def position(setpoint_time: Scalar, lag: Scalar | None = None) -> Scalar:
        return position_at(
            start,
            moving.acceleration,
            setpoint_time,
            jnp,
            smoothing=moving.smoothing,
            lag=lag,
            earlier=earlier,
        )

    if control.lag is None:
        return position(setpoint_time)
    # `position` with a lag is the lag's output after a long time with this motion. The difference
    # of the real output from it at the start of the step fades.
    lag = jnp.maximum(control.lag, 1e-3)
    difference = control.filtered - position(setpoint_time - time, lag)
    return position(setpoint_time, lag) + difference * jnp.exp(-time / lag)


def servo_targets(control: Control, num_steps: int) -> jax.Array:
    """Targets [num_steps, nu] of all servos in each physics step."""
    steps = jnp.arange(num_steps, dtype=control.ctrl.dtype)
    return jax.vmap(lambda step: servo_target(control, step))(steps)


def drag(air_drag: Scalar, velocity: Any) -> tuple[Scalar, ...]:
    """Acceleration of a ball with this velocity (x, y, z; m/s) by the drag of the air, m/s^2."""
    squared = sum(v * v for v in velocity)
    speed = squared * jax.lax.rsqrt(jnp.where(squared > 0.0, squared, 1.0))
    return tuple(-air_drag * speed * v for v in velocity)
