"""Least squares over the unknowns of the world and the states at the windows' starts.

The residuals are in units of each sensor's noise. The starts, thousands of numbers of which each
matters in one window, are eliminated inside every step: the variable projection of Golub and
Pereyra (1973) in the linearised problem.
"""

from collections.abc import Callable, Generator, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from bounce_mjx.identify.following import error_size
from bounce_mjx.identify.simulation import NOTHING_ELSE, Simulate, Simulated
from bounce_mjx.identify.unknowns import ARM, Layout
from bounce_mjx.identify.windows import Windows, is_seen

# Deviation of the guessed starts, and the differences for their derivatives: angles (rad), joint
# velocities (rad/s); the ball's position (m), velocity (m/s), spin (rad/s) and, relative to that of
# all flights, drag.
_START_DEVIATIONS = (0.01, 1.0, 1.0, 10.0, 10.0, 0.15)
_START_STEPS = (3e-3, 0.1, 0.01, 0.03, 5.0, 0.05)
# Entries of a start that are searched: a servo forgets a wrong velocity within milliseconds.
_SEARCHED = (True, False, True, True, True, False)
# Levenberg and Marquardt's dampings, and shares of the change of the starts, that a step tries side
# by side: the best damping for all, and the best share for each window. With a share of 0, a wrong
# slope of one window's start cannot spoil the step of all.
_DAMPINGS = np.array([0.0, 1e-2, 0.3, 10.0])
_SHARES = np.array([1.0, 0.3, 0.0])
# Farthest that an angle of a start may be from its guess, a measurement, in deviations.
_FARTHEST_START = 5.0
# Decrease of the cost, and its share, at which a search ends.
_CONVERGED = 0.3
_CONVERGED_SHARE = 2e-5
# Share of the expected decrease from which a step is as the linear problem says, and for how many
# steps derivatives then serve.
_AS_EXPECTED = 0.7
_REUSES = 4
# Residuals beyond this many standard deviations lose weight (Huber 1964).
_HUBER = 3.0
NO_FLIGHT = 25.0
"""Mean squared residual of a window's pictures beyond which the ball was not in free flight."""
_WORST = 30.0
# Windows in which candidates are compared.
_FEW = 13

# Deviation of a bounce from the model's: of the ball's velocity after it along x, y and z, m/s. A
# real paddle is not the same everywhere; and a simulated bounce depends by as much on where in a
# physics step it begins, which makes the fit smooth only with this freedom.
_BOUNCE_DEVIATION = (0.02, 0.02, 0.1)
# The same of a ball with spin, which rubs and rolls in ways that the contact's friction lacks.
_SPINNING_DEVIATION = (0.5, 0.5, 0.1)
# Where a real ball leaves the paddle, from where the model's does, m. The model's contact takes
# 10 ms, in which it falls back by 9 ms * speed; the paddle's height makes good for the mean alone.
_LEAVING_DEVIATION = (0.005, 0.005, 0.01)
AIR_LIFT = 0.006
"""Acceleration of a table-tennis ball across its flight, per spin (rad/s) and speed (m/s): a flight
shows its product with the spin alone."""
# Deviation of the spin of a flight that shows lift, rad/s, and of the acceleration by the spin
# after a bounce from the model's, m/s^2.
_SPIN_DEVIATION = 150.0
_LIFT_DEVIATION = 4.0


class Noise(NamedTuple):
    """Standard deviations of the sensors."""

    angles: np.ndarray
    """Of each measured joint angle [n], rad."""
    balls: np.ndarray
    """Of each coordinate of a picture [3], m."""


class Fit(NamedTuple):
    """A minimum of the residuals, or where a search for it begins."""

    vector: np.ndarray
    """The unknowns [P]."""
    starts: np.ndarray
    """States at the windows' starts [S, D]."""
    predicted: np.ndarray = np.zeros(0)
    """What the sensors would have measured [S, A n + 3 B]."""
    weights: np.ndarray = np.zeros(0)
    """Weight of each measurement [S, A n + 3 B]; 0 for padding and for pictures of no flight."""
    cost: float = np.inf
    """Half the sum of squared weighted residuals and the prior's."""


class Problem(NamedTuple):
    """The windows of a log and how to simulate them."""

    simulate: Simulate
    windows: Windows
    layout: Layout
    sensors: Noise
    noise: Noise
    """What counts as noise: the sensors', or the model's own errors where they are larger."""
    correlation: np.ndarray | float = 1.0
    """Successive angles of each joint [n] that count as one measurement, as their errors are alike:
    see `correlation_times`."""
    progress: Callable[[str], None] = lambda line: None
    """Called with a line about each step of a search."""
    simulated: Simulated = NOTHING_ELSE
    """What is simulated beyond the unknowns. With lift, the spin after a bounce is as free as that
    before it."""

    @property
    def deviations(self) -> np.ndarray:
        """The noise of each entry of a window's measurements [A n + 3 B]; larger by the root of
        the number of angles that count as one."""
        of_one = self.noise.angles * np.sqrt(self.correlation)
        of_angles = np.tile(of_one, self.windows.angles.shape[1])
        of_balls = np.tile(self.noise.balls, self.windows.balls.shape[1])
        return np.concatenate([of_angles, of_balls])

    def predict(self, vector: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """What the sensors would have measured [S, A n + 3 B], in one world."""
        return self.simulate(vector[None], starts[None], np.ones((1, len(starts)), bool))[0]

    def whiten(self, predicted: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Residuals [..., S, A n + 3 B] in units of the noise, times the roots of their weights,
        and without the common error of the pictures after a bounce.

        A bounce that deviates from the model moves each picture after it, along each axis, by the
        columns C = time since the bounce * deviation of the velocity / noise and, with lift, time^2
        / 2 * deviation of the acceleration / noise and deviation of the place / noise. The
        residuals' covariance is then I + C C'. With C'C = V diag(l) V', its inverse root is
        I - C V diag((1 - 1 / sqrt(1 + l)) / l) V' C'.
        """
        w = self.windows
        root = np.sqrt(weights)
        scaled = (predicted - w.measured) / self.deviations * root
        angles, balls = w.split(scaled)
        columns = self.bounce_columns() * w.split(root)[1][..., None]
        squares, vectors = np.linalg.eigh(np.einsum("sbak,sbal->sakl", columns, columns))
        squares = np.maximum(squares, 1e-12)
        shares = (1.0 - 1.0 / np.sqrt(1.0 + squares)) / squares
        inner = np.einsum("saik,sak,sajk->saij", vectors, shares, vectors)
        along = np.einsum("sbak,...sba->...sak", columns, balls)
        white = balls - np.einsum("sbai,saij,...saj->...sba", columns, inner, along)
        return np.concatenate([x.reshape(*scaled.shape[:-1], -1) for x in (angles, white)], axis=-1)

    def bounce_columns(self) -> np.ndarray:
        """Shifts [S, B, 3, K] of the pictures, in units of their noise, by each way in which a
        bounce may deviate from the model, by its standard deviation."""
        since = np.nan_to_num(self.windows.picture_times - self.windows.bounces[:, None])
        has_left = (since > 0.0)[:, :, None]
        since = np.maximum(since, 0.0)[:, :, None]
        columns = [since * _BOUNCE_DEVIATION / self.noise.balls]
        if self.simulated.lift > 0.0:
            columns = [since * _SPINNING_DEVIATION / self.noise.balls]
            columns.append(0.5 * since**2 * _LIFT_DEVIATION / self.noise.balls)
            columns.append(has_left * _LEAVING_DEVIATION / self.noise.balls)
        return np.stack(columns, axis=-1)

    def scale_starts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Deviation, difference and whether it is searched, of each entry of a start [2 n + 10]."""
        n = self.windows.angles.shape[2]
        sizes = n, n, 3, 3, 3, 1
        deviations = np.repeat(_START_DEVIATIONS, sizes)
        searched = np.repeat(_SEARCHED, sizes)
        if self.simulated.lift > 0.0:
            deviations[-4:-1] = _SPIN_DEVIATION
            searched[-1] = True
        return deviations, np.repeat(_START_STEPS, sizes), searched

    def weights(
        self,
        pictures: np.ndarray | float = 1.0,
        windows: np.ndarray | float = 1.0,
        angles: np.ndarray | float = 1.0,
    ) -> np.ndarray:
        """Weights [S, A n + 3 B]; those of the pictures [S, B] are multiplied by `pictures`, those
        of the angles [S, A, n] by `angles`, and those of the windows [S, 1] by `windows`."""
        w = self.windows
        of_angles = w.angle_weights[:, :, None] * angles * np.ones(w.angles.shape)
        of_balls = np.repeat(w.picture_weights * pictures, 3, axis=1)
        rows = [of_angles.reshape(len(of_angles), -1), of_balls]
        return np.concatenate(rows, axis=1) * windows


def minimise(
    problem: Problem,
    fit: Fit,
    stages: Sequence[str],
    weights: np.ndarray,
    iterations: int,
    free_states: np.ndarray | None = None,
    slopes: "Linearisation | None" = None,
) -> Fit:
    """Steps of Levenberg and Marquardt from a fit, until one lowers the cost by less than 0.3, a
    fraction of what a change of the unknowns by their deviation does, or by less than 2e-5 of it.
    The cost is infinite if the simulation diverges at the fit.

    Where the cost falls as the linear problem says, the next step has the same derivatives, which
    cost dozens of simulations: the simplified method of Newton (Deuflhard 2004, "Newton methods for
    nonlinear problems").

    Args:
      stages: those whose unknowns may change; of none, the starts alone.
      weights: of the measurements [S, M].
      iterations: how many times the derivatives are taken.
      free_states: which entries [D] of the starts may change; all by default.
      slopes: the derivatives for the first step, from `differentiate`.
    """
    given = [] if slopes is None else [slopes]
    return minimise_each(problem, [fit], stages, weights, iterations, free_states, given)[0]


def minimise_each(
    problem: Problem,
    fits: Sequence[Fit],
    stages: Sequence[str],
    weights: np.ndarray,
    iterations: int,
    free_states: np.ndarray | None = None,
    slopes: Sequence["Linearisation"] = (),
) -> list[Fit]:
    """`minimise` from several fits, whose windows are simulated together: a few windows of one
    alone would leave most lanes of a simulation empty.

    Args:
      slopes: for each fit, the derivatives for its first step; none by default.
    """
    searches = []
    for i, fit in enumerate(fits):
        given = slopes[i] if slopes else None
        search = _search(problem, fit, stages, weights, iterations, free_states, given)
        searches.append(search)
    return _run_together(problem, searches)


_Request = tuple[np.ndarray, np.ndarray, np.ndarray]
"""What is to be simulated: the arguments of `Simulate`."""


def _run_together(problem: Problem, searches: Sequence[Generator[_Request, np.ndarray, Any]]):
    """What each of the searches returns; each of them yields what it wants to have simulated."""
    results: list[Any] = [None] * len(searches)
    answers: dict[int, np.ndarray | None] = dict.fromkeys(range(len(searches)))
    while answers:
        requests: dict[int, _Request] = {}
        for i, answer in answers.items():
            try:
                requests[i] = searches[i].send(answer)
            except StopIteration as end:
                results[i] = end.value
        answers = {}
        if requests:
            vectors, states, used = map(np.concatenate, zip(*requests.values(), strict=True))
            outcome = problem.simulate(vectors, states, used)
            ends = np.cumsum([len(request[0]) for request in requests.values()])
            for i, part in zip(requests, np.split(outcome, ends[:-1]), strict=True):
                # Where a candidate does not count, it has the numbers of its search's first.
                answers[i] = np.where(requests[i][2][:, :, None], part, part[0])
    return results


def _search(
    problem: Problem,
    fit: Fit,
    stages: Sequence[str],
    weights: np.ndarray,
    iterations: int,
    free_states: np.ndarray | None,
    slopes: "Linearisation | None",
) -> Generator[_Request, np.ndarray, Fit]:
    """The steps of `minimise`."""
    layout = problem.layout
    used = np.any(weights > 0.0, axis=1)
    unknowns, entries = _searched(problem, stages, free_states)
    for iteration in range(iterations):
        if slopes is None:
            line = yield from _linearise(
                problem, fit.vector, fit.starts, unknowns, entries, weights
            )
        else:
            outcome = yield fit.vector[None], fit.starts[None], used[None]
            line = _move(problem, slopes, outcome, weights, len(unknowns))
            slopes = None
        for reuse in range(_REUSES):
            if not np.all(np.isfinite(line.white)):
                # The simulation diverges.
                return Fit(fit.vector, fit.starts, line.predicted, weights, np.inf)
            costs = _window_costs(problem, line.white[None], fit.starts[None])
            now = float(np.sum(costs)) + _prior_cost(layout, fit.vector)
            fit = Fit(fit.vector, fit.starts, line.predicted, weights, now)
            least = max(_CONVERGED, _CONVERGED_SHARE * now)
            trials = _list_trials(problem, fit, line, unknowns, entries, used)
            if trials.expected < least:
                return fit
            outcome = yield trials.vectors[:1], trials.states[:1], used[None]
            tried, white = _first_of(problem, trials, outcome, weights)
            as_expected = now - tried.cost >= _AS_EXPECTED * trials.expected
            if reuse == 0 and not as_expected:
                each = np.tile(used, (len(trials.vectors), 1))
                outcome = yield trials.vectors, trials.states, each
                tried = _best_of(problem, trials, outcome, weights)
            problem.progress(f"step {iteration + 1}: {now:.1f} -> {tried.cost:.1f}")
            fit = min(fit, tried, key=lambda x: x.cost)
            if reuse == 0 and now - tried.cost < least:
                return fit
            if not as_expected:
                break
            line = line._replace(predicted=fit.predicted, white=white)
    return fit


def differentiate(
    problem: Problem,
    fit: Fit,
    stages: Sequence[str],
    weights: np.ndarray,
    free_states: np.ndarray | None = None,
) -> "Linearisation":
    """The derivatives at a fit for searches of several sets of windows: see `minimise`."""
    unknowns, entries = _searched(problem, stages, free_states)
    return linearise(problem, fit.vector, fit.starts, unknowns, entries, weights)


def _searched(
    problem: Problem, stages: Sequence[str], free_states: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the unknowns [F] and of the entries of the starts [D] that may change."""
    searched = problem.scale_starts()[2]
    if free_states is not None:
        searched = searched & free_states
    return np.flatnonzero(problem.layout.free(stages)), np.flatnonzero(searched)


def _move(
    problem: Problem,
    slopes: "Linearisation",
    outcome: np.ndarray,
    weights: np.ndarray,
    num_free: int,
) -> "Linearisation":
    """What was simulated at a fit [1, S, M], with derivatives that were taken near it: of all the
    windows, or of more, by the same unknowns, or by none."""
    used = np.any(weights > 0.0, axis=1)
    by_unknown = slopes.by_unknown[:, :, :num_free]
    return Linearisation(
        predicted=outcome[0],
        white=problem.whiten(outcome, weights)[0],
        by_unknown=by_unknown * used[:, None, None],
        by_state=slopes.by_state * used[:, None, None],
    )


def _window_costs(problem: Problem, white: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Half the sum of squares of each candidate and window [C, S]."""
    deviations = problem.scale_starts()[0]
    squares = np.sum(((states - problem.windows.starts) / deviations) ** 2, axis=2)
    return 0.5 * (np.sum(white**2, axis=2) + squares)


def _prior_cost(layout: Layout, vector: np.ndarray) -> float:
    from_mean = (vector - layout.mean) / layout.deviation
    return 0.5 * float(from_mean @ layout.precision @ from_mean)


def _first_of(
    problem: Problem, trials: "_Trials", outcome: np.ndarray, weights: np.ndarray
) -> tuple[Fit, np.ndarray]:
    """The whole step without damping, of which [1, S, M] was simulated, and its white residuals
    [S, M]."""
    vector = trials.vectors[0]
    white = problem.whiten(outcome, weights)
    costs = _window_costs(problem, white, trials.states[:1])
    cost = float(np.sum(costs)) + _prior_cost(problem.layout, vector)
    cost = cost if np.isfinite(cost) else np.inf
    return Fit(vector, trials.states[0], outcome[0], weights, cost), white[0]


def _best_of(problem: Problem, trials: "_Trials", outcome: np.ndarray, weights: np.ndarray) -> Fit:
    """The best step, of which [C, S, M] was simulated: of the best damping, each window takes the
    share that suits it."""
    vectors, states, _ = trials
    windows = np.arange(states.shape[1])
    costs = _window_costs(problem, problem.whiten(outcome, weights), states)
    costs = np.where(np.isfinite(costs), costs, np.inf)
    costs = costs.reshape(len(_DAMPINGS), -1, len(windows))
    # All shares of a damping have the same unknowns.
    of_prior = [_prior_cost(problem.layout, vector) for vector in vectors[:: len(_SHARES)]]
    totals = np.sum(np.min(costs, axis=1), axis=1) + of_prior
    damping = int(np.argmin(totals))
    best = damping * len(_SHARES) + np.argmin(costs[damping], axis=0)
    return Fit(
        vector=vectors[damping * len(_SHARES)],
        starts=states[best, windows],
        predicted=outcome[best, windows],
        weights=weights,
        cost=float(totals[damping]),
    )


class _Trials(NamedTuple):
    """What a step tries: for each damping, each share of the change of the starts."""

    vectors: np.ndarray
    """The unknowns [C, P]."""
    states: np.ndarray
    """The starts [C, S, D]."""
    expected: float
    """By how much the cost falls with the first of them, without damping and whole, if the problem
    is linear."""


def _list_trials(
    problem: Problem,
    fit: Fit,
    line: "Linearisation",
    unknowns: np.ndarray,
    entries: np.ndarray,
    used: np.ndarray,
) -> _Trials:
    """What a step tries.

    Args:
      line: derivatives by the F `unknowns` and the D `entries` of the starts that may change.
      used: which windows [S] count.
    """
    layout = problem.layout
    guess = problem.windows.starts
    deviations = problem.scale_starts()[0]
    scale = layout.deviation[unknowns]
    reach = deviations[entries]
    is_angle = np.arange(len(deviations)) < layout.num_joints
    farthest = np.where(is_angle, _FARTHEST_START * deviations, np.inf)
    reduced = eliminate(
        line.white,
        line.by_unknown * scale,
        line.by_state * reach,
        (fit.starts - guess)[:, entries] / reach,
    )
    hessian = np.sum(reduced.informations, axis=0)
    hessian += layout.precision[np.ix_(unknowns, unknowns)]
    from_mean = (fit.vector - layout.mean) / layout.deviation
    slope = np.sum(reduced.gradients, axis=0) + layout.precision[unknowns] @ from_mean
    room = (layout.bounds(fit.vector) - fit.vector)[:, unknowns] / scale
    vectors = []
    states = []
    for damping in _DAMPINGS:
        damped = hessian + damping * np.diag(np.diag(hessian))
        change = _bounded_step(damped, slope, room)
        moved = reduced.states(change) * reach * used[:, None]
        for share in _SHARES:
            vector = fit.vector.copy()
            vector[unknowns] += change * scale
            starts = fit.starts.copy()
            starts[:, entries] += share * moved
            vectors.append(vector)
            states.append(np.clip(starts, guess - farthest, guess + farthest))
    changes = (vectors[0] - fit.vector)[unknowns]
    moves = (states[0] - fit.starts)[:, entries]
    white = line.white + line.by_unknown @ changes
    white += np.einsum("smd,sd->sm", line.by_state, moves)
    left = np.sum(_window_costs(problem, white[None], states[0][None]))
    expected = fit.cost - float(left) - _prior_cost(layout, vectors[0])
    return _Trials(np.stack(vectors), np.stack(states), expected)


def _bounded_step(hessian: np.ndarray, slope: np.ndarray, room: np.ndarray) -> np.ndarray:
    """The change x [F] within bounds that minimises x' hessian x / 2 + slope' x.

    By an active set (Stark and Parker 1995, "Bounded-variable least squares"): where one unknown
    ends at its bound, the others are the best ones there.

    Args:
      room: smallest and largest change [2, F].
    """
    if not len(slope):
        return slope
    root = np.linalg.cholesky(hessian).T
    target = -np.linalg.solve(root.T, slope)
    low = np.minimum(room[0], 0.0)
    high = np.maximum(room[1], 0.0)
    inside = lsq_linear(root, target, bounds=(low, np.maximum(high, low + 1e-12)), method="bvls")
    return inside.x


class Linearisation(NamedTuple):
    """The residuals at a point, and their derivatives by differences."""

    predicted: np.ndarray
    """What the sensors would measure at the point [S, M]."""
    white: np.ndarray
    """White residuals [S, M]."""
    by_unknown: np.ndarray
    """[S, M, F]."""
    by_state: np.ndarray
    """[S, M, D]."""


class _Difference(NamedTuple):
    """One simulation for derivatives: some columns of the Jacobian, in some rows each."""

    columns: np.ndarray
    """F unknowns, then D entries of the starts."""
    steps: np.ndarray
    """Change of each."""
    rows: list[slice]
    """Where each column is read."""


def _list_differences(
    problem: Problem, vector: np.ndarray, unknowns: np.ndarray, entries: np.ndarray, size: float
) -> list[_Difference]:
    """The simulations for the F `unknowns` and the D `entries` of the starts."""
    layout = problem.layout
    n = layout.num_joints
    split = problem.windows.angles[0].size
    angles = slice(0, split)
    pictures = slice(split, None)
    both = slice(0, None)
    joints = [slice(j, split, n) for j in range(n)]

    found = []

    def add(places: Sequence[int], step: float, rows: list[slice]) -> None:
        """Unknowns of one simulation, with the other sign where they would leave the limits."""
        at = np.array(places)
        moved = vector.copy()
        moved[at] += size * step
        turned = np.abs(layout.clip(moved)[at] - vector[at]) < 0.5 * np.abs(size * step)
        steps = np.where(turned, -size, size) * step
        found.append(_Difference(np.searchsorted(unknowns, at), steps, rows))

    for name, place in layout.slices.items():
        if place.start not in unknowns:
            continue
        unknown = layout.unknowns[name]
        places = range(place.start, place.stop)
        rows = pictures if name not in ARM else both if unknown.ball_step is None else angles
        if unknown.own:
            add(places, unknown.step, joints)
        for p in places:
            if not unknown.own:
                add([p], unknown.step, [rows])
            if unknown.ball_step:
                add([p], unknown.ball_step, [pictures])
    start_steps = size * problem.scale_starts()[1]
    columns = len(unknowns) + np.arange(len(entries))
    arm = np.flatnonzero(entries < n)
    if len(arm):
        # A servo has forgotten its start before the first picture.
        found.append(_Difference(columns[arm], start_steps[entries[arm]], joints))
    for d in np.flatnonzero(entries >= 2 * n):
        found.append(_Difference(columns[[d]], start_steps[entries[[d]]], [pictures]))
    return found


def linearise(
    problem: Problem,
    vector: np.ndarray,
    starts: np.ndarray,
    unknowns: np.ndarray,
    entries: np.ndarray,
    weights: np.ndarray,
    size: float = 1.0,
) -> Linearisation:
    """White residuals r, and derivatives (r(x + h e) - r(x)) / h by the F `unknowns` and the D
    `entries` of the starts, where h is `size` times the step of each.

    The Jacobian is sparse: a joint's start and its servo's gains move, nearly, that joint's angles
    alone, and a start matters in its own window. Columns that share no row share a simulation
    (Curtis, Powell and Reid 1974, "On the estimation of sparse Jacobian matrices"): one step of all
    joints at once gives each joint's column in the rows of its angles, and one step of an entry of
    all starts gives the column of each window. Where the rows of the angles and of the pictures
    need different steps (`Unknown.ball_step`), each have their own simulation.
    """
    search = _linearise(problem, vector, starts, unknowns, entries, weights, size)
    return _run_together(problem, [search])[0]


def _linearise(
    problem: Problem,
    vector: np.ndarray,
    starts: np.ndarray,
    unknowns: np.ndarray,
    entries: np.ndarray,
    weights: np.ndarray,
    size: float = 1.0,
) -> Generator[_Request, np.ndarray, Linearisation]:
    """`linearise`, as a part of a search."""
    num_free = len(unknowns)
    differences = []
    used = [np.any(weights > 0.0, axis=1)]
    for difference in _list_differences(problem, vector, unknowns, entries, size):
        counts = [np.any(weights[:, rows] > 0.0, axis=1) for rows in difference.rows]
        if np.any(counts):
            differences.append(difference)
            used.append(np.any(counts, axis=0))
    vectors = np.repeat(vector[None], 1 + len(differences), axis=0)
    states = np.repeat(starts[None], len(vectors), axis=0)
    for i, difference in enumerate(differences, 1):
        is_unknown = difference.columns < num_free
        vectors[i, unknowns[difference.columns[is_unknown]]] += difference.steps[is_unknown]
        at = entries[difference.columns[~is_unknown] - num_free]
        states[i][:, at] += difference.steps[~is_unknown]
    predicted = yield vectors, states, np.array(used)
    white = problem.whiten(predicted, weights)
    # A window whose simulation diverges there has no derivative.
    changed = np.where(np.isfinite(white), white, white[0])
    jacobian = np.zeros((*white.shape[1:], num_free + len(entries)))
    for i, difference in enumerate(differences, 1):
        changes = zip(difference.columns, difference.steps, difference.rows, strict=True)
        for column, step, rows in changes:
            jacobian[:, rows, column] = (changed[i] - white[0])[:, rows] / step
    return Linearisation(
        predicted=predicted[0],
        white=white[0],
        by_unknown=jacobian[:, :, :num_free],
        by_state=jacobian[:, :, num_free:],
    )


class _Reduced(NamedTuple):
    """The linearised problem after the starts are eliminated."""

    informations: np.ndarray
    """Of each window [S, F, F]."""
    gradients: np.ndarray
    """Of each window [S, F]."""
    by_unknown: np.ndarray
    """Change [S, D, F] of the starts with the unknowns."""
    unmoved: np.ndarray
    """Change [S, D] of the starts if no unknown changes."""

    def states(self, change: np.ndarray) -> np.ndarray:
        """Change [S, D] of the starts for a change [F] of the unknowns."""
        return self.unmoved + self.by_unknown @ change


def eliminate(
    residuals: np.ndarray, by_unknown: np.ndarray, by_state: np.ndarray, at_guess: np.ndarray
) -> _Reduced:
    """Eliminates the starts, each of which has a guess with the deviation 1: the Schur complement
    of the normal equations of each window.

    Args:
      residuals: [S, M]; its derivatives are `by_unknown` [S, M, F] and `by_state` [S, M, D].
      at_guess: distance [S, D] of the starts from their guess.
    """
    num_free = by_unknown.shape[2]
    num_states = at_guess.shape[1]
    columns = np.concatenate([by_unknown, residuals[:, :, None], by_state], axis=2)
    normal = _multiply(columns)
    kept = normal[:, : num_free + 1, : num_free + 1]
    starts = normal[:, num_free + 1 :]
    across = starts[:, :, : num_free + 1]
    among = starts[:, :, num_free + 1 :]
    across[:, :, num_free] += at_guess
    change = -np.linalg.solve(among + np.eye(num_states), across)
    reduced = kept + np.swapaxes(across, 1, 2) @ change
    return _Reduced(
        informations=reduced[:, :num_free, :num_free],
        gradients=reduced[:, :num_free, num_free],
        by_unknown=change[:, :, :num_free],
        unmoved=change[:, :, num_free],
    )


def _multiply(columns: np.ndarray) -> np.ndarray:
    """Products [S, K, K] of the columns [S, M, K] of each window, in parts that are too small for
    OpenBLAS to start threads: on a busy machine, these wait for one another a hundred times as long
    as they compute."""
    _, rows, size = columns.shape
    parts = np.array_split(columns, -(-rows * size**2 // 2**18), axis=1)
    return sum(np.swapaxes(part, 1, 2) @ part for part in parts)


def angle_weights(problem: Problem, predicted: np.ndarray) -> np.ndarray:
    """Weights [S, A, n] of the joint angles: less for outliers."""
    residuals = problem.windows.split(predicted)[0] - problem.windows.angles
    return _huber_weights(np.abs(residuals) / problem.noise.angles)


def _huber_weights(size: np.ndarray) -> np.ndarray:
    """Weights of residuals of a size in units of their noise; 0 where a simulation diverges."""
    size = np.where(np.isfinite(size), size, np.inf)
    return np.minimum(1.0, _HUBER / np.maximum(size, 1e-9))


def correlation_times(residuals: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Number [n] of successive residuals that say as much as one: the integrated autocorrelation
    time 1 + 2 sum rho_k, up to the first rho_k that is not positive (Sokal 1997, "Monte Carlo
    methods in statistical mechanics").

    It is 1 for the noise of a sensor, and hundreds for a model's error in a log at 1 kHz. With
    every residual counted, such a log would outweigh the prior by that factor.

    Args:
      residuals: of each window and joint [S, A, n].
      counts: which count [S, A].
    """
    counted = np.where(counts[:, :, None], residuals, 0.0)
    length = counted.shape[1]
    # Twice as long, as the transform's correlations are circular.
    spectra = np.fft.rfft(counted, 2 * length, axis=1)
    powers = np.sum(np.abs(spectra) ** 2, axis=0)
    correlations = np.fft.irfft(powers, 2 * length, axis=0)[:length]
    times = np.ones(residuals.shape[2])
    for joint, along in enumerate((correlations / np.maximum(correlations[0], 1e-30)).T):
        is_over = np.append(along[1:] <= 0.0, True)
        times[joint] += 2.0 * np.sum(along[1 : 1 + np.argmax(is_over)])
    return times


def picture_weights(problem: Problem, predicted: np.ndarray) -> np.ndarray:
    """Weights [S, B] of the pictures: less for outliers, and 0 for all of a window whose ball was
    not in free flight, such as one in a hand."""
    white = problem.windows.split(problem.whiten(predicted, problem.weights()))[1]
    size = np.max(np.abs(white), axis=2)
    flies = flight_errors(problem, predicted, problem.windows.picture_weights) < NO_FLIGHT
    return _huber_weights(size) * flies[:, None]


def flight_errors(problem: Problem, predicted: np.ndarray, pictures: np.ndarray) -> np.ndarray:
    """Mean squared residual [S] of the pictures [S, B] that count, in units of their noise."""
    white = problem.windows.split(problem.whiten(predicted, problem.weights()))[1]
    size = np.minimum(np.max(np.abs(white), axis=2), _WORST)
    return np.sum(size**2 * pictures, axis=1) / np.maximum(np.sum(pictures, axis=1), 1.0)


def seen_windows(problem: Problem) -> np.ndarray:
    """1 for each window of the search [S, 1], 0 for those held out."""
    return is_seen(problem.windows)[:, None].astype(float)


def sample(problem: Problem, counts: np.ndarray) -> np.ndarray:
    """1 for about `_FEW` of the windows of the search that count [S], evenly over the log
    [S, 1]."""
    used = np.flatnonzero(counts & (seen_windows(problem)[:, 0] > 0.0))
    few = np.zeros((len(counts), 1))
    few[used[:: max(len(used) // _FEW, 1)]] = 1.0
    return few


def joint_errors(windows: Windows, fit: Fit) -> np.ndarray:
    """Root mean square [n] of the angles' residuals where they count, rad."""
    angles = windows.split(fit.predicted)[0]
    weights = windows.split(fit.weights)[0]
    counts = np.any(weights > 0.0, axis=2)
    return error_size((angles - windows.angles)[counts])
