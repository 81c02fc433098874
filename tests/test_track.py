"""The task track: paths, the prediction of the point, rewards and results."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bounce_mjx import task
from bounce_mjx.env.env import Env
from bounce_mjx.task import paths
from bounce_mjx.task.track import Config, Track
from bounce_mjx.world.randomization import RandomizationConfig

CONFIG = Config()
TRACK = Track(CONFIG)
SIZE, DT = CONFIG.path_size, CONFIG.control_dt
INTERVAL = RandomizationConfig(goal_interval=(0.5, 0.5))
NOT_STEPS = [i for i in range(len(paths.NAMES)) if i != paths.STEPS]


def goal(path: float = 0, speed: float = 0.3, course: float = 0.2, phase: float = 0.4) -> dict:
    values = {"target_x": 0.6, "target_y": 0.1, "target_height": 0.5, "point_speed": speed}
    values |= {"path": path, "course": course, "phase": phase}
    return {name: jnp.float32(value) for name, value in values.items()}


@partial(jax.jit, static_argnums=1)
def followed(start: dict, steps: int) -> jax.Array:
    """The point [steps, 3] of an episode that starts with drawn goals."""

    def advance(now, _):
        now = TRACK.next_goal(jnp.array(True), now)
        return now, paths.point(now)

    return jax.lax.scan(advance, TRACK.first_goal(start), None, steps)[1]


def from_middle(start: dict, seconds: float) -> np.ndarray:
    """The point from the middle of its path, turned back by its course [T, 2], m."""
    x, y = (np.asarray(followed(start, round(seconds / DT)), float)[:, :2] - [0.6, 0.1]).T
    angle = 2.0 * np.pi * 0.2
    return np.stack([np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x])


def test_the_paths_are_their_equations() -> None:
    """Of a circle, a line, and the lemniscate of Gerono, each over more than one turn."""
    x, y = from_middle(goal(0), 4.0)
    np.testing.assert_allclose(np.hypot(x, y), SIZE, atol=1e-5)
    x, y = from_middle(goal(1), 4.0)
    np.testing.assert_allclose(y, 0.0, atol=1e-5)
    np.testing.assert_allclose((x.min(), x.max()), (-SIZE, SIZE), atol=1e-4)
    x, y = from_middle(goal(2), 6.0)
    np.testing.assert_allclose(y**2, x**2 * (1.0 - (x / SIZE) ** 2), atol=1e-6)
    np.testing.assert_allclose((x.min(), x.max()), (-SIZE, SIZE), atol=1e-4)


def test_the_point_steps_by_10_cm_every_4_s() -> None:
    way = np.linalg.norm(np.diff(np.asarray(followed(goal(3), 2000))[:, :2], axis=0), axis=1)
    (steps,) = np.nonzero(way > 1e-4)
    np.testing.assert_allclose(way[steps], 0.1, atol=1e-5)
    np.testing.assert_allclose(np.diff(steps), 400, atol=1)
    assert len(steps) == 5


@pytest.mark.parametrize("path", NOT_STEPS)
@pytest.mark.parametrize("speed", [0.1, 0.3])
def test_the_point_is_at_most_as_fast_as_commanded(path: int, speed: float) -> None:
    """In any course; the courses of the wandering differ in their greatest speed."""
    courses = np.linspace(0.0, 1.0, 50, endpoint=False)
    starts = jax.vmap(lambda course: goal(path, speed) | {"course": course})(courses)
    points = np.asarray(jax.vmap(lambda start: followed(start, 3000))(starts), float)
    fastest = np.linalg.norm(np.diff(points[..., :2], axis=1), axis=-1).max() / DT
    assert 0.9 * speed < fastest < 1.001 * speed
    assert np.abs(points[..., :2] - [0.6, 0.1]).max() < 0.2


def test_flight_is_that_of_a_falling_ball() -> None:
    """Against small steps of Newton's law."""
    ball, velocity = np.array([0.5, 0.1, 0.3]), np.array([0.2, -0.1, 1.5])
    flight = task.flight(jnp.array(ball), jnp.array(velocity), 0.1)
    time, highest, dt = 0.0, (0.0, ball), 1e-5
    while ball[2] > 0.1:
        ball = ball + dt * velocity + 0.5 * dt**2 * np.array([0.0, 0.0, -9.81])
        velocity, time = velocity + dt * np.array([0.0, 0.0, -9.81]), time + dt
        highest = max(highest, (time, ball), key=lambda found: found[1][2])
    np.testing.assert_allclose((flight.rise, flight.fall), (highest[0], time), atol=1e-4)
    np.testing.assert_allclose(flight.top, highest[1], atol=1e-4)
    np.testing.assert_allclose(flight.end, ball, atol=1e-4)


def measured(x: float, y: float, **others: object) -> dict:
    given = {"ball_position": jnp.array([0.6, 0.0, 0.4]), "ball_velocity": jnp.zeros(3)}
    values = {"target_x": [x], "target_y": [y], "target_height": [0.5]} | others
    return given | {name: jnp.array(value) for name, value in values.items()}


def seen_aim(points: list[tuple[float, float]], **others: object) -> np.ndarray:
    """The aim [2] after measurements of a point at successive control steps."""
    memory, seen = TRACK.first_quantities(measured(*points[0], **others))
    seen = {"aim": seen["aim"][None]}
    for there in points[1:]:
        memory, seen = TRACK.next_quantities(memory, seen, measured(*there, **others))
    return np.asarray(seen["aim"][0])


def test_the_aim_is_the_point_at_the_next_apex() -> None:
    """A ball that falls from rest at 0.4 m to 0.0725 m and rises to 0.5 m; a point that is
    uniformly accelerated."""
    seconds = np.sqrt(2 * (0.4 - 0.0725) / 9.81) + np.sqrt(2 * (0.5 - 0.0725) / 9.81)
    with jax.enable_x64(True):

        def at(time: float) -> tuple[float, float]:
            return 0.6 + 0.2 * time - 0.3 * time**2, 0.1 * time + 0.25 * time**2

        aim = seen_aim([at(DT * step) for step in (-3, -2, -1, 0)])
        x, y = at(seconds)
    # The velocity is that of half a step ago.
    np.testing.assert_allclose(aim, (x - 0.6, y), atol=0.005)
    assert np.linalg.norm(aim - np.array(at(0.0)) + (0.6, 0.0)) > 0.05


def test_after_a_jump_the_aim_is_that_of_the_new_velocity() -> None:
    """At a reset, a new sample or a step of the hexagon the point jumps, along any direction. In
    that step it has no velocity; from the next one on, its own, and no acceleration of the jump."""
    seconds = np.sqrt(2 * (0.4 - 0.0725) / 9.81) + np.sqrt(2 * (0.5 - 0.0725) / 9.81)
    velocity = np.array([0.02, -0.25])

    def moving_from(x: float, y: float) -> list[tuple[float, float]]:
        return [tuple((x, y) + velocity * DT * step) for step in range(4)]

    with jax.enable_x64(True):
        for jump in ((0.1, 0.0), (0.1, 0.009), (-0.004, 0.1), (0.07, 0.07)):
            before = [(0.6 - 1e-4 * step, 0.0) for step in (3, 2, 1, 0)]
            after = moving_from(0.6 + jump[0], jump[1])
            for points, jumps_at in ((after, 0), (before + after, len(before))):
                np.testing.assert_allclose(
                    seen_aim(points[: jumps_at + 1]), np.subtract(after[0], (0.6, 0.0)), atol=1e-9
                )
                for now in (1, 2, 3):
                    aim = seen_aim(points[: jumps_at + now + 1])
                    expected = after[now] + velocity * seconds - (0.6, 0.0)
                    np.testing.assert_allclose(aim, expected, atol=1e-9)


def test_no_path_accelerates_like_a_jump() -> None:
    """Also the tightest and fastest paths that the settings admit."""
    for settings in ({}, {"speed_range": (1.0, 1.0)}, {"path_size": 0.03}):
        config = Config(**settings)
        track = Track(config)
        phase = np.linspace(0.0, 1.0, 2001)
        accelerations = []
        for path in NOT_STEPS:
            turns_a_second = config.speed_range[1] / (
                2.0 * np.pi * config.path_size * paths.FASTEST[path]
            )
            for course in np.linspace(0.0, 1.0, 50, endpoint=False):
                values = {"path": path, "course": course}
                point = paths.offset(values, config.path_size, phase, np)[:2]
                seconds = (phase[1] - phase[0]) / turns_a_second
                second_difference = np.diff(point, n=2, axis=1) / seconds**2
                accelerations.append(np.linalg.norm(second_difference, axis=0).max())
        assert max(accelerations) < track._jump_acceleration()
        greatest = paths.SHARPEST * config.speed_range[1] ** 2 / config.path_size
        np.testing.assert_allclose(max(accelerations), greatest, rtol=1e-3)


def test_every_sampled_path_has_its_middle_at_home() -> None:
    """Also the tenth one of an episode."""
    env = Env(CONFIG.model_copy(update={"randomization": INTERVAL}))

    @jax.jit
    @jax.vmap
    def middles(key: jax.Array) -> jax.Array:
        start = env.reset(key)
        actuation, physics = start.pipeline_state.actuation, start.pipeline_state.physics

        def pass_time(state, _):
            state = env.finish_step(state, jnp.zeros(6), actuation, physics)
            now = state.pipeline_state.goal
            return state, paths.point(now) - paths.offset(now, SIZE, now["phase"])

        return jax.lax.scan(pass_time, start, None, 500)[1]

    found = np.asarray(middles(jax.random.split(jax.random.key(0), 50)))
    assert len(np.unique(np.round(found[0], 4), axis=0)) > 8
    assert np.abs(found[..., :2] - CONFIG.home[:2]).max() < 0.0201
    heights = found[..., 2] - CONFIG.home[2]
    assert 0.3999 < heights.min() < heights.max() < 0.5001


def truth_of(ball: jax.Array, velocity: jax.Array, paddle: jax.Array) -> task.Kinematics:
    zero = jnp.zeros(6)
    return task.Kinematics(zero, ball, jnp.zeros(4), zero, velocity, jnp.zeros(3), paddle)


def rewards_at(seconds: float, shift: float = 0.0, lift: float = 0.0) -> dict[str, float]:
    """Rewards of a flight whose apex is the point on a circle at that time."""
    now = goal(0)
    offset = paths.offset(now, SIZE, now["phase"])
    later = paths.offset(now, SIZE, paths.phase_in(seconds, now, SIZE))
    apex = paths.point(now) + later - offset + jnp.array([shift, 0.0, lift])
    speed = jnp.array([0.2, 0.1, 9.81 * seconds])
    ball = apex - speed * seconds + jnp.array([0.0, 0.0, 0.5 * 9.81 * seconds**2])
    end = task.flight(ball, speed, CONFIG.home[2] + 0.0225).end
    truth = truth_of(ball, speed, end.at[2].set(CONFIG.home[2]))
    step = task.Step(truth, now, jnp.zeros(6), jnp.zeros(6))
    return TRACK.step(jnp.array(True), step).reward


@pytest.mark.parametrize("seconds", [0.2, -0.1])
def test_rewards_are_greatest_without_an_error(seconds: float) -> None:
    """The apex counts throughout its flight; an error of 3 cm, or of 10 cm in height, halves it."""
    best = rewards_at(seconds)
    weights = dict(CONFIG.reward)
    for name in ("apex", "paddle", "home", "calm"):
        np.testing.assert_allclose(best[name], weights[name].weight, rtol=1e-4)
    assert best.keys() == set(task.term_names(type(CONFIG.reward)))
    np.testing.assert_allclose(rewards_at(seconds, shift=0.03)["apex"], 3.0, rtol=1e-3)
    np.testing.assert_allclose(rewards_at(seconds, lift=0.1)["apex"], 3.0, rtol=1e-3)
    assert rewards_at(seconds, shift=0.5)["apex"] < 0.03


def apex_metrics(ball: tuple[float, float, float]) -> task.TaskStep:
    truth = truth_of(jnp.array(ball), jnp.array([0.3, 0.0, -0.01]), jnp.array(CONFIG.home))
    step = task.Step(truth, goal(), jnp.zeros(6), jnp.zeros(6))
    return TRACK.step(jnp.array(True), step)


def test_an_apex_is_measured_against_the_point_now() -> None:
    done = apex_metrics((0.63, 0.14, 0.56))
    assert done.metrics["apexes"] and not done.ended
    np.testing.assert_allclose(done.metrics["error"], 0.05, rtol=1e-4)
    np.testing.assert_allclose(done.metrics["height_error"], 0.06, rtol=1e-4)
    assert apex_metrics((0.6, 0.1, 1.25)).ended and apex_metrics((0.6, 0.1, 0.04)).ended


def figures(moments: list[tuple[dict, float, float, float]]) -> task.Episodes:
    """One episode with an apex for each: its goals, error, height error, seconds."""
    tallies = []
    for now, error, height, seconds in moments:
        metrics = {"apexes": 1.0, "error": error, "height_error": height}
        moment = task.Moment(None, now, None, metrics, jnp.array(seconds), jnp.array(seconds))
        tallies.append(TRACK.tally(moment))

    def rows(kind: str) -> dict[str, np.ndarray]:
        found = [getattr(tally, kind) for tally in tallies]
        return {name: np.array([float(one[name]) for one in found]) for name in found[0]}

    lasted = np.ones(len(moments), bool)
    return task.Episodes(rows("sums"), rows("maxima"), lasted, {})


def test_results_judge_apexes_by_path_and_speed() -> None:
    """Apexes of the first 2 s, and of the first second after a step, do not count."""
    slow, fast, between = (goal(0, speed) for speed in (0.1, 0.3, 0.2))
    moments = [(slow, 0.01, 0.0, 5.0), (slow, 0.02, 0.0, 5.0), (slow, 1.0, 1.0, 1.9)]
    moments += [(fast, 0.05, 0.2, 5.0), (between, 1.0, 0.0, 5.0)]
    for corner, error in ((0.2, 1.0), (0.3, 0.02), (0.9, 0.04)):
        moments += [(goal(3, 0.3, phase=corner / 6.0), error, 0.0, 9.0)]
    found = {result.name: result for result in TRACK.results(figures(moments))}
    np.testing.assert_allclose(found["slow error"].value, np.sqrt(2.5), rtol=1e-5)
    np.testing.assert_allclose(found["fast error"].value, 5.0, rtol=1e-5)
    assert found["after steps"].value == 50.0
    np.testing.assert_allclose(found["height"].value, 600 / 7)
    assert not any(found[name].passed for name in ("slow error", "fast error", "after steps"))
    assert found["stable"].passed
    only_slow = {r.name: r.passed for r in TRACK.results(figures([(slow, 0.015, 0.0, 5.0)]))}
    assert only_slow == {
        "after steps": None, "slow error": True, "fast error": None, "height": True, "stable": True
    }  # fmt: skip
    # Nothing was measured, although the path and the speed are judged.
    assert TRACK.results(figures([(slow, 0.0, 0.0, 1.0)]))[1].passed is False


def test_the_margin_of_a_root_mean_square_is_that_of_the_mean_square() -> None:
    squares, events = np.array([1.0, 2.0, 6.0, 3.0]), np.array([1.0, 1.0, 2.0, 1.0])
    root = task.root_mean_square("", "", squares, events, 1.6)
    mean = task.mean_of_events("", "", squares, events, (0.0, 1.6**2))
    assert root.value == pytest.approx(np.sqrt(12 / 5)) and root.margin == mean.margin
    assert 0.0 < root.margin < 1.0 and root.passed
    assert not task.root_mean_square("", "", squares, events, 1.5).passed
