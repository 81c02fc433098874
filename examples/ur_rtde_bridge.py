"""A policy on a Universal Robots arm, by ur_rtde (`pip install ur_rtde`), at 500 Hz.

`python examples/ur_rtde_bridge.py ROBOT_IP POLICY` reads the ball from UDP datagrams "x y z age" (m
in the frame of the base, s) on port 5005 of this computer; for a camera on another one, give the
address at which this one is reached (`--listen`). Read "Safety steps" in docs/real-robot.md first.
"""

import argparse
import socket

import numpy as np

from bounce_mjx import load_policy

RATE, LOOKAHEAD, GAIN = 500.0, 0.03, 300
# The order of RTDE's arrays.
JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)


class Camera:
    """The newest datagram of the ball."""

    def __init__(self, port: int = 5005, address: str = "127.0.0.1"):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((address, port))
        self.socket.setblocking(False)
        self.newest: dict = {}
        self.ignored = 0
        """Datagrams that were not four finite numbers."""

    def measure(self, step: float) -> dict:
        """Position and age of the ball; the age grows by a control step until the next datagram."""
        age = self.newest.get("ball_age", np.inf) + step
        self.newest = self.newest | {"ball_age": age}
        while True:
            try:
                datagram = self.socket.recv(256)
            except BlockingIOError:
                return self.newest
            try:
                numbers = np.array(datagram.split(), float)
            except ValueError:
                numbers = np.zeros(0)
            if numbers.shape == (4,) and np.all(np.isfinite(numbers)):
                self.newest = {"ball_position": numbers[:3], "ball_age": float(numbers[3])}
            else:
                self.ignored += 1


def bounce(policy, control, receive, camera, commands: dict, seconds: float) -> list[str]:
    """Bounces for a time, again after each lost ball, until another fault. Returns the reasons."""
    arm, step, reasons = policy.supervise(RATE), policy.metadata.control_dt, []
    for _ in range(round(seconds / step)):
        joints = {"joint_angles": receive.getActualQ(), "joint_velocities": receive.getActualQd()}
        time = {"time": receive.getTimestamp()}
        ball = camera.measure(step)
        targets = arm.commands(joints | ball | commands | time)
        for command in targets:
            period = control.initPeriod()
            control.servoJ(command.tolist(), 0.0, 0.0, 1.0 / RATE, LOOKAHEAD, GAIN)
            control.waitPeriod(period)
        if not len(targets):
            # The arm is where no command was given yet.
            control.waitPeriod(control.initPeriod())
        if arm.state == "ready" and ball.get("ball_age", np.inf) < 0.05:
            arm.start()
        elif arm.state == "stopped":
            reasons.append(arm.reason)
            if arm.fault != "ball_lost":
                break
            arm.restart()
    control.servoStop()
    return reasons


if __name__ == "__main__":
    import rtde_control
    import rtde_receive

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robot", help="address of the robot")
    parser.add_argument("policy", help="name, file or run")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--target-height", type=float, default=0.7, help="m")
    parser.add_argument("--listen", default="127.0.0.1", help="address for the ball's datagrams")
    given = parser.parse_args()
    rtde = rtde_control.RTDEControlInterface(given.robot, RATE)
    state = rtde_receive.RTDEReceiveInterface(given.robot, RATE)
    wished = {"target_height": given.target_height}
    policy, camera = load_policy(given.policy, joint_names=JOINTS), Camera(address=given.listen)
    print(*bounce(policy, rtde, state, camera, wished, given.seconds), sep="\n")
    print(f"{camera.ignored} datagrams were ignored")
