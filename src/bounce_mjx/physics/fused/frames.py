"""Choice of the links' frames: entries of 0 and 1 fold, and a step costs less."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bounce_mjx.physics.fused.chain import Link
from bounce_mjx.physics.scalars import (
    IDENTITY3,
    ZERO3,
    Mat3,
    Scalar,
    Vec3,
    congruence,
    is_constant,
    is_zero,
    matmul,
    matvec,
    sub,
)


class Frame(NamedTuple):
    """Position (m) and orientation of a body in the frame of its link."""

    origin: Vec3 = ZERO3
    rotation: Mat3 = IDENTITY3


def floats(values: np.ndarray) -> tuple[float, ...]:
    """An array as Python floats, which fold."""
    return tuple(float(v) for v in values)


def exact(rotation: Sequence[Sequence[float]]) -> Mat3:
    """Rotation matrix; entries within rounding error of -1, 0 and 1 become exact and fold."""

    def entry(x: Scalar) -> Scalar:
        return float(round(x)) if is_constant(x) and abs(x - round(x)) < 1e-12 else x

    return tuple(tuple(map(entry, row)) for row in rotation)


def cheapest(links: Sequence[Link], last_body: Frame) -> tuple[list[Link], Frame]:
    """The same chain in the frames of its bodies or, if they cost less, in frames aligned with its
    axes.

    Args:
      last_body: a body in the frame of the last link.
    """
    return min((list(links), last_body), _align_with_axes(links, last_body), key=_cost)


def _cost(chain: tuple[Sequence[Link], Frame]) -> int:
    """Number of entries that cost an operation: neither -1, 0 nor 1 in the links' orientations and
    axes, not 0 in their offsets."""
    links, _ = chain
    directions = [row for link in links for row in (*link.rotation, link.axis)]
    offsets = sum(not is_zero(x) for link in links for x in link.offset)
    return int(np.sum(~np.isin(directions, (-1.0, 0.0, 1.0)))) + offsets


def _align_with_axes(links: Sequence[Link], last_body: Frame) -> tuple[list[Link], Frame]:
    """The chain in turned frames. In the frame of a hinge, z is its axis, and x is normal to its
    axis and the next one (Denavit and Hartenberg). The joint's angle contains the angle between its
    x axis and the last one. The frame of a slide is parallel to its parent's."""
    turned: list[Link] = []
    parent = turn = np.eye(3)
    for link, following in zip(links, [*links[1:], None], strict=True):
        rotation = np.array(link.rotation)
        zero = link.zero_position
        if link.slides:
            turn = rotation.T @ parent
        else:
            axis = np.array(link.axis)
            next_axis = np.array(following.rotation) @ following.axis if following else axis
            turn = _with_axis(axis, np.cross(axis, next_axis))
        relative = parent.T @ rotation @ turn
        if not link.slides:
            angle = np.arctan2(-relative[0, 1], relative[0, 0])
            cosine, sine = np.cos(angle), np.sin(angle)
            relative = relative @ [[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]
            zero = sub(zero, float(angle))
        to_parent, to_link = (exact(frame.T.tolist()) for frame in (parent, turn))
        turned.append(
            dataclasses.replace(
                link,
                offset=matvec(to_parent, link.offset),
                rotation=exact(relative.tolist()),
                axis=exact([(turn.T @ link.axis).tolist()])[0],
                zero_position=zero,
                first_moment=matvec(to_link, link.first_moment),
                inertia=congruence(to_link, link.inertia),
                floating_moment=matvec(to_link, link.floating_moment),
            )
        )
        parent = turn
    rotation = exact(matmul(to_link, last_body.rotation))
    return turned, Frame(matvec(to_link, last_body.origin), rotation)


def _with_axis(axis: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Frame with this z axis, and x along the normal if the normal is not zero."""
    if np.linalg.norm(normal) < 1e-9:
        normal = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    x = normal / np.linalg.norm(normal)
    return np.stack([x, np.cross(axis, x), axis], axis=1)
