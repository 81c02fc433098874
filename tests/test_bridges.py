"""The bridges to robots, on stand-ins of their libraries in front of MuJoCo's C engine."""

import argparse
import itertools
import os
import re
import runpy
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from bounce_mjx import load_policy
from bounce_mjx.deploy.box import add_box, box_of
from bounce_mjx.deploy.session import Session, Terminal, play
from bounce_mjx.resources import resource_path

EXAMPLES = Path(__file__).parent.parent / "examples"
RATE, SECONDS = 500, 9.0
BOX = ((0.1, -0.5, -0.4), (1.1, 0.5, 0.6))


class World:
    """The simulated arm at 500 Hz, somebody who holds the ball until the arm is ready and puts it
    back after a loss, and a camera of 100 Hz with 20 ms of delay."""

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_path(str(resource_path("mjcf/bounce_ball.xml")))
        self.data = mujoco.MjData(self.model)
        self.names = [f"Joint{i}" for i in range(1, 7)]
        self.data.qpos[:6] = np.radians([0, 40, 110, 0, -60, 0]) + 0.05
        self.data.ctrl[:] = self.data.qpos[:6]
        self.ball = self.data.joint("ball_link")
        self.start, self.held = self.ball.qpos.copy(), True
        self.pictures: list[tuple[float, np.ndarray]] = []
        self.commands, self.ticks, self.bounces, self.before = [], 0, 0, 0

    @property
    def time(self) -> float:
        return self.data.time

    def picture(self) -> tuple[float, np.ndarray] | None:
        """The newest picture that has arrived: its time and the ball's position."""
        arrived = [p for p in self.pictures if p[0] <= self.time - 0.02 + 1e-9]
        return arrived[-1] if arrived else None

    def tick(self, command: Any) -> None:
        """2 ms with a command."""
        self.commands.append(np.array(command))
        self.data.ctrl[:] = command
        if self.ticks % 5 == 0:
            self.pictures.append((self.time, self.ball.qpos[:3].copy()))
        for _ in range(2):
            falling = self.ball.qvel[2] < 0.0
            mujoco.mj_step(self.model, self.data)
            if self.held:
                self.ball.qpos[:], self.ball.qvel[:] = self.start, 0.0
            self.bounces += bool(falling and self.ball.qvel[2] > 0.0)
        self.ticks += 1

    def tool(self) -> tuple[np.ndarray, np.ndarray]:
        """The paddle's centre [3], m, and its axes [3, 3] in columns, z upward, by MuJoCo."""
        mujoco.mj_kinematics(self.model, self.data)
        paddle = self.data.geom("blocker")
        axes = paddle.xmat.reshape(3, 3)
        if axes[2, 2] < 0.0:
            axes = axes * [1.0, -1.0, -1.0]
        return paddle.xpos.copy(), axes

    def watch(self, arm: Any) -> None:
        self.held = arm.state not in ("running", "braking")


class Watched:
    """A policy whose supervisor is known."""

    def __init__(self):
        self.policy = load_policy("robust")
        self.settings: list[dict[str, Any]] = []
        self.supervisor: Any = None
        make = self.policy.supervise

        def supervise(rate: float, **settings: Any) -> Any:
            self.settings.append(settings)
            self.supervisor = make(rate, **settings)
            return self.supervisor

        self.policy.supervise = supervise


class Waiting:
    """An operator who gives the word when the arm has waited for it for half a second."""

    def __init__(self):
        self.asked: list[bool] = []
        """Whether the arm waited, in each control step."""
        self.heard: list[str] = []

    def has_word(self, state: str) -> bool:
        self.asked.append(state in ("ready", "stopped"))
        return len(self.asked) >= 50 and all(self.asked[-50:])

    def hear(self, words: str) -> None:
        self.heard.append(words)


def asked_for(time: float) -> dict[str, float]:
    return {"target_height": 0.5}


def check(world: World, session: Session) -> None:
    """The ball bounces, is thrown away once, and bounces again."""
    first, second = session.episodes
    assert first.fault in ("ball_lost", "ball_flight") and second.fault is None
    assert session.fault is None
    assert world.before >= 3 and world.bounces - world.before >= 2
    steps = np.abs(np.diff(world.commands, axis=0))
    assert steps.max() < 0.05


def rotation_vector(axes: np.ndarray) -> np.ndarray:
    """Of a rotation matrix [3, 3]."""
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    vector = np.zeros(3)
    mujoco.mju_quat2Vel(vector, quaternion, 1.0)
    return vector


def knocked(world: World) -> None:
    """Knocks the ball away in the third second."""
    if world.ticks == 3 * RATE:
        world.ball.qvel[:3], world.before = (3.0, 3.0, 0.0), world.bounces


def test_ur_rtde_bridge() -> None:
    world, watched = World(), Watched()
    bridge = runpy.run_path(str(EXAMPLES / "ur_rtde_bridge.py"))

    rests: list[int] = []

    class Control:
        in_period = False
        was_stopped = False

        def initPeriod(self) -> int:
            self.in_period = True
            return world.ticks

        def servoJ(self, q, speed, acceleration, dt, lookahead, gain) -> bool:
            assert isinstance(q, list) and len(q) == 6 and dt == 1.0 / RATE
            assert 0.03 <= lookahead <= 0.2 and 100 <= gain <= 2000
            self.sent = q
            return True

        def waitPeriod(self, period: int) -> None:
            assert period == world.ticks
            self.in_period = False
            is_stopped = watched.supervisor.state == "stopped"
            if is_stopped and not self.was_stopped and world.before:
                rests.append(0)
            rests_on = is_stopped and rests and np.array_equal(self.sent, world.commands[-1])
            self.was_stopped = is_stopped
            if rests_on:
                rests[-1] += 1
            knocked(world)
            world.tick(self.sent)
            world.watch(watched.supervisor)

        def servoStop(self) -> None:
            self.stopped = True

    class Receive:
        def getActualQ(self) -> list[float]:
            # A period has the time of reading and computing too, or a control step is longer.
            assert control.in_period
            return world.data.qpos[:6].tolist()

        broken = False

        def getTargetQ(self) -> list[float]:
            return world.data.ctrl[:6].tolist()

        def getActualQd(self) -> list[float]:
            return [np.nan] * 6 if self.broken else world.data.qvel[:6].tolist()

        def getTimestamp(self) -> float:
            return world.time

        def getActualTCPPose(self) -> list[float]:
            position, axes = world.tool()
            return [*position, *rotation_vector(axes)]

    class Socket:
        """Datagrams of the camera."""

        sent, bad = 0, [b"", b"hello", b"0.5 0.4", b"nan nan nan nan", b"0.5 0 0.5 0.01 77"]

        def recv(self, size: int) -> bytes:
            picture = world.picture()
            if world.ticks > RATE and self.bad:
                return self.bad.pop()
            if picture is None or picture[0] == self.sent:
                raise BlockingIOError
            self.sent = picture[0]
            return " ".join(map(str, [*picture[1], world.time - picture[0]])).encode()

    camera = bridge["Camera"].__new__(bridge["Camera"])
    camera.socket, camera.newest, camera.ignored = Socket(), {}, 0
    camera.clock, camera.taken = (lambda: world.time), -np.inf
    control, receive = Control(), Receive()
    operator = Waiting()
    box = {"box": BOX}
    robot = bridge["UniversalRobot"](control, receive, camera)
    session = play(watched.policy, robot, SECONDS, operator, asked_for, box)
    # It brakes at the end, within the box of time and some more.
    assert control.stopped and 0 <= world.ticks - SECONDS * RATE <= 0.3 * RATE
    assert np.ptp(world.commands[-5:], axis=0).max() < 1e-9
    # No hand is met by an arm that went home after the lost ball before the word.
    assert len(rests) == 2 and rests[0] >= 0.49 * RATE
    assert watched.settings == [box]
    # After the lost ball the arm was ready, and waited for the word.
    waits = "".join("r" if is_ready else "." for is_ready in operator.asked)
    assert len(re.findall("r{50}", waits)) == 3
    words = ["is ready", "stopped as the ball", "is ready"]
    assert len(operator.heard) == 3
    assert all(word in said for word, said in zip(words, operator.heard, strict=True))
    check(world, session)
    assert camera.ignored == 5
    # After another fault, no word starts it again.
    receive.broken = True
    watched = Watched()
    session = play(watched.policy, robot, SECONDS, operator, asked_for, {})
    assert session.fault == "measurement" and "joint_velocities holds nan" in session.reason
    assert world.ticks < 2 * SECONDS * RATE
    # A lost connection ends the program, and stops the arm first.
    control.stopped = False

    def lose_connection() -> list[float]:
        raise RuntimeError("connection lost")

    receive.getActualQ = lose_connection
    with pytest.raises(RuntimeError, match="connection lost"):
        play(Watched().policy, robot, SECONDS, operator, asked_for, {})
    assert control.stopped


def test_the_word_at_a_terminal_is_a_line(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """Nothing, and the end of the input, are none."""
    readable, writable = os.pipe()
    with os.fdopen(readable) as lines:
        monkeypatch.setattr("sys.stdin", lines)
        terminal = Terminal()
        assert not terminal.has_word("ready")
        os.write(writable, b"\n")
        assert terminal.has_word("ready") and not terminal.has_word("ready")
        os.close(writable)
        assert not terminal.has_word("ready")
    terminal.hear("the arm is ready")
    assert capsys.readouterr().out == "the arm is ready\n"


def test_a_bridge_does_not_begin_at_readings_that_its_controller_contradicts() -> None:
    """Here the second joint is read with another sign: nothing is sent, and the reason is said."""
    bridge = runpy.run_path(str(EXAMPLES / "ur_rtde_bridge.py"))
    policy = load_policy("robust")
    parked = np.radians([0, 40, 110, 0, -60, 0]) + 0.3
    sent, ticks = [], []
    control = message(
        initPeriod=lambda: None,
        waitPeriod=ticks.append,
        servoJ=lambda *command: sent.append(command),
        servoStop=lambda: None,
    )
    receive = message(
        getTargetQ=parked.tolist,
        getActualQ=lambda: (parked * [1, -1, 1, 1, 1, 1]).tolist(),
        getActualQd=lambda: [0.0] * 6,
        getTimestamp=lambda: 0.002 * len(ticks),
        getActualTCPPose=lambda: [0.0] * 6,
    )
    camera = message(measure=lambda: {"ball_age": np.inf}, receive=lambda: None)
    robot = bridge["UniversalRobot"](control, receive, camera)
    session = play(policy, robot, 6.0, Waiting(), asked_for, {})
    assert not sent and not session.episodes
    assert "Joint2 is 2 rad from where its commands rest" in session.reason


# Of Universal Robots' own table (support article "DH parameters"): d and a of each joint, m.
UNIVERSAL_ROBOTS = {
    "UR3e": ((0.15185, 0, 0, 0.13105, 0.08535, 0.0921), (0, -0.24355, -0.2132, 0, 0, 0)),
    "UR5e": ((0.1625, 0, 0, 0.1333, 0.0997, 0.0996), (0, -0.425, -0.3922, 0, 0, 0)),
    "UR10e": ((0.1807, 0, 0, 0.17415, 0.11985, 0.11655), (0, -0.6127, -0.57155, 0, 0, 0)),
}
TWISTS = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
"""alpha of each joint, rad."""
PADDLE = 0.0304
"""From the flange to the paddle's centre along the flange's z, m."""


def tool_pose(robot: str, angles: Any) -> list[float]:
    """What the controller of a Universal Robot gives as its tool centre point's pose."""
    pose = np.eye(4)
    for q, d, a, twist in zip(angles, *UNIVERSAL_ROBOTS[robot], TWISTS, strict=True):
        c, s = np.cos(q), np.sin(q)
        ca, sa = np.cos(twist), np.sin(twist)
        link = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d]]
        pose = pose @ np.array([*link, [0, 0, 0, 1]])
    return [*(pose[:3, 3] + PADDLE * pose[:3, 2]), *rotation_vector(pose[:3, :3])]


@pytest.mark.parametrize("robot", list(UNIVERSAL_ROBOTS))
@pytest.mark.parametrize("parked", [0.0, 0.4])
def test_a_ur_bridge_sends_nothing_to_another_robot(robot, parked) -> None:
    """Of which the joints have the same names, and rest at the same angles."""
    bridge = runpy.run_path(str(EXAMPLES / "ur_rtde_bridge.py"))
    policy = load_policy("ur5e", joint_names=bridge["JOINTS"])
    arm = message(angles=np.array(policy.metadata.default_joint_angles) + parked)
    sent, ticks = [], []

    def follow(angles: list[float], *settings: float) -> None:
        sent.append(angles)
        arm.angles = np.array(angles)

    control = message(
        initPeriod=lambda: None, waitPeriod=ticks.append, servoJ=follow, servoStop=lambda: None
    )
    start = arm.angles
    receive = message(
        getTargetQ=lambda: arm.angles.tolist(),
        getActualQ=lambda: (arm.angles + 1e-4).tolist(),
        getActualQd=lambda: [0.0] * 6,
        getTimestamp=lambda: 0.002 * len(ticks),
        getActualTCPPose=lambda: tool_pose(robot, arm.angles),
    )
    camera = message(measure=lambda: {"ball_age": np.inf}, receive=lambda: None)
    driver = bridge["UniversalRobot"](control, receive, camera)
    operator = Waiting()
    session = play(policy, driver, 6.0, operator, asked_for, {})
    if robot == "UR5e":
        assert sent and session.fault is None
        np.testing.assert_allclose(sent[0], start, atol=1e-3)
        # Without a picture of the ball, no word starts an episode.
        assert not session.episodes and "there is no picture of the ball" in session.reason
    else:
        assert not sent and session.fault == "tool"
        assert "check that the policy is of this arm" in session.reason


def test_a_robots_program_asks_for_a_box(capsys: pytest.CaptureFixture) -> None:
    parser = argparse.ArgumentParser()
    add_box(parser)
    with pytest.raises(SystemExit):
        parser.parse_args([])
    assert "--box --no-box is required" in capsys.readouterr().err
    given = "--box 0.2 -0.5 -0.2 1 0.5 0.6".split()
    assert box_of(parser.parse_args(given)) == {"box": ([0.2, -0.5, -0.2], [1, 0.5, 0.6])}
    assert box_of(parser.parse_args(["--no-box"])) == {}


def message(**fields: Any) -> types.SimpleNamespace:
    return types.SimpleNamespace(**fields)


def ros_bridge(
    monkeypatch: pytest.MonkeyPatch, world: World, said: list[str], turn: Callable[[Any], None]
) -> dict[str, Any]:
    """The names of the ROS bridge, on stand-ins of the messages, of a node and of an executor.

    Args:
      turn: takes a node through a period, in which messages come and then the timer.
    """

    class Time:
        def __init__(self, nanoseconds: int):
            self.nanoseconds = nanoseconds

        def __sub__(self, other: "Time") -> "Time":
            return Time(self.nanoseconds - other.nanoseconds)

        @staticmethod
        def from_msg(stamp: types.SimpleNamespace) -> "Time":
            return Time(stamp.sec * 10**9 + stamp.nanosec)

    class Node:
        def __init__(self, name: str):
            self.subscribed, self.timers = {}, []

        def create_subscription(self, kind, topic, callback, depth) -> None:
            self.subscribed[topic] = callback

        def create_publisher(self, kind, topic, depth) -> types.SimpleNamespace:
            assert topic == "/forward_position_controller/commands"
            return message(publish=lambda sent: setattr(self, "sent", sent.data))

        def create_timer(self, period: float, callback) -> None:
            assert period == 1.0 / RATE
            self.timers.append(callback)

        def get_logger(self) -> types.SimpleNamespace:
            return message(info=said.append)

    class Executor:
        def add_node(self, node: Node) -> None:
            self.node = node

        def spin_once(self) -> None:
            turn(self.node)
            (tick,) = self.node.timers
            tick()

    modules = {
        "rclpy": {},
        "rclpy.executors": {"SingleThreadedExecutor": Executor},
        "rclpy.node": {"Node": Node},
        "rclpy.time": {"Time": Time},
        "geometry_msgs.msg": {"PointStamped": None, "PoseStamped": None},
        "sensor_msgs.msg": {"JointState": None},
        "std_msgs.msg": {"Empty": None, "Float64MultiArray": message, "Header": None},
    }
    for name, content in modules.items():
        module = types.ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
        monkeypatch.setitem(
            sys.modules, name.split(".")[0], sys.modules.get(name.split(".")[0], module)
        )
    return runpy.run_path(str(EXAMPLES / "ros2_bridge.py"))


def test_ros2_bridge(monkeypatch: pytest.MonkeyPatch) -> None:
    world, watched, operator, said = World(), Watched(), Waiting(), []
    tool_topic = "/tcp_pose_broadcaster/pose"
    backwards = world.names[::-1]
    shown: list[float] = []
    missing: set[str] = set()

    def turn(node: Any) -> None:
        """A period, of which the last command is sent; the first ten have no tool's pose."""
        if watched.supervisor is not None:
            knocked(world)
            world.tick(getattr(node, "sent", world.data.ctrl))
            world.watch(watched.supervisor)
        if world.ticks < 10:
            # Nothing is sent before the tool's pose has come.
            assert not hasattr(node, "sent")
        else:
            node.subscribed[tool_topic](tool_message(world))
        velocities = world.data.qvel[:6][::-1].tolist()
        state = message(
            header=message(stamp=stamp_of(world.time)),
            name=backwards,
            position=world.data.qpos[:6][::-1].tolist(),
            velocity=[] if "velocities" in missing else velocities,
        )
        if "angles" not in missing:
            node.subscribed["/joint_states"](state)
        gripper = message(name=["finger"], position=[0.02], velocity=[])
        node.subscribed["/joint_states"](gripper)
        picture = world.picture()
        if picture is not None and picture[0] not in shown[-1:]:
            shown.append(picture[0])
            point = message(**dict(zip("xyz", picture[1], strict=True)))
            header = message(stamp=stamp_of(picture[0]), frame_id="base")
            node.subscribed["/ball"](message(point=point, header=header))
        if operator.has_word(watched.supervisor.state):
            node.subscribed["/start"](message())

    bridge = ros_bridge(monkeypatch, world, said, turn)
    # The operator says where the arm rests, where the paddle may go, and the frame's name.
    rests, box, frame = ["--rests-at", "0", "0"], ["--no-box"], ["--frame", "base"]
    for words in (rests + box, rests + frame, box + frame):
        with pytest.raises(SystemExit):
            bridge["parse_arguments"](["robust", *words])
    assert bridge["parse_arguments"](["robust", *rests, *box, *frame]).frame == "base"
    rests_at = world.data.ctrl[:6].tolist()
    node = bridge["Bridge"](world.names, rests_at, "base", tool_topic)
    session = play(watched.policy, node, SECONDS, node, asked_for, {"box": BOX})
    check(world, session)
    assert [words.split(";")[0] for words in said][::2] == ["the arm is ready"] * 2
    assert len(said) == 3 and "give the word to go home, with no hand near" in said[1]
    # A message without velocities brakes the arm, and the program ends.
    missing.add("velocities")
    node.rests_at = np.array(node.sent)
    session = play(watched.policy, node, SECONDS, node, asked_for, {"box": BOX})
    assert session.fault == "measurement" and "joint_velocities" in session.reason
    # Angles that come no more are no new ones.
    missing.add("angles")
    operator.asked.clear()
    node.rests_at = np.array(node.sent)
    session = play(watched.policy, node, SECONDS, node, asked_for, {"box": BOX})
    assert session.fault == "time"


def stamp_of(time: float) -> types.SimpleNamespace:
    return message(sec=int(time), nanosec=round(time % 1 * 1e9))


def tool_message(world: World, frame: str = "base") -> types.SimpleNamespace:
    """The pose of the paddle as ROS has it."""
    position, axes = world.tool()
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    pose = message(
        position=message(**dict(zip("xyz", position, strict=True))),
        orientation=message(**dict(zip("wxyz", quaternion, strict=True))),
    )
    return message(pose=pose, header=message(frame_id=frame))


def resting(world: World, turn: Callable[[Any, int], None]) -> Callable[[Any], None]:
    """Periods of an arm that rests at its start pose, each with its messages and others'."""
    angles = list(load_policy("robust").metadata.default_joint_angles)
    count = itertools.count()

    def period(node: Any) -> None:
        number = next(count)
        header = message(stamp=stamp_of(1.0 + number / RATE), frame_id="base")
        still = {"position": angles, "velocity": [0.0] * 6}
        node.subscribed["/joint_states"](message(header=header, name=world.names, **still))
        turn(node, number)

    return period


@pytest.mark.parametrize("topic", ["/ball", "/tool"])
def test_a_ros2_bridge_takes_no_message_of_another_frame(
    monkeypatch: pytest.MonkeyPatch, topic: str
) -> None:
    """It brakes, and the program ends with the reason."""
    world, said = World(), []
    watched = Watched()

    def turn(node: Any, number: int) -> None:
        wrong = number == 60
        if topic == "/tool":
            tool = tool_message(world, "base_link" if wrong else "base")
            node.subscribed["/tool"](tool)
        elif wrong:
            header = message(stamp=stamp_of(1.0), frame_id="base_link")
            point = message(x=0.5, y=0.0, z=0.5)
            node.subscribed["/ball"](message(point=point, header=header))

    bridge = ros_bridge(monkeypatch, world, said, resting(world, turn))
    world.data.qpos[:6] -= 0.05
    angles = list(watched.policy.metadata.default_joint_angles)
    tool_topic = "/tool" if topic == "/tool" else None
    node = bridge["Bridge"](world.names, angles, "base", tool_topic)
    session = play(watched.policy, node, 1.0, node, asked_for, {"box": BOX})
    assert session.fault == "stopped" and hasattr(node, "sent")
    assert "has the frame_id 'base_link', not 'base'; transform it" in session.reason
    assert "ball_position" not in node.measurements


def test_a_ros2_bridge_sends_nothing_to_an_arm_with_another_tool(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = World()
    world.data.qpos[:6] -= 0.05
    angles = list(load_policy("robust").metadata.default_joint_angles)
    for off in (0.0, 0.1):

        def turn(node: Any, number: int, off: float = off) -> None:
            tool = tool_message(world)
            tool.pose.position.x += off
            node.subscribed["/tool"](tool)

        bridge = ros_bridge(monkeypatch, world, [], resting(world, turn))
        node = bridge["Bridge"](world.names, angles, "base", "/tool")
        session = play(load_policy("robust"), node, 0.1, node, asked_for, {"box": BOX})
        assert hasattr(node, "sent") == (off == 0.0)
    assert "check that the policy is of this arm" in session.reason


def test_a_start_that_is_refused_is_said_and_waited_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a ball that is not over the paddle, or of none, or of an old picture."""
    world, said = World(), []

    def turn(node: Any, number: int) -> None:
        if number >= 100:
            age = 0.2 if number < 150 else 0.0
            header = message(stamp=stamp_of(1.0 + number / RATE - age), frame_id="base")
            point = message(x=0.6, y=0.6, z=0.4)
            node.subscribed["/ball"](message(point=point, header=header))
        if number in (90, 140, 190):
            node.subscribed["/start"](message())

    bridge = ros_bridge(monkeypatch, world, said, resting(world, turn))
    angles = list(load_policy("robust").metadata.default_joint_angles)
    node = bridge["Bridge"](world.names, angles, "base")
    session = play(load_policy("robust"), node, 0.5, node, asked_for, {"box": BOX})
    assert session.fault is None and not session.episodes
    assert len(said) == 4
    assert "no picture of the ball" in said[1] and "200 ms old" in said[2]
    assert "0.6 m beside" in said[3] and "0.6 m beside" in session.reason
