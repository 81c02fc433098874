"""`play --log`: a robot of a known world, next to its simulation in that world and in another."""

import runpy
from pathlib import Path

import numpy as np
import pytest
import yaml

from bounce_mjx.commands.main import main
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.identify.fit import _BOUNCE_DEVIATION
from bounce_mjx.identify.log import Log, read_csv
from bounce_mjx.identify.replay import Replay, replay_log
from bounce_mjx.identify.windows import _AFTER, _AFTER_SHARE
from bounce_mjx.robot.model import find_addresses
from bounce_mjx.runs.config import read_preset
from bounce_mjx.viewers.comparison import recording
from bounce_mjx.viewers.simulation import resample

BENCHMARK = Path(__file__).parent.parent / "benchmarks" / "identify.py"
WORLD = {"action_latency": 0.02, "ball_latency": 0.01, "restitution": 0.8, "servo_lag": 0.005}
NAMES = [f"Joint{i}" for i in range(1, 7)]
# Of the benchmark's robot, rad and m.
ANGLE_NOISE, BALL_NOISE = 1e-3, 2e-3


def world_file(folder: Path, **changes: float) -> Path:
    """A named world whose ranges have a width, and the known robot's terms in the middle."""
    ranges = {name: [x - 1e-3, x + 1e-3] for name, x in (WORLD | changes).items()}
    path = folder / f"world{len(list(folder.iterdir()))}.yaml"
    content = {"env": {"randomization": ranges}, "sources": {"randomization": "A test."}}
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def log_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a robot in WORLD on MuJoCo's C engine: 10 s of the arm, 8 s with the ball."""
    path = tmp_path_factory.mktemp("log") / "run.csv"
    benchmark = runpy.run_path(str(BENCHMARK))
    world = {name: np.float32(x) for name, x in WORLD.items()}
    record = benchmark["record"]
    record.__globals__["hidden_robot"] = lambda seed: benchmark["Hidden"](world, "nothing")
    record(read_preset(Path("default")).env, 1000, path, excited=10.0, played=8.0)
    return path


@pytest.fixture(scope="module")
def log(log_file: Path) -> Log:
    return read_csv(log_file, NAMES)


def replayed(log: Log, world: Path, **estimates) -> Replay:
    return replay_log(read_preset(Path("default"), world=world).env, log, estimates)


@pytest.fixture(scope="module")
def found(log: Log, tmp_path_factory: pytest.TempPathFactory) -> Replay:
    """The log next to its simulation in the robot's own world."""
    return replayed(log, world_file(tmp_path_factory.mktemp("world")))


@pytest.mark.slow
def test_in_the_world_of_the_robot_only_noise_and_scatter_remain(found: Replay) -> None:
    angles, ball = found.distances
    # The encoders' noise; the time stamps' jitter of 0.3 ms adds 0.2 mrad at 0.5 rad/s.
    assert 0.9 * ANGLE_NOISE < angles < 1.1 * ANGLE_NOISE
    # Two engines' bounces scatter, as a contact begins anywhere in a physics step. A share of
    # each flight is after a bounce, of which the next window cuts off the rest.
    scatter = np.mean(np.square(_BOUNCE_DEVIATION)) * _AFTER_SHARE * _AFTER**2 / 3.0
    # The mean square of 8 bounces or more is itself uncertain by a half: three times that.
    assert ball < np.sqrt(2.5 * (BALL_NOISE**2 + scatter))
    seen = ~np.isnan(found.balls[..., 0])
    assert np.sum(seen[:, 0]) > 150 and np.mean(seen[seen[:, 0], 1]) > 0.7
    assert not np.any(seen[~seen[:, 0], 1])


@pytest.mark.slow
def test_a_delay_shows_in_the_angles(log: Log, tmp_path: Path) -> None:
    late, _ = replayed(log, world_file(tmp_path, action_latency=0.05)).distances
    # What the joints move in 30 ms, three control steps, without the noise of both ends.
    moved = np.mean((log.joint_angles[3:] - log.joint_angles[:-3]) ** 2) - 2.0 * ANGLE_NOISE**2
    assert late == pytest.approx(np.sqrt(moved + ANGLE_NOISE**2), rel=0.15)


@pytest.mark.slow
def test_a_dull_paddle_shows_in_the_heights(log: Log, found: Replay, tmp_path: Path) -> None:
    dull = replayed(log, world_file(tmp_path, restitution=0.7))
    lower = np.nanmean(found.balls[:, 1, 2]) - np.nanmean(dull.balls[:, 1, 2])
    # A fall of 0.3 m ends at 2.4 m/s, of which a tenth is lost, for a share of the time.
    expected = 0.1 * 2.4 * _AFTER_SHARE * _AFTER / 2.0
    assert 0.5 * expected < lower < 2.0 * expected


@pytest.mark.slow
def test_estimates_of_each_joint_replace_the_middle(
    log: Log, found: Replay, tmp_path: Path
) -> None:
    """A robot whose encoders are off moves the same way: only what it measures and is sent differs,
    by as much."""
    bias = np.array([0.01, -0.02, 0.01, 0.0, 0.05, 0.03])
    biased = log._replace(
        joint_angles=log.joint_angles + bias, servo_targets=log.servo_targets + bias
    )
    world = world_file(tmp_path, action_latency=0.05)
    known = replayed(biased, world, action_latency=0.02, encoder_bias=tuple(bias))
    np.testing.assert_allclose(known.distances, found.distances, rtol=0.02)
    # A paddle that tilts by 0.05 rad sends a ball of 2.4 m/s aside with 0.24 m/s.
    _, ball = replayed(biased, world, action_latency=0.02).distances
    assert ball > 0.5 * 0.24 * _AFTER * np.sqrt(_AFTER_SHARE / 9.0)


@pytest.mark.slow
def test_command_writes_the_page(log_file: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    world = world_file(tmp_path)
    monkeypatch.chdir(tmp_path)
    main(["play", "--log", str(log_file), "--world", str(world), "--seconds", "2.5"])
    assert "written: run_replay.html" in capsys.readouterr().out
    assert "<title>bounce_mjx</title>" in (tmp_path / "run_replay.html").read_text(encoding="utf-8")


def test_a_ball_that_vanishes_is_under_the_floor_and_draws_no_line() -> None:
    config = read_preset(Path("default")).env
    env, count = Env(config), 40
    balls = np.full((count, 2, 3), (0.6, 0.0, 0.3))
    balls[10:20, 0] = np.nan
    angles = np.random.default_rng(0).normal(size=(count, 2, 6))
    frames = recording(env, Replay(angles, balls), {})
    addresses = find_addresses(env.mj_model)
    np.testing.assert_array_equal(frames.qpos[..., list(addresses.arm_qpos)], angles)
    heights = frames.balls[:, 0, 0, 2]
    assert np.all(heights[10:20] < -1.0) and np.all(frames.ball[:, 1, 2] == 0.3)
    # A viewer's line starts again where the time goes back.
    assert list(np.flatnonzero(np.diff(frames.time[:, 0]) < 0.0) + 1) == [10, 20]
    assert np.all(np.diff(frames.time[:, 1]) > 0.0)
    between = resample(frames, env.dt, 1000.0).balls[:, 0, 0, 2]
    assert set(np.unique(between)) == set(np.unique(heights))


@pytest.mark.slow
def test_a_log_without_pictures_shows_the_arm_alone() -> None:
    times = np.arange(0.0, 4.0, 0.01)
    pose = np.array(read_preset(Path("default")).env.default_joint_angles)
    sway = pose + 0.02 * np.sin(2.0 * times[:, None])
    nothing = np.zeros(0)
    log = Log("here", times, sway, times, sway, nothing, np.zeros((0, 3)), nothing)
    found = replay_log(read_preset(Path("default")).env, log, seconds=1.0)
    assert found.angles.shape == (101, 2, 6) and np.all(np.isnan(found.balls))
    # The servos of the simulation follow their targets 10 ms later, at up to 0.04 rad/s.
    assert 1e-5 < np.max(np.abs(found.angles[50:, 0] - found.angles[50:, 1])) < 5e-3
    with pytest.raises(UserError, match="have 5 numbers for encoder_bias, and the robot has 6"):
        replay_log(read_preset(Path("default")).env, log, {"encoder_bias": (0.0,) * 5})
    short = log._replace(times=times[:40], joint_angles=sway[:40])
    with pytest.raises(UserError, match="has 0 stretches of unbroken .*; record at least 5 s"):
        replay_log(read_preset(Path("default")).env, short)


@pytest.mark.parametrize(
    "args, sentence",
    [
        (["latest"], "a checkpoint cannot be combined with it; omit one"),
        (["--video", "a.mp4"], "--video cannot be combined with it; omit one"),
        (["--viewer", "browser"], "--viewer cannot be combined with it; omit one"),
        (["--actions", "mirror", "--task", "track"], "--actions and --task cannot"),
        (["--html", "a.txt"], "--html a.txt does not end in .html"),
        ([], "the log nowhere.csv is not a file"),
    ],
)
def test_command_refuses(args, sentence, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(["play", *args, "--log", "nowhere.csv"])
    error = capsys.readouterr().err
    assert end.value.code == 2 and sentence in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())
