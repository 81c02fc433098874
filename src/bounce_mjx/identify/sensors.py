"""What a log's sensors are like, from the log alone: their noise, and the camera's rate."""

import numpy as np
from numpy.polynomial.polynomial import polyfit

from bounce_mjx.identify.fit import Noise
from bounce_mjx.identify.log import Log

# Longest time between two pictures of one flight, s.
_TOGETHER = 0.1


def sensor_noise(log: Log) -> Noise:
    """The sensors' noise, from differences that no motion explains: of third order, in the quietest
    quarter of the log."""
    weights = np.array([1.0, -3.0, 3.0, -1.0]) / np.sqrt(20.0)
    third = np.stack([np.convolve(a, weights, "valid") for a in log.joint_angles.T], axis=1)
    parts = np.array_split(third**2, max(len(third) // 200, 1))
    means = np.sort([np.mean(part, axis=0) for part in parts], axis=0)
    angles = np.sqrt(means[len(means) // 4])
    balls = np.full(3, 0.002)
    if len(log.ball_positions) > 200:
        # Unequal intervals, as pictures are lost: a parabola through five neighbours.
        t = log.picture_times
        rests = []
        for i in range(2, len(t) - 2, 2):
            near = slice(i - 2, i + 3)
            if t[i + 2] - t[i - 2] < 0.08:
                fitted = polyfit(t[near] - t[i], log.ball_positions[near], 2, full=True)
                rests.append(fitted[1][0] / 2.0)
        if len(rests) > 50:
            # Of a sum of two squared normal numbers, the median is 1.386 times the variance.
            balls = np.sqrt(np.median(rests, axis=0) * 2.0 / 1.386)
    return Noise(np.maximum(angles, 1e-5), np.maximum(balls, 1e-4))


def measure_camera(log: Log) -> tuple[float, float] | None:
    """Rate of the pictures (Hz), and share of them that were lost; None for fewer than 50.

    A picture that came together with a later one, between two control steps, is not lost.
    """
    intervals = np.diff(log.picture_times)
    steps = np.searchsorted(log.times, log.arrivals)
    together = intervals < _TOGETHER
    if np.sum(together) < 50:
        return None
    intervals = intervals[together]
    period = float(np.median(intervals))
    for _ in range(3):
        # Stamps that are rounded, or of every second picture at times, have another median.
        periods = np.maximum(np.round(intervals / period), 1.0)
        period = float(np.sum(intervals) / np.sum(periods))
    missing = periods - 1.0
    if np.mean(np.isin(log.arrivals, log.times)) > 0.9:
        missing = np.minimum(missing, np.maximum(np.diff(steps)[together] - 1.0, 0.0))
    return 1.0 / period, float(np.sum(missing) / (len(missing) + np.sum(missing)))
