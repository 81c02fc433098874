"""Least squares over the unknowns of the world and the states at the windows' starts.

The residuals are in units of each sensor's noise. The starts, thousands of numbers of which each
matters in one window, are eliminated inside every step: the variable projection of Golub and
Pereyra (1973) in the linearised problem.
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from bounce_mjx.identify.simulation import Predicted, Simulate
from bounce_mjx.identify.unknowns import ARM, Layout
from bounce_mjx.identify.windows import Windows

# Deviation of the guessed starts, and the differences for their derivatives: angles (rad), joint
# velocities (rad/s); the ball's position (m), velocity (m/s) and spin (rad/s).
_START_DEVIATIONS = (0.01, 1.0, 1.0, 10.0, 10.0)
_START_STEPS = (3e-3, 0.1, 0.01, 0.03, 5.0)
# Entries of a start that are searched: a servo forgets a wrong velocity within milliseconds.
_SEARCHED = (True, False, True, True, True)
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
# Largest share of the information along any direction that one window counts for: its own is known
# up to noise.
_LARGEST_SHARE = 0.9
# Share by which two derivatives of a window may differ.
_DISAGREEMENT = 0.1


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

    def at(self, vector: np.ndarray, starts: np.ndarray) -> Predicted:
        """What the sensors would have measured, in one world."""
        shown = self.simulate(vector[None], starts[None], np.ones((1, len(starts)), bool))
        return Predicted(shown.angles[0], shown.balls[0])

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
    deviations, _, searched = _per_state(problem.windows)
    place, now = np.flatnonzero(free), np.inf
    of_state = np.flatnonzero(searched if free_states is None else searched & free_states)
    scale, reach = layout.deviation[place], deviations[of_state]
    # The start of a window that does not count stays as it is.
    used = np.any(weights > 0.0, axis=1)
    num_tried = len(_DAMPINGS) * len(_SHARES)

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
        tried_vectors = np.repeat(vector[None], num_tried, axis=0)
        tried_states = np.repeat(starts[None], num_tried, axis=0)
        for i, (damping, share) in enumerate(itertools.product(_DAMPINGS, _SHARES)):
            change = -np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), slope)
            tried_vectors[i, place] += change * scale
            tried_vectors[i] = layout.clipped(tried_vectors[i])
            change = (tried_vectors[i, place] - vector[place]) / scale
            tried_states[i][:, of_state] += share * reduced.states(change) * reach * used[:, None]
        outcome = problem.simulate(tried_vectors, tried_states, np.tile(used, (num_tried, 1)))
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


class Certainty(NamedTuple):
    """What a log says about the unknowns at a minimum."""

    covariance: np.ndarray
    """[P, P], with the prior."""
    information: np.ndarray
    """[P, P], without the prior, after the starts are eliminated."""


def certainty(problem: Problem, fit: Fit) -> Certainty:
    """Information about the unknowns at a minimum, and their covariance.

    A bounce depends on where in a physics step it begins, which makes derivatives noisy; their
    square would take the noise for information. The information is therefore the product of two
    derivatives with independent noise, by central differences of one and of two steps.

    Each deviation is the larger of two: that of independent residuals of the sensors' noise, and
    that of the scatter of the windows' gradients, which knows that residuals of one window are
    correlated (the estimator CR2 of Bell and McCaffrey 2002, "Bias reduction in standard errors for
    linear regression with multi-stage samples").
    """
    layout, (deviations, _, searched) = problem.layout, _per_state(problem.windows)
    place, of_state = np.arange(len(fit.vector)), np.flatnonzero(searched)
    scale, reach, size = layout.deviation, deviations[of_state], len(fit.vector)
    vector = layout.interior(fit.vector, 2.0)
    lines = [
        _linearised(problem, vector, fit.starts, place, of_state, fit.weights, step)
        for step in (1.0, -1.0, 2.0, -2.0)
    ]
    one, two = (0.5 * (a.by_unknown + b.by_unknown) * scale for a, b in (lines[:2], lines[2:]))
    by_state = np.mean([line.by_state for line in lines], axis=0) * reach
    at_guess = (fit.starts - problem.windows.starts)[:, of_state] / reach
    both = np.concatenate([one, two], axis=2)
    at_fit = Predicted(fit.predicted.angles[None], fit.predicted.balls[None])
    residuals = problem.whitened(problem.residuals(at_fit), fit.weights)[0]
    reduced = _eliminate(residuals, both, by_state, at_guess)
    of_windows = _symmetric(reduced.informations[:, :size, size:])
    # A ball that meets the paddle's edge has no derivative. That of a lag near 0 is another matter.
    others = place != layout.slices()["servo_lag"].start
    diagonal = np.diagonal(of_windows, axis1=1, axis2=2)
    squares = np.diagonal(reduced.informations, axis1=1, axis2=2)
    agreed = 2.0 * np.sum(diagonal[:, others], axis=1)
    total = np.sum(squares[:, np.tile(others, 2)], axis=1)
    differs = total - agreed > _DISAGREEMENT**2 * (total + agreed)
    smooth = ~(differs & problem.windows.has_ball)
    of_windows = of_windows * smooth[:, None, None]
    values, vectors = np.linalg.eigh(np.sum(of_windows, axis=0))
    values = np.maximum(values, 0.0)
    # Coordinates in which the covariance of independent residuals is the identity.
    root = vectors / np.sqrt(values + 1.0)
    share, turned = np.linalg.eigh(root.T @ of_windows @ root)
    share = np.clip(share, 0.0, _LARGEST_SHARE)
    gradients = np.stack(np.split(reduced.gradients * smooth[:, None], 2, axis=1)) @ root
    less = 1.0 / np.sqrt(1.0 - share)
    gradients = np.einsum("sij,sj,skj,lsk->lsi", turned, less, turned, gradients)
    of_noise = root @ root.T
    scatter = _symmetric(gradients[0].T @ gradients[1]) + np.diag(1.0 / (values + 1.0))
    scatter = root @ scatter @ root.T
    wider = np.sqrt(np.maximum(np.diag(scatter) / np.diag(of_noise), 1.0)) * scale
    information = (vectors * values) @ vectors.T
    return Certainty(of_noise * np.outer(wider, wider), information / np.outer(scale, scale))


def _symmetric(matrices: np.ndarray) -> np.ndarray:
    return 0.5 * (matrices + np.swapaxes(matrices, -1, -2))


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


class _Difference(NamedTuple):
    """One simulation for derivatives."""

    columns: np.ndarray
    """Derivatives that it gives: F unknowns, then D entries of the starts. Of several, each is that
    of one joint's angles."""
    steps: np.ndarray
    """Change of each."""
    of_angles: bool
    of_pictures: bool


def _differences(
    problem: Problem, vector: np.ndarray, place: np.ndarray, of_state: np.ndarray, size: float
) -> list[_Difference]:
    """The simulations for the F unknowns at `place` and the D entries `of_state` of the starts."""
    layout, n = problem.layout, problem.layout.num_joints

    def inside(step: np.ndarray) -> np.ndarray:
        """Differences that stay within the limits."""
        ahead = layout.clipped(vector + size * step) - vector
        return np.where(np.abs(ahead) < 0.5 * np.abs(size * step), -size, size) * step

    steps, ball_steps = inside(layout.step), inside(layout.ball_step)
    column = {int(p): np.array([f]) for f, p in enumerate(place)}
    found = []
    for name, at in layout.slices().items():
        unknown, entries = layout.unknowns[name], [p for p in range(at.start, at.stop)]
        if at.start not in column:
            continue
        of_angles = name in ARM
        if unknown.own:
            together = np.concatenate([column[p] for p in entries])
            found.append(_Difference(together, steps[at], True, False))
        for p in entries:
            step, apart = steps[[p]], unknown.ball_step is not None
            if not unknown.own:
                found.append(_Difference(column[p], step, of_angles, not apart))
            if unknown.ball_step:
                found.append(_Difference(column[p], ball_steps[[p]], False, True))
    own, start = size * _per_state(problem.windows)[1], len(place)
    arm = np.flatnonzero(of_state < n)
    if len(arm):
        # A servo has forgotten its start before the first picture.
        found.append(_Difference(start + arm, own[of_state[arm]], True, False))
    for d in np.flatnonzero(of_state >= 2 * n):
        found.append(_Difference(start + np.array([d]), own[of_state[[d]]], False, True))
    return found


def _linearised(
    problem: Problem,
    vector: np.ndarray,
    starts: np.ndarray,
    place: np.ndarray,
    of_state: np.ndarray,
    weights: np.ndarray,
    size: float = 1.0,
) -> _Linearised:
    """Derivatives by the F unknowns at `place` and the D entries `of_state` of the starts, by
    differences of `size` times each step."""
    n, num_free = problem.layout.num_joints, len(place)
    num_angles = weights.shape[1] - 3 * problem.windows.balls.shape[1]
    angles, pictures = (
        np.any(part > 0.0, axis=1) for part in np.split(weights, [num_angles], axis=1)
    )
    tried = [
        d
        for d in _differences(problem, vector, place, of_state, size)
        if (d.of_angles and np.any(angles)) or (d.of_pictures and np.any(pictures))
    ]
    vectors = np.repeat(vector[None], 1 + len(tried), axis=0)
    states = np.repeat(starts[None], len(vectors), axis=0)
    used = np.tile(angles | pictures, (len(vectors), 1))
    for i, difference in enumerate(tried, 1):
        for column, step in zip(difference.columns, difference.steps, strict=True):
            if column < num_free:
                vectors[i, place[column]] += step
            else:
                states[i, :, of_state[column - num_free]] += step
        used[i] = (difference.of_angles & angles) | (difference.of_pictures & pictures)
    predicted = problem.simulate(vectors, states, used)
    r = problem.whitened(problem.residuals(predicted), weights)
    by = np.zeros((*r.shape[1:], num_free + len(of_state)))
    for i, difference in enumerate(tried, 1):
        change = r[i] - r[0]
        for j, (column, step) in enumerate(zip(difference.columns, difference.steps, strict=True)):
            if difference.of_angles:
                stride = n if len(difference.columns) > 1 else 1
                first = j if stride > 1 else 0
                by[:, first:num_angles:stride, column] = change[:, first:num_angles:stride] / step
            if difference.of_pictures:
                by[:, num_angles:, column] = change[:, num_angles:] / step
    return _Linearised(
        Predicted(*(part[:1] for part in predicted)), r[0], by[..., :num_free], by[..., num_free:]
    )


class _Reduced(NamedTuple):
    """The linearised problem after the starts are eliminated."""

    informations: np.ndarray
    """Of each window [S, F, F]."""
    gradients: np.ndarray
    """Of each window [S, F]."""
    by_unknown: np.ndarray
    """Change [S, D, F] of the starts with the unknowns."""
    own: np.ndarray
    """Change [S, D] of the starts if no unknown changes."""

    @property
    def information(self) -> np.ndarray:
        """Of all windows [F, F]."""
        return np.sum(self.informations, axis=0)

    @property
    def gradient(self) -> np.ndarray:
        """Of all windows [F]."""
        return np.sum(self.gradients, axis=0)

    def states(self, change: np.ndarray) -> np.ndarray:
        """Change [S, D] of the starts for a change [F] of the unknowns."""
        return self.own + self.by_unknown @ change


def _eliminate(
    residuals: np.ndarray, by_unknown: np.ndarray, by_state: np.ndarray, at_guess: np.ndarray
) -> _Reduced:
    """Eliminates the starts, each of which has a guess with the deviation 1: the Schur complement
    of the normal equations of each window.

    Args:
      residuals: [S, M]; its derivatives are `by_unknown` [S, M, F] and `by_state` [S, M, D].
      at_guess: distance [S, D] of the starts from their guess.
    """
    num_free, num_states = by_unknown.shape[2], at_guess.shape[1]
    columns = np.concatenate([by_unknown, residuals[:, :, None], by_state], axis=2)
    normal = _squared(columns)
    kept, starts = normal[:, : num_free + 1, : num_free + 1], normal[:, num_free + 1 :]
    across, of_starts = starts[:, :, : num_free + 1], starts[:, :, num_free + 1 :]
    across[:, :, num_free] += at_guess
    change = -np.linalg.solve(of_starts + np.eye(num_states), across)
    reduced = kept + np.swapaxes(across, 1, 2) @ change
    return _Reduced(
        reduced[:, :num_free, :num_free],
        reduced[:, :num_free, num_free],
        change[:, :, :num_free],
        change[:, :, num_free],
    )


def _squared(columns: np.ndarray) -> np.ndarray:
    """Products [S, K, K] of the columns [S, M, K] of each window, in parts that are too small for
    OpenBLAS to start threads: on a busy machine, these wait for one another a hundred times as long
    as they compute."""
    _, rows, size = columns.shape
    parts = np.array_split(columns, -(-rows * size**2 // 2**18), axis=1)
    return sum(np.swapaxes(part, 1, 2) @ part for part in parts)


def _per_state(windows: Windows) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Deviation, difference and whether it is searched, of each entry of a start [2 n + 9]."""
    n = windows.angles.shape[2]
    sizes = (n, n, 3, 3, 3)
    of_all = (_START_DEVIATIONS, _START_STEPS, _SEARCHED)
    return tuple(np.repeat(values, sizes) for values in of_all)


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
