"""The benchmarks: figures of the ranking; the arm as URDF and the delays in other simulators."""

import copy
import importlib
import re
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bounce_mjx import load_policy
from bounce_mjx.env.env import Env
from bounce_mjx.evaluation.robustness import ConditionOutcome
from bounce_mjx.resources import POLICIES, resource_path
from bounce_mjx.runs.config import load_run_config


def script(name: str):
    """A fixture: the module of a benchmark."""

    @pytest.fixture(name=name)
    def module(monkeypatch):
        monkeypatch.syspath_prepend(str(Path(__file__).parent.parent / "benchmarks"))
        return importlib.import_module(name)

    return module


NAMES = ("endless", "identify", "physics", "rank", "simulators")
endless, identify, physics, rank, simulators = map(script, NAMES)


def outcome(name: str, strength: float, lasted: float) -> ConditionOutcome:
    return ConditionOutcome(
        perturbation=name, group="", unit="", strength=strength, trained=False, physics="fused",
        values={"stable": 100.0 * lasted}, failed=[], lasted=lasted, mean_length_s=1.0,
    )  # fmt: skip


def test_a_limit_ends_before_the_first_failure(rank) -> None:
    rows = [outcome("late", s, x) for s, x in ((10, 1.0), (20, 0.99), (30, 0.98), (40, 1.0))]
    assert rank.largest_stable([*rows, outcome("push", 5, 0.0)], "late") == 20
    assert rank.largest_stable(rows[2:], "late") == 0.0


def test_the_interval_is_that_of_the_mean(rank) -> None:
    values = np.random.default_rng(1).normal(5.0, 2.0, 40)
    found = rank.interval(list(values), ".3f")
    mean, low, high = map(float, re.findall(r"[\d.]+", found))
    half = 1.96 * values.std(ddof=1) / np.sqrt(40)
    assert mean == pytest.approx(values.mean(), abs=1e-3)
    np.testing.assert_allclose([low, high], [mean - half, mean + half], atol=0.15 * half)
    assert rank.interval([None], ".1f") == "-" and rank.interval([2.0, 2.0], ".1f") == "2.0"


def test_one_world_spans_all_conditions_without_an_end(endless) -> None:
    config = load_run_config(resource_path(POLICIES["robust"])).env
    suite = Path(endless.__file__).with_name("endless.yaml")
    nominal, *conditions = endless.load_suite(suite, config)
    world = endless.spanning_world([nominal, *conditions])
    assert nominal.ranges.keys() == config.commands.keys()
    for condition in conditions:
        for name in condition.ranges.keys() - config.commands.keys():
            low, high = getattr(world.randomization, name)
            for end in (*condition.range(name), *nominal.range(name)):
                assert np.all(low <= end) and np.all(end <= high), (condition, name)
    heavy = next(c for c in conditions if c.perturbation.name == "ball of 5 g")
    factor, _ = heavy.range("ball_mass")
    assert factor * config.robot.ball.mass == pytest.approx(0.005, rel=1e-3)


@pytest.mark.parametrize("policy", ["pretrained", "ur5e"])
def test_the_urdf_is_the_models_arm(simulators, policy: str) -> None:
    """MuJoCo's own reader finds the paddle where the model has it, and the same inertia."""
    model = Env(load_run_config(resource_path(POLICIES[policy])).env).mj_model
    parts, addresses = simulators.make_parts(model), simulators.find_addresses(model)
    urdf = mujoco.MjModel.from_xml_string(parts.urdf)
    mine, theirs = mujoco.MjData(model), mujoco.MjData(urdf)
    angles = np.random.default_rng(0).uniform(-2.0, 2.0, len(parts.links))
    mine.qpos[list(addresses.arm_qpos)] = theirs.qpos[:] = angles
    inertias = []
    for of, data in ((model, mine), (urdf, theirs)):
        mujoco.mj_forward(of, data)
        inertias.append(np.zeros((of.nv, of.nv)))
        mujoco.mj_fullM(of, data, inertias[-1])
    arm = list(addresses.arm_qvel)
    expected = inertias[0][np.ix_(arm, arm)] - np.diag(parts.armature)
    np.testing.assert_allclose(inertias[1], expected, atol=1e-6)
    paddle = addresses.paddle_geom
    geared = copy.copy(model)
    geared.actuator_gear[0, 0] = 2.0
    with pytest.raises(ValueError, match="gears"):
        simulators.make_parts(geared)
    assert urdf.ngeom == 1
    np.testing.assert_allclose(theirs.geom_xpos[0], mine.geom_xpos[paddle], atol=1e-6)
    np.testing.assert_allclose(theirs.geom_xmat[0], mine.geom_xmat[paddle], atol=1e-6)
    np.testing.assert_allclose(urdf.geom_size[0], model.geom_size[paddle], atol=1e-9)


@pytest.mark.parametrize("timestep, steps", [(0.001, 240), (1.0 / 240.0, 58)])
def test_commands_and_pictures_are_late(simulators, timestep: float, steps: int) -> None:
    sent, seen = [], []
    targets = np.zeros(6)
    simulator = simulators.Simulator(
        lambda *_: None,
        lambda: (home, np.zeros(6)),
        lambda: np.full((1, 9), float(len(sent))),
        lambda angles: np.copyto(targets, angles),
        lambda: sent.append(targets.copy()),
        lambda: None,
    )
    policy = load_policy("pretrained")
    home = np.array(policy.metadata.default_joint_angles)
    world = simulators.World(action_latency=0.02, ball_latency=0.03, timestep=timestep)
    episode = simulators.Episode(policy, simulator, world)
    episode.reset(home, np.zeros((1, 3)), np.zeros((1, 3)))
    for number in range(24):
        seen.append(episode.measure())
        episode.run(np.full((10, 6), float(number + 1)))
    # 24 control steps of 10 ms; a time step belongs to the control step in which it begins.
    assert len(sent) == steps
    started = np.arange(steps) * timestep
    expected = np.maximum(np.floor((started - 0.02) / 0.01 + 1e-6) + 1.0, 0.0)
    np.testing.assert_array_equal(np.array(sent)[:, 0], np.where(expected, expected, home[0]))
    assert [x["ball_age"] for x in seen[:5]] == pytest.approx([0.0, 0.01, 0.02, 0.03, 0.03])
    begun = round(0.2 / timestep)
    assert seen[23]["ball_position"][0, 0] == begun


@pytest.mark.parametrize("num_found, told", [((0, 3), "2 (40.00%)"), ((0, 0), "5 (100.00%)")])
def test_episodes_in_which_no_ball_was_seen_are_told(monkeypatch, capsys, num_found, told) -> None:
    pytest.importorskip("cv2")
    monkeypatch.syspath_prepend(str(Path(__file__).parent.parent / "benchmarks"))
    cameras = importlib.import_module("cameras")
    played = [
        cameras.Played(
            qpos=np.zeros((2, 13)),
            qvel=np.zeros((2, 12)),
            alarm="",
            calibration="",
            num_pairs=num_pairs,
            errors=np.full((found, 3), 0.001),
            heights=np.full(found, 0.2),
            tracking_times=np.full(num_pairs, 0.002),
        )
        for num_pairs, found in zip((2, 3), num_found, strict=True)
    ]
    cameras.print_seeing(played)
    printed = capsys.readouterr().out
    assert f"5 pairs, {told} without a ball" in printed
    assert ("off by 1.00, 1.00, 1.00 mm" in printed) == any(num_found)


def test_logs_are_of_one_case_and_do_not_overwrite(simulators, monkeypatch, capsys, tmp_path):
    def refusal(*words: str) -> str:
        monkeypatch.setattr(sys, "argv", ["simulators.py", *words, "--logs", str(tmp_path)])
        with pytest.raises(SystemExit):
            simulators.main()
        return capsys.readouterr().err

    one_world = ("--simulators", "mujoco", "--worlds", "nominal")
    assert "one policy in one simulator and world" in refusal("robust", "pretrained", *one_world)
    assert "one policy in one simulator and world" in refusal("robust", *one_world[:2])
    (tmp_path / "ball.csv").touch()
    assert "ball.csv exists; give --logs another folder" in refusal("robust", *one_world)


def test_a_log_is_used_again_for_the_same_robot_alone(identify, monkeypatch, tmp_path) -> None:
    config = load_run_config(resource_path(POLICIES["robust"])).env
    finer = config.model_copy(update={"physics_dt": 5e-4})
    recorded = []

    def record(config, hidden, seed: int, path: Path) -> None:
        path.write_text("time [s]")
        recorded.append((config.physics_dt, hidden.flaw))
        if len(recorded) == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(identify, "record", record)
    flawed = identify.Hidden(world={}, flaw="backlash")
    flawless = identify.Hidden(world={}, flaw="nothing")
    with pytest.raises(KeyboardInterrupt):
        identify.log_in(tmp_path, config, flawed, 1001)
    cases = [(config, flawed), (config, flawless), (finer, flawless), (config, flawed)]
    paths = [identify.log_in(tmp_path, world, hidden, 1001) for world, hidden in cases]
    # The interrupted one is recorded again, and the last one is there.
    assert recorded[1:] == [(0.001, "backlash"), (0.001, "nothing"), (0.0005, "nothing")]
    assert paths[3] == paths[0] and len(set(paths)) == 3 and all(p.exists() for p in paths)


def test_fused_is_compared_with_the_engines_of_the_same_task(physics) -> None:
    def row(task: str, engine: str, speed: float) -> dict:
        record = {"batch": 64, "task": task, "engine": engine, "compile_seconds": 0.0}
        return record | {"steps_per_second": speed, "median_steps_per_second": speed}

    one_task = [row("bounce", "fused", 6e6), row("bounce", "c", 2e6)]
    other_task = [row("juggle", "fused", 5e6), row("juggle", "c", 1e6)]
    lines = physics.table(one_task + other_task).splitlines()[2:]
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]
    assert [row[1] for row in cells] == ["fused, bounce", "c, bounce", "fused, juggle", "c, juggle"]
    assert [row[-1] for row in cells] == ["", "3", "", "5"]
    assert physics.table(one_task).splitlines()[3].split("|")[2].strip() == "c"
