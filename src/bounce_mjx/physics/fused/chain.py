"""Rigid-body dynamics of a serial chain of hinges and slides, unrolled into scalar arithmetic.

Quantities of link i are in the frame of link i, unless their names or docstrings say otherwise: the
pose of a link (`offset`, `rotation`) is in its parent's frame. The origin of the frame is on the
axis of joint i and moves with the link. Joint forces are torques (N m) of hinges
and forces (N) of slides. Source: Featherstone, Rigid Body Dynamics Algorithms (2008), table 5.1
(recursive Newton-Euler) and table 6.2 (composite rigid bodies), in three-dimensional form.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from bounce_mjx.physics.scalars import (
    IDENTITY3,
    ZERO3,
    ZERO_MATRIX3,
    Mat,
    Scalar,
    Vec,
    add,
    axis_rotation,
    congruence,
    cross,
    dot,
    inverse_root,
    is_zero,
    mul,
    sine_cosine,
    sub,
    symmetric,
)

SquareMatrix = list[list[Scalar]]
Factor = tuple[SquareMatrix, list[Scalar]]
"""A lower Cholesky factor, and the reciprocals of its diagonal."""


@dataclasses.dataclass(frozen=True)
class Link:
    """One joint and the bodies that move with it."""

    offset: Vec
    """Origin of the link in the frame of its parent at the joint position `zero_position`, m."""
    rotation: Mat
    """Orientation of the link in the frame of its parent at the joint position `zero_position`."""
    axis: Vec
    """Unit axis of the joint."""
    slides: bool
    """Whether the joint is a slide, not a hinge."""
    zero_position: Scalar
    """Joint position at which `offset` and `rotation` hold, rad or m."""
    mass: Scalar
    """Mass, kg."""
    first_moment: Vec
    """Mass times centre of mass, kg m."""
    inertia: Mat
    """Rotational inertia about the origin of the link, kg m^2."""
    armature: Scalar
    """Rotor inertia reflected to the joint, kg m^2 or kg."""
    damping: Scalar
    """Viscous damping of the joint, N m s/rad or N s/m."""
    stiffness: Scalar = 0.0
    """Stiffness of the joint's spring, N m/rad or N/m."""
    spring_position: Scalar = 0.0
    """Joint position at which the spring is at rest, rad or m."""
    frictionloss: Scalar = 0.0
    """Largest force of the joint's dry friction, N m or N."""
    friction_regulariser: float = 0.0
    """Regulariser R of the dry friction, 1/(kg m^2) or 1/kg."""
    friction_damping: float = 0.0
    """b of the dry friction's reference acceleration, 1/s."""
    floating_mass: Scalar = 0.0
    """Mass whose weight `gravcomp` carries, kg."""
    floating_moment: Vec = ZERO3
    """First moment of this mass, kg m."""


class Pose(NamedTuple):
    """Poses of all links."""

    rotation: list[Mat]
    """Orientation of each link in its parent's frame."""
    world_rotation: list[Mat]
    """Orientation of each link in the world."""
    world_origin: list[Vec]
    """Origin of each link in the world, m."""
    offset: list[Vec]
    """Origin of each link in its parent's frame, m."""


def forward_kinematics(links: Sequence[Link], q: Sequence[Scalar]) -> Pose:
    """Pose of every link at the joint positions q (rad, m)."""
    pose = Pose(rotation=[], world_rotation=[], world_origin=[], offset=[])
    parent_rotation = IDENTITY3
    parent_origin = ZERO3
    for link, position in zip(links, q, strict=True):
        displacement = sub(position, link.zero_position)
        rotation = link.rotation
        offset = link.offset
        if link.slides:
            offset = offset + (rotation @ link.axis) * displacement
        else:
            sine, cosine = sine_cosine(displacement)
            rotation = rotation @ axis_rotation(link.axis, cosine, sine)
        parent_origin = parent_origin + parent_rotation @ offset
        parent_rotation = parent_rotation @ rotation
        pose.rotation.append(rotation)
        pose.offset.append(offset)
        pose.world_rotation.append(parent_rotation)
        pose.world_origin.append(parent_origin)
    return pose


def bias_force(
    links: Sequence[Link], pose: Pose, v: Sequence[Scalar], gravity: Vec
) -> list[Scalar]:
    """Joint forces that balance gravity, Coriolis and centrifugal effects at zero joint
    acceleration: recursive Newton-Euler, with gravity as an acceleration of the base."""
    # Outwards: motion of each link, and the force and moment that it needs.
    omega = ZERO3
    alpha = ZERO3
    acceleration = -gravity
    forces = []
    moments = []
    for link, rotation, offset, speed in zip(links, pose.rotation, pose.offset, v, strict=True):
        to_link = rotation.T
        about_parent = cross(alpha, offset) + cross(omega, cross(omega, offset))
        omega_of_parent = to_link @ omega
        alpha_of_parent = to_link @ alpha
        acceleration = to_link @ (acceleration + about_parent)
        joint_motion = link.axis * speed
        if link.slides:
            omega = omega_of_parent
            alpha = alpha_of_parent
            acceleration = acceleration + cross(omega_of_parent, joint_motion) * 2.0
        else:
            omega = omega_of_parent + joint_motion
            alpha = alpha_of_parent + cross(omega_of_parent, joint_motion)
        first_moment = link.first_moment
        about_origin = cross(alpha, first_moment) + cross(omega, cross(omega, first_moment))
        forces.append(acceleration * link.mass + about_origin)
        turning = link.inertia @ alpha + cross(omega, link.inertia @ omega)
        moments.append(turning + cross(first_moment, acceleration))

    # Inwards: each joint carries its link and all links behind it.
    joint_forces: list[Scalar] = [0.0] * len(links)
    force = ZERO3
    moment = ZERO3
    for i in reversed(range(len(links))):
        force = forces[i] + force
        moment = moments[i] + moment
        joint_forces[i] = _along_joint(links[i], force, moment)
        force, moment = _to_parent(pose.rotation[i], pose.offset[i], force, moment)
    return joint_forces


def floating_force(links: Sequence[Link], pose: Pose, gravity: Vec) -> list[Scalar]:
    """Joint forces of MuJoCo's gravity compensation, which carries the weight of each link's
    `floating_mass`."""
    at_rest = [0.0] * len(links)
    if not any(_is_carried(link) for link in links):
        return at_rest
    floating_links = []
    for link in links:
        floating_link = dataclasses.replace(
            link, mass=link.floating_mass, first_moment=link.floating_moment, inertia=ZERO_MATRIX3
        )
        floating_links.append(floating_link)
    return bias_force(floating_links, pose, at_rest, gravity)


def _is_carried(link: Link) -> bool:
    """Whether gravity compensation may act on a link. Shares of either sign can cancel to no mass
    and leave a moment."""
    return not all(is_zero(x) for x in (link.floating_mass, *link.floating_moment))


def mass_matrix(links: Sequence[Link], pose: Pose) -> SquareMatrix:
    """Joint-space inertia matrix [n, n], armature included: composite rigid bodies."""
    n = len(links)
    matrix: SquareMatrix = [[0.0] * n for _ in range(n)]
    mass: Scalar = 0.0
    first_moment = ZERO3
    inertia = ZERO_MATRIX3
    for i in reversed(range(n)):
        link = links[i]
        mass = add(mass, link.mass)
        first_moment = first_moment + link.first_moment
        inertia = inertia + link.inertia

        # What a unit acceleration of the joint needs.
        if link.slides:
            force = link.axis * mass
            moment = cross(first_moment, link.axis)
        else:
            force = cross(link.axis, first_moment)
            moment = inertia @ link.axis
        matrix[i][i] = add(_along_joint(link, force, moment), link.armature)
        for j in range(i, 0, -1):
            force, moment = _to_parent(pose.rotation[j], pose.offset[j], force, moment)
            matrix[i][j - 1] = matrix[j - 1][i] = _along_joint(links[j - 1], force, moment)
        if i > 0:
            first_moment, inertia = _inertia_to_parent(
                pose.rotation[i], pose.offset[i], mass, first_moment, inertia
            )
    return matrix


def point_velocities(links: Sequence[Link], pose: Pose, point: Vec) -> Iterator[Vec]:
    """Velocity of a point fixed to the last link, per unit velocity of each joint; all in the
    world."""
    for link, rotation, origin in zip(links, pose.world_rotation, pose.world_origin, strict=True):
        axis = rotation @ link.axis
        yield axis if link.slides else cross(axis, point - origin)


def cholesky(matrix: SquareMatrix) -> Factor:
    """Lower Cholesky factor of a symmetric positive definite matrix, and the reciprocals of its
    diagonal."""
    n = len(matrix)
    triangle: SquareMatrix = [[0.0] * n for _ in range(n)]
    inverse_diagonal = []
    for j in range(n):
        row = triangle[j][:j]
        pivot = sub(matrix[j][j], dot(row, row))
        reciprocal = inverse_root(pivot)
        inverse_diagonal.append(reciprocal)
        for i in range(j + 1, n):
            triangle[i][j] = mul(sub(matrix[i][j], dot(triangle[i][:j], row)), reciprocal)
    return triangle, inverse_diagonal


def solve_lower(factor: Factor, b: Sequence[Scalar]) -> list[Scalar]:
    """L^-1 b for the factor L of `cholesky`. It is half of the solution M^-1 b = L^-T L^-1 b, and
    the product of two of them is one with M^-1: (L^-1 a).(L^-1 b) = a.M^-1 b. Names with `half`
    hold them."""
    x: list[Scalar] = []
    for row, inverse, entry in zip(*factor, b, strict=True):
        x.append(mul(sub(entry, dot(row[: len(x)], x)), inverse))
    return x


def solve_upper(factor: Factor, b: Sequence[Scalar]) -> list[Scalar]:
    """L^-T b for the factor L of `cholesky`."""
    triangle, inverse_diagonal = factor
    x = list(b)
    for i in reversed(range(len(b))):
        column = [row[i] for row in triangle[i + 1 :]]
        x[i] = mul(sub(x[i], dot(column, x[i + 1 :])), inverse_diagonal[i])
    return x


def _along_joint(link: Link, force: Vec, moment: Vec) -> Scalar:
    """Joint force that a force and its moment about the link's origin exert."""
    return link.axis @ (force if link.slides else moment)


def _to_parent(rotation: Mat, offset: Vec, force: Vec, moment: Vec) -> tuple[Vec, Vec]:
    """A force and its moment about the link's origin, transformed to the parent's frame and
    origin."""
    force = rotation @ force
    return force, rotation @ moment + cross(offset, force)


def _inertia_to_parent(
    rotation: Mat, offset: Vec, mass: Scalar, first_moment: Vec, inertia: Mat
) -> tuple[Vec, Mat]:
    """First moment and inertia of the composite body in the parent's frame, about the parent's
    origin (parallel-axis theorem with the offset p of the link's origin)."""
    p = offset
    h = rotation @ first_moment
    rotated = congruence(rotation, inertia)
    diagonal = add(mul(2.0, p @ h), mul(mass, p @ p))

    def entry(i: int, j: int) -> Scalar:
        off = add(add(mul(p[i], h[j]), mul(p[j], h[i])), mul(mul(mass, p[i]), p[j]))
        return sub(add(rotated[i][j], diagonal if i == j else 0.0), off)

    return h + p * mass, symmetric(entry)
