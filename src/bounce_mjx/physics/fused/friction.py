"""Contact force with sliding friction (`condim="3"`), as MuJoCo computes it.

Sources: MuJoCo's documentation, "Computation" (constraint model: friction cones, the dual problem,
impedance, diagonal regulariser), and its source code for the regulariser. The force f along the
normal and the two tangents minimises

    1/2 f.(J M^-1 J^T + R) f + f.(J a0 - aref)    over the pyramidal friction cone

with a0 the acceleration without the contact. In units of the cone, x = (f_n, f_1 / mu_1,
f_2 / mu_2), it consists of the nonnegative combinations of the four edges (1, +-1, 0), (1, 0, +-1).
The solver runs the same operations in every state, so that the threads of a GPU kernel do not
diverge.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from bounce_mjx.physics.fused import chain, joint_friction
from bounce_mjx.physics.fused.contact import (
    Contact,
    ContactModel,
    impedance,
    relative,
    shared,
    side,
    softness,
)
from bounce_mjx.physics.fused.coupled import coupled_forces, edge_regulariser
from bounce_mjx.physics.fused.model import FusedModel
from bounce_mjx.physics.fused.scalars import (
    ZERO3,
    Quaternion,
    Scalar,
    Vec3,
    add,
    cross,
    dot,
    matvec,
    mul,
    neg,
    quaternion_matrix,
    quaternion_product,
    scale,
    sine_cosine,
    stored,
    transpose,
    vadd,
    vsub,
)


class Turning(NamedTuple):
    """Spin and orientation of the ball."""

    spin: Vec3
    """Angular velocity in the world, rad/s. Without a torque it is constant for a sphere, both in
    the world and in the ball's frame."""
    orientation: Quaternion
    """Unit quaternion w, x, y, z."""


class Response(NamedTuple):
    """Effect of the contacts' forces and of dry friction on the joints and the balls."""

    joint_torque: list[Scalar]
    """Joint torques of both, N m."""
    ball_accelerations: list[Vec3]
    """Acceleration of each ball by the contacts alone, m/s^2."""
    spin_accelerations: list[Vec3]
    """Angular acceleration of each ball in the world, rad/s^2."""


class Touch(NamedTuple):
    """A contact with its frame, in which a force has the components normal, first and second
    tangent."""

    model: ContactModel
    distance: jax.Array
    """Gap between the surfaces, m."""
    axes: tuple[Vec3, Vec3, Vec3]
    """The frame's unit vectors."""
    levers: dict[int, Scalar]
    """Distance from the contact point, midway between the surfaces, to each ball's centre, m."""
    torques: dict[int, tuple[Vec3, Vec3]]
    """Torques on each ball from unit forces along the tangents, m."""
    rows: list[list[Scalar]]
    """Jacobian [3, n] of the joints."""


class ConeProblem(NamedTuple):
    """Objective 1/2 x.Q x + c.x in units of the cone, without the regulariser."""

    q: tuple[Scalar, ...]
    """Entries Q00, Q01, Q02, Q11, Q12, Q22, 1/kg."""
    c: Vec3
    """Linear term, m/s^2."""


def contact_response(
    model: FusedModel,
    pose: chain.Pose,
    factor: tuple[chain.SquareMatrix, list[jax.Array]],
    contacts: Sequence[Contact],
    joint_velocity: Sequence[Scalar],
    half_applied: Sequence[Scalar],
    balls: Sequence[tuple[Vec3, Vec3, Vec3]],
    free_accelerations: Sequence[Vec3],
) -> Response:
    """Effect of the contacts' forces and of dry friction on the joints and the balls.

    Args:
      factor: Cholesky factor L of the arm's inertia matrix.
      contacts: geometry of each of the model's contacts.
      half_applied: L^-1 times the joint torques without the contacts and dry friction.
      balls: position, velocity and spin of each in the world.
      free_accelerations: the balls' accelerations without the contacts.
    """
    positions, velocities, spins = zip(*balls, strict=True)
    touches = [
        _touch(model, pose, pair, contact, positions)
        for pair, contact in zip(model.contacts, contacts, strict=True)
    ]
    halves = [[chain.solve_lower(factor, row) for row in touch.rows] for touch in touches]
    halves, half_applied = stored((halves, list(half_applied)))
    matrix = _matrix(model, touches, halves)
    impedances = [impedance(touch.model, touch.distance) for touch in touches]
    offsets = []
    for touch, half, d in zip(touches, halves, impedances, strict=True):
        velocity = relative(touch.model, velocities), spins, joint_velocity
        free = relative(touch.model, free_accelerations), half_applied
        offsets += _offsets(touch, half, d, velocity, free)
    matrix, offsets = stored((matrix, tuple(offsets)))
    softnesses = [softness(t.model, d) for t, d in zip(touches, impedances, strict=True)]

    def forces_of(matrix: tuple[Scalar, ...], offsets: tuple[Scalar, ...]) -> tuple[Scalar, ...]:
        touching = [touch.distance < 0.0 for touch in touches]
        if len(touches) > 1:
            return coupled_forces(model.contacts, touching, matrix, offsets, softnesses)
        force = contact_force(model.contacts[0], matrix, offsets, softnesses[0])
        return tuple(jnp.where(touching[0], f, 0.0) for f in force)

    forces, dry_friction = joint_friction.contact_and_friction(
        model.links,
        factor,
        joint_velocity,
        half_applied,
        [row for half in halves for row in half],
        matrix,
        offsets,
        forces_of,
    )
    forces = stored(forces)
    rows = [row for touch in touches for row in touch.rows]
    torque = [
        add(dot(column, forces), f)
        for column, f in zip(zip(*rows, strict=True), dry_friction, strict=True)
    ]
    return Response(torque, *_ball_accelerations(model, touches, forces))


def _touch(
    model: FusedModel,
    pose: chain.Pose,
    pair: ContactModel,
    contact: Contact,
    positions: Sequence[Vec3],
) -> Touch:
    """A contact with its frame; `positions` are the balls'."""
    contact = stored(contact)
    normal = contact.normal
    first, second = stored(tangents(normal))
    axes = normal, first, second
    levers = {i: model.balls[i].radius + 0.5 * contact.distance for i in pair.balls}
    torques = {i: (scale(second, -lever), scale(first, lever)) for i, lever in levers.items()}
    rows = [[0.0] * len(model.links)] * 3
    if len(pair.balls) == 1:
        ball = pair.balls[0]
        point = vsub(positions[ball], scale(normal, levers[ball]))
        columns = list(chain.point_velocities(model.links, pose, point))
        rows = stored([[neg(dot(axis, column)) for column in columns] for axis in axes])
    return Touch(pair, contact.distance, axes, levers, torques, rows)


def _matrix(
    model: FusedModel, touches: Sequence[Touch], halves: Sequence[Sequence[Sequence[Scalar]]]
) -> tuple[Scalar, ...]:
    """J M^-1 J^T of all contacts, the upper triangle row by row, 1/kg.

    Args:
      halves: L^-1 J^T [3, n] of each contact.
    """
    components = [(k, a) for k in range(len(touches)) for a in range(3)]
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
    for i, sign in shared(first.model, second.model):
        ball = model.balls[i]
        if first is not second:
            share = add(share, mul(dot(first.axes[a], second.axes[b]), sign / ball.mass))
            if a > 0 and b > 0:
                turning = dot(first.torques[i][a - 1], second.torques[i][b - 1])
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
    velocity: tuple[Vec3, Sequence[Vec3], Sequence[Scalar]],
    free: tuple[Vec3, Sequence[Scalar]],
) -> Vec3:
    """J a0 - aref of a contact, m/s^2.

    Args:
      half: L^-1 J^T [3, n].
      d: impedance.
      velocity: relative velocity of the balls' centres, spins of the balls, and joint velocities.
      free: relative acceleration without the contacts, and `half_applied`.
    """
    model, (along, spins, joint_velocity) = touch.model, velocity
    offsets = []
    for a in range(3):
        speed, acceleration = dot(touch.axes[a], along), dot(touch.axes[a], free[0])
        if a > 0:
            for i, torques in touch.torques.items():
                speed = add(speed, dot(torques[a - 1], spins[i]))
        for j, v, half_j, half_a in zip(
            touch.rows[a], joint_velocity, half[a], free[1], strict=True
        ):
            speed, acceleration = add(speed, mul(j, v)), add(acceleration, mul(half_j, half_a))
        offsets.append(acceleration + model.damping * speed)
    normal, *tangential = offsets
    return normal + model.stiffness * d * touch.distance, *tangential


def _ball_accelerations(
    model: FusedModel, touches: Sequence[Touch], forces: Sequence[Scalar]
) -> tuple[list[Vec3], list[Vec3]]:
    """Accelerations and angular accelerations of the balls by the contacts' forces [3 K]."""
    along, turning = [ZERO3] * len(model.balls), [ZERO3] * len(model.balls)
    for k, touch in enumerate(touches):
        normal, *tangential = forces[3 * k : 3 * k + 3]
        n, t1, t2 = touch.axes
        force = vadd(scale(n, normal), vadd(scale(t1, tangential[0]), scale(t2, tangential[1])))
        for i, (torque_1, torque_2) in touch.torques.items():
            along[i] = vadd(along[i], scale(force, side(touch.model, i)))
            torque = vadd(scale(torque_1, tangential[0]), scale(torque_2, tangential[1]))
            turning[i] = vadd(turning[i], torque)
    return (
        [scale(a, 1.0 / ball.mass) for a, ball in zip(along, model.balls, strict=True)],
        [scale(a, 1.0 / ball.inertia) for a, ball in zip(turning, model.balls, strict=True)],
    )


def tangents(normal: Vec3) -> tuple[Vec3, Vec3]:
    """Tangents of MuJoCo's contact frame (mju_makeFrame), the second up to its sign. The first
    tangent is y, or z if the normal is close to y, made orthogonal to the normal."""
    x, y, z = normal
    from_y = jnp.abs(y) < 0.5
    along = jnp.where(from_y, y, z)
    inverse = lax.rsqrt(1.0 - along * along)
    first = scale(
        (
            -x * along,
            jnp.where(from_y, 1.0, 0.0) - y * along,
            jnp.where(from_y, 0.0, 1.0) - z * along,
        ),
        inverse,
    )
    return first, cross(normal, first)


def contact_force(
    model: ContactModel, matrix: tuple[Scalar, ...], offsets: Vec3, regulariser: Scalar
) -> Vec3:
    """Force [normal, first and second tangent] (N): the minimum of the objective at
    the top of this file.

    Args:
      matrix: J M^-1 J^T, the entries 00, 01, 02, 11, 12, 22, 1/kg.
      offsets: J a0 - aref, m/s^2.
      regulariser: regulariser of the normal force without friction, 1/kg.
    """
    m1, m2 = model.friction
    units = (1.0, m1, m2)
    pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    problem = ConeProblem(
        tuple(
            mul(entry, mul(units[i], units[j])) for entry, (i, j) in zip(matrix, pairs, strict=True)
        ),
        tuple(map(mul, offsets, units)),
    )
    x = in_pyramidal_cone(problem, edge_regulariser(model, regulariser))
    return tuple(map(mul, x, units))


def in_pyramidal_cone(problem: ConeProblem, regulariser: Scalar) -> Vec3:
    """Minimum x over nonnegative combinations of the four edges, each with a regulariser.

    The first tangent's two edges have four active sets. Each is eliminated in turn, and the second
    tangent's pair of edges is solved in closed form; the solution is the active set with the right
    signs. Sums and differences of the coefficients of a pair avoid cancellation at small friction.
    """
    (q00, q01, q02, q11, q12, q22), (c0, c1, c2) = problem
    h = 0.5 * regulariser

    # Neither edge of the first pair is active.
    s2, t2 = _pair(q00, q02, q22, c0, c2, regulariser)
    push = c0 + q00 * s2 + q02 * t2
    pull = c1 + q01 * s2 + q12 * t2
    none = (s2, jnp.zeros_like(t2), t2), push - jnp.abs(pull)

    # Both edges are active.
    k00, k11 = q00 + h, q11 + h
    i = 1.0 / (k00 * k11 - q01 * q01)
    p00 = h * (q00 * k11 - q01 * q01) * i
    p02 = h * (k11 * q02 - q01 * q12) * i
    p22 = q22 - (k11 * q02 * q02 - 2.0 * q01 * q02 * q12 + k00 * q12 * q12) * i
    g0 = h * (k11 * c0 - q01 * c1) * i
    g2 = c2 - (k11 * q02 * c0 - q01 * (q02 * c1 + q12 * c0) + k00 * q12 * c1) * i
    s2, t2 = _pair(p00, p02, p22, g0, g2, regulariser)
    push = c0 + q00 * s2 + q02 * t2
    pull = c1 + q01 * s2 + q12 * t2
    s1 = (q01 * pull - k11 * push) * i
    t1 = (q01 * push - k00 * pull) * i
    both = (s1 + s2, t1, t2), (s1 - jnp.abs(t1)) * q00

    # One edge is active: the first, or its opposite.
    def one(i: jax.Array, best: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        sign = 1.0 - 2.0 * lax.convert_element_type(i, q01.dtype)
        q_01, q_12, c_1 = sign * q01, sign * q12, sign * c1
        r0, r2, g = q00 + q_01, q02 + q_12, c0 + c_1
        rest = q_01 + q11 + regulariser
        inverse = 1.0 / (r0 + rest)
        s2, t2 = _pair(
            (q00 * (q11 + regulariser) - q01 * q01) * inverse,
            (q02 * rest - q_12 * r0) * inverse,
            q22 - r2 * r2 * inverse,
            (c0 * rest - c_1 * r0) * inverse,
            c2 - r2 * g * inverse,
            regulariser,
        )
        lack = g + r0 * s2 + r2 * t2
        f = -lack * inverse
        n = s2 + f
        other = (c0 + q00 * n + q_01 * f + q02 * t2) - (c_1 + q_01 * n + q11 * f + q_12 * t2)
        return _better(best, ((n, sign * f, t2), jnp.minimum(-lack, other)))

    return lax.fori_loop(0, 2, one, _better(none, both))[0]


def _better(a: tuple[Vec3, jax.Array], b: tuple[Vec3, jax.Array]) -> tuple[Vec3, jax.Array]:
    """The candidate with the higher score."""
    (x, x_score), (y, y_score) = a, b
    chosen = tuple(jnp.where(y_score > x_score, j, i) for i, j in zip(x, y, strict=True))
    return chosen, jnp.maximum(x_score, y_score)


def _pair(p00, p02, p22, g0, g2, regulariser) -> tuple[jax.Array, jax.Array]:
    """Sum s and difference t of the nonnegative coefficients of the edges (1, 1) and (1, -1)."""
    h = 0.5 * regulariser
    k00, k22 = p00 + h, p22 + h
    inverse_determinant = 1.0 / (k00 * k22 - p02 * p02)
    s = (p02 * g2 - k22 * g0) * inverse_determinant
    t = (p02 * g0 - k00 * g2) * inverse_determinant
    both = s >= jnp.abs(t)
    diagonal, off = p00 + p22 + regulariser, p00 - p22
    plus = jnp.maximum(-(g0 + g2) / (diagonal + 2.0 * p02), 0.0)
    minus = jnp.maximum(-(g0 - g2) / (diagonal - 2.0 * p02), 0.0)
    # One edge is active: the one that leaves the larger gradient on the other.
    first = g0 - g2 + off * plus >= g0 + g2 + off * minus
    s_one = jnp.where(first, plus, minus)
    t_one = jnp.where(first, plus, -minus)
    return jnp.where(both, s, s_one), jnp.where(both, t, t_one)


def _tiny(x: jax.Array) -> float:
    return float(jnp.finfo(x.dtype).tiny)


def turning_of(quaternion: Quaternion, spin: Vec3) -> Turning:
    """Spin in the world and normalised orientation from MuJoCo's coordinates."""
    w, x, y, z = quaternion
    inverse_norm = lax.rsqrt(w * w + x * x + y * y + z * z)
    quaternion = tuple(c * inverse_norm for c in quaternion)
    return Turning(matvec(quaternion_matrix(quaternion), spin), quaternion)


def spin_in_ball(turning: Turning) -> Vec3:
    """Spin in the ball's frame, MuJoCo's coordinates."""
    matrix = quaternion_matrix(turning.orientation)
    return matvec(transpose(matrix), turning.spin)


def turned(turning: Turning, acceleration: Vec3, dt: float) -> Turning:
    """Spin and orientation one step later; the new spin turns the orientation."""
    spin = vadd(turning.spin, scale(acceleration, dt))
    squared = dot(spin, spin)
    still = squared < _tiny(squared)
    inverse_speed = lax.rsqrt(jnp.where(still, 1.0, squared))
    sine, cosine = sine_cosine(0.5 * dt * (squared * inverse_speed))
    rotation = (cosine, *scale(spin, sine * inverse_speed))
    return Turning(spin, quaternion_product(rotation, turning.orientation))
