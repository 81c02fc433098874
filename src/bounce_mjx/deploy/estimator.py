"""The Kalman filter of the ball in NumPy: the twin of `world/estimator.py`, by the same code."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from bounce_mjx.deploy.chain import Chain
from bounce_mjx.deploy.metadata import Metadata
from bounce_mjx.world.ball_filter import BallFilter

# Time of control steps whose planes of the paddle are kept, s.
_MEMORY = 0.3


class RobotEstimator:
    """The filter with its track of one ball."""

    def __init__(
        self, metadata: Metadata, position: np.ndarray, joint_angles: np.ndarray, age: float
    ):
        """Starts with a ball at rest.

        Args:
          position: measured position of the ball [3], m.
          joint_angles: measured joint angles [J], rad.
          age: time since the picture was taken, s.
        """
        self._chain, self._control_dt = Chain(metadata), metadata.control_dt
        self._filter = BallFilter(metadata.estimator, metadata.control_dt, np, _repeat)
        self._track = self._filter.start(position, np.float64(age))
        count = math.ceil(_MEMORY / metadata.control_dt) + 1
        self._planes = np.tile(self._filter.plane(*self._chain.paddle(joint_angles)), (count, 1))

    def add(
        self, position: np.ndarray | None, age: float, joint_angles: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Estimated position [3] (m) and velocity [3] (m/s) of the ball at the next control step.

        Args:
          position: position [3] in a new picture, m; None if there is none.
          age: time since the new picture was taken, s.
          joint_angles: measured joint angles [J], rad.
        """
        self._planes[1:] = self._planes[:-1].copy()
        self._planes[0] = self._filter.plane(*self._chain.paddle(joint_angles))
        track = self._track._replace(age=self._track.age + self._control_dt)
        planes = self._planes[: math.ceil(track.age / self._control_dt - 1e-6) + 1]
        if position is not None:
            track = self._filter.add_picture(track, planes, position, np.float64(age))
        self._track = track
        return self._filter.present(track, planes)


def _repeat(count: int, function: Callable[[Any], Any], start: Any) -> Any:
    for _ in range(count):
        start = function(start)
    return start
