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
from bounce_mjx.physics.fused.contact import (
    Contact,
    ContactModel,
    impedance,
    relative,
    shared_balls,
    side,
    softness,
    sphere_box,
    sphere_sphere,
    tangents,
)
from bounce_mjx.physics.fused.coupled import coupled_forces
from bounce_mjx.physics.fused.model import FusedModel
from bounce_mjx.physics.fused.normals import normal_forces
from bounce_mjx.physics.fused.pyramid import pyramid_force
from bounce_mjx.physics.scalars import ZERO3, Scalar, Vec, add, dot, mul

Keep = Callable[[Any], Any]
"""`not_inlined`, or the identity."""


class Response(NamedTuple):
    """Effect of the contacts' forces and of dry friction on the joints and the balls."""

    joint_torque: list[Scalar]
    """Joint torques of both, N m."""
    ball_accelerations: list[Vec]
    """Acceleration of each ball by the contacts alone, m/s^2."""
    spin_accelerations: list[Vec]
    """Angular acceleration of each ball in the world, rad/s^2."""


class Touch(NamedTuple):
    """A contact with its r rows: the normal, and with friction the first and second tangent."""

    model: ContactModel
    distance: jax.Array
    """Gap between the surfaces, m."""
    axes: tuple[Vec, ...]
    """The rows' unit vectors [r] in the world."""
    levers: dict[int, Scalar]
    """Distance from the contact point, midway between the surfaces, to each ball's centre, m; only
    with friction."""
    torques: dict[int, tuple[Vec, ...]]
    """Torques on each ball from unit forces along the tangents, m."""
    rows: list[list[Scalar]]
    """Jacobian [r, n] of the joints."""


def contact_response(
    model: FusedModel,
    pose: chain.Pose,
    factor: tuple[chain.SquareMatrix, list[jax.Array]],
    joint_velocity: Sequence[Scalar],
    half_applied: Sequence[Scalar],
    balls: Sequence[tuple[Vec, Vec, Vec | None]],
    free_accelerations: Sequence[Vec],
    keep: Keep,
) -> Response:
    """Effect of the contacts' forces and of dry friction on the joints and the balls.

    Args:
      factor: Cholesky factor L of the arm's inertia matrix.
      half_applied: L^-1 times the joint torques without the contacts and dry friction.
      balls: position, velocity and spin of each in the world; a spin may be None without friction.
      free_accelerations: the balls' accelerations without the contacts.
    """
    positions, velocities, spins = zip(*balls, strict=True)
    touches = [
        _touch(model, pose, pair, keep(contact), positions, keep)
        for pair, contact in zip(model.contacts, _contacts(model, pose, positions), strict=True)
    ]
    halves = [[chain.solve_lower(factor, row) for row in touch.rows] for touch in touches]
    halves, half_applied = keep((halves, list(half_applied)))
    matrix = _matrix(model, touches, halves)
    impedances = [impedance(touch.model, touch.distance) for touch in touches]
    offsets = []
    for touch, half, d in zip(touches, halves, impedances, strict=True):
        velocity = relative(touch.model, velocities), spins, joint_velocity
        free = relative(touch.model, free_accelerations), half_applied
        offsets += _offsets(touch, half, d, velocity, free)
    matrix, offsets = keep((matrix, tuple(offsets)))
    softnesses = [softness(t.model, d) for t, d in zip(touches, impedances, strict=True)]
    touching = [touch.distance < 0.0 for touch in touches]

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
        [row for half in halves for row in half],
        matrix,
        offsets,
        contact_forces,
    )
    forces = keep(forces)
    columns = zip(*(row for touch in touches for row in touch.rows), strict=True)
    torque = [add(dot(c, forces), f) for c, f in zip(columns, dry_friction, strict=True)]
    return Response(torque, *_ball_accelerations(model, touches, forces))


def paddle_origin(model: FusedModel, pose: chain.Pose) -> Vec:
    """Centre of the paddle in the world, m."""
    return pose.world_origin[-1] + pose.world_rotation[-1] @ model.paddle_origin


def _contacts(model: FusedModel, pose: chain.Pose, positions: Sequence[Vec]) -> list[Contact]:
    """Geometry of each of `FusedModel.contacts`; `positions` are the balls'."""
    origin = paddle_origin(model, pose)
    rotation = pose.world_rotation[-1] @ model.paddle_rotation
    contacts = []
    for pair in model.contacts:
        centres = [positions[i] for i in pair.balls]
        radii = [model.balls[i].radius for i in pair.balls]
        contacts.append(
            sphere_box(*radii, *centres, model.paddle_half_size, origin, rotation)
            if len(pair.balls) == 1
            else sphere_sphere(*radii, *centres)
        )
    return contacts


def _touch(
    model: FusedModel,
    pose: chain.Pose,
    pair: ContactModel,
    contact: Contact,
    positions: Sequence[Vec],
    keep: Keep,
) -> Touch:
    """A contact with its rows; `positions` are the balls'."""
    normal = contact.normal
    axes, levers, torques = (normal,), {}, {}
    if pair.friction is not None:
        first, second = keep(tangents(normal))
        axes = normal, first, second
        levers = {i: model.balls[i].radius + 0.5 * contact.distance for i in pair.balls}
        torques = {i: (second * -lever, first * lever) for i, lever in levers.items()}
    rows = [[0.0] * len(model.links)] * len(axes)
    if len(pair.balls) == 1:
        # A force along the normal has the same torque at the ball's centre.
        point = positions[pair.balls[0]]
        for lever in levers.values():
            point = point - normal * lever
        columns = list(chain.point_velocities(model.links, pose, point))
        rows = keep([[axis @ column for column in columns] for axis in map(operator.neg, axes)])
    return Touch(pair, contact.distance, axes, levers, torques, rows)


def _matrix(
    model: FusedModel, touches: Sequence[Touch], halves: Sequence[Sequence[Sequence[Scalar]]]
) -> tuple[Scalar, ...]:
    """J M^-1 J^T of all contacts, the upper triangle row by row, 1/kg.

    Args:
      halves: L^-1 J^T [r, n] of each contact.
    """
    components = [(k, a) for k, touch in enumerate(touches) for a in range(len(touch.axes))]
    return tuple(
        add(dot(halves[k][a], halves[m][b]), _by_balls(model, (touches[k], a), (touches[m], b)))
        for i, (k, a) in enumerate(components)
        for m, b in components[i:]
    )


def _by_balls(model: FusedModel, one: tuple[Touch, int], other: tuple[Touch, int]) -> Scalar:
    """Share of the balls' inertia in an entry of `_matrix`, of a component of one contact and a
    component of another."""
    (first, a), (second, b) = one, other
    share: Scalar = 0.0
    for i, sign in shared_balls(first.model, second.model):
        ball = model.balls[i]
        if first is not second:
            share = add(share, mul(first.axes[a] @ second.axes[b], sign / ball.mass))
            if a > 0 and b > 0:
                turning = first.torques[i][a - 1] @ second.torques[i][b - 1]
                share = add(share, turning / ball.inertia)
        elif a == b:
            share = add(share, 1.0 / ball.mass)
            if a > 0:
                share = add(share, first.levers[i] * first.levers[i] / ball.inertia)
    return share


def _offsets(
    touch: Touch,
    half: Sequence[Sequence[Scalar]],
    d: Scalar,
    velocity: tuple[Vec, Sequence[Vec | None], Sequence[Scalar]],
    free: tuple[Vec, Sequence[Scalar]],
) -> list[Scalar]:
    """J a0 - aref [r] of a contact, m/s^2.

    Args:
      half: L^-1 J^T [r, n].
      d: impedance.
      velocity: relative velocity of the balls' centres, spins of the balls, and joint velocities.
      free: relative acceleration without the contacts, and `half_applied`.
    """
    model, (along, spins, joint_velocity) = touch.model, velocity
    offsets = []
    for a, axis in enumerate(touch.axes):
        speed, acceleration = axis @ along, axis @ free[0]
        if a > 0:
            for i, torques in touch.torques.items():
                speed = add(speed, torques[a - 1] @ spins[i])
        speed = add(speed, dot(touch.rows[a], joint_velocity))
        acceleration = add(acceleration, dot(half[a], free[1]))
        offsets.append(add(acceleration, mul(model.damping, speed)))
    offsets[0] = add(offsets[0], mul(mul(model.stiffness, d), touch.distance))
    return offsets


def _ball_accelerations(
    model: FusedModel, touches: Sequence[Touch], forces: Sequence[Scalar]
) -> tuple[list[Vec], list[Vec]]:
    """Accelerations and angular accelerations of the balls by the contacts' forces."""
    along, turning = [ZERO3] * len(model.balls), [ZERO3] * len(model.balls)
    remaining = iter(forces)
    for touch in touches:
        own = [next(remaining) for _ in touch.axes]
        for i in touch.model.balls:
            ball = model.balls[i]
            for axis, force in zip(touch.axes, own, strict=True):
                push = mul(force, side(touch.model, i) / ball.mass)
                along[i] = along[i] + axis * push
            for torque, force in zip(touch.torques.get(i, ()), own[1:], strict=True):
                turning[i] = turning[i] + torque * mul(force, 1.0 / ball.inertia)
    return along, turning
