"""The ball's position from two cameras, for any policy that needs `ball_position`.

    python examples/two_cameras.py calibrate POLICY cameras.json --sources 0 1   # with the arm
    python examples/two_cameras.py watch cameras.json --sources 0 1              # prints the place

OpenCV does the geometry (`pip install ".[vision]"`); what is special is here: the ball. It is found
by its colour, as a circle that is fitted to the edge of its picture. A part of the edge is enough,
so a ball that the paddle hides in part still gives its centre. What does not fit gives nothing: the
size, the rays of both cameras and the flight must agree. docs/cameras.md says which cameras to take
and where to put them; `rendered_cameras.py` has the same program see a simulated arm.
"""

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import least_squares

from bounce_mjx import load_policy
from bounce_mjx.deploy.motion import paddle_position

RADIUS = 0.019
"""Radius of the ball, m."""
GRAVITY = np.array([0.0, 0.0, -9.81])

# The ball's colour in OpenCV's HSV (hue 0 to 180, saturation and value 0 to 255): lower and upper
# ends, wide enough for its side in the shade.
COLOURS = {
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
_RADIUS_TOLERANCE = 0.3
# Distance of an edge point from the circle, pixels, and the share of the circle's directions in
# which there must be such points.
_EDGE_TOLERANCE = 1.2
_LEAST_ARC = 0.35
_DIRECTIONS = 24
# Score of a ball that is seen clearly; without one, so many circles of each edge are tried.
_CLEAR_SCORE = 0.5
_CANDIDATES = 4
# Least share of a circle's inside that has the ball's colour, and points [25, 2] spread over the
# inside of a circle of the radius 1 (a sunflower's seeds).
_LEAST_FILLED = 0.4
_SEEDS = np.arange(25)
_INSIDE = 0.85 * np.sqrt((_SEEDS[:, None] + 0.5) / 25.0)
_INSIDE = _INSIDE * np.column_stack([np.cos(2.4 * _SEEDS), np.sin(2.4 * _SEEDS)])
# Distance between a circle's centre and the projection of the triangulated ball, pixels.
_MAX_REPROJECTION = 3.0
# Largest changes of the ball's velocity at a bounce, m/s: upward; downward, where a paddle gives
# none and the velocity of two pictures is a little off; sideways (by friction, and by a paddle that
# is tilted by 0.2 rad). And what is added to the distance from the predicted place, m.
_MAX_UPWARD_CHANGE = 9.0
_MAX_DOWNWARD_CHANGE = 1.5
_MAX_SIDEWAYS_CHANGE = 2.5
_PLACE_TOLERANCE = 0.02
# So many pairs in a row without a ball are searched around the predicted place; later ones whole.
_SEARCHED_NEAR = 3
# Pairs of pictures that may wait in the cameras' buffers.
_BUFFERED = 4
# How far the ball may be from where cameras that were measured with a tape expect it, pixels.
_TAPE_MARGIN = 90.0


class Camera(NamedTuple):
    """A calibrated camera, in OpenCV's convention: x right, y down, z forward."""

    matrix: np.ndarray
    """Intrinsic matrix [3, 3], pixels."""
    distortion: np.ndarray
    """k1, k2, p1, p2, k3 of the lens [5]."""
    rotation: np.ndarray
    """From the robot's frame to the camera's [3, 3]."""
    translation: np.ndarray
    """The robot's origin in the camera's frame [3], m."""

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels [N, 2] of points [N, 3] (m) in the robot's frame."""
        rotation_vector, _ = cv2.Rodrigues(self.rotation)
        pixels, _ = cv2.projectPoints(
            np.reshape(points, (-1, 1, 3)).astype(float),
            rotation_vector,
            self.translation,
            self.matrix,
            self.distortion,
        )
        return pixels.reshape(-1, 2)

    @property
    def centre(self) -> np.ndarray:
        """Place of the camera in the robot's frame [3], m."""
        return -self.rotation.T @ self.translation

    def ray(self, pixel: Sequence[float]) -> np.ndarray:
        """Unit vector [3] in the robot's frame from the camera toward a pixel."""
        point = np.array(pixel, float).reshape(1, 1, 2)
        x, y = cv2.undistortPoints(point, self.matrix, self.distortion).ravel()
        direction = self.rotation.T @ np.array([x, y, 1.0])
        return direction / np.linalg.norm(direction)

    def radius_at(self, position: np.ndarray) -> float:
        """Radius of the ball at a position [3] (m) in the picture, pixels."""
        depth = (self.rotation @ position + self.translation)[2]
        return float(self.matrix[0, 0] * RADIUS / max(depth, 0.05))


class Circle(NamedTuple):
    """A ball in a picture, pixels."""

    centre: np.ndarray
    radius: float
    score: float
    """Share of the circle's directions in which its edge was seen, times the share of its inside
    that has the ball's colour."""


class Fix(NamedTuple):
    """A measured place of the ball."""

    time: float
    """Middle of the exposure, s."""
    position: np.ndarray
    """In the robot's frame [3], m."""
    error: float
    """Largest distance from a circle's centre to the ball's projection, pixels."""


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
    colour: tuple[Sequence[int], Sequence[int]],
    background: np.ndarray | None = None,
    expected: Expected | None = None,
    count: int = 3,
) -> list[Circle]:
    """Circles of the ball's colour in a picture, the most complete ones first.

    Args:
      picture: BGR [H, W, 3], uint8.
      colour: lower and upper ends in HSV, as `COLOURS`.
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
        tolerance = _RADIUS_TOLERANCE * expected.radius
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
    if all(circle.score <= _CLEAR_SCORE for circle in circles):
        # The ball may share its edge with a thing of its colour.
        for edge in edges:
            circle = fit_circle(edge, mask, radii, blur, expected_radius, _CANDIDATES)
            if circle is not None and circle.score > _CLEAR_SCORE:
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


def triangulate(cameras: Sequence[Camera], pixels: Sequence[np.ndarray]) -> np.ndarray:
    """The place [3] (m) with the least sum of squared distances from the rays of all cameras."""
    matrix = np.zeros((3, 3))
    vector = np.zeros(3)
    for camera, pixel in zip(cameras, pixels, strict=True):
        ray = camera.ray(pixel)
        across = np.eye(3) - np.outer(ray, ray)
        matrix += across
        vector += across @ camera.centre
    return np.linalg.solve(matrix, vector)


class Tracker:
    """Places of the ball from pairs of pictures, one pair after the other."""

    def __init__(
        self,
        cameras: Sequence[Camera],
        colour: tuple[Sequence[int], Sequence[int]] = COLOURS["white"],
        exposure: float = 0.004,
    ):
        """Args:
        exposure: of both cameras, s; the ball's motion in it blurs its edge.
        """
        self.cameras = tuple(cameras)
        self.colour = colour
        self.exposure = exposure
        self.fixes: list[Fix] = []
        self._missed = 0
        self._backgrounds: list[np.ndarray | None] = [None] * len(self.cameras)

    def learn_background(self, pairs: Sequence[Sequence[np.ndarray]]) -> None:
        """Takes pairs of pictures without a ball as what is always there; some twenty average out
        the noise. The arm may be in them, and move later."""
        self._backgrounds = [
            np.mean(np.stack(pictures).astype(np.float32), axis=0).astype(np.uint8)
            for pictures in zip(*pairs, strict=True)
        ]

    def update(self, pictures: Sequence[np.ndarray], taken: float) -> Fix | None:
        """The place of the ball in a pair of pictures; None if it is not seen for sure.

        Args:
          pictures: one of each camera, taken at once, BGR.
          taken: middle of the exposure, s.
        """
        motion = self._predict(taken)
        if motion is None:
            fix, _ = self._look(pictures, taken, None, [None] * len(self.cameras))
        else:
            expected = [self._expected(camera, *motion) for camera in self.cameras]
            fix, score = self._look(pictures, taken, motion[0], expected)
            if score <= _CLEAR_SCORE:
                # A ball that turns around within the exposure is hardly blurred.
                still = [place._replace(blur=np.zeros(2)) for place in expected]
                bounced, bounced_score = self._look(pictures, taken, motion[0], still)
                if bounced_score > score:
                    fix = bounced
        if fix is None:
            self._missed += 1
            if self._missed >= _SEARCHED_NEAR:
                self.fixes = []
            return None
        self._missed = 0
        self.fixes = [*self.fixes[-1:], fix]
        return fix

    def _predict(self, taken: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Position and velocity [3] at a time, of a ball in free flight since the last picture.

        None if the ball is lost. With one picture, it is taken to have been at rest there: the
        gates of `_fix` bear the rest.
        """
        if not self.fixes:
            return None
        last = self.fixes[-1]
        after = taken - last.time
        velocity = np.zeros(3)
        if len(self.fixes) > 1:
            before = self.fixes[-2]
            between = max(last.time - before.time, 1e-3)
            velocity = (last.position - before.position) / between + 0.5 * between * GRAVITY
        position = last.position + after * velocity + 0.5 * after * after * GRAVITY
        return position, velocity + after * GRAVITY

    def _expected(self, camera: Camera, position: np.ndarray, velocity: np.ndarray) -> Expected:
        half = 0.5 * self.exposure * velocity
        start, centre, end = camera.project(np.stack([position - half, position, position + half]))
        return Expected(centre, camera.radius_at(position), end - start)

    def _look(
        self,
        pictures: Sequence[np.ndarray],
        taken: float,
        predicted: np.ndarray | None,
        expected: Sequence[Expected | None],
    ) -> tuple[Fix | None, float]:
        """The place of the most complete pair of circles that can be the ball, and the score of its
        less complete circle; None and 0 if there is none.

        The rays of two other things of its colour may meet better by chance.

        Args:
          predicted: where a ball in free flight is [3], m; None if that is not known.
          expected: where to search in the picture of each camera; None for the whole picture.
        """
        circles = []
        for picture, background, place in zip(pictures, self._backgrounds, expected, strict=True):
            circles.append(find_circles(picture, self.colour, background, place))
        best = None
        best_score = 0.0
        for first in circles[0]:
            for second in circles[1]:
                score = min(first.score, second.score)
                if score <= best_score:
                    continue
                fix = self._fix((first, second), taken, predicted)
                if fix is not None:
                    best = fix
                    best_score = score
        return best, best_score

    def _fix(
        self, pair: Sequence[Circle], taken: float, predicted: np.ndarray | None
    ) -> Fix | None:
        position = triangulate(self.cameras, [circle.centre for circle in pair])
        error = 0.0
        for camera, circle in zip(self.cameras, pair, strict=True):
            radius = camera.radius_at(position)
            if abs(circle.radius - radius) > _RADIUS_TOLERANCE * radius:
                return None
            projected = camera.project(position[None])[0]
            error = max(error, float(np.linalg.norm(projected - circle.centre)))
        if error > _MAX_REPROJECTION:
            return None
        if predicted is not None:
            since = taken - self.fixes[-1].time
            sideways = np.linalg.norm(position[:2] - predicted[:2])
            upward = position[2] - predicted[2]
            # A single picture shows no velocity: the ball may fall as fast as it may rise.
            is_velocity_known = len(self.fixes) > 1
            downward_change = _MAX_DOWNWARD_CHANGE if is_velocity_known else _MAX_UPWARD_CHANGE
            if sideways > _PLACE_TOLERANCE + _MAX_SIDEWAYS_CHANGE * since:
                return None
            if upward > _PLACE_TOLERANCE + _MAX_UPWARD_CHANGE * since:
                return None
            if -upward > _PLACE_TOLERANCE + downward_change * since:
                return None
        return Fix(taken, position, error)


class Calibration(NamedTuple):
    """Both cameras in the frame of the robot's base, and how well they are known."""

    cameras: tuple[Camera, ...]
    ball: np.ndarray
    """Centre of the ball that was fixed to the paddle, from the paddle's centre [3], m, in the axes
    of the robot's frame at the joints' reference angles."""
    errors: np.ndarray
    """Triangulated place less that of the forward kinematics [N, 3], m, of each pose, by cameras
    that were fitted without it and without the rest of its quarter; NaN for a pose that is not
    used."""
    bad: tuple[int, ...]
    """Poses that do not fit the others, and were left out."""

    def report(self) -> str:
        """How well the cameras are known, in words."""
        used = self.errors[np.all(np.isfinite(self.errors), axis=1)]
        x, y, z = 1e3 * np.sqrt(np.mean(used**2, axis=0))
        text = f"{len(used)} poses; error x {x:.2f}, y {y:.2f}, z {z:.2f} mm (root mean square)"
        if self.bad:
            numbers = ", ".join(str(pose + 1) for pose in self.bad)
            text += f"; left out, as they do not fit: pose {numbers}"
        return text


# Standard deviations of what is known before a calibration: focal length (share), principal point
# (pixels), k1 and k2, and the place of the ball on the paddle (m).
_PRIOR_FOCAL = 0.05
_PRIOR_CENTRE = 10.0
_PRIOR_LENS = 0.2
_PRIOR_BALL = 0.005
# Noise of a circle's centre, pixels, and how many times the typical residual a pose may be off.
_PIXEL_NOISE = 0.3
_BAD_RATIO = 4.0
# Distance at which a pose agrees with cameras whose lens and ball are known roughly, pixels.
_ROUGH_REPROJECTION = 15.0
# Largest error of a calibration along an axis, m (root mean square).
_MAX_ERROR = 0.01
# Parts into which the poses are divided to measure the error with poses that were not used.
_FOLDS = 4
# How far over its target an apex may be, m.
_OVERSHOOT = 0.1
# Half of the paddle's thickness, m.
_HALF_THICKNESS = 0.0035


def highest_seen(cameras: Sequence[Camera], size: tuple[int, int], place: np.ndarray) -> float:
    """Height of the ball (m) up to which all pictures show all of it straight above a place [3].

    Args:
      size: width and height of the pictures, pixels.
    """
    heights = np.arange(0.0, 2.0, 0.005)
    positions = place + heights[:, None] * np.array([0.0, 0.0, 1.0])
    is_seen = np.ones(len(heights), bool)
    for camera in cameras:
        pixels = camera.project(positions)
        radii = np.array([camera.radius_at(position) for position in positions])[:, None]
        is_seen &= np.all((pixels > radii) & (pixels < np.array(size) - radii), axis=1)
    if not np.any(is_seen):
        raise SystemExit(f"no place above {np.round(place, 3)} m is in all pictures")
    first = int(np.argmax(is_seen))
    # A strong lens bends what is far outside back into the picture.
    after = np.flatnonzero(~is_seen[first:])
    last = first + int(after[0]) - 1 if len(after) else len(heights) - 1
    return float(positions[last, 2])


def report_height(cameras: Sequence[Camera], size: tuple[int, int], metadata) -> str:
    """In words, whether the cameras see as high as a policy plays."""
    home = paddle_position(metadata, np.array(metadata.default_joint_angles))
    highest = highest_seen(cameras, size, home)
    text = f"all cameras see the ball up to a height of {highest:.2f} m"
    target = metadata.goals.get("target_height")
    if target is None:
        return text
    apex = target.range[1]
    text += f"; the policy's apexes are at {apex:.2f} m at most"
    if highest < apex + _OVERSHOOT:
        text += f": aim higher, or play with targets of at most {highest - _OVERSHOOT:.2f} m"
    return text


def ball_positions(metadata, joint_angles: np.ndarray, ball: np.ndarray) -> np.ndarray:
    """Places [N, 3] (m) of a ball that is fixed to the paddle, by the forward kinematics.

    Args:
      metadata: of the policy for this arm.
      joint_angles: [N, J], rad.
      ball: as `Calibration.ball`.
    """
    fixed = metadata._replace(paddle=tuple(np.array(metadata.paddle) + ball))
    return paddle_position(fixed, joint_angles)


def plan_poses(
    metadata, cameras: Sequence[Camera], size: tuple[int, int], count: int = 20, seed: int = 0
) -> np.ndarray:
    """Joint angles [count, J] (rad) at which both cameras see the paddle, spread over their views.

    Of many random poses around the start pose, those are kept whose paddle is in both pictures, at
    most 5 cm below its home, and with its upper face upward (within 53 degrees) and toward both
    cameras; then each pose that is farthest from all chosen ones is added.

    Args:
      cameras: roughly known, such as `rough_camera` gives.
      size: width and height of the pictures, pixels.
    """
    rng = np.random.default_rng(seed)
    home = np.array(metadata.default_joint_angles)
    low, high = np.array(
        [(-np.inf, np.inf) if ends is None else ends for ends in metadata.joint_ranges]
    ).T
    angles = home + rng.uniform(-0.5, 0.5, (20_000, len(home)))
    angles = np.clip(angles, low + 0.05, high - 0.05)
    places = paddle_position(metadata, angles)
    normal = np.array(metadata.paddle_normal)
    upward = ball_positions(metadata, angles, normal) - places
    home_place = paddle_position(metadata, home)
    is_good = (places[:, 2] > home_place[2] - 0.05) & (upward[:, 2] > 0.6)
    for camera in cameras:
        pixels = camera.project(places)
        margin = 0.08 * np.array(size)
        is_good &= np.all((pixels > margin) & (pixels < size - margin), axis=1)
        toward = camera.centre - places
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        is_good &= np.sum(toward * upward, axis=1) > 0.25
    angles = angles[is_good]
    places = places[is_good]
    if len(angles) < count:
        raise SystemExit(
            f"both cameras see the paddle in {len(angles)} of 20,000 poses around the start pose, "
            f"but {count} are needed; move them so that both see the paddle around its home"
        )
    chosen = [int(np.argmin(np.linalg.norm(places - home_place, axis=1)))]
    distances = np.linalg.norm(places - places[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distances)))
        distances = np.minimum(distances, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return angles[chosen]


def rough_camera(
    place: Sequence[float], gaze: Sequence[float], size: tuple[int, int], field_of_view: float
) -> Camera:
    """A camera with a level horizon, measured with a tape.

    Args:
      place: of the camera [3], m, in the robot's frame.
      gaze: the point at which it looks [3], m.
      size: width and height of its pictures, pixels.
      field_of_view: horizontal, degrees.
    """
    width, height = size
    forward = np.array(gaze, float) - np.array(place, float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    focal_length = 0.5 * width / np.tan(0.5 * np.radians(field_of_view))
    matrix = np.array(
        [[focal_length, 0.0, width / 2], [0.0, focal_length, height / 2], [0.0, 0.0, 1.0]]
    )
    return Camera(matrix, np.zeros(5), rotation, -rotation @ np.array(place, float))


def find_fixed_ball(
    metadata,
    rough: Camera,
    joint_angles: np.ndarray,
    picture: np.ndarray,
    colour: tuple[Sequence[int], Sequence[int]],
    background: np.ndarray | None = None,
) -> np.ndarray:
    """Pixel [2] of the ball that is fixed to the paddle at joint angles [J]; NaN if it is not seen.

    Args:
      rough: this camera, roughly known.

    The other arguments are those of `find_circles`.
    """
    place = ball_positions(metadata, joint_angles, _nominal_ball(metadata))
    radius = rough.radius_at(place)
    expected = Expected(rough.project(place)[0], radius, np.zeros(2), _TAPE_MARGIN)
    circles = find_circles(picture, colour, background, expected, count=1)
    return circles[0].centre if circles else np.full(2, np.nan)


def _nominal_ball(metadata) -> np.ndarray:
    """`Calibration.ball` of a ball on the middle of the paddle's upper face."""
    return np.array(metadata.paddle_normal) * (RADIUS + _HALF_THICKNESS)


def calibrate(
    metadata, rough: Sequence[Camera], joint_angles: np.ndarray, pixels: np.ndarray
) -> Calibration:
    """Both cameras in the frame of the base, from pictures of a ball that is fixed to the paddle.

    `cv2.solvePnP` starts each camera, and a bundle adjustment finds both with their lenses and the
    place of the ball on the paddle. A pose that does not fit is left out.

    Args:
      metadata: of the policy for this arm.
      rough: the cameras as `rough_camera` gives them; of these the intrinsics count.
      joint_angles: of the arm in each pose [N, J], rad.
      pixels: the ball's centre in each camera's pictures [2, N, 2]; NaN where it was not seen.
    """
    ball = _nominal_ball(metadata)
    is_seen = np.all(np.isfinite(pixels), axis=(0, 2))
    used = _agreeing_poses(ball_positions(metadata, joint_angles, ball), rough, pixels, is_seen)
    bad = np.flatnonzero(is_seen & ~used).tolist()
    while True:
        if np.count_nonzero(used) < 8:
            raise SystemExit(
                f"{np.count_nonzero(used)} poses are left, but 8 are needed; check that the ball "
                "is fixed, that both cameras see it, and that the arm is the policy's"
            )
        cameras, adjusted, residuals = _adjust(metadata, rough, ball, joint_angles, pixels, used)
        worst = int(np.argmax(residuals))
        typical = max(_PIXEL_NOISE, 1.5 * float(np.median(residuals[used])))
        if residuals[worst] < _BAD_RATIO * typical:
            break
        bad.append(worst)
        used[worst] = False
    errors = np.full((len(joint_angles), 3), np.nan)
    numbers = np.flatnonzero(used)
    for fold in range(_FOLDS):
        left_out = numbers[fold::_FOLDS]
        others = used.copy()
        others[left_out] = False
        fold_cameras, fold_ball, _ = _adjust(metadata, rough, ball, joint_angles, pixels, others)
        truth = ball_positions(metadata, joint_angles, fold_ball)
        for pose in left_out:
            place = triangulate(fold_cameras, pixels[:, pose])
            errors[pose] = place - truth[pose]
    calibration = Calibration(cameras, adjusted, errors, tuple(sorted(bad)))
    typical_errors = np.sqrt(np.nanmean(errors**2, axis=0))
    if np.any(typical_errors > _MAX_ERROR):
        raise SystemExit(
            f"the poses do not agree ({calibration.report()}), but {1e3 * _MAX_ERROR:g} mm is the "
            "most that a policy bears; check that the ball is fixed, that nothing else in the "
            "pictures looks like it, and that the arm reached each pose"
        )
    return calibration


def _agreeing_poses(
    places: np.ndarray, rough: Sequence[Camera], pixels: np.ndarray, is_seen: np.ndarray
) -> np.ndarray:
    """Which poses [N] agree roughly with most others in the pictures of every camera.

    Another thing that was taken for the ball is tens of pixels away from it. The bundle adjustment
    would bend a lens to meet it, and then leave out other poses.

    Args:
      places: nominal places of the ball [N, 3], m.
      rough: the cameras, of which the intrinsics count.
      pixels: [2, N, 2].
      is_seen: whether both cameras saw the ball [N].
    """
    numbers = np.flatnonzero(is_seen)
    agrees = is_seen.copy()
    for camera, seen in zip(rough, pixels, strict=True):
        is_inlier = np.zeros(len(numbers), bool)
        # OpenCV's least number of points.
        if len(numbers) >= 4:
            is_solved, _, _, inliers = cv2.solvePnPRansac(
                places[numbers],
                seen[numbers],
                camera.matrix,
                None,
                iterationsCount=1000,
                reprojectionError=_ROUGH_REPROJECTION,
                confidence=0.9999,
                flags=cv2.SOLVEPNP_SQPNP,
            )
            if is_solved:
                is_inlier[inliers.ravel()] = True
        agrees[numbers[~is_inlier]] = False
    return agrees


def _adjust(
    metadata,
    rough: Sequence[Camera],
    ball: np.ndarray,
    joint_angles: np.ndarray,
    pixels: np.ndarray,
    used: np.ndarray,
) -> tuple[tuple[Camera, ...], np.ndarray, np.ndarray]:
    """Bundle adjustment: the cameras, the ball's place on the paddle, and each pose's residual
    [N] (pixels; 0 for one that is not used)."""
    places = ball_positions(metadata, joint_angles, ball)
    starts = []
    for camera, seen in zip(rough, pixels, strict=True):
        _, rotation, translation = cv2.solvePnP(
            places[used], seen[used], camera.matrix, None, flags=cv2.SOLVEPNP_SQPNP
        )
        starts.append([*rotation.ravel(), *translation.ravel(), 1.0, 0.0, 0.0, 0.0, 0.0])
    size = len(starts[0])

    def cameras_of(unknowns: np.ndarray) -> tuple[Camera, ...]:
        cameras = []
        for k, camera in enumerate(rough):
            values = unknowns[k * size : (k + 1) * size]
            matrix = camera.matrix.copy()
            matrix[0, 0] *= values[6]
            matrix[1, 1] *= values[6]
            matrix[:2, 2] += values[7:9]
            distortion = np.array([values[9], values[10], 0.0, 0.0, 0.0])
            rotation, _ = cv2.Rodrigues(values[:3])
            cameras.append(Camera(matrix, distortion, rotation, values[3:6]))
        return tuple(cameras)

    def reprojections(unknowns: np.ndarray) -> np.ndarray:
        points = ball_positions(metadata, joint_angles, unknowns[-3:])
        errors = []
        for camera, seen in zip(cameras_of(unknowns), pixels, strict=True):
            errors.append(camera.project(points) - seen)
        return np.stack(errors)

    def residuals(unknowns: np.ndarray) -> np.ndarray:
        priors = [(unknowns[-3:] - ball) / _PRIOR_BALL]
        for k in range(len(rough)):
            values = unknowns[k * size : (k + 1) * size]
            priors.append([(values[6] - 1.0) / _PRIOR_FOCAL])
            priors.append(values[7:9] / _PRIOR_CENTRE)
            priors.append(values[9:11] / _PRIOR_LENS)
        seen = reprojections(unknowns)[:, used] / _PIXEL_NOISE
        return np.concatenate([seen.ravel(), *priors])

    start = np.concatenate([*starts, ball])
    unknowns = least_squares(residuals, start, loss="soft_l1", x_scale="jac").x
    distances = np.linalg.norm(reprojections(unknowns), axis=2).max(axis=0)
    return cameras_of(unknowns), unknowns[-3:], np.where(used, distances, 0.0)


def save_cameras(path: Path, cameras: Sequence[Camera], size: tuple[int, int]) -> None:
    """Writes calibrated cameras, and the width and height of their pictures, pixels."""
    entries = []
    for camera in cameras:
        entries.append({name: value.tolist() for name, value in camera._asdict().items()})
    text = json.dumps({"size": list(size), "cameras": entries}, indent=1)
    path.write_text(text + "\n")


def load_cameras(path: Path) -> tuple[tuple[Camera, ...], tuple[int, int]]:
    """Reads what `save_cameras` wrote: the cameras, and the size of their pictures."""
    if not path.is_file():
        raise SystemExit(f"there is no file {path}; write it with two_cameras.py calibrate")
    saved = json.loads(path.read_text())
    if not isinstance(saved, dict):
        raise SystemExit(
            f"{path} does not tell the size of its pictures; calibrate the cameras again"
        )
    cameras = []
    for entry in saved["cameras"]:
        cameras.append(Camera(**{name: np.array(value) for name, value in entry.items()}))
    return tuple(cameras), tuple(saved["size"])


class Sources:
    """Two cameras of OpenCV, such as USB or GigE ones.

    The time stamp is that of the exposure's middle: the arrival of the second picture less the
    time of transport and half of the exposure. Cameras without a common trigger expose at different
    times, and a ball of 4 m/s moves by 4 mm in each millisecond between them: wire the trigger.
    """

    def __init__(
        self,
        sources: Sequence[str],
        size: tuple[int, int],
        rate: float,
        exposure: float,
        transport: float,
    ):
        """Opens the cameras.

        Args:
          sources: numbers of cameras, or addresses such as rtsp://...
          size: width and height of the pictures, pixels.
          rate: pictures in a second, Hz.
          exposure: as it is set in the cameras, s; it is not set here.
          transport: from the end of the exposure until a picture has arrived, s.
        """
        self.size = size
        self._behind = transport + 0.5 * exposure
        self._captures = []
        for source in sources:
            capture = cv2.VideoCapture(int(source) if source.isdigit() else source)
            if not capture.isOpened():
                raise SystemExit(f"the camera {source} does not open; give its number or address")
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
            capture.set(cv2.CAP_PROP_FPS, rate)
            # An old picture in a buffer would be taken for a new one.
            capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
            self._captures.append(capture)

    def read(self) -> tuple[tuple[np.ndarray, ...], float]:
        """The next pair of pictures, and the middle of its exposure (s, of `time.monotonic`)."""
        # Both are grabbed before either is decoded, which takes milliseconds.
        if not all(capture.grab() for capture in self._captures):
            raise SystemExit("a camera gives no picture; check its cable")
        taken = time.monotonic() - self._behind
        pictures = tuple(capture.retrieve()[1] for capture in self._captures)
        for picture in pictures:
            height, width = picture.shape[:2]
            if (width, height) != self.size:
                raise SystemExit(
                    f"a camera gives pictures of {width} x {height}, not {self.size[0]} x "
                    f"{self.size[1]}; set the camera, or calibrate with --size {width} {height}"
                )
        return pictures, taken

    def read_newest(self) -> tuple[np.ndarray, ...]:
        """A pair that was exposed after this call: older ones may wait in the cameras' buffers."""
        for _ in range(_BUFFERED):
            self.read()
        return self.read()[0]


def calibrate_by_hand(args: argparse.Namespace) -> None:
    """Asks for one pose after the other, and writes the cameras."""
    if not args.cameras.parent.is_dir():
        raise SystemExit(
            f"there is no folder {args.cameras.parent} for {args.cameras.name}; make it"
        )
    metadata = load_policy(args.policy).metadata
    size = tuple(args.size)
    sources = Sources(args.sources, size, args.rate, args.exposure, args.transport)
    rough = [
        rough_camera(place, args.gaze, size, args.field_of_view)
        for place in (args.first, args.second)
    ]
    poses = plan_poses(metadata, rough, size)
    input("Take the ball away, keep the arm out of the pictures if you can, and press Enter.")
    backgrounds = sources.read_newest()
    print("Fix the ball to the middle of the paddle.")
    pixels = np.full((2, len(poses), 2), np.nan)
    for pose, angles in enumerate(poses):
        text = ", ".join(
            f"{name} {angle:.3f}" for name, angle in zip(metadata.joint_names, angles, strict=True)
        )
        input(f"{pose + 1} of {len(poses)}: move the arm to {text} (rad), and press Enter.")
        pictures = sources.read_newest()
        for k, picture in enumerate(pictures):
            pixels[k, pose] = find_fixed_ball(
                metadata, rough[k], angles, picture, COLOURS[args.ball], backgrounds[k]
            )
    calibration = calibrate(metadata, rough, poses, pixels)
    print(calibration.report())
    save_cameras(args.cameras, calibration.cameras, size)
    print(report_height(calibration.cameras, size, metadata))


def watch(args: argparse.Namespace) -> None:
    """Prints the ball's place for each pair of pictures."""
    cameras, size = load_cameras(args.cameras)
    tracker = Tracker(cameras, COLOURS[args.ball], args.exposure)
    sources = Sources(args.sources, size, args.rate, args.exposure, args.transport)
    print("learning the background: keep the ball out of the pictures")
    tracker.learn_background([sources.read()[0] for _ in range(20)])
    while True:
        pictures, taken = sources.read()
        fix = tracker.update(pictures, taken)
        if fix is not None:
            x, y, z = fix.position
            print(f"{fix.time:.4f} s: x {x:.4f}, y {y:.4f}, z {z:.4f} m, {fix.error:.2f} pixels")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    programs = parser.add_subparsers(required=True)
    by_hand = programs.add_parser("calibrate", help="find the cameras with the arm itself")
    by_hand.add_argument("policy", help="policy for the arm: name, file or run")
    watching = programs.add_parser("watch", help="print where the ball is")
    for program, function in ((by_hand, calibrate_by_hand), (watching, watch)):
        program.set_defaults(function=function)
        program.add_argument("cameras", type=Path, help="JSON file of the calibrated cameras")
        program.add_argument("--sources", nargs=2, default=["0", "1"], help="numbers or addresses")
        program.add_argument("--ball", choices=list(COLOURS), default="orange")
        program.add_argument("--rate", type=float, default=120.0, help="Hz")
        program.add_argument("--exposure", type=float, default=0.004, help="s")
        program.add_argument("--transport", type=float, default=0.004, help="s")
    place = {"nargs": 3, "type": float, "metavar": ("X", "Y", "Z")}
    by_hand.add_argument("--first", **place, default=(1.45, 0.85, 0.75), help="by tape, m")
    by_hand.add_argument("--second", **place, default=(1.45, -0.85, 0.75), help="by tape, m")
    by_hand.add_argument("--gaze", **place, default=(0.59, 0.0, 0.48), help="where both look, m")
    by_hand.add_argument("--size", nargs=2, type=int, default=(640, 480), help="pixels")
    by_hand.add_argument("--field-of-view", type=float, default=60.0, help="horizontal, degrees")
    args = parser.parse_args()
    args.function(args)


if __name__ == "__main__":
    main()
