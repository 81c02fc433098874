"""The viewers' simulation: its frames, goals, pushes, worlds, clock and markers."""

import itertools
import re
import time
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import viewing
from bounce_mjx import BounceBall, EnvConfig
from bounce_mjx.errors import UserError
from bounce_mjx.learning.policy import make_networks
from bounce_mjx.resources import resource_path
from bounce_mjx.runs.checkpoints import read_policy
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.runs.folders import find_checkpoint
from bounce_mjx.task.bounce import Config as BounceConfig
from bounce_mjx.task.bounce_rewards import Rewards
from bounce_mjx.viewers import page, show
from bounce_mjx.viewers.controls import direction
from bounce_mjx.viewers.display import Display, camera_pose, marker_body
from bounce_mjx.viewers.options import ViewerOptions
from bounce_mjx.viewers.scene import _grid as scene_grid
from bounce_mjx.viewers.simulation import (
    EnvFrame,
    Simulation,
    at_index,
    frame_at,
    in_real_time,
    make_policy_controller,
)
from bounce_mjx.viewers.world import SLIDERS, reset_ranges, sliders_for, with_sliders
from bounce_mjx.world.randomization import RandomizationConfig
from viewing import (
    GRAVITY,
    INFINITY,
    NAN,
    SECONDS,
    LeanConfig,
    StillConfig,
    at_height,
    served,
    target_of,
    wait_until,
    watch,
)


@pytest.fixture(scope="module")
def mirrored() -> Simulation:
    return viewing.mirrored()


@pytest.fixture(scope="module")
def env(mirrored: Simulation) -> BounceBall:
    return mirrored.env


@pytest.fixture(scope="module")
def recording(mirrored: Simulation) -> EnvFrame:
    """A recording from a reset that is one step longer than an episode."""
    mirrored.reset()
    return mirrored.record(SECONDS + mirrored.env.dt)


def test_frames_describe_one_state(env: BounceBall, recording: EnvFrame) -> None:
    """MuJoCo's kinematics find the ball and the paddle where the frame has them."""
    display = Display(env)
    for step in (0, 57, 123):
        for i in range(2):
            display.pose(recording.qpos[step, i], at_index(frame_at(recording, step).goal, i))
            geom = display.data.geom
            np.testing.assert_allclose(geom("ball").xpos, recording.balls[step, i, 0], atol=1e-6)
            np.testing.assert_allclose(geom("blocker").xpos, recording.paddle[step, i], atol=1e-5)
    assert np.all(recording.qpos[0, 0, :6] != recording.qpos[0, 1, :6])


def test_time_runs_until_the_episode_ends(recording: EnvFrame, env: BounceBall) -> None:
    steps = round(SECONDS / env.dt)
    np.testing.assert_allclose(recording.time[: steps + 1, 0], np.arange(steps + 1) * env.dt)
    np.testing.assert_array_equal(np.flatnonzero(recording.over[:, 0]), [steps])
    np.testing.assert_allclose(recording.time[steps + 1], env.dt)
    start = np.asarray(env.config.ball_init_pos)
    distance = np.abs(recording.balls[steps + 1, :, 0] - start)
    assert np.all(distance < env.config.reset.ball_position + 0.001)
    assert np.all(recording.metrics["n_bounces"][steps + 1] == 0)


def test_the_target_height_can_be_set_and_stays(mirrored: Simulation) -> None:
    """It is seen before the next step, as while the page is paused, and after a reset."""
    mirrored.reset()
    drawn = target_of(mirrored.frame)
    mirrored.goal = at_height(0.77)
    assert np.all(drawn != np.float32(0.77))
    for advance in (lambda: None, mirrored.step, mirrored.reset, mirrored.step):
        advance()
        np.testing.assert_allclose(target_of(mirrored.frame), 0.77)
    mirrored.goal = {}
    mirrored.reset()
    low, high = mirrored.env.config.target_height_range
    target = target_of(mirrored.step())
    assert np.all((target >= low) & (target <= high))


def test_an_exchanged_policy_acts(env: BounceBall) -> None:
    exchangeable = viewing.exchangeable()
    before = exchangeable.frame.qpos[0, :6]
    np.testing.assert_allclose(exchangeable.record(0.1).qpos[-1, 0, :6], before, atol=0.01)
    exchangeable.policy = np.float32(1.0)
    moved = exchangeable.record(0.1).qpos[-1, 0, :6] - before
    # The target of a servo is ahead of its joint by the scale of an action.
    assert np.all(moved > 0.5 * env.config.action_scale)


def test_a_push_adds_its_velocity_to_the_ball_once(mirrored: Simulation) -> None:
    steps, push = 5, np.array([0.2, -0.1, 0.3])
    mirrored.reset()
    start = mirrored.frame.balls[:, 0]
    mirrored.push(tuple(push))
    for _ in range(steps):
        mirrored.step()
    flight = steps * mirrored.env.dt
    # The sum of a semi-implicit integrator's steps, in place of g t^2 / 2.
    fall = 0.5 * GRAVITY * flight * (flight + mirrored.env.config.physics_dt)
    expected = start + push * flight - np.array([0.0, 0.0, fall])
    np.testing.assert_allclose(mirrored.frame.balls[:, 0], expected, atol=1e-5)


def test_steps_become_due_with_the_clock(mirrored: Simulation, monkeypatch) -> None:
    now, speed = 0.0, 0.5
    monkeypatch.setattr(time, "monotonic", lambda: now)
    monkeypatch.setattr(time, "sleep", lambda _: None)
    clock = in_real_time(mirrored, 0.65, lambda: speed)
    assert not next(clock)
    steps = []
    for _ in range(60):
        now += 1.0 / 60.0
        steps.append(len(next(clock)))
    assert sum(steps) in (49, 50)
    assert max(steps) == 1
    now, speed = now + 100.0, 0.0
    assert not next(clock)
    now, speed = now + 100.0, 1.0  # a machine that slept
    steps.append(len(next(clock)))
    assert 9 <= steps[-1] <= 11
    now += 100.0
    steps.append(len(next(clock)))
    assert sum(steps) == 65 and next(clock, None) is None


def test_policies_of_different_tasks_are_not_shown_together() -> None:
    shown = [show.Shown(config(), None, "") for config in (LeanConfig, StillConfig)]
    options = ViewerOptions(viewer="browser")
    with pytest.raises(UserError, match="different tasks; show one at a time"):
        show.show(shown, options, goals={}, console=Console())


NOMINAL = {slider.term: slider.world_value(slider.nominal) for slider in SLIDERS}


def test_a_slider_reaches_every_value_that_a_reset_samples() -> None:
    own = RandomizationConfig(action_latency=(0.0, 0.08), paddle_tilt=((-0.1, 0.0), (0.02, 0.2)))
    config = with_sliders(BounceConfig(randomization=own))
    spans = {slider.term: slider.span for slider in sliders_for(config)}
    assert spans["action_latency"] == pytest.approx((0.0, 0.08))
    assert spans["paddle_tilt"] == pytest.approx((-0.1, 0.2))
    assert spans["restitution"] == (0.6, 0.98)


def test_another_model_has_no_slider_for_a_restitution() -> None:
    """Its nominal one is unknown, whatever its own randomisation says."""
    own = RandomizationConfig(restitution=(0.5, 0.98))
    config = BounceConfig(mjcf=Path("scene.xml"), randomization=own)
    terms = {slider.term for slider in sliders_for(with_sliders(config))}
    assert terms == {slider.term for slider in SLIDERS} - {"restitution"}


@pytest.mark.slow
@pytest.mark.usefixtures("quick_compilation")
def test_a_moved_slider_changes_the_world_at_once(monkeypatch) -> None:
    """Of the nominal policy, in worlds whose ball mass is drawn."""
    checkpoint = find_checkpoint("pretrained")
    run = load_run_config(checkpoint.run)
    config = run.env.model_copy(
        update={"randomization": RandomizationConfig(ball_mass=(0.8, 0.95))}
    )
    env = BounceBall(with_sliders(config))
    networks = make_networks(run.ppo, env.observation_size, env.action_size)
    controller, policy = make_policy_controller(networks), read_policy(checkpoint, run)
    played = Simulation(env, controller, 2, 0, reset_ranges(config), policy)
    frames, worlds = [], []
    watch(monkeypatch, Simulation, "step", lambda simulation: frames.append(simulation.frame))
    watch(monkeypatch, Simulation, "step", lambda simulation: worlds.append(simulation.world))
    played.world = None
    played.reset()
    with served(played, monkeypatch) as client:
        wait_until(lambda: len(frames) > 100)
        assert worlds[-1] is None and not any(frame.over.any() for frame in frames)
        client.set(client.control("action delay, ms"), 30)
        wait_until(lambda: worlds[-1] == NOMINAL | {"action_latency": (0.03,)})
        wait_until(lambda: any(frame.over.any() for frame in frames))
        for value in (1e9, -1e9, NAN, INFINITY, "much", [1], None):
            client.set(client.control("restitution"), value)
        assert {world["restitution"] for world in worlds if world} == {(0.85,)}
        client.set(client.control("make the world nominal"), True)
        wait_until(lambda: worlds[-1] == NOMINAL)


def marker_position(display: Display, name: str) -> np.ndarray:
    return display.data.body(marker_body(name)).xpos


def test_markers_are_at_the_positions_of_the_task() -> None:
    config = EnvConfig(reward=Rewards(paddle_home_height=0.15))
    display = Display(env := BounceBall(config))
    display.pose(env.mj_model.qpos0, at_height(0.61))
    x, y = config.reward.target_x, config.reward.target_y
    np.testing.assert_allclose(marker_position(display, "target_height"), (x, y, 0.61))
    np.testing.assert_allclose(marker_position(display, "paddle_home"), (x, y, 0.15))


def test_a_model_without_markers_gets_them(tmp_path: Path) -> None:
    text = resource_path("mjcf/bounce_ball.xml").read_text(encoding="utf-8")
    bare = tmp_path / "bare.xml"
    bare.write_text(re.sub(r"<site [^>]*/>", "", text), encoding="utf-8")
    env = BounceBall(EnvConfig(mjcf=bare))
    assert env.mj_model.nsite == 0
    display = Display(env)
    display.pose(env.mj_model.qpos0, at_height(0.5))
    assert marker_position(display, "target_height")[2] == 0.5
    home_height = env.config.reward.paddle_home_height
    assert marker_position(display, "paddle_home")[2] == pytest.approx(home_height)


def projected(points: np.ndarray, focus, aspect: float, offsets, zoom=1.0) -> np.ndarray:
    """Points [N, 3] in the picture [N, 2]: -1 to 1 from left to right and from below."""
    position, gaze = camera_pose(offsets, focus, aspect, zoom)
    forward = (gaze - position) / np.linalg.norm(gaze - position)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    seen = (points - position) @ np.stack([right, np.cross(right, forward), forward]).T
    return seen[:, :2] / seen[:, 2:] / np.tan(np.radians(20.0)) / (aspect, 1.0)


ASPECTS = (0.46, 0.85, 2.0)
"""Width / height of a picture."""


HOMES = ((0.58856, 0.0, 0.05), (0.67, 0.0, 0.4), (0.0, 0.55, 0.25), (-0.6, 0.0, 0.3))


def test_on_a_phone_the_panel_leaves_the_arm_and_the_ball_visible() -> None:
    """It covers the lower three fifths."""
    home = np.array(HOMES[0])
    parts = np.array([(-0.1, 0.0, 0.0), home + (0.05, 0.0, 0.0), home + (0.0, 0.0, 0.8)])
    points = projected(parts, home, 390 / 844, np.zeros((1, 3)))
    assert np.all(np.abs(points[:, 0]) < 1.0)
    assert np.all((points[:, 1] > 0.2) & (points[:, 1] < 1.0))


@pytest.mark.parametrize("home", HOMES, ids=["default", "raised", "turned", "behind"])
def test_the_camera_sees_every_robot(home) -> None:
    """Base, paddle, and the ball at the highest target."""
    x, y, z = home
    paddle = np.array([x, y, 0.0]) * (1.0 + 0.05 / np.hypot(x, y)) + (0.0, 0.0, z)
    parts = np.array([(-0.1, 0.0, 0.0), paddle, (x, y, z + 0.8)])
    for number, aspect in itertools.product((1, 2, 4, 16), ASPECTS):
        offsets = scene_grid(number)
        points = (offsets[:, None] + parts).reshape(-1, 3)
        assert np.all(np.abs(projected(points, np.array(home), aspect, offsets)) < 1.0)


VIEWS = {
    # From the default camera, the arm's side (-x, +y) is away.
    "default": ((-1.06, 1.17, -0.42), "right", (1.17, 1.06, 0.0)),
    "from behind the arm": ((1.0, 0.0, -0.3), "left", (0.0, 1.0, 0.0)),
    "from the front": ((-1.0, 0.0, -0.3), "left", (0.0, -1.0, 0.0)),
    "from above": ((0.0, 0.0, -1.0), "away", (1.0, 0.0, 0.0)),
    "any": ((0.0, 2.0, 0.0), "back", (0.0, -1.0, 0.0)),
    "no number": ((NAN, 0.0, 0.0), "up", (0.0, 0.0, 1.0)),
}


@pytest.mark.parametrize("case", VIEWS.values(), ids=VIEWS)
def test_pushes_follow_the_camera(case) -> None:
    view, towards, expected = case
    expected = np.array(expected) / np.linalg.norm(expected)
    np.testing.assert_allclose(direction(towards, np.array(view)), expected, atol=1e-12)


@pytest.mark.parametrize("lasted", [True, False])
def test_a_film_and_a_report_tell_a_failure_in_the_last_step_of_an_episode(
    lasted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulation = viewing.mirrored()
    expected = [False, False, not lasted]
    film = viewing.film_of(simulation, 3, lasted)
    assert film.frames.lost[:, 0].tolist() == expected
    replayed = []
    monkeypatch.setattr(page, "replay", lambda _, frames, **__: replayed.append(frames))
    page.replay_first_and_worst(simulation.env, viewing.recording_of(simulation, 3, lasted))
    assert replayed[0].lost[:, 0].tolist() == expected
