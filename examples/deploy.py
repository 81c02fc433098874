"""A policy in the control loop of a simulated robot with a late and noisy camera.

`python examples/deploy.py [POLICY]` needs numpy, onnxruntime and mujoco, but no JAX. With `--log`,
it writes the log from which `bounce-mjx identify` estimates the robot's world. With `--cameras`,
the ball is seen in rendered pictures of two cameras alone (`two_cameras.py`), which the arm has
calibrated before; that needs OpenCV too.
"""

import argparse
import contextlib

import mujoco
import numpy as np

from bounce_mjx import load_policy
from bounce_mjx.deploy.recorder import Recorder
from bounce_mjx.errors import exit_on_user_error
from bounce_mjx.resources import resource_path

MJCF = resource_path("mjcf/bounce_ball.xml")


class Camera:
    """Pictures of the ball: their rate (Hz), noise (m) and delay (s)."""

    def __init__(self, rate: float = 120.0, noise: float = 0.002, delay: float = 0.020):
        self.rate, self.noise, self.delay = rate, noise, delay
        self.random = np.random.default_rng(0)
        self.pictures: list[tuple[float, np.ndarray]] = []

    def look(self, data: mujoco.MjData) -> None:
        """Takes a picture of the ball if one is due."""
        if data.time * self.rate > len(self.pictures) - 1e-6:
            ball = data.joint("ball_link").qpos[:3]
            noise = self.noise * self.random.standard_normal(3)
            self.pictures.append((data.time, ball + noise))

    def measure(self, time: float) -> dict:
        """Newest picture that has arrived, if any, and the velocity from the last two."""
        arrived = [p for p in self.pictures if p[0] < time - self.delay + 1e-6]
        if not arrived:
            return {}
        taken, position = arrived[-1]
        before, last_position = arrived[max(len(arrived) - 2, 0)]
        velocity = (position - last_position) / max(taken - before, 1e-3)
        return {"ball_position": position, "ball_velocity": velocity, "ball_age": time - taken}


def simulate(
    policy,
    camera: Camera,
    seconds: float,
    heights: list[float],
    recorder: Recorder | None = None,
    model: mujoco.MjModel | None = None,
) -> list[tuple[int, float]]:
    """Bounces and length (s) of each episode, each from a new start; a target height lasts 3 s."""
    if model is None:
        model = mujoco.MjModel.from_xml_path(str(MJCF))
    data = mujoco.MjData(model)
    joints = [data.joint(name) for name in policy.metadata.joint_names]
    ball = data.joint("ball_link")
    held = ball.qpos.copy()
    for joint, angle in zip(joints, policy.metadata.default_joint_angles, strict=True):
        joint.qpos = angle
    policy.reset()
    camera.look(data)
    arm = policy.supervise(rate=1.0 / model.opt.timestep, box=((0.2, -0.5, -0.2), (1.0, 0.5, 0.6)))
    episodes, begun, bounces, falling = [], 0.0, 0, False
    while data.time < seconds - 1e-6:
        measured = {
            "joint_angles": [joint.qpos[0] for joint in joints],
            "joint_velocities": [joint.qvel[0] for joint in joints],
            "target_height": heights[int(data.time / 3.0) % len(heights)],
            "time": data.time,
            **camera.measure(data.time),
        }
        commands = arm.commands(measured)
        if recorder is not None:
            recorder.step(measured, commands[-1])
        if arm.state == "ready" and "ball_position" in measured:
            arm.start()
            begun, bounces, falling = data.time, 0, False
        elif arm.state == "stopped":
            episodes.append((bounces, data.time - begun))
            arm.restart()
        for command in commands:
            data.ctrl[:] = command
            mujoco.mj_step(model, data)
            if arm.state != "running" and arm.state != "braking":
                # Somebody holds the ball until the arm is ready.
                ball.qpos[:], ball.qvel[:] = held, 0.0
            bounces += falling and ball.qvel[2] > 0.0
            falling = ball.qvel[2] < 0.0
            camera.look(data)
    return [*episodes, (int(bounces), data.time - begun)] if arm.state == "running" else episodes


if __name__ == "__main__":
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
    args = parser.parse_args()
    with exit_on_user_error(), contextlib.ExitStack() as files:
        robot, recorder = load_policy(args.policy), None
        if args.log:
            joints = robot.metadata.joint_names
            recorder = files.enter_context(Recorder(args.log, joints, {"target_height": "m"}))
        camera, model = Camera(), None
        if args.cameras:
            # Before MuJoCo renders; a second import of it changes nothing.
            import rendered_cameras

            model = rendered_cameras.make_model(str(MJCF), args.ball, args.side_light, args.quick)
            camera = rendered_cameras.seen_ball(model, robot.metadata, args.ball, args.camera_rate)
            print(f"cameras calibrated with the arm: {camera.calibration.report()}")
            print(rendered_cameras.how_high(camera.calibration, robot.metadata), flush=True)
            camera.film = rendered_cameras.Film() if args.film else None
        episodes = simulate(robot, camera, args.seconds, args.target_height, recorder, model)
        for count, lasted in episodes:
            print(f"{count} bounces in {lasted:.1f} s of {args.seconds:g} s")
        if args.cameras:
            print(camera.report())
            if args.film:
                camera.film.save(args.film)
