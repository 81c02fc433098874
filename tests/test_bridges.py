"""The bridges to robots, on stand-ins of their libraries in front of MuJoCo's C engine."""

import argparse
import re
import runpy
import sys
import types
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from bounce_mjx import load_policy
from bounce_mjx.deploy.box import add_box, box_of
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


def check(world: World, reasons: list[str]) -> None:
    """The ball bounces, is thrown away once, and bounces again."""
    assert len(reasons) == 1 and re.search("the ball is lost|has not fallen", reasons[0])
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
        world.ball.qvel[:2], world.before = 3.0, world.bounces


def test_ur_rtde_bridge() -> None:
    world, supervised = World(), []
    boxes = []

    def watched_policy() -> Any:
        policy = load_policy("robust")
        make = policy.supervise

        def supervise(rate: float, **settings: Any) -> Any:
            boxes.append(settings)
            supervised.append(make(rate, **settings))
            return supervised[-1]

        policy.supervise = supervise
        return policy

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
            is_stopped = supervised[-1].state == "stopped"
            if is_stopped and not self.was_stopped and world.before:
                rests.append(0)
            rests_on = is_stopped and rests and np.array_equal(self.sent, world.commands[-1])
            self.was_stopped = is_stopped
            if rests_on:
                rests[-1] += 1
            knocked(world)
            world.tick(self.sent)
            world.watch(supervised[-1])

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
    wished = {"target_height": 0.5}
    asked = []

    def is_told() -> bool:
        """The operator gives the word when the arm has waited for it for half a second."""
        is_ready = supervised[-1].state in ("ready", "stopped")
        asked.append(is_ready)
        return is_ready and all(asked[-50:]) and len(asked) >= 50

    box = {"box": BOX}
    policy = watched_policy()
    reasons = bridge["bounce"](policy, control, receive, camera, wished, SECONDS, box, is_told)
    # It brakes at the end, within the box of time and some more.
    assert control.stopped and 0 <= world.ticks - SECONDS * RATE <= 0.3 * RATE
    assert np.ptp(world.commands[-5:], axis=0).max() < 1e-9
    # No hand is met by an arm that went home after the lost ball before the word.
    assert len(rests) == 2 and rests[0] >= 0.49 * RATE
    assert boxes == [box]
    # After the lost ball the arm was ready, and waited for the word.
    waits = "".join("r" if is_ready else "." for is_ready in asked)
    assert len(re.findall("r{50}", waits)) == 3
    check(world, reasons)
    assert camera.ignored == 5
    # After another fault, no word starts it again.
    receive.broken = True
    policy = watched_policy()
    reasons = bridge["bounce"](policy, control, receive, camera, wished, SECONDS, {}, is_told)
    assert len(reasons) == 1 and "joint_velocities holds nan" in reasons[0]
    assert world.ticks < 2 * SECONDS * RATE
    # A lost connection ends the program, and stops the arm first.
    control.stopped = False

    def lose_connection() -> list[float]:
        raise RuntimeError("connection lost")

    receive.getActualQ = lose_connection
    with pytest.raises(RuntimeError, match="connection lost"):
        bridge["bounce"](policy, control, receive, camera, wished, SECONDS, {}, is_told)
    assert control.stopped


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
    reasons = bridge["bounce"](policy, control, receive, camera, {}, 6.0, {}, lambda: True)
    assert not sent and len(reasons) == 1
    assert "Joint2 is 2 rad from where its commands rest" in reasons[0]


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
    reasons = bridge["bounce"](policy, control, receive, camera, {}, 6.0, {}, lambda: False)
    if robot == "UR5e":
        assert not reasons and sent
        np.testing.assert_allclose(sent[0], start, atol=1e-3)
    else:
        assert not sent
        assert len(reasons) == 1 and "check that the policy is of this arm" in reasons[0]


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


def ros_bridge(monkeypatch: pytest.MonkeyPatch, world: World, said: list[str]) -> dict[str, Any]:
    """The names of the ROS bridge, on stand-ins of the messages and of a node."""

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
            self.timers.append((period, callback))

        def get_clock(self) -> types.SimpleNamespace:
            return message(now=lambda: Time(round(world.time * 1e9)))

        def get_logger(self) -> types.SimpleNamespace:
            return message(info=said.append)

    modules = {
        "rclpy": {},
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
    world, said = World(), []
    bridge = ros_bridge(monkeypatch, world, said)
    rests_at = world.data.ctrl[:6].tolist()
    tool_topic = "/tcp_pose_broadcaster/pose"
    node = bridge["Bridge"](load_policy("robust"), rests_at, {"box": BOX}, "base", tool_topic, 0.5)
    # The operator says where the arm rests, where the paddle may go, and the frame's name.
    rests, box, frame = ["--rests-at", "0", "0"], ["--no-box"], ["--frame", "base"]
    for words in (rests + box, rests + frame, box + frame):
        with pytest.raises(SystemExit):
            bridge["parse_arguments"](["robust", *words])
    assert bridge["parse_arguments"](["robust", *rests, *box, *frame]).frame == "base"
    ((period, tick),) = node.timers
    assert period == 1.0 / RATE
    backwards = world.names[::-1]
    shown = None
    for count in range(round(SECONDS * RATE)):
        if count == 10:
            # Nothing is sent before the tool's pose has come.
            assert not hasattr(node, "sent")
        if count >= 10:
            node.subscribed[tool_topic](tool_message(world))
        state = message(
            header=message(stamp=stamp_of(world.time)),
            name=backwards,
            position=world.data.qpos[:6][::-1].tolist(),
            velocity=world.data.qvel[:6][::-1].tolist(),
        )
        node.subscribed["/joint_states"](state)
        gripper = message(name=["finger"], position=[0.02], velocity=[])
        node.subscribed["/joint_states"](gripper)
        picture = world.picture()
        if picture is not None and picture[0] != shown:
            shown = picture[0]
            point = message(**dict(zip("xyz", picture[1], strict=True)))
            header = message(stamp=stamp_of(shown), frame_id="base")
            node.subscribed["/ball"](message(point=point, header=header))
        if node.arm.state in ("ready", "stopped"):
            node.subscribed["/start"](message())
        tick()
        knocked(world)
        world.tick(getattr(node, "sent", world.data.ctrl))
        world.watch(node.arm)
    said = [words for words in said if words.startswith("stopped")]
    assert len(said) == 1
    check(world, [said[0].removeprefix("stopped as ").removesuffix("; going home")])
    # A message without velocities brakes the arm.
    assert node.arm.state == "running"
    node.subscribed["/joint_states"](message(**vars(state) | {"velocity": []}))
    for _ in range(RATE // 10):
        tick()
    assert node.arm.state == "stopped" and "joint_velocities" in node.arm.reason
    # Angles that come no more are no new ones.
    node.subscribed["/start"](message())
    assert node.arm.state == "homing"
    for _ in range(RATE // 10):
        tick()
    assert (node.arm.state, node.arm.fault) == ("stopped", "time")


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


def test_a_ros2_bridge_takes_no_message_of_another_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    world, said = World(), []
    bridge = ros_bridge(monkeypatch, world, said)
    rests_at = world.data.ctrl[:6].tolist()
    point = message(x=0.5, y=0.0, z=0.5)
    stamp = message(sec=0, nanosec=0)
    node = bridge["Bridge"](load_policy("robust"), rests_at, {"box": BOX}, "base", "/tool")
    node.subscribed["/ball"](message(point=point, header=message(stamp=stamp, frame_id="camera")))
    assert "ball_position" not in node.measurements
    assert node.arm.state != "ready" and "'camera', not 'base'" in node.arm.reason
    node = bridge["Bridge"](load_policy("robust"), rests_at, {"box": BOX}, "base", "/tool")
    node.subscribed["/tool"](tool_message(world, "base_link"))
    assert "tool_position" not in node.measurements
    assert "the tool's pose has the frame_id 'base_link'" in node.arm.reason


def test_a_ros2_bridge_sends_nothing_to_an_arm_with_another_tool(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world, said = World(), []
    bridge = ros_bridge(monkeypatch, world, said)
    rests_at = world.data.ctrl[:6].tolist()
    for off in (0.0, 0.1):
        node = bridge["Bridge"](load_policy("robust"), rests_at, {"box": BOX}, "base", "/tool")
        header = message(stamp=stamp_of(0.0))
        state = message(header=header, name=world.names, position=rests_at, velocity=[0.0] * 6)
        tool = tool_message(world)
        tool.pose.position.x += off
        node.subscribed["/joint_states"](state)
        node.subscribed["/tool"](tool)
        ((_, tick),) = node.timers
        tick()
        assert hasattr(node, "sent") == (off == 0.0)
    assert "check that the policy is of this arm" in node.arm.reason


def test_a_start_that_is_refused_is_said_and_waited_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a ball that is not over the paddle, or of none."""
    world, said = World(), []
    bridge = ros_bridge(monkeypatch, world, said)
    rests_at = load_policy("robust").metadata.default_joint_angles
    node = bridge["Bridge"](load_policy("robust"), list(rests_at), {"box": BOX}, "base")
    ((_, tick),) = node.timers
    for count in range(100):
        header = message(stamp=stamp_of(1.0 + 0.002 * count), frame_id="base")
        still = {"position": list(rests_at), "velocity": [0.0] * 6}
        node.subscribed["/joint_states"](message(header=header, name=world.names, **still))
        if count == 90:
            node.subscribed["/start"](message())
        if count > 90:
            point = message(x=0.6, y=0.6, z=0.4)
            node.subscribed["/ball"](message(point=point, header=header))
        tick()
    assert node.arm.state == "ready"
    node.subscribed["/start"](message())
    assert node.arm.state == "ready"
    assert "no picture of the ball" in said[0] and "0.6 m beside" in said[1]
