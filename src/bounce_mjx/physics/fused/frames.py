"""Choice of the links' frames: entries of 0 and 1 fold, and a step costs less."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bounce_mjx.physics.fused.chain import Link
from bounce_mjx.physics.fused.scalars import IDENTITY3, ZERO3, Mat3, Vec3


class Frame(NamedTuple):
    """Position (m) and orientation of a body in the frame of its link."""

    origin: Vec3 = ZERO3
    rotation: Mat3 = IDENTITY3


def floats(values: np.ndarray) -> tuple[float, ...]:
    """An array as Python floats, which fold."""
    return tuple(float(v) for v in values)


def exact(rotation: Sequence[Sequence[float]]) -> Mat3:
    """Rotation matrix; entries within rounding error of -1, 0 and 1 become exact and fold."""
    matrix = np.asarray(rotation)
    nearest = np.round(matrix)
    matrix = np.where(np.abs(matrix - nearest) < 1e-12, nearest, matrix)
    return tuple(floats(row) for row in matrix)


def cheapest(links: Sequence[Link], last_body: Frame) -> tuple[list[Link], Frame]:
    """The same chain in the frames of its bodies or, if they cost less, in frames aligned with its
    axes.

    Args:
      last_body: a body in the frame of the last link.
    """
    return min((list(links), last_body), _aligned(links, last_body), key=_cost)


def _cost(chain: tuple[Sequence[Link], Frame]) -> int:
    """Number of entries that cost an operation: neither -1, 0 nor 1 in the links' orientations and
    axes, not 0 in their offsets."""
    links, _ = chain
    directions = [row for link in links for row in (*link.rotation, link.axis)]
    offsets = [link.offset for link in links]
    return int(np.sum(~np.isin(directions, (-1.0, 0.0, 1.0))) + np.count_nonzero(offsets))


def _aligned(links: Sequence[Link], last_body: Frame) -> tuple[list[Link], Frame]:
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
            zero -= float(angle)
        turned.append(
            dataclasses.replace(
                link,
                offset=floats(parent.T @ link.offset),
                rotation=exact(relative),
                axis=exact([turn.T @ link.axis])[0],
                zero_position=zero,
                first_moment=floats(turn.T @ link.first_moment),
                inertia=tuple(floats(row) for row in turn.T @ link.inertia @ turn),
                floating_moment=floats(turn.T @ link.floating_moment),
            )
        )
        parent = turn
    origin, rotation = turn.T @ last_body.origin, turn.T @ last_body.rotation
    return turned, Frame(floats(origin), exact(rotation))


def _with_axis(axis: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Frame with this z axis, and x along the normal if the normal is not zero."""
    if np.linalg.norm(normal) < 1e-9:
        normal = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    x = normal / np.linalg.norm(normal)
    return np.stack([x, np.cross(axis, x), axis], axis=1)
