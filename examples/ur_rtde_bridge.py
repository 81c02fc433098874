"""A policy on a Universal Robots arm, by ur_rtde (`pip install ur_rtde`), at 500 Hz.

`python examples/ur_rtde_bridge.py ROBOT_IP POLICY --box 0.2 -0.5 -0.2 1.0 0.5 0.6` reads the ball
from UDP datagrams "x y z age" (m in the controller's feature Base, s) on port 5005 of this
computer; for a camera on another one, give the address at which this one is reached (`--listen`).
Each episode starts when Enter is pressed, with the hands away from the arm; after a lost ball the
arm rests until Enter sends it home.

Set the tool centre point on the pendant to the paddle's centre, with its z along the paddle's upper
normal: nothing is sent to an arm whose controller has the paddle elsewhere than the policy, such as
a UR3e under the policy of a UR5e. Read "Safety" in docs/your-arm.md first.
"""

import argparse
import select
import socket
import sys
import time
from collections.abc import Callable

import numpy as np

from bounce_mjx import load_policy
from bounce_mjx.deploy.box import add_box, box_of
from bounce_mjx.deploy.session import BALL_GONE, heed_word

RATE = 500.0
"""Commands a second, Hz."""
LOOKAHEAD_TIME = 0.03
"""Of `servoJ`, s: the least that it accepts, for the least delay."""
GAIN = 300
"""Of `servoJ`, from 100 to 2000."""
MAX_FIRST_BALL_AGE = 0.05
"""An episode starts only with a newer picture of the ball, s."""
OVER = "the time is over"
"""Why the arm stops at the end."""
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
        self.clock = time.monotonic
        self.newest: dict = {}
        """The ball's position [3], m."""
        self.taken = -np.inf
        """When its picture was taken, s of the clock."""
        self.ignored = 0
        """Datagrams that were not four finite numbers."""

    def measure(self) -> dict:
        """Position and age of the ball now; the age is infinite before the first datagram."""
        self.receive()
        return self.newest | {"ball_age": self.clock() - self.taken}

    def receive(self) -> None:
        """Takes what has arrived, once each period of the robot: a datagram that waits is younger
        than its picture."""
        while True:
            try:
                datagram = self.socket.recv(256)
            except BlockingIOError:
                # No more have arrived.
                return
            self.take(datagram)

    def take(self, datagram: bytes) -> None:
        """Believes a datagram of four finite numbers, and counts any other."""
        try:
            numbers = np.array(datagram.split(), float)
        except ValueError:
            self.ignored += 1
            return
        if numbers.shape != (4,) or not np.all(np.isfinite(numbers)):
            self.ignored += 1
            return
        self.newest = {"ball_position": numbers[:3]}
        self.taken = self.clock() - float(numbers[3])


def has_pressed_enter() -> bool:
    """Whether the operator has given the word since the last call."""
    has_line, _, _ = select.select([sys.stdin], [], [], 0.0)
    return bool(has_line and sys.stdin.readline())


def bounce(
    policy,
    rtde_c,
    rtde_r,
    camera,
    goals: dict,
    seconds: float,
    box: dict,
    is_told: Callable[[], bool] = has_pressed_enter,
) -> list[str]:
    """Bounces for a time by the robot's clock, and brakes. After a lost ball the arm rests until
    the operator's word sends it home, and another one starts an episode; another fault ends it.

    Args:
      policy: the result of `load_policy`.
      rtde_c: ur_rtde's `RTDEControlInterface`.
      rtde_r: its `RTDEReceiveInterface`.
      camera: its `measure` returns the ball's part of the measurements, its `receive` takes what
        has arrived.
      goals: such as the target height, m.
      box: the `box` of `DeployedPolicy.supervise`, m; empty for none.
      is_told: whether the operator has given the word to start since it was last asked.

    Returns:
      Why the arm stopped, each time.
    """
    # Where the controller holds the arm, whatever its encoders say.
    policy.reset(np.array(rtde_r.getTargetQ()))
    arm = policy.supervise(RATE, **box)
    reasons = []
    was = arm.state
    until = rtde_r.getTimestamp() + seconds
    # A period begins before reading and computing, so that a control step lasts whole periods.
    t_start = rtde_c.initPeriod()
    try:
        while True:
            ball = camera.measure()
            measurements = {
                "joint_angles": rtde_r.getActualQ(),
                "joint_velocities": rtde_r.getActualQd(),
                "time": rtde_r.getTimestamp(),
                **tool_of(rtde_r.getActualTCPPose()),
                **ball,
                **goals,
            }
            if measurements["time"] >= until:
                arm.stop(OVER, OVER)
            commands = arm.commands(measurements)
            for joint_angles in commands:
                servo(rtde_c, joint_angles)
                rtde_c.waitPeriod(t_start)
                t_start = rtde_c.initPeriod()
                camera.receive()
            if len(commands) == 0:
                # The first sample is not believed yet, and nothing is sent.
                rtde_c.waitPeriod(t_start)
                t_start = rtde_c.initPeriod()
            state = arm.state
            has_changed = state != was
            was = state
            if state == "stopped" and arm.fault == OVER:
                break
            if state == "stopped" and has_changed:
                reasons.append(arm.reason)
                if arm.fault not in BALL_GONE:
                    break
                print(f"stopped as {arm.reason}; press Enter to go home, with no hand near")
            elif state == "ready" and has_changed:
                print("the arm is ready; press Enter to start")
            # A word that comes in another state does not count.
            if is_told() and state in ("ready", "stopped"):
                refused = heed_word(arm, ball["ball_age"], MAX_FIRST_BALL_AGE)
                if refused is not None:
                    print(refused)
    finally:
        # Whatever ends the loop, the arm does not go on toward its last command.
        rtde_c.servoStop()
    return reasons


def tool_of(pose: list[float]) -> dict[str, np.ndarray]:
    """The paddle by the controller's kinematics, as two measurements.

    Args:
      pose: of the tool centre point, m, with its rotation vector, rad [6].
    """
    position, rotation = np.split(np.array(pose), 2)
    angle = np.linalg.norm(rotation)
    axis = rotation / max(angle, 1e-9)
    # Rodrigues' formula for the tool's z.
    upward = np.array([0.0, 0.0, 1.0])
    turned = np.cos(angle) * upward + np.sin(angle) * np.cross(axis, upward)
    normal = turned + (1.0 - np.cos(angle)) * axis[2] * axis
    return {"tool_position": position, "tool_normal": normal}


def servo(rtde_c, joint_angles: np.ndarray) -> None:
    """Sends a command [6], rad, for the next period."""
    # servoJ has these two arguments, and does not use them.
    velocity = 0.0
    acceleration = 0.0
    rtde_c.servoJ(joint_angles.tolist(), velocity, acceleration, 1.0 / RATE, LOOKAHEAD_TIME, GAIN)


def main() -> None:
    # Here, so that the rest can be imported on a computer without ur_rtde.
    from rtde_control import RTDEControlInterface
    from rtde_receive import RTDEReceiveInterface

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robot", help="address of the robot")
    parser.add_argument("policy", help="name, file or run")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--target-height", type=float, default=0.7, help="m")
    parser.add_argument("--listen", default="127.0.0.1", help="address for the ball's datagrams")
    add_box(parser)
    arguments = parser.parse_args()

    rtde_c = RTDEControlInterface(arguments.robot, RATE)
    rtde_r = RTDEReceiveInterface(arguments.robot, RATE)
    policy = load_policy(arguments.policy, joint_names=JOINTS)
    camera = Camera(address=arguments.listen)
    goals = {"target_height": arguments.target_height}
    print("press Enter for each episode, when the ball is over the paddle and no hand is near")
    reasons = bounce(policy, rtde_c, rtde_r, camera, goals, arguments.seconds, box_of(arguments))
    for reason in reasons:
        print(reason)
    print(f"{camera.ignored} datagrams were ignored")


if __name__ == "__main__":
    main()
