"""`play --log`: a robot of a known world, beside its simulation in that world and in another."""

import runpy
from pathlib import Path

import numpy as np
import pytest
import yaml

from bounce_mjx.commands.main import main
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.identify.log import Log, read_csv
from bounce_mjx.identify.replay import Replay, replay_log
from bounce_mjx.robot.model import find_addresses
from bounce_mjx.runs.config import read_preset
from bounce_mjx.viewers.comparison import recording
from bounce_mjx.viewers.simulation import resample

BENCHMARK = Path(__file__).parent.parent / "benchmarks" / "identify.py"
WORLD = {"action_latency": 0.02, "ball_latency": 0.01, "restitution": 0.8, "servo_lag": 0.005}


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


def replayed(log_file: Path, world: Path) -> Replay:
    config = read_preset(Path("default"), world=world).env
    return replay_log(config, read_csv(log_file, [f"Joint{i}" for i in range(1, 7)]))


def distances(found: Replay) -> tuple[float, float]:
    """Root mean square of the angles' (rad) and of the balls' (m) distances."""
    return tuple(
        float(np.sqrt(np.nanmean((x[:, 0] - x[:, 1]) ** 2))) for x in (found.angles, found.balls)
    )


@pytest.mark.slow
def test_the_world_of_the_robot_is_closest_to_its_log(log_file: Path, tmp_path: Path) -> None:
    found = replayed(log_file, world_file(tmp_path))
    angles, balls = distances(found)
    # The sensors' noise is 1 mrad and 2 mm; the ball leaves a paddle's bounce a little differently.
    assert angles < 1.5e-3 and balls < 8e-3
    late = distances(replayed(log_file, world_file(tmp_path, action_latency=0.05)))
    assert late[0] > 3.0 * angles and late[1] > 1.2 * balls
    dull = distances(replayed(log_file, world_file(tmp_path, restitution=0.7)))
    assert dull[1] > 2.0 * balls
    seen = ~np.isnan(found.balls[..., 0])
    assert np.sum(seen[:, 0]) > 150 and np.mean(seen[seen[:, 0], 1]) > 0.7
    assert not np.any(seen[~seen[:, 0], 1])


@pytest.mark.slow
def test_command_writes_the_page(log_file: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    world = world_file(tmp_path)
    monkeypatch.chdir(tmp_path)
    main(["play", "--log", str(log_file), "--world", str(world), "--seconds", "2.5"])
    assert "written: run.html" in capsys.readouterr().out
    assert "<title>bounce_mjx</title>" in (tmp_path / "run.html").read_text(encoding="utf-8")


def test_a_ball_that_vanishes_is_under_the_floor_and_draws_no_line() -> None:
    config = read_preset(Path("default")).env
    env, count = Env(config), 40
    balls = np.full((count, 2, 3), (0.6, 0.0, 0.3))
    balls[10:20, 0] = np.nan
    angles = np.random.default_rng(0).normal(size=(count, 2, 6))
    frames = recording(env, Replay(env.dt * np.arange(count), angles, balls), {})
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
    short = log._replace(times=times[:40], joint_angles=sway[:40])
    with pytest.raises(UserError, match="no stretch of unbroken .*; record at least 5 s"):
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
