"""Effects of the contacts, and of the joints' dry friction, on the arm and the balls.

Each contact has one row of the Jacobian along its normal, and two more along its tangents if it has
sliding friction. Source: MuJoCo's documentation, "Computation" (constraint model, reference
acceleration, diagonal regulariser).
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp

from bounce_mjx.physics.fused import chain, joint_friction
from bounce_mjx.physics.fused.ball import Ball
from bounce_mjx.physics.fused.contact import (
    Contact,
    ContactModel,
    impedance_at,
    relative,
    shared_balls,
    side,
    sphere_box,
    sphere_sphere,
    tangents,
)
from bounce_mjx.physics.fused.friction import coupled_forces, pyramid_force
from bounce_mjx.physics.fused.model import FusedModel
from bounce_mjx.physics.fused.normals import normal_forces
from bounce_mjx.physics.scalars import ZERO3, Scalar, Vec, add, dot, mul

Scalars = tuple[Scalar, ...]


class ConstraintEffects(NamedTuple):
    """What the contacts and dry friction do."""

    joint_force: list[Scalar]
    """Forces [n] at the joints, N m or N: MuJoCo's `qfrc_constraint`."""
    ball_accelerations: list[Vec]
    """Acceleration of each ball in the world, m/s^2."""
    ball_angular_accelerations: list[Vec]
    """Angular acceleration of each ball in the world, rad/s^2."""


class Row(NamedTuple):
    """A row of the contacts' Jacobian: along a normal, or along a tangent of a contact with
    friction."""

    pair: ContactModel
    axis: Vec
    """Unit vector in the world."""
    torques: dict[int, Vec]
    """Torque on each ball (by its index) from a unit force along a tangent, m; none along a
    normal. Two balls that touch get torques of one direction: force and lever both change sign
    from one to the other."""
    joints: list[Scalar]
    """Entries [n] of the joints."""
    position_reference: Scalar
    """Share of the position in -aref = b v + k d(r) r, m/s^2: k d(r) r with the distance r along
    the normal, 0 along a tangent."""


def fwd_constraint(
    model: FusedModel,
    pose: chain.Pose,
    mass_factor: chain.Factor,
    joint_velocity: Sequence[Scalar],
    half_acceleration: Sequence[Scalar],
    balls: Sequence[Ball],
    free_accelerations: Sequence[Vec],
    keep: Callable[[Any], Any],
) -> ConstraintEffects:
    """Forces of the contacts and of dry friction.

    Args:
      mass_factor: Cholesky factor L of the arm's mass matrix.
      joint_velocity: velocities [n] of the joints, rad/s or m/s.
      half_acceleration: L^-1 times the joint forces [n] without contacts and dry friction.
      free_accelerations: the balls' accelerations without the contacts.
      keep: `forward.Keep`.
    """
    contacts = [keep(contact) for contact in _contacts(model, pose, balls)]
    rows: list[Row] = []
    regularisers = []
    for pair, contact in zip(model.contacts, contacts, strict=True):
        impedance = impedance_at(pair, contact.distance)
        rows.extend(_contact_rows(model, pose, pair, contact, impedance, balls, keep))
        regularisers.append(normal_regulariser(pair, impedance))

    # `half` as in `chain.solve_lower`.
    half_rows = [chain.solve_lower(mass_factor, row.joints) for row in rows]
    half_rows, half_acceleration = keep((half_rows, list(half_acceleration)))
    contact_matrix = _inverse_inertia(model, rows, half_rows)
    contact_offsets = []
    for row, half_row in zip(rows, half_rows, strict=True):
        # J a0, then -aref.
        row_acceleration = add(
            row.axis @ relative(row.pair, free_accelerations),
            dot(half_row, half_acceleration),
        )
        speed = _speed(row, balls, joint_velocity)
        damped = add(row_acceleration, mul(row.pair.damping, speed))
        contact_offsets.append(add(damped, row.position_reference))
    contact_matrix, contact_offsets = keep((contact_matrix, tuple(contact_offsets)))
    is_touching = [contact.distance < 0.0 for contact in contacts]

    def contact_forces(matrix: Scalars, offsets: Scalars) -> Scalars:
        # Either all contacts have friction or none (`support.unsupported_friction`).
        if model.contacts[0].friction is None:
            return normal_forces(is_touching, matrix, offsets, regularisers)
        if len(model.contacts) > 1:
            return coupled_forces(model.contacts, is_touching, matrix, offsets, regularisers)
        force = pyramid_force(model.contacts[0], matrix, offsets, regularisers[0])
        return tuple(jnp.where(is_touching[0], component, 0.0) for component in force)

    # Without dry friction these are the contacts' forces alone.
    forces, dry_friction = joint_friction.contact_and_dry_friction(
        links=model.links,
        mass_factor=mass_factor,
        joint_velocity=joint_velocity,
        half_acceleration=half_acceleration,
        half_rows=half_rows,
        contact_matrix=contact_matrix,
        contact_offsets=contact_offsets,
        contact_forces=contact_forces,
    )
    forces = keep(forces)
    accelerations, angular_accelerations = _ball_accelerations(model, rows, forces)
    return ConstraintEffects(
        joint_force=_joint_forces(rows, forces, dry_friction),
        ball_accelerations=accelerations,
        ball_angular_accelerations=angular_accelerations,
    )


def paddle_centre(model: FusedModel, pose: chain.Pose) -> Vec:
    """Centre of the paddle in the world, m."""
    return pose.world_origin[-1] + pose.world_rotation[-1] @ model.paddle.origin


def normal_regulariser(pair: ContactModel, impedance: Scalar) -> Scalar:
    """Regulariser R of the normal force without friction, 1/kg: (1 - d) / d times the approximate
    diagonal of J M^-1 J^T, which MuJoCo takes at the reference pose."""
    return (1.0 - impedance) / impedance * add(*pair.inverse_weights)


def _contacts(model: FusedModel, pose: chain.Pose, balls: Sequence[Ball]) -> list[Contact]:
    """Geometry of each of `FusedModel.contacts`."""
    origin = paddle_centre(model, pose)
    rotation = pose.world_rotation[-1] @ model.paddle.rotation
    contacts = []
    for pair in model.contacts:
        last = pair.balls[-1]
        radius = model.balls[last].radius
        centre = balls[last].position
        if len(pair.balls) == 1:
            contact = sphere_box(radius, centre, model.paddle_half_size, origin, rotation)
        else:
            first = pair.balls[0]
            contact = sphere_sphere(
                model.balls[first].radius, radius, balls[first].position, centre
            )
        contacts.append(contact)
    return contacts


def _contact_rows(
    model: FusedModel,
    pose: chain.Pose,
    pair: ContactModel,
    contact: Contact,
    impedance: Scalar,
    balls: Sequence[Ball],
    keep: Callable[[Any], Any],
) -> list[Row]:
    """The rows of a contact: the normal, and with friction the first and second tangent."""
    normal = contact.normal
    # Where the force acts on the paddle; two balls that touch need no point. A force along the
    # normal has the same torque at the contact point and at the ball's centre.
    last_ball = pair.balls[-1]
    point = balls[last_ball].position
    axes = [normal]
    torques: list[dict[int, Vec]] = [{}]
    position_references = [mul(mul(pair.stiffness, impedance), contact.distance)]
    if pair.friction is not None:
        first_tangent, second_tangent = keep(tangents(normal))
        axes += [first_tangent, second_tangent]
        first_torques = {}
        second_torques = {}
        for i in pair.balls:
            # From the contact point, midway between the surfaces, to the ball's centre.
            lever = model.balls[i].radius + 0.5 * contact.distance
            first_torques[i] = second_tangent * -lever
            second_torques[i] = first_tangent * lever
            if i == last_ball:
                point = point - normal * lever
        torques += [first_torques, second_torques]
        position_references += [0.0, 0.0]
    joints = _joint_entries(model, pose, pair, axes, point, keep)
    rows = []
    for k, axis in enumerate(axes):
        rows.append(Row(pair, axis, torques[k], joints[k], position_references[k]))
    return rows


def _joint_entries(
    model: FusedModel,
    pose: chain.Pose,
    pair: ContactModel,
    axes: Sequence[Vec],
    point: Vec,
    keep: Callable[[Any], Any],
) -> list[list[Scalar]]:
    """Entries [n] of the joints along each axis: the paddle's velocity at a point counts against
    the ball's; two balls that touch do not touch the arm."""
    if len(pair.balls) == 2:
        return [[0.0] * len(model.links) for _ in axes]
    point_velocities = list(chain.point_velocities(model.links, pose, point))
    entries = []
    for axis in axes:
        against_ball = -axis
        entries.append([against_ball @ velocity for velocity in point_velocities])
    return keep(entries)


def _inverse_inertia(
    model: FusedModel, rows: Sequence[Row], half_rows: Sequence[Sequence[Scalar]]
) -> Scalars:
    """J M^-1 J^T, the upper triangle row by row, 1/kg."""
    entries = []
    for i in range(len(rows)):
        for j in range(i, len(rows)):
            by_arm = dot(half_rows[i], half_rows[j])
            entries.append(add(by_arm, _inverse_inertia_by_balls(model, rows[i], rows[j])))
    return tuple(entries)


def _inverse_inertia_by_balls(model: FusedModel, a: Row, b: Row) -> Scalar:
    """Share of the balls in an entry of J M^-1 J^T, 1/kg."""
    share: Scalar = 0.0
    if a.pair is b.pair and a is not b:
        # The axes of one contact's rows are orthogonal, and so are their torques.
        return share
    for i, sign in shared_balls(a.pair, b.pair):
        product_of_axes = 1.0 if a is b else a.axis @ b.axis
        share = add(share, mul(product_of_axes, sign / model.balls[i].mass))
        if a.torques and b.torques:
            product_of_torques = a.torques[i] @ b.torques[i]
            share = add(share, product_of_torques / model.balls[i].inertia)
    return share


def _speed(row: Row, balls: Sequence[Ball], joint_velocity: Sequence[Scalar]) -> Scalar:
    """Relative velocity of a contact along a row, m/s: J times the velocities."""
    speed = row.axis @ relative(row.pair, [ball.velocity for ball in balls])
    for i, torque in row.torques.items():
        speed = add(speed, torque @ balls[i].turning.spin)
    return add(speed, dot(row.joints, joint_velocity))


def _joint_forces(
    rows: Sequence[Row], forces: Sequence[Scalar], dry_friction: Sequence[Scalar]
) -> list[Scalar]:
    """Forces [n] at the joints: J^T times the contacts' forces, and dry friction."""
    joint_forces = []
    for joint, friction in enumerate(dry_friction):
        column = [row.joints[joint] for row in rows]
        joint_forces.append(add(dot(column, forces), friction))
    return joint_forces


def _ball_accelerations(
    model: FusedModel, rows: Sequence[Row], forces: Sequence[Scalar]
) -> tuple[list[Vec], list[Vec]]:
    """Accelerations and angular accelerations of the balls by the contacts' forces.

    A force along a tangent has a torque (`Row.torques`), and its angular acceleration is that over
    the ball's inertia; `ball.turn` changes the spin by it. A force along a normal has no torque.
    """
    accelerations = [ZERO3] * len(model.balls)
    angular_accelerations = [ZERO3] * len(model.balls)
    for row, force in zip(rows, forces, strict=True):
        for i in row.pair.balls:
            along_axis = mul(force, side(row.pair, i) / model.balls[i].mass)
            accelerations[i] = accelerations[i] + row.axis * along_axis
        for i, torque in row.torques.items():
            along_torque = mul(force, 1.0 / model.balls[i].inertia)
            angular_accelerations[i] = angular_accelerations[i] + torque * along_torque
    return accelerations, angular_accelerations
