"""Effect of the contacts, and of the joints' dry friction, on the arm and the balls.

Each contact has one row of the Jacobian along its normal, and two more along its tangents if it has
sliding friction. Source: MuJoCo's documentation, "Computation" (constraint model, reference
acceleration).
"""

import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.physics.fused import chain, joint_friction
from bounce_mjx.physics.fused import contact as geometry
from bounce_mjx.physics.fused.friction import coupled_forces, pyramid_force
from bounce_mjx.physics.fused.model import FusedModel
from bounce_mjx.physics.fused.normals import normal_forces
from bounce_mjx.physics.scalars import ZERO3, Scalar, Vec, add, dot, mul

Keep = Callable[[Any], Any]
"""`not_inlined`, or the identity."""


class Row(NamedTuple):
    """A row of the contacts' Jacobian: along a normal, or along a tangent of a contact with
    friction."""

    contact: geometry.ContactModel
    axis: Vec
    """Unit vector in the world."""
    torques: dict[int, Vec]
    """Torque on each ball from a unit force along a tangent, m."""
    joints: list[Scalar]
    """Entries [n] of the joints."""


def contact_response(
    model: FusedModel,
    pose: chain.Pose,
    factor: tuple[chain.SquareMatrix, list[jax.Array]],
    joint_velocity: Sequence[Scalar],
    half_applied: Sequence[Scalar],
    balls: Sequence[Any],
    free_accelerations: Sequence[Vec],
    keep: Keep,
) -> tuple[list[Scalar], list[Vec], list[Vec]]:
    """Effect of the contacts' forces and of dry friction: torques of the joints (N m), and by the
    contacts alone, accelerations (m/s^2) and angular accelerations (rad/s^2) of the balls in the
    world.

    Args:
      factor: Cholesky factor L of the arm's inertia matrix.
      half_applied: L^-1 times the joint torques without the contacts and dry friction.
      balls: `dynamics.Ball` of each.
      free_accelerations: the balls' accelerations without the contacts.
    """
    positions, velocities, turnings = zip(*balls, strict=True)
    contacts = [keep(contact) for contact in _contacts(model, pose, positions)]
    rows, springs, softnesses = [], [], []
    for pair, contact in zip(model.contacts, contacts, strict=True):
        own = _rows(model, pose, pair, contact, positions, keep)
        d = geometry.impedance(pair, contact.distance)
        rows += own
        springs += [mul(mul(pair.stiffness, d), contact.distance), *[0.0] * (len(own) - 1)]
        # Regularisers of the normal forces.
        softnesses.append((1.0 - d) / d * add(*pair.inverse_weights))
    halves = [chain.solve_lower(factor, row.joints) for row in rows]
    halves, half_applied = keep((halves, list(half_applied)))
    matrix = tuple(
        add(dot(halves[i], halves[j]), _by_balls(model, rows[i], rows[j]))
        for i in range(len(rows))
        for j in range(i, len(rows))
    )
    offsets = []
    for row, half, spring in zip(rows, halves, springs, strict=True):
        speed = row.axis @ geometry.relative(row.contact, velocities)
        for i, torque in row.torques.items():
            speed = add(speed, torque @ turnings[i].spin)
        speed = add(speed, dot(row.joints, joint_velocity))
        free = add(
            row.axis @ geometry.relative(row.contact, free_accelerations), dot(half, half_applied)
        )
        offsets.append(add(add(free, mul(row.contact.damping, speed)), spring))
    matrix, offsets = keep((matrix, tuple(offsets)))
    touching = [contact.distance < 0.0 for contact in contacts]

    def contact_forces(
        matrix: tuple[Scalar, ...], offsets: tuple[Scalar, ...]
    ) -> tuple[Scalar, ...]:
        first, *others = model.contacts
        if first.friction is None:
            return normal_forces(touching, matrix, offsets, softnesses)
        if others:
            return coupled_forces(model.contacts, touching, matrix, offsets, softnesses)
        force = pyramid_force(first, matrix, offsets, softnesses[0])
        return tuple(jnp.where(touching[0], f, 0.0) for f in force)

    forces, dry_friction = joint_friction.contact_and_friction(
        model.links,
        factor,
        joint_velocity,
        half_applied,
        halves,
        matrix,
        offsets,
        contact_forces,
    )
    forces = keep(forces)
    columns = zip(*(row.joints for row in rows), strict=True)
    torque = [add(dot(c, forces), f) for c, f in zip(columns, dry_friction, strict=True)]
    return torque, *_ball_accelerations(model, rows, forces)


def paddle_origin(model: FusedModel, pose: chain.Pose) -> Vec:
    """Centre of the paddle in the world, m."""
    return pose.world_origin[-1] + pose.world_rotation[-1] @ model.paddle_origin


def _contacts(
    model: FusedModel, pose: chain.Pose, positions: Sequence[Vec]
) -> list[geometry.Contact]:
    """Geometry of each of `FusedModel.contacts`; `positions` are the balls'."""
    origin = paddle_origin(model, pose)
    rotation = pose.world_rotation[-1] @ model.paddle_rotation
    contacts = []
    for pair in model.contacts:
        centres = [positions[i] for i in pair.balls]
        radii = [model.balls[i].radius for i in pair.balls]
        contacts.append(
            geometry.sphere_box(*radii, *centres, model.paddle_half_size, origin, rotation)
            if len(pair.balls) == 1
            else geometry.sphere_sphere(*radii, *centres)
        )
    return contacts


def _rows(
    model: FusedModel,
    pose: chain.Pose,
    pair: geometry.ContactModel,
    contact: geometry.Contact,
    positions: Sequence[Vec],
    keep: Keep,
) -> list[Row]:
    """The rows of a contact: the normal, and with friction the first and second tangent;
    `positions` are the balls'."""
    normal, point = contact.normal, positions[pair.balls[0]]
    axes, torques = [normal], [{}]
    if pair.friction is not None:
        first, second = keep(geometry.tangents(normal))
        # From the contact point, midway between the surfaces, to each ball's centre.
        levers = {i: model.balls[i].radius + 0.5 * contact.distance for i in pair.balls}
        axes += first, second
        torques.append({i: second * -lever for i, lever in levers.items()})
        torques.append({i: first * lever for i, lever in levers.items()})
        point = point - normal * levers[pair.balls[0]]
    joints = [[0.0] * len(model.links)] * len(axes)
    if len(pair.balls) == 1:
        # A force along the normal has the same torque at the ball's centre.
        columns = list(chain.point_velocities(model.links, pose, point))
        joints = keep([[axis @ column for column in columns] for axis in map(operator.neg, axes)])
    return [Row(pair, *own) for own in zip(axes, torques, joints, strict=True)]


def _by_balls(model: FusedModel, a: Row, b: Row) -> Scalar:
    """Share of the balls' inertia in an entry of J M^-1 J^T, 1/kg."""
    share: Scalar = 0.0
    if a.contact is b.contact and a is not b:
        return share
    for i, sign in geometry.shared_balls(a.contact, b.contact):
        along = 1.0 if a is b else a.axis @ b.axis
        share = add(share, mul(along, sign / model.balls[i].mass))
        if a.torques and b.torques:
            share = add(share, a.torques[i] @ b.torques[i] / model.balls[i].inertia)
    return share


def _ball_accelerations(
    model: FusedModel, rows: Sequence[Row], forces: Sequence[Scalar]
) -> tuple[list[Vec], list[Vec]]:
    """Accelerations and angular accelerations of the balls by the contacts' forces."""
    along, turning = [ZERO3] * len(model.balls), [ZERO3] * len(model.balls)
    for row, force in zip(rows, forces, strict=True):
        for i in row.contact.balls:
            push = mul(force, geometry.side(row.contact, i) / model.balls[i].mass)
            along[i] = along[i] + row.axis * push
        for i, torque in row.torques.items():
            turning[i] = turning[i] + torque * mul(force, 1.0 / model.balls[i].inertia)
    return along, turning
