"""How each joint of a log responds to its command: the one look at angles and commands from which
the inspection, the simplest model and the start of a fit read.

A joint follows late: measured(t) = gain * commanded(t - delay - change(t)) + offset + remainder.
The delay is the joint's own. The change over time is one that all joints share, as only the stamps,
or what carries all commands, can make it: nothing, steps at some times, or a drift.
"""

import itertools
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

from bounce_mjx.identify.log import Log

# Delays that are searched, s: a trajectory server gets its targets seconds ahead.
_SHORTEST = -0.5
_LONGEST = 3.0
_COARSE = 0.02
_FINE = 1e-3
_ROWS = 2500
# Time over which both signals are averaged for gain and offset, s: a servo damps fast motions.
_SMOOTH = 0.25
# A joint whose angle or command moves by less is too little to judge, rad.
LITTLE = 0.05
# Delays count as equally good up to this loss of correlation, and this multiple of the least.
_TIED = 1e-8
_TIE = 1.1
# Constant difference between angle and command beyond which another delay is tried, rad.
_ZERO = 0.02
_TURN = 2.0 * np.pi
LATE = 0.3
"""Largest delay of a servo, s."""
EARLY = -0.02
"""Largest lead that rounded stamps explain, s."""
FOLLOWS = 0.7
"""Correlation from which a joint follows its command at all."""

# Blocks in which the delay is looked at: their length, s, and the most of a log and rows of each.
_BLOCK = 1.0
_BLOCKS = 360
_ROWS_OF_BLOCK = 120
_FEWEST_ROWS = 12
# Delays about a joint's own that are tried in a block, s, and their distance.
_AROUND = 0.36
_STEP = 4e-3
# A block shows a delay to half the range of those whose squared error is at most so many times the
# least, if that is below a bound, s. A steady motion shows none.
_AS_GOOD = 2.0
_SHARP = 0.02
# Motion of a command in a block from which it may show a delay, rad.
_MOVES = 4e-3
# Blocks on each side of a change, and share of the errors that it must take away.
_FEWEST_BLOCKS = 3
_GAIN = 0.4
# A change is shared if no more than this share of what the joints show goes against it.
_AGAINST = 0.2
# Changes of the delay that no motion of an arm makes, s.
_SMALLEST_STEP = 8e-3
_SMALLEST_DRIFT = 3e-3
_MOST_CHANGES = 4
# Edges between which a change for a while is looked for.
_EDGES = 40


class Joint(NamedTuple):
    """How one joint follows its command."""

    name: str
    commanded: float
    """Range of the command, rad."""
    measured: float
    """Range of the angle, rad."""
    slope: float
    """Gain: change of the angle for one of the command, in slow motions."""
    offset: float
    """rad"""
    delay: float
    """s; before any change."""
    correlation: float
    """Of angle and late command; its sign is the slope's."""
    remainder: float
    """Root mean square of what slope and offset leave, rad."""


class Change(NamedTuple):
    """A change of the delay that all joints share."""

    kind: str
    """Step or drift."""
    begin: float
    """Time at which it begins, s; of a step, at which it happens."""
    end: float
    """s"""
    size: float
    """By how much later the joints follow at its end, s."""


class Response(NamedTuple):
    """The response of all joints."""

    joints: tuple[Joint, ...]
    correlations: np.ndarray
    """Largest correlation [n, n], at any delay, of each joint's command with each joint's angle;
    with its sign."""
    delay: float | None
    """The common delay, s: the median of the joints that follow their commands; None if none
    does."""
    changes: tuple[Change, ...]
    """Of that delay over the log."""
    times: np.ndarray
    """Middles of the blocks [B] in which the delay was looked at, s."""
    delays: np.ndarray
    """Delay of each joint in each block [B, n], s; NaN where a block shows none."""

    def late_command(self, log: Log, j: int, times: np.ndarray) -> np.ndarray:
        """The command [T] that joint j answers at some times [T], rad."""
        at = times - self.joints[j].delay - change_of_delay(self.changes, times)
        return np.interp(at, log.target_times, log.servo_targets[:, j])


def commanded(log: Log, times: np.ndarray) -> np.ndarray:
    """The commands [T, n] at times [T], interpolated between those that were sent."""
    return np.stack([np.interp(times, log.target_times, c) for c in log.servo_targets.T], axis=1)


def change_of_delay(changes: tuple[Change, ...], times: np.ndarray) -> np.ndarray:
    """By how much later than at first the joints follow at some times [T], s."""
    late = np.zeros(len(times))
    for change in changes:
        length = max(change.end - change.begin, 1e-9)
        late += change.size * np.clip((times - change.begin) / length, 0.0, 1.0)
    return late


def measure_response(log: Log, rows: np.ndarray, names: tuple[str, ...]) -> Response:
    """The response of a log's joints.

    Args:
      rows: indices of the joint angles that count.
      names: of the joints.
    """
    few = rows[:: max(len(rows) // _ROWS, 1)]
    tried = np.arange(_SHORTEST, _LONGEST, _COARSE)
    correlations = _correlate(log, few, tried)
    of_own = np.abs(np.diagonal(correlations, axis1=1, axis2=2))
    best = np.array([_least_of_best(tried, column) for column in of_own.T])
    ranges = [
        np.minimum(np.ptp(x), np.ptp(y))
        for x, y in zip(commanded(log, log.times[rows]).T, log.joint_angles[rows].T, strict=True)
    ]
    follows = (np.array(ranges) > LITTLE) & (np.max(of_own, axis=0) > FOLLOWS)
    # A joint that does not follow its command is compared at the delay of the others.
    others = float(np.median(tried[best[follows]])) if np.any(follows) else 0.0
    guesses = np.where(follows, tried[best], others)
    times, delays, widths = _delays_of_blocks(log, rows, guesses)
    delays = np.where(follows, delays, np.nan)
    changes = _find_changes(times, delays, widths)
    if changes:
        # A joint's delay is the one before any change.
        own = delays - change_of_delay(changes, times)[:, None]
        with np.errstate(all="ignore"):
            medians = np.array(
                [_median(x[np.isfinite(x)], g) for x, g in zip(own.T, guesses, strict=True)]
            )
        guesses = np.where(follows, medians, guesses)
    joints = tuple(
        _compare(log, rows, j, name, float(guesses[j]), changes) for j, name in enumerate(names)
    )
    largest = np.take_along_axis(
        correlations, np.argmax(np.abs(correlations), axis=0)[None], axis=0
    )[0]
    delay = None
    if np.any(follows):
        delay = float(np.median([joints[j].delay for j in np.flatnonzero(follows)]))
    return Response(joints, largest, delay, changes, times, delays)


def _median(values: np.ndarray, otherwise: float) -> float:
    return float(np.median(values)) if len(values) else float(otherwise)


def _correlate(log: Log, rows: np.ndarray, delays: np.ndarray) -> np.ndarray:
    """Correlations [D, n, n] of each joint's command, late by each delay [D], and each joint's
    angle."""
    measured = normalise(log.joint_angles[rows])
    return np.stack(
        [normalise(commanded(log, log.times[rows] - delay)).T @ measured for delay in delays]
    )


def _least_of_best(delays: np.ndarray, correlations: np.ndarray) -> int:
    """Index of the least delay [D] among those that correlate as well as the best: a steady motion
    looks the same at every delay."""
    loss = 1.0 - np.abs(correlations)
    tied = loss <= max(_TIE * np.min(loss), np.min(loss) + _TIED)
    return int(np.argmin(np.where(tied, np.abs(delays), np.inf)))


def normalise(values: np.ndarray) -> np.ndarray:
    """Columns [T, n] with the mean 0 and the length 1; 0 where nothing moves."""
    centred = values - np.mean(values, axis=0)
    length = np.linalg.norm(centred, axis=0)
    return centred / np.where(length > 1e-9, length, np.inf)


def _delays_of_blocks(
    log: Log, rows: np.ndarray, guesses: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Middles [B] of blocks of a log; the delay of each joint in each [B, n], about a guess [n],
    NaN where it is not shown; and how sharply it is [B, n], s.

    In a block, the angle is the late command and a constant: what a joint sags by changes slowly.
    """
    times = log.times[rows]
    block = ((times - times[0]) / _BLOCK).astype(int)
    starts = np.flatnonzero(np.diff(block, prepend=-1))
    ends = np.append(starts[1:], len(rows))
    enough = ends - starts >= _FEWEST_ROWS
    starts, ends = starts[enough], ends[enough]
    if len(starts) > _BLOCKS:
        chosen = np.linspace(0, len(starts) - 1, _BLOCKS).round().astype(int)
        starts, ends = starts[chosen], ends[chosen]
    used = [
        np.arange(a, b)[:: max((b - a) // _ROWS_OF_BLOCK, 1)]
        for a, b in zip(starts, ends, strict=True)
    ]
    count = np.array([len(x) for x in used])
    at = np.concatenate([*used, np.zeros(0, int)])
    firsts = np.cumsum(count) - count
    shifts = np.arange(-_AROUND, _AROUND + 0.5 * _STEP, _STEP)
    delays = np.full((len(starts), len(guesses)), np.nan)
    widths = np.full_like(delays, np.inf)
    if not len(starts):
        return np.zeros(0), delays, widths
    for j, guess in enumerate(guesses):
        measured = log.joint_angles[rows[at], j]
        errors = np.empty((len(shifts), len(starts)))
        for i, shift in enumerate(shifts):
            late = np.interp(times[at] - guess - shift, log.target_times, log.servo_targets[:, j])
            off = measured - late
            sums = np.add.reduceat(off, firsts)
            errors[i] = np.add.reduceat(off**2, firsts) - sums**2 / count
            if i == len(shifts) // 2:
                moved = np.maximum.reduceat(late, firsts) - np.minimum.reduceat(late, firsts)
        found, width = _sharpest(errors, count)
        shown = (moved > _MOVES) & (width < _SHARP)
        delays[shown, j] = guess + found[shown]
        widths[shown, j] = width[shown]
    middles = 0.5 * (times[starts] + times[ends - 1])
    return middles, delays, widths


def _sharpest(errors: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The shift of the least squared error [D, B] about 0, s, and half the range of those that are
    as good [B], s."""
    best = np.argmin(errors, axis=0)
    least = np.take_along_axis(errors, best[None], axis=0)[0]
    good = errors <= _AS_GOOD * least + count * 1e-12
    width = 0.5 * _STEP * np.sum(good, axis=0)
    inside = np.clip(best, 1, len(errors) - 2)
    below, here, above = (errors[inside + k, np.arange(errors.shape[1])] for k in (-1, 0, 1))
    bend = below - 2.0 * here + above
    offset = np.where(bend > 0.0, 0.5 * (below - above) / np.where(bend > 0.0, bend, 1.0), 0.0)
    shift = -_AROUND + _STEP * (inside + np.clip(offset, -1.0, 1.0))
    at_end = (best == 0) | (best == len(errors) - 1)
    return shift, np.where(at_end, np.inf, width)


def _find_changes(times: np.ndarray, delays: np.ndarray, widths: np.ndarray) -> tuple[Change, ...]:
    """Changes of the delay [B, n] over the blocks that all joints share: a drift, or steps."""
    errors, own = _spread(delays, widths, np.zeros(len(times)))
    if not np.isfinite(errors) or errors <= 0.0:
        return ()
    steps = _find_steps(times, delays, widths)
    with_steps = _spread(delays, widths, change_of_delay(steps, times))[0] if steps else errors
    drift = _find_drift(times, delays, widths)
    if drift is not None:
        with_drift, _ = _spread(delays, widths, change_of_delay((drift,), times))
        if with_drift < (1.0 - _GAIN) * errors and with_drift < with_steps:
            return (drift,)
    return steps


def _spread(delays: np.ndarray, widths: np.ndarray, late: np.ndarray) -> tuple[float, np.ndarray]:
    """Sum of the distances of the delays [B, n] from each joint's median [n], in units of how
    sharply each is shown, with a change [B] taken away."""
    own = delays - late[:, None]
    medians = np.array([_median(x[np.isfinite(x)], np.nan) for x in own.T])
    distances = np.abs(own - medians) / widths
    return float(np.nansum(distances)), medians


def _find_drift(times: np.ndarray, delays: np.ndarray, widths: np.ndarray) -> Change | None:
    """A delay that grows or shrinks steadily: the median of the slopes between two blocks of one
    joint (Theil 1950 and Sen 1968), if most go one way in every joint."""
    slopes = []
    by_joint = []
    length = times[-1] - times[0] if len(times) else 0.0
    for column in delays.T:
        shown = np.flatnonzero(np.isfinite(column))
        a, b = np.triu_indices(len(shown), 1)
        a, b = shown[a], shown[b]
        far = times[b] - times[a] > 0.25 * length
        if np.sum(far) < _FEWEST_BLOCKS**2:
            continue
        between = (column[b] - column[a])[far] / (times[b] - times[a])[far]
        slopes.append(between)
        by_joint.append(float(np.median(between)))
    if not slopes:
        return None
    slope = float(np.median(np.concatenate(slopes)))
    size = slope * length
    against = np.mean(np.sign(np.concatenate(slopes)) != np.sign(slope))
    is_shared = all(0.3 < x / slope < 3.0 for x in by_joint) if slope else False
    if abs(size) < _SMALLEST_DRIFT or not is_shared or against > _AGAINST:
        return None
    return Change("drift", float(times[0]), float(times[-1]), float(size))


def _find_steps(times: np.ndarray, delays: np.ndarray, widths: np.ndarray) -> tuple[Change, ...]:
    """Times at which the delay of all joints changes at once, for good or for a while: again and
    again the stretch that takes away most of the errors."""
    steps: list[Change] = []
    late = np.zeros(len(times))
    while len(steps) < _MOST_CHANGES:
        found = _find_stretch(delays - late[:, None], widths)
        if found is None:
            break
        begin, end, size = found
        steps.append(_make_step(times, delays, begin, size))
        if end < len(times):
            steps.append(_make_step(times, delays, end, -size))
        late += np.where(
            (np.arange(len(times)) >= begin) & (np.arange(len(times)) < end), size, 0.0
        )
    return tuple(sorted(steps, key=lambda step: step.begin))


def _make_step(times: np.ndarray, delays: np.ndarray, at: int, size: float) -> Change:
    """A step before a block."""
    shown = np.any(np.isfinite(delays), axis=1)
    last = np.flatnonzero(shown[:at])[-1]
    first = at + np.flatnonzero(shown[at:])[0]
    time = 0.5 * float(times[last] + times[first])
    return Change("step", time, time, size)


def _find_stretch(delays: np.ndarray, widths: np.ndarray) -> tuple[int, int, float] | None:
    """First block, block after the last, and size (s) of the change that takes away most of the
    errors; None if none is shared by the joints."""
    count = len(delays)
    before, _ = _spread(delays, widths, np.zeros(count))
    shown = np.flatnonzero(np.any(np.isfinite(delays), axis=1))
    edges = np.unique(shown[:: max(len(shown) // _EDGES, 1)])
    candidates = [(at, count) for at in shown[1:].tolist()]
    candidates += [(a, b) for a, b in itertools.combinations(edges[1:].tolist(), 2)]
    best: tuple[float, int, int, float] | None = None
    for begin, end in candidates:
        inside = np.zeros(count, bool)
        inside[begin:end] = True
        size = _size_of_change(delays, inside)
        if size is None:
            continue
        errors, _ = _spread(delays, widths, size * inside)
        # Of two that explain as much, the one for good.
        if best is None or errors < (1.0 if end == count else 0.9) * best[0]:
            best = errors, begin, end, size
    if best is None or best[0] > (1.0 - _GAIN) * before:
        return None
    return best[1:]


def _size_of_change(delays: np.ndarray, inside: np.ndarray) -> float | None:
    """By how much later the joints follow inside of some blocks [B] than elsewhere, s; None if they
    do not agree, or too few blocks show it."""
    sizes = []
    weights = []
    for column in delays.T:
        shown = np.isfinite(column)
        within = column[shown & inside]
        beside = column[shown & ~inside]
        if len(within) and len(beside):
            sizes.append(float(np.median(within) - np.median(beside)))
            weights.append(min(len(within), len(beside)))
    if sum(weights) < _FEWEST_BLOCKS:
        return None
    of_joints = np.array(sizes)
    counts = np.array(weights)
    size = float(np.average(of_joints, weights=counts))
    # Each joint's own change is near that of all.
    differs = np.abs(of_joints - size) > max(0.35 * abs(size), 0.5 * _SMALLEST_STEP)
    is_shared = np.sum(counts[differs]) <= _AGAINST * np.sum(counts)
    if abs(size) < _SMALLEST_STEP or not is_shared:
        return None
    return float(np.median(np.repeat(of_joints[~differs], counts[~differs])))


def _compare(
    log: Log,
    rows: np.ndarray,
    j: int,
    name: str,
    guess: float,
    changes: tuple[Change, ...],
) -> Joint:
    """How joint j follows its command, near a guess of its delay."""
    changed = change_of_delay(changes, log.times[rows])
    stride = max(len(rows) // (2 * _ROWS), 1)
    measured = normalise(log.joint_angles[rows[::stride], j : j + 1])[:, 0]

    def late(delay: float, which: slice = slice(None)) -> np.ndarray:
        at = log.times[rows][which] - delay - changed[which]
        return np.interp(at, log.target_times, log.servo_targets[:, j])

    few = slice(None, None, stride)

    def correlation(delay: float) -> float:
        return float(normalise(late(delay, few)[:, None])[:, 0] @ measured)

    near = np.arange(guess - 1.5 * _COARSE, guess + 1.5 * _COARSE, _FINE)
    values = [correlation(delay) for delay in near]
    best = _least_of_best(near, np.array(values))
    delay = float(near[best])
    angles, targets = smoothed(log, rows, j, late(delay))
    if _ZERO < abs(np.median(angles - targets)) < _TURN / 4.0:
        # A motion that goes one way shows an offset as well as a delay.
        tried = np.arange(EARLY, LATE, 2.0 * _FINE)
        shown = log.joint_angles[rows[::stride], j]
        sizes = [np.sqrt(np.mean((shown - late(other, few)) ** 2)) for other in tried]
        if min(sizes) < 0.2 * abs(np.median(angles - targets)):
            delay = float(tried[np.argmin(sizes)])
            angles, targets = smoothed(log, rows, j, late(delay))
    spread = np.var(targets, ddof=1)
    slope = float(np.cov(targets, angles)[0, 1] / spread) if spread > 1e-10 else 0.0
    command = late(delay)
    return Joint(
        name=name,
        commanded=float(np.ptp(command)),
        measured=float(np.ptp(log.joint_angles[rows, j])),
        slope=slope,
        offset=float(np.median(angles - targets)),
        delay=delay,
        correlation=values[best],
        remainder=float(np.std(log.joint_angles[rows, j] - slope * command)),
    )


def smoothed(
    log: Log, rows: np.ndarray, j: int, command: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The angle of a joint and its late command [T], without fast motions."""
    size = max(round(_SMOOTH / float(np.median(np.diff(log.times)))), 1)
    pair = log.joint_angles[rows, j], command
    return tuple(uniform_filter1d(x, size, mode="nearest") for x in pair)
