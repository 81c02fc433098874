"""A deployed policy's commands between two actions, and its supervisor."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bounce_mjx import BounceBall, EnvConfig, load_policy
from bounce_mjx.deploy.export import policy_metadata
from bounce_mjx.deploy.metadata import CommandLimits, from_entries, to_entries
from bounce_mjx.deploy.policy import DeployedPolicy
from bounce_mjx.errors import UserError
from bounce_mjx.physics import servo_targets
from bounce_mjx.runs.config import TrainConfig

LIMITS = {"velocity": (2.0,) * 6, "acceleration": (15.0,) * 6, "jerk": (7500.0,) * 6}
HOME = np.radians([0, 40, 110, 0, -60, 0])


def limited(limits: dict[str, Any] = LIMITS) -> DeployedPolicy:
    """The shipped policy as if its training had had limits."""
    policy = load_policy("pretrained")
    policy.metadata = policy.metadata._replace(limits=CommandLimits(**limits), max_lead=0.15)
    policy._motion = type(policy._motion)(policy.metadata)
    policy.reset()
    return policy


def measured(angles: np.ndarray = HOME, **others: Any) -> dict[str, Any]:
    still = {"ball_velocity": np.zeros(3), "joint_velocities": np.zeros(6)}
    return (
        still
        | {
            "joint_angles": angles,
            "ball_position": [0.589, 0.0, 0.45],
            "target_height": 0.5,
        }
        | others
    )


@pytest.mark.parametrize("smooth", [False, True])
def test_commands_are_those_of_the_environment(smooth: bool) -> None:
    limits = LIMITS if smooth else LIMITS | {"jerk": None}
    config = EnvConfig(
        robot={"limits": limits}, action={"base": "target"}, reset={"joint_velocities": 0.0}
    )
    policy, rng = limited(limits), np.random.default_rng(0)
    with jax.enable_x64(True):
        env = BounceBall(config)
        state = env.reset(jax.random.PRNGKey(0))
        begin = jax.jit(env.begin_step)
        for i in range(60):
            physics = state.pipeline_state.physics
            # The arm follows its command, more or less.
            start = state.pipeline_state.setpoint.position + rng.normal(0.0, 0.05 * (i > 0), 6)
            physics = physics._replace(qpos=physics.qpos.at[:6].set(start))
            state = state.replace(pipeline_state=state.pipeline_state._replace(physics=physics))
            action = np.clip(rng.normal(0.0, 1.0, 6), -1.0, 1.0)
            policy.step(measured(np.asarray(start)))
            targets = policy.servo_targets(action)
            state, control = begin(state, jnp.asarray(action))
            expected = np.asarray(servo_targets(control, 10))
            np.testing.assert_allclose(policy.commands(1000), expected, rtol=0.0, atol=1e-12)
            np.testing.assert_allclose(policy.commands(500), expected[1::2], rtol=0.0, atol=1e-12)
            np.testing.assert_array_equal(targets, policy.commands(1000)[-1])


def test_a_policy_without_limits_sends_one_target() -> None:
    policy = load_policy("pretrained")
    with pytest.raises(UserError, match="call step first"):
        policy.commands(1000)
    targets = policy.servo_targets(policy.step(measured()))
    np.testing.assert_array_equal(policy.commands(500), [targets] * 5)
    for rate in (50, 250, 0, -1000, float("nan"), 1e9):
        with pytest.raises(UserError, match="multiple of 100 Hz"):
            policy.commands(rate)


def test_the_file_holds_the_limits() -> None:
    config = TrainConfig(env={"robot": {"limits": LIMITS}, "action": {"base": "target"}})
    metadata = policy_metadata(config, 0)
    assert metadata.limits == CommandLimits(**LIMITS)
    entries = to_entries(metadata)
    assert from_entries(entries) == metadata
    assert from_entries({k: v for k, v in entries.items() if k != "limits"}).limits is None
    with pytest.raises(ValueError, match="velocity limits do not have one entry for each of the 6"):
        wrong = metadata._replace(limits=CommandLimits((1.0,) * 5, (1.0,) * 6, None))
        from_entries(to_entries(wrong))


class Arm:
    """An arm that follows its commands at once, and records them."""

    def __init__(self, supervisor: Any, angles: np.ndarray = HOME):
        self.supervisor, self.angles, self.time = supervisor, np.array(angles), 0.0
        self.rows = [self.angles]

    def step(self, **others: Any) -> str:
        rows = self.supervisor.commands(measured(self.angles, time=self.time, **others))
        self.rows.extend(rows)
        self.angles, self.time = rows[-1], self.time + 0.01
        return self.supervisor.state

    def until(self, state: str, most: int = 2000) -> None:
        for _ in range(most):
            if self.step() == state:
                return
        raise AssertionError(f"{self.supervisor.state}, never {state}")

    def check(self) -> None:
        velocity = np.diff(self.rows, axis=0) * 1e3
        acceleration = np.diff(velocity, axis=0) * 1e3
        jerk = np.diff(acceleration, axis=0) * 1e3
        for values, limit in ((velocity, 2.0), (acceleration, 15.0), (jerk, 7500.0)):
            assert np.abs(values).max() <= limit * (1.0 + 1e-5)


def running(**settings: Any) -> Arm:
    arm = Arm(limited().supervise(1000, **settings), HOME + 0.1)
    arm.until("ready")
    np.testing.assert_allclose(arm.angles, HOME, atol=2e-3)
    arm.supervisor.start()
    for i in range(25):
        assert arm.step(ball_position=[0.589, 0.0, 0.45 + 1e-4 * i]) == "running"
    assert np.abs(arm.angles - HOME).max() > 0.01
    return arm


FAULTS = {
    "stale picture": ({"ball_age": 0.12}, "picture of the ball is 120 ms old"),
    "not finite": ({"joint_velocities": [np.nan] * 6}, "joint_velocities holds nan"),
    "missing": ({"ball_velocity": None}, "ball_velocity"),
    "lost": ({"ball_position": [0.6, 0.0, -0.2]}, "the ball is lost"),
    "fast": ({"joint_velocities": [9.0] * 6}, "a joint has 9 rad/s"),
    "behind": ({"joint_angles": HOME + 1.0}, "behind its command"),
}


@pytest.mark.parametrize("wrong, reason", FAULTS.values(), ids=FAULTS.keys())
def test_a_fault_brakes_within_the_limits_and_says_why(wrong: dict, reason: str) -> None:
    arm = running()
    angles = arm.angles
    assert arm.step(**wrong) == "braking"
    assert reason in arm.supervisor.reason
    arm.until("stopped", 100)
    assert reason in arm.supervisor.reason
    # At rest from then on, even with good measurements.
    for _ in range(5):
        arm.step()
    assert np.ptp(arm.rows[-40:], axis=0).max() == 0.0
    assert np.abs(arm.angles - angles).max() < 0.2
    arm.check()


def test_a_late_step_and_an_old_picture_without_an_age_are_faults() -> None:
    arm = running()
    arm.time += 0.03
    assert arm.step() == "braking" and "came after 40 ms" in arm.supervisor.reason
    arm = running()
    for _ in range(12):
        state = arm.step()
    assert state != "running" and "old" in arm.supervisor.reason


def test_a_command_outside_of_the_box_is_a_fault() -> None:
    policy = load_policy("pretrained")
    paddle = (0.58856, 0.0, 0.05)
    low, high = ([x + d for x in paddle] for d in (-0.002, 0.002))
    arm = Arm(policy.supervise(1000, box=(low, high)))
    arm.until("ready", 20)
    arm.supervisor.start()
    arm.until("stopped", 50)
    assert "outside the box" in arm.supervisor.reason
    with pytest.raises(UserError, match="the box is"):
        policy.supervise(1000, box=(high, low))


def test_an_episode_starts_again_after_a_loss() -> None:
    arm = running()
    with pytest.raises(UserError, match="restart it when it has stopped"):
        arm.supervisor.restart()
    arm.supervisor.stop("the operator pressed a button")
    arm.until("stopped", 100)
    assert arm.supervisor.reason == "the operator pressed a button"
    with pytest.raises(UserError, match="starts when it is ready"):
        arm.supervisor.start()
    arm.supervisor.restart()
    arm.until("ready")
    assert arm.supervisor.reason is None
    arm.supervisor.start()
    assert arm.step() == "running"
    arm.check()


def test_no_command_is_known_before_the_first_measurement() -> None:
    supervisor = limited().supervise(1000)
    with pytest.raises(UserError, match="joint_angles"):
        supervisor.commands({"joint_angles": [np.inf] * 6})
