"""Least squares over the unknowns of the world and the states at the windows' starts.

The residuals are in units of each sensor's noise. The starts, thousands of numbers of which each
matters in one window, are eliminated inside every step: the variable projection of Golub and
Pereyra (1973) in the linearised problem, by one QR decomposition for each window.
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from bounce_mjx.identify.simulation import CHUNK, Predicted, Simulate
from bounce_mjx.identify.unknowns import Layout
from bounce_mjx.identify.windows import Windows

# Deviation of the guessed starts, and the differences for their derivatives: angles (rad), joint
# velocities (rad/s); the ball's position (m), velocity (m/s) and spin (rad/s).
_START_DEVIATIONS = (0.01, 1.0, 0.1, 3.0, 10.0)
_START_STEPS = (3e-3, 0.1, 0.01, 0.1, 5.0)
# Levenberg and Marquardt's dampings, and shares of the change of the starts, that a step tries side
# by side: the best damping for all, and the best share for each window.
_DAMPINGS = np.array([0.0, 1e-2, 0.3, 10.0])
_SHARES = np.array([1.0, 0.3])
_CONVERGED = 0.3
# Residuals of pictures beyond this many standard deviations lose weight (Huber 1964).
_HUBER = 3.0
# Mean squared residual of the pictures of a window beyond which the ball was not in free flight.
_NO_FLIGHT = 25.0
_WORST = 30.0


# Deviation of a bounce from the model's: of the ball's velocity after it along x, y and z, m/s. A
# real paddle is not the same everywhere; and a simulated bounce depends by as much on where in a
# physics step it begins, which makes the fit smooth only with this freedom.
_BOUNCE_DEVIATION = (0.02, 0.02, 0.1)


class Noise(NamedTuple):
    """Standard deviations of the sensors."""

    angles: np.ndarray
    """Of each measured joint angle [n], rad."""
    balls: np.ndarray
    """Of each coordinate of a picture [3], m."""


class Fit(NamedTuple):
    """A minimum of the residuals."""

    vector: np.ndarray
    """The unknowns [P]."""
    starts: np.ndarray
    """States at the windows' starts [S, D]."""
    information: np.ndarray
    """Information [P, P] of the log about the unknowns, without the prior: the inverse of their
    covariance, after the starts are eliminated."""
    predicted: Predicted
    """What the sensors would have measured: [S, A, n] and [S, B, 3]."""
    weights: np.ndarray
    """Weight of each residual [S, A n + 3 B]; 0 for padding and for pictures of no flight."""
    cost: float
    """Half the sum of squared weighted residuals and the prior's."""


class Problem(NamedTuple):
    """The windows of a log and how to simulate them."""

    simulate: Simulate
    windows: Windows
    layout: Layout
    noise: Noise

    def residuals(self, predicted: Predicted) -> np.ndarray:
        """Residuals [C, S, A n + 3 B] in units of the noise."""
        w, count = self.windows, len(predicted.angles)
        angles = (predicted.angles - w.angles) / self.noise.angles
        balls = (predicted.balls - w.balls) / self.noise.balls
        shape = count, len(w.first), -1
        return np.concatenate([angles.reshape(shape), balls.reshape(shape)], axis=2)

    def whitened(self, residuals: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Residuals [..., S, M] times the roots of their weights, without the common error of those
        after a bounce: times the inverse root of their covariance, the identity plus that of the
        bounce's deviation."""
        root, count = np.sqrt(weights), self.windows.balls.shape[1]
        scaled = residuals * root
        of_balls = scaled[..., -3 * count :].reshape(*scaled.shape[:-1], count, 3)
        since = np.nan_to_num(self.windows.picture_times - self.windows.bounces[:, None])
        common = np.maximum(since, 0.0)[:, :, None] * _BOUNCE_DEVIATION / self.noise.balls
        common = common * root[:, -3 * count :].reshape(-1, count, 3)
        squared = np.maximum(np.sum(common**2, axis=1), 1e-12)
        share = (1.0 - 1.0 / np.sqrt(1.0 + squared)) / squared
        along = np.sum(common * of_balls, axis=-2)
        white = of_balls - common * (share * along)[..., None, :]
        scaled[..., -3 * count :] = white.reshape(*scaled.shape[:-1], -1)
        return scaled

    def weights(self, with_angles: bool = True, pictures: np.ndarray | float = 1.0) -> np.ndarray:
        """Weights [S, A n + 3 B]; those of the pictures [S, B] are multiplied by `pictures`."""
        w = self.windows
        angles = np.repeat(w.angle_weights * with_angles, w.angles.shape[2], axis=1)
        return np.concatenate([angles, np.repeat(w.picture_weights * pictures, 3, axis=1)], axis=1)


def minimise(
    problem: Problem,
    vector: np.ndarray,
    starts: np.ndarray,
    free: np.ndarray,
    weights: np.ndarray,
    iterations: int,
    free_states: np.ndarray | None = None,
    log: Callable[[str], None] = lambda line: None,
) -> Fit:
    """Steps of Levenberg and Marquardt until one lowers the cost by less than 0.3, a fraction of
    what a change of the unknowns by their deviation does.

    Args:
      free: which unknowns [P] may change.
      weights: of the residuals [S, M].
      free_states: which entries [D] of the starts may change; all by default.
    """
    layout, guess = problem.layout, problem.windows.starts
    deviations, _ = _per_state(problem.windows)
    place, now = np.flatnonzero(free), np.inf
    of_state = np.arange(starts.shape[1]) if free_states is None else np.flatnonzero(free_states)
    scale, reach = layout.deviation[place], deviations[of_state]
    # The start of a window that does not count stays as it is.
    counts = np.any(weights > 0.0, axis=1)[:, None]

    def costs(predicted: Predicted, states: np.ndarray) -> np.ndarray:
        """Half the sum of squares of each candidate and window [C, S]."""
        r = problem.whitened(problem.residuals(predicted), weights)
        of_states = np.sum(((states - guess) / deviations) ** 2, axis=2)
        return 0.5 * (np.sum(r**2, axis=2) + of_states)

    def of_prior(vectors: np.ndarray) -> np.ndarray:
        return 0.5 * np.sum(((vectors - layout.mean) / layout.deviation) ** 2, axis=-1)

    for iteration in range(iterations):
        line = _linearised(problem, vector, starts, place, of_state, weights)
        now = float(np.sum(costs(line.predicted, starts[None])) + of_prior(vector))
        at_guess = (starts - guess)[:, of_state] / reach
        reduced = _eliminate(
            line.residuals, line.by_unknown * scale, line.by_state * reach, at_guess
        )
        hessian = reduced.information + np.eye(len(place))
        slope = reduced.gradient + (vector[place] - layout.mean[place]) / scale
        tried_vectors = np.repeat(vector[None], CHUNK, axis=0)
        tried_states = np.repeat(starts[None], CHUNK, axis=0)
        for i, (damping, share) in enumerate(itertools.product(_DAMPINGS, _SHARES)):
            change = -np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), slope)
            tried_vectors[i, place] += change * scale
            tried_vectors[i] = layout.clipped(tried_vectors[i])
            change = (tried_vectors[i, place] - vector[place]) / scale
            tried_states[i][:, of_state] += share * reduced.states(change) * reach * counts
        outcome = problem.simulate(tried_vectors, tried_states)
        tried = costs(outcome, tried_states)
        tried = np.where(np.isfinite(tried), tried, np.inf).reshape(len(_DAMPINGS), -1, len(starts))
        totals = np.sum(np.min(tried, axis=1), axis=1) + of_prior(tried_vectors[:: len(_SHARES)])
        damping = int(np.argmin(totals))
        best = damping * len(_SHARES) + np.argmin(tried[damping], axis=0)
        gain = now - totals[damping]
        log(f"step {iteration + 1}: {now:.1f} -> {totals[damping]:.1f}")
        whole = np.zeros((len(vector), len(vector)))
        whole[np.ix_(place, place)] = reduced.information / np.outer(scale, scale)
        if not gain > 0.0:
            predicted = Predicted(*(part[0] for part in line.predicted))
            return Fit(vector, starts, whole, predicted, weights, now)
        each = np.arange(len(starts))
        vector, starts = tried_vectors[best[0]], tried_states[best, each]
        predicted = Predicted(*(part[best, each] for part in outcome))
        now = float(totals[damping])
        if gain < _CONVERGED:
            break
    return Fit(vector, starts, whole, predicted, weights, now)


class _Linearised(NamedTuple):
    """The residuals at a point, and their derivatives by differences."""

    predicted: Predicted
    """At the point [1, S, ...]."""
    residuals: np.ndarray
    """[S, M]."""
    by_unknown: np.ndarray
    """[S, M, F]."""
    by_state: np.ndarray
    """[S, M, D]."""


def _linearised(
    problem: Problem,
    vector: np.ndarray,
    starts: np.ndarray,
    place: np.ndarray,
    of_state: np.ndarray,
    weights: np.ndarray,
) -> _Linearised:
    """Derivatives by the F unknowns at `place` and the D entries `of_state` of the starts."""
    layout, (_, differences) = problem.layout, _per_state(problem.windows)
    num_free, own = len(place), differences[of_state]
    num_angles = weights.shape[1] - 3 * problem.windows.balls.shape[1]
    # Unknowns for which the pictures need another difference, if any picture counts.
    apart = layout.ball_step[place] != layout.step[place]
    apart = np.flatnonzero(apart & np.any(weights[:, num_angles:] > 0.0))
    at_states, at_apart = 1 + num_free, 1 + num_free + len(of_state)
    vectors = np.repeat(vector[None], at_apart + len(apart), axis=0)
    states = np.repeat(starts[None], len(vectors), axis=0)
    # Differences that stay within the limits.
    steps = layout.step[place].copy()
    ahead = layout.clipped(vector + layout.step)[place] - vector[place]
    steps = np.where(np.abs(ahead) < 0.5 * steps, -steps, steps)
    vectors[1 + np.arange(num_free), place] += steps
    wide = layout.ball_step[place[apart]]
    vectors[at_apart + np.arange(len(apart)), place[apart]] += wide
    for i, d in enumerate(of_state):
        states[at_states + i, :, d] += differences[d]
    predicted = problem.simulate(vectors, states)
    r = problem.whitened(problem.residuals(predicted), weights)
    change = np.moveaxis(r[1:] - r[0], 0, -1)
    by_unknown, by_state = (
        change[..., :num_free] / steps,
        change[..., num_free : at_apart - 1] / own,
    )
    by_unknown[:, num_angles:, apart] = change[:, num_angles:, at_apart - 1 :] / wide
    return _Linearised(Predicted(*(part[:1] for part in predicted)), r[0], by_unknown, by_state)


class _Reduced(NamedTuple):
    """The linearised problem after the starts are eliminated."""

    information: np.ndarray
    gradient: np.ndarray
    residuals: np.ndarray
    by_unknown: np.ndarray
    q: np.ndarray
    r: np.ndarray

    def states(self, change: np.ndarray) -> np.ndarray:
        """Change [S, D] of the starts for a change [F] of the unknowns."""
        left = self.residuals + self.by_unknown @ change
        right = np.einsum("smd,sm->sd", self.q, left)
        return -np.linalg.solve(self.r, right[:, :, None])[:, :, 0]


def _eliminate(
    residuals: np.ndarray, by_unknown: np.ndarray, by_state: np.ndarray, at_guess: np.ndarray
) -> _Reduced:
    """Eliminates the starts; each of them has a guess with the deviation 1.

    Args:
      residuals: [S, M]; its derivatives are `by_unknown` [S, M, F] and `by_state` [S, M, D].
      at_guess: distance [S, D] of the starts from their guess.
    """
    num_windows, num_states = at_guess.shape
    eye = np.broadcast_to(np.eye(num_states), (num_windows, num_states, num_states))
    q, r = np.linalg.qr(np.concatenate([by_state, eye], axis=1))
    nothing = np.zeros((num_windows, num_states, by_unknown.shape[2]))
    a = np.concatenate([by_unknown, nothing], axis=1)
    b = np.concatenate([residuals, at_guess], axis=1)
    qa, qb = np.swapaxes(q, 1, 2) @ a, np.einsum("smd,sm->sd", q, b)
    flat, ends = (x.reshape(x.shape[0] * x.shape[1], x.shape[2]) for x in (a, qa))
    information = flat.T @ flat - ends.T @ ends
    gradient = flat.T @ b.ravel() - ends.T @ qb.ravel()
    return _Reduced(information, gradient, b, a, q, r)


def _per_state(windows: Windows) -> tuple[np.ndarray, np.ndarray]:
    n = windows.angles.shape[2]
    sizes = (n, n, 3, 3, 3)
    return np.repeat(_START_DEVIATIONS, sizes), np.repeat(_START_STEPS, sizes)


def picture_weights(problem: Problem, predicted: Predicted) -> np.ndarray:
    """Weights [S, B] of the pictures: less for outliers, and 0 for all of a window whose ball was
    not in free flight, such as one in a hand."""
    w, one = problem.windows, Predicted(predicted.angles[None], predicted.balls[None])
    white = problem.whitened(problem.residuals(one), problem.weights())[0]
    r = white[:, -3 * w.balls.shape[1] :].reshape(w.balls.shape)
    size = np.max(np.abs(r), axis=2)
    count = np.maximum(np.sum(w.picture_weights, axis=1), 1.0)
    mean = np.sum(np.minimum(size, _WORST) ** 2 * w.picture_weights, axis=1) / count
    return np.minimum(1.0, _HUBER / np.maximum(size, 1e-9)) * (mean < _NO_FLIGHT)[:, None]


assert len(_DAMPINGS) * len(_SHARES) == CHUNK
