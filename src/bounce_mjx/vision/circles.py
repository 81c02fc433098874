"""The ball in one picture: a circle of its colour, fitted to the edge of its picture. A part of the
edge is enough, so that a ball which the paddle hides in part still gives its centre."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

Colour = tuple[Sequence[int], Sequence[int]]
"""Lower and upper ends of a ball's colour in OpenCV's HSV (hue 0 to 180, saturation and value 0 to
255), wide enough for its side in the shade."""
COLOURS: dict[str, Colour] = {
    "white": ((0, 0, 60), (180, 80, 255)),
    "orange": ((7, 110, 50), (25, 255, 255)),
}
# Difference of a pixel from the background, of 255, that is no noise.
_DIFFERENCE = 16

# Radii of the ball in a picture before it is known how far away it is, pixels.
_RADII = (3.0, 40.0)
# Weight of the expected radius beside one edge point, and how much smaller than the ball's a circle
# through the centres of its outermost pixels is, pixels.
_RADIUS_WEIGHT = 4.0
_RADIUS_OF_PIXELS = 0.4
# Keeps the least squares of points on a short arc solvable; a point counts 1.
_DAMPING = 1e-9
# Share of the expected radius by which a measured one may differ.
RADIUS_TOLERANCE = 0.3
# Distance of an edge point from the circle, pixels, and the share of the circle's directions in
# which there must be such points.
_EDGE_TOLERANCE = 1.2
_LEAST_ARC = 0.35
_DIRECTIONS = 24
# Score of a ball that is seen clearly; without one, so many circles of each edge are tried.
CLEAR_SCORE = 0.5
_CANDIDATES = 4
# Least share of a circle's inside that has the ball's colour, and points [25, 2] spread over the
# inside of a circle of the radius 1 (a sunflower's seeds).
_LEAST_FILLED = 0.4
_SEEDS = np.arange(25)
_INSIDE = 0.85 * np.sqrt((_SEEDS[:, None] + 0.5) / 25.0)
_INSIDE = _INSIDE * np.column_stack([np.cos(2.4 * _SEEDS), np.sin(2.4 * _SEEDS)])


class Circle(NamedTuple):
    """A ball in a picture, pixels."""

    centre: np.ndarray
    radius: float
    score: float
    """Share of the circle's directions in which its edge was seen, times the share of its inside
    that has the ball's colour."""


class Expected(NamedTuple):
    """Where a ball is expected in a picture, pixels."""

    centre: np.ndarray
    radius: float
    blur: np.ndarray
    """Motion during the exposure [2]."""
    margin: float = 45.0
    """How far from there the ball may be."""


def find_circles(
    picture: np.ndarray,
    colour: Colour,
    background: np.ndarray | None = None,
    expected: Expected | None = None,
    count: int = 3,
) -> list[Circle]:
    """Circles of the ball's colour in a picture, the most complete ones first.

    Args:
      picture: BGR [H, W, 3], uint8.
      colour: of the ball.
      background: the picture without a ball; None takes the colour alone.
      expected: searches around this place alone; None for the whole picture.
      count: largest number of circles.
    """
    corner = np.zeros(2, int)
    radii = _RADII
    expected_radius = None
    blur = np.zeros(2)
    if expected is not None:
        reach = expected.radius + np.linalg.norm(expected.blur) + expected.margin
        height, width = picture.shape[:2]
        lower = np.clip(np.floor(expected.centre - reach), 0, (width, height)).astype(int)
        upper = np.clip(np.ceil(expected.centre + reach), 0, (width, height)).astype(int)
        if np.any(upper - lower < 4):
            return []
        window = np.s_[lower[1] : upper[1], lower[0] : upper[0]]
        picture = picture[window]
        background = None if background is None else background[window]
        corner = lower
        expected_radius = expected.radius
        tolerance = RADIUS_TOLERANCE * expected.radius
        radii = (expected.radius - tolerance, expected.radius + tolerance)
        blur = expected.blur
    hsv = cv2.cvtColor(picture, cv2.COLOR_BGR2HSV)
    mask = cv2.inRange(hsv, np.array(colour[0], np.uint8), np.array(colour[1], np.uint8))
    if background is not None:
        difference = cv2.absdiff(picture, background)
        is_background = cv2.inRange(difference, (0, 0, 0), (_DIFFERENCE,) * 3)
        mask[is_background > 0] = 0
    mask = cv2.medianBlur(mask, 3)
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    edges = []
    for contour in contours:
        edge = contour.reshape(-1, 2).astype(float)
        if len(edge) < 3.0 * radii[0]:
            continue
        # A picture's border is no edge of the ball.
        size = np.array(mask.shape[::-1]) - 1
        edges.append(edge[np.all((edge > 0) & (edge < size), axis=1)])
    fits = [fit_circle(edge, mask, radii, blur, expected_radius) for edge in edges]
    circles = [circle for circle in fits if circle is not None]
    if all(circle.score <= CLEAR_SCORE for circle in circles):
        # The ball may share its edge with a thing of its colour.
        for edge in edges:
            circle = fit_circle(edge, mask, radii, blur, expected_radius, _CANDIDATES)
            if circle is not None and circle.score > CLEAR_SCORE:
                circles.append(circle)
    circles.sort(key=lambda circle: circle.score, reverse=True)
    return [circle._replace(centre=circle.centre + corner) for circle in circles[:count]]


def fit_circle(
    edge: np.ndarray,
    mask: np.ndarray,
    radii: tuple[float, float],
    blur: np.ndarray,
    expected_radius: float | None = None,
    num_candidates: int = 1,
) -> Circle | None:
    """The filled circle that most of an edge lies on; None if there is none.

    Circles through three points on arcs of the edge are tried; those with the most points close to
    them and the most of their inside filled are refined on these points. With a blur, the edge is
    that of a circle that moved along a line.

    Args:
      edge: points [N, 2] in the order of the edge, pixels.
      mask: pixels of the ball's colour [H, W], not 0.
      radii: smallest and largest radius.
      blur: motion [2] during the exposure, pixels.
      expected_radius: from the ball's distance, if it is known.
      num_candidates: circles that are refined; the most complete one counts.
    """
    if len(edge) < 8:
        return None
    best = None
    for centre, radius in _supported_circles(edge, mask, radii, blur, num_candidates):
        circle = _refine(edge, mask, centre, radius, radii, blur, expected_radius)
        if circle is not None and (best is None or circle.score > best.score):
            best = circle
    return best


def _refine(
    edge: np.ndarray,
    mask: np.ndarray,
    centre: np.ndarray,
    radius: float,
    radii: tuple[float, float],
    blur: np.ndarray,
    expected_radius: float | None,
) -> Circle | None:
    """The circle near a centre [2] and radius that fits the edge points close to it; None if they
    are too few, or if it is not filled. The other arguments are those of `fit_circle`."""
    # The first centre may be at an end of the motion. In the end, a sharp edge is told by a narrow
    # tolerance from the edge of what hides the rest.
    length = float(np.linalg.norm(blur))
    last_tolerance = 0.5 * _EDGE_TOLERANCE if length < 1.0 else _EDGE_TOLERANCE
    for tolerance in np.linspace(_EDGE_TOLERANCE + 0.5 * length, last_tolerance, 8):
        offsets = edge - _nearest_on_path(edge, centre, blur)
        distances = np.hypot(offsets[:, 0], offsets[:, 1])
        # A point at the centre itself shows no direction.
        is_near = (np.abs(distances - radius) < tolerance) & (distances > 0.0)
        if np.count_nonzero(is_near) < 8:
            return None
        # Gauss-Newton: a shift of the centre changes a distance by its component along the offset.
        normals = offsets[is_near] / distances[is_near, None]
        jacobian = np.ones((len(normals), 3))
        jacobian[:, :2] = normals
        information = jacobian.T @ jacobian
        gradient = jacobian.T @ (distances[is_near] - radius)
        if expected_radius is not None:
            # Where an arc alone is seen, the radius is better known from the distance.
            known = expected_radius - _RADIUS_OF_PIXELS - radius
            information[2, 2] += _RADIUS_WEIGHT**2
            gradient[2] += _RADIUS_WEIGHT**2 * known
        change = np.linalg.solve(information + _DAMPING * np.eye(3), gradient)
        centre = centre + change[:2]
        radius = radius + change[2]
    if not radii[0] <= radius <= radii[1]:
        return None
    angles = np.arctan2(normals[:, 1], normals[:, 0])
    directions = np.unique(np.floor((angles + np.pi) / (2.0 * np.pi) * _DIRECTIONS))
    arc = len(directions) / _DIRECTIONS
    filled = float(_filled_share(mask, centre[None], np.array([radius]))[0])
    if arc < _LEAST_ARC or filled < _LEAST_FILLED:
        return None
    return Circle(centre, float(radius), arc * filled)


def _filled_share(mask: np.ndarray, centres: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Share [C] of circles' insides that a mask fills; centres [C, 2] and radii [C] in pixels."""
    points = centres[:, None] + radii[:, None, None] * _INSIDE
    columns, rows = np.moveaxis(np.round(points).astype(int), -1, 0)
    height, width = mask.shape
    is_in_picture = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    values = mask[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
    return np.mean(is_in_picture & (values > 0), axis=1)


def _nearest_on_path(points: np.ndarray, centre: np.ndarray, blur: np.ndarray) -> np.ndarray:
    """Nearest places [N, 2] of the moving centre to points [N, 2]."""
    squared_length = blur @ blur
    if squared_length < 1e-6:
        return np.broadcast_to(centre, points.shape)
    along = np.clip((points - centre) @ blur / squared_length, -0.5, 0.5)
    return centre + along[:, None] * blur


def _supported_circles(
    edge: np.ndarray,
    mask: np.ndarray,
    radii: tuple[float, float],
    blur: np.ndarray,
    count: int,
) -> list[tuple[np.ndarray, float]]:
    """Centres and radii of some circles through three points of an arc: those that have the most
    edge points close to them, and are filled; each half a radius at least from the ones before."""
    num_points = len(edge)
    starts = np.arange(0, num_points, max(1, num_points // 40))
    triples = []
    for share in (0.12, 0.22, 0.32):
        for circumference in (2.0 * np.pi * radii[0], 2.0 * np.pi * radii[1]):
            stride = int(max(2, min(share * circumference, num_points / 3)))
            triples.append(np.stack([starts, starts + stride, starts + 2 * stride], axis=1))
    corners = edge[np.concatenate(triples) % num_points]
    centres, circle_radii = _circles_through(corners)
    is_possible = (circle_radii > 0.8 * radii[0]) & (circle_radii < 1.2 * radii[1])
    centres = centres[is_possible]
    circle_radii = circle_radii[is_possible]
    if not len(centres):
        return []
    tolerance = _EDGE_TOLERANCE + 0.5 * np.linalg.norm(blur)
    columns = edge[None, :, 0] - centres[:, None, 0]
    rows = edge[None, :, 1] - centres[:, None, 1]
    distances = np.hypot(columns, rows)
    is_near = np.abs(distances - circle_radii[:, None]) < tolerance
    # A large circle has more edge; its share counts.
    support = np.count_nonzero(is_near, axis=1) / circle_radii
    support *= _filled_share(mask, centres, circle_radii)
    chosen: list[int] = []
    for candidate in np.argsort(-support):
        offsets = centres[chosen] - centres[candidate]
        if np.all(np.hypot(offsets[:, 0], offsets[:, 1]) > 0.5 * radii[0]):
            chosen.append(int(candidate))
        if len(chosen) == count:
            break
    return [(centres[k], float(np.clip(circle_radii[k], *radii))) for k in chosen]


def _circles_through(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres [N, 2] and radii [N] of the circles through triples of points [N, 3, 2]."""
    first = corners[:, 1] - corners[:, 0]
    second = corners[:, 2] - corners[:, 0]
    determinant = 2.0 * (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    is_straight = np.abs(determinant) < 1e-6
    determinant = np.where(is_straight, np.inf, determinant)
    first_squared = np.sum(first * first, axis=1)
    second_squared = np.sum(second * second, axis=1)
    x = (second[:, 1] * first_squared - first[:, 1] * second_squared) / determinant
    y = (first[:, 0] * second_squared - second[:, 0] * first_squared) / determinant
    offsets = np.stack([x, y], axis=1)
    radii = np.where(is_straight, np.inf, np.linalg.norm(offsets, axis=1))
    return corners[:, 0] + offsets, radii
