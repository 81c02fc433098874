"""A named world has sourced numbers, and training and measuring take place in it."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from bounce_mjx.config.settings import merged
from bounce_mjx.config.validation import validate
from bounce_mjx.deploy.environments import environment_config
from bounce_mjx.deploy.export import policy_metadata
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.config import EvaluationOptions
from bounce_mjx.evaluation.policy_evaluation import setup_of
from bounce_mjx.evaluation.suite import load_suite
from bounce_mjx.resources import resource_path
from bounce_mjx.robot.config import LimitsConfig, RobotConfig
from bounce_mjx.robot.model import add_balls, scene_spec
from bounce_mjx.runs.config import TrainConfig, load_run_config
from bounce_mjx.runs.folders import find_checkpoint
from bounce_mjx.runs.layers import read_layers, read_preset
from bounce_mjx.runs.start import Choice
from bounce_mjx.runs.worlds import (
    OWN,
    read_named_world,
    robot_in_world,
    settings_in_world,
)
from bounce_mjx.task.bounce import Bounce
from bounce_mjx.task.catch import Catch
from bounce_mjx.task.registry import find_task
from bounce_mjx.world.config import ActionConfig
from bounce_mjx.world.model import model_nominals
from bounce_mjx.world.named import read_world
from bounce_mjx.world.randomization import TERMS, RandomizationConfig
from tiny_runs import settings_of

TWICE = "twice the assumed, or half"
NAMES = ("ur5e_rtde", "panda_fci", "iiwa_fri", "fast_servo")
WORLD = {
    "env": {"randomization": {"action_latency": [0.01, 0.02], "frame_drop": [0.0, 0.1]}},
    "sources": {"randomization": "An example."},
    "assumed": ["randomization.frame_drop"],
}


def written(folder: Path, **changes: object) -> Path:
    path = folder / "world.yaml"
    path.write_text(yaml.safe_dump(WORLD | changes), encoding="utf-8")
    return path


@pytest.mark.parametrize("name", NAMES)
def test_each_number_of_a_shipped_world_is_sourced_or_assumed(name: str) -> None:
    world = read_world(resource_path(f"configs/worlds/{name}.yaml"))
    assert {f"randomization.{x}" for x in world.settings["randomization"]} <= world.sources.keys()


@pytest.mark.parametrize(
    "changes, wrong",
    [
        ({"env": {"observation": {"action": 3}}}, "unknown key env.observation"),
        ({"env": {"randomization": {"latency": [0, 1]}}}, "unknown key env.randomization.latency"),
        ({"env": {"randomization": {"frame_drop": [0.5, 0.1]}}}, "frame_drop"),
        ({"sources": {"randomization": "x", "robot": "y"}}, "has robot, but env has no"),
        ({"sources": {}, "assumed": []}, "randomization.action_latency has no source"),
        ({"assumed": ["frame_drop"]}, "has frame_drop, but env has no such key"),
        ({"sources": {"randomization": " "}}, "randomization has an empty source"),
        (
            {
                "env": {"randomization": {"warmup_steps": 5, "frame_drop": [0.0, 0.1]}},
                "assumed": ["randomization.warmup_steps"],
            },
            "randomization.warmup_steps is assumed, but is no number to double",
        ),
        (
            {
                "env": {"randomization": {"shares": {"frame_drop": 0.6}, "frame_drop": [0.0, 0.1]}},
                "assumed": ["randomization.shares.frame_drop"],
            },
            "randomization.shares.frame_drop is assumed, but is no number to double",
        ),
    ],
)
def test_a_mistake_is_one_sentence(tmp_path: Path, changes: dict, wrong: str) -> None:
    path = written(tmp_path, **changes)
    with pytest.raises(UserError) as caught:
        read_world(path)
    assert wrong in str(caught.value) and str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_training_has_the_world_in_place_of_the_presets(tmp_path: Path) -> None:
    world = written(tmp_path)
    preset = read_preset(Path("transfer")).env
    command = settings_of(
        ["--config", "transfer", "--world", str(world), "--randomization.frame-drop", "0", "0.2"]
    )
    drawn = command.config.env.randomization
    assert preset.randomization.terms != drawn.terms == ("action_latency", "frame_drop")
    assert (drawn.action_latency, drawn.frame_drop) == ((0.01, 0.02), (0.0, 0.2))
    assert drawn.share == preset.randomization.share
    assert command.config.env.observation == preset.observation


TILT = (-0.08, 0.01), (-0.07, 0.03)
TILTED = {
    "env": {"randomization": {"paddle_tilt": [[-0.08, 0.01], [-0.07, 0.03]]}},
    "sources": {"randomization": "An example."},
    "assumed": ["randomization.paddle_tilt"],
}


@pytest.mark.slow
def test_a_world_with_ranges_of_axes_trains_and_is_doubled(tmp_path: Path) -> None:
    world = written(tmp_path, **TILTED)
    assert settings_of(["--world", str(world)]).config.env.randomization.paddle_tilt == TILT
    given = settings_of(["--world", str(world), "--randomization.paddle-tilt", "-0.1", "0.1"])
    assert given.config.env.randomization.paddle_tilt == (-0.1, 0.1)
    trained = TrainConfig()
    there = settings_in_world(trained.env, world)
    _, named = read_named_world(world)
    conditions = load_suite(
        resource_path("configs/robustness.yaml"),
        there,
        there,
        named.double_assumed(model_nominals(there)),
    )
    nominal, twice = (c for c in conditions if c.perturbation.group in ("nominal", TWICE))
    np.testing.assert_allclose(nominal.ranges["paddle_tilt"], TILT)
    np.testing.assert_allclose(twice.ranges["paddle_tilt"], 2.0 * np.array(TILT))
    assert nominal.trained and not twice.trained


def test_assumed_numbers_are_doubled_entry_by_entry() -> None:
    """As `bounce-mjx robustness --world` doubles them: about the model's value of each entry."""
    there = settings_in_world(TrainConfig().env, Path("fast_servo"))
    _, named = read_named_world(Path("fast_servo"))
    nominals = model_nominals(there)
    doubled = named.double_assumed(nominals)
    assert doubled.keys() == {f"twice {key}" for key in named.assumed}
    for name, settings in doubled.items():
        key = name.removeprefix("twice ")
        term = key.removeprefix("randomization.")
        assert settings.keys() == {"randomization"} and settings["randomization"].keys() == {term}
        low, high = getattr(there.randomization, term)
        expected_low = np.clip(2.0 * np.array(low) - nominals[term], *TERMS[term].bounds)
        expected_high = np.clip(2.0 * np.array(high) - nominals[term], *TERMS[term].bounds)
        doubled_low, doubled_high = settings["randomization"][term]
        np.testing.assert_allclose(doubled_low, expected_low)
        np.testing.assert_allclose(doubled_high, expected_high)
        validate(type(there), merged(there.model_dump(), settings), key)


def test_less_of_a_limit_is_harder(tmp_path: Path) -> None:
    keys = [
        "max_joint_velocity",
        "action_scale",
        "randomization.torque_limit",
        "robot.servo_force_limit",
        "robot.limits.jerk",
        "robot.gravity_compensation",
    ]
    env = {
        "robot": {
            "servo_force_limit": [80.0, 12.0],
            "limits": {"velocity": [2.0], "acceleration": [10.0], "jerk": [5000.0]},
            "gravity_compensation": 1.0,
        },
        "max_joint_velocity": 4.0,
        "action_scale": 0.02,
        "randomization": {"torque_limit": [20.0, 40.0]},
    }
    sources = dict.fromkeys([*keys, "robot"], "An example.")
    path = written(tmp_path, env=env, sources=sources, assumed=keys)
    assert read_world(path).double_assumed({}) == {
        "half max_joint_velocity": {"max_joint_velocity": 2.0},
        "twice action_scale": {"action_scale": 0.04},
        "half randomization.torque_limit": {"randomization": {"torque_limit": [10.0, 20.0]}},
        "half robot.servo_force_limit": {"robot": {"servo_force_limit": [40.0, 6.0]}},
        "half robot.limits.jerk": {"robot": {"limits": {"jerk": [2500.0]}}},
        "half robot.gravity_compensation": {"robot": {"gravity_compensation": 0.5}},
    }


def test_a_world_brings_its_robot() -> None:
    command = settings_of(["--config", "cpu", "--world", "ur5e_rtde"])
    assert command.config.env.mjcf.name == "ur5e.xml"
    assert command.config.env.robot.site == "attachment_site"
    assert command.config.env.robot.servo_stiffness[0] > 1e4
    with pytest.raises(UserError, match="is for the robot ur5e, and a robot is given too"):
        settings_of(["--world", "ur5e_rtde", "--robot", "panda"])


def test_a_world_names_a_robots_file_from_its_own_folder(tmp_path: Path, monkeypatch) -> None:
    """As `identify --robot arm.yaml --out worlds/world.yaml` writes it, and --world reads it from
    anywhere."""
    monkeypatch.chdir(tmp_path)
    Path("worlds").mkdir()
    Path("arm.yaml").write_text(yaml.safe_dump({"env": {"action_scale": 0.013}}), encoding="utf-8")
    robot = robot_in_world(Path("arm.yaml"), Path("worlds/world.yaml"))
    world = written(tmp_path / "worlds", robot=robot)
    monkeypatch.chdir("/")
    assert settings_of(["--config", "cpu", "--world", str(world)]).config.env.action_scale == 0.013
    assert robot_in_world(Path("ur5e"), Path("worlds/world.yaml")) == "ur5e"


def test_a_robots_own_balls_and_stiff_contact_are_taken_by_another_task(tmp_path: Path) -> None:
    """The paddle's place is found with the step that the contact needs; and a policy for the scene
    is exported."""
    spec, _ = scene_spec(None, RobotConfig())
    add_balls(spec, 2)
    spec.compile()
    scene = tmp_path / "two_balls.xml"
    scene.write_text(spec.to_xml().replace('solref="-98696 -31.4"', 'solref="-1e6 -60"'))
    env = {"mjcf": str(scene), "physics_dt": 0.0005, "num_balls": 2}
    robot = tmp_path / "robot.yaml"
    robot.write_text(yaml.safe_dump({"task": "juggle", "env": env}))
    config = settings_of(["catch", "--robot", str(robot)]).config.env
    assert config.physics_dt == 0.0005
    assert config.ball_init_pos == pytest.approx(Catch.Config().ball_init_pos, abs=1e-3)
    assert policy_metadata(TrainConfig(task="juggle", env=env), 1).num_balls == 2


def test_a_policy_is_measured_in_the_world_alone() -> None:
    trained = read_preset(Path("transfer"))
    there = settings_in_world(trained.env, Path("fast_servo"))
    _, named = read_named_world(Path("fast_servo"))
    drawn = there.randomization
    assert set(drawn.terms) == set(named.settings["randomization"])
    assert drawn.share == 1.0 and drawn.camera_rate == (150.0, 203.0)
    assert there.observation == trained.env.observation
    assert there.action_scale == trained.env.action_scale
    with pytest.raises(UserError, match="fast_servo"):
        settings_in_world(trained.env, Path("ur5e_rtde"))


def test_a_warm_start_is_in_the_world_in_which_its_policy_is_measured() -> None:
    """One function says what a policy's environment is in a world, for a training too."""
    trained = load_run_config(find_checkpoint("robust_small").run).env
    for flag, world in ((None, OWN), (Path("fast_servo"), "fast_servo")):
        choice = Choice(word="robust_small", world=flag)
        begun = read_layers(choice, resource_path("configs/cpu.yaml")).config().env
        assert begun == settings_in_world(trained, world)
        assert begun == environment_config("robust_small", world)


def test_a_robots_file_is_of_no_other_algorithm_or_warm_start(tmp_path: Path) -> None:
    for key, value in {"warm_start": "robust_small", "algorithm": "sac"}.items():
        robot = tmp_path / f"{key}.yaml"
        robot.write_text(yaml.safe_dump({key: value, "env": {}}), encoding="utf-8")
        with pytest.raises(UserError, match=f"the robot .*{key}.yaml .*{value}"):
            settings_of(["--config", "cpu", "--robot", str(robot)])


def test_a_world_of_a_robot_brings_its_limits_to_a_policy() -> None:
    trained = read_preset(Path("cpu"), Path("ur5e"))
    own = trained.env.robot.limits
    free = {"robot": trained.env.robot.model_copy(update={"limits": LimitsConfig()})}
    config = trained.model_copy(update={"env": trained.env.model_copy(update=free)})
    there = settings_in_world(config.env, Path("ur5e_rtde"))
    assert own.velocity is not None and there.robot.limits == own
    assert there.action_scale == trained.env.action_scale
    assert there.randomization.action_latency == (0.015, 0.045)
    measured = free | {"action": ActionConfig(base="measured")}
    config = trained.model_copy(update={"env": trained.env.model_copy(update=measured)})
    with pytest.raises(UserError, match="ur5e_rtde.*action.base"):
        settings_in_world(config.env, Path("ur5e_rtde"))


def test_a_named_world_is_for_a_ball_on_the_paddle_too() -> None:
    """How well a person drops a ball is nothing to one that lies on the paddle."""
    for task, ball_start in (("balance", None), ("catch", (-0.03, 0.03))):
        config = settings_in_world(find_task(task), "fast_servo")
        Env(config)
        assert config.randomization.ball_start == ball_start
        assert config.randomization.action_latency is not None
        trained = settings_in_world(find_task(task).Config(), "fast_servo")
        assert trained.randomization.ball_start == ball_start


class _Moving(Bounce):
    """Bouncing at heights that change."""

    class Config(Bounce.Config):
        randomization: RandomizationConfig = RandomizationConfig(goal_interval=(3.0, 3.0))


def test_the_nominal_world_of_a_task_is_that_of_its_policies() -> None:
    """Of balance, whose defaults push the ball, there are no pushes."""
    balance = find_task("balance")
    pushed = settings_in_world(balance, "own")
    nominal = settings_in_world(balance, "nominal")
    assert pushed.randomization.push_interval is not None
    assert nominal.randomization.push_interval is None
    assert nominal == settings_in_world(pushed, "nominal")
    assert environment_config("balance", "nominal") == nominal


def test_how_often_a_task_samples_its_goals_is_no_part_of_a_world() -> None:
    """Whatever replaces the world of its training."""
    trained = _Moving.Config(randomization={"goal_interval": (3.0, 3.0), "air_drag": (0.0, 0.1)})
    drag = RandomizationConfig(air_drag=(0.1, 0.1))
    others = [
        settings_in_world(trained, "nominal"),
        settings_in_world(trained, "fast_servo"),
        settings_in_world(trained, drag),
        environment_config(trained, "nominal"),
        setup_of(trained, EvaluationOptions(nominal=True)).env.config,
    ]
    conditions = load_suite(resource_path("configs/robustness.yaml"), trained)
    others += [condition.config for condition in conditions]
    assert len(others) > 50
    assert None not in [config.randomization.goal_interval for config in others]
    assert others[1].randomization.action_latency and not others[0].randomization.air_drag
    # The user's own interval of a training is no part of the task, as its ranges are not.
    bounce = Bounce.Config(randomization={"goal_interval": (3.0, 3.0)})
    assert settings_in_world(bounce, "nominal").randomization.goal_interval is None
    # One value for all goals leaves nothing to sample again.
    fixed = EvaluationOptions(nominal=True, goals={"target_height": 0.5})
    assert setup_of(trained, fixed).env.config.randomization.goal_interval is None
