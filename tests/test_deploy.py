"""Exported policies: the ONNX graph against JAX, the NumPy histories against the environment."""

import json
import math
import random
import runpy
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import onnx
import onnxruntime
import pytest
from bounce_mjx.task.observation import QUANTITIES, Kinematics
from bounce_mjx.task.sensing import Sensing, remember, start_sensing

from bounce_mjx import BounceBall, EnvConfig, load_policy
from bounce_mjx.commands import export as export_command
from bounce_mjx.deploy import loading
from bounce_mjx.deploy.chain import Chain
from bounce_mjx.deploy.export import describe, export_jax, export_onnx
from bounce_mjx.deploy.histories import Histories
from bounce_mjx.deploy.metadata import from_entries
from bounce_mjx.deploy.policy import DeployedPolicy
from bounce_mjx.errors import UserError
from bounce_mjx.learning.policy import Policy, act, make_networks
from bounce_mjx.learning.statistics import Normalizer
from bounce_mjx.resources import resource_path
from bounce_mjx.robot.model import load_model
from bounce_mjx.runs import reading
from bounce_mjx.runs.config import TrainConfig, load_run_config
from bounce_mjx.runs.folders import find_checkpoint, pretrained_checkpoint, save_config
from bounce_mjx.runs.writing import CheckpointWriter

CHECKOUT = Path(__file__).resolve().parent.parent
EXAMPLE = runpy.run_path(str(CHECKOUT / "examples" / "deploy.py"))

# Length of the history of each quantity.
ALL = {
    "ball_position": 10,
    "paddle_position": 2,
    "target_height": 2,
    "action": 4,
    "apex_error": 3,
    "bounce_position": 3,
    "bounce_interval": 3,
    "bounce_joint_angles": 3,
    "bounce_joint_velocities": 2,
}
# A ball bounces for seconds on a level paddle that hardly moves: with such stiff servos the arm
# sinks only by micrometres.
STIFF = {"servo_gain": (100.0, 100.0), "servo_damping": (10.0, 10.0)}
LEVEL = {
    "action_scale": 1e-5,
    "ball_init_pos": (0.58856, 0.01, 1.0),
    "ball_position_noise": 0.0,
    "joint_angle_noise": 0.0,
    "joint_velocity_noise": 0.0,
}
ENVS = {
    "specification": {},
    "all histories": {"observation": ALL, "randomization": STIFF, **LEVEL},
    "sensors": {
        "observation": ALL | {"ball_age": 2, "ball_velocity": 3, "velocity": "differences"},
        "randomization": STIFF
        | {
            "camera_rate": (80.0, 130.0),
            "ball_latency": (0.005, 0.02),
            "frame_drop": (0.1, 0.1),
            "ball_position_noise": (0.001, 0.001),
            "joint_angle_noise": (5e-5, 5e-5),
            "encoder_bias": (-0.003, 0.003),
            "joint_velocity_noise": (0.05, 0.05),
            "target_height": (0.4, 0.6),
            "target_interval": (0.3, 0.5),
        },
        **LEVEL,
    },
}


def input_name(quantity: str) -> str:
    """Name of the exported policy's input for a quantity."""
    return "past_actions" if quantity == "action" else quantity


def make_run(folder: Path, env: dict) -> Path:
    """Writes a run with a random policy; its first input never varied in the training."""
    config = TrainConfig(env=env, ppo={"hidden_layers": (24, 8)})
    size = config.env.layout.size
    rng = np.random.default_rng(0)
    std = rng.uniform(0.5, 1.5, size).astype(np.float32)
    std[0] = 1e-3
    normalizer = Normalizer(
        jnp.asarray(rng.normal(size=size), jnp.float32), jnp.asarray(std, jnp.float32)
    )
    networks = make_networks(config.ppo, size, config.env.num_joints)
    params = networks.policy_network.init(jax.random.PRNGKey(1))
    params["params"]["Dense_0"]["kernel"] *= 20.0
    folder.mkdir()
    save_config(folder, config)
    writer = CheckpointWriter(folder, config)
    writer.save(("best",), 64, Policy(normalizer, params))
    writer.close()
    assert writer.problem() is None
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Runs for each of ENVS, and the runs of the package's policies."""
    folder = tmp_path_factory.mktemp("runs")
    made = {name: make_run(folder / name.replace(" ", "_"), env) for name, env in ENVS.items()}
    shipped = {"pretrained": "pretrained", "robust": "pretrained/robust"}
    return made | {name: resource_path(folder) for name, folder in shipped.items()}


@pytest.fixture(scope="module")
def policies(runs: dict[str, Path]) -> dict[str, DeployedPolicy]:
    """Policies of the runs."""
    return {name: load_policy(run) for name, run in runs.items()}


@pytest.fixture
def observations(runs: dict[str, Path]):
    """Function (name) -> 1,000 observations, the actions of JAX, and the inputs by name."""

    def draw(name: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        checkpoint = find_checkpoint(runs[name])
        config = load_run_config(checkpoint.run)
        policy = reading.load_policy(checkpoint, config)
        layout = config.env.layout
        rng = np.random.default_rng(3)
        # Some observations are beyond the clipping range of the normaliser.
        spread = rng.choice([1.0, 1.0, 1.0, 20.0], size=(1000, 1))
        noise = spread * rng.normal(size=(1000, layout.size))
        mean, std = (np.asarray(array) for array in policy.normalizer)
        observation = (mean + std * noise).astype(np.float32)
        networks = make_networks(config.ppo, layout.size, config.env.num_joints)
        inputs = {
            input_name(part.name): observation[:, layout[part.name]].reshape(
                1000, getattr(config.env.observation, part.name), -1
            )
            for part in layout.parts
        }
        return np.asarray(act(networks, policy, observation)), inputs

    return draw


@pytest.mark.parametrize("name", [*ENVS, "pretrained", "robust"])
def test_onnx_equals_jax(name: str, runs: dict[str, Path], observations) -> None:
    expected, inputs = observations(name)
    model = export_onnx(find_checkpoint(runs[name]))
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    (actions,) = session.run(["action"], inputs)
    np.testing.assert_allclose(actions, expected, rtol=0.0, atol=1e-5)
    # Some actions are clipped and some are not.
    assert 0.0 < np.mean(np.abs(expected) == 1.0) < 0.9


@pytest.mark.parametrize("name", ["all histories", "pretrained"])
def test_jax_artefact_equals_jax(name: str, runs: dict[str, Path], observations) -> None:
    expected, inputs = observations(name)
    artefact = jax.export.deserialize(export_jax(find_checkpoint(runs[name])))
    assert set(artefact.platforms) == {"cpu", "cuda"}
    for count in (1, 1000):
        some = {part: values[:count] for part, values in inputs.items()}
        np.testing.assert_allclose(artefact.call(some), expected[:count], rtol=0.0, atol=1e-5)


def test_metadata_describes_inputs_servos_and_training(runs: dict[str, Path]) -> None:
    model = onnx.load_from_string(export_onnx(find_checkpoint(runs["sensors"])))
    metadata = from_entries({prop.key: prop.value for prop in model.metadata_props})
    config = load_run_config(runs["sensors"])
    assert {p.name: p.history for p in metadata.observation} == {
        input_name(q.name): n for q in QUANTITIES if (n := getattr(config.env.observation, q.name))
    }
    assert [p.unit for p in metadata.observation if p.name == "ball_position"] == ["m"]
    assert metadata.joint_names == tuple(f"Joint{i}" for i in range(1, 7)) and metadata.steps == 64
    assert metadata.control_dt == config.env.control_dt
    assert metadata.randomization["camera_rate"] == (80.0, 130.0)
    assert metadata.target_height_range == (0.4, 0.6)
    assert metadata.servo_stiffness == (20000.0,) * 6 and metadata.servo_damping == (200.0,) * 6
    assert metadata.torque_limits == (None,) * 6
    for node in model.graph.input:
        shape = [d.dim_value or d.dim_param for d in node.type.tensor_type.shape.dim]
        (part,) = (p for p in metadata.observation if p.name == node.name)
        assert shape == ["N", part.history, part.size]


def test_servo_targets_are_those_of_the_environment() -> None:
    env, policy = BounceBall(EnvConfig()), load_policy("pretrained")
    rng = np.random.default_rng(0)
    limits = np.array(policy.metadata.joint_ranges)
    for _ in range(20):
        # Some angles are at the limits of their ranges.
        angles = np.clip(rng.uniform(1.2 * limits[:, 0], 1.2 * limits[:, 1]), *limits.T)
        state = env.reset(jax.random.PRNGKey(0)).pipeline_state
        physics = state.physics._replace(qpos=state.physics.qpos.at[:6].set(angles))
        action = rng.uniform(-1.0, 1.0, 6)
        policy.reset()
        policy.step(measured_once() | {"joint_angles": angles})
        expected = env.servo_targets(physics, jnp.asarray(action, jnp.float32))
        np.testing.assert_allclose(policy.servo_targets(action), expected, atol=1e-6)


MJCF = resource_path("mjcf/bounce_ball.xml").read_text(encoding="utf-8")


@pytest.mark.parametrize("edited", [False, True], ids=["shipped", "anchors and references"])
def test_paddle_position_is_that_of_mujoco(edited: bool, tmp_path: Path) -> None:
    text = MJCF
    if edited:
        text = text.replace('name="Joint3"', 'name="Joint3" pos="0.01 0.02 -0.03" ref="0.4"')
        text = text.replace('name="Joint5"', 'name="Joint5" pos="-0.02 0.01 0.03"')
        assert text.count(' ref="0.4"') == 1 and text.count('name="Joint5" pos') == 1
    (tmp_path / "arm.xml").write_text(text, encoding="utf-8")
    metadata = describe(TrainConfig(env={"mjcf": tmp_path / "arm.xml"}), 0)
    model = load_model(tmp_path / "arm.xml", 0.001)
    data, rng, chain = mujoco.MjData(model), np.random.default_rng(0), Chain(metadata)
    for _ in range(20):
        angles = rng.uniform(-2.0, 2.0, 6)
        data.qpos[:6] = angles
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(
            chain.paddle_position(angles), data.geom("blocker").xpos, atol=1e-12
        )


def test_an_arm_with_another_joint_is_refused(tmp_path: Path) -> None:
    text = MJCF.replace(
        '<body name="Link1" pos="0 0 0.1">',
        '<body name="Link1" pos="0 0 0.1"><joint name="track" type="slide" axis="1 0 0"/>',
    )
    (tmp_path / "arm.xml").write_text(text, encoding="utf-8")
    with pytest.raises(UserError, match="hangs on the joint 'track'.*remove the joint"):
        describe(TrainConfig(env={"mjcf": tmp_path / "arm.xml"}), 0)


def measured_by(sensing: Sensing, target_height: float) -> dict[str, np.ndarray]:
    """Newest measurements in an environment's sensor memory."""
    names = ("joint_angles", "joint_velocities", "ball_quaternion", "ball_angular_velocity")
    measured = {name: np.asarray(sensing.seen[name][0]) for name in names}
    return measured | {
        "ball_position": np.asarray(sensing.picture.position),
        "ball_velocity": np.asarray(sensing.picture.velocity),
        "target_height": target_height,
    }


@pytest.mark.parametrize("name", ["all histories", "sensors"])
def test_histories_are_those_of_the_environment(name: str, policies) -> None:
    """Policy and environment run side by side in a closed loop."""
    env, policy = BounceBall(EnvConfig(**ENVS[name])), policies[name]
    step, state = jax.jit(env.step), jax.jit(env.reset)(jax.random.PRNGKey(5))
    policy.reset()
    bounces, targets, reached = 0, set(), set()
    for i in range(300):
        memory, task = state.pipeline_state.memory, state.pipeline_state.task
        measured = measured_by(memory.sensing, task.target_height)
        if name == "sensors":
            measured["ball_age"] = memory.sensing.picture.age
        before = None if i == 0 else policy.observation
        action = policy.step(measured | {"time": 7.0 + i * env.dt})
        np.testing.assert_allclose(policy.observation, state.obs, atol=1e-5, err_msg=f"step {i}")
        flight = env.layout["bounce_interval"]
        bounces += i > 0 and before[flight][0] != policy.observation[flight][0]
        targets.add(float(task.target_height))
        reached |= set(np.flatnonzero(policy.observation))
        state = step(state, jnp.asarray(action, jnp.float32))
        assert not state.done, i
    assert bounces >= 4 and len(targets) >= (5 if name == "sensors" else 1)
    # Every entry changed, except the ball's orientation and spin.
    still = range(env.layout["ball_quaternion"].start + 1, env.layout["ball_quaternion"].stop)
    still = {*still, *range(*env.layout["ball_angular_velocity"].indices(env.layout.size))}
    assert set(range(env.layout.size)) - reached <= still


@pytest.mark.parametrize("seed", range(3))
def test_histories_of_any_observation_are_those_of_the_simulated_sensors(seed: int) -> None:
    """History lengths are random, and the ball follows an invented path over a moving paddle."""
    rng = np.random.default_rng(seed)
    lengths = {quantity.name: int(rng.integers(0, 5)) for quantity in QUANTITIES}
    lengths["bounce_interval"] += 1
    env = TrainConfig(env={"observation": lengths}).env
    metadata = describe(TrainConfig(env=env), 0)
    chain, times = Chain(metadata), np.arange(200) * env.control_dt
    angles = np.array(env.default_joint_angles) + 0.05 * np.sin(times[:, None] * np.arange(3, 9))
    paddle = np.array([chain.paddle_position(a) for a in angles])
    ball = paddle + rng.normal(scale=0.01, size=paddle.shape)
    ball[:, 2] += 0.4 * np.abs(np.sin(5.0 * times)) + 0.02
    actions = rng.uniform(-1.0, 1.0, (200, 6))
    truth = Kinematics(
        joint_angles=angles,
        ball_position=ball,
        ball_quaternion=rng.normal(size=(200, 4)),
        joint_velocities=rng.normal(size=(200, 6)),
        ball_velocity=rng.normal(size=(200, 3)),
        ball_angular_velocity=rng.normal(size=(200, 3)),
        paddle_position=paddle,
    )
    targets, ages = rng.uniform(0.4, 0.6, (200, 1)), 0.03 - 0.0001 * np.arange(200)[:, None]
    measured = truth._asdict() | {"target_height": targets, "action": actions, "ball_age": ages}
    given = {name: values for name, values in measured.items() if name != "action"}

    def at(i: int, values: dict) -> dict:
        return {name: array[i] for name, array in values.items()}

    @jax.jit
    def remembered(memory, measured, near_height):
        picture = memory.picture._replace(position=measured["ball_position"])
        target = measured["target_height"][0]
        return remember(memory, measured, picture, near_height, target, env.control_dt)

    with jax.enable_x64(True):
        start = Kinematics(*(jnp.asarray(values[0]) for values in truth))
        memory = start_sensing(
            env.randomization, env.observation, env.control_dt, start, jnp.asarray(targets[0, 0])
        )
        histories = Histories(metadata, at(0, given) | {"ball_age": np.zeros(1)})
        for i in range(1, 200):
            near_height = paddle[i, 2] + env.bounce_max_distance
            memory = remembered(memory, at(i, measured), near_height)
            histories.add(at(i, given), actions[i])
            for name, values in memory.seen.items():
                seen = histories.values[input_name(name)]
                np.testing.assert_allclose(seen, values, atol=1e-9, err_msg=f"{name} at {i}")
    # There were at least three bounces.
    intervals = histories.values["bounce_interval"]
    assert np.count_nonzero(intervals) >= min(3, len(intervals))


def test_velocity_is_the_difference_of_the_last_two_pictures(tmp_path: Path) -> None:
    """Without a measured age, a picture is new if the ball has moved."""
    observation = dict.fromkeys((quantity.name for quantity in QUANTITIES), 0)
    observation |= {"ball_velocity": 1, "velocity": "differences"}
    policy = load_policy(make_run(tmp_path / "run", {"observation": observation}))
    assert policy.needs == ("ball_position",)
    speeds = []
    for x in (0.0, 0.001, 0.001, 0.005, 0.005, 0.005, 0.002):
        policy.step({"ball_position": [x, 0.0, 0.3]})
        speeds.append(policy.observation[0])
    np.testing.assert_allclose(speeds, [0.0, 0.1, 0.1, 0.2, 0.2, 0.2, -0.1], atol=1e-12)


def measured_once() -> dict:
    """Valid measurements for every policy of these tests."""
    return {
        "joint_angles": np.array([0.0, 0.7, 1.9, 0.0, -1.0, 0.0]),
        "joint_velocities": np.linspace(-0.1, 0.1, 6),
        "ball_position": np.array([0.6, 0.01, 0.3]),
        "ball_velocity": np.array([0.1, -0.1, -2.0]),
        "target_height": 0.5,
    }


def falling(time: float) -> dict:
    """Measurements that change linearly with time (s)."""
    measured = measured_once()
    return measured | {
        "joint_angles": measured["joint_angles"] + 0.3 * time,
        "ball_position": measured["ball_position"] - 1.5 * time,
        "time": time,
    }


def test_a_repeated_call_changes_nothing(policies) -> None:
    policy = policies["all histories"]
    policy.reset()
    actions = [policy.step(falling(time)) for time in (1.0, 1.01)]
    seen = policy.observation
    for time in (1.01, 1.0149, 1.0, 0.5):
        np.testing.assert_array_equal(policy.step(falling(1.0) | {"time": time}), actions[1])
        np.testing.assert_array_equal(policy.observation, seen)
    policy.step(falling(1.02))
    assert not np.array_equal(policy.observation, seen)


def test_histories_stay_in_control_steps(policies) -> None:
    """A late call leaves the same positions as punctual calls, and jitter does not matter."""
    policy, seen = policies["all histories"], []
    ball = slice(*(policies_layout(policy)["ball_position"]))
    for times in (np.arange(12) * 0.01, np.delete(np.arange(12) * 0.01, [4, 5, 8])):
        policy.reset()
        for time in times:
            policy.step(falling(time))
        seen.append(policy.observation[ball])
    np.testing.assert_allclose(seen[1], seen[0], atol=1e-12)

    jitter = np.random.default_rng(0).uniform(-0.002, 0.002, 12)
    observations = []
    for errors in (np.zeros(12), jitter):
        policy.reset()
        for i, error in enumerate(errors):
            policy.step(falling(0.01 * i) | {"time": 0.01 * i + error})
        observations.append(policy.observation)
    np.testing.assert_array_equal(*observations)


def policies_layout(policy: DeployedPolicy) -> dict[str, tuple[int, int]]:
    """Start and end of each part of a policy's observation."""
    ends = np.cumsum([part.history * part.size for part in policy.metadata.observation])
    starts = [0, *ends[:-1]]
    names = [part.name for part in policy.metadata.observation]
    return dict(zip(names, zip(starts, ends, strict=True), strict=True))


WRONG = {
    "missing": ({"ball_position": None}, "ball_position is missing", "needs joint_angles"),
    "unknown": ({"ball_positon": [0, 0, 0]}, "ball_positon is no measurement", "ball_position"),
    "short": ({"joint_angles": [0.0] * 5}, "joint_angles has the shape [5]", "6 numbers (rad)"),
    "batch": ({"ball_position": [[0, 0, 1]]}, "has the shape [1, 3]", "3 numbers (m)"),
    "words": ({"target_height": "high"}, "target_height is 'high'", "one number (m)"),
    "ragged": ({"ball_velocity": [[0], 1, 2]}, "ball_velocity is", "3 numbers (m/s)"),
    "nan": ({"joint_velocities": [0, 0, np.nan, 0, 0, 0]}, "holds nan", "finite", "rad/s"),
    "huge": ({"ball_position": [0, 0, 1e300]}, "holds 1e+300", "finite numbers (m)"),
    "infinite": ({"time": np.inf}, "time holds inf", "finite numbers (s)"),
    "a long pause": ({"time": 1003.0}, "1e+03 s after", "call reset", "give seconds"),
    "another clock": ({"time": -5.0}, "call reset"),
}


@pytest.mark.parametrize("case", WRONG.values(), ids=WRONG)
def test_wrong_measurements_are_refused_and_change_nothing(case: tuple, policies) -> None:
    changes, *words = case
    policy = policies["all histories"]
    policy.reset()
    policy.step(falling(0.0))
    seen = policy.observation
    given = {k: v for k, v in (falling(0.01) | changes).items() if v is not None}
    with pytest.raises(UserError) as refusal:
        policy.step(given)
    assert all(word in str(refusal.value) for word in words), refusal.value
    np.testing.assert_array_equal(policy.observation, seen)


def test_a_policy_needs_only_what_it_sees(tmp_path: Path) -> None:
    names = [quantity.name for quantity in QUANTITIES]
    observation = dict.fromkeys(names, 0) | {"ball_position": 2, "ball_quaternion": 1, "action": 1}
    policy = load_policy(make_run(tmp_path / "run", {"observation": observation}))
    assert policy.needs == ("ball_position",)
    policy.step({"ball_position": (1.0, 2.0, 3.0)})
    policy.step({"ball_position": (4.0, 5.0, 6.0)})
    expected = [4.0, 5.0, 6.0, 1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0]
    np.testing.assert_array_equal(policy.observation[:10], expected)
    with pytest.raises(UserError, match="call step with joint_angles first"):
        policy.servo_targets(np.zeros(6))


@pytest.mark.parametrize("name", ["pretrained", "robust"])
def test_the_shipped_file_is_a_fresh_export(name: str, runs: dict[str, Path]) -> None:
    file = runs[name] / f"{name}.onnx"
    assert onnx.load(file) == onnx.load_from_string(export_onnx(find_checkpoint(runs[name]))), (
        f"{file} is stale; write it with bounce-mjx export {name} --onnx {file}"
    )


def test_load_policy_refuses_other_files(tmp_path: Path, monkeypatch) -> None:
    with pytest.raises(UserError, match="nowhere.onnx cannot be read .*robust or pretrained"):
        load_policy("nowhere.onnx")
    with pytest.raises(UserError, match="not in a run's folder"):
        load_policy(tmp_path)
    shipped = resource_path("pretrained/pretrained.onnx").read_bytes()
    foreign = onnx.load_from_string(shipped)
    del foreign.metadata_props[:]
    older = onnx.load_from_string(shipped)
    entries = {prop.key: prop for prop in older.metadata_props}
    entries["format"].value = "1"
    older.metadata_props.remove(entries["estimator"])
    unknown = onnx.load_from_string(shipped)
    for prop in unknown.metadata_props:
        prop.value = prop.value.replace("ball_velocity", "ball_colour")
    recurrent = onnx.load_from_string(shipped)
    recurrent.metadata_props.add(key="memory_size", value="128")
    broken = {
        "its network has a memory": recurrent.SerializeToString(),
        "its input ball_colour is unknown": unknown.SerializeToString(),
        "text": b"hello",
        "half": shipped[: len(shipped) // 2],
        "lacks format": foreign.SerializeToString(),
        "format is 1, not 2": older.SerializeToString(),
    }
    for reason, content in broken.items():
        (tmp_path / "a.onnx").write_bytes(content)
        with pytest.raises(UserError, match="a.onnx is no policy .*bounce-mjx export") as refusal:
            load_policy(tmp_path / "a.onnx")
        assert " " not in reason or reason in str(refusal.value)
    monkeypatch.setattr(loading, "resource_path", lambda name: tmp_path / name)
    with pytest.raises(UserError, match="the policy robust is not in this version .*pretrained"):
        load_policy("robust")


WRONG_ENTRIES = {
    "control_dt": [1e-300, 0.0, -0.01, 1e300, float("nan"), "0.01", None, True, [0.01]],
    "action_scale": [float("inf"), 1e300, -0.1, {}],
    "format": [2.0, "2", [2], None],
    "steps": [-1, 1.5, True],
    "joint_names": ["Joint1", ["Joint1"] * 5, [1] * 6, {}, []],
    "joint_ranges": [
        [[1.0, -1.0]] * 6,
        [[0.0, float("nan")]] * 6,
        [[0.0, 1.0, 2.0]] * 6,
        [0.0] * 6,
    ],
    "servo_stiffness": [[1.0] * 5, 3.0],
    "torque_limits": [[None] * 7],
    "velocity": ["guessed", ["filter"], None],
    "position": ["differences", 3],
    "estimator": [None, {}, []],
    "paddle": [[0.0, 0.0], [1e300, 0.0, 0.0]],
    "paddle_normal": [[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]],
    "chain": [[], {}, [{"joint": 0}], None],
    "observation": [[], {}, [["joint_angles", 1, 6, "rad"]]],
    "randomization": [{"ball_mass": 1.0}, []],
}


@pytest.fixture(scope="module")
def filtered(tmp_path_factory: pytest.TempPathFactory) -> onnx.ModelProto:
    """A policy that sees every kind of quantity, the ball by the Kalman filter."""
    observation = ALL | {"position": "filter", "velocity": "filter", "ball_velocity": 2}
    run = make_run(tmp_path_factory.mktemp("filtered") / "run", {"observation": observation})
    model = export_onnx(find_checkpoint(run))
    DeployedPolicy(model, "the file before the edits")
    return onnx.load_from_string(model)


def edited(model: onnx.ModelProto, name: str, text: str) -> bytes:
    """An ONNX file with another text of an entry."""
    copy = onnx.ModelProto.FromString(model.SerializeToString())
    (prop,) = (prop for prop in copy.metadata_props if prop.key == name)
    prop.value = text
    return copy.SerializeToString()


@pytest.mark.parametrize("name", WRONG_ENTRIES)
def test_a_wrong_entry_is_refused_by_name(name: str, filtered: onnx.ModelProto) -> None:
    for value in WRONG_ENTRIES[name]:
        with pytest.raises(UserError, match="^a.onnx is no policy .*; give a file") as refusal:
            DeployedPolicy(edited(filtered, name, json.dumps(value)), "a.onnx")
        reason = str(refusal.value)
        words = (name, "estimator", "joints", "inputs", "length than 1")
        assert len(reason) < 400 and any(word in reason for word in words), (value, reason)


def nodes(value: object) -> list[tuple[object, object]]:
    """Every (group or list, key) in JSON."""
    keys = (
        value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    )
    return [place for key in keys for place in [(value, key), *nodes(value[key])]]


def random_edit(rng: random.Random, text: str) -> str:
    """JSON with one value replaced, removed, repeated or scaled, or with one character changed."""
    if rng.random() < 0.1:
        at = rng.randrange(len(text))
        return text[:at] + rng.choice('0123456789-.eE"[]{},:nN') + text[at + 1 :]
    whole = [json.loads(text)]
    group, key = rng.choice(nodes(whole))
    value, hostile = group[key], (0, -1, 1e-300, 1e300, 1e30, 10**400, math.nan, math.inf, True)
    kind = rng.randrange(4)
    if kind == 0:
        group[key] = rng.choice([*hostile, None, "", "a", [], {}, [[]], 1, 7, 0.5, 1e-3, 1e4])
    elif kind == 1 and type(value) in (int, float):
        group[key] = value * rng.choice((-1, 0.5, 2, 10, 1e3, 1e-3, 1e-6, 1e6))
    elif kind == 2 and isinstance(group, list):
        group.insert(key, value)
    elif group is not whole:
        del group[key]
    return json.dumps(whole[0])


def test_an_edited_file_is_refused_or_acts_within_the_ranges(filtered: onnx.ModelProto) -> None:
    rng, acting = random.Random(0), 0
    entries = {prop.key: prop.value for prop in filtered.metadata_props}
    for _ in range(500):
        name = rng.choice(list(entries))
        text = random_edit(rng, entries[name])
        try:
            policy = DeployedPolicy(edited(filtered, name, text), "a.onnx")
        except UserError as error:
            assert "a.onnx is no policy" in str(error) and "\n" not in str(error), (name, text)
            continue
        ranges = [limits or (-math.inf, math.inf) for limits in policy.metadata.joint_ranges]
        low, high = np.transpose(ranges)
        for time in (0.0, 0.01, 0.02, 0.05, 0.06):
            measured = {k: v for k, v in falling(time).items() if k in (*policy.needs, "time")}
            action = policy.step(measured)
            targets = policy.servo_targets(action)
            assert np.all(np.abs(action) <= 1.0), (name, text)
            assert np.all(np.isfinite(targets) & (low <= targets) & (targets <= high)), (name, text)
        acting += 1
    # Some edits only change a number.
    assert 20 < acting < 400


def test_a_network_that_gives_no_number_is_refused(filtered: onnx.ModelProto) -> None:
    copy = onnx.ModelProto.FromString(filtered.SerializeToString())
    (bias,) = (tensor for tensor in copy.graph.initializer if tensor.name == "mean/bias")
    array = onnx.numpy_helper.to_array(bias).copy()
    array[0] = np.nan
    bias.CopyFrom(onnx.numpy_helper.from_array(array, bias.name))
    with pytest.raises(UserError, match="a.onnx is no policy .*not finite"):
        DeployedPolicy(copy.SerializeToString(), "a.onnx")


@pytest.mark.parametrize(
    "action", [[np.nan] * 6, [np.inf] * 6, [0.0] * 5, [[0.0] * 6], "up", None, [5.0] * 6]
)
def test_no_servo_targets_for_a_wrong_action(action, policies) -> None:
    policy = policies["all histories"]
    policy.reset()
    policy.step(falling(0.0))
    with pytest.raises(UserError, match="the action .*give .*numbers .*from -1 to 1"):
        policy.servo_targets(action)


@pytest.mark.parametrize("package", ["onnx", "onnxruntime", "flatbuffers"])
def test_a_missing_package_is_named(package: str, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    use = {
        "onnx": lambda: export_onnx(pretrained_checkpoint()),
        "onnxruntime": lambda: load_policy("pretrained"),
        "flatbuffers": lambda: export_jax(pretrained_checkpoint()),
    }
    with pytest.raises(UserError, match=f"^{package} cannot be imported.*pip install"):
        use[package]()


# All dependencies of the project except NumPy and onnxruntime.
BLOCKED = (
    "jax jaxlib mujoco flax optax orbax pydantic pydantic_core tensorstore yaml rich tyro onnx "
    "matplotlib scipy brax gymnasium torch"
)


def test_it_runs_with_numpy_and_onnxruntime_alone(tmp_path: Path) -> None:
    script = f"""
import importlib.abc, sys

class Blocker(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {BLOCKED.split()!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Blocker())
import numpy as np
from bounce_mjx import load_policy
from bounce_mjx.errors import UserError
policy = load_policy("pretrained")
action = policy.step({{
    "joint_angles": [0.0, 0.7, 1.9, 0.0, -1.0, 0.0], "joint_velocities": np.zeros(6),
    "ball_position": [0.6, 0.0, 0.4], "ball_velocity": [0.0, 0.0, -1.0], "target_height": 0.5}})
print(action.shape, policy.servo_targets(action).shape, bool(np.all(np.abs(action) <= 1.0)))
try:
    load_policy(sys.argv[1])
except UserError as error:
    print(error)
"""
    done = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    shapes, refusal = done.stdout.splitlines()
    assert shapes == "(6,) (6,) True"
    assert "must be exported, for which" in refusal and "bounce-mjx export" in refusal


def test_the_shipped_policy_bounces_on_plain_mujoco() -> None:
    perfect = EXAMPLE["Camera"](rate=1000.0, noise=0.0, delay=0.0)
    bounces, survived = EXAMPLE["simulate"](load_policy("pretrained"), perfect, 8.0, 0.5)
    assert bounces >= 10 and survived == pytest.approx(8.0)


def test_only_the_robust_policy_bounces_with_a_late_camera() -> None:
    """On plain MuJoCo; the defaults of the example."""
    (bounces, survived), (lost_bounces, lost_at) = (
        EXAMPLE["simulate"](load_policy(name), EXAMPLE["Camera"](120.0, 0.002, 0.020), 8.0, 0.5)
        for name in ("robust", "pretrained")
    )
    assert bounces >= 10 and survived == pytest.approx(8.0)
    assert lost_bounces < 5 and lost_at < 4.0


def test_the_example_prints_bounces_and_time(monkeypatch, capsys) -> None:
    source = CHECKOUT / "examples" / "deploy.py"
    assert len(source.read_text(encoding="utf-8").splitlines()) <= 80
    monkeypatch.setattr(sys, "argv", ["deploy.py", "pretrained", "--seconds", "0.6"])
    runpy.run_path(str(source), run_name="__main__")
    # The ball falls 0.36 m in 0.27 s and returns 0.5 s later.
    assert capsys.readouterr().out == "1 bounces in 0.6 s of 0.6 s\n"


def test_the_example_has_a_late_camera() -> None:
    camera = EXAMPLE["Camera"](rate=100.0, noise=0.0, delay=0.020)
    for step in range(101):
        camera.look(step * 0.001, np.array([0.0, 0.0, 3.0 * step * 0.001]))
    measured = camera.measure(0.1)
    assert measured["ball_position"][2] == pytest.approx(0.24)
    assert measured["ball_velocity"][2] == pytest.approx(3.0)
    assert measured["ball_age"] == pytest.approx(0.02)


def test_command_writes_both_files(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    export_command.main("pretrained --onnx policy.onnx --jax policy.jax".split())
    shipped = resource_path("pretrained/pretrained.onnx").read_bytes()
    assert (tmp_path / "policy.onnx").read_bytes() == shipped
    artefact = jax.export.deserialize((tmp_path / "policy.jax").read_bytes())
    assert artefact.out_avals[0].shape[1:] == (6,)
    assert "written: policy.onnx" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("args", "words"),
    [
        ("pretrained", "give --onnx FILE or --jax FILE"),
        ("pretrained --onnx nowhere/a.onnx", "folder of --onnx nowhere/a.onnx does not exist"),
        ("pretrained --jax .", "--jax . is a folder"),
        ("nowhere --onnx a.onnx", "no checkpoint folder nowhere"),
    ],
)
def test_command_refuses(args: str, words: str, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_info:
        export_command.main(args.split())
    error = capsys.readouterr().err
    assert exit_info.value.code == 2 and words in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())
