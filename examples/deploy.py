"""A policy in the control loop of a simulated robot with a late and noisy camera.

`python examples/deploy.py [POLICY]` needs numpy, onnxruntime and mujoco, but no JAX. With `--log`,
it writes the log from which `bounce-mjx identify` estimates the robot's world. With `--cameras`,
the ball is seen in rendered pictures of two cameras alone (`bounce_mjx.vision`), which the arm has
calibrated before; that needs OpenCV too.
"""

import argparse
import contextlib

import mujoco
import numpy as np

from bounce_mjx import load_policy
from bounce_mjx.deploy.recorder import Recorder
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.resources import resource_path

MJCF = resource_path("mjcf/bounce_ball.xml")
BOX = ((0.2, -0.5, -0.2), (1.0, 0.5, 0.6))
"""The lowest and the highest x, y and z that the paddle may reach, m."""
SECONDS_OF_A_TARGET_HEIGHT = 3.0
# Times are sums of steps, which rounding makes a little too small or too large.
TIME_TOLERANCE = 1e-6
"""s."""


class Camera:
    """Pictures of the ball: their rate (Hz), noise (m) and delay (s)."""

    def __init__(self, rate: float = 120.0, noise: float = 0.002, delay: float = 0.020):
        self.rate = rate
        self.noise = noise
        self.delay = delay
        self.random = np.random.default_rng(0)
        self.pictures: list[tuple[float, np.ndarray]] = []
        """When each was taken, s, and where it shows the ball [3], m."""

    def look(self, data: mujoco.MjData) -> None:
        """Takes a picture of the ball if one is due."""
        due = len(self.pictures) / self.rate
        if data.time > due - TIME_TOLERANCE:
            position = data.joint("ball_link").qpos[:3]
            error = self.noise * self.random.standard_normal(3)
            self.pictures.append((data.time, position + error))

    def measure(self, time: float) -> dict:
        """Newest picture that has arrived, if any, and the velocity from the last two."""
        newest_arrival = time - self.delay + TIME_TOLERANCE
        arrived = [picture for picture in self.pictures if picture[0] < newest_arrival]
        if not arrived:
            return {}
        taken, position = arrived[-1]
        if len(arrived) == 1:
            velocity = np.zeros(3)
        else:
            taken_before, position_before = arrived[-2]
            velocity = (position - position_before) / (taken - taken_before)
        return {"ball_position": position, "ball_velocity": velocity, "ball_age": time - taken}


class BounceCounter:
    """Counts how often the ball turns from falling to rising."""

    def __init__(self):
        self.bounces = 0
        self.is_falling = False

    def watch(self, ball_velocity_z: float) -> None:
        """Looks at the ball once each physics step; its vertical velocity is in m/s."""
        if self.is_falling and ball_velocity_z > 0.0:
            self.bounces += 1
        self.is_falling = ball_velocity_z < 0.0


def simulate(
    policy,
    camera: Camera,
    seconds: float,
    target_heights: list[float],
    recorder: Recorder | None = None,
    model: mujoco.MjModel | None = None,
) -> list[tuple[int, float]]:
    """Bounces for a time, again from the start after each stop.

    Args:
      policy: the result of `load_policy`.
      target_heights: each lasts 3 s, m.
      recorder: of the log, if there is to be one.
      model: of the arm and the ball; None for the one of `MJCF`.

    Returns:
      Bounces and length (s) of each episode; why the arm stopped is printed.
    """
    if model is None:
        model = mujoco.MjModel.from_xml_path(str(MJCF))
    data = mujoco.MjData(model)
    joints = [data.joint(name) for name in policy.metadata.joint_names]
    for joint, angle in zip(joints, policy.metadata.default_joint_angles, strict=True):
        joint.qpos = angle
    data.ctrl[:] = policy.metadata.default_joint_angles
    ball = data.joint("ball_link")
    ball_start = ball.qpos.copy()

    policy.reset()
    rate = 1.0 / model.opt.timestep
    arm = policy.supervise(rate, box=BOX)
    camera.look(data)
    counter = BounceCounter()
    episode_start = None
    episodes = []
    while data.time < seconds - TIME_TOLERANCE:
        target = int(data.time / SECONDS_OF_A_TARGET_HEIGHT) % len(target_heights)
        measurements = {
            "joint_angles": [joint.qpos[0] for joint in joints],
            "joint_velocities": [joint.qvel[0] for joint in joints],
            "target_height": target_heights[target],
            "time": data.time,
            **camera.measure(data.time),
        }
        commands = arm.commands(measurements)
        if len(commands) == 0:
            # The first sample is not believed yet: nothing is sent, and the servos keep theirs.
            commands = np.tile(data.ctrl, (policy.commands_per_step(rate), 1))

        if arm.state == "ready" and "ball_position" in measurements:
            arm.start()
            counter = BounceCounter()
            episode_start = data.time
        elif arm.state == "stopped":
            print(f"stopped at {data.time:.2f} s ({arm.fault}): {arm.reason}", flush=True)
            if episode_start is not None:
                episodes.append((counter.bounces, data.time - episode_start))
            episode_start = None
            arm.restart()

        for command in commands:
            data.ctrl[:] = command
            # The contact has no friction. Of one that has, `mj_step` would compute MuJoCo's own, in
            # place of the package's: `bounce_mjx.physics.CEngine` has that, but needs JAX.
            mujoco.mj_step(model, data)
            if arm.state not in ("running", "braking"):
                # Somebody holds the ball until the arm is ready.
                ball.qpos[:] = ball_start
                ball.qvel[:] = 0.0
            counter.watch(ball.qvel[2])
            camera.look(data)
        if recorder is not None:
            # After the commands, which a full disk must not keep back.
            recorder.step(measurements, commands[-1])
    if episode_start is not None:
        episodes.append((counter.bounces, data.time - episode_start))
    return episodes


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policy", nargs="?", default="robust", help="name, file or run")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--target-height", type=float, nargs="+", default=[0.5], help="m")
    parser.add_argument("--log", help="CSV file for the log, which must not exist")
    parser.add_argument("--cameras", action="store_true", help="see the ball in rendered pictures")
    parser.add_argument("--camera-rate", type=float, default=120.0, help="of --cameras, Hz")
    parser.add_argument("--ball", choices=["white", "orange"], default="white", help="of --cameras")
    parser.add_argument("--film", help="of --cameras: what they see, a .webp or .gif file")
    parser.add_argument("--side-light", action="store_true", help="light --cameras from one side")
    parser.add_argument("--quick", action="store_true", help="render --cameras without shadows")
    return parser.parse_args()


def rendered_camera(policy, arguments: argparse.Namespace):
    """The model with what its two cameras see, and the camera of its rendered pictures."""
    # Here, so that the rest runs without OpenCV.
    from bounce_mjx.vision import rendering, simulated

    model = rendering.make_model(str(MJCF), arguments.ball, arguments.side_light, arguments.quick)
    camera = simulated.seen_ball(model, policy.metadata, arguments.ball, arguments.camera_rate)
    print(f"cameras calibrated with the arm: {camera.calibration.report()}")
    print(simulated.how_high(camera.calibration, policy.metadata), flush=True)
    if arguments.film:
        camera.film = simulated.Film()
    return model, camera


def main() -> None:
    arguments = parse_arguments()
    policy = load_policy(arguments.policy)
    if list(policy.metadata.commands) != ["target_height"] or policy.metadata.num_balls > 1:
        raise UserError(
            f"{arguments.policy} is of another task, and this loop bounces one ball; give a policy "
            "of bouncing, such as robust"
        )
    log = contextlib.nullcontext()
    if arguments.log:
        log = Recorder(arguments.log, policy.metadata.joint_names, commands={"target_height": "m"})
    with log as recorder:
        model = None
        camera = Camera()
        if arguments.cameras:
            model, camera = rendered_camera(policy, arguments)
        episodes = simulate(
            policy, camera, arguments.seconds, arguments.target_height, recorder, model
        )
    for bounces, duration in episodes:
        print(f"{bounces} bounces in {duration:.1f} s of {arguments.seconds:g} s")
    if arguments.cameras:
        print(camera.report())
        if arguments.film:
            camera.film.save(arguments.film)


if __name__ == "__main__":
    with exit_on_user_error():
        main()
