"""The benchmark of other simulators: the arm as URDF, delays, and what tunes a simulator."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from bounce_mjx import load_policy
from bounce_mjx.env.env import Env
from bounce_mjx.identify import Topics
from bounce_mjx.identify.reading import read_log
from bounce_mjx.resources import POLICIES, resource_path
from bounce_mjx.runs.config import load_run_config

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"


@pytest.fixture
def simulators(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import simulators

    return simulators


def model_of(policy: str) -> mujoco.MjModel:
    return Env(load_run_config(resource_path(POLICIES[policy])).env).mj_model


@pytest.mark.parametrize("policy", ["pretrained", "ur5e"])
def test_the_urdf_is_the_models_arm(simulators, policy: str) -> None:
    """MuJoCo's own reader finds the paddle where the model has it, and the same inertia."""
    model = model_of(policy)
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
    assert urdf.ngeom == 1
    np.testing.assert_allclose(theirs.geom_xpos[0], mine.geom_xpos[paddle], atol=1e-6)
    np.testing.assert_allclose(theirs.geom_xmat[0], mine.geom_xmat[paddle], atol=1e-6)
    np.testing.assert_allclose(urdf.geom_size[0], model.geom_size[paddle], atol=1e-9)


def test_a_step_and_a_drop_are_measured(simulators) -> None:
    """A first-order arm without gravity, and a ball that rebounds with 0.7."""
    rate, constant, angles = 1000.0, 0.012, np.zeros(2)
    now = {"angles": angles, "targets": angles, "ball": np.zeros((1, 9))}

    def reset(angles, positions, velocities):
        now.update(angles=angles, ball=np.hstack([positions, velocities, np.zeros((1, 3))]))

    def step():
        share = 1.0 - np.exp(-1.0 / rate / constant)
        now["angles"] = now["angles"] + share * (now["targets"] - now["angles"])
        ball = now["ball"] = now["ball"].copy()
        ball[0, 5] -= 9.81 / rate
        if ball[0, 2] + ball[0, 5] / rate < 0.1:
            ball[0, 5] *= -0.7
        ball[0, 2] += ball[0, 5] / rate

    simulator = simulators.Simulator(
        reset,
        lambda: (now["angles"], np.zeros(2)),
        lambda: now["ball"],
        lambda angles: now.update(targets=angles),
        step,
        lambda: None,
    )
    parts = simulators.make_parts(model_of("pretrained"))
    assert simulators.lag(simulator, parts, angles, 1.0 / rate) == pytest.approx(constant, rel=0.01)
    above = np.array([0.0, 0.0, 0.1])
    assert simulators.drop(simulator, parts, angles, above) == pytest.approx(0.7, abs=0.01)


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


def test_logs_are_those_that_identify_reads(simulators, monkeypatch, tmp_path: Path) -> None:
    """The motion and the bounces, of MuJoCo's own engine."""
    monkeypatch.setattr(simulators, "BALL_SECONDS", 1.0)
    world = simulators.WORLDS["20 + 10 ms"]
    simulators.record_logs("pretrained", "mujoco", world, tmp_path)
    model = model_of("pretrained")
    arm, ball = (read_log(tmp_path / f"{name}.csv", model, Topics()) for name in ("arm", "ball"))
    assert len(arm.times) > 1900 and not len(arm.picture_times)
    assert np.ptp(arm.joint_angles, axis=0).min() > 0.05
    # A joint follows its target after the delay and about one time constant of the servo.
    target, angle = arm.servo_targets[:, 0], arm.joint_angles[:, 0]
    errors = [np.abs(target[: -k or None] - angle[k:]).mean() for k in range(7)]
    assert np.argmin(errors) in (3, 4)
    assert len(ball.times) == 100 and len(ball.picture_times) == 99
    np.testing.assert_allclose(np.diff(ball.picture_times), 0.01, atol=1e-9)
    np.testing.assert_allclose(ball.arrivals - ball.picture_times, [0.0, *[0.01] * 98], atol=1e-9)
