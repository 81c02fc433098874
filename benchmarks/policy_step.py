"""Time of `DeployedPolicy.step` on one thread, in ms.

    python benchmarks/policy_step.py                        # every policy, one run of 1,200 steps
    python benchmarks/policy_step.py robust ur5e --runs 8

For two versions of the package, run it in turns, each from its own checkout: of each, the lowest
median counts. The ball flies up and down above the paddle, and the arm rests.
"""

import argparse
import os
import time

# Before NumPy is imported.
os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

import numpy as np

from bounce_mjx import load_policy
from bounce_mjx.deploy.motion import paddle_position
from bounce_mjx.resources import POLICIES

STEPS = 1200
WARM_UP = 200
"""First steps, whose times do not count."""
GRAVITY = 9.81
"""m/s^2"""
LAUNCH_SPEED = 3.0
"""Of the ball from the paddle, m/s."""


def run(name: str) -> np.ndarray:
    """Times of the steps after the first ones, ms."""
    policy = load_policy(name)
    metadata = policy.metadata
    home = np.array(metadata.default_joint_angles)
    paddle = paddle_position(metadata, home)
    goals = {key: float(np.mean(goal.range)) for key, goal in metadata.goals.items()}
    times = []
    for step in range(STEPS):
        now = step * metadata.control_dt
        flown = now % (2.0 * LAUNCH_SPEED / GRAVITY)
        height = LAUNCH_SPEED * flown - 0.5 * GRAVITY * flown**2
        # The encoders' noise, without which no reading changes.
        angles = home + 1e-5 * np.sin(7.0 * now + np.arange(len(home)))
        ball = paddle + [0.0, 0.0, 0.05 + height]
        velocity = [0.0, 0.0, LAUNCH_SPEED - GRAVITY * flown]
        measured = goals | {
            "joint_angles": angles,
            "joint_velocities": np.zeros(len(home)),
            "ball_position": np.tile(ball, metadata.num_balls),
            "ball_velocity": np.tile(velocity, metadata.num_balls),
        }
        measured = {key: measured[key] for key in policy.needs}
        begin = time.perf_counter()
        policy.step(measured)
        times.append(1e3 * (time.perf_counter() - begin))
    return np.array(times[WARM_UP:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("policies", nargs="*", default=list(POLICIES), help="names")
    parser.add_argument("--runs", type=int, default=1)
    given = parser.parse_args()
    for name in given.policies:
        runs = [run(name) for _ in range(given.runs)]
        lowest = min(np.median(times) for times in runs)
        late = np.median([np.percentile(times, 99.9) for times in runs])
        print(f"{name:12s} median {lowest:.3f} ms, 99.9th percentile {late:.3f} ms", flush=True)


if __name__ == "__main__":
    main()
