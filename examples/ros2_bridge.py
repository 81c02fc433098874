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

Publish a message on /start for each episode; where the arm has stopped, one sends it home first. If
the arm was moved with its servos off, start the program again. Read "Safety" in docs/your-arm.md
first.
"""

import argparse

import numpy as np
import rclpy
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import JointState
from std_msgs.msg import Empty, Float64MultiArray, Header

from bounce_mjx import load_policy
from bounce_mjx.deploy.box import add_box, box_of
from bounce_mjx.deploy.faults import picture_age
from bounce_mjx.deploy.session import heed_word

RATE = 500.0
"""Commands a second, Hz."""
NEWEST_ONLY = 1
"""Depth of the queues of the topics: an old message is worth nothing."""


class Bridge(Node):
    """Takes the newest messages once each control step, and publishes one command in each tick."""

    def __init__(
        self,
        policy,
        rests_at: list[float],
        box: dict,
        frame: str,
        tool_topic: str | None = None,
        target_height: float = 0.7,
    ):
        """Subscribes to the topics; `rclpy.spin` runs it.

        Args:
          policy: the result of `load_policy`.
          rests_at: joint angles [J] at which the operator says that the arm rests, rad.
          box: the `box` of `DeployedPolicy.supervise`, m; empty for none.
          frame: the `frame_id` of the policy's frame.
          tool_topic: of the tool's pose by the robot's own kinematics, if it has one.
          target_height: m.
        """
        super().__init__("bounce_mjx")
        self.joint_names = policy.metadata.joint_names
        policy.reset(np.array(rests_at))
        self.arm = policy.supervise(RATE, **box)
        self.frame = frame
        self.measurements = {"target_height": target_height}
        self.awaited = {"joint_angles"}
        """What has to be measured before the first command."""
        self.max_first_ball_age = picture_age(policy.metadata)
        self.joint_stamp = None
        """When the newest joint angles were measured."""
        self.picture_stamp = None
        """When the newest picture of the ball was taken."""
        self.commands = []
        """What is still to be published in this control step, each [J], rad."""
        self.create_subscription(JointState, "/joint_states", self.on_joints, NEWEST_ONLY)
        self.create_subscription(PointStamped, "/ball", self.on_ball, NEWEST_ONLY)
        self.create_subscription(Empty, "/start", self.on_start, NEWEST_ONLY)
        if tool_topic is not None:
            self.awaited |= {"tool_position"}
            self.create_subscription(PoseStamped, tool_topic, self.on_tool, NEWEST_ONLY)
        self.publisher = self.create_publisher(
            Float64MultiArray, "/forward_position_controller/commands", NEWEST_ONLY
        )
        self.create_timer(1.0 / RATE, self.tick)

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
        self.arm.stop(
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

    def on_start(self, message: Empty) -> None:
        """Starts an episode where the arm is ready, and sends it home where it has stopped."""
        if self.arm.state == "stopped":
            self.get_logger().info(f"stopped as {self.arm.reason}; going home")
        ball_age = self.timed_measurements().get("ball_age", np.inf)
        refused = heed_word(self.arm, ball_age, self.max_first_ball_age)
        if refused is not None:
            self.get_logger().info(f"nothing starts: {refused}")

    def tick(self) -> None:
        """Publishes the next command; after the last one, a new control step begins."""
        if not self.awaited <= self.measurements.keys():
            return
        if not self.commands:
            self.commands = list(self.arm.commands(self.timed_measurements()))
        if not self.commands:
            # The first sample is not believed yet, and nothing is sent.
            return
        command = self.commands.pop(0)
        self.publisher.publish(Float64MultiArray(data=command.tolist()))

    def timed_measurements(self) -> dict:
        """The newest measurements, with the time of the joint angles, which stands where none come,
        and the age of the ball's picture by then, s."""
        measurements = dict(self.measurements)
        if self.joint_stamp is None:
            return measurements
        now = Time.from_msg(self.joint_stamp)
        measurements["time"] = now.nanoseconds * 1e-9
        if self.picture_stamp is not None:
            ball_age = now - Time.from_msg(self.picture_stamp)
            measurements["ball_age"] = ball_age.nanoseconds * 1e-9
        return measurements


def parse_arguments(words: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policy", help="name, file or run")
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
    box = box_of(arguments)
    rclpy.init()
    rclpy.spin(Bridge(policy, arguments.rests_at, box, arguments.frame, arguments.tool_pose))


if __name__ == "__main__":
    main()
