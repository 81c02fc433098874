"""A suite's conditions are what its file says, measured in their own worlds, told and drawn."""

import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from rich.console import Console

from bounce_mjx import EnvConfig
from bounce_mjx.commands import robustness as robustness_command
from bounce_mjx.config.user_code import import_code
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation import robustness
from bounce_mjx.evaluation.config import EvaluationOptions
from bounce_mjx.evaluation.robustness import ConditionOutcome, RobustnessReport, measure_conditions
from bounce_mjx.evaluation.statistics import Statistics
from bounce_mjx.evaluation.suite import load_suite, read_suite
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import networks_of
from bounce_mjx.reports.robustness import load_robustness, robustness_table
from bounce_mjx.resources import resource_path
from bounce_mjx.task import Tally
from bounce_mjx.task.registry import find_task
from bounce_mjx.world.randomization import TERMS

DRIBBLE = Path(__file__).parent.parent / "examples" / "dribble_task.py"
RESULTS = ("consecutive bounces", "horizontal position", "height", "upward speed", "stable")


def suite_file(tmp_path: Path, *perturbations: object) -> Path:
    path = tmp_path / "suite.yaml"
    path.write_text(yaml.safe_dump({"perturbations": list(perturbations)}), encoding="utf-8")
    return path


def suite(tmp_path: Path, *perturbations: object, trained: EnvConfig | None = None):
    """Conditions of a suite file, without the nominal condition."""
    path = suite_file(tmp_path, *perturbations)
    nominal, *others = load_suite(path, trained or EnvConfig())
    assert (nominal.perturbation.name, nominal.trained) == ("nominal", True)
    assert nominal.ranges.keys() == nominal.env.goals.keys()
    return others


def test_the_shipped_suite_has_every_term() -> None:
    conditions = load_suite(resource_path("configs/robustness.yaml"), EnvConfig())
    assert len(conditions) >= 100
    ranged = {term for condition in conditions for term in condition.ranges}
    # Version 1 of the suite is older than these.
    newer = {"servo_offset", "ball_inertia", "contact_duration"}
    assert ranged == {*TERMS, "target_height"} - newer
    assert read_suite(resource_path("configs/robustness.yaml")).version == "v1"


def test_strengths_have_a_unit_and_values_a_shape(tmp_path: Path) -> None:
    tilt, start, real = suite(
        tmp_path,
        dict(name="tilt", unit="deg", strengths=[2], terms={"paddle_tilt": ["-strength", 0.5]}),
        dict(
            name="start",
            unit="cm",
            strengths=[5],
            terms={
                "ball_start": {"from": ["-strength", 0, 0], "to": ["strength"] * 3},
                "air_drag": 0.1,
            },
        ),
        dict(name="real", terms={"servo_gain": 0.9, "target_height": {"from": 0.3, "to": 0.8}}),
    )
    np.testing.assert_allclose(tilt.ranges["paddle_tilt"], [[-np.pi / 90, 0.5]] * 2)
    np.testing.assert_allclose(start.ranges["ball_start"], [[-0.05, 0, 0], [0.05] * 3])
    np.testing.assert_allclose(start.ranges["air_drag"], [0.1, 0.1])
    assert (start.strength, real.strength) == (5.0, None)
    np.testing.assert_allclose(real.ranges["servo_gain"], np.full((2, 6), 0.9))
    assert real.goals == {"target_height": (0.3, 0.8)}
    assert tilt.goals == {"target_height": EnvConfig().target_height_range}


def test_settings_change_the_task_and_drop_the_training_world(tmp_path: Path) -> None:
    trained = EnvConfig(randomization={"ball_mass": (0.8, 1.2)}, action_scale=0.03)
    slow, dropped = suite(
        tmp_path,
        dict(
            name="slow",
            unit="ms",
            strengths=[20],
            settings={"control_dt": "strength", "observation.velocity": "differences"},
        ),
        dict(
            name="dropped",
            unit="cm",
            strengths=[50],
            settings={
                "ball_init_pos": [0.6, 0.0, "strength"],
                "reward": {"target_y": "-strength", "target_x": 0.6},
            },
        ),
        trained=trained,
    )
    assert dropped.env.ball_init_pos == (0.6, 0.0, 0.5)
    assert (dropped.env.reward.target_x, dropped.env.reward.target_y) == (0.6, -0.5)
    assert (slow.env.control_dt, slow.env.observation.velocity) == (0.02, "differences")
    assert (slow.env.action_scale, slow.env.randomization.terms) == (0.03, ())
    assert not slow.trained


def test_the_trained_ranges_contain_a_condition_or_not(tmp_path: Path) -> None:
    trained = EnvConfig(
        target_height_range=(0.3, 0.8),
        randomization={"action_latency": (0.0, 0.02), "gravity_tilt": (-0.02, 0.02)},
    )
    late, tilt, both, everything = (
        dict(name="late", unit="ms", strengths=[0, 20, 21], terms={"action_latency": "strength"}),
        dict(name="tilt", strengths=[-0.02, -0.03], terms={"gravity_tilt": [0, "strength"]}),
        dict(name="both", terms={"action_latency": 0.01, "air_drag": 0.1}),
        dict(name="all", trained_ranges=True),
    )
    conditions = suite(tmp_path, late, tilt, both, everything, trained=trained)
    assert [c.trained for c in conditions] == [True, True, False, True, False, False, True]
    np.testing.assert_allclose(conditions[-1].ranges["gravity_tilt"], [[-0.02] * 2, [0.02] * 2])
    assert conditions[-1].ranges.keys() == {"action_latency", "gravity_tilt", "target_height"}
    assert conditions[-1].goals == {"target_height": (0.3, 0.8)}
    assert conditions[0].goals == {"target_height": (0.4, 0.6)}
    # In a named world, whose settings differ from the training's, it is the training's own.
    world = EnvConfig(action_scale=0.02)
    *others, own = load_suite(suite_file(tmp_path, late, everything), trained, world)
    assert {condition.env.action_scale for condition in others} == {0.02}
    assert own.env.action_scale == trained.action_scale and own.trained
    # Without randomisation, a training contains only conditions that leave the world unchanged.
    conditions = suite(tmp_path, late, tilt, both, everything)
    assert [c.trained for c in conditions] == [True, *[False] * 5]


def test_a_training_that_always_has_a_term_does_not_contain_a_world_without(tmp_path: Path) -> None:
    latency = dict(name="late", unit="ms", strengths=[0, 20], terms={"action_latency": "strength"})
    path = suite_file(tmp_path, latency)
    always = {"action_latency": (0.015, 0.045)}
    # What has no neutral value, and how often goals change, is not asked.
    others = {"camera_rate": (60.0, 120.0), "goal_interval": (3.0, 8.0), "air_drag": (0.0, 0.2)}
    for randomization, expected in (
        (always | others, [False, False, True]),
        (always | others | {"share": 0.5}, [True, True, True]),
        (always | others | {"share": 0.5, "shares": {"action_latency": 1.0}}, [False, False, True]),
        (others, [True, True, False]),
    ):
        conditions = load_suite(path, EnvConfig(randomization=randomization))
        assert [condition.trained for condition in conditions] == expected


def test_a_suite_names_the_contact_pair_that_a_model_lacks(tmp_path: Path) -> None:
    """Its ball and its paddle touch as all geoms do."""
    text = resource_path("mjcf/bounce_ball.xml").read_text(encoding="utf-8")
    for geom in ("ball", "blocker"):
        text = text.replace(f'<geom name="{geom}"', f'<geom name="{geom}" contype="1"')
    model = tmp_path / "model.xml"
    model.write_text(re.sub(r"<contact>.*</contact>", "", text, flags=re.DOTALL), encoding="utf-8")
    stiff = dict(name="restitution", strengths=[0.8], terms={"restitution": "strength"})
    conditions = load_suite(suite_file(tmp_path, stiff), EnvConfig(mjcf=str(model)))
    with pytest.raises(UserError, match="the MJCF has no contact pair of the ball and the paddle"):
        measure_conditions(None, lambda env: None, conditions, EvaluationOptions(4))


LATE = dict(name="late", strengths=[0.01], terms={"action_latency": "strength"})
MISTAKES = {
    "unknown term": (
        [LATE | {"terms": {"action_latencies": "strength"}}],
        "unknown key randomization.action_latencies; did you mean randomization.action_latency?",
    ),
    "limit of a goal": (
        [LATE | {"terms": {"target_height": {"from": 0, "to": "strength"}}}],
        "'late' at 0.01: target_height is 0, but must be a finite number >= 0.05",
    ),
    "order of a goal": (
        [LATE | {"strengths": [0.4], "terms": {"target_height": {"from": 0.5, "to": "strength"}}}],
        "'late' at 0.4: target_height is from 0.5 to 0.4; exchange the two",
    ),
    "unused strengths": ([LATE | {"terms": {"action_latency": 0.01}}], "with the word strength"),
    "nothing": ([dict(name="late")], "give terms or settings"),
    "same name": ([LATE, LATE], "'late': the name is taken"),
    "length": (
        [LATE | {"terms": {"paddle_tilt": ["strength", 0, 0]}}],
        "is not a range; give two numbers, or two lists with one for each of 2 axes",
    ),
    "size": (
        [dict(name="blind", settings={"observation.ball_position": 0})],
        "it changes the observation",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_in_a_suite_is_one_sentence(name: str, refused) -> None:
    perturbations, words = MISTAKES[name]
    Path("suite.yaml").write_text(yaml.safe_dump({"perturbations": perturbations}))
    refused("robustness --suite suite.yaml --out out", "suite.yaml", words)


def test_every_condition_gets_its_own_ranges_and_outcome(tmp_path: Path, monkeypatch) -> None:
    """In every program and call; the statistics of this fake evaluator depend on the ranges."""
    conditions = suite(
        tmp_path,
        LATE | dict(unit="ms", strengths=[0, 5, 10, 15, 20]),
        dict(name="camera", unit="Hz", strengths=[60, 120], terms={"camera_rate": "strength"}),
        dict(name="target", strengths=[0.8], terms={"target_height": "strength"}),
        dict(name="slow", strengths=[0.02], settings={"control_dt": "strength"}),
        dict(name="dry", strengths=[5], terms={"joint_frictionloss": "strength"}),
    )  # fmt: skip
    calls = []

    def make_evaluator(env, networks, count):
        terms = env.config.randomization.terms

        def evaluate(policy, key, ranges):
            given_goals = sorted((ranges or {}).keys() - set(terms))
            calls.append((*terms, *given_goals, count))
            given = {name: np.repeat(low, 4) for name, (low, _) in (ranges or {}).items()}
            late = given.get("action_latency", np.zeros(count))
            rate = given.get("camera_rate", np.zeros(count))
            # 100 steps are one second; the mean length and the speed identify the condition.
            nothing = (
                "settled_steps", "centred_steps", "settled_bounces", "accurate_bounces",
                "apex_error",
            )  # fmt: skip
            speed = given.get("target_height", np.full(count, 0.5)) + late
            sums = dict.fromkeys(nothing, np.zeros(count)) | {
                "rising_steps": np.ones(count),
                "rising_speed": speed,
            }
            measured = Statistics(
                running=np.ones(count, bool),
                steps=100.0 + 1000.0 * late + rate,
                episode_return=np.zeros(count),
                tally=Tally(sums, {"n_bounces": np.zeros(count)}),
            )
            return measured, None

        return evaluate

    monkeypatch.setattr(robustness, "make_evaluator", make_evaluator)
    monkeypatch.setattr(robustness, "make_mujoco_evaluator", make_evaluator)
    monkeypatch.setattr(robustness, "_CPU_BATCH", 14)
    done = []
    options = EvaluationOptions(4)
    outcomes = measure_conditions(None, networks_of(PPOConfig()), conditions, options, done.append)
    assert [(o.perturbation, o.strength) for o in outcomes] == [
        *[("late", s) for s in (0, 5, 10, 15, 20)],
        ("camera", 60), ("camera", 120), ("target", 0.8), ("slow", 0.02), ("dry", 5),
    ]  # fmt: skip
    assert {o.physics for o in outcomes} == {"fused"}
    lengths = [1.0, 1.05, 1.1, 1.15, 1.2, 1.6, 2.2, 1.0, 2.0, 1.0]
    np.testing.assert_allclose([o.mean_length_s for o in outcomes], lengths, rtol=1e-6)
    # The neutral target height is the task's own; at 0.8 m the speed is not judged.
    speeds = [0.4, 0.405, 0.41, 0.415, 0.42, 0.5, 0.5, 0.8, 0.5, 0.5]
    np.testing.assert_allclose([o.values["upward speed"] for o in outcomes], speeds, rtol=1e-6)
    assert done == sorted(done) and done[-1] == 10
    assert calls == [("action_latency", "target_height", 12)] * 2 + [
        ("camera_rate", 8),
        (4,),
        ("joint_frictionloss", 4),
    ]


def test_conditions_that_differ_in_nothing_have_the_same_episodes(tmp_path, monkeypatch) -> None:
    """And a film is that of the condition's own episode."""
    slow = dict(strengths=[0.02], settings={"control_dt": "strength"})
    path = suite_file(tmp_path, dict(name="slow", **slow), dict(name="slow again", **slow))
    _, *conditions = load_suite(path, find_task("balance").Config())
    calls = []

    def make_evaluator(env, networks, count):
        ones = np.ones(count)
        measured = Statistics(ones > 0, ones, ones, Tally({"steps": ones, "squares": ones}))

        def evaluate(policy, key, ranges):
            calls.append((count, ranges, key.tolist()))
            return measured, None

        return evaluate

    monkeypatch.setattr(robustness, "make_evaluator", make_evaluator)
    options = EvaluationOptions(4)
    measure_conditions(None, lambda env: None, conditions, options)
    assert len(calls) == 2 and calls[0] == calls[1] == (4, None, calls[0][2])
    found = robustness.find_episode(conditions, 1, options, 3)
    assert (found.episodes, found.episode) == (4, 3)


def test_each_condition_is_judged_as_an_evaluation_in_its_own_world(tmp_path, monkeypatch) -> None:
    """Also where the task's bounds depend on the world, and conditions share a program: an error of
    1.2 cm is within balance's bound with pushes, and beyond the one without."""
    trained = find_task("balance").Config()
    pushed = dict(
        name="pushed", strengths=[0.1, 0], terms={"push_speed": "strength", "push_interval": 2}
    )
    content = {"perturbations": [pushed, dict(name="all", trained_ranges=True)]}
    (tmp_path / "suite.yaml").write_text(yaml.safe_dump(content))
    conditions = load_suite(tmp_path / "suite.yaml", trained)
    # Not the pushes that the task's own world has.
    assert conditions[0].ranges.keys() == trained.goals.keys()

    def make_evaluator(env, networks, count):
        sums = {"steps": np.ones(count), "squares": np.full(count, 0.012**2)}
        ones = np.ones(count)
        measured = Statistics(ones > 0, 2000.0 * ones, ones, Tally(sums))
        return lambda policy, key, ranges: (measured, None)

    monkeypatch.setattr(robustness, "make_evaluator", make_evaluator)
    outcomes = measure_conditions(None, lambda env: None, conditions, EvaluationOptions(4))
    assert [outcome.label for outcome in outcomes] == ["nominal", "pushed 0.1", "pushed 0", "all"]
    assert [outcome.failed for outcome in outcomes] == [["error"], [], ["error"], []]


def outcome(name: str, strength: float | None = None, **changes) -> ConditionOutcome:
    values = dict(zip(RESULTS, (100.0, 99.0, 98.0, 1.4, 100.0), strict=True))
    given = dict(
        perturbation=name, group="g", unit="ms", strength=strength, trained=False, physics="fused",
        values=values, failed=[], lasted=1.0, mean_length_s=20.0,
    )  # fmt: skip
    return ConditionOutcome(**(given | changes))


@pytest.fixture
def report() -> RobustnessReport:
    bad = dict(zip(RESULTS, (50.0, None, None, 1.8, 25.0), strict=True))
    failed = ["consecutive bounces", "height", "stable"]
    return RobustnessReport(
        checkpoint="c", steps=1, suite="s", episodes=4, seed=0,
        measured={
            name: f"what {name} means, {'m/s' if name == 'upward speed' else '%'}"
            for name in RESULTS
        },
        outcomes=[
            outcome("nominal", group="nominal", trained=True),
            outcome("late", 0.0, trained=True),
            outcome("late", 5.0, trained=True),
            outcome("late", 10.0, values=bad, failed=failed, lasted=0.25),
            outcome("other", 1.0, group="h", physics="mujoco"),
        ],
    )  # fmt: skip


def test_table_tells_every_figure(report: RobustnessReport) -> None:
    stream = io.StringIO()
    Console(file=stream, width=80).print(robustness_table(report))
    lines = stream.getvalue().splitlines()
    assert "4 of 5 conditions (s) meet all judged results" in lines[0]
    for suite, version, name in (
        ("folder/mine.yaml", "", "(mine)"),
        ("configs/robustness.yaml", "v2", "of v2"),
        ("twice or half what my.yaml assumes", "", "(twice or half what my.yaml assumes)"),
    ):
        report = report.model_copy(update={"suite": suite, "version": version})
        assert f"4 of 5 conditions {name} meet" in robustness_table(report).title
    (row,) = [line.split() for line in lines if "10 ms" in line]
    assert row == ["10", "ms", "50.0*", "-", "-*", "1.80", "25.0*", "FAIL"]
    (row,) = [line.split() for line in lines if "1 ms" in line]
    assert row == ["other", "1", "ms", "100.0", "99.0", "98.0", "1.40", "100.0", "pass"]
    (header,) = [line.split() for line in lines if "strength" in line]
    assert header == ["condition", "strength", "A", "B", "C", "D", "E"]
    described = [line.strip() for line in lines]
    assert "D  upward speed: what upward speed means, m/s" in described


@pytest.fixture
def measured(report: RobustnessReport, monkeypatch) -> RobustnessReport:
    """Makes the command return this report's outcomes without a simulation."""
    monkeypatch.setattr(robustness, "measure_conditions", lambda *_, **__: report.outcomes)
    return report


def test_command_writes_its_results(measured, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    out, mine = tmp_path / "robustness", tmp_path / "mine"
    out.mkdir()
    mine.write_text("mine")
    for suffix in ("json", "png", "svg"):
        (out / f"robustness.{suffix}").symlink_to(mine)
    with pytest.raises(SystemExit) as exit_info:
        robustness_command.main(["--episodes", "4", "--seed", "3"])
    assert exit_info.value.code == 1
    assert mine.read_text() == "mine"
    assert {p.name for p in out.iterdir()} == {f"robustness.{s}" for s in ("json", "png", "svg")}
    written = load_robustness(out)
    assert written.outcomes == measured.outcomes
    assert (written.episodes, written.seed) == (4, 3)
    assert "4 of 5 conditions" in capsys.readouterr().out

    measured.outcomes[:] = [o for o in measured.outcomes if o.passed]
    with pytest.raises(SystemExit) as exit_info:
        robustness_command.main(["--out", str(tmp_path / "other")])
    assert exit_info.value.code == 0
    assert json.loads((tmp_path / "other" / "robustness.json").read_text())["outcomes"]


@pytest.mark.slow
def test_a_perturbation_of_one_task_is_skipped_for_others(tmp_path: Path) -> None:
    """The shipped suite runs for a task without its goals, whose own goal has its limits."""
    import_code(DRIBBLE)
    dribble = find_task("dribble").Config()
    shipped, of_bounce = (
        load_suite(resource_path("configs/robustness.yaml"), config)
        for config in (dribble, EnvConfig())
    )
    names = {c.perturbation.name for c in of_bounce} - {c.perturbation.name for c in shipped}
    assert names == {"target height", "target changes every"}
    assert len(of_bounce) - len(shipped) == 8
    assert all(condition.goals == {"apex": (0.065, 0.085)} for condition in shipped)
    low, high = suite(
        tmp_path,
        dict(name="apex", unit="cm", strengths=[7, 9], terms={"apex": "strength"}),
        dict(name="only bounce", task="bounce", terms={"target_height": 0.5}),
        trained=dribble,
    )
    assert [c.goals["apex"][0] for c in (low, high)] == pytest.approx([0.07, 0.09])
    assert [c.trained for c in (low, high)] == [True, False]
    with pytest.raises(UserError, match="unknown key randomization.target_height; "):
        suite(tmp_path, dict(name="target", terms={"target_height": 0.5}), trained=dribble)
    with pytest.raises(UserError, match="apex is 0.001, but must be a finite number >= 0.01"):
        suite(tmp_path, dict(name="apex", terms={"apex": 0.001}), trained=dribble)


def test_a_start_that_a_task_cannot_have_is_left_out_of_its_suite(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A ball that balances would start within the paddle; displaced sideways, it starts on it."""
    sideways = {"from": ["-strength", "-strength", 0], "to": ["strength", "strength", 0]}
    deep = {"from": [0, 0, "-strength"], "to": [0, 0, "strength"]}
    moved = {"unit": "cm", "strengths": [5]}
    path = suite_file(
        tmp_path,
        {"name": "sideways", "terms": {"ball_start": sideways}, **moved},
        {"name": "height", "terms": {"ball_start": deep}, **moved},
    )
    names = {}
    for task in ("balance", "bounce"):
        conditions = load_suite(path, find_task(task).Config())
        names[task] = [condition.label for condition in conditions]
    assert names == {
        "balance": ["nominal", "sideways 5 cm"],
        "bounce": ["nominal", "sideways 5 cm", "height 5 cm"],
    }
    assert "height 5 cm is left out: randomization.ball_start" in capsys.readouterr().err
    # The program of the conditions that are left starts only where they do.
    config = robustness._spanning_config(load_suite(path, find_task("balance").Config()), "config")
    assert config.randomization.ball_start == ((-0.05, -0.05, 0.0), (0.05, 0.05, 0.0))
    Env(config)
