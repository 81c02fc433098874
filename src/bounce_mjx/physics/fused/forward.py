"""One physics step of the fused engine, in MuJoCo's stages.

Whoever knows `mj_step` knows this file:

    fwd_position      poses and mass matrix
    fwd_velocity      bias and passive forces
    fwd_actuation     forces of the servos and of gravity compensation
    fwd_acceleration  what moves without constraints, the drag of the air included
    fwd_constraint    all about contacts and dry friction (`constraint.py`): collision, Jacobian,
                      reference acceleration and forces; MuJoCo has the first three in its first
                      two stages
    integrate         the next state: MuJoCo's `mj_implicit` or `mj_Euler`

and one more, after MuJoCo's:

    rub               sliding friction of the balls, as an impulse (`friction.py`)

Source: MuJoCo's documentation, "Computation" (simulation pipeline), and `engine_forward.c`, whose
functions `mj_fwdPosition` to `mj_fwdConstraint` gave the first five their names.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp

from bounce_mjx.physics.fused import chain, joint_friction
from bounce_mjx.physics.fused.ball import Ball, free_acceleration, move_ball
from bounce_mjx.physics.fused.constraint import ConstraintEffects, fwd_constraint
from bounce_mjx.physics.fused.friction import rub
from bounce_mjx.physics.fused.model import FusedModel, Servo
from bounce_mjx.physics.scalars import Scalar, Vec, add, dot, mul, not_inlined, sub

Keep = Callable[[Any], Any]
"""`not_inlined` for a long program, in which XLA would compute shared values again and again; the
identity for a short one. A solver of several forces is long in any program, and calls `not_inlined`
itself."""


class Motion(NamedTuple):
    """The state that a physics step changes, one scalar for each coordinate."""

    q: Vec
    """Positions [n] of the joints, rad or m."""
    v: Vec
    """Velocities [n] of the joints, rad/s or m/s."""
    balls: tuple[Ball, ...]


class Position(NamedTuple):
    """What follows from the positions alone."""

    pose: chain.Pose
    mass_matrix: chain.SquareMatrix
    """Joint-space inertia [n, n], kg m^2 or kg."""
    mass_factor: chain.Factor
    """Its Cholesky factor."""


class Velocity(NamedTuple):
    """Joint forces that follow from positions and velocities, N m or N."""

    bias: Sequence[Scalar]
    """Forces [n] that keep the joints from accelerating against gravity, Coriolis and centrifugal
    effects: MuJoCo's `qfrc_bias`."""
    spring_and_damper: Sequence[Scalar]
    """Forces [n] of the joints' springs and dampers: MuJoCo's `qfrc_spring` + `qfrc_damper`."""
    gravity_compensation: Sequence[Scalar]
    """Forces [n] that carry the weight of the bodies with `gravcomp`: `qfrc_gravcomp`, which
    `fwd_actuation` adds."""


class Actuation(NamedTuple):
    """What acts on the joints beside bias, springs and dampers."""

    force: list[Scalar]
    """Forces [n] of the servos and of gravity compensation, N m or N."""
    derivative: list[Scalar]
    """Derivatives [n] of the servos' forces with respect to the joint velocities."""


class Smooth(NamedTuple):
    """What acts without constraints."""

    joint_force: list[Scalar]
    """Forces [n] at the joints, N m or N: MuJoCo's `qfrc_smooth`."""
    half_acceleration: list[Scalar]
    """L^-1 times `joint_force` for the Cholesky factor L of the mass matrix: the first half of the
    solution M^-1 = L^-T L^-1 for MuJoCo's `qacc_smooth`, whose second half no stage needs."""
    ball_accelerations: list[Vec]
    """Acceleration of each ball, m/s^2."""


def substep(
    model: FusedModel, motion: Motion, targets: Sequence[Scalar], air_drag: Scalar | None = None
) -> Motion:
    """One physics step: the equivalent of `mj_step` with frictionless contacts, and then the
    friction of the balls.

    Args:
      targets: targets [n] of the servos in this step, rad or m.
      air_drag: as in `Control`.
    """
    keep = _keep(model, motion)
    position = fwd_position(model, motion, keep)
    velocity = fwd_velocity(model, motion, position, keep)
    actuation = fwd_actuation(model, motion, velocity, targets)
    smooth = fwd_acceleration(model, motion, position, velocity, actuation, air_drag)
    constraint = fwd_constraint(
        model,
        pose=position.pose,
        mass_factor=position.mass_factor,
        joint_velocity=motion.v,
        half_acceleration=smooth.half_acceleration,
        balls=motion.balls,
        free_accelerations=smooth.ball_accelerations,
        keep=keep,
    )
    after = integrate(model, motion, position, actuation, smooth, constraint, keep)
    if not _balls_turn(motion):
        return after
    v, balls = rub(
        model,
        pose=position.pose,
        mass_factor=position.mass_factor,
        centres=[ball.position for ball in motion.balls],
        contacts=constraint.contacts,
        normal_forces=constraint.normal_forces,
        v=after.v,
        balls=after.balls,
    )
    return Motion(after.q, v, balls)


def _balls_turn(motion: Motion) -> bool:
    """Whether a contact may have sliding friction: `dynamics.step` then gives the balls their
    spin."""
    return motion.balls[0].turning is not None


def _keep(model: FusedModel, motion: Motion) -> Keep:
    has_dry_friction = any(joint_friction.has_friction(link) for link in model.links)
    if _balls_turn(motion) or has_dry_friction:
        return not_inlined
    return lambda values: values


def fwd_position(model: FusedModel, motion: Motion, keep: Keep) -> Position:
    """Poses of the links and the mass matrix with its factor."""
    pose = keep(chain.forward_kinematics(model.links, motion.q))
    mass_matrix = keep(chain.mass_matrix(model.links, pose))
    mass_factor = keep(chain.cholesky(mass_matrix))
    return Position(pose, mass_matrix, mass_factor)


def fwd_velocity(model: FusedModel, motion: Motion, position: Position, keep: Keep) -> Velocity:
    """Bias forces, and the passive forces of springs, dampers and gravity compensation."""
    springs_and_dampers = []
    for link, q, v in zip(model.links, motion.q, motion.v, strict=True):
        spring = mul(link.stiffness, sub(link.spring_position, q))
        springs_and_dampers.append(sub(spring, mul(link.damping, v)))
    return Velocity(
        bias=keep(chain.bias_force(model.links, position.pose, motion.v, model.gravity)),
        spring_and_damper=springs_and_dampers,
        gravity_compensation=chain.floating_force(model.links, position.pose, model.gravity),
    )


def fwd_actuation(
    model: FusedModel, motion: Motion, velocity: Velocity, targets: Sequence[Scalar]
) -> Actuation:
    """Forces of the servos for their targets [n]."""
    forces = []
    derivatives = []
    for i, servo in enumerate(model.servos):
        force, derivative = servo_force(
            servo, targets[i], motion.q[i], motion.v[i], velocity.gravity_compensation[i]
        )
        forces.append(force)
        derivatives.append(derivative)
    return Actuation(forces, derivatives)


def servo_force(
    servo: Servo, target: Scalar, q: Scalar, v: Scalar, gravity_compensation: Scalar
) -> tuple[Scalar, Scalar]:
    """Force of a servo and of gravity compensation at a joint (N m, N) for the servo target, and
    the derivative of the servo's force with respect to the velocity, which is 0 at the servo's
    force limit. The limit of the joint does not change MuJoCo's derivative."""
    if servo.ctrl_range is not None:
        target = jnp.clip(target, *servo.ctrl_range)
    coefficients = servo.gain, servo.force_per_position, servo.force_per_velocity
    force = dot(coefficients, (target, q, v))
    force = add(force, servo.bias)
    derivative = servo.force_per_velocity
    if servo.force_range is not None:
        least, most = servo.force_range
        is_within = (force > least) & (force < most)
        derivative = jnp.where(is_within, derivative, 0.0)
        force = jnp.clip(force, least, most)
    # With `actuatorgravcomp`, the joint's limit holds for the sum; otherwise for the servo alone.
    if servo.carries_weight:
        force = add(force, gravity_compensation)
    if servo.joint_range is not None:
        force = jnp.clip(force, *servo.joint_range)
    if not servo.carries_weight:
        force = add(force, gravity_compensation)
    return force, derivative


def fwd_acceleration(
    model: FusedModel,
    motion: Motion,
    position: Position,
    velocity: Velocity,
    actuation: Actuation,
    air_drag: Scalar | None,
) -> Smooth:
    """Joint forces without constraints, and the accelerations of the balls in free flight."""
    joint_force = []
    for i, force in enumerate(actuation.force):
        actuation_and_passive = add(force, velocity.spring_and_damper[i])
        joint_force.append(sub(actuation_and_passive, velocity.bias[i]))
    ball_accelerations = []
    for ball_model, ball in zip(model.balls, motion.balls, strict=True):
        ball_accelerations.append(free_acceleration(ball_model, ball, model.gravity, air_drag))
    return Smooth(
        joint_force=joint_force,
        half_acceleration=chain.solve_lower(position.mass_factor, joint_force),
        ball_accelerations=ball_accelerations,
    )


def integrate(
    model: FusedModel,
    motion: Motion,
    position: Position,
    actuation: Actuation,
    smooth: Smooth,
    constraint: ConstraintEffects,
    keep: Keep,
) -> Motion:
    """The next state: semi-implicit Euler, implicit in the velocity-dependent forces of the joints'
    dampers (unless Euler's flag `eulerdamp` is off) and, with the integrator implicitfast, of the
    servos (MuJoCo's documentation, "Computation", numerical integration)."""
    implicit_matrix = [list(row) for row in position.mass_matrix]
    for i, link in enumerate(model.links):
        damping = link.damping if model.implicit_damping else 0.0
        if model.implicit_servos:
            # A damper's force per velocity is minus its damping.
            damping = sub(damping, actuation.derivative[i])
        implicit_matrix[i][i] = add(implicit_matrix[i][i], mul(damping, model.dt))
    implicit_factor = keep(chain.cholesky(implicit_matrix))
    joint_force = Vec(smooth.joint_force) + Vec(constraint.joint_force)
    half_acceleration = chain.solve_lower(implicit_factor, joint_force)
    acceleration = Vec(chain.solve_upper(implicit_factor, half_acceleration))

    v = motion.v + acceleration * model.dt
    q = motion.q + v * model.dt
    balls = []
    for i, ball in enumerate(motion.balls):
        ball_acceleration = smooth.ball_accelerations[i] + constraint.ball_accelerations[i]
        balls.append(move_ball(ball, ball_acceleration, model.dt))
    return Motion(q, v, tuple(balls))
