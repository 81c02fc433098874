"""A deployed policy's commands stay within the limits; its supervisor brakes at every fault."""

import math
import re
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bounce_mjx import BounceBall, EnvConfig, load_policy
from bounce_mjx.deploy.faults import arm_responses, picture_age
from bounce_mjx.deploy.flight import begin, fit_fall, flight_bounds, follow
from bounce_mjx.deploy.metadata import CommandLimits
from bounce_mjx.deploy.motion import paddle_normal, paddle_position
from bounce_mjx.deploy.policy import DeployedPolicy
from bounce_mjx.deploy.samples import Samples, Seen
from bounce_mjx.errors import UserError
from bounce_mjx.physics import servo_targets
from deployed import ball_over, changed_policy

LIMITS = {"velocity": (2.0,) * 6, "acceleration": (15.0,) * 6, "jerk": (7500.0,) * 6}
HOME = np.radians([0, 40, 110, 0, -60, 0])


PADDLE = np.array([0.59356, 0.0, 0.04980])


def limited(limits: dict[str, Any] = LIMITS) -> DeployedPolicy:
    """The shipped policy as if its training had had limits."""
    return changed_policy("pretrained", limits=CommandLimits(**limits), max_lead=0.15)


def measured(angles: np.ndarray = HOME, **others: Any) -> dict[str, Any]:
    still = {"ball_velocity": np.zeros(3), "joint_velocities": np.zeros(6)}
    return (
        still
        | {"joint_angles": angles, "ball_position": [0.589, 0.0, 0.45], "target_height": 0.5}
        | others
    )


@pytest.mark.parametrize("smooth", [False, True])
def test_commands_are_those_of_the_environment(smooth: bool) -> None:
    limits = LIMITS if smooth else LIMITS | {"jerk": None}
    config = EnvConfig(
        robot={"limits": limits}, action={"base": "target"}, reset={"joint_velocities": 0.0}
    )
    policy, rng, before = limited(limits), np.random.default_rng(0), None
    with jax.enable_x64(True):
        env = BounceBall(config)
        state = jax.jit(env.reset)(jax.random.PRNGKey(0)).pipeline_state
        begin = jax.jit(env.control)
        for i in range(60):
            physics = state.physics
            # The arm follows its command, more or less.
            start = state.actuation.setpoint.position + 0.05 * np.sin(0.2 * i * np.arange(1, 7) / 6)
            physics = physics._replace(qpos=physics.qpos.at[:6].set(start))
            state = state._replace(physics=physics)
            action = np.clip(rng.normal(0.0, 1.0, 6), -1.0, 1.0)
            angles = np.asarray(start, float)
            velocities = np.zeros(6) if before is None else (angles - before) / 0.01
            before = angles
            policy.step(measured(angles, joint_velocities=velocities))
            targets = policy.servo_targets(action)
            control, actuation = begin(state, jnp.asarray(action))
            state = state._replace(actuation=actuation)
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


class Arm:
    """An arm that follows its commands at once, and records them."""

    def __init__(self, supervisor: Any, angles: np.ndarray = HOME):
        self.supervisor, self.angles, self.time = supervisor, np.array(angles), 0.0
        self.velocities = np.zeros(len(angles))
        self.rows = [self.angles]

    def step(self, **others: Any) -> str:
        given = measured(self.angles, joint_velocities=self.velocities, time=self.time)
        rows = self.supervisor.commands(given | others)
        self.rows.extend(rows)
        angles = rows[-1] if len(rows) else self.angles
        self.velocities = (angles - self.angles) / 0.01
        self.angles, self.time = angles, self.time + 0.01
        return self.supervisor.state

    def until(self, state: str, most: int = 2000) -> None:
        for _ in range(most):
            if self.step() == state:
                return
        raise AssertionError(f"{self.supervisor.state}, never {state}")

    def until_not(self, state: str, most: int = 2000) -> None:
        for _ in range(most):
            if self.step() != state:
                return
        raise AssertionError(f"always {state}")

    def check(self, since: int = 0) -> None:
        velocity = np.diff(self.rows[since:], axis=0) * 1e3
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
        assert arm.step(**flying(i)) == "running", arm.supervisor.reason
    assert np.abs(arm.angles - HOME).max() > 0.01
    return arm


# Those that cannot be true are bridged for a third of 0.1 s.
FAULTS = {
    "late_step": ({}, "came 3 steps late"),
    "old_picture": (
        {"ball_age": 0.12},
        "picture of the ball is 120 ms old",
    ),
    "old_picture before the last": (
        {"ball_age": 0.14, "ball_position": [0.589, 0.0, 0.4]},
        "was taken 1[0-9]0 ms before the last",
    ),
    "old_picture of the future": ({"ball_age": -0.02}, "picture of the ball is -20 ms old"),
    "measurement": ({"joint_velocities": [np.nan] * 6}, "joint_velocities holds nan"),
    "measurement missing": ({"ball_velocity": None}, "ball_velocity"),
    "ball_place in mm": ({"ball_position": [589.0, 0.0, 450.0]}, "ball_position is 741"),
    "ball_speed": ({"ball_velocity": [0.0, 0.0, -2000.0]}, "the ball has 2e.03 m/s"),
    "ball_flight": ({"ball_position": [0.589, 0.9, 0.45]}, "is 0.9[0-9]* m from"),
    "joint_speed": ({"joint_velocities": [9.0] * 6}, "has 9 rad/s"),
    "joint_jump": ({"joint_angles": HOME + 0.3}, "farther than it moves"),
    "joint_jump wrapped": ({"joint_angles": HOME + 2.0 * np.pi}, "give unwrapped angles"),
    "time": ({}, "the time went back by"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_brakes_within_the_limits_and_says_why(name: str) -> None:
    arm, (wrong, reason) = running(), FAULTS[name]
    is_bridged = name.startswith(("ball", "joint", "time")) or name.endswith("before the last")
    angles = arm.angles
    if name.startswith("late"):
        arm.time += 0.03
    if name == "time":
        wrong = {"time": arm.time - 0.3}
    ball = flying(25)
    if name == "old_picture":
        # The same picture again.
        ball = flying(24)
    if is_bridged:
        # Three samples that cannot be true stop nothing, also of six.
        for step in range(6):
            ball = flying(25 + step)
            assert arm.step(**ball | (wrong if step % 2 == 0 else {})) == "running"
            if name == "time":
                wrong = {"time": arm.time - 0.3}
        ball = flying(31)
    assert arm.step(**ball | wrong) in ("braking", "stopped")
    assert arm.supervisor.fault == name.split()[0] and re.search(reason, arm.supervisor.reason)
    arm.until("stopped", 100)
    assert re.search(reason, arm.supervisor.reason)
    # At rest from then on, even with good measurements.
    for _ in range(10):
        arm.step()
    assert np.ptp(arm.rows[-40:], axis=0).max() == 0.0
    assert np.abs(arm.angles - angles).max() < 0.2
    if name in ("late_step", "time"):
        # The robot waits at the end of its commands already.
        assert np.abs(arm.angles - angles).max() < (1e-9 if name == "late_step" else 0.2)
    else:
        arm.check()


def flying(i: int, **others: Any) -> dict[str, Any]:
    """Measurements of a ball that bounces over the paddle's home since an episode's start."""
    return ball_over(PADDLE, 0.01 * i, **others)


def test_a_command_outside_of_the_box_is_a_fault() -> None:
    policy = limited()
    paddle = paddle_position(policy.metadata, HOME)
    low, high = (list(paddle + d) for d in (-0.005, 0.005))
    arm = Arm(policy.supervise(1000, box=(low, high)))
    arm.until("ready", 20)
    arm.supervisor.start()
    for i in range(50):
        if arm.step(**flying(i)) != "running":
            break
    assert arm.supervisor.fault == "box" and "m outside the box" in arm.supervisor.reason
    arm.until("stopped", 50)
    # The command that would have left the box was not sent.
    arm.check()


SETTINGS = {
    "box": [
        ((0, 0, 0), (1, math.nan, 1)),
        ((1, 1, 1), (0, 0, 0)),
        ((0, 0), (1, 1)),
        ((0, 0, 0), (1, 1)),
        "1 m",
        None,
        # In mm and in cm, also of one end alone.
        ((-1000, -500, -200), (1000, 500, 600)),
        ((-0.1, -0.5, -math.inf), (math.inf, math.inf, 60)),
    ],
    "max_picture_age": [0.0, -0.1, 1.5, math.nan, math.inf, "0.1", [0.1]],
    "max_steps_late": [0, -1, math.nan, math.inf, None, "2"],
    "rate": [125, 0, math.nan, "500", None, [500]],
}


@pytest.mark.parametrize("name", SETTINGS)
def test_a_wrong_setting_is_refused_at_once(name: str) -> None:
    policy = limited()
    for value in SETTINGS[name]:
        with pytest.raises(UserError, match=f"the {name} is|{name} is"):
            policy.supervise(**{"rate": 1000} | {name: value})
    policy.supervise(np.float32(1000.0), max_steps_late=np.int64(2))
    policy.reset()
    policy.supervise(1000, box=((-30, -math.inf, 0), (30, math.inf, 1)))


def test_the_largest_age_of_a_picture_is_that_of_the_training() -> None:
    latency = {"ur5e": 0.075 + 5.0 / 45.0, "robust": 0.065 + 5.0 / 60.0, "pretrained": 0.1}
    for name, expected in latency.items():
        assert picture_age(load_policy(name).metadata) == pytest.approx(expected)


def test_a_missing_measurement_is_named_with_each_that_is_needed_once() -> None:
    arm = running()
    given = measured(arm.angles)
    del given["ball_position"]
    arm.supervisor.commands(given | {"time": arm.time})
    needs = load_policy("pretrained").needs
    assert arm.supervisor.reason == (
        f"the measurement ball_position is missing; this policy needs {', '.join(needs)} in every "
        "step"
    )
    assert needs.count("joint_angles") == 1


@pytest.mark.parametrize("rate", [100, 125, 1000])
def test_a_policy_acts_at_its_own_rate(rate: int) -> None:
    policy = load_policy("pretrained")
    actions = []
    for k in range(2 * rate):
        ball = ball_over(PADDLE, k / rate)
        action = policy.step(measured(**ball, time=1e3 + k / rate))
        if not actions or np.any(action != actions[-1]):
            actions.append(action)
    assert abs(len(actions) - 200) <= 1 and policy.step_number == len(actions) - 1


@pytest.mark.parametrize("late", [0.0, 0.004], ids=["repeated", "early"])
def test_the_commands_of_a_control_step_are_given_once(late: float) -> None:
    """A call that is no new step has none, whatever the rate of the calls."""
    arm = running()
    for i in range(25, 45):
        if i in (30, 31, 35):
            time, arm.time = arm.time, arm.time - 0.01 + late
            rows = len(arm.rows)
            assert arm.step(**flying(i - 1)) == "running" and len(arm.rows) == rows
            arm.time = time
        assert arm.step(**flying(i)) == "running"
    arm.check()
    # A clock that stands moves nothing, and is said.
    time, rows = arm.time - 0.01 + late, len(arm.rows)
    for call in range(26):  # noqa: B007
        arm.time = time
        if arm.step(**flying(44)) != "running":
            break
        assert len(arm.rows) == rows
    assert call > 20 and arm.supervisor.fault == "time"
    assert "the time has stood at" in arm.supervisor.reason
    arm.until("stopped")
    # The robot came to the end of its commands meanwhile.
    assert np.ptp(arm.rows[rows - 1 :], axis=0).max() < 1e-9


def test_a_late_step_goes_on_from_rest_within_the_limits() -> None:
    """The robot came to the end of its commands, and waited there."""
    arm = running()
    for i in (25, 26, 29, 30, 31, 34):
        arm.time += 0.02 * (i in (29, 34))
        start = arm.rows[-1]
        assert arm.step(**flying(i)) == "running", arm.supervisor.reason
        first = arm.rows[-10] - start
        if i in (29, 34):
            # From rest at 15 rad/s^2, in the first millisecond.
            assert np.abs(first).max() <= 0.5 * 15.0 * 1e-6 + 1e-9
            steps = np.diff(np.vstack([start, start, arm.rows[-10:]]), axis=0)
            assert np.abs(np.diff(steps, axis=0)).max() <= 15.0 * 1e-6 * (1.0 + 1e-5)


class Host:
    """The monotonic clock of the computer beside the robot."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch):
        self.now = 50.0
        monkeypatch.setattr("bounce_mjx.deploy.supervisor.time.monotonic", lambda: self.now)


def played_on(host: Host, steps: int = 75) -> Arm:
    """An arm in play, whose clock agrees with the host's."""
    arm = Arm(limited().supervise(1000))
    for _ in range(10):
        arm.step()
        host.now += 0.01
    arm.supervisor.start()
    for i in range(steps):
        assert arm.step(**flying(i)) == "running", arm.supervisor.reason
        host.now += 0.01
    return arm


JUMPS = {
    "once forward": (5.0, 1),
    "once back": (-5.0, 1),
    "forward": (5.0, None),
    "by two steps": (0.02, None),
    "a restarted clock": (-0.6, None),
}


@pytest.mark.parametrize("jump, samples", JUMPS.values(), ids=JUMPS)
def test_a_time_that_the_hosts_clock_contradicts_moves_nothing_beyond_the_limits(
    jump: float, samples: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The robot has not waited, and goes on; a clock that stays elsewhere brakes it."""
    host = Host(monkeypatch)
    arm = played_on(host)
    assert np.abs(arm.velocities).max() > 0.05
    arm.time += jump
    for i in range(75, 140):
        arm.step(**flying(i))
        host.now += 0.01
        if i == 75 and samples:
            arm.time -= jump
    arm.check()
    if samples:
        assert arm.supervisor.state == "running"
        return
    assert (arm.supervisor.state, arm.supervisor.fault) == ("stopped", "time")
    assert "by this computer's clock" in arm.supervisor.reason
    # A restart begins a new clock.
    arm.supervisor.restart()
    for _ in range(20):
        arm.step()
        host.now += 0.01
    assert arm.supervisor.state in ("homing", "ready"), arm.supervisor.reason


@pytest.mark.parametrize("is_home", [False, True])
def test_a_time_from_the_future_does_not_outlive_a_restart(is_home: bool) -> None:
    """Also where no other clock has agreed with the driver's."""
    arm = Arm(limited().supervise(1000)) if is_home else running()
    arm.step()
    arm.step(time=arm.time + 1e5)
    arm.step()
    assert arm.supervisor.fault in ("time", "late_step")
    for _ in range(60):
        arm.step()
    assert arm.supervisor.state == "stopped"
    arm.supervisor.restart()
    for _ in range(200):
        arm.step()
    assert arm.supervisor.state == "ready", arm.supervisor.reason


@pytest.mark.parametrize("kind", ["it stands", "it goes back"])
@pytest.mark.parametrize("is_agreed", [False, True])
def test_an_arm_that_waited_for_a_clock_goes_on_from_rest(
    kind: str, is_agreed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    host = Host(monkeypatch)
    arm = played_on(host)
    if not is_agreed:
        host.now += 100.0
        arm.step(**flying(75))
    rows = len(arm.rows)
    known = arm.time - 0.01
    for _ in range(60):
        arm.time = known if kind == "it stands" else known - 0.3
        arm.step(**flying(76))
        host.now += 0.01 if is_agreed else 1e-4
    assert (arm.supervisor.state, arm.supervisor.fault) == ("stopped", "time")
    if kind == "it goes back" and is_agreed:
        # The host's clock went on, and so did the arm.
        arm.check()
    else:
        assert np.ptp(arm.rows[rows - 1 :], axis=0).max() < 1e-9


def test_a_late_step_is_told_by_the_hosts_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    host = Host(monkeypatch)
    arm = played_on(host)
    rows = len(arm.rows)
    arm.time += 0.02
    host.now += 0.02
    start = arm.rows[-1]
    assert arm.step(**flying(77)) == "running"
    assert np.abs(arm.rows[rows] - start).max() <= 0.5 * 15.0 * 1e-6 + 1e-9


@pytest.mark.parametrize("period", [0.00985, 0.0102])
def test_a_loop_that_drifts_has_commands_in_every_step(period: float) -> None:
    """As of a robot whose clock is 2% faster or slower than its program's; a phase that crosses
    the middle of two steps is no late step."""
    arm = Arm(limited().supervise(1000))
    arm.until("ready")
    arm.supervisor.start()
    rows = len(arm.rows)
    time = arm.time
    for i in range(300):
        given = ball_over(PADDLE, period * i)
        assert arm.step(**given, time=time + period * i) == "running", arm.supervisor.reason
    assert len(arm.rows) - rows == 300 * 10
    arm.check()


def test_one_shift_of_the_phase_is_no_late_step() -> None:
    """The robot had commands until 4 ms ago."""
    arm = running()
    arm.time += 0.004
    for i in range(25, 28):
        assert arm.step(**flying(i)) == "running"
    arm.time += 0.004
    for i in range(28, 31):
        assert arm.step(**flying(i)) == "running"
    arm.check()


def test_a_first_sample_of_an_episode_that_cannot_be_true_is_bridged() -> None:
    arm = Arm(limited().supervise(1000))
    arm.until("ready")
    arm.supervisor.start()
    assert arm.step(**flying(0), joint_angles=arm.angles + 0.9) == "running", arm.supervisor.reason


def test_a_stop_holds_an_arm_that_is_outside_of_its_range() -> None:
    policy = limited()
    start = HOME.copy()
    start[2] = policy.metadata.joint_ranges[2][1] + 0.3
    policy.reset(start)
    arm = Arm(policy.supervise(1000), start)
    arm.step()
    arm.supervisor.stop("the operator")
    for _ in range(100):
        arm.step()
    assert arm.supervisor.state == "stopped"
    arm.check()
    # What the one control step had begun is braked.
    assert np.abs(arm.angles - start).max() < 2e-3
    rested = arm.angles
    for _ in range(20):
        arm.step()
    np.testing.assert_array_equal(arm.angles, rested)
    arm.supervisor.restart()
    arm.until("ready")


def test_an_arm_has_its_second_to_settle_after_its_targets_stand_still() -> None:
    policy = limited()
    arm = policy.supervise(1000)
    for step in range(170):
        moving = 0.2 + 1e-3 * step if step < 150 else 0.2
        given = measured(HOME, joint_targets=HOME + moving, time=0.01 * step)
        assert arm.commands(given).shape == (0, 6)
        assert arm.state == "homing", arm.reason


def test_a_time_in_a_list_is_a_time() -> None:
    arm = running()
    arm.supervisor.stop("the operator")
    before = len(arm.rows)
    for _ in range(3):
        arm.step(time=[arm.time])
    assert len(arm.rows) - before == 30
    arm.time += 5.0
    rows = len(arm.rows)
    arm.step(time=[arm.time])
    # The robot came to the end of its commands.
    assert np.ptp(arm.rows[rows - 1 :], axis=0).max() < 1e-9


def test_without_a_time_the_hosts_clock_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """However often the commands are asked for: at 500 Hz, a fifth of the calls are steps."""
    now = [50.0]
    monkeypatch.setattr("bounce_mjx.deploy.supervisor.time.monotonic", lambda: now[0])
    arm = limited().supervise(1000)
    angles, rows = HOME + 0.1, []
    for _ in range(1000):
        commands = arm.commands({"joint_angles": angles})
        rows.extend(commands)
        angles = commands[-1] if len(commands) else angles
        now[0] += 0.002
        if arm.state == "ready":
            break
    assert arm.state == "ready" and now[0] - 50.0 > 0.1 / 0.3
    assert len(rows) <= 1000 * (now[0] - 50.0) + 20
    with pytest.raises(UserError, match="time is given, and was not before"):
        raise UserError(stopped_by(arm, {"joint_angles": angles, "time": 3.0}))
    other = limited().supervise(1000)
    other.commands({"joint_angles": HOME, "time": 3.0})
    assert "time is missing, and was given before" in stopped_by(other, {"joint_angles": HOME})


def stopped_by(arm: Any, measurements: dict[str, Any]) -> str:
    """Why measurements stop an arm."""
    arm.commands(measurements)
    assert arm.state in ("braking", "stopped")
    return arm.reason


@pytest.mark.parametrize("is_limited", [False, True], ids=["without limits", "limits"])
@pytest.mark.parametrize("rate", [80, 100, 200, 500])
def test_the_way_home_has_its_speed_at_any_rate_of_calls(rate: int, is_limited: bool) -> None:
    """As of a robot that calls at its own rate, and sends the first one of the commands."""
    policy = limited() if is_limited else load_policy("pretrained")
    start = HOME + [0.4, 0.0, 0.0, 0.0, 0.0, 0.0]
    policy.reset(start)
    arm = policy.supervise(500)
    angles = start
    for call in range((8 if rate == 80 else 4) * rate):
        commands = arm.commands(measured(angles, time=7.0 + call / rate))
        if len(commands):
            # A step begins up to half a step early, and goes on to its end.
            allowed = 0.3 * (call / rate + 0.015)
            assert np.max(np.abs(commands - start)) <= allowed + 1e-9
            sent = commands[0]
        angles = angles + (sent - angles) * (1.0 - np.exp(-1.0 / rate / 0.02))
    assert (arm.state, arm.fault) == ("ready", None)


@pytest.mark.parametrize("is_playing", [False, True])
def test_a_loop_that_is_slower_than_the_control_steps_is_named(is_playing: bool) -> None:
    """At 50 Hz the arm had commands for 10 ms of each 20, and would crawl home. One pause is no
    slow loop, nor are times that lie between two steps."""
    arm = running() if is_playing else Arm(limited().supervise(1000), HOME + 0.1)
    states = []
    for i in range(25, 75):
        jitter = 0.0051 * (i % 2)
        arm.time = arm.time + 0.4 * (i == 30 and not is_playing)
        states.append(arm.step(time=arm.time + jitter, **flying(i)))
    assert "stopped" not in states and arm.supervisor.fault is None
    for i in range(75, 95):
        arm.time += 0.01
        arm.step(**flying(75 + 2 * (i - 75)))
    assert arm.supervisor.fault == "late_step"
    assert "the last one 20 ms after the one before; call commands every 10 ms" in (
        arm.supervisor.reason
    )


def test_a_clock_that_stands_at_home_is_noticed_and_may_begin_anew_after_a_restart() -> None:
    arm = Arm(limited().supervise(1000))
    arm.until("ready")
    time = arm.time
    for _ in range(2):
        assert arm.step(time=time) == "ready"
    for _ in range(30):
        state = arm.step(time=time + 0.01)
    assert state == "stopped" and arm.supervisor.fault == "time"
    arm.supervisor.restart()
    arm.until("ready", 20)
    for _ in range(20):
        assert arm.step() == "ready"


def supervised(name: str) -> tuple[Any, np.ndarray, Any]:
    """A supervisor of a shipped policy, the arm's home, and measurements of a ball that bounces
    above it to a height."""
    policy = load_policy(name)
    home = np.array(policy.metadata.default_joint_angles)
    place = paddle_position(policy.metadata, home) + [0.05, 0.03, 0.0]
    last: list[tuple[int, np.ndarray]] = []

    def seen(angles: np.ndarray, step: int, height: float = 0.4) -> dict[str, Any]:
        before, known = last[-1] if last else (step - 1, angles)
        velocities = (angles - known) / 0.01 / max(step - before, 1)
        last.append((step, np.array(angles)))
        ball = ball_over(place, 0.01 * step, height)
        given = measured(angles, joint_velocities=velocities, ball_age=0.0, **ball)
        given |= dict.fromkeys(policy.metadata.goals, 0.0) | {"target_height": 0.6}
        given |= {name: 0.0 for name in policy.metadata.goals if name not in given}
        kept = {k: v for k, v in given.items() if k in (*policy.needs, "ball_age")}
        return kept | {"time": step * policy.metadata.control_dt}

    return policy.supervise(500), home, seen


@pytest.mark.parametrize(
    ("name", "joints"),
    [("pretrained", slice(None)), ("robust_small", 1), ("ur5e", 1), ("iiwa", slice(None))],
    ids=["pretrained", "robust_small, joint 2", "ur5e, joint 2", "iiwa"],
)
def test_a_stuck_arm_is_seen_within_half_a_second(name: str, joints: Any) -> None:
    arm, home, seen = supervised(name)
    step, angles = 0, home
    while arm.state != "ready" and step < 500:
        arm.commands(seen(home, step, 0.4))
        step += 1
    # An arm that rests is not asked to move.
    for _ in range(40):
        arm.commands(seen(home, step, 0.4))
        step += 1
    arm.start()
    for _ in range(50):
        angles = arm.commands(seen(angles, step))[-1].copy()
        step += 1
        if arm.state != "running":
            break
        angles[joints] = home[joints]
    assert arm.fault == "joint_astray" and "does not follow its commands" in arm.reason


def started(name: str) -> tuple[Any, Callable, np.ndarray, np.ndarray, int]:
    """A supervisor that has been started beside a ball 0.4 m above the paddle; what it measures,
    as from `supervised`; the paddle's place [3], m; its last commands [J], rad; its steps."""
    arm, home, seen = supervised(name)
    paddle = paddle_position(load_policy(name).metadata, home)
    step, angles = 0, home
    while arm.state != "ready" and step < 500:
        given = seen(angles, step)
        given["ball_position"] = paddle + [0.0, 0.0, 0.4]
        angles = arm.commands(given)[-1]
        step += 1
    arm.start()
    return arm, seen, paddle, angles, step


HELD = {
    "above": ("robust", [0.0, 0.0, 0.3], 0.3),
    "beside": ("ur5e", [0.0, 0.4, 0.1], 0.3),
    "carried": ("robust", [0.2, 0.4, 0.1], 0.3),
    "3 cm above": ("robust", [0.0, 0.0, 0.05], 0.5),
    "on the paddle": ("balance", [0.0, 0.0, 0.0225], math.inf),
}


def show_a_ball(
    running: tuple, place: Callable[[float], np.ndarray], rate: float, noise: float, steps: int
) -> int:
    """Shows a running arm pictures of a ball, seen 30 ms late, until it stops; the steps that it
    took.

    Args:
      running: what `started` gives.
      place: time since the start, s -> the ball's place relative to the paddle [3], m.
      rate: of the pictures, Hz.
      noise: standard deviation of a picture along an axis, m.
      steps: most control steps.
    """
    arm, seen, paddle, angles, began = running
    rng = np.random.default_rng(0)
    shown = None
    for step in range(began, began + steps):
        given = seen(angles, step)
        time = 0.01 * step
        picture = math.floor((time - 0.03) * rate)
        if picture != shown:
            shown = picture
            since = picture / rate - 0.01 * began
            ball = paddle + place(since) + rng.normal(0.0, noise, 3)
        given |= {"ball_position": ball, "ball_age": time - picture / rate}
        if "ball_velocity" in given:
            given["ball_velocity"] = np.zeros(3)
        angles = arm.commands(given)[-1]
        if arm.state != "running":
            break
    return step - began


@pytest.mark.parametrize("name, place, within", HELD.values(), ids=HELD)
@pytest.mark.parametrize("rate", [60.0, 30.0])
def test_a_ball_that_a_hand_holds_stops_the_arm(
    name: str, place: list[float], within: float, rate: float
) -> None:
    """As it does not fall; a ball that may rest does. Seen with 3 mm of noise."""
    carried = 0.3 if place[0] == 0.2 else 0.0

    def held(since: float) -> np.ndarray:
        return place + np.array([0.0, carried * since, 0.0])

    running = started(name)
    arm = running[0]
    steps = show_a_ball(running, held, rate, noise=0.003, steps=60)
    if within is math.inf:
        assert arm.state == "running"
    else:
        # Beside the 30 ms of the camera.
        assert arm.fault == "ball_flight" and steps <= round(100 * (within + 0.03)), arm.reason
        assert "nobody holds it" in arm.reason


@pytest.mark.parametrize("rate", [120.0, 60.0])
def test_a_ball_that_is_thrown_from_a_hand_flies_from_then_on(rate: float) -> None:
    """One that leaves it two control steps after the word, with 8 mm of noise."""

    def flying(since: float) -> np.ndarray:
        flown = max(since - 0.02, 0.0)
        return np.array([0.0, 0.0, 0.3 + 3.0 * flown - 0.5 * 9.81 * flown**2])

    running = started("robust")
    arm = running[0]
    show_a_ball(running, flying, rate, noise=0.008, steps=40)
    assert arm.fault is None, arm.reason


@pytest.mark.parametrize(
    ("name", "height", "fault"),
    [("balance", 0.0225, None), ("balance", 0.3, "old_picture"), ("robust", 0.0225, "old_picture")],
)
def test_a_picture_that_repeats_is_old_but_of_a_ball_that_may_rest_there(
    name: str, height: float, fault: str | None
) -> None:
    """Without `ball_age`, whose absence is no evidence of a camera that stands still."""
    arm, home, seen = supervised(name)
    paddle = paddle_position(load_policy(name).metadata, home)
    angles = home
    for step in range(200):
        given = seen(angles, step) | {"ball_position": paddle + [0.0, 0.0, height]}
        given.pop("ball_age", None)
        given |= {key: np.zeros(3) for key in ("ball_velocity",) if key in given}
        angles = arm.commands(given)[-1]
        if arm.state == "ready":
            arm.start()
    assert arm.fault == fault, arm.reason


def test_a_ball_that_comes_to_rest_has_no_velocity_without_ages() -> None:
    """Of a policy that makes it from two pictures, of which the last two differed."""
    metadata = load_policy("balance").metadata._replace(velocity="differences")
    samples = Samples(metadata)
    seen = samples.rest(Seen(), np.array(metadata.default_joint_angles))
    ball = paddle_position(metadata, np.array(metadata.default_joint_angles)) + [0.0, 0.0, 0.0225]
    pictures = []
    for step in range(30):
        place = ball + [1e-3 * min(step, 5), 0.0, 0.0]
        time = np.array([0.01 * step])
        seen, _, _ = samples.take(seen, {"time": time, "ball_position": place})
        pictures.append((seen.picture.balls[0, 0] - ball[0], seen.picture.taken))
    # Sooner than after 50 ms there may have been no picture.
    assert [taken for _, taken in pictures[5:10]] == pytest.approx([0.05] * 5)
    assert all(taken > 0.07 for _, taken in pictures[11:])
    assert pictures[-1][1] > 0.25


def to_and_fro(offset: float, noise: float, rate: float) -> list[str | None]:
    """What speaks against pictures at a rate (Hz) of a ball that rests on the paddle, each second
    one beside by an offset, m, with noise, m."""
    rng = np.random.default_rng(0)
    bounds = flight_bounds(load_policy("catch").metadata)
    paddle = np.zeros(3)
    flight = begin(0.0, np.array([0.0, 0.0, 0.0225]), paddle)
    reasons = []
    for number in range(1, 400):
        ball = [offset * (number % 2), 0.0, 0.0225] + rng.normal(0.0, noise, 3)
        flight, reason = follow(bounds, flight, number / rate, ball, paddle)
        reasons.append(reason)
    return reasons


def test_two_balls_in_turn_on_a_paddle_are_no_ball_at_rest() -> None:
    for rate in (100.0, 60.0):
        reasons = to_and_fro(0.1, 0.003, rate)
        assert all("to and fro" in reason for reason in reasons[8:20])
    for noise in (0.001, 0.005, 0.008):
        assert not any(to_and_fro(0.0, noise, 120.0))


@pytest.mark.parametrize("rate", [100.0, 60.0, 30.0])
def test_low_bounces_in_a_row_are_no_hand(rate: float) -> None:
    """Of 7 cm, in which the ball is always near the paddle: no line is as bent."""
    arm, seen, paddle, angles, began = started("robust")
    rng = np.random.default_rng(0)
    flight = 0.24
    shown = None
    for step in range(began, began + 80):
        given = seen(angles, step)
        time = 0.01 * step
        picture = math.floor((time - 0.03) * rate)
        if picture != shown:
            shown = picture
            flown = max(picture / rate - 0.01 * began, 0.0) % flight
            height = 0.0225 + 0.5 * 9.81 * flown * (flight - flown)
            ball = paddle + [0.0, 0.0, height] + rng.normal(0.0, 0.003, 3)
        given |= {"ball_position": ball, "ball_age": time - picture / rate}
        if "ball_velocity" in given:
            given["ball_velocity"] = np.zeros(3)
        angles = arm.commands(given)[-1]
        assert arm.fault is None, arm.reason


def test_a_ball_that_flies_is_not_lost_wherever_it_is() -> None:
    """From a noisy camera, as when it is thrown at the arm; at one place, somebody holds it."""
    for speed, fault in ((-1.5, None), (0.0, "ball_flight")):
        arm, rng = Arm(limited().supervise(1000)), np.random.default_rng(0)
        arm.until("ready")
        arm.supervisor.start()
        for i in range(30):
            time = 0.01 * i
            height = 0.4 + (1.5 * time - 0.5 * 9.81 * time**2 if speed else 0.0)
            ball = [0.589 + 1.4 + speed * time, 0.0, height] + rng.normal(0.0, 0.003, 3)
            arm.step(ball_position=ball)
        assert arm.supervisor.fault == fault


def test_an_arm_that_was_moved_starts_from_where_it_is() -> None:
    arm = running()
    arm.supervisor.stop("an emergency stop")
    # Braking and resting need no measurement.
    for _ in range(150):
        rows = arm.supervisor.commands({"joint_angles": None, "ball": "lost"})
    assert arm.supervisor.state == "stopped"
    stopped, moved = rows[-1], HOME + 0.6

    def seen(angles: np.ndarray, **others: Any) -> np.ndarray:
        arm.time += 0.01
        return arm.supervisor.commands(measured(angles, time=arm.time) | others)

    np.testing.assert_array_equal(seen(stopped)[-1], stopped)
    # Nothing is sent to an arm that is elsewhere, so that its servos may be switched on again.
    for _ in range(20):
        assert seen(moved).shape == (0, 6)
    arm.supervisor.restart()
    for _ in range(110):
        assert seen(moved).shape == (0, 6)
    assert arm.supervisor.state == "stopped" and arm.supervisor.fault == "joint_astray"
    assert "rad from where its commands rest" in arm.supervisor.reason
    # Nor is anything raised before the next first command.
    for wrong, fault in ((np.full(6, np.nan), "measurement"), (HOME + 9.0, "joint_range")):
        arm.supervisor.restart(moved=True)
        assert seen(wrong).shape == (0, 6)
        assert (arm.supervisor.state, arm.supervisor.fault) == ("stopped", fault)
    # It is to be said where the arm rests, by the operator or by its controller.
    arm.supervisor.restart(moved=True)
    for _ in range(5):
        assert seen(moved).shape == (0, 6)
    assert "nobody says where the arm rests" in arm.supervisor.reason
    for _ in range(2):
        assert seen(moved, joint_targets=moved + 1e-4).shape == (0, 6)
    np.testing.assert_allclose(seen(moved, joint_targets=moved + 1e-4)[0], moved, atol=1e-3)
    arm.supervisor.stop("again")
    while arm.supervisor.state != "stopped":
        rows = seen(moved)
    with pytest.raises(UserError, match="the target of Joint3 is 14"):
        arm.supervisor.restart(targets=np.degrees(moved))
    assert (arm.supervisor.state, arm.supervisor.reason) == ("stopped", "again")
    moved = rows[-1]
    arm.supervisor.restart(targets=moved)
    moves = Arm(arm.supervisor, moved)
    moves.time = arm.time + 0.01
    moves.step()
    assert np.abs(moves.rows[1] - moved).max() < 1e-3 and arm.supervisor.state == "homing"
    moves.until("ready")
    moves.check()
    np.testing.assert_allclose(moves.angles, HOME, atol=2e-3)
    # At 0.3 rad/s, the speed of every way home.
    speeds = 1000.0 * np.abs(np.diff(np.asarray(moves.rows[1:]), axis=0))
    assert 0.29 < speeds.max() < 0.3 + 1e-6


@pytest.mark.parametrize("name", ["robust", "ur5e", "iiwa"])
def test_nothing_is_sent_after_a_restart_until_the_arm_is_where_its_commands_rest(
    name: str,
) -> None:
    """As after an emergency stop, when somebody moved the arm with its servos off."""
    arm, home, seen = supervised(name)
    for step in range(20):
        rest = arm.commands(seen(home, step, 0.3))[-1]
    arm.stop("an emergency stop")
    while arm.state != "stopped" and step < 500:
        arm.commands(seen(home, step, 0.3))
        step += 1
    arm.restart()
    for step in range(20, 40):
        assert arm.commands(seen(home + 0.6, step, 0.3)).shape == (0, len(home))
        assert arm.state == "homing"
    assert "from where its commands rest" in arm.reason
    # It is pushed back.
    for step in range(40, 90):
        away = 0.6 - 0.012 * (step - 39)
        commands = arm.commands(seen(home + away, step, 0.3))
        assert len(commands) == 0 or away < 0.1
    np.testing.assert_allclose(commands, np.tile(rest, (5, 1)), atol=4e-3)


@pytest.mark.parametrize("earlier", [False, True], ids=["once", "again"])
def test_joints_have_the_order_of_the_driver(earlier: bool) -> None:
    """Whatever the order, the policy does the same with each joint."""
    own, rng = load_policy("panda"), np.random.default_rng(0)
    joints, order = own.metadata.joint_names, rng.permutation(7)
    named = load_policy("panda", joint_names=joints[::-1] if earlier else None)
    named.use_joints([f"fr3_{joints[i]}" for i in order])
    assert named.metadata.joint_names == tuple(f"fr3_{joints[i]}" for i in order)
    assert named.metadata.joint_damping == tuple(own.metadata.joint_damping[i] for i in order)
    home = np.array(own.metadata.default_joint_angles)
    place = paddle_position(own.metadata, home)
    for step in range(20):
        angles, velocities = home + 0.05 * np.sin(0.1 * step + np.arange(7)), rng.normal(size=7)
        ball = {"ball_position": place + [0.0, 0.0, 0.3 + 0.01 * step], "target_height": 0.8}
        given = {"joint_angles": angles, "joint_velocities": velocities}
        action = own.step(ball | given)
        same = named.step(ball | {name: x[order] for name, x in given.items()})
        np.testing.assert_array_equal(same, action[order])
        np.testing.assert_array_equal(named.commands(500), own.commands(500)[:, order])


@pytest.mark.parametrize(
    "policy, names",
    [
        ("robust", load_policy("ur5e").metadata.joint_names),
        ("iiwa", load_policy("panda").metadata.joint_names),
        ("panda", [f"fr3_joint{i}" for i in range(1, 7)]),
        ("panda", [f"fr3_joint{i}" for i in (1, 2, 3, 4, 5, 6, 6)]),
        ("panda", {f"a{i}": "joint1" for i in range(7)}),
    ],
)
def test_a_policy_refuses_another_robot(policy: str, names: Any) -> None:
    with pytest.raises(UserError, match="joint_names has .*, but the policy is for .*; give"):
        load_policy(policy, joint_names=names)


def test_other_names_are_mapped() -> None:
    names = {f"lbr_A{i}": f"joint_{i}" for i in range(1, 8)}
    assert load_policy("iiwa", joint_names=names).metadata.joint_names == tuple(names)


IMPOSSIBLE = {
    "a ball in mm": ({"ball_position": [589.0, 0.0, 450.0]}, "ball_position is 741, .* \\(m\\)"),
    "a command in cm": ({"target_height": 50.0}, "target_height is 50, but .* 0.4 to 0.6 \\(m\\)"),
    "angles in degrees": (
        {"joint_angles": np.degrees(HOME)},
        "angle of Joint3 is 110, .* \\(rad\\)",
    ),
}


@pytest.mark.parametrize("wrong, words", IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_a_step_refuses_what_no_world_can_hold(wrong: dict, words: str) -> None:
    policy = load_policy("pretrained")
    with pytest.raises(UserError, match=words):
        policy.step(measured(**wrong))
    assert policy.step_number == -1
    # A lost ball is no error.
    policy.step(measured(ball_position=[1.4, -1.4, 0.02]))


def test_another_goal_than_the_only_one_of_the_training_is_refused() -> None:
    """The network's input is the same for all, so that none would be heeded."""
    constant = load_policy("pretrained").metadata.goals["target_height"]
    constant = constant._replace(range=(0.5, 0.5))
    policy = changed_policy("pretrained", goals={"target_height": constant})
    policy.step(measured(target_height=np.float32(0.5)))
    for height in (0.3, 0.51, 0.9):
        words = f"target_height is {height}, but the training had 0.5 alone .m.; give that"
        with pytest.raises(UserError, match=words):
            policy.step(measured(target_height=height))


def test_zeros_of_a_driver_without_data_are_no_command() -> None:
    """Nor is any first sample far from the start pose, however often it is repeated."""
    for name, joints in (("robust", 6), ("ur5e", 6), ("panda", 7)):
        arm, home, seen = supervised(name)
        for step in range(20):
            assert arm.commands(seen(np.zeros(joints), step)).shape == (0, joints)
        assert "a driver without data" in arm.reason
        for step in range(20, 200):
            assert arm.commands(seen(home + 0.9, step)).shape == (0, joints)
        assert arm.state == "homing" and "nobody says where the arm rests" in arm.reason
        assert arm.commands(seen(home, 200)).shape == (5, joints) and arm.reason is None
        policy = load_policy(name)
        for angles, words in ((np.zeros(joints), "all joint angles are 0"), (home + 0.9, "say")):
            with pytest.raises(UserError, match=words):
                policy.step(seen(angles, 0))


def test_an_arm_rests_where_its_controllers_target_is() -> None:
    """Whatever is wrong with its readings, nothing is sent; also where the target is a copy of
    them."""
    for name in ("robust", "ur5e", "panda"):
        policy = load_policy(name)
        home = np.array(policy.metadata.default_joint_angles)
        rng = np.random.default_rng(0)
        parked = home + 0.3 * rng.uniform(0.5, 1.0, len(home))
        flipped = np.where(np.arange(len(home)) == 1, -1.0, 1.0)
        turned = 0.5 * math.pi * (np.arange(len(home)) == 2)
        half = np.arange(len(home)) < 3
        wrongs = {
            "a sign": lambda q, flipped=flipped: q * flipped,
            "a zero": lambda q, turned=turned: q - turned,
            "zeros": lambda q, half=half: q * half,
            "an order": lambda q: q[[1, 0, *range(2, len(q))]],
        }
        for wrong in wrongs.values():
            for kind in ("true", "a copy", "a late copy"):
                last = None
                arm = policy.supervise(500, box=((-9, -9, -9), (9, 9, 9)))
                for step in range(120):
                    noisy = parked + 1e-5 * rng.standard_normal(len(home))
                    angles = wrong(noisy)
                    target = {"true": parked, "a copy": angles, "a late copy": last}[kind]
                    last = angles
                    given = {"joint_angles": angles, "time": 0.01 * step}
                    if target is not None:
                        given["joint_targets"] = target
                    assert len(arm.commands(given)) == 0
                assert arm.state == ("stopped" if kind == "true" else "homing")
                assert arm.reason
        # Right readings, beside the target by the arm's weight.
        arm = policy.supervise(500)
        for step in range(4):
            angles = parked + 0.005 + 1e-5 * rng.standard_normal(len(home))
            given = {"joint_angles": angles, "joint_targets": parked, "time": 0.01 * step}
            commands = arm.commands(given)
            assert len(commands) == (5 if step >= 2 else 0)
        assert np.abs(commands - parked).max() < 0.01


def test_the_controllers_kinematics_tells_another_arm() -> None:
    """The tool's place and normal, of an arm with longer links or with other signs."""
    metadata = load_policy("ur5e").metadata
    home = np.array(metadata.default_joint_angles)
    longer = [
        link._replace(position=tuple(1.4 * x for x in link.position)) for link in metadata.chain
    ]
    others = {
        "own": (metadata, home),
        "longer": (metadata._replace(chain=tuple(longer)), home),
        "sign": (metadata, home * [1, 1, 1, -1, 1, 1]),
        "zero": (metadata, home + [0, 0, 0, 0, 0.5, 0]),
    }
    for name, (arm_of, angles) in others.items():
        arm = load_policy("ur5e").supervise(500)
        tool = {
            "tool_position": paddle_position(arm_of, angles),
            "tool_normal": paddle_normal(arm_of, angles),
        }
        commands = arm.commands({"joint_angles": home, "time": 0.0} | tool)
        assert len(commands) == (5 if name == "own" else 0)
        if name != "own":
            assert "the policy is of this arm" in arm.reason


def test_targets_at_which_the_arm_does_not_rest_are_no_command() -> None:
    """Neither in degrees nor as zeros of a driver without data; the measured angles are right."""
    for name in ("robust", "ur5e", "panda"):
        _, home, seen = supervised(name)
        policy = load_policy(name)
        policy.reset(home)
        with pytest.raises(UserError, match=r"the target of .* is -?\d+, but .* \(rad\); give"):
            policy.reset(np.degrees(home))
        # Nothing was forgotten.
        np.testing.assert_array_equal(policy.targets, home)
        policy.reset(0.0 * home)
        arm = policy.supervise(500)
        for step in range(120):
            assert arm.commands(seen(home + 0.05, step)).shape == (0, len(home))
            if step == 0:
                assert "where the arm is said to rest" in arm.reason
        assert (arm.state, arm.fault) == ("stopped", "joint_astray")
        assert "check its load, sign, zero" in arm.reason
        arm.restart(moved=True)
        assert len(arm.commands(seen(home + 0.05, 120))) == 5
        # True targets are where the commands begin.
        policy = load_policy(name)
        policy.reset(home + 0.5)
        arm = policy.supervise(500)
        assert np.max(np.abs(arm.commands(seen(home + 0.5, 0)) - home - 0.5)) < 4e-3


def test_an_arm_without_lag_and_one_wrong_sample_are_no_fault() -> None:
    for name in ("robust", "robust_small", "pretrained"):
        arm, home, seen = supervised(name)
        angles = home
        for step in range(60):
            given = seen(angles, step)
            if arm.state == "ready":
                arm.start()
            if step in (30, 40):
                given["joint_angles"] = angles + [0.0, 0.0, 0.0, 3.0, 0.0, 0.0]
            angles = arm.commands(given)[-1]
        assert arm.state == "running", arm.reason


def test_a_wrong_first_sample_of_a_joint_is_no_command() -> None:
    for name, joint, size in (("robust", 1, 0.5), ("ur5e", 0, 0.5), ("iiwa", 1, 0.25)):
        arm, home, seen = supervised(name)
        wrong = home + size * (np.arange(len(home)) == joint)
        assert not len(arm.commands(seen(wrong, 0)))
        assert arm.fault is None and "rad from its start pose" in arm.reason
        for step in range(1, 20):
            commands = arm.commands(seen(home, step))
            assert len(commands) == 5 and np.max(np.abs(commands - home)) < 1e-9
        with pytest.raises(UserError, match="rad from its start pose; say where the arm rests"):
            load_policy(name).step(seen(wrong, 0))
        # Near the start pose it is believed, and the right ones are a jump; nothing else moves.
        arm, home, seen = supervised(name)
        wrong = home + 0.15 * (np.arange(len(home)) == joint)
        rows = [arm.commands(seen(wrong, 0))[-1]]
        rows += [arm.commands(seen(home, step))[-1] for step in range(1, 20)]
        assert arm.fault in ("joint_jump", "joint_astray")
        largest_step = np.array(load_policy(name).metadata.largest_step)
        assert np.all(np.abs(np.diff(rows, axis=0)) <= largest_step + 1e-12)
        assert np.max(np.abs(rows - home)) < 0.15 + 1e-9


def test_another_order_of_the_joints_is_refused_at_the_start_pose() -> None:
    arm, home, seen = supervised("ur5e")
    alphabetical = home[[2, 1, 0, 3, 4, 5]]
    for step, angles in enumerate((alphabetical, home * [1, 1, -1, 1, 1, 1])):
        assert len(arm.commands(seen(angles, step))) == 0
        assert re.search("check its load, sign, zero, unit and place in the order", arm.reason)


def test_a_command_moves_at_most_one_step_from_the_last() -> None:
    """Whatever a sample says: here random ones, of which every fourth cannot be true."""
    for name in ("pretrained", "robust", "ur5e"):
        policy, rng, last = load_policy(name), np.random.default_rng(0), None
        _, home, seen = supervised(name)
        for step in range(200):
            angles = home + 0.002 * rng.uniform(-1.0, 1.0, 6)
            given = seen(angles, step) | {"joint_velocities": np.zeros(6)}
            given["joint_angles"] = angles + (step % 4 == 1) * rng.uniform(-3.0, 3.0, 6)
            policy.step(given)
            command = policy.servo_targets(rng.uniform(-1.0, 1.0, 6))
            if last is not None:
                assert np.all(
                    np.abs(command - last) <= np.array(policy.metadata.largest_step) + 1e-12
                )
            last = command


@pytest.mark.parametrize("share, stops", [(4, False), (2, True)])
def test_at_most_a_third_of_the_samples_is_bridged(share: int, stops: bool) -> None:
    """Zeros of three joints in every second sample are no measurement, nor in every fourth."""
    arm, home, seen = supervised("robust")
    angles = home
    for step in range(80):
        given = seen(angles, step)
        if step > 20 and step % share == 0:
            given["joint_angles"] = angles * [1, 0, 0, 0, 0, 1]
        if arm.state == "ready":
            arm.start()
        angles = arm.commands(given)[-1]
    assert (arm.state != "running") == stops
    assert not stops or arm.fault == "joint_jump"


VELOCITIES = {
    "zero": lambda v: 0.0 * v,
    "reversed": lambda v: -v,
    "permuted": lambda v: np.roll(v, 1),
    "rpm": lambda v: v * 60.0 / (2.0 * math.pi),
    "right": lambda v: v,
    "late": None,
}


@pytest.mark.parametrize("kind", VELOCITIES)
def test_velocities_agree_with_the_angles(kind: str) -> None:
    """Of a policy that sees them; they may come 20 ms later, and have noise."""
    arm, home, seen = supervised("robust")
    rng = np.random.default_rng(0)
    angles, past = home, [np.zeros(6)] * 3
    for step in range(100):
        given = seen(angles, step)
        past.append(given["joint_velocities"])
        velocities = past[-3] if kind == "late" else VELOCITIES[kind](past[-1])
        given["joint_velocities"] = velocities + rng.normal(0.0, 0.02, 6)
        if arm.state == "ready":
            arm.start()
            began = step
        angles = arm.commands(given)[-1]
        if arm.fault:
            break
    if kind in ("right", "late"):
        assert arm.state == "running", arm.reason
    else:
        assert arm.fault == "joint_speed" and step - began <= 50
        assert "by its velocities" in arm.reason or kind == "rpm"


def test_the_first_command_is_where_the_arm_is() -> None:
    """Also outside of its range, to which it comes back at most a step at a time."""
    for policy in (load_policy("robust"), load_policy("ur5e")):
        metadata = policy.metadata
        home = np.array(metadata.default_joint_angles)
        angles = home.copy()
        low, high = metadata.joint_ranges[1]
        angles[1] = high + 0.3
        given = measured(angles, target_height=0.6)
        given["ball_position"] = paddle_position(metadata, home) + [0.0, 0.0, 0.3]
        given = {name: given[name] for name in policy.needs}
        with pytest.raises(UserError, match="say where the arm rests"):
            policy.step(given)
        policy.reset(angles)
        commands = [angles]
        for _ in range(20):
            commands.append(policy.servo_targets(policy.step(given)))
        steps = np.abs(np.diff(commands, axis=0))
        assert np.all(steps <= np.array(metadata.largest_step) + 1e-12)
        assert commands[-1][1] < commands[0][1] - 1e-3


def test_an_angle_whole_turns_outside_its_range_is_refused() -> None:
    """A command for the joint without the turn would be a turn from its reading; and a joint that
    is really so far outside has the same reading."""
    policy, turned = load_policy("robust"), HOME + [2.0 * np.pi, 0.0, 0.0, 0.0, 0.0, 0.0]
    supervisor = policy.supervise(500)
    for _ in range(3):
        with pytest.raises(UserError, match="Joint1 is 6.28, .* and no whole turns"):
            policy.step(measured_by_robust(turned))
        with pytest.raises(UserError, match="Joint1 is 6.28, .* and no whole turns"):
            supervisor.commands(measured_by_robust(turned))


def measured_by_robust(angles: np.ndarray) -> dict[str, Any]:
    given = measured(angles)
    return {name: given[name] for name in load_policy("robust").needs}


def test_time_goes_on() -> None:
    policy = load_policy("pretrained")
    for _ in range(25):
        policy.step(measured(time=0.0))
    with pytest.raises(UserError, match="the time has stood at 0 s for 25 calls"):
        policy.step(measured(time=0.0))
    policy.reset()
    policy.step(measured(time=0.0))
    with pytest.raises(UserError, match="call reset after a pause of 1 s"):
        policy.step(measured(time=1.0))
    policy.reset()
    with pytest.raises(UserError, match="is a float32, whose next number is 128 s later"):
        policy.step(measured(time=np.float32(1.7e9)))


def test_the_braking_distance_counts_in_the_box() -> None:
    """A ball that flies sideways takes neither the commands nor their stop out of the box."""
    arm, home, seen = supervised("ur5e")
    metadata = load_policy("ur5e").metadata
    place = paddle_position(metadata, home)
    arm = load_policy("ur5e").supervise(500, box=(place - 0.1, place + 0.1))
    angles, step, rows = home, 0, []
    while arm.state != "stopped" and step < 500:
        given = seen(angles, step, 0.4)
        if arm.state == "ready":
            arm.start()
        if arm.state == "running":
            given["ball_position"] = given["ball_position"] + [0.0, 0.01 * min(step, 60), 0.0]
        commands = arm.commands(given)
        rows.extend(commands)
        angles, step = commands[-1], step + 1
    paddles = paddle_position(metadata, np.array(rows))
    assert arm.fault == "box" and "outside the box" in arm.reason
    assert 0.05 < np.abs(paddles - place).max() <= 0.1


def test_a_velocity_that_cannot_be_true_is_bridged_also_at_a_repeated_position() -> None:
    policy, right = load_policy("pretrained"), load_policy("pretrained")
    policy.step(measured())
    right.step(measured())
    # For a third of 0.1 s.
    for _ in range(3):
        policy.step(measured(ball_velocity=[0.0, 0.0, 500.0]))
        right.step(measured())
        np.testing.assert_array_equal(policy.observation, right.observation)
    with pytest.raises(UserError, match="the ball has 501 m/s"):
        policy.step(measured(ball_velocity=[0.0, 0.0, 501.0]))


def test_velocities_between_two_pictures_make_no_later_picture() -> None:
    """Here estimates for each step of a ball that a camera without ages sees every 50 ms, and one
    false picture in between."""
    policy = load_policy("pretrained")
    for step in range(40):
        shown = ball_over(PADDLE, 0.05 * (step // 5))
        velocity = ball_over(PADDLE, 0.01 * step)["ball_velocity"]
        if step // 5 == 4 and step % 5 < 2:
            shown = {"ball_position": PADDLE + [0.0, 0.6, 0.4]}
        policy.step(measured(**shown | {"ball_velocity": velocity}))


def test_a_measurement_that_first_comes_when_it_is_doubted_is_left_out() -> None:
    """As a picture's age, from the second picture on."""
    policy = load_policy("pretrained")
    away = {"ball_position": [0.589, 2.0, 0.45]}
    policy.step(measured())
    seen = policy.observation
    policy.step(measured(**away, ball_age=0.0))
    np.testing.assert_array_equal(policy.observation[:3], seen[:3])
    for _ in range(2):
        policy.step(measured(**away, ball_age=0.0))
    with pytest.raises(UserError, match="is 2.1 m from"):
        policy.step(measured(ball_position=[0.589, 2.1, 0.45], ball_age=0.0))
    arm = running()
    arm.supervisor.commands(measured(arm.angles, **away, ball_age=0.0) | {"time": arm.time})
    assert arm.supervisor.state == "running"


@pytest.mark.parametrize("kind", ["the arm's model", "the network"])
def test_whatever_fails_the_arm_brakes_from_its_last_command(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm = running()
    if kind == "the arm's model":

        def fail(*_: Any) -> None:
            raise ZeroDivisionError("of a model")

        # Within the step, when the command has been aimed.
        monkeypatch.setattr(type(arm.supervisor), "_check_box", fail)
        fault = "error"
        reason = r"the program failed: ZeroDivisionError\('of a model'\) \(test_motion.py:\d+\)"
    else:
        network = arm.supervisor._controller.network
        monkeypatch.setattr(
            network._session, "run", lambda *_: [np.full((1, 6), np.nan)], raising=False
        )
        fault, reason = "network", "returned an action that is not finite"
    assert arm.step(**flying(25)) in ("braking", "stopped")
    assert arm.supervisor.fault == fault and re.search(reason, arm.supervisor.reason)
    arm.until("stopped", 100)
    arm.check()


def test_an_arm_that_rests_beside_home_says_why_it_waits_and_stops() -> None:
    policy, angles = limited(), HOME + 0.3
    policy.reset(angles)
    supervisor = policy.supervise(1000)
    off = np.array([0.0, 0.03, 0.0, 0.0, 0.0, 0.0])
    seen = []
    for step in range(300):
        rows = supervisor.commands(measured(angles) | {"time": 0.01 * step})
        # It sinks under its load on the way.
        angles = rows[-1] + off * min(0.0125 * step, 1.0)
        seen.append((supervisor.state, supervisor.reason))
    waiting = [reason for state, reason in seen if state == "homing" and reason]
    assert 90 < len(waiting) <= 100
    assert re.search("Joint2 is 0.0[0-9]+ rad from where its commands rest", waiting[-1])
    assert (supervisor.state, supervisor.fault) == ("stopped", "joint_astray")
    # The load is gone.
    supervisor.restart()
    for step in range(20):
        rows = supervisor.commands(measured() | {"time": 3.0 + 0.01 * step})
    assert (supervisor.state, supervisor.reason) == ("ready", None)


def test_what_is_done_to_the_policy_of_an_arm_moves_nothing() -> None:
    """A supervisor has a memory of its own: resets and steps beside it, another order of the joints
    and another supervisor are not its own."""
    twins = []
    for is_disturbed in (False, True):
        policy = limited()
        arm = Arm(policy.supervise(1000), HOME + 0.1)

        def disturb(policy: DeployedPolicy = policy) -> None:
            policy.use_joints([f"Joint{i}" for i in range(1, 7)])
            for i in range(3):
                policy.step(measured(**flying(i)))
            policy.reset(HOME + 1.0)
            policy.use_joints(policy.metadata.joint_names[::-1])
            policy.supervise(500).commands(measured(HOME[::-1], time=0.0))

        for i in range(120):
            if is_disturbed and i % 7 == 0:
                disturb()
            if arm.supervisor.state == "ready":
                arm.supervisor.start()
                began = i
            running = arm.supervisor.state == "running"
            arm.step(**(flying(i - began) if running else {}))
        arm.check()
        assert arm.supervisor.state == "running"
        twins.append(arm.rows)
    np.testing.assert_array_equal(*twins)


@pytest.mark.parametrize("moment", ["homing", "ready", "start", "running", "restart"])
def test_a_stop_that_comes_while_a_call_works_stays(
    moment: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As from another thread, or from a signal handler within the call."""
    arm = Arm(limited().supervise(1000))
    supervisor = arm.supervisor
    if moment != "homing":
        arm.until("ready")
    if moment == "running":
        supervisor.start()
        for i in range(25):
            arm.step(**flying(i))
    if moment == "restart":
        supervisor.stop("the operator")
        arm.until("stopped")

    def press_stop() -> None:
        supervisor.stop("the operator pressed stop")

    class PressedWhileRead(dict):
        def items(self) -> Any:
            press_stop()
            return super().items()

    if moment in ("start", "restart"):
        controller = supervisor._controller
        episode = controller.episode

        def pressed(*arguments: Any) -> Any:
            press_stop()
            return episode(*arguments)

        monkeypatch.setattr(controller, "episode", pressed)
        if moment == "start":
            supervisor.start()
        else:
            supervisor.restart(moved=True)
        monkeypatch.undo()
    else:
        given = measured(arm.angles, **flying(25), time=arm.time)
        rows = supervisor.commands(PressedWhileRead(given))
        # Nothing was sent before the first sample.
        assert len(rows) == (0 if moment == "homing" else 10)
        arm.rows.extend(rows)
    for _ in range(50):
        assert supervisor.state in ("braking", "stopped") and supervisor.fault == "stopped"
        assert supervisor.reason == "the operator pressed stop"
        with pytest.raises(UserError, match="starts when it is ready"):
            supervisor.start()
        arm.rows.extend(supervisor.commands({}))
    assert supervisor.state == "stopped"
    if len(arm.rows) > 3:
        arm.check()
    supervisor.restart()
    assert (supervisor.state, supervisor.fault) == ("homing", None)


def test_a_stop_before_the_first_sample_sends_nothing_and_stays() -> None:
    supervisor = limited().supervise(1000)
    supervisor.stop("the operator")
    for angles in (np.zeros(6), HOME, HOME):
        assert supervisor.commands(measured(angles)).shape == (0, 6)
        assert (supervisor.state, supervisor.reason) == ("stopped", "the operator")
    supervisor.restart()
    np.testing.assert_allclose(supervisor.commands(measured()), np.tile(HOME, (10, 1)))


@pytest.mark.parametrize(
    ("fault", "later"), [("late_step", 1.5), ("late_step", 0.9), ("time", -1.5)]
)
def test_a_pause_of_any_length_is_a_late_step(fault: str, later: float) -> None:
    arm = running()
    arm.time += later
    arm.step(**flying(25))
    assert arm.supervisor.fault == fault


def test_the_way_home_does_not_leave_the_box() -> None:
    """The paddle's circle about the base is wider than its ends; from outside, the arm may come."""
    start = HOME + [2.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    side = paddle_position(load_policy("pretrained").metadata, start)[1]
    for width, fault in ((side + 0.01, "box"), (side - 0.2, None), (side + 0.1, None)):
        policy = limited()
        policy.reset(start)
        arm = Arm(policy.supervise(1000, box=((-1.0, -1.0, -1.0), (1.0, width, 1.0))), start)
        arm.until_not("homing")
        assert arm.supervisor.fault == fault
        if fault is None:
            assert arm.supervisor.state == "ready"
            continue
        arm.until("stopped")
        paddles = paddle_position(arm.supervisor._metadata, np.array(arm.rows))
        assert side < paddles[:, 1].max() <= width
        arm.check()


def is_astray(changes: dict[str, Any], offset: float, time_constant: float) -> bool:
    """Whether an arm under a policy of other metadata is stopped on its way home from 0.2 rad, or
    in the play: one whose joints are beside their commands (rad), and behind them (s)."""
    policy = changed_policy("robust_small", **changes)
    arm = policy.supervise(500)
    home = np.array(policy.metadata.default_joint_angles)
    place = paddle_position(policy.metadata, home)
    share = 1.0 - math.exp(-0.01 / max(time_constant, 1e-9))
    angles = before = home - 0.2
    for step in range(220):
        given = measured(angles, **ball_over(place, 0.01 * step), target_height=0.6)
        given["joint_velocities"] = (angles - before) / 0.01
        before = angles
        given = {name: given[name] for name in policy.needs} | {"time": 0.01 * step}
        commands = arm.commands(given)
        if len(commands):
            angles = angles + share * (commands[-1] + offset - angles)
        if arm.state == "ready":
            arm.start()
    assert arm.state == "running" or arm.fault == "joint_astray"
    return arm.fault == "joint_astray"


def test_an_arm_of_the_training_is_followed_and_another_one_stops() -> None:
    """Servos without damping, joints with damping of their own, and servos that are soft or have
    constant errors."""
    quick = {"randomization": {}, "servo_damping": (0.0,) * 6}
    stiffness = load_policy("robust").metadata.servo_stiffness
    damped = quick | {"joint_damping": tuple(0.12 * k for k in stiffness)}
    offset = quick | {"randomization": {"servo_offset[3]": (-0.06, 0.02)}}
    soft = quick | {"randomization": {"servo_gain": (0.5, 1.0)}, "sag": (0.0, 0.03, 0.0) * 2}
    late = {"randomization": {"action_latency": (0.0, 0.05)}, "servo_damping": (0.0,) * 6}
    assert np.isfinite(arm_responses(load_policy("robust").metadata._replace(**late))).all()
    for changes, beside, time_constant, expected in (
        (late, 0.0, 0.0, False),
        (late, 0.0, 0.3, True),
        (damped, 0.0, 0.12, False),
        (quick, 0.0, 0.3, True),
        (offset, -0.06, 0.0, False),
        (soft, -0.06, 0.0, False),
        (quick, -0.06, 0.0, True),
    ):
        assert is_astray(changes, beside, time_constant) == expected, (changes, beside)


def test_complex_angles_and_hidden_balls_are_no_measurements() -> None:
    policy = load_policy("pretrained")
    for wrong, words in (
        ({"joint_angles": HOME + 0j}, "joint_angles is"),
        ({"ball_position": np.ma.array([0.6, 0.0, 0.4], mask=True)}, "ball_position holds nan"),
        ({"target_height": "0.5"}, "target_height is '0.5'"),
    ):
        with pytest.raises(UserError, match=words):
            policy.step(measured(**wrong))
    for wrong in (None, []):
        with pytest.raises(UserError, match="takes measurements by name"):
            policy.step(wrong)
        with pytest.raises(UserError, match="give a mapping of their names"):
            policy.supervise(500).commands(wrong)


def pictures_of_a_fall(
    rate: float, noise: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Times [N], s, and places [N, 3], m, of a ball in flight for 0.25 s."""
    times = np.arange(0.0, 0.25, 1.0 / rate)
    path = np.outer(times, [0.2, -0.1, 1.5])
    path[:, 2] -= 0.5 * 9.81 * times**2
    return times, path + noise * rng.standard_normal(path.shape)


@pytest.mark.parametrize("rate", [60.0, 120.0])
def test_a_camera_that_is_bumped_by_5_cm_shows_no_fall(rate: float) -> None:
    """In the training's worlds without pushes; one of these moves a ball as far. With few pictures
    the noise hides one in some hundred."""
    rng = np.random.default_rng(0)
    seen = []
    for _ in range(200):
        times, places = pictures_of_a_fall(rate, 0.003, rng)
        angle = rng.uniform(0.0, 2.0 * np.pi)
        # The last 80 ms.
        places[times > 0.17] += 0.05 * np.array([np.cos(angle), np.sin(angle), 0.0])
        seen.append(fit_fall(times, places, noise=0.008).ratio > 1.0)
    assert np.mean(seen) >= 0.99


@pytest.mark.parametrize("rate", [30.0, 60.0, 120.0])
@pytest.mark.parametrize("push", [0.0, 0.4])
def test_a_fall_with_noise_and_a_push_is_one(rate: float, push: float) -> None:
    rng = np.random.default_rng(0)
    for _ in range(1000):
        times, places = pictures_of_a_fall(rate, 0.008, rng)
        angle = rng.uniform(0.0, 2.0 * np.pi)
        since = np.maximum(times - rng.uniform(0.0, 0.25), 0.0)
        places[:, 0] += push * np.cos(angle) * since
        places[:, 1] += push * np.sin(angle) * since
        assert fit_fall(times, places, noise=0.008, push=push).ratio <= 1.0


def test_missed_steps_have_the_velocity_between_the_last_pictures(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of a policy whose velocities are differences; none in which the ball stood still."""
    policy = changed_policy("track", velocity="differences")
    network = policy.controller.network
    newest = network._newest
    seen = []

    def recorded(*arguments: Any) -> Any:
        values = newest(*arguments)
        seen.append(values["ball_velocity"][2])
        return values

    monkeypatch.setattr(network, "_newest", recorded)
    for step in (0, 1, 2, 6, 7):
        ball = [0.589, 0.0, 0.9 - 0.01 * step]
        given = measured(ball_position=ball, time=0.01 * step, target_x=0.589, target_y=0.0)
        del given["ball_velocity"]
        policy.step(given)
    np.testing.assert_allclose(seen[1:], -1.0, atol=1e-9)
