"""A policy on the topics of ROS 2, with the controller forward_position_controller of ros2_control.

`python examples/ros2_bridge.py POLICY --rests-at Q ... --box X Y Z X2 Y2 Z2 [--joints NAME ...]`
subscribes to /joint_states and /ball (PointStamped, in the frame of the base), and publishes
/forward_position_controller/commands at 500 Hz. The joints are the driver's names in the order of
the controller, if they differ from the policy's.

This controller publishes no target, so that the operator says where the arm rests: the angles (rad)
on the robot's own panel, and not those of /joint_states, which this program could read wrongly.
Publish a message on /start for each episode, also after a fault; if the arm was moved with its
servos off, start the program again. Read "Safety steps" in docs/real-robot.md first.
"""

import argparse

import numpy as np
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

    def __init__(self, policy, rests_at: list[float], box: dict, target_height: float = 0.7):
        """Subscribes to the topics; `rclpy.spin` runs it.

        Args:
          policy: the result of `load_policy`.
          rests_at: joint angles [J] at which the operator says that the arm rests, rad.
          box: the `box` of `DeployedPolicy.supervise`, m; empty for none.
          target_height: m.
        """
        super().__init__("bounce_mjx")
        self.joint_names = policy.metadata.joint_names
        policy.reset(np.array(rests_at))
        self.arm = policy.supervise(RATE, **box)
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
    box = parser.add_mutually_exclusive_group(required=True)
    box.add_argument(
        "--box",
        type=float,
        nargs=6,
        metavar=("X", "Y", "Z", "X2", "Y2", "Z2"),
        help="the lowest and the highest x, y and z that the paddle may reach, m",
    )
    box.add_argument("--no-box", action="store_true", help="let the paddle go anywhere")
    return parser.parse_args(words)


def main() -> None:
    arguments = parse_arguments()
    box = {} if arguments.no_box else {"box": (arguments.box[:3], arguments.box[3:])}
    policy = load_policy(arguments.policy, joint_names=arguments.joints)
    rclpy.init()
    rclpy.spin(Bridge(policy, arguments.rests_at, box))


if __name__ == "__main__":
    main()
