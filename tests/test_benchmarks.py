"""The benchmarks: figures of the ranking; the arm as URDF and the delays in other simulators."""

import copy
import importlib
import json
import re
import subprocess
import sys
import types
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bounce_mjx import load_policy
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.robustness import ConditionOutcome
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.resources import POLICIES, resource_path
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.runs.layers import read_preset


def script(name: str):
    """A fixture: the module of a benchmark."""

    @pytest.fixture(name=name)
    def module(monkeypatch):
        monkeypatch.syspath_prepend(str(BENCHMARKS))
        return importlib.import_module(name)

    return module


BENCHMARKS = Path(__file__).parent.parent / "benchmarks"
PACKAGE = "src/bounce_mjx"
NAMES = ("endless", "identify", "physics", "rank", "simulators")
endless, identify, physics, rank, simulators = map(script, NAMES)
figures, jax_vs_torch, start, sweep = map(script, ("figures", "jax_vs_torch", "start", "sweep"))


def outcome(name: str, strength: float, lasted: float) -> ConditionOutcome:
    return ConditionOutcome(
        perturbation=name, group="", unit="", strength=strength, trained=False, physics="fused",
        values={"stable": 100.0 * lasted}, failed=[], lasted=lasted, mean_length_s=1.0,
    )  # fmt: skip


TRAINERS = {
    "brax_trainer.py": ("learning/policy.py", "adapters/brax/ppo.py"),
    "rsl_rl_learner.py": ("torch_networks.py", "adapters/torch/rsl_rl_env.py"),
    "skrl_learner.py": ("torch_networks.py", "adapters/torch/skrl_env.py"),
}
"""The PPO trainers of `jax_vs_torch.py`, and what else reads settings for them."""


@pytest.mark.parametrize("trainer", TRAINERS)
def test_a_trainer_has_each_setting_or_its_table_says_how_it_differs(trainer: str) -> None:
    """A setting of which neither holds is another one in silence."""
    page, code = (BENCHMARKS / trainer).read_text(encoding="utf-8").split('"""', 2)[1:]
    for name in TRAINERS[trainer]:
        folder = BENCHMARKS if (BENCHMARKS / name).is_file() else BENCHMARKS.parent / PACKAGE
        code += (folder / name).read_text(encoding="utf-8")
    listed = " ".join(row.split("|")[1] for row in page.splitlines() if row.startswith("|"))
    for setting in PPOConfig.model_fields:
        is_read = re.search(rf"\b(config|ppo)\.{setting}\b", code)
        assert is_read or re.search(rf"\b{setting}\b", listed), setting


def evaluations(run: str, blocks: list[float], **values) -> list[dict]:
    """The records of a run with an evaluation after each block."""
    method, seed, _ = run.split("-")
    begun = {"run": run, "method": method, "seed": int(seed)}
    measured = {
        "device": "CPU", "num_envs": 64, "total_steps": len(blocks), "process_seconds": 1.0,
        "passed": False, "return": 5.0,
    } | values  # fmt: skip
    records = [
        begun | measured | {"steps": step, "block_seconds": seconds}
        for step, seconds in enumerate(blocks, start=1)
    ]
    return [begun, *records]


def test_a_run_replaces_the_earlier_one_also_where_it_fails(jax_vs_torch) -> None:
    ours = evaluations("ours-0-2.0", [1.0])
    records = [*evaluations("brax-0-1.0", [1.0]), *evaluations("brax-0-3.0", []), *ours]
    assert list(jax_vs_torch.newest_runs(records)) == [("ours", 0)]
    later = evaluations("brax-0-4.0", [1.0, 1.0])
    runs = jax_vs_torch.newest_runs([*later, *records])
    assert [record["steps"] for record in runs["brax", 0]] == [1, 2]


def test_the_training_clock_is_without_what_the_first_blocks_compile(jax_vs_torch) -> None:
    """Two files with the same records are those of one run."""
    records = evaluations("skrl-1-1.0", [30.0, 1.5, 1.0, 2.0, 3.0])
    (run,) = jax_vs_torch.newest_runs(records + records).values()
    assert [record["train_seconds"] for record in run] == [2.0, 3.5, 4.5, 6.5, 9.5]
    (run,) = jax_vs_torch.newest_runs(records[:3]).values()
    assert run[-1]["train_seconds"] == 31.5


def test_the_comparison_names_each_device_and_length(jax_vs_torch) -> None:
    ours = evaluations("ours-0-1.0", [1.0], device="H100", total_steps=20_000_000)
    runs = jax_vs_torch.newest_runs([*ours, *evaluations("skrl-0-1.0", [1.0], total_steps=10**6)])
    text = jax_vs_torch.table(runs)
    assert "Device: CPU or H100, 64 environments" in text
    assert "return after 1 or 20 M steps" in text


def test_the_comparison_refuses_what_it_would_ignore(jax_vs_torch) -> None:
    for flags in (["--stop-when-solved"], ["--num-seeds", "2"], ["--screening-episodes", "8"]):
        with pytest.raises(UserError, match=flags[0]):
            jax_vs_torch.read_command(flags)
    with pytest.raises(UserError, match="the task track"):
        jax_vs_torch.read_command(["--config", str(resource_path("configs/track/default.yaml"))])
    command = jax_vs_torch.read_command(["--config", "default", "--eval-episodes", "9"])
    config = command.training(seed=7)
    assert (config.seed, config.eval_episodes, config.stop_when_solved) == (7, 9, False)
    assert config.ppo == read_preset(Path("default")).ppo


def test_a_start_that_is_interrupted_leaves_no_training_behind(
    start, tmp_path: Path, monkeypatch
) -> None:
    training = tmp_path / "train.py"
    training.write_text("import os, time\nprint(os.getpid())\ntime.sleep(60)\n")
    processes = []
    popen = subprocess.Popen

    def started(*args, **options) -> subprocess.Popen:
        processes.append(popen(*args, **options))
        return processes[0]

    def moment() -> float:
        if processes:
            raise KeyboardInterrupt
        return 0.0

    monkeypatch.setattr(start, "TIMED", training)
    monkeypatch.setattr(subprocess, "Popen", started)
    monkeypatch.setattr(start, "time", types.SimpleNamespace(time=moment))
    with pytest.raises(KeyboardInterrupt):
        start.start_once(1, tmp_path, [])
    assert processes[0].poll() is not None


def test_an_interrupted_trial_is_repeated_once(sweep, tmp_path: Path, monkeypatch) -> None:
    pytest.importorskip("optuna")
    base = read_preset(Path("default"))
    command = sweep.Command(trials=2, storage=tmp_path / "sweep.db")
    preset = {name: pytest.approx(getattr(base.ppo, name)) for name in sweep.SPACE}
    ends = iter([KeyboardInterrupt, KeyboardInterrupt, None, None])

    def run_trial(trial, *_) -> float:
        for name, (low, high, is_logarithmic) in sweep.SPACE.items():
            trial.suggest_float(name, low, high, log=is_logarithmic)
        if (end := next(ends)) is not None:
            raise end
        return 1.0

    monkeypatch.setattr(sweep, "run_trial", run_trial)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            sweep.search(command, base)
    trials = sweep.search(command, base).trials
    assert [trial.state.name for trial in trials] == ["FAIL", "FAIL", "COMPLETE", "COMPLETE"]
    assert trials[1].params == preset and trials[2].params == preset != trials[3].params


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
    assert nominal.ranges.keys() == config.goals.keys()
    for condition in conditions:
        for name in condition.ranges.keys() - config.goals.keys():
            low, high = getattr(world.randomization, name)
            for end in (*condition.range(name), *nominal.range(name)):
                assert np.all(low <= end) and np.all(end <= high), (condition, name)
    heavy = next(c for c in conditions if c.perturbation.name == "ball of 5 g")
    factor, _ = heavy.range("ball_mass")
    assert factor * config.robot.ball.mass == pytest.approx(0.005, rel=1e-3)


@pytest.mark.slow
@pytest.mark.usefixtures("quick_compilation")
def test_a_policy_without_delays_loses_each_ball_of_a_late_world(
    endless, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(endless, "EPISODES", 4)
    command = "endless.py pretrained --minutes 1 --world fast_servo --out"
    monkeypatch.setattr(sys, "argv", [*command.split(), str(tmp_path)])
    endless.main()
    (record,) = json.loads((tmp_path / "endless.json").read_text())["records"]
    assert record["world"] == "fast_servo" and record["kept"] == 0
    assert len(record["bounces"]) == 4 and max(record["bounces"]) < 30


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
    monkeypatch.syspath_prepend(str(BENCHMARKS))
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
