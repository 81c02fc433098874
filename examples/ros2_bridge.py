"""A policy on the topics of ROS 2, with the controller forward_position_controller of ros2_control.

`python examples/ros2_bridge.py POLICY [JOINT ...]` subscribes to /joint_states and /ball
(PointStamped, in the frame of the base), and publishes /forward_position_controller/commands at
500 Hz. The joints are the driver's names in the order of the controller, if they differ from the
policy's.
Publish a message on /start for each episode, also after a fault. Read "Safety steps" in
docs/real-robot.md first.
"""

import sys

import rclpy
from geometry_msgs.msg import PointStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Empty, Float64MultiArray

from bounce_mjx import load_policy

RATE = 500.0


class Bridge(Node):
    """Takes the newest messages once each control step, and publishes one command in each tick."""

    def __init__(self, policy, target_height: float = 0.7):
        super().__init__("bounce_mjx")
        self.names, self.arm = policy.metadata.joint_names, policy.supervise(RATE)
        self.measured, self.taken, self.queue = {"target_height": target_height}, None, []
        self.create_subscription(JointState, "/joint_states", self.on_joints, 1)
        self.create_subscription(PointStamped, "/ball", self.on_ball, 1)
        self.create_subscription(Empty, "/start", self.on_start, 1)
        topic = "/forward_position_controller/commands"
        self.publisher = self.create_publisher(Float64MultiArray, topic, 1)
        self.create_timer(1.0 / RATE, self.tick)

    def on_joints(self, message: JointState) -> None:
        """Takes the arm's angles; a message of other joints, such as a gripper's, has none."""
        if not set(self.names) <= set(message.name):
            return
        order = [message.name.index(name) for name in self.names]
        self.measured["joint_angles"] = [message.position[i] for i in order]
        # A driver without velocities sends none, and the supervisor brakes.
        self.measured["joint_velocities"] = [v for i in order for v in message.velocity[i : i + 1]]

    def on_ball(self, message: PointStamped) -> None:
        point, self.taken = message.point, message.header.stamp
        self.measured["ball_position"] = [point.x, point.y, point.z]

    def on_start(self, message: Empty) -> None:
        if self.arm.state == "stopped":
            self.get_logger().info(f"stopped as {self.arm.reason}; going home")
            self.arm.restart()
        elif self.arm.state == "ready":
            self.arm.start()

    def tick(self) -> None:
        if "joint_angles" not in self.measured:
            return
        if not self.queue:
            now = self.get_clock().now()
            measured = self.measured | {"time": now.nanoseconds * 1e-9}
            if self.taken is not None:
                age = now - rclpy.time.Time.from_msg(self.taken)
                measured["ball_age"] = age.nanoseconds * 1e-9
            self.queue = list(self.arm.commands(measured))
        if not self.queue:
            # The first sample is not believed yet, and nothing is sent.
            return
        self.publisher.publish(Float64MultiArray(data=self.queue.pop(0).tolist()))


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(Bridge(load_policy(sys.argv[1], joint_names=sys.argv[2:] or None)))
