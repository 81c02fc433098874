"""The line that a viewer draws behind the ball."""

import numpy as np

from bounce_mjx.viewers.simulation import EnvFrame

TRAIL_SECONDS = 0.6
"""Age of the end of the line, s."""
TRAIL_RGB = np.array([235.0, 85.0, 0.0])
"""Colour of its newest part, from 0 to 255."""


class Trail:
    """The last positions of the balls of N environments, in frames that are `dt` seconds apart."""

    def __init__(self, dt: float):
        self.length = round(TRAIL_SECONDS / dt)
        """Number P of positions."""
        self.points: np.ndarray | None = None
        """Positions [P, N, B, 3], the oldest first, m; where an episode is shorter, its first
        position comes several times. None before the first frame."""

    def add(self, frame: EnvFrame) -> None:
        """Adds a frame's positions."""
        if self.points is None:
            self.points, self._time = np.tile(frame.balls, (self.length, 1, 1, 1)), frame.time
        self.points = np.concatenate([self.points[1:], frame.balls[None]])
        restarted = frame.time < self._time
        self.points[:, restarted] = frame.balls[restarted]
        self._time = frame.time
