"""The arm of a robot's world: its hypotheses, fitted to some windows and judged in others."""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from bounce_mjx.identify.fit import (
    Fit,
    Problem,
    angle_weights,
    correlation_times,
    joint_errors,
    minimise,
    minimise_each,
    sample,
    seen_windows,
)
from bounce_mjx.identify.following import Following
from bounce_mjx.identify.hypotheses import (
    CARRIED,
    COMMAND,
    DELAY,
    FOLLOWER,
    SERVOS,
    STILL,
    Choice,
    Hypothesis,
    Trial,
    choose,
    expect_command,
    expect_delay,
    expect_follower,
    judge,
)
from bounce_mjx.identify.log import Log
from bounce_mjx.identify.response import Response
from bounce_mjx.identify.servos import Servos
from bounce_mjx.identify.simulation import Simulate, Simulated
from bounce_mjx.identify.unknowns import ARM, Layout
from bounce_mjx.identify.windows import Windows, is_seen

# The model's own servos, and others, that make a joint follow as late as measured: the shares of
# the rest of the delay that are a lag; the others' gains, and the shares of the delay that are
# theirs.
_OWN_LAG_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
_GAINS = (0.3, 1.0, 2.0, 4.0, 8.0, 30.0)
_SERVO_SHARES = (0.1, 0.3, 0.6, 0.9)
_LAG_SHARES = (0.0, 0.3, 0.6)
# Gains and longest own delays (s) of the servos of an arm that follows its commands exactly; and
# the factor of the least error that the least gain may have.
_FOLLOWING_GAINS = (1.0, 8.0, 30.0, 100.0)
_FOLLOWING_DELAYS = (5e-4, 1e-3, 3e-3)
_AS_EXACT = 1.01
# Steps in which servos of an arm that is carried and of one that is not are fitted and compared.
_COMPARED = 5
# Relative change of the units of the residuals that changes no fit.
_SAME_UNITS = 0.03
# Candidates with the model's own servos, and with others, from each of which a search over a few
# windows begins: a servo that is slow and a lag that is long delay alike, and only a search tells
# them apart.
_KEPT = 2


class Given(NamedTuple):
    """What a log says about its arm before any simulation."""

    log: Log
    response: Response
    following: Following
    """A delay and offsets, fitted to the windows that are seen."""
    delay: float
    """From a command to the angle, without the time for which it is held, s."""
    is_still: bool
    """Whether no command changes: nothing but the servos' offsets is shown."""
    has_set_points: bool
    """Whether the targets are a controller's own, which the joints follow at once: they say nothing
    about servos."""


def explain_arm(
    own: Problem,
    servos: Servos,
    given: Given,
    make: Callable[[Simulated], Simulate],
) -> tuple[Problem, Fit, Choice]:
    """The arm alone: the hypotheses, compared, and the problem and the fit of the chosen one.

    Args:
      own: the problem of an arm whose controller carries no more of its weight than the model's.
      servos: of the model.
      make: what is simulated -> the simulation of it.
    """
    windows = own.windows
    if given.is_still:
        own.progress("arm: its commands do not change")
        # Gravity's tilt would explain where an arm rests.
        fit = with_offsets(own, Fit(own.layout.mean, windows.starts))
        return own, fit, Choice((), STILL, (), None)
    unseen = ~is_seen(windows)
    own.progress(f"arm: {1e3 * given.following.delay:.1f} ms behind its commands")
    trials = _directly(windows, given)
    searches: dict[Hypothesis, tuple[Problem, Fit]] = {}
    if not given.has_set_points:
        searches = _search_servos(own, servos, given, make)
        of_servos = []
        for hypothesis, (problem, fit) in searches.items():
            of_servos.append(_judge_fit(hypothesis, problem, fit, unseen))
        first = choose(of_servos, windows, unseen, own.sensors.angles).chosen
        own.progress(f"arm: {first.name}")
        searches[first] = _fit_arm(*searches[first])
        trials += [
            _judge_fit(first, *searches[first], unseen) if trial.hypothesis == first else trial
            for trial in of_servos
        ]
    choice = choose(trials, windows, unseen, own.sensors.angles)
    own.progress(f"the log is explained by {choice.chosen.name}")
    if choice.chosen.has_servos:
        return *searches[choice.chosen], choice
    carried = Simulated(gravity_compensation=1.0)
    problem = own._replace(simulate=make(carried), simulated=carried)
    problem, fit = _exact_follower(problem, servos, given, choice.chosen)
    fit = with_offsets(problem, fit)
    # A training simulates the follower, and its formula does not.
    simulated = _judge_fit(choice.chosen, problem, fit, unseen)
    of_training = [simulated, *(choice.trial(hypothesis) for hypothesis in searches)]
    chosen = choose(of_training, windows, unseen, own.sensors.angles).chosen
    if chosen in searches:
        own.progress(f"{chosen.name} simulate it more exactly")
        return *searches[chosen], choice._replace(chosen=chosen)
    return problem, fit, choice


def _directly(windows: Windows, given: Given) -> list[Trial]:
    """The hypotheses that need no simulation."""
    seen = is_seen(windows)
    log = given.log
    follower, words = expect_follower(log, windows, seen, given.response)
    late = f"{1e3 * given.following.delay:.1f} ms"
    return [
        judge(COMMAND, windows, expect_command(log, windows), ~seen),
        judge(DELAY, windows, expect_delay(log, windows, given.following), ~seen, late),
        judge(FOLLOWER, windows, follower, ~seen, words),
    ]


def _search_servos(
    own: Problem, servos: Servos, given: Given, make: Callable[[Simulated], Simulate]
) -> dict[Hypothesis, tuple[Problem, Fit]]:
    """Fits of servos, without and with a controller that carries the arm, to the windows that are
    seen: each from the better of the best fits of both to a few windows, as a search may have ended
    too early."""
    found = {}
    begin = None
    for hypothesis in (SERVOS, CARRIED):
        simulated = Simulated(hypothesis.gravity_compensation)
        problem = own._replace(simulate=make(simulated), simulated=simulated)
        # What carries an arm changes offsets, and neither its delay nor its gains.
        found[hypothesis] = _search_arm(problem, servos, given, begin)
        begin = found[hypothesis][1]
    noise = own.noise._replace(
        angles=np.min([problem.noise.angles for problem, _ in found.values()], axis=0)
    )
    correlation = np.min([problem.correlation for problem, _ in found.values()], axis=0)
    fits = [fit for _, fit in found.values()]
    for hypothesis, (problem, _) in found.items():
        problem = problem._replace(noise=noise, correlation=correlation)
        states = problem.windows.arm_state
        tried = minimise_each(problem, fits, ["arm"], fits[0].weights, 1, states)
        best = min(tried, key=lambda fit: fit.cost)
        # All of them: gravity in postures that a few windows lack would decide otherwise.
        weights = problem.weights(0.0, seen_windows(problem))
        found[hypothesis] = problem, minimise(problem, best, ["arm"], weights, _COMPARED, states)
    return found


def _judge_fit(hypothesis: Hypothesis, problem: Problem, fit: Fit, unseen: np.ndarray) -> Trial:
    """Servos, judged in windows [S] that the search has not seen, from their best starts there."""
    weights = problem.weights(0.0, unseen[:, None].astype(float))
    started = minimise(problem, fit, [], weights, 3, problem.windows.arm_state)
    angles = problem.windows.split(started.predicted)[0]
    if not np.isfinite(started.cost):
        angles = np.full_like(angles, np.nan)
    return judge(hypothesis, problem.windows, angles, unseen)


def _exact_follower(
    problem: Problem, servos: Servos, given: Given, hypothesis: Hypothesis
) -> tuple[Problem, Fit]:
    """An arm that is where its command was, with servos for a training: those of the least gain
    with which the simulated joints follow as exactly as with any. It knows nothing of windows that
    are held out."""
    layout = problem.layout
    windows = problem.windows
    late = hypothesis == DELAY
    # A servo answers the mean command of a physics step, that of its middle, at the step's end: the
    # sum of latency and the servo's delay counts half a step too much.
    total = max((given.delay if late else 0.0) + 0.5 * layout.physics_dt, 0.0)
    offsets = given.following.offsets if late else np.zeros(layout.num_joints)
    few = problem.weights(0.0, sample(problem, np.any(windows.angle_weights > 0.0, axis=1)))
    tried = list(itertools.product(_FOLLOWING_GAINS, _FOLLOWING_DELAYS))
    begins = []
    for gain, longest in tried:
        of_servo = max(min(longest, total), _FOLLOWING_DELAYS[0])
        damping = servos.damping_for(of_servo, gain, ARM["servo_damping"].limits)
        world = {
            "servo_gain": np.full(layout.num_joints, gain),
            "servo_damping": damping,
            "servo_offset": offsets,
            "action_latency": max(total - float(np.mean(servos.delays(gain, damping))), 0.0),
            "servo_lag": 0.0,
            "joint_frictionloss": np.zeros(layout.num_joints),
        }
        begins.append(Fit(layout.clip(layout.vector(world)), windows.starts))
    fits = minimise_each(problem, begins, [], few, 2, windows.arm_state)
    best: dict[float, tuple[float, Fit]] = {}
    for (gain, _), fit in zip(tried, fits, strict=True):
        size = float(np.sum(joint_errors(windows, fit) ** 2)) if np.isfinite(fit.cost) else np.inf
        if size < best.get(gain, (np.inf, fit))[0]:
            best[gain] = size, fit
    least = min(size for size, _ in best.values())
    gain = min(gain for gain, (size, _) in best.items() if size <= _AS_EXACT**2 * least)
    fit = best[gain][1]._replace(starts=windows.starts)
    problem = in_units_of_errors(problem, best[gain][1])
    return problem, with_offsets(problem, fit, seen_windows(problem))


def _search_arm(
    problem: Problem,
    servos: Servos,
    given: Given,
    other: Fit | None,
) -> tuple[Problem, Fit]:
    """The best fit to a few windows of the arm, from candidates that differ in what a search could
    confuse, or from the fit of another hypothesis; and the problem in units of the errors that it
    leaves.

    Args:
      other: the fit of the other hypothesis, if there is one.
    """
    layout = problem.layout
    windows = problem.windows
    rough = np.hypot(problem.sensors.angles, given.following.errors)
    problem = problem._replace(noise=problem.noise._replace(angles=rough))
    if other is None:
        near = _own_servos(layout, servos, given.delay)
        vectors = np.concatenate([near, _late_servos(layout, servos, given.delay)])
    else:
        near = other.vector[None]
        vectors = near.copy()
    few = problem.weights(0.0, sample(problem, np.any(windows.angle_weights > 0.0, axis=1)))
    used = np.any(few > 0.0, axis=1)
    starts = np.repeat(windows.starts[None], len(vectors), axis=0)
    predicted = problem.simulate(vectors, starts, np.tile(used, (len(vectors), 1)))
    is_angle = few[:, : windows.angles[0].size].reshape(windows.angles.shape) > 0.0
    costs = []
    for vector, rows in zip(vectors, predicted, strict=True):
        # An offset of each joint is a part of every candidate.
        residuals = windows.angles - windows.split(rows)[0]
        offsets = np.median(residuals[is_angle].reshape(-1, layout.num_joints), axis=0)
        vector[layout.slices["servo_offset"]] = offsets
        left = np.where(is_angle, residuals - offsets, 0.0) / rough
        costs.append(np.sum(left**2) if np.all(np.isfinite(left)) else np.inf)
    is_near = np.arange(len(vectors)) < len(near)
    ranked = np.argsort(costs)
    best = [*ranked[is_near[ranked]][:_KEPT], *ranked[~is_near[ranked]][:_KEPT]]
    begins = [Fit(vectors[i], windows.starts) for i in best]
    fits = minimise_each(problem, begins, ["arm"], few, 2, windows.arm_state)
    fit = min(fits, key=lambda fit: fit.cost)
    return in_units_of_errors(problem, fit), fit


def _own_servos(layout: Layout, servos: Servos, delay: float) -> np.ndarray:
    """Candidates [C, P] with the model's own servos, late as measured (s) by latency and lag, with
    the dry friction that arms have and with the model's own: a log of the model itself, as of a
    rehearsal, is so exact that a search from another friction ends elsewhere."""
    rest = max(delay - float(np.mean(servos.delays())), 0.0)
    vectors = []
    for share in _OWN_LAG_SHARES:
        late = {"action_latency": (1.0 - share) * rest, "servo_lag": share * rest}
        vectors.append(layout.vector(late))
        vectors.append(layout.vector(late | {"joint_frictionloss": servos.frictionloss}))
    return np.stack(vectors)


def _late_servos(layout: Layout, servos: Servos, delay: float) -> np.ndarray:
    """Candidates [C, P] whose joints follow their commands as late as measured (s)."""
    total = max(delay, 2e-3)
    vectors = []
    for gain, servo_share, lag_share in itertools.product(_GAINS, _SERVO_SHARES, _LAG_SHARES):
        damping = servos.damping_for(servo_share * total, gain, ARM["servo_damping"].limits)
        # The joints' own damping may make them later than that share.
        rest = total - float(np.mean(servos.delays(gain, damping)))
        # A share of what the servo was to leave.
        lag = lag_share * (1.0 - servo_share) * total
        if rest < lag and gain < max(_GAINS):
            # Servos so soft would be later than measured.
            continue
        rest = max(rest, 0.0)
        lag = min(lag, rest)
        world = {
            "servo_gain": np.full(layout.num_joints, gain),
            "servo_damping": damping,
            "action_latency": rest - lag,
            "servo_lag": lag,
        }
        vectors.append(layout.clip(layout.vector(world)))
    return np.stack(vectors)


def _fit_arm(problem: Problem, fit: Fit) -> tuple[Problem, Fit]:
    """The arm in all windows that the search sees, to which it was fitted, with robust weights and
    in units of what the model leaves there."""
    states = problem.windows.arm_state
    seen = seen_windows(problem)
    for _ in range(2):
        before = problem.deviations
        problem = in_units_of_errors(problem, fit)
        angles = angle_weights(problem, problem.predict(fit.vector, fit.starts))
        fit = minimise(problem, fit, ["arm"], problem.weights(0.0, seen, angles), 4, states)
        if np.allclose(problem.deviations, before, rtol=_SAME_UNITS):
            break
    return problem, fit


def in_units_of_errors(problem: Problem, fit: Fit) -> Problem:
    """The problem in units of the sensors' noise, or of the model's errors of the angles where they
    are larger, and with as many angles as their correlation leaves."""
    windows = problem.windows
    errors = joint_errors(windows, fit)
    angles = np.maximum(problem.sensors.angles, errors)
    residuals = windows.split(fit.predicted)[0] - windows.angles
    counts = np.any(windows.split(fit.weights)[0] > 0.0, axis=2)
    return problem._replace(
        noise=problem.noise._replace(angles=angles),
        correlation=correlation_times(residuals, counts),
    )


def with_offsets(problem: Problem, fit: Fit, windows: np.ndarray | float = 1.0) -> Fit:
    """The fit with the servo offsets of some windows [S, 1], by default of all; without these an
    unknown that is no servo's would have to explain where the joints stand."""
    vector = fit.vector.copy()
    angles = problem.windows.split(problem.predict(fit.vector, fit.starts))[0]
    counts = problem.windows.angle_weights * windows > 0.0
    residuals = (problem.windows.angles - angles)[counts]
    vector[problem.layout.slices["servo_offset"]] += np.median(residuals, axis=0)
    return fit._replace(vector=vector)
