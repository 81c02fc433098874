"""A deployed policy's commands stay within the limits; its supervisor brakes at every fault."""

import math
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bounce_mjx import BounceBall, EnvConfig, load_policy
from bounce_mjx.deploy.faults import arm_responses, picture_age
from bounce_mjx.deploy.metadata import CommandLimits
from bounce_mjx.deploy.motion import paddle_position
from bounce_mjx.deploy.policy import DeployedPolicy
from bounce_mjx.errors import UserError
from bounce_mjx.physics import servo_targets

LIMITS = {"velocity": (2.0,) * 6, "acceleration": (15.0,) * 6, "jerk": (7500.0,) * 6}
HOME = np.radians([0, 40, 110, 0, -60, 0])


def limited(limits: dict[str, Any] = LIMITS) -> DeployedPolicy:
    """The shipped policy as if its training had had limits."""
    policy = load_policy("pretrained")
    policy.metadata = policy.metadata._replace(limits=CommandLimits(**limits), max_lead=0.15)
    policy.motion = type(policy.motion)(policy.metadata)
    policy.reset()
    return policy


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
    policy, rng = limited(limits), np.random.default_rng(0)
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
            policy.step(measured(np.asarray(start)))
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
        self.rows = [self.angles]

    def step(self, **others: Any) -> str:
        rows = self.supervisor.commands(measured(self.angles) | {"time": self.time} | others)
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


# Two in a row: the first one is bridged where it cannot be true.
FAULTS = {
    "late_step": ({}, "came 3 steps late"),
    "old_picture": (
        {"ball_age": 0.12, "ball_position": [0.589, 0.0, 0.4524]},
        "picture of the ball is 120 ms old",
    ),
    "old_picture before the last": ({"ball_age": 0.12}, "was taken 1[0-9]0 ms before the last"),
    "old_picture of the future": ({"ball_age": -0.02}, "picture of the ball is -20 ms old"),
    "measurement": ({"joint_velocities": [np.nan] * 6}, "joint_velocities holds nan"),
    "measurement missing": ({"ball_velocity": None}, "ball_velocity"),
    "ball_place in mm": ({"ball_position": [589.0, 0.0, 450.0]}, "ball_position is 741"),
    "ball_speed": ({"ball_velocity": [0.0, 0.0, -2000.0]}, "the ball has 2e.03 m/s"),
    "ball_speed by position": ({"ball_position": [0.589, 0.9, 0.45]}, "the ball is 0.9 m from"),
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
    if is_bridged:
        # One sample that cannot be true stops nothing.
        assert arm.step(**wrong) == "running"
        assert arm.step(**flying(26)) == "running"
        assert arm.step(**wrong) == "running"
        wrong = flying(27) | {name: np.array(x) + 1e-5 for name, x in wrong.items()}
    assert arm.step(**wrong) in ("braking", "stopped")
    assert arm.supervisor.fault == name.split()[0] and re.search(reason, arm.supervisor.reason)
    arm.until("stopped", 100)
    assert re.search(reason, arm.supervisor.reason)
    # At rest from then on, even with good measurements.
    for _ in range(5):
        arm.step()
    assert np.ptp(arm.rows[-40:], axis=0).max() == 0.0
    assert np.abs(arm.angles - angles).max() < 0.2
    arm.check()


def flying(i: int, **others: Any) -> dict[str, Any]:
    """Measurements of a ball that each picture shows elsewhere."""
    return {"ball_position": [0.589, 0.0, 0.45 + 1e-4 * i]} | others


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
    needs = arm.supervisor._policy.needs
    assert arm.supervisor.reason == (
        f"the measurement ball_position is missing; this policy needs {', '.join(needs)} in every "
        "step"
    )
    assert needs.count("joint_angles") == 1


@pytest.mark.parametrize("rate", [100, 125, 1000])
def test_a_policy_acts_at_its_own_rate(rate: int) -> None:
    policy, rng = load_policy("pretrained"), np.random.default_rng(0)
    actions = []
    for k in range(2 * rate):
        ball = [0.589, 0.0, 0.3 + 0.1 * rng.random()]
        action = policy.step(measured(ball_position=ball, time=1e3 + k / rate))
        if not actions or np.any(action != actions[-1]):
            actions.append(action)
    assert abs(len(actions) - 200) <= 1 and policy.step_number == len(actions) - 1


@pytest.mark.parametrize("late", [0.0, 0.004], ids=["repeated", "early"])
def test_a_call_without_a_new_step_goes_on_where_the_last_ended(late: float) -> None:
    """No commands are sent twice: the ones of a call without a step brake."""
    arm = running()
    for i in range(25, 45):
        if i in (30, 31, 35):
            time, arm.time = arm.time, arm.time - 0.01 + late
            assert arm.step(**flying(i)) == "running"
            arm.time = time
        assert arm.step(**flying(i)) == "running"
    arm.check()
    time = arm.time - 0.01 + late
    for i in range(3):
        arm.time = time
        state = arm.step(**flying(45 + i))
    assert state == "stopped" and arm.supervisor.fault == "no_step"
    assert "3 calls in a row" in arm.supervisor.reason
    arm.check()


@pytest.mark.parametrize("is_limited", [False, True], ids=["without limits", "limits"])
@pytest.mark.parametrize("rate, fault", [(50, None), (100, None), (200, None), (500, "no_step")])
def test_the_way_home_has_its_speed_at_any_rate_of_calls(
    rate: int, fault: str | None, is_limited: bool
) -> None:
    """As of a robot that calls at its own rate, and sends the first one of the commands."""
    policy = limited() if is_limited else load_policy("pretrained")
    arm = policy.supervise(500)
    start = HOME + [0.4, 0.0, 0.0, 0.0, 0.0, 0.0]
    angles = start
    for call in range(4 * rate):
        commands = arm.commands(measured(angles, time=7.0 + call / rate))
        if len(commands):
            # A step begins up to half a step early, and goes on to its end.
            allowed = 0.3 * (call / rate + 0.015)
            assert np.max(np.abs(commands - start)) <= allowed + 1e-9
            angles = angles + (commands[0] - angles) * (1.0 - np.exp(-1.0 / rate / 0.02))
    assert (arm.state, arm.fault) == (("stopped", fault) if fault else ("ready", None))


def test_a_clock_that_stands_at_home_is_noticed_and_may_begin_anew_after_a_restart() -> None:
    arm = Arm(limited().supervise(1000))
    arm.until("ready")
    time = arm.time
    for _ in range(2):
        assert arm.step(time=time) == "ready"
    # A new step ends the row.
    arm.time = time + 0.01
    assert arm.step() == "ready"
    for repeats in range(1, 4):
        assert arm.step(time=time + 0.01) == ("ready" if repeats < 3 else "stopped")
    assert arm.supervisor.fault == "no_step" and "3 calls in a row" in arm.supervisor.reason
    arm.supervisor.restart()
    arm.time = 0.0
    arm.until("ready", 20)
    for _ in range(20):
        assert arm.step() == "ready"


def supervised(name: str) -> tuple[Any, np.ndarray, Any]:
    """A supervisor of a shipped policy, the arm's home, and measurements of a ball above it."""
    policy = load_policy(name)
    home = np.array(policy.metadata.default_joint_angles)
    place = paddle_position(policy.metadata, home)

    def seen(angles: np.ndarray, step: int, height: float) -> dict[str, Any]:
        given = measured(angles, joint_velocities=np.zeros(len(home)), ball_age=0.005)
        given |= {"ball_position": place + [0.05, 0.03, height], "target_height": 0.6}
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
    while arm.state != "ready":
        arm.commands(seen(home, step, 0.4))
        step += 1
    # An arm that rests is not asked to move.
    for _ in range(40):
        arm.commands(seen(home, step, 0.4))
        step += 1
    arm.start()
    for i in range(50):
        angles = arm.commands(seen(angles, step, 0.25 + 0.15 * np.sin(0.11 * i)))[-1].copy()
        step += 1
        if arm.state != "running":
            break
        angles[joints] = home[joints]
    assert arm.fault == "joint_astray" and "does not follow its commands" in arm.reason


@pytest.mark.parametrize("height, fault", [(0.3, "old_picture"), (0.03, None)])
def test_a_picture_that_stays_the_same_is_old_in_flight_alone(height: float, fault: Any) -> None:
    arm, home, seen = supervised("robust")
    angles = home
    for step in range(60):
        angles = arm.commands(seen(angles, step, height))[-1]
        if arm.state == "ready":
            arm.start()
    assert arm.fault == fault


def test_a_ball_that_comes_nearer_is_not_lost() -> None:
    """From a noisy camera, as when it is thrown at the arm; at the same place it is lost."""
    for speed, fault in ((-1.5, None), (0.0, "ball_lost")):
        arm, rng = Arm(limited().supervise(1000)), np.random.default_rng(0)
        arm.until("ready")
        arm.supervisor.start()
        for i in range(30):
            ball = [0.589 + 1.4 + 0.01 * speed * i, 0.0, 0.4] + rng.normal(0.0, 0.003, 3)
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
    np.testing.assert_array_equal(arm.supervisor.commands(measured(arm.angles))[-1], stopped)
    # Nothing is sent to an arm that is elsewhere, so that its servos may be switched on again.
    for _ in range(20):
        assert arm.supervisor.commands(measured(moved)).shape == (0, 6)
    arm.supervisor.restart()
    for _ in range(110):
        assert arm.supervisor.commands(measured(moved)).shape == (0, 6)
    assert arm.supervisor.state == "stopped" and arm.supervisor.fault == "joint_astray"
    assert "rad from where its commands rest" in arm.supervisor.reason
    # Nor is anything raised before the next first command.
    for wrong, fault in ((np.full(6, np.nan), "measurement"), (HOME + 9.0, "joint_range")):
        arm.supervisor.restart(moved=True)
        assert arm.supervisor.commands(measured(wrong)).shape == (0, 6)
        assert (arm.supervisor.state, arm.supervisor.fault) == ("stopped", fault)
    arm.supervisor.restart(moved=True)
    # One sample could be wrong, so that nothing is sent until the next one confirms it.
    assert len(arm.supervisor.commands(measured(moved))) == 0
    moves = Arm(arm.supervisor, moved)
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
    while arm.state != "stopped":
        arm.commands(seen(home, step, 0.3))
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


def test_another_command_than_the_only_one_of_the_training_is_refused() -> None:
    """The network's input is the same for all, so that none would be heeded."""
    policy = load_policy("pretrained")
    constant = policy.metadata.commands["target_height"]._replace(range=(0.5, 0.5))
    policy.metadata = policy.metadata._replace(commands={"target_height": constant})
    policy.step(measured(target_height=np.float32(0.5)))
    for height in (0.3, 0.51, 0.9):
        words = f"target_height is {height}, but the training had 0.5 alone .m.; give that"
        with pytest.raises(UserError, match=words):
            policy.step(measured(target_height=height))


def test_zeros_of_a_driver_without_data_are_no_command() -> None:
    """Nor is any first sample far from the start pose, before the next one confirms it."""
    for name, joints in (("robust", 6), ("ur5e", 6), ("panda", 7)):
        arm, home, seen = supervised(name)
        for step in range(20):
            assert arm.commands(seen(np.zeros(joints), step, 0.3)).shape == (0, joints)
        assert "a driver without data" in arm.reason
        far = home + 0.9
        assert arm.commands(seen(far, 20, 0.3)).shape == (0, joints)
        assert arm.commands(seen(home, 21, 0.3)).shape == (5, joints) and arm.reason is None
        arm, home, seen = supervised(name)
        assert not len(arm.commands(seen(far, 0, 0.3)))
        np.testing.assert_allclose(arm.commands(seen(far, 1, 0.3))[0], far, atol=4e-3)
        policy = load_policy(name)
        with pytest.raises(UserError, match="all joint angles are 0"):
            policy.step(seen(np.zeros(joints), 0, 0.3))


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
            assert arm.commands(seen(home + 0.05, step, 0.3)).shape == (0, len(home))
            if step == 0:
                assert "the commands at which the arm is said to rest" in arm.reason
        assert (arm.state, arm.fault) == ("stopped", "joint_astray")
        assert "check its load, its zero and the targets given to reset" in arm.reason
        arm.restart(moved=True)
        assert len(arm.commands(seen(home + 0.05, 120, 0.3))) == 5
        # True targets are where the commands begin.
        policy = load_policy(name)
        policy.reset(home + 0.5)
        arm = policy.supervise(500)
        assert np.max(np.abs(arm.commands(seen(home + 0.5, 0, 0.3)) - home - 0.5)) < 4e-3


def test_an_arm_without_lag_and_one_wrong_sample_are_no_fault() -> None:
    for name in ("robust", "robust_small", "pretrained"):
        arm, home, seen = supervised(name)
        names = (*load_policy(name).needs, "ball_age", "time")
        angles = home
        for step in range(60):
            given = seen(angles, step, 0.4 + 0.05 * math.sin(0.2 * step))
            given["ball_velocity"] = [0.0, 0.0, math.cos(0.2 * step)]
            if arm.state == "ready":
                arm.start()
            if step in (30, 40):
                given["joint_angles"] = angles + [0.0, 0.0, 0.0, 3.0, 0.0, 0.0]
            angles = arm.commands({key: given[key] for key in names})[-1]
        assert arm.state == "running", arm.reason


def test_a_wrong_first_sample_of_a_joint_is_no_command() -> None:
    for name, joint, size in (("robust", 1, 0.5), ("ur5e", 0, 0.5), ("iiwa", 1, 0.25)):
        arm, home, seen = supervised(name)
        wrong = home + size * (np.arange(len(home)) == joint)
        # Far from the start pose, it waits for a second one that agrees.
        assert not len(arm.commands(seen(wrong, 0, 0.3)))
        assert arm.fault is None and "the next sample confirms them" in arm.reason
        for step in range(1, 20):
            commands = arm.commands(seen(home, step, 0.3))
            assert len(commands) == 5 and np.max(np.abs(commands - home)) < 1e-9
        with pytest.raises(UserError, match="the next sample confirms them"):
            load_policy(name).step(seen(wrong, 0, 0.3))
        # Near the start pose it is believed, and the right ones are a jump; nothing else moves.
        arm, home, seen = supervised(name)
        wrong = home + 0.15 * (np.arange(len(home)) == joint)
        rows = [arm.commands(seen(wrong, 0, 0.3))[-1]]
        rows += [arm.commands(seen(home, step, 0.3))[-1] for step in range(1, 20)]
        assert arm.fault == "joint_jump"
        largest_step = np.array(load_policy(name).metadata.largest_step)
        assert np.all(np.abs(np.diff(rows, axis=0)) <= largest_step + 1e-12)
        assert np.max(np.abs(rows - home)) < 0.15 + 1e-9


def test_another_order_of_the_joints_is_refused_at_the_start_pose() -> None:
    arm, home, seen = supervised("ur5e")
    alphabetical = home[[2, 1, 0, 3, 4, 5]]
    for angles in (alphabetical, home * [1, 1, -1, 1, 1, 1]):
        with pytest.raises(UserError, match="another order or with other signs; give .*elbow"):
            arm.commands(seen(angles, 0, 0.3))


def test_a_command_moves_at_most_one_step_from_the_last() -> None:
    """Whatever a sample says: here random ones, of which every second cannot be true."""
    for name in ("pretrained", "robust", "ur5e"):
        policy, rng, last = load_policy(name), np.random.default_rng(0), None
        home = np.array(policy.metadata.default_joint_angles)
        place = paddle_position(policy.metadata, home)
        for step in range(200):
            angles = (
                home + 0.02 * rng.uniform(-1.0, 1.0, 6) + (step % 2) * rng.uniform(-3.0, 3.0, 6)
            )
            ball = place + [0.0, 0.0, 0.3 + 0.05 * np.sin(0.3 * step)]
            given = measured(angles, ball_position=ball, target_height=0.6)
            policy.step({key: given[key] for key in policy.needs})
            command = policy.servo_targets(rng.uniform(-1.0, 1.0, 6))
            if last is not None:
                assert np.all(
                    np.abs(command - last) <= np.array(policy.metadata.largest_step) + 1e-12
                )
            last = command


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
        with pytest.raises(UserError, match="the next sample confirms them"):
            policy.step(given)
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
    for _ in range(50):
        policy.step(measured(time=0.0))
    with pytest.raises(UserError, match="the time has stood at 0 s for 50 calls"):
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
    while arm.state != "stopped":
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
    # One picture is bridged in all of its steps.
    for _ in range(2):
        policy.step(measured(ball_velocity=[0.0, 0.0, 500.0]))
        right.step(measured())
        np.testing.assert_array_equal(policy.observation, right.observation)
    with pytest.raises(UserError, match="the ball has 501 m/s"):
        policy.step(measured(ball_velocity=[0.0, 0.0, 501.0]))


def test_velocities_between_two_pictures_make_no_later_picture() -> None:
    """Here estimates for each step of a ball that a camera without ages sees every 50 ms."""
    policy = load_policy("pretrained")
    speed = 0.5 * policy.metadata.ball.speed
    for step in range(20):
        height = 0.3 + 0.05 * speed * (step // 5 % 2)
        velocity = [0.0, 0.0, 0.01 * step]
        policy.step(measured(ball_position=[0.589, 0.0, height], ball_velocity=velocity))


def test_a_measurement_that_first_comes_when_it_is_doubted_is_left_out() -> None:
    """As a picture's age, from the second picture on."""
    policy = load_policy("pretrained")
    away = {"ball_position": [0.589, 2.0, 0.45]}
    policy.step(measured())
    seen = policy.observation
    policy.step(measured(**away, ball_age=0.0))
    np.testing.assert_array_equal(policy.observation[:3], seen[:3])
    with pytest.raises(UserError, match="the ball is 2.1 m from"):
        policy.step(measured(ball_position=[0.589, 2.1, 0.45], ball_age=0.0))
    arm = running()
    arm.supervisor.commands(measured(arm.angles, **away, ball_age=0.0) | {"time": arm.time})
    assert arm.supervisor.state == "running"


@pytest.mark.parametrize("kind", ["the arm's model", "the network", "the policy is reset", "order"])
def test_whatever_fails_the_arm_brakes_from_its_last_command(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm = running()
    policy = arm.supervisor._policy
    fault, reason = "error", "the policy was reset or stepped beside its supervisor"
    if kind == "the arm's model":

        def fail(*_: Any) -> None:
            raise ZeroDivisionError("of a model")

        # Within the step, when the command has been aimed.
        monkeypatch.setattr(type(arm.supervisor), "_keep_in_box", fail)
        reason = r"the program failed: ZeroDivisionError\('of a model'\) \(test_motion.py:\d+\)"
    elif kind == "the network":
        monkeypatch.setattr(
            policy._network._session, "run", lambda *_: [np.full((1, 6), np.nan)], raising=False
        )
        fault, reason = "network", "returned an action that is not finite"
    elif kind == "order":
        policy.use_joints(policy.metadata.joint_names[::-1])
        reason = "joints have another order than the supervisor's"
    else:
        policy.reset(HOME + 1.0)
    assert arm.step(**flying(25)) in ("braking", "stopped")
    assert arm.supervisor.fault == fault and re.search(reason, arm.supervisor.reason)
    arm.until("stopped", 100)
    arm.check()
    if kind == "order":
        with pytest.raises(UserError, match="call supervise again"):
            arm.supervisor.restart()
        rows = policy.supervise(1000).commands(measured(HOME[::-1]))
        np.testing.assert_allclose(rows, np.tile(HOME[::-1], (10, 1)), atol=1e-12)


def test_an_arm_that_rests_beside_home_says_why_it_waits_and_stops() -> None:
    supervisor, angles = limited().supervise(1000), HOME + 0.3
    off = np.array([0.0, 0.03, 0.0, 0.0, 0.0, 0.0])
    seen = []
    # Far from home, it waits for a second sample.
    supervisor.commands(measured(angles) | {"time": -0.01})
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


def play_beside(policy: DeployedPolicy, steps: int = 10) -> None:
    """Steps of a policy whose commands nobody sends."""
    for i in range(steps):
        policy.step(measured(**flying(i)))


@pytest.mark.parametrize("is_reset", [True, False], ids=["reset", "stepped"])
def test_what_is_done_to_the_policy_of_a_resting_arm_moves_nothing(is_reset: bool) -> None:
    arm = Arm(limited().supervise(1000), HOME + 0.1)

    def disturb() -> None:
        if is_reset:
            arm.supervisor._policy.reset()
        else:
            play_beside(arm.supervisor._policy)

    arm.until("ready")
    disturb()
    arm.supervisor.start()
    for i in range(25):
        assert arm.step(**flying(i)) == "running"
    arm.supervisor.stop("the operator")
    arm.until("stopped", 100)
    disturb()
    arm.supervisor.restart()
    arm.until("ready")
    arm.check()


@pytest.mark.parametrize("moment", ["homing", "ready", "start", "running", "restart"])
def test_a_stop_that_comes_while_a_call_works_stays(moment: str) -> None:
    """As from another thread, or from a signal handler within the call."""
    arm = Arm(limited().supervise(1000))
    supervisor, policy = arm.supervisor, arm.supervisor._policy
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
        reset = policy.reset

        def pressed_reset(*targets: Any) -> None:
            press_stop()
            reset(*targets)

        policy.reset = pressed_reset
        if moment == "start":
            supervisor.start()
        else:
            supervisor.restart(moved=True)
        policy.reset = reset
    else:
        given = measured(arm.angles, **flying(25)) | {"time": arm.time}
        arm.rows.extend(supervisor.commands(PressedWhileRead(given)))
        arm.angles, arm.time = arm.rows[-1], arm.time + 0.01
    for _ in range(50):
        assert supervisor.state in ("braking", "stopped") and supervisor.fault == "stopped"
        assert supervisor.reason == "the operator pressed stop"
        with pytest.raises(UserError, match="starts when it is ready"):
            supervisor.start()
        arm.rows.extend(supervisor.commands({}))
    assert supervisor.state == "stopped"
    arm.check()
    supervisor.restart()
    assert (supervisor.state, supervisor.fault) == ("homing", None)


def test_steps_beside_a_supervisor_without_commands_are_no_commands() -> None:
    policy = limited()
    supervisor = policy.supervise(1000)
    play_beside(policy)
    assert supervisor.commands(measured()).shape == (0, 6)
    assert supervisor.fault == "error" and "call the supervisor alone" in supervisor.reason
    supervisor.restart()
    np.testing.assert_allclose(supervisor.commands(measured()), np.tile(HOME, (10, 1)))


def test_a_policy_has_one_supervisor_at_a_time() -> None:
    arm = running()
    policy, first = arm.supervisor._policy, arm.supervisor
    with pytest.raises(UserError, match="has a supervisor, whose arm is running; stop it"):
        policy.supervise(1000)
    assert arm.step(**flying(25)) == "running"
    first.stop("the operator")
    arm.until("stopped", 100)
    arm.supervisor = policy.supervise(1000)
    arm.until("ready")
    arm.check()
    # The first one has an end of its commands from before, to which it does not go back.
    assert first.commands(measured(arm.angles)).shape == (0, 6)
    assert first.fault == "error" and "the policy has a newer supervisor" in first.reason
    for change in (first.restart, first.start):
        with pytest.raises(UserError, match="the policy has a newer supervisor"):
            change()
    arm.supervisor.start()
    for i in range(25):
        assert arm.step(**flying(i)) == "running"
    arm.check()


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
        arm = Arm(limited().supervise(1000, box=((-1.0, -1.0, -1.0), (1.0, width, 1.0))), start)
        # Far from home, it waits for a second sample.
        arm.supervisor.commands(measured(start) | {"time": -0.01})
        while arm.step() == "homing":
            pass
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
    policy = load_policy("robust")
    policy.metadata = policy.metadata._replace(**changes)
    arm = policy.supervise(500)
    home = np.array(policy.metadata.default_joint_angles)
    place = paddle_position(policy.metadata, home)
    share = 1.0 - math.exp(-0.01 / max(time_constant, 1e-9))
    angles = home - 0.2
    for step in range(220):
        ball = place + [0.05, 0.03, 0.4 + 0.1 * math.sin(0.2 * step)]
        given = measured(angles, ball_position=ball, target_height=0.6)
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
