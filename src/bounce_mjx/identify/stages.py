"""The search for a robot's world: the arm alone, the ball's flights, its bounces, all together."""

import itertools
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.polynomial.polynomial import polyfit

from bounce_mjx.errors import UserError
from bounce_mjx.identify.fit import (
    AIR_LIFT,
    NO_FLIGHT,
    Fit,
    Noise,
    Problem,
    angle_weights,
    certainty,
    correlation_times,
    flight_errors,
    minimise,
    picture_weights,
)
from bounce_mjx.identify.flight import Flight, acceleration, fit_flight
from bounce_mjx.identify.following import (
    Following,
    command_delay,
    does_move,
    error_size,
    find_settled,
    follow,
    held_out_error,
    set_points,
    shows_set_points,
)
from bounce_mjx.identify.log import Log, least_age
from bounce_mjx.identify.servos import Servos, servos_of
from bounce_mjx.identify.simulation import Simulate, make_simulator
from bounce_mjx.identify.unknowns import ARM, Layout
from bounce_mjx.identify.windows import BEFORE_BOUNCE, GUESSED_DRAG, Windows, cut
from bounce_mjx.robot.model import find_addresses
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.model import model_nominals, world_model

# Every fifth window is held out of the search for the unknowns until its last stage. Its residuals
# give its outliers less weight, as in all windows, and choose between servos and a follower: of the
# two errors the smaller one is told, which is a little too small.
_HELD_OUT = 5
# Latencies of the ball, s, and its frictions, of the first candidates.
_BALL_LATENCIES = np.arange(-0.004, 0.05, 0.008)
_FRICTIONS = (0.01, 0.2)
# Windows in which the first candidates are compared.
_FEW = 13
# The model's own servos, and others, that make a joint follow as late as measured: the shares of
# the rest of the delay that are a lag; the others' gains, and the shares of the delay that are
# theirs.
_OWN_LAG_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
_GAINS = (1.0, 2.0, 4.0, 8.0, 30.0)
_SERVO_SHARES = (0.1, 0.3, 0.6, 0.9)
_LAG_SHARES = (0.0, 0.3, 0.6)
# Gains and longest own delays (s) of servos that are too stiff to matter.
_STIFF_GAINS = (30.0, 100.0)
_STIFF_DELAYS = (5e-4, 1e-3, 3e-3)
# Candidates with the model's own servos, and with others, from each of which a search over a few
# windows begins: a servo that is slow and a lag that is long delay alike, and only a search tells
# them apart.
_KEPT = 2
# Decreases of the cost from which the controller counts as carrying the arm's weight, and from
# which the ball counts as one that leaves the paddle at once.
_CARRIED = 10.0
_SHORT_CONTACT = 10.0
# Successive angles that count as one below which what is left is the noise of the sensors: then an
# error of the simulation's step shows.
_FEW_ALIKE = 3.0
# Standard deviation of stamps about regular steps below which the steps count as regular, s.
_JITTER = 5e-4
_FEWEST_BOUNCES = 3
# Time between two logs that are joined, s: a gap, also where steps are as long as a log may have.
_APART = 1.5
# Distance of the bounces from the paddle's height beyond which the search would not find them, m.
_BESIDE = 0.03


class Identified(NamedTuple):
    """What a log says about a robot's world."""

    layout: Layout
    windows: Windows
    noise: Noise
    fit: Fit
    information: np.ndarray
    """Of the log about the unknowns [P, P], without the prior: the inverse of their covariance,
    after the starts are eliminated."""
    covariance: np.ndarray
    """Of the unknowns [P, P], with the prior."""
    before: dict[str, float]
    """Root of the mean squared residual of each sensor, in units of its noise: in the model's own
    world, from the starts of the identified one."""
    after: dict[str, float]
    """In the identified world."""
    held_out: dict[str, float]
    """On the windows that the search had not seen, with their outliers weighted; without a sensor
    that none of them shows."""
    dropped: int
    """Windows whose ball was not in free flight."""
    counted: Noise | None = None
    """What the fit counted as noise: the sensors', or the model's own errors where they are
    larger."""
    following: Following | None = None
    """The simplest model: every joint follows its command late, with an offset."""
    following_errors: np.ndarray = np.zeros(0)
    """Its errors [n] in the windows that the search had not seen, rad."""
    joint_errors: np.ndarray = np.zeros(0)
    """Those of the identified world [n], rad. Where it is a follower, its offsets are medians over
    all windows."""
    gravity_compensation: float = 0.0
    """Share of the arm's weight that its controller carries, if more than the model's own."""
    is_still: bool = False
    """Whether no command of the log changes: it shows no delay, and no servos but their offsets."""
    has_set_points: bool = False
    """Whether the log's targets are a controller's own set points: the arm is then a follower."""
    is_follower: bool = False
    """Whether the arm follows its commands late, with an offset and stiff servos: its targets are
    set points, or a fit of the servos explained windows that the search had not seen no better."""
    has_lift: bool = False
    """Whether the flights show lift by spin."""
    leaves_at_once: bool = False
    """Whether the bounces show a ball that does not stay on the paddle, as the model's does."""
    stamp_age: float = 0.0
    """Time from a picture's stamp to its arrival, s: `ball_latency` in the fit is without it."""

    @property
    def deviation(self) -> np.ndarray:
        """Standard deviations [P] of the unknowns."""
        return np.sqrt(np.diag(self.covariance))


def join(logs: Sequence[Log]) -> Log:
    """Several logs, one after another, without the pictures of times at which the arm was not
    recorded; no window spans two of them."""
    shifted = []
    start = 0.0
    for log in logs:
        first = min(log.times[0], log.target_times[0])
        last = max(log.times[-1], log.target_times[-1])
        is_within = (log.picture_times >= first) & (log.picture_times <= last + 0.5 * _APART)
        shift = start - first
        shifted.append(
            log._replace(
                times=log.times + shift,
                target_times=log.target_times + shift,
                picture_times=log.picture_times[is_within] + shift,
                ball_positions=log.ball_positions[is_within],
                arrivals=log.arrivals[is_within] + shift,
            )
        )
        start = float(last + shift) + _APART

    def joined(field: str) -> np.ndarray:
        return np.concatenate([getattr(log, field) for log in shifted])

    return Log(
        source=", ".join(log.source for log in logs),
        times=joined("times"),
        joint_angles=joined("joint_angles"),
        target_times=joined("target_times"),
        servo_targets=joined("servo_targets"),
        picture_times=joined("picture_times"),
        ball_positions=joined("ball_positions"),
        arrivals=joined("arrivals"),
        notes=tuple(note for log in logs for note in log.notes),
    )


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


def _straighten(times: np.ndarray) -> np.ndarray:
    """Stamps [T] of control steps at regular times, in each stretch in which they only jitter about
    a line: what a stamp is off by is an error of the stamp, not of the step."""
    steps = np.diff(times)
    typical = float(np.median(steps))
    stretches = []
    for part in np.split(times, np.flatnonzero(steps > 1.5 * typical) + 1):
        index = np.arange(len(part)) - 0.5 * (len(part) - 1)
        slope = typical if len(part) < 50 else float(index @ part / (index @ index))
        line = np.mean(part) + slope * index
        stretches.append(line if np.std(part - line) < _JITTER else part)
    # Where jitter alone parts two stretches, their lines may overlap by less than it.
    return np.sort(np.concatenate(stretches))


def identify(
    config: WorldConfig,
    log: Log,
    camera_rotation: float = 0.0,
    progress: Callable[[str], None] = lambda line: None,
) -> Identified:
    """Estimates the world of a robot from its log.

    Args:
      config: settings of the robot's environment.
      camera_rotation: prior standard deviation of the camera's rotation, rad; 0 for a camera that
        is calibrated.
      progress: called with a line about each step.

    Raises:
      UserError: the log has fewer than five windows, the ball bounces beside the paddle, or the
        simulation diverges.
    """
    times = {name: _straighten(getattr(log, name)) for name in ("times", "target_times")}
    log = log._replace(**times)
    windows = _cut_enough(log, config.physics_dt)
    bounces = int(np.sum(windows.has_ball))
    with_ball = bounces > 0
    progress(f"{len(windows.first)} windows, {bounces} with a bounce")
    if with_ball:
        _check_frame(windows, config, log.source)
    layout = Layout(config.num_joints, with_ball, config.physics_dt, camera_rotation)
    sensors = sensor_noise(log)
    settled = find_settled(log)
    held_out = _held_out_rows(log, windows)
    following = follow(log, settled & ~held_out)
    delay = command_delay(log, following)
    # Before `log` has a command in each physics step, as `following` was fitted without these.
    following_errors = held_out_error(log, following, settled & held_out)
    is_still = not does_move(log)
    has_set_points = shows_set_points(log, following)
    log = set_points(log, following, config.physics_dt)
    own = Problem(
        simulate=make_simulator(config, layout, log, windows),
        windows=windows,
        layout=layout,
        sensors=sensors,
        noise=sensors,
        progress=progress,
    )
    problem, fit, is_follower = _explain_arm(
        own, config, log, following, delay, is_still, has_set_points
    )
    share = problem.gravity_compensation
    # The unknowns and the entries of the starts that the last searches vary.
    stages = [] if is_follower else ["arm"]
    free_states = windows.arm_state
    pictures = np.ones_like(windows.picture_weights)
    if with_ball:
        make = partial(make_simulator, config, layout, log, windows, share)
        problem, fit, pictures = _fit_ball(problem, fit, make)
        stages = [*stages, "flight", "bounce"]
        free_states = None
    if not is_still and not is_follower and np.max(problem.correlation) < _FEW_ALIKE:
        finer = _halve_steps(config)
        layout = Layout(config.num_joints, with_ball, finer.physics_dt, camera_rotation)
        problem, fit = _in_finer_steps(problem, fit, layout, finer, log)
    progress("all")
    fit, unseen = _fit_all(problem, fit, pictures, stages, free_states)
    if not fit.cost < np.inf:
        raise UserError(
            f"the simulation of {log.source} diverges with {config.physics_dt:g} s steps; take a "
            "smaller physics_dt in the robot's config"
        )
    nominals = model_nominals(config)
    known = {name: nominals[name] for name in layout.terms if name in nominals}
    nominal_vector = own.layout.vector(known)
    before = fit._replace(predicted=own.predict(nominal_vector, fit.starts))
    is_estimated = layout.free(stages)
    if is_follower:
        # By `follow`; its servos were chosen.
        is_estimated[layout.slices["delay"]] = True
        is_estimated[layout.slices["servo_offset"]] = True
    information, covariance = certainty(problem, fit, is_estimated)
    counts = np.any(windows.split(fit.weights)[1] > 0.0, axis=(1, 2))
    by_sensor = problem._replace(noise=sensors, correlation=1.0)
    return Identified(
        layout=layout,
        windows=windows,
        noise=sensors,
        fit=fit,
        information=information,
        covariance=covariance,
        before=_measure_errors(by_sensor, before),
        after=_measure_errors(by_sensor, fit),
        held_out=_measure_errors(by_sensor, unseen),
        dropped=int(np.sum(windows.has_ball & ~counts)),
        counted=problem.noise,
        following=following,
        following_errors=following_errors,
        joint_errors=_joint_errors(windows, unseen),
        gravity_compensation=share,
        is_still=is_still,
        has_set_points=has_set_points,
        is_follower=is_follower,
        has_lift=problem.has_lift,
        leaves_at_once=problem.leaves_at_once,
        stamp_age=least_age(log),
    )


def _explain_arm(
    own: Problem,
    config: WorldConfig,
    log: Log,
    following: Following,
    delay: float,
    is_still: bool,
    has_set_points: bool,
) -> tuple[Problem, Fit, bool]:
    """The arm alone: the problem and its fit with servos, or with the stiff ones of a follower, and
    whether it is one.

    Args:
      own: the problem of an arm whose controller does not carry its weight.
      log: where the commands are set points, with one for each physics step.
      delay: from a command to the angle (`command_delay`), s.
      is_still: whether no command changes. Then the servos' offsets alone are fitted.
      has_set_points: whether the arm is a follower without a comparison.
    """
    windows = own.windows
    if is_still:
        own.progress("arm: its commands do not change")
        # Gravity's tilt would explain where an arm rests.
        return own, _with_offsets(own, Fit(own.layout.mean, windows.starts)), False
    own.progress(f"arm: {1e3 * following.delay:.1f} ms behind its commands")
    simulate = make_simulator(config, own.layout, log, windows, carried=1.0)
    carried = own._replace(simulate=simulate, gravity_compensation=1.0)
    searches = [_search_arm(problem, config, delay, following) for problem in (own, carried)]
    problem, fit = _choose(own, carried, searches)
    problem, fit = _fit_arm(problem, fit)
    follower = _stiff_follower(problem, config, delay, following)
    if has_set_points:
        own.progress("the targets are set points, which the arm follows")
    elif _explains_better(problem, follower, fit):
        own.progress("a delay and offsets explain the arm as well as its servos do")
    else:
        return problem, fit, False
    # As the last fit of servos, in all windows.
    return problem, _with_offsets(problem, follower), True


def _in_finer_steps(
    problem: Problem, fit: Fit, layout: Layout, config: WorldConfig, log: Log
) -> tuple[Problem, Fit]:
    """The problem and its fit in the physics steps of another config, for which `layout` is:
    windows and simulation have two in place of one."""
    # Latency and lag are the same; their delay and its variance depend on the lag's steps.
    world = problem.layout.world(fit.vector)
    simulate = make_simulator(
        config,
        layout,
        log,
        problem.windows.finer(),
        problem.gravity_compensation,
        AIR_LIFT * problem.has_lift,
        problem.leaves_at_once,
    )
    problem = problem._replace(simulate=simulate, layout=layout)
    return problem, fit._replace(vector=layout.vector(world))


def _fit_all(
    problem: Problem,
    fit: Fit,
    pictures: np.ndarray,
    stages: Sequence[str],
    free_states: np.ndarray | None,
) -> tuple[Fit, Fit]:
    """The fit to all windows; and the one before it, of the windows that the search sees, with the
    best starts of the others.

    Args:
      pictures: weights of the pictures [S, B].
      stages, free_states: what is searched, as for `minimise`.
    """
    seen = _training(problem)
    angles = angle_weights(problem, problem.predict(fit.vector, fit.starts))
    of_seen = problem.weights(pictures, seen, angles)
    of_unseen = problem.weights(pictures, 1.0 - seen, angles)
    of_all = problem.weights(pictures, 1.0, angles)
    fit = minimise(problem, fit, stages, of_seen, 3, free_states)
    unseen = minimise(problem, fit, [], of_unseen, 3, free_states)
    return minimise(problem, unseen, stages, of_all, 3, free_states), unseen


def _cut_enough(log: Log, physics_dt: float) -> Windows:
    """The windows of a log; of the arm alone if it has too few bounces for the unknowns of the
    ball, as the arm's unknowns would make good for these."""
    windows = cut(log, physics_dt)
    if np.sum(windows.has_ball) >= _FEWEST_BOUNCES:
        return windows
    none = np.zeros(0)
    of_arm = log._replace(picture_times=none, ball_positions=np.zeros((0, 3)), arrivals=none)
    return cut(of_arm, physics_dt)


def _halve_steps(config: WorldConfig) -> WorldConfig:
    """The robot in physics steps of half the length.

    A real robot has no steps. With those of a training, gains and frictions would make good for the
    length of a step, by up to four standard deviations of what a minute's log shows.
    """
    return config.model_copy(update={"physics_dt": 0.5 * config.physics_dt})


def _held_out_rows(log: Log, windows: Windows) -> np.ndarray:
    """Which joint angles [T] of a log are in windows that the search does not see."""
    rows = np.zeros(len(log.times), bool)
    for s in np.flatnonzero(~_is_seen(windows)):
        used = windows.angle_times[s, windows.angle_weights[s] > 0.0]
        if len(used):
            times = log.times - windows.zero[s]
            rows |= (times > used[0] - 1e-6) & (times < used[-1] + 1e-6)
    return rows


def _joint_errors(windows: Windows, fit: Fit) -> np.ndarray:
    """Root mean square [n] of the angles' residuals where they count, rad."""
    angles = windows.split(fit.predicted)[0]
    weights = windows.split(fit.weights)[0]
    counts = np.any(weights > 0.0, axis=2)
    return error_size((angles - windows.angles)[counts])


def _squared_errors(windows: Windows, fit: Fit) -> float:
    """Of all joints together, rad^2; infinite if the simulation diverges."""
    if not np.isfinite(fit.cost):
        return np.inf
    return float(np.sum(_joint_errors(windows, fit) ** 2))


def _is_seen(windows: Windows) -> np.ndarray:
    """Which windows [S] the search sees: all but every fifth; of a log whose few bounces are all in
    these, all but those before them."""
    place = np.arange(len(windows.first)) % _HELD_OUT
    is_seen = place != _HELD_OUT - 1
    if np.any(windows.has_ball) and not np.any(windows.has_ball & is_seen):
        return place != _HELD_OUT - 2
    return is_seen


def _training(problem: Problem) -> np.ndarray:
    """1 for each window of the search [S, 1], 0 for those held out."""
    return _is_seen(problem.windows)[:, None].astype(float)


def _check_frame(windows: Windows, config: WorldConfig, source: str) -> None:
    """Refuses a ball that bounces beside the paddle: no search would find where it is, as it would
    not bounce there.

    Raises:
      UserError: it does.
    """
    model = world_model(config, visual=False)
    offsets = []
    addresses = find_addresses(model)
    data = mujoco.MjData(model)
    paddle = addresses.paddle_geom
    radius = model.geom_size[addresses.balls[0].geom, 0]
    for s in np.flatnonzero(windows.has_ball & np.any(windows.angle_weights > 0.0, axis=1)):
        bounce = windows.bounces[s]
        since = np.abs(windows.angle_times[s] - bounce)
        near = np.argmin(np.where(windows.angle_weights[s] > 0.0, since, np.inf))
        data.qpos[list(addresses.arm_qpos)] = windows.angles[s, near]
        mujoco.mj_kinematics(model, data)
        normal = data.geom_xmat[paddle].reshape(3, 3)[:, 2]
        top = data.geom_xpos[paddle] + (model.geom_size[paddle, 2] + radius) * normal
        ball = windows.balls[s, np.argmin(np.abs(windows.picture_times[s] - bounce))]
        offsets.append(ball - top)
    offset = np.median(offsets, axis=0) if offsets else np.zeros(3)
    if np.hypot(*offset[:2]) > np.max(model.geom_size[paddle, :2]) or abs(offset[2]) > _BESIDE:
        x, y, z = offset
        raise UserError(
            f"the ball in {source} bounces {x:.3f}, {y:.3f}, {z:.3f} m (x, y, z) beside the "
            "paddle; give its position in the frame of the robot's base, in metres, z up, and the "
            "robot with the paddle as it is mounted"
        )


def _fit_ball(
    problem: Problem, fit: Fit, make: Callable[[float, bool], Simulate]
) -> tuple[Problem, Fit, np.ndarray]:
    """The ball's flights, then its bounces; and the weights of the pictures [S, B].

    Args:
      make: (lift, whether the ball leaves the paddle at once) -> the simulation with such a ball,
        which counts where flights and bounces show it.
    """
    windows = problem.windows
    states = ~problem.windows.arm_state
    seen = _training(problem)
    problem.progress("flight")
    flying = windows.picture_times < windows.bounces[:, None] - BEFORE_BOUNCE
    plain = minimise(problem, fit, ["flight"], problem.weights(flying, seen), 4, states)
    if _flies(problem, plain, flying):
        fit = plain
    else:
        # A ball with spin is a real one.
        real = make(AIR_LIFT, True)
        spinning = problem._replace(simulate=real, has_lift=True, leaves_at_once=True)
        guess = _guess_spins(spinning, fit)
        spinning = spinning._replace(noise=_flight_noise(spinning, guess, flying))
        turned = minimise(spinning, guess, ["flight"], problem.weights(flying, seen), 8, states)
        if _flies(spinning, turned, flying):
            problem = spinning
            fit = turned
            problem.progress("the flights show lift by spin")
    problem.progress("bounce")
    stages = ["flight", "bounce"]
    few = problem.weights(1.0, _sample(problem, windows.has_ball))
    # A ball that slips and one that sticks are two valleys, and each latency may be one.
    tried = [
        _shift_flights(problem, fit, latency, friction)
        for latency, friction in itertools.product(_BALL_LATENCIES, _FRICTIONS)
    ]
    for kept, iterations in ((4, 1), (1, 2)):
        found = [minimise(problem, x, stages, few, iterations, states) for x in tried]
        tried = sorted(found, key=lambda fit: fit.cost)[:kept]
    fit = tried[0]
    if not problem.leaves_at_once:
        problem, fit = _choose_contact(problem, fit, make, few)
    fit = minimise(problem, fit, stages, problem.weights(1.0, seen), 5, states)
    fit = minimise(problem, fit, [], problem.weights(1.0, 1.0 - seen), 3, states)
    pictures = picture_weights(problem, problem.predict(fit.vector, fit.starts))
    fit = minimise(problem, fit, stages, problem.weights(pictures, seen), 6, states)
    return problem, fit, pictures


def _choose_contact(
    problem: Problem, fit: Fit, make: Callable[[float, bool], Simulate], few: np.ndarray
) -> tuple[Problem, Fit]:
    """Whether the ball leaves the paddle at once, as a real one does, or later, as the model's: the
    log decides, by the costs of both fits to `few` windows (their weights [S, M])."""
    stages = ["flight", "bounce"]
    states = ~problem.windows.arm_state
    real = problem._replace(simulate=make(0.0, True), leaves_at_once=True)
    of_model, of_real = (minimise(x, fit, stages, few, 3, states) for x in (problem, real))
    if of_model.cost - of_real.cost < _SHORT_CONTACT:
        return problem, of_model
    problem.progress("the ball leaves the paddle at once")
    return real, of_real


def _guess_spins(problem: Problem, fit: Fit) -> Fit:
    """The fit with the spin and the drag of each flight before a bounce, by a direct fit of it."""
    windows = problem.windows
    starts = fit.starts.copy()
    vector = fit.vector.copy()
    deviations, _, _ = problem.scale_starts()
    lift_deviation = AIR_LIFT * deviations[-2]
    drag_deviation = deviations[-1]
    with_ball = np.flatnonzero(windows.has_ball)
    latency = vector[problem.layout.slices["ball_latency"]]

    def fit_window(s: int, drag: float, drag_deviation: float) -> Flight:
        before = windows.picture_times[s] < windows.bounces[s] - BEFORE_BOUNCE
        counts = before & (windows.picture_weights[s] > 0.0)
        return fit_flight(
            windows.picture_times[s, counts] - latency,
            windows.balls[s, counts],
            problem.noise.balls,
            drag,
            lift_deviation,
            drag_deviation,
        )

    # At first, each flight may have any drag; their median is then that of the ball.
    seen = with_ball[_is_seen(windows)[with_ball]]
    free = [fit_window(s, GUESSED_DRAG, 1.0).drag_deviation for s in seen]
    drag = GUESSED_DRAG * (1.0 + float(np.median(free)))
    vector[problem.layout.slices["air_drag"]] = drag
    for s in with_ball:
        flight = fit_window(s, drag, drag_deviation)
        spin = flight.lift / AIR_LIFT
        starts[s, -10:] = [*flight.position, *flight.velocity, *spin, flight.drag_deviation]
    return fit._replace(vector=vector, starts=starts)


def _flight_noise(problem: Problem, fit: Fit, flying: np.ndarray) -> Noise:
    """The sensors' noise, or what the flights [S, B] of the search leave where it is larger: a
    camera's errors that change slowly are not in the differences of neighbouring pictures."""
    windows = problem.windows
    residuals = windows.split(problem.predict(fit.vector, fit.starts))[1] - windows.balls
    counts = flying & (windows.picture_weights > 0.0) & (_training(problem) > 0.0)
    errors = error_size(residuals[counts])
    return problem.noise._replace(balls=np.maximum(problem.sensors.balls, errors))


def _flies(problem: Problem, fit: Fit, flying: np.ndarray) -> bool:
    """Whether most flights [S, B] before a bounce, of those in the search, are explained."""
    counts = problem.windows.has_ball & (_training(problem)[:, 0] > 0.0)
    pictures = problem.windows.picture_weights * flying
    errors = flight_errors(problem, problem.predict(fit.vector, fit.starts), pictures)
    return bool(np.mean(errors[counts] < NO_FLIGHT) > 0.5)


def _search_arm(
    problem: Problem, config: WorldConfig, delay: float, following: Following
) -> tuple[Problem, Fit]:
    """The best fit to a few windows of the arm, from candidates that differ in what a search could
    confuse; and the problem in units of the errors that it leaves.

    Args:
      delay: time from a command to the angle, s.
    """
    layout = problem.layout
    windows = problem.windows
    rough = np.hypot(problem.sensors.angles, following.errors)
    problem = problem._replace(noise=problem.noise._replace(angles=rough))
    servos = servos_of(world_model(config, visual=False))
    of_model = _own_servos(layout, servos, delay)
    vectors = np.concatenate([of_model, _late_servos(layout, servos, delay)])
    few = problem.weights(0.0, _sample(problem, np.any(windows.angle_weights > 0.0, axis=1)))
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
    is_of_model = np.arange(len(vectors)) < len(of_model)
    ranked = np.argsort(costs)
    best = [*ranked[is_of_model[ranked]][:_KEPT], *ranked[~is_of_model[ranked]][:_KEPT]]
    fits = [
        minimise(problem, Fit(vectors[i], windows.starts), ["arm"], few, 2, windows.arm_state)
        for i in best
    ]
    fit = min(fits, key=lambda fit: fit.cost)
    return _in_units_of_errors(problem, fit), fit


def _with_offsets(problem: Problem, fit: Fit, windows: np.ndarray | float = 1.0) -> Fit:
    """The fit with the servo offsets of some windows [S, 1], by default of all; without these an
    unknown that is no servo's would have to explain where the joints stand."""
    vector = fit.vector.copy()
    angles = problem.windows.split(problem.predict(fit.vector, fit.starts))[0]
    counts = problem.windows.angle_weights * windows > 0.0
    residuals = (problem.windows.angles - angles)[counts]
    vector[problem.layout.slices["servo_offset"]] += np.median(residuals, axis=0)
    return fit._replace(vector=vector)


def _own_servos(layout: Layout, servos: Servos, delay: float) -> np.ndarray:
    """Candidates [C, P] with the model's own servos, late as measured (s) by latency and lag."""
    rest = max(delay - float(np.mean(servos.delays())), 0.0)
    return np.stack(
        [
            layout.vector({"action_latency": (1.0 - share) * rest, "servo_lag": share * rest})
            for share in _OWN_LAG_SHARES
        ]
    )


def _late_servos(layout: Layout, servos: Servos, delay: float) -> np.ndarray:
    """Candidates [C, P] whose joints follow their commands as late as measured (s)."""
    total = max(delay, 2e-3)
    vectors = []
    for gain, servo_share, lag_share in itertools.product(_GAINS, _SERVO_SHARES, _LAG_SHARES):
        damping = servos.damping_for(servo_share * total, gain, ARM["servo_damping"].limits)
        # The joints' own damping may make them later than that share.
        rest = max(total - float(np.mean(servos.delays(gain, damping))), 0.0)
        # A share of what the servo was to leave.
        lag = min(lag_share * (1.0 - servo_share) * total, rest)
        world = {
            "servo_gain": np.full(layout.num_joints, gain),
            "servo_damping": damping,
            "action_latency": rest - lag,
            "servo_lag": lag,
        }
        vectors.append(layout.clip(layout.vector(world)))
    return np.stack(vectors)


def _stiff_follower(
    problem: Problem, config: WorldConfig, delay: float, following: Following
) -> Fit:
    """The arm that follows its commands as the simplest model does: late, with an offset of each
    joint, by servos that are too stiff to matter. It knows nothing of held-out windows."""
    layout = problem.layout
    windows = problem.windows
    # A servo answers the mean command of a physics step, that of its middle, at the step's end: the
    # sum of latency and the servo's delay counts half a step too much.
    total = max(delay + 0.5 * config.physics_dt, 0.0)
    servos = servos_of(world_model(config, visual=False))
    vectors = []
    for gain, longest in itertools.product(_STIFF_GAINS, _STIFF_DELAYS):
        of_servo = max(min(longest, total), _STIFF_DELAYS[0])
        damping = servos.damping_for(of_servo, gain, ARM["servo_damping"].limits)
        world = {
            "servo_gain": np.full(layout.num_joints, gain),
            "servo_damping": damping,
            "servo_offset": following.offsets,
            "action_latency": max(total - float(np.mean(servos.delays(gain, damping))), 0.0),
            "servo_lag": 0.0,
            "joint_frictionloss": np.zeros(layout.num_joints),
        }
        vectors.append(layout.clip(layout.vector(world)))
    few = problem.weights(0.0, _sample(problem, np.any(windows.angle_weights > 0.0, axis=1)))
    followers = [
        minimise(problem, Fit(vector, windows.starts), [], few, 2, windows.arm_state)
        for vector in vectors
    ]
    best = min(followers, key=lambda fit: _squared_errors(windows, fit))
    return _with_offsets(problem, best._replace(starts=windows.starts), _training(problem))


def _explains_better(problem: Problem, simple: Fit, fit: Fit) -> bool:
    """Whether the simple arm leaves no more than the fit in windows that neither has seen. A tie is
    the simple arm's, which has fewer unknowns."""
    windows = problem.windows
    unseen = problem.weights(0.0, 1.0 - _training(problem))

    def unseen_error(fit: Fit) -> float:
        """Of the arm's angles, with the best starts of these windows."""
        started = minimise(problem, fit, [], unseen, 3, windows.arm_state)
        return _squared_errors(windows, started)

    return unseen_error(simple) <= unseen_error(fit)


def _choose(
    own: Problem, carried: Problem, searches: Sequence[tuple[Problem, Fit]]
) -> tuple[Problem, Fit]:
    """Whether the controller carries the arm's weight: the log decides, by the costs of both fits
    in units of the smaller errors."""
    noise = own.noise._replace(angles=np.min([p.noise.angles for p, _ in searches], axis=0))
    correlation = np.min([problem.correlation for problem, _ in searches], axis=0)
    choices = []
    for problem in (own, carried):
        problem = problem._replace(noise=noise, correlation=correlation)
        # Also from the fit of the other: the search for one of the two may have ended too early.
        states = problem.windows.arm_state
        tried = [minimise(problem, fit, ["arm"], fit.weights, 4, states) for _, fit in searches]
        choices.append((problem, min(tried, key=lambda fit: fit.cost)))
    (_, of_own), (_, of_carried) = choices
    is_carried = of_own.cost - of_carried.cost > _CARRIED
    if is_carried:
        own.progress("the controller carries the arm's weight")
    return choices[int(is_carried)]


def _fit_arm(problem: Problem, fit: Fit) -> tuple[Problem, Fit]:
    """The arm in all windows that the search sees, with robust weights: first in units of the
    errors in a few windows, then in units of what the model leaves in all."""
    states = problem.windows.arm_state
    seen = _training(problem)
    fit = minimise(problem, fit, ["arm"], problem.weights(0.0, seen), 8, states)
    for _ in range(2):
        problem = _in_units_of_errors(problem, fit)
        angles = angle_weights(problem, problem.predict(fit.vector, fit.starts))
        fit = minimise(problem, fit, ["arm"], problem.weights(0.0, seen, angles), 4, states)
    return problem, fit


def _in_units_of_errors(problem: Problem, fit: Fit) -> Problem:
    """The problem in units of the sensors' noise, or of the model's errors of the angles where they
    are larger, and with as many angles as their correlation leaves."""
    windows = problem.windows
    errors = _joint_errors(windows, fit)
    angles = np.maximum(problem.sensors.angles, errors)
    residuals = windows.split(fit.predicted)[0] - windows.angles
    counts = np.any(windows.split(fit.weights)[0] > 0.0, axis=2)
    return problem._replace(
        noise=problem.noise._replace(angles=angles),
        correlation=correlation_times(residuals, counts),
    )


def _shift_flights(problem: Problem, fit: Fit, latency: float, friction: float) -> Fit:
    """The fit with another latency of the ball and friction on the paddle, and flights that explain
    the pictures before the bounces equally well."""
    places = problem.layout.slices
    n = problem.layout.num_joints
    vector = fit.vector.copy()
    starts = fit.starts.copy()
    later = latency - vector[places["ball_latency"].start]
    vector[places["ball_latency"]] = latency
    vector[places["contact_friction"]] = friction
    position = slice(2 * n, 2 * n + 3)
    velocity = slice(2 * n + 3, 2 * n + 6)
    spin = slice(2 * n + 6, 2 * n + 9)
    lift = AIR_LIFT * problem.has_lift * starts[:, spin]
    drag = vector[places["air_drag"]] * (1.0 + starts[:, -1])
    pull = acceleration(starts[:, velocity], drag, lift)
    starts[:, position] += later * starts[:, velocity] + 0.5 * later**2 * pull
    starts[:, velocity] += later * pull
    return fit._replace(vector=vector, starts=starts)


def _sample(problem: Problem, counts: np.ndarray) -> np.ndarray:
    """1 for about `_FEW` of the windows of the search that count [S], evenly over the log
    [S, 1]."""
    used = np.flatnonzero(counts & (_training(problem)[:, 0] > 0.0))
    few = np.zeros((len(counts), 1))
    few[used[:: max(len(used) // _FEW, 1)]] = 1.0
    return few


def _measure_errors(problem: Problem, fit: Fit) -> dict[str, float]:
    """Root mean square of each sensor's residuals in units of its noise; the entries of the starts
    that were searched count as degrees of freedom. The unknowns, dozens beside thousands of
    residuals, do not."""
    windows = problem.windows
    white = problem.whiten(fit.predicted, fit.weights)
    parts = zip(windows.split(white), windows.split(fit.weights), strict=True)
    searched = problem.scale_starts()[2]
    num_searched = [np.sum(searched[which]) for which in (windows.arm_state, ~windows.arm_state)]
    errors = {}
    for name, (residuals, weights), num_states in zip(
        ("joint_angles", "ball_position"), parts, num_searched, strict=True
    ):
        used = np.sum(weights > 0.0, axis=(1, 2))
        free = float(np.sum(np.maximum(used - num_states, 0)))
        if free > 0.0:
            errors[name] = float(np.sqrt(np.sum(residuals**2) / free))
    return errors
