"""A direct fit of one flight of a ball, from which a search begins.

Under gravity g, drag k and lift by a constant spin, a ball with the velocity v accelerates by
g - k |v| v + l x v, where l is the spin times a coefficient. For a known v(t), its path is linear
in the start, in l and in k.
"""

from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyfit
from scipy.integrate import cumulative_trapezoid

GRAVITY = np.array([0.0, 0.0, -9.81])
"""m/s^2."""
_STEP = 2e-3
_ITERATIONS = 4


class Flight(NamedTuple):
    """A flight's start, at the time 0."""

    position: np.ndarray
    """[3], m."""
    velocity: np.ndarray
    """[3], m/s."""
    lift: np.ndarray
    """Spin times the coefficient of lift [3], 1/s."""
    drag_deviation: float
    """Relative deviation of its drag from the one that was expected."""


def acceleration(velocity: np.ndarray, drag: np.ndarray | float, lift: np.ndarray) -> np.ndarray:
    """Acceleration [..., 3] of a ball in the air, m/s^2.

    Args:
      velocity: [..., 3], m/s.
      drag: [...], 1/m.
      lift: spin times the coefficient of lift [..., 3], 1/s.
    """
    speed = np.linalg.norm(velocity, axis=-1)
    braking = np.asarray(drag * speed)[..., None] * velocity
    return GRAVITY - braking + np.cross(lift, velocity)


def fit_flight(
    times: np.ndarray,
    balls: np.ndarray,
    noise: np.ndarray,
    drag: float,
    lift_deviation: float = 0.0,
    drag_deviation: float = 0.0,
) -> Flight:
    """Fits the start of a flight by least squares, with priors of lift and drag.

    Args:
      times: of the pictures [B], from 0 on, s.
      balls: [B, 3], m.
      noise: standard deviation of each coordinate [3], m.
      drag: the one that is expected, 1/m.
      lift_deviation: standard deviation of each coordinate of the lift, 1/s; 0 for none.
      drag_deviation: standard deviation of the drag, relative; 0 if it is as expected.
    """
    grid = np.arange(0.0, times[-1] + _STEP, _STEP)
    deviations = np.array([*[lift_deviation] * 3, drag_deviation])
    falling = polyfit(times, balls - 0.5 * times[:, None] ** 2 * GRAVITY, 1)
    velocities = falling[1] + grid[:, None] * GRAVITY

    def moved_by(accelerations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Changes of velocity [G, 3] and of place [B, 3] by accelerations [G, 3]."""
        gained = cumulative_trapezoid(accelerations, grid, axis=0, initial=0.0)
        moved = cumulative_trapezoid(gained, grid, axis=0, initial=0.0)
        at_pictures = np.stack([np.interp(times, grid, path) for path in moved.T], axis=1)
        return gained, at_pictures

    for _ in range(_ITERATIONS):
        usual_gain, usual_path = moved_by(acceleration(velocities, drag, np.zeros(3)))
        speeds = np.linalg.norm(velocities, axis=1, keepdims=True)
        pulls = [np.cross(axis, velocities) for axis in np.eye(3)]
        pulls.append(-drag * speeds * velocities)
        unusual = [moved_by(pull) for pull in pulls]
        columns = [np.ones_like(balls)[:, :, None] * np.eye(3)]
        columns.append(times[:, None, None] * np.eye(3))
        columns.append(np.stack([path for _, path in unusual], axis=2) * deviations)
        design = np.concatenate(columns, axis=2) / noise[:, None]
        prior = np.eye(10)[6:]
        solution = np.linalg.lstsq(
            np.concatenate([design.reshape(-1, 10), prior]),
            np.concatenate([((balls - usual_path) / noise).ravel(), np.zeros(4)]),
            rcond=None,
        )[0]
        position = solution[:3]
        velocity = solution[3:6]
        unusual_share = deviations * solution[6:]
        gains = np.stack([gained for gained, _ in unusual], axis=2)
        velocities = velocity + usual_gain + gains @ unusual_share
    return Flight(position, velocity, unusual_share[:3], float(unusual_share[3]))
