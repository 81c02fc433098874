"""An exported policy computes what JAX computes, and acts as in the environment."""

import inspect
import math
import os
import re
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

from bounce_mjx import BounceBall, EnvConfig, load_policy
from bounce_mjx.config.user_code import import_code
from bounce_mjx.deploy.export import export_onnx, policy_metadata
from bounce_mjx.deploy.graph import onnx_graph
from bounce_mjx.deploy.metadata import (
    TERMS_PER_JOINT,
    CommandLimits,
    GoalRange,
    from_entries,
    in_driver_order,
    to_entries,
)
from bounce_mjx.deploy.motion import paddle_position
from bounce_mjx.deploy.policy import DeployedPolicy
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.learning.policy import Policy, make_networks
from bounce_mjx.learning.statistics import Normalizer
from bounce_mjx.resources import resource_path
from bounce_mjx.robot.model import load_model
from bounce_mjx.runs import checkpoints
from bounce_mjx.runs.checkpoints import save_checkpoint
from bounce_mjx.runs.config import TrainConfig, load_run_config
from bounce_mjx.runs.creation import save_config
from bounce_mjx.runs.folders import find_checkpoint
from bounce_mjx.world.randomization import EACH_JOINT, TERMS
from bounce_mjx.world.sensing import Sensing
from deployed import ball_over, changed_policy

CHECKOUT = Path(__file__).resolve().parent.parent

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
QUANTITIES = EnvConfig().observation.quantities()
# A ball bounces for seconds on a level paddle that hardly moves: with such stiff servos the arm
# sinks only by micrometres.
STIFF = {"servo_gain": (100.0, 100.0), "servo_damping": (10.0, 10.0)}
LEVEL = {
    # Exported without a simulation of own play.
    "action": {"base": "target"},
    "action_scale": 1e-5,
    "ball_init_pos": (0.58856, 0.01, 1.0),
    "reset": {"ball_position": 0.0, "joint_angles": 0.0, "joint_velocities": 0.0},
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
            "goal_interval": (0.3, 0.5),
        },
        **LEVEL,
    },
    "another task": {
        "observation": {"ball_position": 2, "action": 2},
        "randomization": STIFF,
        **LEVEL,
    },
}
LIMITS = "velocity", "acceleration", "jerk"
ENVS["leading targets"] = ENVS["all histories"] | {
    "observation": ALL | {"servo_lead": 3},
    "action": {"base": "target", "max_lead": 2e-4},
    "action_scale": 1e-4,
    "robot": {"limits": {n: (x,) * 6 for n, x in zip(LIMITS, (9e-3, 0.5, 200.0), strict=True)}},
}


def input_name(quantity: str) -> str:
    """Name of the exported policy's input for a quantity."""
    return "past_actions" if quantity == "action" else quantity


def make_run(folder: Path, env: dict, task: str = "bounce") -> Path:
    """Writes a run with a random policy; its first input never varied in the training."""
    config = TrainConfig(task=task, env=env, ppo={"hidden_layers": (24, 8)})
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
    save_checkpoint(folder, config, 64, {"policy": Policy(normalizer, params)})
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Runs for each of ENVS, of which "another task" is tracking, and of two shipped policies."""
    folder = tmp_path_factory.mktemp("runs")
    made = {
        name: make_run(
            folder / name.replace(" ", "_"), env, "track" if name == "another task" else "bounce"
        )
        for name, env in ENVS.items()
    }
    shipped = {"pretrained": "pretrained", "robust": "pretrained/robust"}
    return made | {name: resource_path(folder) for name, folder in shipped.items()}


@pytest.fixture(scope="module")
def policies(runs: dict[str, Path]) -> dict[str, DeployedPolicy]:
    return {name: load_policy(run) for name, run in runs.items()}


def draw_inputs(name: str, runs: dict[str, Path]) -> tuple[dict, np.ndarray]:
    """1,000 inputs of a policy's network by the names of the quantities, and the actions of JAX."""
    checkpoint = find_checkpoint(runs[name])
    config = load_run_config(checkpoint.run)
    policy = checkpoints.read_policy(checkpoint, config)
    layout, counts = config.env.layout, config.env.observation.counts()
    rng = np.random.default_rng(3)
    # Some observations are beyond the clipping range of the normaliser.
    spread = rng.choice([1.0, 1.0, 1.0, 20.0], size=(1000, 1))
    noise = spread * rng.normal(size=(1000, layout.size))
    mean, std = (np.asarray(array) for array in policy.normalizer)
    observation = (mean + std * noise).astype(np.float32)
    inputs = {
        name: observation[:, layout[name]].reshape(1000, count, -1)
        for name, count in counts.items()
    }
    networks = make_networks(config.ppo, layout.size, config.env.num_joints)
    return inputs, np.asarray(networks.act(policy, observation))


# Functions of a vector x [3], a matrix a [2, 3], a number s, whole numbers i [3], and truth values
# b [3] and p. Together they have every operation that a graph may have.
FUNCTIONS = {
    "arithmetic": lambda x, s: -x * s + 2.0 - x / 3.0,
    "functions": lambda x: jnp.sin(x) + jnp.cos(x) * jnp.tanh(x) + jnp.tan(x) - jnp.exp(x),
    "of positive": lambda x: jnp.sqrt(jnp.abs(x)) + jnp.log(jnp.abs(x)) + jnp.abs(x) ** 0.7,
    "powers": lambda x: x**2 + x**3 + jnp.square(x) + 1.0 / x**2,
    "rounding": lambda x: jnp.floor(x) + jnp.ceil(x) + jnp.sign(x) + x % 0.3,
    "limits": lambda x: jnp.clip(x, -0.5, 0.5) + jax.lax.clamp(-0.3, x, 0.7) + jnp.maximum(x, 0.1),
    "activations": lambda x: jax.nn.relu(x) + jax.nn.silu(x) + jax.nn.sigmoid(x) + jax.nn.elu(x),
    "no gradient": lambda x: jax.lax.stop_gradient(x) + jnp.copy(x),
    "whole numbers": lambda i: jnp.abs(i) + i * 2 - jnp.minimum(i, 1) + jnp.sign(-i) + i * i,
    "reductions": lambda i, x: jnp.sum(i) + i.max() - i.min() + jnp.mean(x) + x.max() - x.min(),
    "of a matrix": lambda a: a.sum(0) + a.max(1).min() + jnp.var(a) + jnp.linalg.norm(a),
    "truth": lambda b, i: jnp.any(b) & jnp.all(i < 2) | (b[0] != b[1]) ^ ~b[2],
    "comparisons": lambda x, i: jnp.stack([x > 0.1, x >= i, x < i, x <= 0, i == 1, i != 2]),
    "conversions": lambda x, b: x.astype(jnp.int32) + b.astype(jnp.int32) + x.astype(bool),
    "a choice": lambda p, a, s: jnp.where(p, a, s) + jnp.where(a > 0, 1.0, a),
    "a choice of truth": lambda p, b: jnp.where(p, b, ~b[::-1]),
    "constants": lambda x: jnp.arange(3.0) * 2 + x + jnp.ones((2, 3))[0],
    "slices": lambda x, a: jnp.concatenate([x[:1], a[1], x[:0], x[::-1], x[np.array([0, 2])]]),
    "changes": lambda x: x.at[0].set(x[2]) + x.at[1:].set(4.0),
    "moves": lambda x: jnp.concatenate([jnp.roll(x, 1), jnp.pad(x, 1), jnp.tile(x, 2), x]),
    "shapes": lambda a: jnp.repeat(a, 2, 0).reshape(3, 4).T[:, None] + jnp.zeros((4, 2, 3)),
    "parts": lambda x: sum(jnp.split(x, 3)) + jnp.append(x, 1.0)[3:],
    "windows": lambda x: jax.lax.dynamic_slice(x, (1,), (2,)),
    "an update": lambda x: jax.lax.dynamic_update_slice(x, jnp.ones(2), (1,)),
    "products": lambda x: jnp.outer(x, x) + x @ jnp.arange(6.0).reshape(3, 2)[:, :1],
    "cross": lambda x: jnp.cross(x, x[::-1]) + jnp.hypot(x[0], x[1]),
}


@pytest.fixture(scope="module")
def rows() -> dict[str, np.ndarray]:
    """Seven rows of the arguments of `FUNCTIONS`."""
    rng = np.random.default_rng(0)
    numbers = {"x": (7, 3), "a": (7, 2, 3), "s": (7,)}
    floats = {k: rng.normal(size=shape).astype(np.float32) for k, shape in numbers.items()}
    truths = {"b": rng.random((7, 3)) < 0.5, "p": rng.random(7) < 0.5}
    return floats | truths | {"i": rng.integers(-3, 4, (7, 3)).astype(np.int32)}


def graph_of(function, rows: dict[str, np.ndarray]) -> tuple[onnx.GraphProto, dict]:
    """The graph of a function with the output `result`, and its inputs."""
    given = {name: rows[name] for name in inspect.signature(function).parameters}
    shapes = {k: jax.ShapeDtypeStruct(v.shape[1:], v.dtype) for k, v in given.items()}
    graph = onnx_graph(lambda named: {"result": function(**named)}, shapes, "the task Test")
    return graph, given


@pytest.mark.parametrize("function", FUNCTIONS.values(), ids=FUNCTIONS)
def test_a_graph_computes_what_jax_computes(function, rows) -> None:
    graph, given = graph_of(function, rows)
    opset = [onnx.helper.make_opsetid("", 17)]
    model = onnx.helper.make_model(graph, opset_imports=opset, ir_version=8)
    onnx.checker.check_model(model, full_check=True)
    session = onnxruntime.InferenceSession(
        model.SerializeToString(), providers=["CPUExecutionProvider"]
    )
    (result,) = session.run(["result"], given)
    expected = np.asarray(jax.jit(jax.vmap(lambda named: function(**named)))(given))
    assert result.dtype == expected.dtype
    np.testing.assert_allclose(result, expected, rtol=2e-5, atol=2e-6)


REFUSED = {
    "sort": lambda x: jnp.sort(x),
    "atan2": lambda x: jnp.arctan2(x, x),
    "scan": lambda x: jax.lax.fori_loop(0, 3, lambda _, y: 2.0 * y, x),
    "dynamic_slice": lambda x, i: x[i[0]],
    "dot_general": lambda a, x: a @ x,
    "div of int32": lambda i: jax.lax.div(i, i),
    "mul of float16": lambda x: x.astype(jnp.float16) * 2,
}


def test_an_operation_without_a_counterpart_is_named(rows) -> None:
    for operation, function in REFUSED.items():
        with pytest.raises(
            UserError, match=f"^the task Test uses the operation {operation}.*; use"
        ):
            graph_of(function, rows)


@pytest.mark.parametrize(
    "name", [pytest.param("specification", marks=pytest.mark.slow), "pretrained"]
)
def test_onnx_equals_jax(name: str, runs: dict[str, Path]) -> None:
    inputs, expected = draw_inputs(name, runs)
    given = {input_name(quantity): values for quantity, values in inputs.items()}
    graph = export_onnx(find_checkpoint(runs[name]))
    session = onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
    (actions,) = session.run(["action"], given)
    np.testing.assert_allclose(actions, expected, rtol=0.0, atol=1e-5)
    # Some actions are clipped and some are not.
    assert 0.0 < np.mean(np.abs(expected) == 1.0) < 0.9


OWN_LIMITS = {"velocity": (2.0,) * 6, "acceleration": (15.0,) * 6, "jerk": (7500.0,) * 6}


def test_metadata_describes_the_training_and_survives_the_file() -> None:
    ranges = {"air_drag": (0.0, 0.2), "paddle_tilt": ((-0.08, 0.01), (-0.07, 0.03))}
    limits = {"robot": {"limits": OWN_LIMITS}, "action": {"base": "target"}}
    metadata = policy_metadata(TrainConfig(env={"randomization": ranges} | limits), 64)
    assert from_entries(to_entries(metadata)) == metadata
    assert metadata.limits == CommandLimits(**OWN_LIMITS) and metadata.steps == 64
    assert metadata.randomization == {
        "air_drag": (0.0, 0.2), "paddle_tilt[0]": (-0.08, -0.07), "paddle_tilt[1]": (0.01, 0.03)
    }  # fmt: skip
    config = EnvConfig()
    assert {p.name: p.history for p in metadata.observation} == {
        input_name(name): count for name, count in config.observation.counts().items()
    }
    assert metadata.joint_names == tuple(f"Joint{i}" for i in range(1, 7))
    assert metadata.control_dt == config.control_dt and metadata.torque_limits == (None,) * 6
    assert metadata.goals == {"target_height": GoalRange((0.4, 0.6), "m")}
    assert metadata.servo_stiffness == (20000.0,) * 6 and metadata.servo_damping == (200.0,) * 6
    assert (metadata.task, metadata.robot, metadata.action_base) == ("bounce", "AIR4-560", "target")
    # In a control step of 10 ms at 2 rad/s.
    np.testing.assert_allclose(metadata.largest_step, 0.02)


def test_a_drivers_order_is_that_of_the_terms_too() -> None:
    """Of those of each joint; of a paddle's axes not."""
    of_joints = {name for name, term in TERMS.items() if term.size is EACH_JOINT}
    assert TERMS_PER_JOINT == of_joints
    gains = tuple(zip((0.8, 0.81, 0.82, 0.83, 0.84, 0.85), (1.2,) * 6, strict=True))
    tilts = ((-0.2, 0.0), (0.0, 0.1))
    terms = {"servo_gain": tuple(zip(*gains, strict=True)), "paddle_tilt": tilts}
    metadata = policy_metadata(TrainConfig(env={"randomization": terms}), 64)
    order = [3, 4, 5, 0, 2, 1]
    names = [metadata.joint_names[i] for i in order]
    ranges = in_driver_order(metadata, names, order).randomization
    assert ranges.keys() == metadata.randomization.keys()
    assert [ranges[f"servo_gain[{i}]"] for i in range(6)] == [gains[i] for i in order]
    assert (ranges["paddle_tilt[0]"], ranges["paddle_tilt[1]"]) == ((-0.2, 0.0), (0.0, 0.1))


def test_servo_targets_lead_the_measured_angles_as_in_the_environment() -> None:
    """The policy's actions add to its last targets; a step that is repeated changes nothing."""
    env = BounceBall(EnvConfig(action={"base": "target", "max_lead": 0.03}))
    policy = changed_policy("pretrained", max_lead=0.03)
    rng = np.random.default_rng(0)
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    for step in range(12):
        pipeline = state.pipeline_state
        angles = np.asarray(pipeline.physics.qpos[:6]) + 0.001 * step
        physics = pipeline.physics._replace(qpos=pipeline.physics.qpos.at[:6].set(angles))
        state = state.replace(pipeline_state=pipeline._replace(physics=physics))
        for _ in range(2):
            given = {"joint_angles": angles, "joint_velocities": np.full(6, 0.1 * step)}
            policy.step(measured_once() | given | {"time": 0.01 * step})
        action = rng.uniform(0.0, 1.0, 6)
        pipeline = state.pipeline_state
        control, actuation = env.control(pipeline, jnp.asarray(action, jnp.float32))
        state = state.replace(pipeline_state=pipeline._replace(actuation=actuation))
        targets = policy.servo_targets(action)
        np.testing.assert_allclose(targets, control.ctrl, atol=1e-6)
    assert np.abs(targets - angles).max() > 0.025


MJCF = resource_path("mjcf/bounce_ball.xml").read_text(encoding="utf-8")


def test_paddle_position_is_that_of_mujoco(tmp_path: Path) -> None:
    """Also with anchors and references of joints."""
    text = MJCF.replace('name="Joint3"', 'name="Joint3" pos="0.01 0.02 -0.03" ref="0.4"')
    text = text.replace('name="Joint5"', 'name="Joint5" pos="-0.02 0.01 0.03"')
    assert text.count(' ref="0.4"') == 1 and text.count('name="Joint5" pos') == 1
    (tmp_path / "arm.xml").write_text(text, encoding="utf-8")
    metadata = policy_metadata(TrainConfig(env={"mjcf": tmp_path / "arm.xml"}), 0)
    model = load_model(tmp_path / "arm.xml", 0.001)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(20):
        angles = rng.uniform(-2.0, 2.0, 6)
        data.qpos[:6] = angles
        mujoco.mj_kinematics(model, data)
        position = paddle_position(metadata, angles)
        np.testing.assert_allclose(position, data.geom("blocker").xpos, atol=1e-12)


def measured_by(sensing: Sensing, goal: dict) -> dict[str, np.ndarray]:
    """Newest measurements in an environment's sensor memory."""
    names = ("joint_angles", "joint_velocities", "ball_quaternion", "ball_angular_velocity")
    known = sensing.histories
    measured = {name: np.asarray(known[name][0]) for name in names if name in known}
    return (
        measured
        | goal
        | {
            "ball_position": np.asarray(sensing.picture.position),
            "ball_velocity": np.asarray(sensing.picture.velocity),
        }
    )


@pytest.mark.parametrize("name", ["leading targets", "sensors", "another task"])
@pytest.mark.slow
def test_histories_are_those_of_the_environment(name: str, runs, policies) -> None:
    """Policy and environment run side by side in a closed loop."""
    env, policy = Env(load_run_config(runs[name]).env), policies[name]
    step, state = jax.jit(env.step), jax.jit(env.reset)(jax.random.PRNGKey(5))
    policy.reset()
    own = {name: set() for name in env.config.observation.counts("task")}
    goals, reached = set(), set()
    for i in range(300):
        state_now = state.pipeline_state
        measured = measured_by(state_now.sensing, state_now.goal)
        if name == "sensors":
            measured["ball_age"] = state_now.sensing.picture.age
        action = policy.step(measured | {"time": 7.0 + i * env.dt})
        # The environment's targets add up in single precision.
        tolerance = 1e-5 + (1e-7 * i if name == "leading targets" else 0.0)
        np.testing.assert_allclose(policy.observation, state.obs, 0, tolerance, err_msg=f"{i}")
        for quantity, values in own.items():
            values.add(tuple(policy.observation[env.layout[quantity]]))
        goals |= set(map(float, state_now.goal.values()))
        reached |= set(np.flatnonzero(policy.observation))
        state = step(state, jnp.asarray(action, jnp.float32))
        assert not state.done, i
    assert len(goals) >= (5 if name in ("sensors", "another task") else 1)
    # The start and at least four bounces.
    assert min(map(len, own.values())) >= 5
    # Every entry changed, except the ball's orientation and spin.
    still = set()
    if name != "another task":
        still = {*range(env.layout.size)[env.layout["ball_quaternion"]][1:]}
        still |= {*range(env.layout.size)[env.layout["ball_angular_velocity"]]}
    assert set(range(env.layout.size)) - reached <= still


@pytest.mark.slow
def test_a_policy_of_two_balls_sees_what_the_environment_sees(tmp_path: Path) -> None:
    """In rows or one after another, from noisy and late pictures."""
    env = {
        "observation": {"ball_position": 2, "velocity": "differences"},
        "randomization": {"ball_position_noise": (0.001, 0.001), "ball_latency": (0.01, 0.02)},
        "action_scale": 1e-3,
    }
    run = make_run(tmp_path / "run", env, "juggle")
    env, policy = Env(load_run_config(run).env), load_policy(run)
    step, state = jax.jit(env.step), jax.jit(env.reset)(jax.random.PRNGKey(5))
    nexts = set()
    for i in range(40):
        now = state.pipeline_state
        sensing = now.sensing
        balls = np.asarray(sensing.picture.position)
        measured = {
            "joint_angles": sensing.histories["joint_angles"][0],
            "joint_velocities": sensing.histories["joint_velocities"][0],
            "ball_position": balls if i % 2 else balls.ravel(),
        }
        action = policy.step(measured | now.goal)
        np.testing.assert_allclose(policy.observation, state.obs, atol=1e-5, err_msg=f"step {i}")
        nexts.add(bool(policy.observation[env.layout["next_ball"]][3] > 0.0))
        state = step(state, jnp.asarray(action, jnp.float32))
    # Each ball was the next one.
    assert policy.metadata.num_balls == 2 and len(nexts) == 2
    for wrong in (np.zeros(3), np.zeros((3, 2))):
        with pytest.raises(UserError, match="ball_position has the shape .*; give 6 numbers"):
            policy.step(measured | now.goal | {"ball_position": wrong})


def measured_once() -> dict:
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
        "joint_velocities": np.full(6, 0.3),
        "ball_position": measured["ball_position"] - 1.5 * time,
        "time": time,
    }


def test_histories_stay_in_control_steps(policies) -> None:
    """A late call leaves the same positions as punctual calls, and jitter does not matter."""
    policy = policies["all histories"]
    ends = np.cumsum([part.history * part.size for part in policy.metadata.observation])
    names = [part.name for part in policy.metadata.observation]
    place = names.index("ball_position")
    ball = slice([0, *ends][place], ends[place])

    def seen_after(steps: np.ndarray, errors: np.ndarray) -> np.ndarray:
        policy.reset()
        for i, error in zip(steps, errors, strict=True):
            policy.step(falling(0.01 * i) | {"time": 0.01 * i + error})
        return policy.observation

    steps, jitter = np.arange(12), np.random.default_rng(0).uniform(-0.002, 0.002, 12)
    punctual = seen_after(steps, np.zeros(12))
    np.testing.assert_array_equal(seen_after(steps, jitter), punctual)
    late = seen_after(np.delete(steps, [4, 5, 8]), np.zeros(9))
    np.testing.assert_allclose(late[ball], punctual[ball], atol=1e-12)


def height_at(time: float) -> float:
    """Of a ball that was thrown up, m."""
    return 0.3 + 2.0 * time - 0.5 * 9.81 * time**2


def velocities_seen(policy: DeployedPolicy, calls: list[tuple[float, float]]) -> list[float]:
    """Vertical velocities that a policy of differences makes of this ball.

    Args:
      calls: the time of each, and when its picture was taken, s.
    """
    place = 0
    for part in policy.metadata.observation:
        if part.name == "ball_velocity":
            break
        place += part.history * part.size
    policy.reset()
    seen = []
    for time, taken in calls:
        ball = {"ball_position": [0.6, 0.01, height_at(taken)], "ball_age": time - taken}
        policy.step(falling(0.0) | ball | {"time": time, "joint_velocities": np.zeros(6)})
        seen.append(float(policy.observation[place + 2]))
    return seen


def velocities_between(calls: list[tuple[float, float]]) -> list[float]:
    """The velocity between the last two pictures, each later than the one before, of the calls
    that are new control steps."""
    velocities: list[float] = []
    number, before, last = -1, None, None
    for time, picture in calls:
        step = round((time - calls[0][0]) / 0.01)
        if step > number and (last is None or picture > last):
            before, last = last, picture
        number = max(number, step)
        velocity = 0.0
        if before is not None:
            velocity = (height_at(last) - height_at(before)) / (last - before)
        velocities.append(velocity)
    return velocities


def test_a_velocity_from_differences_is_of_the_real_time_between_pictures(policies) -> None:
    """Whenever the calls come, also late ones; an older picture is not a newer one."""
    policy = policies["sensors"]
    rng = np.random.default_rng(0)
    calls = []
    for step in range(40):
        time = 0.01 * step + rng.uniform(-0.004, 0.004)
        calls.append((time, 0.0083 * math.floor((time - 0.005) / 0.0083)))
    late = [call for step, call in enumerate(calls) if step not in (10, 11, 20)]
    # The third call comes earlier after the second than a control step; the fourth has an older
    # picture, which came late.
    shown = [(0.0, 0.0), (0.010, 0.008), (0.023, 0.008), (0.030, 0.008), (0.040, 0.0), (0.05, 0.04)]
    for given in (calls, late, shown):
        seen = velocities_seen(policy, given)
        expected = velocities_between(given)
        assert len(set(expected)) >= 3
        np.testing.assert_allclose(seen, expected, rtol=1e-5)


FORGETFUL = """
from bounce_mjx.task.track import Track

class Config(Track.Config):
    pass

class Forgetful(Track):
    Config = Config

    def first_quantities(self, measured):
        return (), {"aim": measured["ball_position"][:2]}

    def next_quantities(self, memory, histories, measured):
        return (), {"aim": measured["ball_position"][None, :2]}
"""


def test_a_task_need_not_look_at_its_last_quantities(tmp_path: Path) -> None:
    (tmp_path / "forgetful.py").write_text(FORGETFUL, encoding="utf-8")
    import_code(tmp_path / "forgetful.py")
    run = make_run(tmp_path / "run", {"observation": {"ball_position": 2}, **LEVEL}, "forgetful")
    policy = load_policy(run)
    place = [part.name for part in policy.metadata.observation].index("aim")
    start = sum(part.history * part.size for part in policy.metadata.observation[:place])
    for step in range(3):
        given = falling(0.01 * step) | dict.fromkeys(policy.metadata.goals, 0.5)
        policy.step({key: given[key] for key in policy.needs})
        aim = policy.observation[start : start + 2]
        np.testing.assert_allclose(aim, given["ball_position"][:2], atol=1e-6)


WRONG = {
    "missing": ({"ball_position": None}, "ball_position is missing", "needs joint_angles"),
    "unknown": ({"ball_positon": [0, 0, 0]}, "ball_positon is not a measurement", "ball_position"),
    "short": ({"joint_angles": [0.0] * 5}, "joint_angles has the shape [5]", "6 numbers (rad)"),
    "column": ({"ball_position": [[0], [0], [1]]}, "has the shape [3, 1]", "3 numbers (m)"),
    "words": ({"target_height": "high"}, "target_height is 'high'", "one number (m)"),
    "nan": ({"joint_velocities": [0, 0, np.nan, 0, 0, 0]}, "holds nan", "finite", "rad/s"),
    "huge": ({"ball_position": [0, 0, 1e300]}, "holds 1e+300", "finite numbers (m)"),
    "a long pause": ({"time": 1003.0}, "1e+03 s after the last", "call reset", "give seconds"),
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
    observation = dict.fromkeys(QUANTITIES, 0) | {
        "ball_position": 2,
        "ball_quaternion": 1,
        "action": 1,
    }
    # A target that varies would have to be seen.
    env = {"observation": observation, "target_height_range": (0.5, 0.5)}
    policy = load_policy(make_run(tmp_path / "run", env))
    assert policy.needs == ("ball_position",)
    policy.step({"ball_position": (0.1, 0.2, 0.3)})
    policy.step({"ball_position": (0.12, 0.22, 0.32)})
    expected = [0.12, 0.22, 0.32, 0.1, 0.2, 0.3, 1.0, 0.0, 0.0, 0.0]
    np.testing.assert_array_equal(policy.observation[:10], expected)
    with pytest.raises(UserError, match="call step with joint_angles first"):
        policy.servo_targets(np.zeros(6))


@pytest.mark.parametrize("name", ["pretrained", "robust"])
def test_the_shipped_file_is_a_fresh_export(name: str, runs: dict[str, Path]) -> None:
    """Another version of JAX may write other nodes, but they compute the same."""
    file = runs[name] / f"{name}.onnx"
    fresh = export_onnx(find_checkpoint(runs[name]))
    stale = f"{file} is stale; write it with bounce-mjx export {name} --onnx {file}"
    assert onnx.load(file).metadata_props == onnx.load_from_string(fresh).metadata_props, stale
    policies = [DeployedPolicy(content, name) for content in (file.read_bytes(), fresh)]
    paddle = paddle_position(policies[0].metadata, measured_once()["joint_angles"])
    for i in range(100):
        swing = 0.03 * math.sin(0.05 * i)
        arm = {"joint_angles": measured_once()["joint_angles"] + swing, "target_height": 0.5}
        arm["joint_velocities"] = np.full(6, 0.15 * math.cos(0.05 * i))
        measured = ball_over(paddle, 0.01 * i, time=0.01 * i) | arm
        actions = [policy.step(measured) for policy in policies]
        np.testing.assert_allclose(*actions, atol=1e-5, err_msg=stale)


def test_load_policy_refuses_other_files(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="nowhere.onnx cannot be read .*give pretrained, robust, "):
        load_policy("nowhere.onnx")
    with pytest.raises(UserError, match="not in a run's folder"):
        load_policy(tmp_path)
    shipped = resource_path("pretrained/pretrained.onnx").read_bytes()
    broken = {"": b"hello", " ": shipped[: len(shipped) // 2]}
    model = onnx.load_from_string(shipped)
    broken |= {
        "ball_colour": edited(model, "observation", "ball_velocity", "ball_colour"),
        "format is 1, not 5; export the policy again": edited(model, "format", "5", "1"),
    }
    del model.metadata_props[:]
    broken["lacks format"] = model.SerializeToString()
    for reason, content in broken.items():
        (tmp_path / "a.onnx").write_bytes(content)
        with pytest.raises(UserError, match=f"a.onnx is not a policy .*{reason}"):
            load_policy(tmp_path / "a.onnx")


def test_a_folder_wins_over_a_policy_of_its_name(tmp_path: Path, monkeypatch) -> None:
    """As for the commands; in a checkout, `pretrained` is the package's own folder."""
    monkeypatch.chdir(tmp_path)
    Path("robust").mkdir()
    with pytest.raises(UserError, match="robust is not in a run's folder"):
        load_policy("robust")
    Path("pretrained").symlink_to(resource_path("pretrained"))
    assert load_policy("pretrained").metadata.task == "bounce"


def edited(model: onnx.ModelProto, name: str, old: str, new: str) -> bytes:
    """An ONNX file with another text in an entry."""
    copy = onnx.ModelProto.FromString(model.SerializeToString())
    (prop,) = (prop for prop in copy.metadata_props if prop.key == name)
    assert old in prop.value
    prop.value = prop.value.replace(old, new)
    return copy.SerializeToString()


def test_no_servo_targets_for_a_wrong_action(policies) -> None:
    policy = policies["all histories"]
    policy.reset()
    policy.step(falling(0.0))
    for action in ([np.nan] * 6, [np.inf] * 6, [0.0] * 5, [[0.0]] * 6, "up", None, [5.0] * 6):
        with pytest.raises(UserError, match="the action .*give .*numbers .*from -1 to 1"):
            policy.servo_targets(action)


# All dependencies of the project except NumPy and onnxruntime.
BLOCKED = (
    "jax jaxlib mujoco flax optax orbax pydantic pydantic_core tensorstore yaml rich onnx "
    "packaging matplotlib scipy brax gymnasium torch"
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
from bounce_mjx.commands.main import main
main(["doctor"])
main(["eval"])
"""
    done = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path)],
        # Which a command would give to MuJoCo.
        env=os.environ | {"MUJOCO_GL": "egl"},
        capture_output=True,
        text=True,
    )
    shapes, refusal, *doctor = done.stdout.splitlines()
    assert shapes == "(6,) (6,) True"
    assert "must be exported, for which" in refusal and "bounce-mjx export" in refusal
    said = dict(line.split(": ", 1) for line in doctor[1:-1])
    assert said["devices"] == "none (No module named 'jax')"
    assert f"onnxruntime {onnxruntime.__version__}" in said["packages"]
    # The other commands say what they need.
    assert done.returncode == 2
    reason = r"\(No module named '\w+'\); install it with: .+\n"
    assert re.fullmatch(f"error: bounce-mjx eval cannot be imported {reason}", done.stderr)
