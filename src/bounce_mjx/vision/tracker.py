"""The ball from pairs of pictures, one pair after the other."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bounce_mjx.deploy import flight
from bounce_mjx.vision.camera import Camera, triangulate
from bounce_mjx.vision.circles import (
    CLEAR_SCORE,
    COLOURS,
    RADIUS_TOLERANCE,
    Circle,
    Colour,
    Expected,
    find_circles,
)

GRAVITY = np.array([0.0, 0.0, -flight.GRAVITY])
"""m/s^2"""
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


class Fix(NamedTuple):
    """A measured place of the ball."""

    time: float
    """Middle of the exposure, s."""
    position: np.ndarray
    """In the robot's frame [3], m."""
    error: float
    """Largest distance from a circle's centre to the ball's projection, pixels."""


class Tracker:
    """Places of the ball from pairs of pictures, one pair after the other."""

    def __init__(
        self,
        cameras: Sequence[Camera],
        colour: Colour = COLOURS["white"],
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
            if score <= CLEAR_SCORE:
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
            if abs(circle.radius - radius) > RADIUS_TOLERANCE * radius:
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
