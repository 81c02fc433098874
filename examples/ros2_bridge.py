"""A policy on the topics of ROS 2, with the controller forward_position_controller of ros2_control.

`python examples/ros2_bridge.py POLICY --rests-at Q ... --frame base --box X Y Z X2 Y2 Z2`
subscribes to /joint_states and /ball (PointStamped), and publishes
/forward_position_controller/commands at 500 Hz. The joints are the driver's names in the order of
the controller (`--joints`), if they differ from the policy's. `--frame` is the name of the policy's
frame, of a Universal Robot `base`: its `base_link` is turned by half a turn. A message of another
frame stops the arm.

This controller publishes no target, so that the operator says where the arm rests: the angles (rad)
on the robot's own panel, and not those of /joint_states, which this program could read wrongly. A
driver that publishes the tool's pose by the robot's own kinematics, such as that of Universal
Robots (`--tool-pose /tcp_pose_broadcaster/pose`, PoseStamped, the tool centre point as in
ur_rtde_bridge.py), also tells whether it is the policy's arm. A pose of TF does not: it comes from
/joint_states and a file.

Publish a message on /start for each episode; after a lost ball, one sends the arm home first.
After another fault the program ends; start it again, as where the arm was moved with its servos
off. The program is `bounce_mjx.deploy.session.play`, as in a rehearsal; here is its driver alone.
Read "Safety" in docs/your-arm.md first.
"""

import argparse
import math

import numpy as np
import rclpy
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import JointState
from std_msgs.msg import Empty, Float64MultiArray, Header

from bounce_mjx import load_policy
from bounce_mjx.deploy.box import add_box, box_of
from bounce_mjx.deploy.session import play
from bounce_mjx.errors import UserError

RATE = 500.0
"""Commands a second, Hz."""
NEWEST_ONLY = 1
"""Depth of the queues of the topics: an old message is worth nothing."""


class Bridge(Node):
    """A driver (`bounce_mjx.deploy.session.Arm`), and an operator (`session.Operator`) on /start.
    It publishes one command in each tick, and takes messages meanwhile."""

    rate = RATE

    def __init__(
        self,
        joint_names: tuple[str, ...],
        rests_at: list[float],
        frame: str,
        tool_topic: str | None = None,
    ):
        """Subscribes to the topics.

        Args:
          joint_names: in the policy's order [J].
          rests_at: joint angles [J] at which the operator says that the arm rests, rad.
          frame: the `frame_id` of the policy's frame.
          tool_topic: of the tool's pose by the robot's own kinematics, if it has one.
        """
        super().__init__("bounce_mjx")
        self.joint_names = joint_names
        self.rests_at = np.array(rests_at)
        self.frame = frame
        self.measurements: dict = {}
        self.awaited = {"joint_angles"}
        """What has to be measured before the first command."""
        self.refusal: str | None = None
        """Why a message is not of this arm."""
        self.joint_stamp = None
        """When the newest joint angles were measured."""
        self.picture_stamp = None
        """When the newest picture of the ball was taken."""
        self.is_told = False
        """Whether a message on /start has come since the last look."""
        self.has_ticked = False
        """Whether a period has ended since the last command."""
        self.create_subscription(JointState, "/joint_states", self.on_joints, NEWEST_ONLY)
        self.create_subscription(PointStamped, "/ball", self.on_ball, NEWEST_ONLY)
        self.create_subscription(Empty, "/start", self.on_start, NEWEST_ONLY)
        if tool_topic is not None:
            self.awaited |= {"tool_position"}
            self.create_subscription(PoseStamped, tool_topic, self.on_tool, NEWEST_ONLY)
        self.publisher = self.create_publisher(
            Float64MultiArray, "/forward_position_controller/commands", NEWEST_ONLY
        )
        self.create_timer(1.0 / RATE, self.on_tick)
        # Node.executor would keep no reference to it.
        self.messages = SingleThreadedExecutor()
        self.messages.add_node(self)

    def targets(self) -> np.ndarray:
        """As `Arm.targets`."""
        return self.rests_at

    def measure(self) -> dict:
        """As `Arm.measure`: with the time of the joint angles, which stands where none come, and
        the age of the ball's picture by then, s. It waits for the first message of each kind."""
        while self.refusal is None and not self.awaited <= self.measurements.keys():
            self.messages.spin_once()
        if self.refusal is not None:
            raise UserError(self.refusal)
        measurements = dict(self.measurements)
        now = Time.from_msg(self.joint_stamp)
        measurements["time"] = now.nanoseconds * 1e-9
        if self.picture_stamp is not None:
            ball_age = now - Time.from_msg(self.picture_stamp)
            measurements["ball_age"] = ball_age.nanoseconds * 1e-9
        return measurements

    def send(self, commands: np.ndarray) -> None:
        """As `Arm.send`."""
        for command in commands:
            self.publisher.publish(Float64MultiArray(data=command.tolist()))
            self.wait()
        if len(commands) == 0:
            self.wait()

    def wait(self) -> None:
        """Takes messages until the next tick."""
        self.has_ticked = False
        while not self.has_ticked:
            self.messages.spin_once()

    def on_tick(self) -> None:
        """A period has ended."""
        self.has_ticked = True

    def stop(self) -> None:
        """As `Arm.stop`: the controller holds the arm at the last command."""

    def has_word(self, state: str) -> bool:
        """As `Operator.has_word`."""
        was_told = self.is_told
        self.is_told = False
        return was_told

    def hear(self, words: str) -> None:
        """As `Operator.hear`."""
        self.get_logger().info(words)

    def on_start(self, message: Empty) -> None:
        """The operator gives the word."""
        self.is_told = True

    def on_joints(self, message: JointState) -> None:
        """Takes the arm's angles; a message of other joints, such as a gripper's, has none."""
        if not set(self.joint_names) <= set(message.name):
            return
        self.joint_stamp = message.header.stamp
        places = [message.name.index(name) for name in self.joint_names]
        self.measurements["joint_angles"] = [message.position[place] for place in places]
        if len(message.velocity) == len(message.name):
            self.measurements["joint_velocities"] = [message.velocity[place] for place in places]
        else:
            # A driver without velocities sends none, and the supervisor brakes.
            self.measurements["joint_velocities"] = []

    def is_of_frame(self, topic: str, header: Header) -> bool:
        """Whether a message is in the policy's frame; if not, the arm stops."""
        if header.frame_id == self.frame:
            return True
        self.refusal = (
            f"{topic} has the frame_id {header.frame_id!r}, not {self.frame!r}; transform it, or "
            "give the policy's frame with --frame"
        )
        return False

    def on_tool(self, message: PoseStamped) -> None:
        """Takes the tool's pose, of which z is the paddle's upper normal."""
        if not self.is_of_frame("the tool's pose", message.header):
            return
        place = message.pose.position
        turned = message.pose.orientation
        self.measurements["tool_position"] = [place.x, place.y, place.z]
        self.measurements["tool_normal"] = [
            2.0 * (turned.x * turned.z + turned.w * turned.y),
            2.0 * (turned.y * turned.z - turned.w * turned.x),
            1.0 - 2.0 * (turned.x**2 + turned.y**2),
        ]

    def on_ball(self, message: PointStamped) -> None:
        """Takes the newest place of the ball."""
        if not self.is_of_frame("/ball", message.header):
            return
        point = message.point
        self.measurements["ball_position"] = [point.x, point.y, point.z]
        self.picture_stamp = message.header.stamp


def parse_arguments(words: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policy", help="name, file or run")
    parser.add_argument("--seconds", type=float, default=math.inf)
    parser.add_argument("--target-height", type=float, default=0.7, help="m")
    parser.add_argument("--joints", nargs="+", help="the driver's names, in its order")
    parser.add_argument(
        "--rests-at",
        type=float,
        nargs="+",
        required=True,
        metavar="Q",
        help="angles at which the arm rests, by the robot's own panel, rad",
    )
    parser.add_argument("--frame", required=True, help="frame_id of the policy's frame")
    parser.add_argument("--tool-pose", metavar="TOPIC", help="of the robot's own kinematics")
    add_box(parser)
    return parser.parse_args(words)


def main() -> None:
    arguments = parse_arguments()
    policy = load_policy(arguments.policy, joint_names=arguments.joints)
    goals = {"target_height": arguments.target_height}
    rclpy.init()
    bridge = Bridge(
        policy.metadata.joint_names, arguments.rests_at, arguments.frame, arguments.tool_pose
    )
    session = play(
        policy,
        bridge,
        arguments.seconds,
        bridge,
        goals=lambda elapsed: goals,
        box=box_of(arguments),
    )
    bridge.hear(f"the program ended: {session.reason or 'the time is over'}")


if __name__ == "__main__":
    main()
