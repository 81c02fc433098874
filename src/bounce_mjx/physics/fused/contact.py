"""MuJoCo's contacts of a ball with the paddle or another ball: geometry and impedance.

Sources: MuJoCo's documentation, "Computation" (constraint model: impedance, reference
acceleration, diagonal regulariser), and its collision functions.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from bounce_mjx.physics.scalars import Mat, Scalar, Vec, add, dot

# MuJoCo's mjMINVAL: a centre closer to the box counts as inside it.
_MIN_DISTANCE = 1e-15


@dataclasses.dataclass(frozen=True)
class ContactModel:
    """Parameters of a contact pair."""

    balls: tuple[int, ...]
    """The ball that touches the paddle, or the two balls that touch."""
    stiffness: Scalar
    """k of the reference acceleration, with the dmax of `solimp`, 1/s^2."""
    damping: Scalar
    """b of the reference acceleration, with the dmax of `solimp`, 1/s."""
    solimp: tuple[float, float, float, float, float | int]
    """dmin, dmax, width (m), midpoint, power of the impedance; the power is an int where it is
    whole, as a product costs less than a power."""
    inverse_weights: tuple[Scalar, Scalar]
    """Translational inverse inertia at the reference pose, 1/kg: of the paddle's body or the first
    ball, and of the last ball."""
    friction: Scalar | None = None
    """Coefficient of sliding friction (`fused.friction`); None for a frictionless contact."""


class Contact(NamedTuple):
    """Geometry of a contact."""

    distance: jax.Array
    """Gap between the surfaces, negative when they overlap, m."""
    normal: Vec
    """Unit vector in the world from the paddle or the first ball to the last ball."""


def side(pair: ContactModel, ball: int) -> float:
    """Sign with which a ball's velocity counts in the relative velocity of a contact."""
    return 1.0 if ball == pair.balls[-1] else -1.0


def relative(pair: ContactModel, vectors: Sequence[Vec]) -> Vec:
    """The vector of the ball at a contact with the paddle; of two balls, the last one's less the
    first one's.

    Args:
      vectors: one of each ball.
    """
    last = vectors[pair.balls[-1]]
    if len(pair.balls) == 1:
        return last
    return last - vectors[pair.balls[0]]


def shared_balls(a: ContactModel, b: ContactModel) -> list[tuple[int, float]]:
    """The balls of both contacts, and the product of their signs (`side`)."""
    return [(i, side(a, i) * side(b, i)) for i in a.balls if i in b.balls]


def sphere_box(
    radius: Scalar,
    centre: Vec,
    half: Vec,
    box_origin: Vec,
    box_rotation: Mat,
) -> Contact:
    """Contact at the box's nearest point; for a centre inside the box, at its nearest face.

    Args:
      half: half sizes of the box, m.
    """
    centre_in_box = box_rotation.T @ (centre - box_origin)
    from_surface = []
    depth = []
    for x, half_size in zip(centre_in_box, half, strict=True):
        from_surface.append(x - jnp.clip(x, -half_size, half_size))
        depth.append(half_size - jnp.abs(x))
    squared = dot(from_surface, from_surface)
    is_outside = squared > _MIN_DISTANCE**2
    inverse = jax.lax.rsqrt(jnp.where(is_outside, squared, 1.0))

    # MuJoCo takes the first of equally near faces, in the order -x, +x, -y, +y, -z, +z.
    x_nearest = (depth[0] <= depth[1]) & (depth[0] <= depth[2])
    y_nearest = ~x_nearest & (depth[1] <= depth[2])
    z_nearest = ~(x_nearest | y_nearest)
    face_depth = jnp.minimum(jnp.minimum(depth[0], depth[1]), depth[2])

    normal = []
    for i, is_nearest in enumerate((x_nearest, y_nearest, z_nearest)):
        face_normal = jnp.where(is_nearest, jnp.where(centre_in_box[i] > 0.0, 1.0, -1.0), 0.0)
        normal.append(jnp.where(is_outside, from_surface[i] * inverse, face_normal))
    distance = jnp.where(is_outside, squared * inverse, -face_depth) - radius
    return Contact(distance, box_rotation @ normal)


def sphere_sphere(first_radius: Scalar, second_radius: Scalar, first: Vec, second: Vec) -> Contact:
    """Contact of two spheres with these centres."""
    offset = second - first
    squared = offset @ offset
    is_apart = squared > _MIN_DISTANCE**2
    inverse = jax.lax.rsqrt(jnp.where(is_apart, squared, 1.0))
    # The normal of two spheres with one centre: the axis x, as in MuJoCo where their z axes are
    # parallel.
    normal = []
    for x, axis_x in zip(offset, (1.0, 0.0, 0.0), strict=True):
        normal.append(jnp.where(is_apart, x * inverse, axis_x))
    between_centres = jnp.where(is_apart, squared * inverse, 0.0)
    return Contact(between_centres - add(first_radius, second_radius), Vec(normal))


def impedance_at(pair: ContactModel, distance: jax.Array) -> jax.Array:
    """d(r) of MuJoCo's solimp at the penetration r = |distance|, in (0, 1)."""
    dmin, dmax, width, midpoint, power = pair.solimp
    x = jnp.clip(jnp.abs(distance) / width, 0.0, 1.0)
    if power == 1.0:
        y = x
    else:
        rising = x**power / midpoint ** (power - 1.0)
        settling = 1.0 - (1.0 - x) ** power / (1.0 - midpoint) ** (power - 1.0)
        y = jnp.where(x <= midpoint, rising, settling)
    return dmin + y * (dmax - dmin)
