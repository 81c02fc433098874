"""The search for a robot's world: the arm alone, the ball's flights, its bounces, all together."""

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.polynomial.polynomial import polyfit

from bounce_mjx.env.env import model_nominals, world_model
from bounce_mjx.errors import UserError
from bounce_mjx.identify.fit import Fit, Noise, Problem, certainty, minimise, picture_weights
from bounce_mjx.identify.log import Log, least_age
from bounce_mjx.identify.simulation import make_simulator
from bounce_mjx.identify.unknowns import Layout
from bounce_mjx.identify.windows import GRAVITY, Windows, cut
from bounce_mjx.robot.model import find_addresses
from bounce_mjx.world.config import WorldConfig

# Every fifth window is held out of the search until its last stage.
_HELD_OUT = 5
# Latencies and lags of the first candidates, s, and frictions of the ball.
_LATENCIES = (0.002, 0.01, 0.02, 0.03, 0.04, 0.055)
_BALL_LATENCIES = np.arange(-0.004, 0.05, 0.008)
_FRICTIONS = (0.01, 0.2)
# Windows in which the first candidates are compared.
_FEW = 13
_LAGS = (0.001, 0.008, 0.016, 0.026, 0.038)
# Standard deviation of stamps about regular steps below which the steps count as regular, s.
_JITTER = 5e-4
BEFORE_BOUNCE = 0.012
"""Time before a bounce at which a flight counts as over, s: the camera's jitter, half a contact."""
_FEWEST_BOUNCES = 3
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
    world."""
    after: dict[str, float]
    """In the identified world."""
    held_out: dict[str, float]
    """On the windows that the search had not seen."""
    dropped: int
    """Windows whose ball was not in free flight."""
    stamp_age: float = 0.0
    """Time from a picture's stamp to its arrival, s: `ball_latency` in the fit is without it."""

    @property
    def deviation(self) -> np.ndarray:
        """Standard deviations [P] of the unknowns."""
        return np.sqrt(np.diag(self.covariance))


def join(logs: Sequence[Log]) -> Log:
    """Several logs, one after another; no window spans two of them."""
    parts, start = [], 0.0
    names = "times", "target_times", "picture_times", "arrivals"
    for log in logs:
        shift = start - min(log.times[0], log.target_times[0])
        parts.append(log._replace(**{name: getattr(log, name) + shift for name in names}))
        start = float(max(parts[-1].times[-1], parts[-1].target_times[-1])) + 1.0
    source = ", ".join(log.source for log in logs)
    arrays = zip(*(part[1:-1] for part in parts), strict=True)
    notes = tuple(note for log in logs for note in log.notes)
    return Log(source, *(np.concatenate(array) for array in arrays), notes)


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
        t, rests = log.picture_times, []
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
    typical, stretches = float(np.median(steps)), []
    for part in np.split(times, np.flatnonzero(steps > 1.5 * typical) + 1):
        index = np.arange(len(part)) - 0.5 * (len(part) - 1)
        slope = typical if len(part) < 50 else float(index @ part / (index @ index))
        line = np.mean(part) + slope * index
        stretches.append(line if np.std(part - line) < _JITTER else part)
    return np.concatenate(stretches)


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
      UserError: the log has fewer than five windows, or the ball bounces beside the paddle.
    """
    times = {name: _straighten(getattr(log, name)) for name in ("times", "target_times")}
    log = log._replace(**times)
    windows = cut(log, config.physics_dt)
    bounces = int(np.sum(windows.has_ball))
    with_ball = bounces >= _FEWEST_BOUNCES
    progress(f"{len(windows.first)} windows, {bounces} with a bounce")
    if with_ball:
        _check_frame(windows, config, log.source)
    layout = Layout(config.num_joints, with_ball, config.physics_dt, camera_rotation)
    simulate = make_simulator(config, layout, log, windows)
    problem = Problem(simulate, windows, layout, sensor_noise(log), progress)
    progress("arm")
    stages, states, pictures, seen = ["arm"], windows.arm_state, 1.0, _training(problem)
    fit = minimise(problem, _guess_arm(problem), stages, problem.weights(0.0, seen), 10, states)
    if with_ball:
        fit, pictures = _fit_ball(problem, fit)
        stages, states = ["arm", "flight", "bounce"], None
    progress("all")
    fit = minimise(problem, fit, stages, problem.weights(pictures, seen), 3, states)
    unseen = minimise(problem, fit, [], problem.weights(pictures, 1.0 - seen), 3, states)
    fit = minimise(problem, unseen, stages, problem.weights(pictures), 3, states)
    nominals = model_nominals(config)
    own = layout.vector({name: nominals[name] for name in layout.terms if name in nominals})
    before = fit._replace(predicted=problem.predict(own, fit.starts))
    counts = np.any(windows.split(fit.weights)[1] > 0.0, axis=(1, 2))
    return Identified(
        layout,
        windows,
        problem.noise,
        fit,
        *certainty(problem, fit),
        *(_measure_errors(problem, x) for x in (before, fit, unseen)),
        int(np.sum(windows.has_ball & ~counts)),
        least_age(log),
    )


def _training(problem: Problem) -> np.ndarray:
    """1 for each window of the search [S, 1], 0 for those held out."""
    index = np.arange(len(problem.windows.first))
    return np.where(index % _HELD_OUT == _HELD_OUT - 1, 0.0, 1.0)[:, None]


def _check_frame(windows: Windows, config: WorldConfig, source: str) -> None:
    """Refuses a ball that bounces beside the paddle: no search would find where it is, as it would
    not bounce there.

    Raises:
      UserError: it does.
    """
    model, offsets = world_model(config, visual=False), []
    addresses, data = find_addresses(model), mujoco.MjData(model)
    paddle, radius = addresses.paddle_geom, model.geom_size[addresses.balls[0].geom, 0]
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


def _fit_ball(problem: Problem, fit: Fit) -> tuple[Fit, np.ndarray]:
    """The ball's flights, then its bounces; and the weights of the pictures [S, B]."""
    windows, states, seen = problem.windows, ~problem.windows.arm_state, _training(problem)
    problem.progress("flight")
    flying = windows.picture_times < windows.bounces[:, None] - BEFORE_BOUNCE
    fit = minimise(problem, fit, ["flight"], problem.weights(flying, seen), 4, states)
    problem.progress("bounce")
    stages, few = ["flight", "bounce"], problem.weights(1.0, _sample(problem, windows.has_ball))
    # A ball that slips and one that sticks are two valleys, and each latency may be one.
    tried = [
        _shift_flights(problem, fit, latency, friction)
        for latency, friction in itertools.product(_BALL_LATENCIES, _FRICTIONS)
    ]
    for kept, iterations in ((4, 1), (1, 2)):
        found = [minimise(problem, x, stages, few, iterations, states) for x in tried]
        tried = sorted(found, key=lambda fit: fit.cost)[:kept]
    fit = minimise(problem, tried[0], stages, problem.weights(1.0, seen), 5, states)
    fit = minimise(problem, fit, [], problem.weights(1.0, 1.0 - seen), 3, states)
    pictures = picture_weights(problem, problem.predict(fit.vector, fit.starts))
    return minimise(problem, fit, stages, problem.weights(pictures, seen), 6, states), pictures


def _guess_arm(problem: Problem) -> Fit:
    """The best of candidates that differ in latency and lag, which the search could confuse."""
    layout, own = problem.layout, problem.layout.world(problem.layout.mean)
    vectors = np.stack(
        [
            layout.vector(own | {"action_latency": latency, "servo_lag": lag})
            for latency, lag in itertools.product(_LATENCIES, _LAGS)
        ]
    )
    starts = np.repeat(problem.windows.starts[None], len(vectors), axis=0)
    counts = np.any(problem.windows.angle_weights > 0.0, axis=1)
    weights = problem.weights(0.0, _sample(problem, counts))
    used = np.tile(np.any(weights > 0.0, axis=1), (len(vectors), 1))
    white = problem.whiten(problem.simulate(vectors, starts, used), weights)
    best = int(np.nanargmin(np.sum(white**2, axis=(1, 2))))
    return Fit(vectors[best], starts[best])


def _shift_flights(problem: Problem, fit: Fit, latency: float, friction: float) -> Fit:
    """The fit with another latency of the ball and friction on the paddle, and flights that explain
    the pictures before the bounces equally well."""
    places, n = problem.layout.slices, problem.layout.num_joints
    vector, starts = fit.vector.copy(), fit.starts.copy()
    later = latency - vector[places["ball_latency"].start]
    vector[places["ball_latency"]], vector[places["contact_friction"]] = latency, friction
    position, velocity = slice(2 * n, 2 * n + 3), slice(2 * n + 3, 2 * n + 6)
    starts[:, position] += later * starts[:, velocity] + 0.5 * later**2 * GRAVITY
    starts[:, velocity] += later * GRAVITY
    return fit._replace(vector=vector, starts=starts)


def _sample(problem: Problem, counts: np.ndarray) -> np.ndarray:
    """1 for about `_FEW` of the windows of the search that count [S], evenly over the log
    [S, 1]."""
    used = np.flatnonzero(counts & (_training(problem)[:, 0] > 0.0))
    few = np.zeros((len(counts), 1))
    few[used[:: max(len(used) // _FEW, 1)]] = 1.0
    return few


def _measure_errors(problem: Problem, fit: Fit) -> dict[str, float]:
    """Root mean square of each sensor's residuals in units of its noise; the estimated starts count
    as degrees of freedom."""
    white = problem.whiten(fit.predicted, fit.weights)
    parts = zip(problem.windows.split(white), problem.windows.split(fit.weights), strict=True)
    states, errors = (2 * problem.layout.num_joints, 6), {}
    for name, (residuals, weights), known in zip(
        ("joint_angles", "ball_position"), parts, states, strict=True
    ):
        used = np.sum(weights > 0.0, axis=(1, 2))
        free = float(np.sum(np.maximum(used - known, 0)))
        if free > 0.0:
            errors[name] = float(np.sqrt(np.sum(residuals**2) / free))
    return errors
