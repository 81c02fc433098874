"""MuJoCo's contact of a sphere and a box: geometry, impedance and the force without friction.

Sources: MuJoCo's documentation, "Computation" (constraint model: impedance, reference
acceleration, diagonal regulariser), and its collision function for a sphere and a box.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.physics.fused.scalars import Mat3, Scalar, Vec3, dot, matvec, transpose, vsub

# MuJoCo's mjMINVAL: a centre closer to the box counts as inside it.
_MIN_DISTANCE = 1e-15


@dataclasses.dataclass(frozen=True)
class ContactModel:
    """Parameters of the contact pair."""

    radius: Scalar
    """Radius of the sphere, m."""
    half_size: tuple[float, float, float]
    """Half sizes of the box, m."""
    stiffness: Scalar
    """k of the reference acceleration, 1/s^2."""
    damping: Scalar
    """b of the reference acceleration, 1/s."""
    solimp: tuple[float, float, float, float, float]
    """dmin, dmax, width (m), midpoint, power of the impedance."""
    paddle_inverse_weight: float
    """Translational inverse inertia of the paddle's body at the reference pose, 1/kg."""
    ball_inverse_weight: Scalar
    """Translational inverse inertia of the ball, 1/kg."""
    friction: tuple[Scalar, Scalar] | None = None
    """Coefficients of sliding friction along the two tangents; None for a frictionless contact."""
    elliptic: bool = False
    """Shape of the friction cone: elliptic if true, pyramidal if false."""
    impratio: float = 1.0
    """Ratio of the tangential to the normal impedance (the option `impratio`)."""
    tangent_damping: float | None = None
    """b of the reference acceleration along the tangents, 1/s; None if equal to `damping`."""


class Contact(NamedTuple):
    """Geometry of a contact."""

    distance: jax.Array
    """Gap between the surfaces, negative when they overlap, m."""
    normal: Vec3
    """Unit vector in the world from the box to the sphere."""


def sphere_box(model: ContactModel, centre: Vec3, box_origin: Vec3, box_rotation: Mat3) -> Contact:
    """Contact at the box's nearest point; for a centre inside the box, at its nearest face."""
    local = matvec(transpose(box_rotation), vsub(centre, box_origin))
    half = model.half_size
    offset = tuple(x - jnp.clip(x, -s, s) for x, s in zip(local, half, strict=True))
    squared = dot(offset, offset)
    outside = squared > _MIN_DISTANCE**2
    inverse = jax.lax.rsqrt(jnp.where(outside, squared, 1.0))

    # MuJoCo takes the first of equally near faces, in the order -x, +x, -y, +y, -z, +z.
    depth = tuple(s - jnp.abs(x) for x, s in zip(local, half, strict=True))
    x_nearest = (depth[0] <= depth[1]) & (depth[0] <= depth[2])
    y_nearest = ~x_nearest & (depth[1] <= depth[2])
    nearest = (x_nearest, y_nearest, ~(x_nearest | y_nearest))
    face = tuple(
        jnp.where(near, jnp.where(x > 0.0, 1.0, -1.0), 0.0)
        for near, x in zip(nearest, local, strict=True)
    )
    face_depth = jnp.minimum(jnp.minimum(depth[0], depth[1]), depth[2])

    normal = tuple(jnp.where(outside, x * inverse, f) for x, f in zip(offset, face, strict=True))
    distance = jnp.where(outside, squared * inverse, -face_depth) - model.radius
    return Contact(distance, matvec(box_rotation, normal))


def impedance(model: ContactModel, distance: jax.Array) -> jax.Array:
    """d(r) of MuJoCo's solimp at the penetration r = |distance|, in (0, 1)."""
    dmin, dmax, width, midpoint, power = model.solimp
    x = jnp.clip(jnp.abs(distance) / width, 0.0, 1.0)
    if power == 1.0:
        y = x
    else:
        rising = x**power / midpoint ** (power - 1.0)
        settling = 1.0 - (1.0 - x) ** power / (1.0 - midpoint) ** (power - 1.0)
        y = jnp.where(x <= midpoint, rising, settling)
    return dmin + y * (dmax - dmin)


def softness(model: ContactModel, d: jax.Array) -> jax.Array:
    """Regulariser (1/kg) of the normal force at the impedance d."""
    return (1.0 - d) / d * (model.paddle_inverse_weight + model.ball_inverse_weight)


def normal_force(
    model: ContactModel,
    contact: Contact,
    normal_velocity: Scalar,
    free_acceleration: Scalar,
    inverse_inertia: Scalar,
) -> jax.Array:
    """Force (N) along the normal: the exact solution of MuJoCo's constraint problem
    with one inequality.

    Args:
      normal_velocity: velocity of the sphere relative to the box along the normal, m/s.
      free_acceleration: acceleration along the normal without the contact, m/s^2.
      inverse_inertia: J M^-1 J^T of the contact, 1/kg.
    """
    d = impedance(model, contact.distance)
    reference = -model.damping * normal_velocity - model.stiffness * d * contact.distance
    regulariser = softness(model, d)
    force = (reference - free_acceleration) / (inverse_inertia + regulariser)
    return jnp.where(contact.distance < 0.0, jnp.maximum(force, 0.0), 0.0)
