"""A hidden robot on C is identified, and each part of the fit agrees with another computation."""

import html
import re
import runpy
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import minimize
from scipy.stats import norm

from bounce_mjx.commands.main import main
from bounce_mjx.deploy.recorder import Recorder
from bounce_mjx.errors import UserError
from bounce_mjx.identify.arm import Given, _exact_follower, _late_servos, _own_servos
from bounce_mjx.identify.ball import check_frame, touch_height
from bounce_mjx.identify.estimates import estimates, total_delay
from bounce_mjx.identify.fit import (
    Fit,
    Noise,
    Problem,
    _bounded_step,
    angle_weights,
    correlation_times,
    differentiate,
    eliminate,
    minimise,
    minimise_each,
    picture_weights,
)
from bounce_mjx.identify.flight import acceleration, fit_flight
from bounce_mjx.identify.following import (
    command_delay,
    does_move,
    find_settled,
    follow,
    set_points,
    shows_set_points,
)
from bounce_mjx.identify.hypotheses import (
    COMMAND,
    DELAY,
    FOLLOWER,
    SERVOS,
    STILL,
    Choice,
    choose,
    expect_command,
    expect_delay,
    expect_follower,
    judge,
)
from bounce_mjx.identify.identification import Identified, _correct, _Finer, identify
from bounce_mjx.identify.inspection import examine
from bounce_mjx.identify.intervals import Certainty, certainty, resample
from bounce_mjx.identify.log import Log, find_gaps, join, straighten
from bounce_mjx.identify.reading import read_csv
from bounce_mjx.identify.response import measure_response
from bounce_mjx.identify.sentences import describe_doubts, sentences
from bounce_mjx.identify.servos import servos_of
from bounce_mjx.identify.simulation import (
    Simulated,
    _paddle_speeds,
    compensated,
    make_simulator,
    make_targets,
    window_targets,
)
from bounce_mjx.identify.unknowns import MOTIONS, Layout
from bounce_mjx.identify.windows import Windows, _joint_start, cut, cut_enough, is_seen
from bounce_mjx.identify.world_file import compare, to_yaml
from bounce_mjx.physics import (
    Control,
    PhysicsParameters,
    PhysicsState,
    edited_model,
    make_engine,
)
from bounce_mjx.reports.identification import identification_page, inspection_page
from bounce_mjx.robot.model import find_addresses, link_bodies
from bounce_mjx.runs.layers import read_preset
from bounce_mjx.world.actuation import Actuators
from bounce_mjx.world.model import world_model
from bounce_mjx.world.named import read_world

BENCHMARK = Path(__file__).parent.parent / "benchmarks" / "identify.py"
NAMES = tuple(f"Joint{i}" for i in range(1, 7))


def test_elimination_gives_the_step_of_the_whole_problem() -> None:
    """Against one dense least-squares problem of all unknowns and all starts."""
    random = np.random.default_rng(0)
    windows, rows, unknowns, states = 4, 30, 5, 3
    r, at_guess = random.normal(size=(windows, rows)), random.normal(size=(windows, states))
    a, b = (random.normal(size=(windows, rows, k)) for k in (unknowns, states))
    reduced = eliminate(r, a, b, at_guess)
    prior = random.normal(size=unknowns)
    information = np.sum(reduced.informations, axis=0)
    gradient = np.sum(reduced.gradients, axis=0)
    step = -np.linalg.solve(information + np.eye(unknowns), gradient + prior)
    size = unknowns + windows * states
    matrix, right = [np.eye(unknowns, size)], [prior]
    for s in range(windows):
        place = slice(unknowns + s * states, unknowns + (s + 1) * states)
        block = np.zeros((rows + states, size))
        block[:rows, :unknowns], block[:rows, place] = a[s], b[s]
        block[rows:, place] = np.eye(states)
        matrix.append(block)
        right.append(np.concatenate([r[s], at_guess[s]]))
    dense = -np.linalg.lstsq(np.concatenate(matrix), np.concatenate(right), rcond=None)[0]
    np.testing.assert_allclose(step, dense[:unknowns], atol=1e-9)
    np.testing.assert_allclose(reduced.states(step).ravel(), dense[unknowns:], atol=1e-9)
    whole = np.concatenate(matrix[1:]).T @ np.concatenate(matrix[1:]) + np.eye(size) * 1e-12
    covariance = np.linalg.inv(whole)[:unknowns, :unknowns]
    np.testing.assert_allclose(np.linalg.inv(information), covariance, rtol=1e-6)


def flight_log(seconds: float = 6.0, gap: tuple[float, float] = (3.0, 3.5)) -> Log:
    """A ball that bounces every 0.6 s, without pictures in a gap, and an arm that sways."""
    times = np.arange(0.0, seconds, 0.01)
    sway = 0.1 * np.sin(2.0 * times[:, None] + np.arange(6))
    pictures = np.arange(0.0, seconds, 1.0 / 120.0)
    pictures = pictures[(pictures < gap[0]) | (pictures > gap[1])]
    since = (pictures % 0.6) - 0.3
    height = 0.1 + 0.5 * 9.81 * (0.3**2 - since**2)
    balls = np.stack([0.6 + 0.0 * height, 0.0 * height, height], axis=1)
    return Log("here", times, sway, times, sway, pictures, balls, pictures)


def windows_of(log: Log) -> Windows:
    return cut(log, 0.001)


def part_of(log: Log, arm: tuple[float, float], targets: tuple[float, float]) -> Log:
    """The log with the joint angles and the servo targets of some times (s) alone."""
    measured = (log.times >= arm[0]) & (log.times <= arm[1])
    sent = (log.target_times >= targets[0]) & (log.target_times <= targets[1])
    return log._replace(
        times=log.times[measured],
        joint_angles=log.joint_angles[measured],
        target_times=log.target_times[sent],
        servo_targets=log.servo_targets[sent],
    )


@pytest.mark.parametrize(
    "arm, targets", [((2.0, 5.0), (2.0, 5.0)), ((0.0, 5.0), (2.0, 7.0)), ((2.0, 7.0), (0.0, 5.0))]
)
def test_windows_are_of_times_at_which_the_arms_motion_is_known(arm, targets) -> None:
    """Not of a bounce before or after the arm's rows, nor where targets begin late or end early."""
    log = part_of(flight_log(8.0, gap=(9.0, 9.0)), arm, targets)
    w = windows_of(log)
    bounces = (w.zero + w.bounces)[w.has_ball]
    assert len(bounces) == 5 and np.all((bounces > 2.3) & (bounces < 5.0))
    times = (w.zero[:, None] + w.angle_times)[w.angle_weights > 0.0]
    assert np.min(times) > 2.295 and np.max(times) < 5.005
    # No picture was taken before the simulation of its window begins.
    assert np.min(w.picture_times[w.picture_weights > 0.0]) > 0.079


def test_what_follows_a_gap_of_the_targets_counts_once_the_arm_has_settled() -> None:
    log = flight_log(8.0, gap=(9.0, 9.0))
    sent = (log.target_times < 3.0) | (log.target_times > 4.0)
    log = log._replace(target_times=log.target_times[sent], servo_targets=log.servo_targets[sent])
    unknown = (log.times > 2.995) & (log.times < 4.305)
    np.testing.assert_array_equal(find_settled(log), ~unknown & (log.times > 0.295))
    w = windows_of(log)
    times = (w.zero[:, None] + w.angle_times)[w.angle_weights > 0.0]
    assert not np.any((times > 2.995) & (times < 4.305))
    bounces = (w.zero + w.bounces)[w.has_ball]
    assert not np.any((bounces > 2.995) & (bounces < 4.305))


def test_a_window_that_begins_in_a_gap_begins_with_the_nearest_angles() -> None:
    """A parabola through eight milliseconds of noisy angles says nothing of those 0.3 s before."""
    random, times = np.random.default_rng(0), np.arange(0.0, 4.0, 0.001)
    angles = 0.5 + 0.1 * times[:, None] + 1e-3 * random.normal(size=(len(times), 6))
    measured = (times < 1.0) | (times >= 2.0)
    log = flight_log()._replace(times=times[measured], joint_angles=angles[measured])
    for begin, angle in ((1.3, 0.6), (1.7, 0.7), (-0.3, 0.5)):
        start = _joint_start(log, begin)
        np.testing.assert_allclose(start[:6], angle, atol=4e-3)
        assert not np.any(start[6:])
    start = _joint_start(log, 3.0)
    np.testing.assert_allclose(start[:6], 0.8, atol=2e-3)
    assert np.all(start[6:] != 0.0)


def test_no_window_spans_two_logs() -> None:
    """Of which the first has pictures beyond the arm's rows, and the second before them."""
    whole = flight_log(8.0, gap=(9.0, 9.0))
    logs = part_of(whole, (0.0, 4.0), (0.0, 4.0)), part_of(whole, (5.0, 8.0), (4.0, 8.0))
    joined = join(logs)
    assert np.all(np.diff(joined.picture_times) > 0.0)
    w = windows_of(joined)
    # The first log ends at 4 s, and the second begins 1.5 s later.
    ends = w.zero + np.max(w.angle_times * w.angle_weights, axis=1)
    begins = w.zero + np.min(np.where(w.angle_weights > 0.0, w.angle_times, np.inf), axis=1)
    assert np.all((ends < 4.01) | (begins > 6.795))
    shown = w.zero[:, None] + w.picture_times
    shown = np.where(w.picture_weights > 0.0, shown, np.nan)[w.has_ball]
    is_early = np.nanmin(shown, axis=1) < 4.5
    assert 0 < np.sum(is_early) < len(shown)
    assert np.all(np.nanmax(shown[is_early], axis=1) < 4.51)


def test_stamps_that_jitter_are_straightened_in_their_order() -> None:
    """Also where a long step parts two short stretches, whose lines would overlap."""
    steps = np.concatenate([np.full(200, 1e-3), [1.7e-3], np.full(39, 0.96e-3)])
    steps = np.concatenate([steps, [1.51e-3], np.full(39, 0.96e-3)])
    times = np.cumsum(steps)
    straight = straighten(times)
    assert np.all(np.diff(straight) >= 0.0)
    assert 5e-4 < np.max(np.abs(straight - times)) < 1e-3


def test_logs_of_the_longest_steps_are_joined_with_a_gap() -> None:
    """A step of the stamps of 0.2 s is allowed, and no gap."""
    log = flight_log()
    times = 0.2 * np.arange(len(log.times))
    slow = log._replace(times=times, target_times=times)
    joined = join([slow, slow])
    for times in (joined.times, joined.target_times):
        assert len(find_gaps(times)) == 1


def test_a_stretch_of_lost_rows_of_an_even_log_is_a_gap() -> None:
    """In 50 ms an arm moves by targets that the log lacks, and a fit would take the last one; up to
    four lost rows are filled (test_logs.py), however many of them a log has."""
    random = np.random.default_rng(0)
    times = 0.01 * np.arange(400.0)
    rows = np.r_[:200, 205:400]
    few = np.sort(random.permutation(400)[:280])
    for noise in (0.0, 3e-4):
        stamps = times[rows] + random.uniform(-noise, noise, len(rows))
        assert find_gaps(stamps) == [(stamps[199], stamps[200])]
        stamps = times[few] + random.uniform(-noise, noise, len(few))
        assert len(find_gaps(stamps)) == np.sum(np.diff(few) > 5) < 3
    # Of stamps that wait for a busy computer, a long step is no lost row.
    waits = np.sort(times + random.choice([0.0, 0.008], len(times)))
    assert find_gaps(waits) == []


@pytest.mark.parametrize("latency, lag", [(0.0237, 0.0), (0.0082, 0.015)])
def test_targets_are_late_and_lagged(latency: float, lag: float) -> None:
    """Against a simulation with steps a hundred times as short."""
    random = np.random.default_rng(1)
    log = flight_log()
    log = log._replace(servo_targets=random.normal(size=log.servo_targets.shape))
    found = make_targets(log, 0.001 * np.arange(501))(latency, lag)
    fine = np.arange(0.0, 0.5, 1e-5) + 0.5e-5
    index = np.searchsorted(log.target_times, fine - latency, side="right") - 1
    late = log.servo_targets[np.maximum(index, 0)]
    means = late.reshape(-1, 100, 6).mean(axis=1)
    expected, state = [], log.servo_targets[0]
    for mean in means:
        state = mean if lag == 0.0 else mean + (state - mean) * np.exp(-0.001 / lag)
        expected.append(state)
    np.testing.assert_allclose(found[: len(expected)], expected, atol=2e-3)


def test_a_log_of_hours_has_the_targets_of_its_windows_alone() -> None:
    """The same as if all of its steps were computed."""
    random = np.random.default_rng(1)
    log = flight_log(60.0)
    log = log._replace(servo_targets=random.normal(size=log.servo_targets.shape))
    first = np.array([31_000, 300, 900, 55_000])
    w = windows_of(log)._replace(first=first, steps=860, origin=0.0)
    send, rows = window_targets(log, w)
    for latency, lag in ((0.02, 0.0), (0.02, 0.2)):
        some = send(latency, lag)
        assert len(some) == 1760 + 2 * 2860
        every = make_targets(log, 0.001 * np.arange(56_001))(latency, lag)
        for begin, row in zip(first, rows, strict=True):
            of_window = slice(row, row + 860)
            np.testing.assert_allclose(some[of_window], every[begin : begin + 860], atol=2e-4)


def measured_rows(w: Windows, angles: np.ndarray) -> np.ndarray:
    """Rows of candidates with these angles [C, S, A, n] and the measured balls."""
    balls = np.broadcast_to(w.balls, (len(angles), *w.balls.shape))
    parts = [x.reshape(*x.shape[:2], -1) for x in (angles, balls)]
    return np.concatenate(parts, axis=2)


def linear_problem(log: Log, random: np.random.Generator) -> Problem:
    """Windows in which the angles follow the start, and by random shapes two unknowns: that of
    delay in all joints, and of servo_gain each in its own."""
    w, layout = windows_of(log), Layout(6, True, 0.001)
    places, shape = layout.slices, w.angles.shape
    late, gain = random.normal(size=(2, *shape))
    ramp = w.angle_times[:, :, None]

    def simulate(vectors: np.ndarray, starts: np.ndarray, used: np.ndarray) -> np.ndarray:
        by_late = 0.1 * vectors[:, places["delay"]][:, :, None, None] * late * ramp
        by_gain = 1e-2 * vectors[:, None, None, places["servo_gain"]] * gain * ramp
        return measured_rows(w, starts[:, :, None, :6] + by_late + by_gain)

    noise = Noise(np.full(6, 1e-3), np.full(3, 2e-3))
    return Problem(simulate, w, layout, sensors=noise, noise=noise)


@pytest.mark.slow
def test_intervals_know_that_residuals_of_a_window_are_correlated() -> None:
    """The deviations are those of estimates from many draws of the noise, half of which is a common
    error of each window along the derivatives."""
    random = np.random.default_rng(3)
    problem = linear_problem(flight_log(20.0), random)
    layout, w = problem.layout, problem.windows
    truth, weights = layout.mean, problem.weights(pictures=0.0)
    place = layout.slices["delay"].start
    late = truth + 0.02 * (np.arange(len(truth)) == place)
    clean, moved = (w.split(problem.predict(x, w.starts))[0] for x in (truth, late))
    along = moved - clean
    estimates, deviations, independent = [], [], []
    for _ in range(20):
        common = random.normal(size=(len(w.first), 1, 1))
        noisy = clean + 1e-3 * random.normal(size=clean.shape) + common * along
        one = problem._replace(windows=w._replace(angles=noisy))
        fit = minimise(one, Fit(truth, w.starts), ["arm"], weights, 4)
        known = certainty(one, fit, layout.free(["arm"]))
        estimates.append(fit.vector[place])
        deviations.append(known.deviation[place])
        by_noise = np.linalg.inv(known.information + np.diag(layout.deviation**-2.0))
        independent.append(np.sqrt(by_noise[place, place]))
    assert np.std(estimates) > 1.5 * np.mean(independent)
    np.testing.assert_allclose(np.mean(deviations), np.std(estimates), rtol=0.35)


def identified(layout: Layout, log: Log, vector: np.ndarray, covariance: np.ndarray) -> Identified:
    """An identified robot with these unknowns, whose windows say nothing more."""
    windows, noise = windows_of(log), Noise(np.full(6, 1e-3), np.full(3, 2e-3))
    predicted = np.zeros((len(windows.angles), windows.angles[0].size + windows.balls[0].size))
    errors = {"joint_angles": 1.0, "ball_position": 1.0}
    # Changes of exactly this covariance, with the quantiles of normal ones.
    quantiles = norm.ppf((np.arange(2000) + 0.5) / 2000)
    random = np.random.default_rng(0)
    normal = np.stack([random.permutation(quantiles) for _ in vector], axis=1)
    normal = normal @ np.linalg.inv(np.linalg.cholesky(np.cov(normal.T, ddof=0))).T
    root = np.linalg.cholesky(covariance + 1e-15 * np.eye(len(vector)))
    precision = np.linalg.inv(covariance) - np.diag(layout.deviation**-2.0)
    return Identified(
        layout=layout,
        windows=windows,
        noise=noise,
        fit=Fit(vector, np.zeros(0), predicted),
        certainty=Certainty(precision, normal @ root.T),
        before=errors,
        after=errors,
        held_out=errors,
        dropped=0,
        choice=Choice((), SERVOS, (), None),
        counted=noise,
        joint_errors=np.full(6, 1e-3),
    )


def test_a_world_has_the_range_of_each_joint_and_axis(tmp_path: Path) -> None:
    """And a log is compared with that of each, not with the range of all."""
    log, layout, path = flight_log(), Layout(6, True, 0.001), tmp_path / "world.yaml"
    vector, places = layout.mean.copy(), layout.slices
    gains = 0.8 + 0.07 * np.arange(6)
    vector[places["servo_gain"]] = np.log(gains)
    vector[places["paddle_tilt"]] = -0.08, 0.04
    found = identified(layout, log, vector, np.diag((0.1 * layout.deviation) ** 2))
    path.write_text(to_yaml(found, log, NAMES, None), encoding="utf-8")
    config = read_preset(Path("default"), world=path).env
    assert np.shape(config.randomization.restitution) == (2,)
    low, high = np.array(config.randomization.paddle_tilt)
    np.testing.assert_allclose(0.5 * (low + high), vector[places["paddle_tilt"]], rtol=2e-3)
    width = 2.0 * 1.5 * 1.96 * 0.1 * layout.deviation[places["paddle_tilt"]]
    np.testing.assert_allclose(high - low, width, rtol=2e-2)
    # The interval of a factor is one of its logarithm.
    low, high = np.array(config.randomization.servo_gain)
    half = 1.96 * 0.1 * layout.deviation[places["servo_gain"]]
    np.testing.assert_allclose(high, gains * (1.0 + 1.5 * np.expm1(half)), rtol=2e-3)
    np.testing.assert_allclose(low, gains * (1.0 + 1.5 * np.expm1(-half)), rtol=2e-3)
    assert compare(read_world(path), found, NAMES) == []
    # The latency of the ball is that until its arrival, in what is printed and in the file.
    late = found._replace(stamp_age=0.012)
    path.write_text(to_yaml(late, log, NAMES, None), encoding="utf-8")
    (printed,) = (e.value for e in estimates(late, NAMES) if e.label == "ball_latency")
    assert printed == pytest.approx(vector[places["ball_latency"]][0] + 0.012)
    range_ = read_world(path).settings["randomization"]["ball_latency"]
    assert np.mean(range_) == pytest.approx(printed, rel=2e-3)
    assert compare(read_world(path), late, NAMES) == []
    other = vector.copy()
    other[places["paddle_tilt"]] = 0.04, -0.08
    moved = late._replace(fit=found.fit._replace(vector=other))
    changed = compare(read_world(path), moved, NAMES)
    assert [line.split(" is ")[0] for line in changed] == ["paddle_tilt x", "paddle_tilt y"]


def test_a_world_contradicts_no_log_that_does_not_tell_terms_apart(tmp_path: Path) -> None:
    """Where a log shows the sum of latency and lag alone, the sums of a world are those of the log;
    and a term that it does not show is within one deviation of its prior."""
    log, layout, path = flight_log(), Layout(6, True, 0.001), tmp_path / "world.yaml"
    places = layout.slices
    vector = layout.vector({"action_latency": 0.02, "servo_lag": 0.005})
    shown = 0.1 * layout.deviation
    shown[places["gravity_tilt"]] = layout.deviation[places["gravity_tilt"]]
    covariance = np.diag(shown**2)
    # A lag of 0 to 15 ms, and a sum that is known to 0.1 ms.
    delay, variance = places["delay"].start, places["delay_variance"].start
    slope = 1.0 / (2.0 * 0.005)
    covariance[variance, variance] = layout.deviation[variance] ** 2
    covariance[delay, variance] = covariance[variance, delay] = (
        slope * covariance[variance, variance]
    )
    covariance[delay, delay] = 1e-4**2 + slope**2 * covariance[variance, variance]
    found = identified(layout, log, vector, covariance)
    path.write_text(to_yaml(found, log, NAMES, None), encoding="utf-8")
    ranges = read_world(path).settings["randomization"]
    sums = np.add(ranges["action_latency"], ranges["servo_lag"])
    np.testing.assert_allclose(sums, [0.025, 0.025], atol=2 * 1.5 * 1.96 * 1e-4 + 1e-5)
    assert sums[0] < 0.025 < sums[1]
    deviation = layout.deviation[places["gravity_tilt"]]
    np.testing.assert_allclose(ranges["gravity_tilt"], [-deviation, deviation])


def at_home(shift: tuple[float, float, float]) -> Log:
    """An arm at rest, on whose paddle the ball bounces; the ball's frame is off by a shift [3]."""
    log, config = flight_log(), read_preset(Path("default")).env
    angles = np.tile(config.default_joint_angles, (len(log.times), 1))
    # The paddle's top and the ball's radius.
    place = np.array(config.ball_init_pos) * [1.0, 1.0, 0.0] + [0.0, 0.0, 0.074]
    height = log.ball_positions[:, 2:] - np.min(log.ball_positions[:, 2])
    balls = place + shift + height * [0.0, 0.0, 1.0]
    return log._replace(joint_angles=angles, servo_targets=angles, ball_positions=balls)


@pytest.mark.parametrize("shift", [(0.02, 0.0, 0.3), (0.4, -0.6, -0.02), (0.0, 0.0, -0.07)])
def test_a_ball_beside_the_paddle_is_refused(shift) -> None:
    """And none whose height a camera, a paddle and encoders of the prior explain."""
    config = read_preset(Path("default")).env
    for height in (-0.035, 0.0, 0.035):
        check_frame(windows_of(at_home((0.02, -0.02, height))), config, "here")
    with pytest.raises(UserError, match="in the frame of the robot's base") as refused:
        check_frame(windows_of(at_home(shift)), config, "here")
    found = re.search(r"bounces (.+) m \(x, y, z\)", str(refused.value))[1]
    np.testing.assert_allclose(list(map(float, found.split(", "))), shift, atol=0.015)


@pytest.mark.slow
def test_a_real_ball_leaves_the_paddle_at_once() -> None:
    """Along the parabola that begins where and when it touches the paddle, with its restitution;
    the model's ball is on the paddle for 10 ms more."""
    config, layout = read_preset(Path("default")).env, Layout(6, True, 0.001)
    log, gravity, restitution = at_home((0.0, 0.0, 0.0)), 9.81, 0.9
    windows = windows_of(log)
    model = world_model(config, visual=False)
    addresses, data = find_addresses(model), mujoco.MjData(model)
    data.qpos[list(addresses.arm_qpos)] = config.default_joint_angles
    mujoco.mj_kinematics(model, data)
    paddle, ball = addresses.paddle_geom, addresses.balls[0].geom
    top = data.geom_xpos[paddle][2] + model.geom_size[paddle, 2] + model.geom_size[ball, 0]
    s = int(np.flatnonzero(windows.has_ball)[1])
    # The mean is over where in a physics step the ball touches the paddle.
    falls, speed = windows.bounces[s] + 1e-3 * np.arange(8) / 8, 2.5
    starts = np.repeat(windows.starts[None], len(falls), axis=0)
    starts[:, s, 12:] = 0.0
    starts[:, s, 12:14] = data.geom_xpos[paddle][:2]
    starts[:, s, 14] = top + speed * falls - gravity * falls**2 / 2
    starts[:, s, 17] = gravity * falls - speed
    world = {"restitution": restitution, "air_drag": 0.0, "ball_latency": 0.0}
    vector = layout.vector(world | {"action_latency": 0.0, "servo_lag": 0.0})
    vectors = np.repeat(vector[None], len(falls), axis=0)
    used = np.tile(np.arange(len(windows.first)) == s, (len(falls), 1))
    since = windows.picture_times[s] - falls[:, None]
    counts = (since[-1] > 0.02) & (windows.picture_weights[s] > 0.0)
    expected = top + restitution * speed * since - gravity * since**2 / 2
    off = []
    for at_once in (True, False):
        simulate = make_simulator(
            config, layout, log, windows, Simulated(1.0, leaves_at_once=at_once)
        )
        heights = windows.split(simulate(vectors, starts, used))[1][:, s, :, 2]
        off.append(np.max(np.abs(np.mean(heights - expected, axis=0))[counts]))
    assert off[0] < 3e-3 and off[1] > 15e-3


def test_the_speed_of_the_paddle_is_that_of_its_joints() -> None:
    """Against MuJoCo's Jacobian."""
    config = read_preset(Path("default")).env
    log, rates = at_home((0.0, 0.0, 0.0)), np.array([0.1, 0.2, -0.3, 0.1, 0.4, 0.2])
    windows = windows_of(log._replace(joint_angles=log.joint_angles + np.outer(log.times, rates)))
    model = world_model(config, visual=False)
    addresses, data = find_addresses(model), mujoco.MjData(model)
    s = int(np.flatnonzero(windows.has_ball)[0])
    moved = (windows.zero[s] + windows.bounces[s]) * rates
    data.qpos[list(addresses.arm_qpos)] = np.array(config.default_joint_angles) + moved
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jacGeom(model, data, jacobian, None, addresses.paddle_geom)
    expected = jacobian[2, list(addresses.arm_qvel)] @ rates
    assert abs(expected) > 0.05
    assert _paddle_speeds(config, windows)[s] == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("dt", [0.001, 0.0005])
def test_the_delay_and_variance_of_a_lag_are_those_of_its_steps(dt: float) -> None:
    """Of the answer to a step of the command, in steps of a training and of half the length."""
    layout, log = Layout(6, False, dt), flight_log()
    lag, edges = 0.008, dt * np.arange(round(0.5 / dt) + 1)
    targets = np.repeat((log.target_times >= 0.1)[:, None], 6, axis=1).astype(float)
    answer = make_targets(log._replace(servo_targets=targets), edges)(0.0, lag)[:, 0]
    weights, times = np.diff(answer, prepend=0.0), edges[:-1] - 0.1
    mean = weights @ times
    vector, places = layout.vector({"action_latency": 0.0, "servo_lag": lag}), layout.slices
    assert vector[places["delay"]][0] == pytest.approx(mean, abs=1e-6)
    variance = weights @ (times - mean) ** 2
    assert vector[places["delay_variance"]][0] == pytest.approx(variance, rel=1e-3)


def unseen() -> Identified:
    """A log that shows nothing: all deviations are those of the prior."""
    layout = Layout(6, False, 0.001)
    return identified(layout, flight_log(), layout.mean, np.diag(layout.deviation**2))


def ball_shown() -> Identified:
    """A log that shows all unknowns, at their prior means."""
    layout = Layout(6, True, 0.001)
    return identified(layout, flight_log(), layout.mean, np.diag((0.1 * layout.deviation) ** 2))


@pytest.mark.slow
def test_the_page_begins_with_the_answer() -> None:
    """What the log leaves open comes after it, and the log itself last."""
    found, log = unseen(), flight_log()
    checkups = examine([log], NAMES)
    world = Path("my world.yaml")
    page = identification_page(found, [log], checkups, NAMES, world, ["A doubt."], None)
    parts = "<b>Found:", "<b>How sure:", "<b>What to do:", "<h2>Estimates", "<h2>What the log"
    assert sorted(parts, key=page.index) == [*parts]
    assert "do not train with this world: A doubt." in page
    inspected = inspection_page([log._replace(source="a&b.csv")], checkups)
    assert "<title>bounce_mjx: logs a&amp;b.csv</title>" in inspected
    assert "<h1>a&amp;b.csv</h1>" in inspected
    better = html.unescape(identification_page(found, [log], checkups, NAMES, world, [], None))
    assert "bounce-mjx identify LOG --check 'my world.yaml'" in better
    assert "--warm-start robust_small --config finetune --world 'my world.yaml'" in better
    # Another arm has no policy to begin from, and its logs are read with its own robot.
    other = html.unescape(identification_page(found, [log], checkups, NAMES, world, [], "ur5e"))
    assert "--warm-start" not in other
    assert "bounce-mjx train --config robust_cpu --world 'my world.yaml'" in other
    assert "bounce-mjx identify LOG --robot ur5e --check 'my world.yaml'" in other
    assert all(entry.label in page for entry in estimates(found, NAMES))


def test_each_unknown_has_a_motion_that_would_show_it() -> None:
    shown = {name for names in MOTIONS.values() for name in names.split()}
    assert shown >= Layout(6, True, 0.001, camera_rotation=0.01).terms.keys()


def test_what_is_not_shown_is_as_well_known_as_before() -> None:
    """The intervals of what no window shows, or no search varied, are the prior's; also where the
    windows' gradients say more than their information."""
    random = np.random.default_rng(0)
    windows, size = 40, 5
    gradients = 20.0 * random.normal(size=(windows, size))
    none = np.zeros((windows, size, size))
    estimated = np.ones(size, bool)
    for is_estimated in (estimated, ~estimated):
        changes = resample(none, gradients, is_estimated, np.random.default_rng(1))
        np.testing.assert_allclose(np.std(changes, axis=0), 1.0, rtol=1e-6)
    shown = resample(none, 0.0 * gradients, estimated, np.random.default_rng(1))
    np.testing.assert_allclose(np.std(shown, axis=0), 1.0, rtol=0.15)
    # In the page, an unknown is not shown at that width.
    assert not any(entry.seen for entry in estimates(unseen(), NAMES))
    assert all(entry.seen for entry in estimates(ball_shown(), NAMES))


def test_an_interval_is_the_spread_over_other_logs() -> None:
    """Of a mean of windows, each of which has an error of its own, however many rows agree within
    it; with many windows and with few."""
    random = np.random.default_rng(0)
    for windows, least in ((8, 0.8), (200, 0.88)):
        inside = []
        spreads = []
        for trial in range(60):
            own = random.normal(size=windows)
            # Each window says 100 times, exactly, what its own mean is.
            estimate = np.mean(own)
            informations = np.full((windows, 1, 1), 100.0)
            gradients = 100.0 * (estimate - own)[:, None]
            generator = np.random.default_rng(trial)
            changes = resample(informations, gradients, np.ones(1, bool), generator)
            low, high = estimate + np.percentile(changes[:, 0], [2.5, 97.5])
            inside.append(low <= 0.0 <= high)
            spreads.append(np.std(changes) * np.sqrt(windows))
        assert np.mean(inside) >= least
        assert np.mean(spreads) == pytest.approx(1.0, abs=0.1)


def test_a_model_that_does_not_explain_a_log_is_named() -> None:
    """A joint's error counts beyond its encoder's noise, and beyond a share of its motion."""
    found = unseen()
    assert describe_doubts(found, NAMES) == []
    errors = np.array([1e-3, 1e-3, 0.02, 1e-3, 1e-3, 1e-3])
    (doubt,) = describe_doubts(found._replace(joint_errors=errors), NAMES)
    assert "does not explain the angles of Joint3" in doubt and "20 mrad" in doubt
    bounces = int(np.sum(found.windows.has_ball))
    (doubt,) = describe_doubts(found._replace(dropped=bounces - 1), NAMES)
    assert doubt.startswith(f"In {bounces - 1} of {bounces} windows")


@pytest.mark.parametrize("sensor", ["joint_angles", "ball_position"])
def test_an_error_that_is_no_number_explains_nothing(sensor: str) -> None:
    found = ball_shown()
    assert describe_doubts(found, NAMES) == []
    errors = found.joint_errors * (1.0 if sensor == "ball_position" else np.nan)
    diverged = found._replace(held_out=found.held_out | {sensor: np.nan}, joint_errors=errors)
    assert "does not explain the" in describe_doubts(diverged, NAMES)[0]


def test_searches_that_are_simulated_together_end_where_each_ends_alone() -> None:
    """With derivatives of their own, or with ones that were taken elsewhere."""
    log = flight_log(20.0)
    problem = linear_problem(log, np.random.default_rng(3))
    late = np.zeros(len(problem.layout.mean))
    late[problem.layout.slices["delay"]] = 0.1
    moved = problem.predict(problem.layout.mean + 0.5 * late, problem.windows.starts)
    angles = problem.windows.split(moved)[0]
    problem = problem._replace(windows=problem.windows._replace(angles=angles))
    weights = problem.weights(pictures=0.0)
    some = weights * (np.arange(len(weights)) % 3 > 0)[:, None]
    starts = problem.windows.starts
    begins = [Fit(problem.layout.mean + share * late, starts) for share in (0.0, 1.0, -2.0)]
    for used in (weights, some):
        alone = [minimise(problem, begin, ["arm"], used, 2) for begin in begins]
        together = minimise_each(problem, begins, ["arm"], used, 2)
        slopes = differentiate(problem, begins[1], ["arm"], weights)
        elsewhere = minimise_each(problem, begins, ["arm"], used, 2, None, [slopes] * 3)
        for one, other, third in zip(alone, together, elsewhere, strict=True):
            np.testing.assert_array_equal(one.vector, other.vector)
            assert third.cost == pytest.approx(one.cost, rel=1e-6)
    counted = []

    def count(vectors: np.ndarray, states: np.ndarray, used: np.ndarray) -> np.ndarray:
        counted.append(len(vectors))
        return problem.simulate(vectors, states, used)

    # Derivatives cost many simulations: of a linear problem, they are taken once.
    minimise(problem._replace(simulate=count), begins[1], ["arm"], weights, 8)
    assert sum(size > 1 for size in counted) == 1


def test_a_search_in_coarse_steps_ends_where_one_in_finer_steps_does() -> None:
    """What the steps change is taken away, and where it depends on the unknowns, once more."""
    problem = linear_problem(flight_log(20.0), np.random.default_rng(3))
    place = problem.layout.slices["delay"].start
    weights = problem.weights(pictures=0.0)
    truth = problem.layout.mean.copy()
    truth[place] += 0.02

    def simulate_finer(vectors: np.ndarray, states: np.ndarray, used: np.ndarray) -> np.ndarray:
        # 0.005 s later, and by a tenth more sensitive.
        moved = vectors.copy()
        moved[:, place] = 1.1 * moved[:, place] + 0.005
        return problem.simulate(moved, states, used)

    every = np.ones((1, len(weights)), bool)
    measured = simulate_finer(truth[None], problem.windows.starts[None], every)[0]
    angles = problem.windows.split(measured)[0]
    problem = problem._replace(windows=problem.windows._replace(angles=angles))
    finer = _Finer(simulate_finer, problem.layout)
    fit = minimise(problem, Fit(problem.layout.mean, problem.windows.starts), ["arm"], weights, 4)
    errors = [abs(fit.vector[place] - truth[place])]
    for _ in range(2):
        corrected = _correct(problem, fit, finer)
        fit = minimise(corrected, fit, ["arm"], weights, 4)
        errors.append(abs(fit.vector[place] - truth[place]))
    assert errors[0] > 5e-3 and errors[1] < 0.2 * errors[0] and errors[2] < 0.2 * errors[1]


def test_a_fit_whose_simulation_diverges_has_an_infinite_cost() -> None:
    problem = linear_problem(flight_log(), np.random.default_rng(0))
    start = Fit(problem.layout.mean, problem.windows.starts)
    assert minimise(problem, start, ["arm"], problem.weights(0.0), 2).cost < np.inf

    def diverge(vectors: np.ndarray, starts: np.ndarray, used: np.ndarray) -> np.ndarray:
        return problem.simulate(vectors, starts, used) * np.nan

    broken = problem._replace(simulate=diverge)
    assert minimise(broken, start, ["arm"], problem.weights(0.0), 2).cost == np.inf
    predicted = broken.predict(start.vector, start.starts)
    assert not np.any(angle_weights(broken, predicted))
    assert not np.any(picture_weights(broken, predicted))

    def diverge_elsewhere(vectors: np.ndarray, starts: np.ndarray, used: np.ndarray) -> np.ndarray:
        moved = np.any(vectors != start.vector, axis=1)[:, None, None]
        return np.where(moved, np.nan, problem.simulate(vectors, starts, used))

    broken = problem._replace(simulate=diverge_elsewhere)
    fit = minimise(broken, start, ["arm"], problem.weights(0.0), 2)
    assert fit.cost < np.inf and np.array_equal(fit.vector, start.vector)


def test_a_ball_that_no_window_checks_is_said() -> None:
    found = ball_shown()
    assert not any("nothing checks" in line for line in sentences(found, NAMES))
    unchecked = found._replace(held_out={"joint_angles": 1.0})
    assert any("nothing checks" in line for line in sentences(unchecked, NAMES))


def test_pictures_of_fewer_than_three_bounces_change_nothing() -> None:
    """As the world then has no terms of a ball, which the arm would make good for."""
    log = flight_log(8.0, gap=(9.0, 9.0))
    every = cut_enough(log, 0.001)
    assert np.sum(every.has_ball) > 3
    second, third = np.sort((every.zero + every.bounces)[every.has_ball])[1:3]
    for last, count in ((second, 0), (third, 3)):
        shown = log.picture_times < last + 0.25
        few = log._replace(
            picture_times=log.picture_times[shown],
            ball_positions=log.ball_positions[shown],
            arrivals=log.arrivals[shown],
        )
        windows = cut_enough(few, 0.001)
        assert np.sum(windows.has_ball) == count
        assert np.any(windows.picture_weights) == (count > 0)
        assert np.all(windows.starts[~windows.has_ball, 14] == 50.0)


@pytest.mark.parametrize("shift", [-0.024, 0.005, 0.024])
def test_a_height_that_does_not_fit_the_bounces_is_named(shift: float) -> None:
    """Whichever terms share it, of which none is beyond its prior; 5 mm are a usual camera's."""
    config, layout = read_preset(Path("default")).env, Layout(6, True, 0.001)
    windows = windows_of(at_home((0.0, 0.0, shift)))
    of_camera = {"ball_position_bias": np.array([0.0, 0.0, shift])}
    # The paddle's offset is in the frame of its body.
    model = world_model(config, visual=False)
    addresses, data = find_addresses(model), mujoco.MjData(model)
    data.qpos[list(addresses.arm_qpos)] = config.default_joint_angles
    mujoco.mj_kinematics(model, data)
    frame = data.xmat[model.geom_bodyid[addresses.paddle_geom]].reshape(3, 3)
    of_paddle = {"paddle_offset": frame.T @ np.array([0.0, 0.0, shift])}
    heights = []
    for shared in (of_camera, of_paddle):
        world = layout.world(layout.vector(shared))
        heights.append(touch_height(config, windows, world))
    np.testing.assert_allclose(heights, shift, atol=1e-4)
    # A joint that is turned by an angle moves the paddle by its lever arm.
    bias = np.array([0.0, 0.01, 0.0, 0.0, 0.0, 0.0])
    lever = touch_height(config, windows, layout.world(layout.vector({"encoder_bias": bias})))
    assert lever == pytest.approx(0.01 * config.ball_init_pos[0], rel=0.05)
    said = [x for x in sentences(ball_shown()._replace(touch_height=shift), NAMES) if "mm" in x]
    assert len(said) == (abs(shift) > 0.01)
    assert all("24 mm " + ("above" if shift > 0.0 else "below") in x for x in said)


def test_the_search_sees_a_bounce_of_each_log_that_has_one() -> None:
    """Also where every fifth window, which it does not see, has all of them; and a simulation of no
    window is of the same shape as one of some."""
    windows = windows_of(at_home((0.0, 0.0, 0.0)))
    every = np.arange(len(windows.first))
    np.testing.assert_array_equal(is_seen(windows), every % 5 != 4)
    few = windows._replace(bounces=np.where(every % 5 == 4, 0.3, np.nan))
    assert np.sum(few.has_ball) > 0
    np.testing.assert_array_equal(is_seen(few), every % 5 != 3)
    config, layout = read_preset(Path("default")).env, Layout(6, True, 0.001)
    simulate = make_simulator(config, layout, at_home((0.0, 0.0, 0.0)), windows)
    none = np.zeros((1, len(every)), bool)
    simulated = simulate(layout.mean[None], windows.starts[None], none)
    assert simulated.shape == (1, *windows.measured.shape) and not np.any(simulated)


def test_a_warning_states_one_quantity_in_one_unit() -> None:
    """The vector has a delay and a variance in s^2, and no age of a picture's stamp."""
    layout = Layout(6, True, 0.001)
    vector = layout.vector({"action_latency": 0.19, "servo_lag": 0.05, "ball_latency": 0.069})
    vector[layout.slices["restitution"]] = 0.98 - 1e-12
    found = identified(layout, flight_log(), vector, np.diag((0.1 * layout.deviation) ** 2))
    said = [x for x in sentences(found._replace(stamp_age=0.01), NAMES) if x.startswith("warning")]
    numbers = [
        re.search(r"warning: (.+) is (\S+)( s)?, (\S+) deviations of the prior from (\S+)\.$", line)
        for line in said
    ]
    shown = {x[1]: (float(x[2]), float(x[5])) for x in numbers}
    # The prior's variance is 2e-4 s^2, and that of a lag its square.
    assert shown["servo_lag"] == pytest.approx((0.05, np.sqrt(2e-4)), rel=0.01)
    # The mean of a lag is shorter than it by half a step.
    assert shown["action_latency and servo_lag together"] == pytest.approx((0.2395, 0.035))
    assert "ball_latency" not in shown
    # At a limit of the search, but for a rounding.
    assert shown["restitution"] == pytest.approx((0.98, 0.85))
    late = found._replace(fit=found.fit._replace(vector=vector + 0.01), stamp_age=0.01)
    (line,) = (x for x in sentences(late, NAMES) if x.startswith("warning: ball_latency"))
    assert "is 0.089 s" in line and line.endswith("from 0.02.")


def test_a_picture_cannot_arrive_before_it_was_taken(tmp_path: Path) -> None:
    """The search allows a latency below 0, as stamps are off; a world has a range from 0 on."""
    layout = Layout(6, True, 0.001)
    path = tmp_path / "world.yaml"
    for latency, is_said in ((-0.001, False), (-0.02, True)):
        vector = layout.vector({"ball_latency": latency})
        shown = 0.1 * layout.deviation
        found = identified(layout, flight_log(), vector, np.diag(shown**2))
        (entry,) = (x for x in estimates(found, NAMES) if x.label == "ball_latency")
        assert 0.0 == entry.low == entry.value <= entry.high
        path.write_text(to_yaml(found, flight_log(), NAMES, None), encoding="utf-8")
        low, high = read_world(path).settings["randomization"]["ball_latency"]
        assert 0.0 == low <= high
        said = [x for x in sentences(found, NAMES) if "arrive" in x]
        assert len(said) == is_said and all("20.0 ms before" in x for x in said)


def test_what_no_search_varied_has_the_deviation_of_its_prior() -> None:
    """Such as the servos of a follower, and gravity's tilt without a ball."""
    problem = linear_problem(flight_log(20.0), np.random.default_rng(3))
    layout, weights = problem.layout, problem.weights(pictures=0.0)
    fit = minimise(problem, Fit(layout.mean, problem.windows.starts), ["arm"], weights, 2)
    searched = layout.free(["arm"])
    gains = layout.slices["servo_gain"]
    chosen = searched.copy()
    chosen[gains] = False
    deviations = [certainty(problem, fit, which).deviation for which in (searched, chosen)]
    assert np.median(deviations[0][gains] / layout.deviation[gains]) < 0.9
    np.testing.assert_allclose(deviations[1][gains], layout.deviation[gains])
    np.testing.assert_allclose(deviations[1][chosen], deviations[0][chosen])


def test_the_servos_of_an_arm_are_of_one_make() -> None:
    """Five joints whose gains are 0.3 of the model's say of the sixth, which a log does not show,
    that it is as soft; its prior alone would have it at the model's."""
    problem = linear_problem(flight_log(20.0), np.random.default_rng(3))
    layout, w = problem.layout, problem.windows
    gains = layout.slices["servo_gain"]
    soft = layout.vector({"servo_gain": np.full(6, 0.3)})
    clean = w.split(problem.predict(soft, w.starts))[0]
    problem = problem._replace(windows=w._replace(angles=clean))
    shown = np.arange(6) < 5
    weights = problem.weights(pictures=0.0, angles=shown)
    fit = minimise(problem, Fit(layout.mean, w.starts), ["arm"], weights, 4)
    world = layout.world(fit.vector)
    np.testing.assert_allclose(world["servo_gain"][shown], 0.3, rtol=0.05)
    assert 0.25 < world["servo_gain"][5] < 0.4
    # So are the dampings, which it does not show either: no servo is slower for it.
    np.testing.assert_allclose(world["servo_damping"] / world["servo_gain"], 1.0, atol=0.3)
    # That each joint has a gain of its own is still open.
    deviation = certainty(problem, fit, layout.free(["arm"])).deviation[gains]
    assert np.all(deviation[shown] < 0.5 * layout.deviation[gains][shown])
    assert deviation[5] == pytest.approx(layout.deviation[gains][5], rel=0.15)


def test_an_offset_is_known_no_better_than_friction_lets_a_servo_rest() -> None:
    """Friction that differs between directions moves an offset in all windows alike."""
    problem = linear_problem(flight_log(20.0), np.random.default_rng(3))
    layout, weights = problem.layout, problem.weights(pictures=0.0)
    fit = minimise(problem, Fit(layout.mean, problem.windows.starts), ["arm"], weights, 2)
    searched = layout.free(["arm"])
    offsets = layout.slices["servo_offset"]
    band = np.array([0.0, 1e-4, 1e-3, 3e-3, 1e-2, 2e-2])
    free = certainty(problem, fit, searched).deviation[offsets]
    held = certainty(problem, fit, searched, dead_band=band).deviation[offsets]
    np.testing.assert_allclose(held, np.hypot(free, band / np.sqrt(3.0)), rtol=0.15)


def test_errors_that_are_alike_in_all_windows_do_not_average_out() -> None:
    """A twentieth of an angle's noise may pass for a delay, however many rows a log has; where
    neighbouring errors are alike, so much more of it; and a servo answers anywhere within a physics
    step."""
    problem = linear_problem(flight_log(20.0), np.random.default_rng(3))
    layout, w = problem.layout, problem.windows
    weights = problem.weights(pictures=0.0)
    fit = minimise(problem, Fit(layout.mean, w.starts), ["arm"], weights, 2)
    place = layout.slices["delay"].start
    counts = w.split(weights)[0] > 0.0
    later = fit.vector + 0.01 * (np.arange(len(fit.vector)) == place)
    change = w.split(problem.predict(later, w.starts) - problem.predict(fit.vector, w.starts))[0]
    sizes = np.sqrt(np.sum((change * counts) ** 2, axis=(0, 1)) / np.sum(counts, axis=(0, 1)))
    least = 0.05 * problem.noise.angles[0] / (np.mean(sizes) / 0.01)
    for alike in (1.0, 25.0):
        one = problem._replace(correlation=np.full(6, alike))
        deviation = certainty(one, fit, layout.free(["arm"])).deviation[place]
        assert deviation > 0.9 * np.hypot(np.sqrt(alike) * least, layout.physics_dt / np.sqrt(12.0))


def test_pictures_say_nothing_about_servos() -> None:
    """A bounce's derivatives by a gain are noise, as it begins in another physics step."""
    random = np.random.default_rng(3)
    problem = linear_problem(flight_log(20.0), random)
    layout, w = problem.layout, problem.windows
    shape = random.normal(size=w.balls.shape)

    def simulate(vectors: np.ndarray, starts: np.ndarray, used: np.ndarray) -> np.ndarray:
        rows = problem.simulate(vectors, starts, used)
        gain = vectors[:, layout.slices["servo_gain"].start]
        rows[..., w.angles[0].size :] += (gain[:, None, None, None] * shape).reshape(
            *rows.shape[:2], -1
        )
        return rows

    weights = problem.weights()
    fit = minimise(problem, Fit(layout.mean, w.starts), ["arm"], weights, 2)
    searched, gains = layout.free(["arm"]), layout.slices["servo_gain"]
    known = [
        certainty(each, fit, searched).information[gains, gains]
        for each in (problem, problem._replace(simulate=simulate))
    ]
    np.testing.assert_allclose(known[1], known[0], rtol=1e-6, atol=1e-6)


def test_a_log_that_no_world_explains_is_not_called_the_same_robot(
    tmp_path: Path, monkeypatch, capsys
) -> None:
    """Nor is a page named that --check does not write."""
    path, world = tmp_path / "log.csv", tmp_path / "world.yaml"
    home = np.array(read_preset(Path("default")).env.default_joint_angles)
    rates = np.arange(1.0, 7.0)
    with Recorder(path, NAMES) as recorder:
        for time in 0.01 * np.arange(1500):
            late, sent = (home + 0.1 * np.sin(rates * t) for t in (time - 0.025, time))
            recorder.step({"time": time, "joint_angles": late}, sent)
    found = unseen()
    world.write_text(to_yaml(found, flight_log(), NAMES, None), encoding="utf-8")
    monkeypatch.setattr("bounce_mjx.identify.identification.identify", lambda *_: found)
    arguments = ["identify", str(path), "--check", str(world), "--out", str(tmp_path / "new.yaml")]
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 0 and "still matches" in capsys.readouterr().out
    found = found._replace(joint_errors=np.full(6, 0.1))
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    printed = capsys.readouterr()
    assert ended.value.code == 2 and "still matches" not in printed.out
    assert "cannot be compared with" in printed.err and "does not explain" in printed.err
    with pytest.raises(SystemExit) as ended:
        main([*arguments, "--inspect"])
    assert ended.value.code == 0 and "new.html" not in capsys.readouterr().out
    assert not list(tmp_path.glob("new.*"))


def test_errors_that_are_alike_count_as_one() -> None:
    """Against the correlation time of y' = a y + noise, (1 + a) / (1 - a)."""
    shares = np.array([0.0, 0.5, 0.9])
    noise = np.random.default_rng(0).normal(size=(40, 600, 3))
    errors = noise.copy()
    for i in range(1, errors.shape[1]):
        errors[:, i] += shares * errors[:, i - 1]
    counts = np.ones(errors.shape[:2], bool)
    expected = (1.0 + shares) / (1.0 - shares)
    np.testing.assert_allclose(correlation_times(errors, counts), expected, rtol=0.1)
    counts[:, 400:] = False
    np.testing.assert_allclose(correlation_times(errors, counts), expected, rtol=0.15)


def test_the_total_delay_is_certain_where_latency_and_lag_are_not() -> None:
    """Also at a latency of 0, where a longer lag alone would be a longer delay."""
    layout = Layout(6, True, 0.001)
    model = world_model(read_preset(Path("default")).env, visual=False)
    vector = layout.vector({"action_latency": 0.0, "servo_lag": 0.001})
    known = layout.deviation.copy()
    known[layout.slices["delay"]] = 1e-4
    known[layout.slices["servo_gain"]] = 1e-3
    known[layout.slices["servo_damping"]] = 1e-3
    found = identified(layout, flight_log(), vector, np.diag(known**2))
    width = total_delay(found, model).split("+- ")[1].split(" ms")[0]
    assert 0.1 < float(width) < 0.3


def test_a_bounded_step_is_the_best_one_within_its_bounds() -> None:
    """Against SciPy's minimiser of the same quadratic."""
    random = np.random.default_rng(5)
    root, slope = random.normal(size=(9, 5)), 5.0 * random.normal(size=5)
    hessian = root.T @ root + 0.1 * np.eye(5)
    room = np.stack([-random.uniform(0.0, 1.0, 5), random.uniform(0.0, 1.0, 5)])
    found = _bounded_step(hessian, slope, room)
    best = minimize(
        lambda x: 0.5 * x @ hessian @ x + slope @ x,
        np.zeros(5),
        jac=lambda x: hessian @ x + slope,
        bounds=room.T,
        method="L-BFGS-B",
        options={"ftol": 1e-14, "gtol": 1e-10},
    )
    np.testing.assert_allclose(found, best.x, atol=1e-6)
    # Another active set than that of the free step, clipped.
    clipped = np.clip(-np.linalg.solve(hessian, slope), *room)
    assert np.max(np.abs(found - clipped)) > 1e-3


@pytest.mark.parametrize("lift", [0.0, 0.006])
def test_whitening_is_the_inverse_root_of_the_covariance(lift: float) -> None:
    """Of the pictures after a bounce whose velocity, and with lift whose spin, deviates."""
    random = np.random.default_rng(6)
    problem = linear_problem(flight_log(), random)._replace(simulated=Simulated(lift=lift))
    w, weights = problem.windows, problem.weights()
    errors = random.normal(size=w.measured.shape) * problem.deviations
    white = w.split(problem.whiten(w.measured + errors, weights))[1]
    s = int(np.flatnonzero(w.has_ball)[0])
    used = w.picture_weights[s] > 0.0
    columns = problem.bounce_columns()[s][used]
    scaled = w.split(errors / problem.deviations)[1][s][used]
    for axis in range(3):
        covariance = np.eye(int(np.sum(used))) + columns[:, axis] @ columns[:, axis].T
        expected = scaled[:, axis] @ np.linalg.solve(covariance, scaled[:, axis])
        assert np.sum(white[s, used, axis] ** 2) == pytest.approx(expected, rel=1e-6)


def test_a_flight_with_drag_and_spin_is_fitted_directly() -> None:
    """As an integrator with an error of 1e-9 flies it."""
    drag, lift = 0.17, np.array([0.6, -0.4, 0.9])
    start = np.array([0.1, -1.5, 0.4, 0.5, 6.0, 1.5])

    def slope(time: float, state: np.ndarray) -> np.ndarray:
        return np.concatenate([state[3:], acceleration(state[3:], drag, lift)])

    times = np.arange(0.08, 0.5, 0.006)
    flown = solve_ivp(slope, (0.0, 0.5), start, t_eval=times, rtol=1e-9, atol=1e-9)
    flight = fit_flight(times, flown.y[:3].T, np.full(3, 1e-5), 0.1, 10.0, 10.0)
    np.testing.assert_allclose(flight.position, start[:3], atol=1e-4)
    np.testing.assert_allclose(flight.velocity, start[3:], atol=2e-3)
    np.testing.assert_allclose(flight.lift, lift, atol=5e-3)
    assert 0.1 * (1.0 + flight.drag_deviation) == pytest.approx(drag, rel=5e-3)
    # Gravity, drag against the motion, and lift across both motion and spin.
    pull = acceleration(np.array([2.0, 0.0, 0.0]), 0.1, np.array([0.0, 0.0, 3.0]))
    np.testing.assert_allclose(pull, [-0.4, 6.0, -9.81])


@pytest.mark.parametrize("of_joint", [0.0, 0.5, 1.0])
def test_the_total_delay_counts_the_joints_own_damping(of_joint: float) -> None:
    """It is the time by which the joints of C's model are behind targets that move steadily,
    whoever damps them; and the candidates of a search are as late as the log."""
    config = read_preset(Path("default")).env
    model, layout = world_model(config, visual=False), Layout(6, False, 0.001)
    addresses = find_addresses(model)
    servos, joints = list(addresses.actuators), list(addresses.arm_qvel)
    model.actuator_gainprm[servos, 0], model.actuator_biasprm[servos, 1] = 1000.0, -1000.0
    model.actuator_biasprm[servos, 2] = -20.0 * (1.0 - of_joint)
    model.dof_damping[joints] = 20.0 * of_joint
    model.opt.gravity[:] = 0.0
    data, home = mujoco.MjData(model), np.array(config.default_joint_angles)
    data.qpos[list(addresses.arm_qpos)] = home
    for _ in range(800):
        # At the end of a step, a servo has answered the target of its middle.
        data.ctrl[servos] = home + 0.05 * (data.time + 0.5 * model.opt.timestep)
        mujoco.mj_step(model, data)
    behind = home + 0.05 * data.time - data.qpos[list(addresses.arm_qpos)]
    vector = layout.vector({"action_latency": np.array(0.0), "servo_lag": np.array(0.0)})
    found = identified(layout, flight_log(), vector, np.diag((1e-3 * layout.deviation) ** 2))
    printed = float(total_delay(found, model).split(" ")[2])
    assert printed == pytest.approx(1e3 * np.mean(behind) / 0.05, abs=0.6)
    assert printed == pytest.approx(19.5, abs=0.1)
    late = _late_servos(layout, servos_of(model), 0.05)
    assert np.all(np.abs(layout.world(late)["action_latency"] - 0.05) < 0.05)
    for world in (layout.world(vector) for vector in late):
        delays = servos_of(model).delays(world["servo_gain"], world["servo_damping"])
        assert world["action_latency"] + world["servo_lag"] + np.mean(delays) == pytest.approx(
            0.05, abs=1e-3
        )


@pytest.mark.slow
@pytest.mark.parametrize("late", [0.012, 0.003])
def test_an_arm_is_explained_no_worse_than_by_a_delay_and_offsets(
    late: float, tmp_path: Path
) -> None:
    """One that follows its commands more exactly than any servo, or so early that they are a
    controller's own set points; and what the servos of the model are, no log of it shows."""
    config, random = read_preset(Path("default")).env, np.random.default_rng(3)
    times = np.arange(0.0, 4.5, 0.008)
    rates = np.array([1.1, 1.7, 2.3, 2.9, 1.3, 0.7])
    home = np.array(config.default_joint_angles)
    offsets = np.array([0.002, -0.001, 0.0, 0.001, -0.002, 0.0005])
    angles = home + offsets + 0.3 * np.sin(np.outer(times - late, rates))
    angles += 1e-4 * random.normal(size=angles.shape)
    targets = home + 0.3 * np.sin(np.outer(times, rates))
    nothing = np.zeros(0)
    log = Log("here", times, angles, times, targets, nothing, np.zeros((0, 3)), nothing)
    found = identify(config, log)
    of_delay = np.sqrt(np.mean(found.choice.trial(DELAY).errors ** 2))
    of_model = np.sqrt(np.mean(found.joint_errors**2))
    assert of_model < 1.1 * of_delay
    # The delay is that of the targets as they are in the log.
    assert of_delay < 1.2e-4
    assert found.has_set_points == (late < 0.004)
    if found.has_set_points:
        assert found.is_follower
        shown = {x.label.split(" ")[0] for x in estimates(found, NAMES) if x.seen}
        assert shown == {"action_latency", "servo_offset"}
        (said,) = (x for x in sentences(found, NAMES) if "stiff servos" in x)
        assert "the controller's own set points" in said
        model = world_model(config, visual=False)
        printed = total_delay(found, model)
        assert float(printed.split(" ")[2]) == pytest.approx(1e3 * late, abs=0.15)
        path = tmp_path / "world.yaml"
        path.write_text(to_yaml(found, log, NAMES, None), encoding="utf-8")
        assert read_world(path).sources["randomization.servo_gain"].startswith("Chosen, as a delay")
        # Of servos and a lag, it is the time by which the simulated joints follow.
        layout, windows = found.layout, found.windows
        other_world = {"action_latency": 0.01, "servo_lag": 0.02, "joint_frictionloss": np.zeros(6)}
        vector = layout.vector(other_world)
        simulate = make_simulator(config, layout, log, windows, Simulated(1.0))
        every = np.ones((1, len(windows.first)), bool)
        simulated = windows.split(simulate(vector[None], windows.starts[None], every)[0])[0]
        settled = (windows.angle_weights > 0.0) & (windows.angle_times > 0.4)
        at = (windows.zero[:, None] + windows.angle_times)[settled]
        other = log._replace(times=at, joint_angles=simulated[settled])
        measured = command_delay(other, follow(other, np.ones(len(at), bool)))
        printed = total_delay(found._replace(fit=found.fit._replace(vector=vector)), model)
        assert float(printed.split(" ")[2]) == pytest.approx(1e3 * measured, abs=0.15)


def test_following_finds_delay_and_offsets() -> None:
    """Of joints that follow 15.5 ms late; an outlier changes nothing."""
    random = np.random.default_rng(7)
    times = np.arange(0.0, 10.0, 0.004)
    waves = np.sin(np.outer(times, [1.0, 1.7, 2.3]))
    late = np.sin(np.outer(times - 0.0155, [1.0, 1.7, 2.3]))
    offsets = np.array([0.002, -0.001, 0.0])
    angles = late + offsets + 3e-4 * random.normal(size=late.shape)
    angles[500, 1] += 0.5
    log = flight_log()._replace(
        times=times, target_times=times, joint_angles=angles, servo_targets=waves
    )
    found = follow(log, find_settled(log))
    assert found.delay == pytest.approx(0.0155, abs=1e-4)
    np.testing.assert_allclose(found.offsets, offsets, atol=1e-4)
    np.testing.assert_allclose(found.errors, 3e-4, rtol=0.1)


def test_set_points_are_commanded_when_they_are_due() -> None:
    """A controller's own set points, recorded every 8 ms, that the joints follow at once: the mean
    command of a physics step is that of the set points in it."""
    times, rates = np.arange(0.0, 10.0, 0.008), np.array([1.0, 1.7, 2.3])
    waves = np.sin(np.outer(times, rates))
    log = flight_log()._replace(
        times=times, target_times=times, joint_angles=waves, servo_targets=waves
    )
    rows = find_settled(log)
    following = follow(log, rows)
    assert command_delay(log, following) == pytest.approx(0.0, abs=1e-4)
    edges = 0.001 * np.arange(1001)
    sent = make_targets(set_points(log, following, 0.001), edges)(0.0, 0.0)
    middles = 0.5 * (edges[1:] + edges[:-1])
    np.testing.assert_allclose(sent, np.sin(np.outer(middles, rates)), atol=5e-5)
    # Commands that are held until the next are later than their stamps by half a step.
    late = log._replace(joint_angles=np.sin(np.outer(times - 0.0155, rates)))
    assert command_delay(late, follow(late, rows)) == pytest.approx(0.0115, abs=1e-4)


def test_an_arm_at_rest_shows_no_delay_and_no_set_points() -> None:
    """Nor does one that rests in two logs, elsewhere in each."""
    log = flight_log()
    rest = np.tile(0.2 * np.arange(6), (len(log.times), 1))
    still = log._replace(joint_angles=rest + 1e-3, servo_targets=rest)
    elsewhere = still._replace(joint_angles=rest + 0.301, servo_targets=rest + 0.3)
    moving = log._replace(joint_angles=log.servo_targets + 1e-3)
    cases = (([still], False), ([still, elsewhere], False), ([still, moving], True))
    for logs, moves in cases:
        joined = join(logs)
        following = follow(joined, find_settled(joined))
        assert does_move(joined) == shows_set_points(joined, following) == moves
    assert not any("their sum is what it shows" in line for line in sentences(unseen(), NAMES))
    found = unseen()._replace(choice=Choice((), STILL, (), None))
    assert any("neither a delay nor servos" in line for line in sentences(found, NAMES))
    model = world_model(read_preset(Path("default")).env, visual=False)
    assert total_delay(found, model).endswith("(not shown by the log)")


def following_log(gain: float = 1.0, lead: float = 0.0, seconds: float = 40.0) -> Log:
    """An arm whose angles are a gain times its commands, 20 ms late less a lead."""
    log = flight_log(seconds, gap=(0.0, seconds))
    rates = np.array([1.0, 1.7, 2.3, 1.3, 2.9, 0.7])
    noise = 1e-4 * np.random.default_rng(0).normal(size=log.joint_angles.shape)
    targets = 0.3 * np.sin(np.outer(log.times, rates))
    late = 0.3 * np.sin(np.outer(log.times - 0.02 + lead, rates))
    return log._replace(servo_targets=targets, joint_angles=gain * late + noise)


def judged(log: Log, servo_error: float) -> Choice:
    """The hypotheses of a log; servos that are off by a random error (rad)."""
    windows = windows_of(log)
    seen = is_seen(windows)
    following = follow(log, find_settled(log))
    response = measure_response(log, np.flatnonzero(find_settled(log)), NAMES)
    follower, words = expect_follower(log, windows, seen, response)
    noise = np.random.default_rng(1).normal(size=windows.angles.shape)
    trials = [
        judge(COMMAND, windows, expect_command(log, windows), ~seen),
        judge(DELAY, windows, expect_delay(log, windows, following), ~seen),
        judge(FOLLOWER, windows, follower, ~seen, words),
        judge(SERVOS, windows, windows.angles + servo_error * noise, ~seen),
    ]
    return choose(trials, windows, ~seen, np.full(6, 1e-4))


def test_a_difference_is_judged_by_each_joint_in_each_window() -> None:
    """Two unseen windows alone, in one of which servos are hardly better, would be a tie."""
    log = following_log()
    windows = cut_enough(log, 1e-3)
    unseen = np.arange(len(windows.first)) < 2
    better = np.ones_like(windows.angles)
    worse = better.copy()
    worse[0] = np.sqrt(1.69)
    worse[1] = np.sqrt(1.04)
    trials = [
        judge(DELAY, windows, windows.angles + 1e-3 * worse, unseen),
        judge(SERVOS, windows, windows.angles + 1e-3 * better, unseen),
    ]
    assert choose(trials, windows, unseen, np.full(6, 1e-4)).chosen == SERVOS


def test_the_least_held_out_error_wins_and_ties_go_to_fewer_unknowns() -> None:
    late = judged(following_log(), 1e-4)
    assert late.chosen == DELAY and late.better is None
    assert [late.trial(x).unknowns for x in (COMMAND, DELAY, FOLLOWER, SERVOS)] == [0, 7, 24, 32]
    # An arm that is where its command is.
    assert judged(following_log(lead=0.02), 1e-4).chosen == COMMAND
    # Servos that say more.
    assert judged(following_log(), 2e-5).chosen == SERVOS
    # A controller that scales and leads: no training simulates it, whatever else is written.
    scaled = judged(following_log(gain=1.05, lead=0.03), 5e-3)
    assert scaled.chosen.can_train and scaled.better.hypothesis == FOLLOWER
    assert "gains of 1.050 to 1.050" in scaled.better.detail
    np.testing.assert_allclose(scaled.better.errors, 1e-4, rtol=0.2)
    found = unseen()._replace(choice=scaled, joint_errors=scaled.trial(SERVOS).errors)
    (doubt, *_) = [x for x in describe_doubts(found, NAMES) if "leads or scales" in x]
    assert "Joint1, Joint2" in doubt and "5, 5" in doubt
    # Where a world is as good as a policy needs, nothing is refused.
    near = found._replace(joint_errors=np.full(6, 9e-4))
    assert not any("leads or scales" in x for x in describe_doubts(near, NAMES))


def test_windows_that_compare_are_not_fitted() -> None:
    """What no fit has seen changes no hypothesis."""
    log = following_log()
    windows = windows_of(log)
    seen = is_seen(windows)
    response = measure_response(log, np.flatnonzero(find_settled(log)), NAMES)
    expected = expect_follower(log, windows, seen, response)[0]
    moved = windows._replace(angles=windows.angles + 0.1 * ~seen[:, None, None])
    np.testing.assert_array_equal(expect_follower(log, moved, seen, response)[0], expected)
    moved = windows._replace(angles=windows.angles + 0.1 * seen[:, None, None])
    other = expect_follower(log, moved, seen, response)[0]
    np.testing.assert_allclose(other, expected + 0.1, atol=1e-6)


def test_an_exact_follower_has_the_least_stiff_servos_and_offsets_of_seen_windows() -> None:
    config, log = read_preset(Path("default")).env, flight_log(20.0)
    problem = linear_problem(log, np.random.default_rng(3))
    windows, following = problem.windows, follow(log, find_settled(log))
    given = Given(log, None, following, 0.02, False, False)
    servos = servos_of(world_model(config, visual=False))
    unseen_windows = ~is_seen(windows)
    followers = []
    for which in (~unseen_windows, unseen_windows):
        angles = windows.angles + 0.1 * which[:, None, None]
        other = problem._replace(windows=windows._replace(angles=angles))
        followers.append(_exact_follower(other, servos, given, DELAY)[1].vector)
    place = problem.layout.slices["servo_offset"]
    same = _exact_follower(problem, servos, given, DELAY)[1].vector
    np.testing.assert_array_equal(followers[1], same)
    np.testing.assert_allclose(followers[0][place], same[place] + 0.1, atol=1e-3)
    # In this problem, all gains follow alike.
    assert problem.layout.world(same)["servo_gain"] == pytest.approx(1.0)


def test_what_was_chosen_for_a_follower_has_no_interval(tmp_path: Path) -> None:
    """Nor does a motion show it; its range in the world is as wide as the prior."""
    found = unseen()
    layout = found.layout
    vector = layout.vector({"servo_gain": np.full(6, 30.0)})
    follower = found._replace(
        choice=Choice((), DELAY, (), None), fit=found.fit._replace(vector=vector)
    )
    chosen = {x.label.split(" ")[0] for x in estimates(follower, NAMES) if x.chosen}
    assert chosen == {"servo_lag", "servo_gain", "servo_damping", "joint_frictionloss"}
    assert not any(x.chosen for x in estimates(found, NAMES))
    unshown = [x for x in sentences(follower, NAMES) if x.startswith("The log does not s")]
    assert any("link_mass" in x for x in unshown)
    assert not any(name in line for name in chosen for line in unshown)
    path = tmp_path / "world.yaml"
    path.write_text(to_yaml(follower, flight_log(), NAMES, None), encoding="utf-8")
    world = read_world(path)
    gain, mass = (world.sources[f"randomization.{name}"] for name in ("servo_gain", "link_mass"))
    assert "30, 30" in gain and "+-" not in gain and "95%" not in gain
    assert "+-" in mass and "95%" in mass
    expected = [[30.0 * (2.0 - np.exp(0.2))] * 6, [30.0 * np.exp(0.2)] * 6]
    np.testing.assert_allclose(world.settings["randomization"]["servo_gain"], expected, rtol=1e-3)
    checkups = examine([flight_log()], NAMES)
    page = identification_page(follower, [flight_log()], checkups, NAMES, path, [], None)
    assert page.count("chosen for an arm that follows") == 19


def test_a_controller_that_carries_the_arm_lets_no_servo_sag() -> None:
    """The forces of gravity and of its compensation cancel; and a share of it that is a parameter
    is the same in the fused engine and on C."""
    config = compensated(read_preset(Path("default")).env)
    model = world_model(config, visual=False)
    addresses, data = find_addresses(model), mujoco.MjData(model)
    dofs = list(addresses.arm_qvel)
    data.qpos[list(addresses.arm_qpos)] = config.default_joint_angles
    mujoco.mj_forward(model, data)
    assert np.max(np.abs(data.qfrc_bias[dofs])) > 1.0
    np.testing.assert_allclose(data.qfrc_gravcomp[dofs], data.qfrc_bias[dofs], atol=1e-9)
    ball = addresses.balls[0].body
    assert model.body_gravcomp[ball] == 0.0
    engine = make_engine(model, "fused")
    links = sum(link_bodies(model, addresses), [])
    start = PhysicsState(jnp.asarray(data.qpos, float), jnp.asarray(data.qvel, float))
    for share in (0.0, 1.0):
        entries = {f"body_gravcomp[{b}]": np.float32(share) for b in links}
        parameters = PhysicsParameters(entries=entries)
        edited = edited_model(model, parameters)
        other = mujoco.MjData(edited)
        other.qpos[:] = data.qpos
        other.ctrl[list(addresses.actuators)] = config.default_joint_angles
        mujoco.mj_step(edited, other)
        control = Control(jnp.asarray(other.ctrl, float))
        after = engine.step(parameters, start, control, 1)
        np.testing.assert_allclose(after.qvel, other.qvel, atol=2e-5)


@pytest.mark.slow
def test_a_hidden_robot_is_identified(tmp_path: Path) -> None:
    """Of a tuning seed, from a log of 19 s."""
    benchmark = runpy.run_path(str(BENCHMARK))
    config, path = read_preset(Path("default")).env, tmp_path / "log.csv"
    hidden = benchmark["hidden_robot"](1000)
    benchmark["record"](config, hidden, 1000, path, excited=10.0, played=9.0)
    truth = hidden.world
    found = identify(config, read_csv(path, NAMES))
    world = found.layout.world(found.fit.vector)
    late, true = (w["action_latency"] + w["servo_lag"] for w in (world, truth))
    assert abs(late - true) < 1.5e-3
    # A lag near 0 differs from a latency only in the second order.
    assert abs(world["servo_lag"] - truth["servo_lag"]) < 5e-3
    assert abs(world["restitution"] - truth["restitution"]) < 0.03
    # Its contact is the model's, and its last simulation has steps of half the length.
    assert not found.simulated.leaves_at_once
    assert found.layout.physics_dt == 0.5 * config.physics_dt
    damping, true = (w["servo_damping"] / w["servo_gain"] for w in (world, truth))
    np.testing.assert_allclose(damping, true, rtol=0.3)
    # The fit explains the log down to the noise, which the model's own world does not.
    assert found.before["ball_position"] > 2.0
    assert all(0.8 < error < 1.2 for error in found.after.values())
    assert all(error < 1.3 for error in found.held_out.values())


def test_a_search_begins_from_slow_servos_and_from_long_lags_that_delay_alike() -> None:
    """Each as late as the log, so that none is left out for its delay alone: robots 1012 and 1017
    of the benchmark were identified with a lag that is 28 and 7 ms off."""
    config, layout = read_preset(Path("default")).env, Layout(6, True, 0.001)
    model = world_model(config, visual=False)
    servo = model.actuator("act1")
    of_model = float(-servo.biasprm[2] / servo.gainprm[0])
    late, servos = 0.0563, servos_of(model)
    for candidates in (_own_servos(layout, servos, late), _late_servos(layout, servos, late)):
        world = layout.world(candidates)
        servos = of_model * (world["servo_damping"] / world["servo_gain"])[:, 0]
        total = world["action_latency"] + world["servo_lag"] + servos
        # The limits of a servo's damping leave some less late; the mean of a lag is shorter than it
        # by half a step at most.
        is_late = np.abs(total - late) < 6e-4
        assert np.mean(is_late) > 0.6
        of_lag = (world["servo_lag"] / (late - servos))[is_late]
        assert np.min(of_lag) < 0.02 and np.max(of_lag) > 0.55
    # Soft servos too: robot 3007, whose gains are 0.3, had a lag that was 13 ms off.
    assert np.min(world["servo_gain"]) < 0.5


def test_a_servo_holds_its_joint_beside_the_target() -> None:
    """By servo_offset, in the world of a training."""
    config = read_preset(Path("default")).env
    model = world_model(config, visual=False)
    actuators, qpos = Actuators(config, model), jnp.asarray(model.qpos0)
    offsets = jnp.array([0.01, 0.0, -0.02, 0.0, 0.0, 0.003])
    before, action = actuators.first(qpos), jnp.full(6, 0.5)
    plain, other = (
        actuators.next(before, qpos, action, world, None)[0]
        for world in ({}, {"servo_offset": offsets})
    )
    servos = list(find_addresses(model).actuators)
    np.testing.assert_allclose((other.ctrl - plain.ctrl)[np.array(servos)], offsets, atol=1e-7)
