"""A policy on a Universal Robots arm, by ur_rtde (`pip install ur_rtde`), at 500 Hz.

`python examples/ur_rtde_bridge.py ROBOT_IP POLICY --box 0.2 -0.5 -0.2 1.0 0.5 0.6` reads the ball
from UDP datagrams "x y z age" (m in the controller's feature Base, s) on port 5005 of this
computer; for a camera on another one, give the address at which this one is reached (`--listen`).
Each episode starts when Enter is pressed, with the hands away from the arm; after a lost ball the
arm rests until Enter sends it home. The program is `bounce_mjx.deploy.session.play`, as in a
rehearsal; here is its driver alone.

Set the tool centre point on the pendant to the paddle's centre, with its z along the paddle's upper
normal: nothing is sent to an arm whose controller has the paddle elsewhere than the policy, such as
a UR3e under the policy of a UR5e. Read "Safety" in docs/your-arm.md first.
"""

import argparse
import socket
import time

import numpy as np

from bounce_mjx import load_policy
from bounce_mjx.deploy.box import add_box, box_of
from bounce_mjx.deploy.session import Terminal, play

RATE = 500.0
"""Commands a second, Hz."""
LOOKAHEAD_TIME = 0.03
"""Of `servoJ`, s: the least that it accepts, for the least delay."""
GAIN = 300
"""Of `servoJ`, from 100 to 2000."""
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


class UniversalRobot:
    """A driver (`bounce_mjx.deploy.session.Arm`)."""

    rate = RATE

    def __init__(self, rtde_c, rtde_r, camera):
        """The arm of two connections.

        Args:
          rtde_c: ur_rtde's `RTDEControlInterface`.
          rtde_r: its `RTDEReceiveInterface`.
          camera: its `measure` returns the ball's part of the measurements, its `receive` takes
            what has arrived.
        """
        self.rtde_c = rtde_c
        self.rtde_r = rtde_r
        self.camera = camera
        # A period begins before reading and computing, so that a control step lasts whole periods.
        self.period = rtde_c.initPeriod()

    def targets(self) -> np.ndarray:
        """As `Arm.targets`: where the controller holds the arm, whatever its encoders say."""
        return np.array(self.rtde_r.getTargetQ())

    def measure(self) -> dict:
        """As `Arm.measure`."""
        ball = self.camera.measure()
        return {
            "joint_angles": self.rtde_r.getActualQ(),
            "joint_velocities": self.rtde_r.getActualQd(),
            "time": self.rtde_r.getTimestamp(),
            **tool_of(self.rtde_r.getActualTCPPose()),
            **ball,
        }

    def send(self, commands: np.ndarray) -> None:
        """As `Arm.send`."""
        for joint_angles in commands:
            self.servo(joint_angles)
            self.wait()
        if len(commands) == 0:
            self.wait()

    def servo(self, joint_angles: np.ndarray) -> None:
        """Sends a command [6], rad, for the next period."""
        # servoJ has these two arguments, and does not use them.
        velocity = 0.0
        acceleration = 0.0
        self.rtde_c.servoJ(
            joint_angles.tolist(), velocity, acceleration, 1.0 / RATE, LOOKAHEAD_TIME, GAIN
        )

    def wait(self) -> None:
        """Until the next period."""
        self.rtde_c.waitPeriod(self.period)
        self.period = self.rtde_c.initPeriod()
        self.camera.receive()

    def stop(self) -> None:
        """As `Arm.stop`."""
        self.rtde_c.servoStop()


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
    robot = UniversalRobot(rtde_c, rtde_r, camera)
    goals = {"target_height": arguments.target_height}
    print("the word is Enter, when the ball is over the paddle and no hand is near")
    session = play(
        policy,
        robot,
        arguments.seconds,
        Terminal(),
        goals=lambda elapsed: goals,
        box=box_of(arguments),
    )
    for episode in session.episodes:
        print(f"{episode.seconds:.1f} s, then {episode.reason or 'the end of the time'}")
    if session.fault is not None or not session.episodes:
        print(session.reason)
    print(f"{camera.ignored} datagrams were ignored")


if __name__ == "__main__":
    main()
