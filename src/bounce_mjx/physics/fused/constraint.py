"""Forces of the contacts along their normals, and of the joints' dry friction, and what they do.

Sliding friction is no constraint: it acts after the step (`friction.py`). The damping b of the
reference acceleration makes the restitution of a bounce (`robot/contact.py`). Source: MuJoCo's
documentation, "Computation" (constraint model, reference acceleration, diagonal regulariser).
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

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
)
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
    contacts: list[Contact]
    """Geometry of each of `FusedModel.contacts`."""
    normal_forces: Scalars
    """Force of each along its normal, N."""


class Row(NamedTuple):
    """A row of the contacts' Jacobian: the relative velocity of a contact along its normal."""

    pair: ContactModel
    normal: Vec
    """Unit vector in the world."""
    joints: list[Scalar]
    """Entries [n] of the joints."""
    position_reference: Scalar
    """Share of the position in -aref = b v + k d(r) r, m/s^2: k d(r) r with the distance r."""


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
    rows = []
    regularisers = []
    for pair, contact in zip(model.contacts, contacts, strict=True):
        impedance = impedance_at(pair, contact.distance)
        rows.append(
            Row(
                pair=pair,
                normal=contact.normal,
                joints=keep(_joint_entries(model, pose, pair, contact, balls)),
                position_reference=mul(mul(pair.stiffness, impedance), contact.distance),
            )
        )
        regularisers.append(normal_regulariser(pair, impedance))

    # `half` as in `chain.solve_lower`.
    half_rows = [chain.solve_lower(mass_factor, row.joints) for row in rows]
    half_rows, half_acceleration = keep((half_rows, list(half_acceleration)))
    contact_matrix = _inverse_inertia(model, rows, half_rows)
    contact_offsets = []
    for row, half_row in zip(rows, half_rows, strict=True):
        # J a0, then -aref.
        row_acceleration = add(
            row.normal @ relative(row.pair, free_accelerations),
            dot(half_row, half_acceleration),
        )
        speed = _speed(row, balls, joint_velocity)
        damped = add(row_acceleration, mul(row.pair.damping, speed))
        contact_offsets.append(add(damped, row.position_reference))
    contact_matrix, contact_offsets = keep((contact_matrix, tuple(contact_offsets)))
    is_touching = [contact.distance < 0.0 for contact in contacts]

    def contact_forces(matrix: Scalars, offsets: Scalars) -> Scalars:
        return normal_forces(is_touching, matrix, offsets, regularisers)

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
    return ConstraintEffects(
        joint_force=_joint_forces(rows, forces, dry_friction),
        ball_accelerations=_ball_accelerations(model, rows, forces),
        contacts=contacts,
        normal_forces=forces,
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


def _joint_entries(
    model: FusedModel,
    pose: chain.Pose,
    pair: ContactModel,
    contact: Contact,
    balls: Sequence[Ball],
) -> list[Scalar]:
    """Entries [n] of the joints along a contact's normal: the paddle's velocity counts against the
    ball's; two balls that touch do not touch the arm."""
    if len(pair.balls) == 2:
        return [0.0] * len(model.links)
    # A force along the normal has the same torque at the contact point and at the ball's centre.
    (ball,) = pair.balls
    against_ball = -contact.normal
    velocities = chain.point_velocities(model.links, pose, balls[ball].position)
    return [against_ball @ velocity for velocity in velocities]


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
    for i, sign in shared_balls(a.pair, b.pair):
        product_of_normals = 1.0 if a is b else a.normal @ b.normal
        share = add(share, mul(product_of_normals, sign / model.balls[i].mass))
    return share


def _speed(row: Row, balls: Sequence[Ball], joint_velocity: Sequence[Scalar]) -> Scalar:
    """Relative velocity of a contact along its normal, m/s: J times the velocities."""
    of_balls = row.normal @ relative(row.pair, [ball.velocity for ball in balls])
    return add(of_balls, dot(row.joints, joint_velocity))


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
) -> list[Vec]:
    """Accelerations of the balls by the contacts' forces."""
    accelerations = [ZERO3] * len(model.balls)
    for row, force in zip(rows, forces, strict=True):
        for i in row.pair.balls:
            along_normal = mul(force, side(row.pair, i) / model.balls[i].mass)
            accelerations[i] = accelerations[i] + row.normal * along_normal
    return accelerations
