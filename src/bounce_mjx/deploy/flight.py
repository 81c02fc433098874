"""Whether a ball falls: away from the paddle, its last pictures lie on a parabola of gravity's
curvature; near it, where it bounces, they do not lie on a straight line, as those of a ball that a
hand holds or carries do, unless the task lets the ball rest; and seen from above it runs on, so
that a picture lies between its neighbours.

In free flight a ball's places are x0 + v t + g t^2 / 2. What is left of them after the least
squares in x0 and v is judged in three directions: the largest of single pictures; the part along
t^2, which is a wrong acceleration (0 of a ball that a hand holds); and the largest along a step,
which is a camera that was bumped, or another ball from a picture on. All are projections on a unit
vector, so that noise is as large in each, and one bound holds for all.
"""

import bisect
import math
from typing import NamedTuple

import numpy as np

from bounce_mjx.deploy.metadata import Metadata, largest_term

GRAVITY = 9.81
"""m/s^2"""

# Pictures that count, s.
_WINDOW = 0.25
# Noise of a picture in standard deviations along an axis, of which 1e6 pictures have no larger one,
# and how many times that it is in a plane; the least standard deviation, m; and that of a picture's
# time, s.
_DEVIATIONS = 5.0
_IN_PLANE = 1.07
_LEAST_NOISE = 0.008
_TIMING = 0.003
# What a sudden change of velocity leaves of N pictures at most, in a unit vector's direction as a
# share of its size, their duration and the root of N, and in a single picture (both of 3 pictures).
_KINK = 0.12
_KINK_ALONE = 0.17
# Largest drag of the air with a spin's lift, as a share of the squared speed, 1/m.
_DRAG = 0.25
# Speed at which a ball leaves the paddle, m/s, and the height above the paddle's centre at which it
# may touch: its radius, half of the paddle, and the errors of the camera and of the arm, m.
_IMPACT_SPEED = 5.0
_TOUCH = 0.07
# Horizontal distance from the paddle's centre at which it may touch, m.
_REACH = 0.15
# Time in which a ball near the paddle leaves the straight line on which a hand would carry it, and
# the time in which it is seen to fall, s.
_HELD = 0.4
_LEAVING = 2.0
# Pictures in 0.4 s, of which fewer do not tell a line from bounces.
_FEW = 5
# How far the root mean square of noise may be above its standard deviation, in deviations of it.
_ABOVE = 3.5
# Pictures of a ball near the paddle of which most lie between their neighbours (an impact is one
# that need not), as far as the noise allows in standard deviations; and how many times that of a
# picture the deviation of such a difference is, at most.
_NEIGHBOURS = 6
_BETWEEN = 3.0
_OF_THREE = 1.4


class Near(NamedTuple):
    """A ball near the paddle that was not seen to fall since."""

    since: float
    """The time of its first picture, s."""
    pictures: np.ndarray
    """The time (s) and the ball's place (m) of those in the last 0.4 s [N, 4]."""


class Flight(NamedTuple):
    """The pictures of a ball since it was last near the paddle."""

    pictures: np.ndarray
    """The time (s) and the ball's place (m) of those in the last 0.25 s [N, 4]."""
    height: float
    """Of the last one above the paddle, m."""
    is_over: bool
    """Whether the last one was over the paddle."""
    near: Near | None
    """None of a ball that was seen to fall since it was near the paddle."""


class FlightBounds(NamedTuple):
    """What a policy's balls may do."""

    noise: float
    """Standard deviation of a picture along an axis, m."""
    push: float
    """Largest sideways push in flight, m/s."""
    speed: float
    """Largest speed of a ball, m/s."""
    may_rest: bool
    """Whether the ball may rest on the paddle."""
    dt: float
    """Duration of a control step, s."""


def flight_bounds(metadata: Metadata) -> FlightBounds:
    """The bounds of the training's worlds."""
    return FlightBounds(
        noise=max(largest_term(metadata, "ball_position_noise"), _LEAST_NOISE),
        push=largest_term(metadata, "push_speed"),
        speed=metadata.ball.speed,
        may_rest=metadata.ball_rests,
        dt=metadata.control_dt,
    )


def may_lie(bounds: FlightBounds, place: np.ndarray, paddle: np.ndarray) -> bool:
    """Whether a ball may rest at its place [3], m: on the paddle, whose centre is at [3], m."""
    x, y, height = place - paddle
    return bounds.may_rest and math.hypot(x, y) < _REACH and abs(height) < _TOUCH


class Fit(NamedTuple):
    """Pictures against a ball's fall."""

    ratio: float
    """What is left, as a share of the bound; above 1, the ball does not fall. Below 1 it may be
    less."""
    is_known: bool
    """Whether a ball at rest would be above 1; if not, a ratio below 1 says nothing."""


def fit_fall(times: np.ndarray, places: np.ndarray, noise: float, push: float = 0.0) -> Fit:
    """Compares pictures with a ball in free flight.

    Args:
      times: [N], s.
      places: [N, 3], m.
      noise: standard deviation of a place along an axis, m.
      push: largest sideways push that the ball may have had, m/s.
    """
    count = len(times)
    if count < 3:
        return Fit(0.0, False)
    # From the newest picture on, and without the fall a ball's places lie on a line over time.
    columns = np.empty((count, 6))
    columns[:, 0] = 1.0
    columns[:, 1] = t = times - times[-1]
    columns[:, 2] = squares = t * t
    columns[:, 3:] = places - places[-1]
    columns[:, 5] += 0.5 * GRAVITY * squares
    means, slopes, sizes, spread = _lines((columns.T @ columns).tolist(), count)
    mean_time = means[0]
    bend_size, *whole = sizes
    vx, vy, vz = slopes[1:]
    squared_speed = vx**2 + vy**2 + (vz - GRAVITY * mean_time) ** 2 + GRAVITY**2 * spread / count
    bound = _DEVIATIONS * math.sqrt(noise**2 + _TIMING**2 * squared_speed)
    at_rest = 0.5 * GRAVITY * bend_size
    is_known = at_rest > _DEVIATIONS * noise
    # No projection is longer than the whole, which mostly is short enough.
    most = math.hypot(*whole) / bound
    if most <= 1.0:
        return Fit(most, is_known)
    t = t - mean_time
    residuals = columns[:, 2:] - means[1:] - t[:, None] * slopes
    bend = residuals[:, 0]
    left = residuals[:, 1:]
    along = (bend @ left / bend_size).tolist()
    drag = 0.5 * _DRAG * squared_speed
    alone_bound = bound + drag * float(np.abs(bend).max())
    along_bound = bound + drag * bend_size
    steps = _along_steps(t, spread, left).tolist()
    sizes = np.abs(left).max(axis=0).tolist()
    pushed = push * float(times[-1] - times[0])
    alone_pushed = _IN_PLANE * alone_bound + _KINK_ALONE * pushed
    along_pushed = _IN_PLANE * along_bound + _KINK * math.sqrt(count) * pushed
    ratio = max(
        sizes[2] / alone_bound,
        abs(along[2]) / along_bound,
        steps[2] / along_bound,
        math.hypot(sizes[0], sizes[1]) / alone_pushed,
        math.hypot(along[0], along[1]) / along_pushed,
        math.hypot(steps[0], steps[1]) / along_pushed,
    )
    return Fit(ratio, is_known)


def _lines(
    products: list[list[float]], count: int
) -> tuple[list[float], list[float], list[float], float]:
    """Least squares in 1 and t of some columns over a number of pictures.

    Args:
      products: sums of the products of each two of the columns 1, t, and these.

    Returns:
      The means of t and of the columns; the slopes of the columns, the sizes of what is left of
      them, and the sum of the squares of t less its mean.
    """
    totals = products[0]
    means = [total / count for total in totals[1:]]
    spread = products[1][1] - totals[1] * means[0]
    slopes = []
    sizes = []
    for column in range(2, len(totals)):
        slope = (products[1][column] - totals[column] * means[0]) / spread
        square = products[column][column] - totals[column] * means[column - 1]
        slopes.append(slope)
        # Rounding may take it a little below 0.
        sizes.append(math.sqrt(max(square - slope**2 * spread, 0.0)))
    return means, slopes, sizes, spread


def _along_steps(t: np.ndarray, spread: float, left: np.ndarray) -> np.ndarray:
    """The largest parts [3] of residuals [N, 3] along a step between two pictures, of all steps.

    Args:
      t: times [N] less their mean, s.
      spread: sum of their squares.
    """
    count = len(t)
    before = np.arange(1, count)
    # A step is 0, then 1, less its own least squares in 1 and t.
    times_before = t.cumsum()[:-1]
    squared_size = before * (1.0 - before / count) - times_before * times_before / spread
    parts = left.cumsum(axis=0)[:-1]
    return np.sqrt((parts * parts / squared_size[:, None]).max(axis=0))


def begin(time: float, place: np.ndarray, paddle: np.ndarray) -> Flight:
    """The flight of a first picture.

    Args:
      time: when it was taken, s.
      place: of the ball [3], m.
      paddle: the paddle's centre then [3], m.
    """
    return Flight(_picture(time, place), float(place[2] - paddle[2]), False, None)


def follow(
    bounds: FlightBounds, flight: Flight, time: float, place: np.ndarray, paddle: np.ndarray
) -> tuple[Flight, str | None]:
    """The flight with a new picture, and why the ball cannot be there; None if it can.

    Args:
      flight: of the pictures before.
      time: when it was taken, s.
      place: of the ball [3], m.
      paddle: the paddle's centre then [3], m.
    """
    last_time, *last_place = flight.pictures[-1].tolist()
    since = time - last_time
    x, y, height = (place - paddle).tolist()
    moved = math.dist(place.tolist(), last_place)
    reach = bounds.speed * max(since, bounds.dt) + _DEVIATIONS * math.sqrt(2.0) * bounds.noise
    if moved > reach:
        reason = f"is {moved:.3g} m from {1e3 * since:.0f} ms before, farther than it flies"
        return flight, reason
    is_over = math.hypot(x, y) < _REACH
    low = height + flight.height - 2.0 * _TOUCH < _IMPACT_SPEED * since
    if low and is_over and (flight.is_over or len(flight.pictures) == 1):
        return _touching(bounds, flight, _picture(time, place), height)
    pictures = _followed(flight.pictures, _picture(time, place), _WINDOW)
    fit = fit_fall(pictures[:, 0], pictures[:, 1:], bounds.noise, bounds.push)
    if fit.ratio > 1.0:
        seconds = time - pictures[0, 0]
        return flight, f"has not fallen as a ball does for {1e3 * seconds:.0f} ms"
    # A ball at which the paddle swings comes and goes, and has left when it is seen to fall.
    near = None
    if flight.near is not None and not fit.is_known:
        near = _still_near(flight.near, pictures[-1:])
    return Flight(pictures, height, is_over, near), None


def _picture(time: float, place: np.ndarray) -> np.ndarray:
    """A picture's time (s) and its ball's place [3] (m) [1, 4]."""
    return np.array([[time, *place.tolist()]])


def _followed(pictures: np.ndarray, newest: np.ndarray, duration: float) -> np.ndarray:
    """Pictures [N, 4] with another one [1, 4], of a duration, s."""
    first = bisect.bisect_right(pictures[:, 0], newest[0, 0] - duration)
    return np.concatenate([pictures[first:], newest])


def _touching(
    bounds: FlightBounds, flight: Flight, picture: np.ndarray, height: float
) -> tuple[Flight, str | None]:
    """A picture [1, 4] before which the ball may have touched the paddle: a new flight begins."""
    near = flight.near
    if near is None:
        near = Near(float(flight.pictures[-1, 0]), flight.pictures[-1:])
    near = _still_near(near, picture)
    if _goes_to_and_fro(near, bounds.noise):
        return flight, "goes to and fro, as two things would that look like it"
    if not bounds.may_rest and len(near.pictures) >= _FEW:
        seconds = float(picture[0, 0]) - near.since
        if seconds > _HELD and _is_straight(near, bounds.noise):
            reason = f"has been near the paddle for {seconds:.2g} s as if it lay or were held there"
            return flight, reason
        if seconds > _LEAVING:
            reason = f"has been near the paddle for {seconds:.2g} s, where it bounces off"
            return flight, reason
    return Flight(picture, height, True, near), None


def _still_near(near: Near, picture: np.ndarray) -> Near:
    """With one more picture [1, 4]."""
    return Near(near.since, _followed(near.pictures, picture, _HELD))


def _is_straight(near: Near, noise: float) -> bool:
    """Whether the heights are those of a constant velocity, but for a noise (m)."""
    count = len(near.pictures)
    times = near.pictures[:, 0]
    t = times - times.mean()
    heights = near.pictures[:, 3]
    left = heights - heights.mean()
    left -= t * ((t @ left) / (t @ t))
    # The root mean square of n values of deviation 1 has a deviation of 1 / sqrt(2 n).
    bound = 1.0 + _ABOVE / math.sqrt(2.0 * (count - 2))
    return math.sqrt((left @ left) / (count - 2)) < bound * noise


def _goes_to_and_fro(near: Near, noise: float) -> bool:
    """Whether most of the last pictures lie beside the way of a ball between their neighbours, seen
    from above, but for a noise (m): they are of two things."""
    if len(near.pictures) < _NEIGHBOURS:
        return False
    times = near.pictures[-_NEIGHBOURS:, 0]
    places = near.pictures[-_NEIGHBOURS:, 1:3]
    duration = times[2:] - times[:-2]
    share = ((times[1:-1] - times[:-2]) / duration)[:, None]
    chord = places[2:] - places[:-2]
    beside = places[1:-1] - places[:-2] - share * chord
    speed = np.hypot(chord[:, 0], chord[:, 1]) / duration
    allowed = _BETWEEN * _OF_THREE * np.hypot(noise, _TIMING * speed)
    return bool(np.sum(np.hypot(beside[:, 0], beside[:, 1]) > allowed) > 0.5 * len(beside))
