"""A policy on the topics of ROS 2, with the controller forward_position_controller of ros2_control.

`python examples/ros2_bridge.py POLICY [JOINT ...]` subscribes to /joint_states and /ball
(PointStamped, in the frame of the base), and publishes /forward_position_controller/commands at
500 Hz. The joints are the driver's names in the order of the controller, if they differ from the
policy's.
Publish a message on /start for each episode, also after a fault; if the arm was moved with its
servos off, start the program again. Read "Safety steps" in
docs/real-robot.md first.
"""

import sys

import rclpy
from geometry_msgs.msg import PointStamped
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import JointState
from std_msgs.msg import Empty, Float64MultiArray

from bounce_mjx import load_policy

RATE = 500.0
"""Commands a second, Hz."""
NEWEST_ONLY = 1
"""Depth of the queues of the topics: an old message is worth nothing."""


class Bridge(Node):
    """Takes the newest messages once each control step, and publishes one command in each tick."""

    def __init__(self, policy, target_height: float = 0.7):
        """Subscribes to the topics; `rclpy.spin` runs it.

        Args:
          policy: the result of `load_policy`.
          target_height: m.
        """
        super().__init__("bounce_mjx")
        self.joint_names = policy.metadata.joint_names
        # The arm rests, and the first command is where it is measured.
        policy.reset()
        self.arm = policy.supervise(RATE)
        self.measurements = {"target_height": target_height}
        self.picture_stamp = None
        """When the newest picture of the ball was taken."""
        self.commands = []
        """What is still to be published in this control step, each [J], rad."""
        self.create_subscription(JointState, "/joint_states", self.on_joints, NEWEST_ONLY)
        self.create_subscription(PointStamped, "/ball", self.on_ball, NEWEST_ONLY)
        self.create_subscription(Empty, "/start", self.on_start, NEWEST_ONLY)
        self.publisher = self.create_publisher(
            Float64MultiArray, "/forward_position_controller/commands", NEWEST_ONLY
        )
        self.create_timer(1.0 / RATE, self.tick)

    def on_joints(self, message: JointState) -> None:
        """Takes the arm's angles; a message of other joints, such as a gripper's, has none."""
        if not set(self.joint_names) <= set(message.name):
            return
        places = [message.name.index(name) for name in self.joint_names]
        self.measurements["joint_angles"] = [message.position[place] for place in places]
        if len(message.velocity) == len(message.name):
            self.measurements["joint_velocities"] = [message.velocity[place] for place in places]
        else:
            # A driver without velocities sends none, and the supervisor brakes.
            self.measurements["joint_velocities"] = []

    def on_ball(self, message: PointStamped) -> None:
        point = message.point
        self.measurements["ball_position"] = [point.x, point.y, point.z]
        self.picture_stamp = message.header.stamp

    def on_start(self, message: Empty) -> None:
        """Starts an episode where the arm is ready, and sends it home where it has stopped."""
        if self.arm.state == "stopped":
            self.get_logger().info(f"stopped as {self.arm.reason}; going home")
            self.arm.restart()
        elif self.arm.state == "ready":
            self.arm.start()

    def tick(self) -> None:
        """Publishes the next command; after the last one, a new control step begins."""
        if "joint_angles" not in self.measurements:
            return
        if not self.commands:
            self.commands = list(self.arm.commands(self.timed_measurements()))
        if not self.commands:
            # The first sample is not believed yet, and nothing is sent.
            return
        command = self.commands.pop(0)
        self.publisher.publish(Float64MultiArray(data=command.tolist()))

    def timed_measurements(self) -> dict:
        """The newest measurements, with the time now and the age of the ball's picture, s."""
        now = self.get_clock().now()
        measurements = self.measurements | {"time": now.nanoseconds * 1e-9}
        if self.picture_stamp is not None:
            ball_age = now - Time.from_msg(self.picture_stamp)
            measurements["ball_age"] = ball_age.nanoseconds * 1e-9
        return measurements


def main() -> None:
    policy_name = sys.argv[1]
    joint_names = sys.argv[2:]
    rclpy.init()
    rclpy.spin(Bridge(load_policy(policy_name, joint_names=joint_names or None)))


if __name__ == "__main__":
    main()
