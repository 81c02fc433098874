"""A camera that sees the balls of a simulated arm: at its rate, late, noisy, and with lost
pictures."""

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from bounce_mjx.robot.model import BallAddresses

# Times are sums of steps, which rounding makes a little too small or too large, s.
_ROUNDING = 1e-9
# Shorter times between two pictures give no velocity, s.
_SHORTEST = 1e-3


class Picture(NamedTuple):
    """What a picture shows."""

    taken: float
    """Time, s."""
    positions: np.ndarray
    """Of the balls [B, 3], m."""
    velocities: np.ndarray
    """Of the balls [B, 3], m/s, by a sensor of their own."""


class Camera:
    """The camera of a world: its rate, its latency and its errors."""

    def __init__(
        self,
        balls: Sequence[BallAddresses],
        world: Mapping[str, Any],
        differences: bool,
        random: np.random.Generator,
    ):
        """A camera without a picture.

        Args:
          balls: that it sees.
          world: value of each term of the randomisation; without `camera_rate`, there is a picture
            of each physics step.
          differences: whether its velocities are those between two pictures, and not measured.
          random: of its errors.
        """
        self.balls = balls
        self.world = world
        self._differences = differences
        self._random = random
        self._underway: deque[Picture] = deque()
        """Taken, and not arrived yet."""
        self.newest: Picture | None = None
        """The last that arrived."""
        self.before: Picture | None = None
        """The last but one."""
        self._next = 0.0
        """Time of the next picture, s."""

    def look(self, data: mujoco.MjData) -> None:
        """Takes a picture if one is due. Called after each physics step."""
        if data.time < self._next - _ROUNDING:
            return
        rate = self.world.get("camera_rate")
        self._next = data.time if rate is None else self._next + 1.0 / rate
        if self._random.random() < self.world.get("frame_drop", 0.0):
            return
        positions = np.array([data.qpos[list(ball.qpos[:3])] for ball in self.balls])
        velocities = np.array([data.qvel[list(ball.qvel[:3])] for ball in self.balls])
        seen = Picture(
            taken=data.time,
            positions=self._with_errors("ball_position", positions),
            velocities=self._with_errors("ball_velocity", velocities),
        )
        self._underway.append(seen)

    def _with_errors(self, name: str, values: np.ndarray) -> np.ndarray:
        noise = self.world.get(f"{name}_noise", 0.0) * self._random.standard_normal(values.shape)
        return values + noise + self.world.get(f"{name}_bias", 0.0)

    def measure(self, time: float) -> dict[str, Any]:
        """The newest picture that has arrived at a time (s); empty before the first one."""
        latency = self.world.get("ball_latency", 0.0)
        while self._underway and self._underway[0].taken <= time - latency + _ROUNDING:
            self.before = self.newest
            self.newest = self._underway.popleft()
        if self.newest is None:
            return {}
        velocities = self.newest.velocities
        if self._differences:
            before = self.before or self.newest
            elapsed = max(self.newest.taken - before.taken, _SHORTEST)
            velocities = (self.newest.positions - before.positions) / elapsed
        return {
            "ball_position": np.squeeze(self.newest.positions).copy(),
            "ball_velocity": np.squeeze(velocities).copy(),
            "ball_age": time - self.newest.taken,
        }


class NoCamera:
    """Nobody looks for a ball."""

    def look(self, data: mujoco.MjData) -> None:
        """Sees nothing."""

    def measure(self, time: float) -> dict[str, Any]:
        """Nothing."""
        return {}
