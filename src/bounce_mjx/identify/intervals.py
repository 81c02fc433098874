"""What a log says about the unknowns: estimates from resampled windows."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bounce_mjx.identify.fit import Fit, Linearisation, Problem, eliminate, linearise
from bounce_mjx.identify.unknowns import Layout

_RESAMPLES = 400
# Successive windows that are drawn together: what the model lacks is alike in neighbours.
_BLOCK = 2
# Largest leverage of a block, its share of the information along a direction: one with all of it
# leaves no residual to correct.
_LARGEST_LEVERAGE = 0.9
# |J1 - J2| / |J1 + J2| of a window's two derivatives beyond which it has none.
_DISAGREEMENT = 0.1
# Error of an angle that is alike in all windows, as a share of its noise.
_ALIKE = 0.05
# What pictures say nothing about, as angles show it many times as well.
_OF_ANGLES = ("delay", "delay_variance", "servo_gain", "servo_damping")


class Certainty(NamedTuple):
    """How certain the unknowns are."""

    information: np.ndarray
    """Of the log about them [P, P], without the prior: the inverse of their covariance, after the
    starts are eliminated."""
    changes: np.ndarray
    """Of the estimate [B, P], in logs of resampled windows with a resampled prior."""

    @property
    def deviation(self) -> np.ndarray:
        """Standard deviations [P] of the unknowns."""
        return np.std(self.changes, axis=0)


def certainty(
    problem: Problem,
    fit: Fit,
    is_estimated: np.ndarray,
    is_chosen: np.ndarray | None = None,
    dead_band: np.ndarray | float = 0.0,
) -> Certainty:
    """The estimates that other logs of the robot would give, by a bootstrap (Efron 1979) over
    blocks of windows, in the linearised problem.

    In units of the prior's deviations, window s has the derivatives J_s [M, P] and the gradient
    g_s = J_s' r_s, after its start is eliminated (`eliminate`). With the weights w_s of a resample
    (of a Bayesian bootstrap, Rubin 1981: of exponential distribution, alike in a block), the
    estimate moves by -(sum_s w_s A_s + Q)^-1 (sum_s w_s g_s + Q (x - m - e)), where A_s is the
    window's information, Q the prior's (`Layout.precision`), x - m the distance from the prior's
    mean, and e a draw of the prior: what no window shows has the prior's spread. What the model
    lacks is in the residuals r_s, and so in the spread.

    *What angles show alone.* Servos move a bounce by less than the step in which it begins, so that
    derivatives of the pictures by a gain, a damping or a delay are noise, to which thousands of
    angles would be fitted: pictures say nothing about these (a cut, Plummer 2015, "Cuts in Bayesian
    graphical models").

    *What no log averages out.* Errors that are alike in all windows, as of an encoder's scale, a
    gear's play, or a clock, do not become less with more rows. They may be a twentieth of an
    angle's noise, and look like the effect of friction, of stiffness or of a delay; and a simulated
    servo answers anywhere within a physics step (`_alike`).

    *What friction hides.* A servo rests anywhere within its dead band, friction / stiffness, and
    what differs between a joint's directions, or its motions, moves it there in all windows alike:
    its offset is known no better.

    *Information.* A bounce depends on where in a physics step it begins, which makes derivatives
    noisy, and J_s' J_s would count their noise as information. J1 and J2, by central differences
    of one and of two steps, have independent noise, so that A_s = (J1' J2 + J2' J1) / 2 has the
    expectation without noise. Negative eigenvalues of a sum of them count as 0. A window whose J1
    and J2 differ much has no derivative, and is left out. Angles are smooth: without a ball, J2 is
    J1.

    *Few windows.* A fit adapts to each block: its residuals have the covariance I - H_s in place
    of I, where H_s = R' A_s R with (A + Q)^-1 = R R' is the block's leverage. Its gradient is
    (I - H_s)^-1 g_s, that of a fit without it (the jackknife, CR3 of Bell and McCaffrey 2002).

    Args:
      is_estimated: which unknowns [P] are at the minimum; no search has moved the others from their
        prior mean, or from the number that was chosen for them.
      is_chosen: those of the latter [P], which the log says nothing about; by default none.
      dead_band: distance [n] from its command at which the friction of each joint holds it, rad.
    """
    layout = problem.layout
    deviations, _, searched = problem.scale_starts()
    size = len(fit.vector)
    entries = np.flatnonzero(searched)
    scale = layout.deviation
    reach = deviations[entries]
    vector = layout.interior(fit.vector, 2.0)
    has_ball = problem.windows.has_ball
    # Angles are smooth, and those of the arm alone need one step.
    of_balls = fit.weights * has_ball[:, None]
    sides = [(1.0, fit.weights), (-1.0, fit.weights), (2.0, of_balls), (-2.0, of_balls)]
    lines = [
        linearise(problem, vector, fit.starts, np.arange(size), entries, weights, step)
        for step, weights in sides
    ]
    for line in lines:
        _cut(line, layout, problem.windows.angles[0].size)
    ones = _mean(lines[:2])
    twos = _mean(lines[2:])
    twos = [np.where(has_ball[:, None, None], b, a) for a, b in zip(ones, twos, strict=True)]
    reduced = eliminate(
        problem.whiten(fit.predicted, fit.weights),
        np.concatenate([ones[0], twos[0]], axis=2) * np.tile(scale, 2),
        0.5 * (ones[1] + twos[1]) * reach,
        (fit.starts - problem.windows.starts)[:, entries] / reach,
    )
    counts = ~(_has_no_derivative(reduced.informations, layout) & problem.windows.has_ball)
    informations = _symmetrise(reduced.informations[:, :size, size:])
    informations *= counts[:, None, None]
    gradients = np.mean(np.split(reduced.gradients * counts[:, None], 2, axis=1), axis=0)
    if is_chosen is not None:
        informations[:, is_chosen] = 0.0
        informations[:, :, is_chosen] = 0.0
        gradients[:, is_chosen] = 0.0
    random = np.random.default_rng(0)
    prior = layout.precision
    changes = resample(informations, gradients, is_estimated, random, prior) * scale
    # What is left of the prior's variance.
    room = np.sqrt(np.maximum(scale**2 - np.var(changes, axis=0), 0.0)) * is_estimated
    changes += _alike(problem, fit, ones[0], room, random)
    offsets = changes[:, layout.slices["servo_offset"]]
    offsets += random.uniform(-1.0, 1.0, offsets.shape) * dead_band
    information = _positive(np.sum(informations, axis=0))
    return Certainty(information / np.outer(scale, scale), changes)


def _mean(lines: list[Linearisation]) -> tuple[np.ndarray, np.ndarray]:
    """Central differences by the unknowns and by the starts, from both sides."""
    forward, backward = lines
    by_unknown = 0.5 * (forward.by_unknown + backward.by_unknown)
    return by_unknown, 0.5 * (forward.by_state + backward.by_state)


def _cut(line: Linearisation, layout: Layout, num_angles: int) -> None:
    """Takes what angles alone show out of the derivatives of the pictures."""
    for name in _OF_ANGLES:
        line.by_unknown[:, num_angles:, layout.slices[name]] = 0.0


def _alike(
    problem: Problem,
    fit: Fit,
    by_unknown: np.ndarray,
    room: np.ndarray,
    random: np.random.Generator,
) -> np.ndarray:
    """Changes [B, P] of the estimate by errors of the angles that are alike in all windows.

    An error of `_ALIKE` noises (root mean square) passes for the effect of a joint's friction, of
    its stiffness, with as late a servo, or of the delay of all joints. So each is known no better
    than the change whose effect is as large. Where several angles count as one, as their errors are
    alike, it is so much larger.

    Args:
      by_unknown: derivatives [S, M, P] of the white residuals.
      room: largest deviation [P] of these changes.
    """
    layout = problem.layout
    windows = problem.windows
    effects = by_unknown[:, : windows.angles[0].size].reshape(*windows.angles.shape, -1)
    counts = windows.split(fit.weights)[0] > 0.0
    columns = np.arange(len(fit.vector))

    def columns_of(name: str) -> np.ndarray:
        return columns[layout.slices[name]]

    # Unknowns that change together, and by how much.
    hidden: list[tuple[list[np.ndarray], np.ndarray]] = []
    frictions = [columns_of("joint_frictionloss")]
    stiffnesses = [columns_of("servo_gain"), columns_of("servo_damping")]
    for together in (frictions, stiffnesses):
        hidden.append((together, _ALIKE / _size_of_effect(effects, counts, together)))
    # A simulated servo answers anywhere within a physics step.
    of_step = layout.physics_dt / np.sqrt(12.0)
    for name, least in (("delay_variance", 0.0), ("delay", of_step)):
        delay = columns_of(name)
        of_all_joints = np.repeat(delay, layout.num_joints)
        size = np.mean(_size_of_effect(effects, counts, [of_all_joints]), keepdims=True)
        hidden.append(([delay], np.hypot(_ALIKE / size, least)))

    changes = np.zeros((_RESAMPLES, len(fit.vector)))
    for together, spread in hidden:
        spread = np.minimum(spread, np.min(room[np.array(together)], axis=0))
        draws = spread * random.normal(size=(_RESAMPLES, len(spread)))
        for unknowns in together:
            changes[:, unknowns] += draws
    return changes


def _size_of_effect(
    effects: np.ndarray, counts: np.ndarray, together: Sequence[np.ndarray]
) -> np.ndarray:
    """Root mean square [n] of what a unit of unknowns that change together does to each joint's
    angles, in units of the noise; a little where it does nothing.

    Args:
      effects: derivatives [S, A, n, P] of the angles in units of the noise.
      counts: which angles [S, A, n] count.
      together: for each kind of unknown, that of each joint [n].
    """
    joints = np.arange(effects.shape[2])
    along = sum(effects[:, :, joints, unknowns] for unknowns in together)
    numbers = np.maximum(np.sum(counts, axis=(0, 1)), 1)
    size = np.sqrt(np.sum((along * counts) ** 2, axis=(0, 1)) / numbers)
    return np.maximum(size, 1e-12)


def resample(
    informations: np.ndarray,
    gradients: np.ndarray,
    is_estimated: np.ndarray,
    random: np.random.Generator,
    precision: np.ndarray | None = None,
) -> np.ndarray:
    """Changes [B, P] of the estimate, in units of the prior's deviations.

    Args:
      informations: A_s [S, P, P] of the windows.
      gradients: g_s [S, P].
      is_estimated: which unknowns [P] are at the minimum.
      precision: Q [P, P] of the prior; by default that of independent unknowns.
    """
    size = gradients.shape[1]
    precision = np.eye(size) if precision is None else precision
    root_precision = np.linalg.cholesky(precision)
    firsts = np.arange(0, len(gradients), _BLOCK)
    informations = np.add.reduceat(informations, firsts, axis=0)
    gradients = np.add.reduceat(gradients, firsts, axis=0)
    values, vectors = np.linalg.eigh(_positive(np.sum(informations, axis=0)) + precision)
    root = vectors / np.sqrt(values)
    leverage, turn = np.linalg.eigh(root.T @ informations @ root)
    larger = 1.0 / (1.0 - np.clip(leverage, 0.0, _LARGEST_LEVERAGE))
    inner = np.einsum("sij,sj,skj,sk->si", turn, larger, turn, gradients @ root)
    # Back from R' g_s, as R is invertible.
    wider = inner @ np.linalg.inv(root)
    # The windows' gradients and the prior's are in balance at the minimum.
    wider -= np.mean(wider, axis=0)
    changes = np.empty((_RESAMPLES, size))
    for b in range(_RESAMPLES):
        weights = random.exponential(size=len(firsts))
        information = _positive(np.einsum("s,sij->ij", weights, informations))
        slope = weights @ wider - root_precision @ random.normal(size=size)
        changes[b] = -np.linalg.solve(information + precision, slope)
    # A log takes no knowledge away; and what no search has moved is as little known as before.
    spread = np.maximum(np.std(changes, axis=0), 1e-12)
    return changes * np.where(is_estimated, np.minimum(1.0, 1.0 / spread), 1.0 / spread)


def _positive(matrix: np.ndarray) -> np.ndarray:
    """A symmetric matrix [P, P] without its negative eigenvalues."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def _has_no_derivative(informations: np.ndarray, layout: Layout) -> np.ndarray:
    """In which windows [S] the two derivatives J1 and J2 differ, as where a ball meets the paddle's
    edge; from the products [S, 2 P, 2 P] of [J1, J2].

    The delay's variance does not count: near 0, its differences are one-sided and depend on their
    step.
    """
    size = informations.shape[1] // 2
    others = np.arange(size) != layout.slices["delay_variance"].start
    cross = np.diagonal(informations[:, :size, size:], axis1=1, axis2=2)
    squares = np.diagonal(informations, axis1=1, axis2=2)
    both = 2.0 * np.sum(cross[:, others], axis=1)
    total = np.sum(squares[:, np.tile(others, 2)], axis=1)
    return total - both > _DISAGREEMENT**2 * (total + both)


def _symmetrise(matrices: np.ndarray) -> np.ndarray:
    return 0.5 * (matrices + np.swapaxes(matrices, -1, -2))
