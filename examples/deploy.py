"""A policy's program on a simulated arm: with another driver, it is that of a real one.

`python examples/deploy.py [POLICY]` plays against MuJoCo's C engine, with the delays and the noise
in the middle of the policy's training, in the loop `play`, which takes any driver. With `--log`, it
writes the log from which `bounce-mjx identify` estimates the robot's world. With `--cameras`, the
ball is seen in rendered pictures of two cameras alone (`bounce_mjx.vision`), which the arm has
calibrated before; that needs OpenCV too. `bounce-mjx rehearse` does the same in any world, with
faults.
"""

import argparse
import contextlib

import numpy as np

from bounce_mjx import load_policy
from bounce_mjx.deploy.environments import environment_config
from bounce_mjx.deploy.motion import paddle_position
from bounce_mjx.deploy.recorder import Recorder
from bounce_mjx.deploy.session import play
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.rehearsal.arm import SimulatedArm, goals_in_turn, middle
from bounce_mjx.rehearsal.operator import SimulatedOperator
from bounce_mjx.resources import resource_path

MJCF = resource_path("mjcf/bounce_ball.xml")
BOX = 0.5
"""How far the paddle may go from its home to each side, m."""


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policy", nargs="?", default="robust", help="name, file or run")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--target-height", type=float, nargs="+", default=[], help="3 s each, m")
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
    metadata = policy.metadata
    config = environment_config(policy=arguments.policy, world="training")
    if arguments.target_height and "target_height" not in config.goals:
        raise UserError(f"{arguments.policy} has no target height; omit --target-height")
    model = camera = None
    if arguments.cameras:
        if config.mjcf is not None:
            raise UserError(f"--cameras show the project's own arm, not {metadata.robot}; omit it")
        model, camera = rendered_camera(policy, arguments)
    arm = SimulatedArm(config, middle(config), model=model, camera=camera)
    goals = goals_in_turn(config, {"target_height": arguments.target_height})
    home = paddle_position(metadata, np.array(metadata.default_joint_angles))
    log = contextlib.nullcontext()
    if arguments.log:
        units = {name: wanted.unit for name, wanted in metadata.goals.items()}
        log = Recorder(arguments.log, metadata.joint_names, units, metadata.num_balls)
    with log as recorder:
        session = play(
            policy,
            arm,
            arguments.seconds,
            SimulatedOperator(arm),
            goals=goals,
            box={"box": (home - BOX, home + BOX)},
            recorder=recorder,
        )
    for episode in session.episodes:
        bounces = arm.bounces_in(episode.start, episode.seconds)
        print(f"{bounces} bounces in {episode.seconds:.1f} s of {arguments.seconds:g} s")
        if episode.fault is not None:
            print(f"stopped ({episode.fault}): {episode.reason}")
    if not session.episodes:
        print(f"no episode began: {session.reason}")
    if arguments.cameras:
        print(camera.report())
        if arguments.film:
            camera.film.save(arguments.film)


if __name__ == "__main__":
    with exit_on_user_error():
        main()
