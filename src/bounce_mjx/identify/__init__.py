"""Identification: from a log of a robot to the ranges of the world in which it acts."""

from bounce_mjx.config.settings import StrictModel


class Topics(StrictModel):
    """Topics of a ROS bag."""

    joints: str = "/joint_states"
    """sensor_msgs/JointState with the measured joint angles."""
    targets: str = "/servo_targets"
    """sensor_msgs/JointState with the servo targets, or std_msgs/Float64MultiArray with those of
    all joints in the robot's order."""
    ball: str = "/ball"
    """geometry_msgs/PointStamped or PoseStamped with the ball's position."""
