"""What may explain an arm: hypotheses, from the simplest to servos, and the choice among them.

Each is fitted to windows of the log and judged in others, which no fit has seen. The least error
wins; a difference in which neither these windows nor the joints agree, within the spread of a
bootstrap over either, is a tie, and goes to the hypothesis with fewer unknowns.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from bounce_mjx.identify.following import Following, error_size
from bounce_mjx.identify.log import Log
from bounce_mjx.identify.response import Response, commanded
from bounce_mjx.identify.windows import Windows

# Residuals beyond so many times a joint's usual error count as so large.
_OUTLIER = 6.0
_RESAMPLES = 500
# Standard deviations of the bootstrap within which a difference is a tie.
_TIED = 1.96
# Delays (s) about a joint's own, and lags (s), that a follower may have.
_DELAYS = np.arange(-0.03, 0.0301, 3e-3)
_FINER = np.array([-2e-3, -1e-3, 1e-3, 2e-3])
_LAGS = (0.0, 0.003, 0.006, 0.012, 0.025, 0.05)
# Step in which a lag is computed, s.
_LAG_STEP = 1e-3
# Largest error of a gain from 1 that is none.
_NO_GAIN = 0.005


class Hypothesis(NamedTuple):
    """What a hypothesis says about an arm."""

    name: str
    of_all: int
    """Unknowns that all joints share."""
    of_each: int
    """Unknowns of each joint."""
    can_train: bool
    """Whether a training simulates such an arm, so that a world may be written from it."""
    has_servos: bool = False
    gravity_compensation: float = 0.0
    """Share of the arm's weight that its controller carries, if more than the model's own."""

    def unknowns(self, num_joints: int) -> int:
        """How many are fitted."""
        return self.of_all + self.of_each * num_joints


STILL = Hypothesis("an arm at rest", 0, 1, can_train=True)
COMMAND = Hypothesis("the command is the position", 0, 0, can_train=True)
DELAY = Hypothesis("a delay and offsets", 1, 1, can_train=True)
FOLLOWER = Hypothesis("a delay, lag, gain and offset of each joint", 0, 4, can_train=False)
SERVOS = Hypothesis("servos", 2, 5, can_train=True, has_servos=True)
CARRIED = Hypothesis("servos, and a controller that carries the arm", 2, 5, True, True, 1.0)


class Trial(NamedTuple):
    """A fitted hypothesis, judged in windows that it has not seen."""

    hypothesis: Hypothesis
    unknowns: int
    angles: np.ndarray
    """What it expects in all windows [S, A, n], rad."""
    errors: np.ndarray
    """Root mean square [n] in the windows that it has not seen, rad."""
    detail: str = ""
    """What the fit found, for a reader."""


class Choice(NamedTuple):
    """The hypotheses of an arm, compared."""

    trials: tuple[Trial, ...]
    chosen: Hypothesis
    """The one from which a world is written: the best of those that a training simulates."""
    ties: tuple[bool, ...]
    """Which trials are as good as the best one, within the spread of the bootstrap."""
    better: Trial | None
    """One that is better than the chosen one and that no training simulates."""

    def trial(self, hypothesis: Hypothesis) -> Trial | None:
        """That of a hypothesis, if it was tried."""
        return next((x for x in self.trials if x.hypothesis == hypothesis), None)


def judge(
    hypothesis: Hypothesis, windows: Windows, angles: np.ndarray, unseen: np.ndarray, detail=""
) -> Trial:
    """A hypothesis that expects angles [S, A, n], judged in windows [S]."""
    counts = (windows.angle_weights > 0.0) & unseen[:, None]
    residuals = (angles - windows.angles)[counts]
    num_joints = windows.angles.shape[2]
    errors = error_size(residuals) if len(residuals) else np.full(num_joints, np.inf)
    errors = np.where(np.isfinite(errors), errors, np.inf)
    return Trial(hypothesis, hypothesis.unknowns(num_joints), angles, errors, detail)


def choose(
    trials: Sequence[Trial], windows: Windows, unseen: np.ndarray, noise: np.ndarray
) -> Choice:
    """Compares hypotheses in windows [S] that none of them has seen.

    Each joint counts in each window by its mean squared residual, in units of the joint's usual
    error: the least of all hypotheses, or the sensor's noise [n], where that is larger. Ten seconds
    have two or three unseen windows, whose spread alone would make most differences a tie; and
    where one joint moves, the others say nothing.
    """
    usual = np.maximum(np.min([trial.errors for trial in trials], axis=0), noise)
    scores = np.stack([_scores(trial, windows, unseen, usual) for trial in trials])
    means = np.mean(scores, axis=(1, 2))
    best = int(np.argmin(means))
    ties = tuple(_is_tie(scores[i] - scores[best]) for i in range(len(trials)))
    can_train = [i for i, trial in enumerate(trials) if trial.hypothesis.can_train]
    leader = min(can_train, key=lambda i: means[i])
    chosen = min(
        (i for i in can_train if _is_tie(scores[i] - scores[leader])),
        key=lambda i: trials[i].unknowns,
    )
    is_better = not trials[best].hypothesis.can_train and not ties[chosen]
    return Choice(
        trials=tuple(trials),
        chosen=trials[chosen].hypothesis,
        ties=ties,
        better=trials[best] if is_better else None,
    )


def describe_choice(choice: Choice) -> list[str]:
    """The comparison, a line for each hypothesis: its errors and what came of it."""
    lines = []
    for name, unknowns, errors, verdict in table_of(choice):
        lines.append(f"{name} ({unknowns} unknowns): {errors} mrad; {verdict}")
    return lines


def table_of(choice: Choice) -> list[tuple[str, int, str, str]]:
    """Name, number of unknowns, error of each joint in unseen windows (mrad), and verdict of each
    hypothesis."""
    rows = []
    for trial, is_tied in zip(choice.trials, choice.ties, strict=True):
        verdict = "as good as the best" if is_tied else "worse"
        if trial.hypothesis == choice.chosen:
            verdict = "the world is written from it"
        elif choice.better is not None and trial.hypothesis == choice.better.hypothesis:
            verdict = "better, but no training simulates it"
        errors = ", ".join(f"{1e3 * error:.2g}" for error in trial.errors)
        name = trial.hypothesis.name + (f" ({trial.detail})" if trial.detail else "")
        rows.append((name, trial.unknowns, errors, verdict))
    return rows


def _scores(trial: Trial, windows: Windows, unseen: np.ndarray, usual: np.ndarray) -> np.ndarray:
    """Mean squared residual of each joint in each window that counts [U, n], in units of the usual
    errors [n]."""
    used = np.flatnonzero(unseen & np.any(windows.angle_weights > 0.0, axis=1))
    off = (trial.angles - windows.angles)[used] / usual
    off = np.where(np.isfinite(off), np.minimum(np.abs(off), _OUTLIER), _OUTLIER)
    weights = windows.angle_weights[used]
    sums = np.einsum("uan,ua->un", off**2, weights)
    return sums / np.sum(weights, axis=1)[:, None]


def _is_tie(differences: np.ndarray) -> bool:
    """Whether the mean of differences [U, n] is within the spread of its bootstrap over windows,
    and within that over joints."""
    spread = min(_spread(np.mean(differences, axis=1)), _spread(np.mean(differences, axis=0)))
    return bool(np.mean(differences) <= _TIED * spread)


def _spread(values: np.ndarray) -> float:
    """Standard deviation of the mean of values [K], by a bootstrap; of one alone 0."""
    count = len(values)
    picks = np.random.default_rng(0).integers(0, count, (_RESAMPLES, count))
    return float(np.std(np.mean(values[picks], axis=1)))


def expect_command(log: Log, windows: Windows) -> np.ndarray:
    """The angles [S, A, n] of an arm that is where its command is, rad."""
    return _in_windows(windows, lambda times: commanded(log, times))


def expect_delay(log: Log, windows: Windows, following: Following) -> np.ndarray:
    """The angles [S, A, n] of one that follows late, with offsets, rad."""
    return _in_windows(
        windows, lambda times: commanded(log, times - following.delay) + following.offsets
    )


class _JointFollower(NamedTuple):
    """How one joint follows."""

    delay: float
    lag: float
    gain: float
    offset: float
    error: float


def expect_follower(
    log: Log, windows: Windows, seen: np.ndarray, response: Response
) -> tuple[np.ndarray, str]:
    """The angles [S, A, n] of an arm whose joints follow each with a delay, or lead, a lag, a gain
    and an offset of their own, rad, fitted to the windows [S] that are seen; and these in words."""
    counts = (windows.angle_weights > 0.0) & seen[:, None]
    times = (windows.zero[:, None] + windows.angle_times)[counts]
    every = (windows.zero[:, None] + windows.angle_times).ravel()
    expected = np.empty((len(every), windows.angles.shape[2]))
    gains = []
    grid = np.arange(log.target_times[0], log.target_times[-1] + _LAG_STEP, _LAG_STEP)
    for j, joint in enumerate(response.joints):
        command = np.interp(grid, log.target_times, log.servo_targets[:, j])
        measured = windows.angles[..., j][counts]
        fits = []
        for lag in _LAGS:
            path = _lagged(command, lag)
            for delay in joint.delay - lag + _DELAYS:
                fits.append(_fit_line(np.interp(times - delay, grid, path), measured, delay, lag))
        best = min(fits, key=lambda fit: fit.error)
        path = _lagged(command, best.lag)
        for delay in best.delay + _FINER:
            late = np.interp(times - delay, grid, path)
            fits.append(_fit_line(late, measured, delay, best.lag))
        best = min(fits, key=lambda fit: fit.error)
        late = np.interp(every - best.delay, grid, _lagged(command, best.lag))
        expected[:, j] = best.offset + best.gain * late
        gains.append(best.gain)
    words = f"gains of {min(gains):.3f} to {max(gains):.3f}"
    shape = (*windows.angle_times.shape, windows.angles.shape[2])
    return expected.reshape(shape), words if np.ptp([*gains, 1.0]) > _NO_GAIN else ""


def _lagged(command: np.ndarray, lag: float) -> np.ndarray:
    """A command [T] in steps of `_LAG_STEP`, behind a lag of the first order (s)."""
    if lag == 0.0:
        return command
    share = -np.expm1(-_LAG_STEP / lag)
    start = [(1.0 - share) * command[0]]
    return lfilter([share], [1.0, share - 1.0], command, zi=start)[0]


def _fit_line(late: np.ndarray, measured: np.ndarray, delay: float, lag: float) -> _JointFollower:
    """The gain and the offset of angles [T] against late commands [T], and the error that stays."""
    centred = late - np.mean(late)
    spread = float(centred @ centred)
    gain = float(centred @ measured) / spread if spread > 1e-12 else 1.0
    offset = float(np.median(measured - gain * late))
    error = float(np.mean(np.abs(measured - gain * late - offset)))
    return _JointFollower(delay, lag, gain, offset, error)


def _in_windows(windows: Windows, path: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """A path of the joints, times [T] -> angles [T, n], at the angles' times [S, A, n]."""
    times = windows.zero[:, None] + windows.angle_times
    return path(times.ravel()).reshape(*times.shape, windows.angles.shape[2])
