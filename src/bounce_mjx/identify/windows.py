"""Windows of a log: pieces of a few tenths of a second, each with one bounce or the arm alone.

A window is simulated from its own start, whose state is estimated too. Errors of the model
therefore do not build up, and a log may have gaps.
"""

from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyfit
from scipy.ndimage import minimum_filter1d

from bounce_mjx.errors import UserError
from bounce_mjx.identify.flight import fit_flight
from bounce_mjx.identify.following import find_settled, find_unknown, is_known
from bounce_mjx.identify.log import Log
from bounce_mjx.identify.unknowns import BALL

MAX_DELAY = 0.08
"""Time before the first picture of a window at which its simulation starts, s; a picture may be
later than what it shows by as much."""
# Flight before and after a bounce that belongs to its window, s, at most. An unbroken flight shows
# gravity and drag with the fifth power of its length, and a bounce scatters: most of each flight
# belongs to the bounce at its end.
_BEFORE = 0.55
_AFTER = 0.2
_AFTER_SHARE = 0.3
_SECONDS = MAX_DELAY + _BEFORE + _AFTER + 0.03
# Shortest window of the arm alone, and twice the shortest flight on a side of a bounce, s.
_SHORTEST = 0.16
_FEWEST = 5
_FEWEST_BOUNCES = 3
# Every fifth window is held out of the search for the unknowns until its last stage. Its residuals
# give its outliers less weight, as in all windows, and choose between hypotheses.
_HELD_OUT = 5
_MOST = 240
_MOST_BALLS = 180
_PADDING = 8
_PICTURE_GAP = 0.06
# Speed that the ball must have before and after a bounce, m/s.
_BOUNCING = 0.5
# Time about a bounce at which pictures do not count, s: a flight's kink has no derivative.
_AT_BOUNCE = 0.01
BEFORE_BOUNCE = 0.012
"""Time before a bounce at which a flight counts as over, s: the camera's jitter, half a contact."""
GUESSED_DRAG = 0.1
"""Drag of a ball with which the first guess of a flight is made, 1/m."""
# Noise of a camera, m.
_GUESSED_NOISE = np.full(3, 2e-3)
# The ball in windows without one, m: so high above a model's origin it touches nothing.
_NO_BALL = np.array([0.0, 0.0, 50.0])


class Windows(NamedTuple):
    """S windows, padded to the same length; a padded measurement has the weight 0."""

    first: np.ndarray
    """Index [S] of the first physics step of each, from `origin`."""
    steps: int
    """Physics steps of each."""
    origin: float
    """Time of the physics step 0, s."""
    angle_times: np.ndarray
    """Times [S, A] of the measured joint angles since the window's start, s."""
    angles: np.ndarray
    """Measured joint angles [S, A, n], rad."""
    angle_weights: np.ndarray
    """1 for a measurement, 0 for padding [S, A]."""
    picture_times: np.ndarray
    """Time stamps [S, B] of the pictures since the window's start, s."""
    balls: np.ndarray
    """The ball in each picture [S, B, 3], m."""
    picture_weights: np.ndarray
    """1 for a picture, 0 for padding and at a bounce [S, B]."""
    bounces: np.ndarray
    """Time [S] of the bounce since the window's start, s, as the pictures are stamped: later than
    the bounce by their latency; NaN for the arm alone."""
    starts: np.ndarray
    """First guess of the state at the start [S, 2 n + 10]: angles, velocities; the ball's position,
    velocity and spin; the relative deviation of its drag."""

    dt: float
    """A physics step, s."""

    def finer(self) -> "Windows":
        """The same windows in physics steps of half the length."""
        return self._replace(first=2 * self.first, steps=2 * self.steps, dt=0.5 * self.dt)

    @property
    def zero(self) -> np.ndarray:
        """Time [S] at which each starts, s."""
        return self.origin + self.first * self.dt

    @property
    def has_ball(self) -> np.ndarray:
        """Which windows [S] show the ball."""
        return np.isfinite(self.bounces)

    @property
    def measured(self) -> np.ndarray:
        """All measurements of each window in a row [S, A n + 3 B]: angles, then balls."""
        return np.concatenate([x.reshape(len(x), -1) for x in (self.angles, self.balls)], axis=1)

    def split(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The angles [..., A, n] and the balls [..., B, 3] of rows [..., A n + 3 B]."""
        angles, balls = np.split(rows, [self.angles[0].size], axis=-1)
        return tuple(
            x.reshape(*rows.shape[:-1], *like.shape[1:])
            for x, like in ((angles, self.angles), (balls, self.balls))
        )

    @property
    def arm_state(self) -> np.ndarray:
        """Which entries [2 n + 10] of a start are the arm's."""
        return np.arange(self.starts.shape[1]) < 2 * self.angles.shape[2]


def cut(log: Log, physics_dt: float) -> Windows:
    """Cuts a log into windows, `_MOST` at most, first those with a bounce: of more, every k-th is
    used.

    Raises:
      UserError: there are fewer than five.
    """
    origin = float(min(log.times[0], log.target_times[0]))
    # A simulation from the window's start cannot show what a picture saw before it.
    earliest = origin + MAX_DELAY
    spans = [(max(b - before, earliest), b + after, b) for b, before, after in _find_bounces(log)]
    # Elsewhere, nothing says how the paddle moved.
    is_shown = is_known(log, np.array([bounce for _, _, bounce in spans]))
    spans = [span for span, shown in zip(spans, is_shown, strict=True) if shown]
    spans += [(start, end, np.nan) for start, end in _find_rests(log, spans)]
    if len(spans) < _FEWEST:
        raise UserError(
            f"{log.source} has {len(spans)} stretches of unbroken joint angles and servo targets; "
            "record at least 5 s"
        )
    if len(spans) > _MOST:
        with_ball = [span for span in spans if np.isfinite(span[2])]
        others = [span for span in spans if not np.isfinite(span[2])]
        with_ball = _thin(with_ball, max(_MOST_BALLS, _MOST - len(others)))
        spans = with_ball + _thin(sorted(others), _MOST - len(with_ball))
    spans.sort()
    # The simulation of a span begins earlier, at the time `zero`: a picture is late.
    begins = [start - MAX_DELAY for start, _, _ in spans]
    first = np.array([int((begin - origin) / physics_dt) for begin in begins], int)
    zero = origin + first * physics_dt
    angle_rows = []
    picture_rows = []
    states = []
    last_end = -np.inf
    settled = find_settled(log)
    bounces = np.array(spans)[:, 2] - zero
    for (start, end, _), begin, bounce in zip(spans, zero, bounces, strict=True):
        # Each angle counts in one window.
        inside = (log.times >= max(begin, last_end)) & (log.times < end) & settled
        seen = (log.picture_times >= start) & (log.picture_times <= end) & np.isfinite(bounce)
        angle_rows.append(np.flatnonzero(inside))
        picture_rows.append(np.flatnonzero(seen))
        ball = _ball_start(log, picture_rows[-1], bounce, begin)
        states.append(np.concatenate([_joint_start(log, begin), ball]))
        last_end = end
    angle_times, angles, angle_weights = _pad(angle_rows, log.times, zero, log.joint_angles)
    picture_times, balls, picture_weights = _pad(
        picture_rows, log.picture_times, zero, log.ball_positions
    )
    near = np.abs(picture_times - bounces[:, None]) < _AT_BOUNCE
    return Windows(
        first=first,
        steps=round(_SECONDS / physics_dt),
        origin=origin,
        angle_times=angle_times,
        angles=angles,
        angle_weights=angle_weights,
        picture_times=picture_times,
        balls=balls,
        picture_weights=np.where(near, 0.0, picture_weights),
        bounces=bounces,
        starts=np.stack(states),
        dt=physics_dt,
    )


def _thin(spans: list, most: int) -> list:
    """At most some of the spans, evenly over the log."""
    if len(spans) <= most:
        return spans
    return [spans[i] for i in np.linspace(0, len(spans) - 1, most).round().astype(int)]


def _find_bounces(log: Log) -> list[tuple[float, float, float]]:
    """Time stamp of each bounce, and the time before and after it in free flight, s."""
    found = []
    times = log.picture_times
    balls = log.ball_positions
    for run in np.split(np.arange(len(times)), np.flatnonzero(np.diff(times) > _PICTURE_GAP) + 1):
        if len(run) < 12:
            continue
        t = times[run]
        z = balls[run, 2]
        speed = _slopes(t, z, 3)
        turns = (speed[:-8] < -_BOUNCING) & (speed[8:] > _BOUNCING)
        lowest = 4 + np.flatnonzero(turns & (z == minimum_filter1d(z, 7))[4:-4])
        lowest = [i for j, i in enumerate(lowest) if j == 0 or i - lowest[j - 1] > 3]
        ends = [t[0], *t[lowest], t[-1]]
        for j, i in enumerate(lowest):
            # The first and the last flight of a run belong to one window each, others to two.
            before = t[i] - ends[j]
            after = ends[j + 2] - t[i]
            before -= _share_flight(before) if j > 0 else 0.0
            after = _share_flight(after) if j < len(lowest) - 1 else after
            before = min(before, _BEFORE)
            after = min(after, _AFTER)
            if min(before, after) > 0.5 * _SHORTEST:
                found.append((float(t[i]), float(before), float(after)))
    return found


def _share_flight(flight: float) -> float:
    """Time of a flight that belongs to the bounce at its start, s: enough for the next window to
    start in the air."""
    return float(np.clip(_AFTER_SHARE * flight, min(1.25 * MAX_DELAY, 0.5 * flight), _AFTER))


def _slopes(times: np.ndarray, values: np.ndarray, reach: int) -> np.ndarray:
    """Slope [P] of a line through each point and its neighbours."""
    parts = [slice(max(i - reach, 0), i + reach + 1) for i in range(len(times))]
    return np.array([polyfit(times[p] - times[p.start], values[p], 1)[1] for p in parts])


def _find_rests(log: Log, spans: list[tuple[float, float, float]]) -> list[tuple[float, float]]:
    """Times between the windows with a ball, in pieces; in none of them is the arm unknown."""
    taken = [(start, end) for start, end, _ in spans] + find_unknown(log)
    pieces = []
    begin = log.times[0]
    for start, end in sorted(taken):
        length = start - begin
        if length > _SHORTEST:
            count = int(np.ceil(length / (_BEFORE + _AFTER)))
            edges = np.linspace(begin, start, count + 1)
            pieces += list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))
        begin = max(begin, end)
    return pieces


def _pad(
    indices: list[np.ndarray], times: np.ndarray, zero: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times since each window's start [S, M], values [S, M, k] and weights [S, M]."""
    # In steps, so that a simulation that was compiled for one log serves others.
    most = -(-max([len(index) for index in indices] + [1]) // _PADDING) * _PADDING
    padded = np.zeros((len(indices), most))
    weights = np.zeros_like(padded)
    kept = np.zeros((*padded.shape, values.shape[1]))
    for s, index in enumerate(indices):
        padded[s, : len(index)] = times[index] - zero[s]
        weights[s, : len(index)] = 1.0
        kept[s, : len(index)] = values[index]
    return padded, kept, weights


def _joint_start(log: Log, time: float) -> np.ndarray:
    """Angles and velocities [2 n] at a time, by a parabola through the measurements near it; in a
    gap or before the first one, the nearest angles at rest."""
    near = np.argsort(np.abs(log.times - time))[:9]
    t = log.times[near] - time
    if np.min(t) > 0.0 or np.max(t) < 0.0:
        nearest = log.joint_angles[near[0]]
        return np.concatenate([nearest, np.zeros_like(nearest)])
    return polyfit(t, log.joint_angles[near], 2)[:2].ravel()


def _ball_start(log: Log, pictures: np.ndarray, bounce: float, zero: float) -> np.ndarray:
    """Position, velocity, spin and deviation of the drag [10] of the ball at a time, by a flight
    without spin through the pictures before the bounce."""
    if not len(pictures):
        return np.concatenate([_NO_BALL, np.zeros(7)])
    times = log.picture_times[pictures] - zero
    before = times < bounce - BEFORE_BOUNCE
    shown = times[before] - BALL["ball_latency"].mean
    balls = log.ball_positions[pictures][before]
    flight = fit_flight(shown, balls, _GUESSED_NOISE, GUESSED_DRAG)
    return np.concatenate([flight.position, flight.velocity, np.zeros(4)])


def cut_enough(log: Log, physics_dt: float) -> Windows:
    """The windows of a log; of the arm alone if it has too few bounces for the unknowns of the
    ball, as the arm's unknowns would make good for these."""
    windows = cut(log, physics_dt)
    if np.sum(windows.has_ball) >= _FEWEST_BOUNCES:
        return windows
    none = np.zeros(0)
    of_arm = log._replace(picture_times=none, ball_positions=np.zeros((0, 3)), arrivals=none)
    return cut(of_arm, physics_dt)


def is_seen(windows: Windows) -> np.ndarray:
    """Which windows [S] the search sees before its last stage: all but every fifth; of a log whose
    few bounces are all in these, all but those before them."""
    place = np.arange(len(windows.first)) % _HELD_OUT
    seen = place != _HELD_OUT - 1
    if np.any(windows.has_ball) and not np.any(windows.has_ball & seen):
        return place != _HELD_OUT - 2
    return seen


def held_out_rows(log: Log, windows: Windows) -> np.ndarray:
    """Which joint angles [T] of a log are in windows that the search does not see."""
    rows = np.zeros(len(log.times), bool)
    for s in np.flatnonzero(~is_seen(windows)):
        used = windows.angle_times[s, windows.angle_weights[s] > 0.0]
        if len(used):
            times = log.times - windows.zero[s]
            rows |= (times > used[0] - 1e-6) & (times < used[-1] + 1e-6)
    return rows
