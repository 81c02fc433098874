"""Shipped policies that see the ball in rendered pictures of two cameras alone.

    pip install -e '.[deploy,vision]'
    MUJOCO_GL=egl python benchmarks/cameras.py robust --episodes 64 --jobs 16
    MUJOCO_GL=egl python benchmarks/cameras.py robust_small --episodes 16 --jobs 16
    MUJOCO_GL=egl python benchmarks/cameras.py robust --rate 60 --episodes 16 --jobs 16

In each episode the arm calibrates the cameras anew from 20 poses (`bounce_mjx.vision.rendering`:
distortion, motion blur, noise). MuJoCo's C engine moves the arm and the ball, the rules of the
supervisor watch, and the environment's own functions measure the results over the task's time
limit. The tracker's error is told apart where the ball is 6 cm above the paddle and more, which
hides no part of it there: in free flight, and for the 0.1 s in which a hand holds it first. Only
policies of the project's own arm play here.
"""

import argparse
import concurrent.futures
import functools
import multiprocessing
import time
from typing import NamedTuple

import jax
import mujoco
import numpy as np
from simulators import Episode, World, judge_step, nominal_env, own_engine

from bounce_mjx import load_policy
from bounce_mjx.deploy.motion import paddle_position
from bounce_mjx.deploy.policy import DeployedPolicy
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.episodes import reset_episodes
from bounce_mjx.evaluation.results import Report, judge
from bounce_mjx.evaluation.statistics import empty_statistics
from bounce_mjx.resources import resource_path
from bounce_mjx.vision.rendering import make_model
from bounce_mjx.vision.simulated import SeenBall, seen_ball

HELD = 0.1
"""Time for which a hand holds the ball before the cameras, s."""
LOST = -0.3
"""Height of the ball at which an episode is over, m."""
FREE_FLIGHT = 0.06
"""Height of the ball over the paddle's centre from which on the paddle hides no part of it, m."""
FAR = 0.020
"""Error of a place that is called wrong, m."""


class Settings(NamedTuple):
    """What the cameras see."""

    rate: float
    """Pictures in a second, Hz."""
    ball: str
    """Colour of the ball."""
    side_light: bool
    """Whether the light comes from one side."""
    quick: bool
    """Whether the pictures have no shadows."""


class Start(NamedTuple):
    """An episode after its reset."""

    qpos: np.ndarray
    """[nq]"""
    qvel: np.ndarray
    """[nv]"""
    goal: dict[str, float]


class Played(NamedTuple):
    """An episode until its ball is lost, or until the time limit."""

    qpos: np.ndarray
    """After the reset and after each control step [T + 1, nq]."""
    qvel: np.ndarray
    """[T + 1, nv]"""
    alarm: str
    """Code of the supervisor's first fault; empty for none."""
    calibration: str
    """How well the arm says that it knows the cameras."""
    num_pairs: int
    """Pairs of pictures."""
    errors: np.ndarray
    """Measured place of each pair in which a ball was found, less the mean true one of its exposure
    [N, 3], m."""
    heights: np.ndarray
    """True height of that ball over the paddle's centre at the end of the exposure [N], m."""
    tracking_times: np.ndarray
    """Processor time of the tracker for each pair [num_pairs], s."""


class SeenEpisode(Episode):
    """An episode whose policy gets the ball from two cameras."""

    def __init__(
        self, policy: DeployedPolicy, env: Env, camera: SeenBall, render_model: mujoco.MjModel
    ):
        simulator = own_engine(env.mj_model)
        self._step_physics = simulator.step
        super().__init__(policy, simulator._replace(step=self._step_and_look), World())
        self._camera = camera
        self._data = mujoco.MjData(render_model)
        joint_names = policy.metadata.joint_names
        self._joints = [render_model.joint(name).qposadr[0] for name in joint_names]
        self._ball = render_model.joint("ball_link").qposadr[0]
        self.heights: list[float] = []
        """True height of the ball over the paddle's centre at each place that was found, m."""

    def reset(self, angles: np.ndarray, positions: np.ndarray, velocities: np.ndarray) -> None:
        """As `Episode.reset`, after a hand has held the ball before the cameras."""
        super().reset(angles, positions, velocities)
        for step in range(round(HELD / self.world.timestep)):
            self._look(step * self.world.timestep)

    def measure(self) -> dict[str, np.ndarray | float]:
        """The joints, and the newest place of the ball that the tracker has told."""
        angles, velocities = self.simulator.joint_state()
        seen = self._camera.measure(self._time)
        return {"joint_angles": angles, "joint_velocities": velocities, "time": self._time, **seen}

    @property
    def _time(self) -> float:
        return HELD + self._steps * self.world.timestep

    def _step_and_look(self) -> None:
        self._step_physics()
        self._look(self._time + self.world.timestep)

    def _look(self, now: float) -> None:
        angles, _ = self.simulator.joint_state()
        ball = self.simulator.ball_state()[0, :3]
        self._data.time = now
        self._data.qpos[self._joints] = angles
        self._data.qpos[self._ball : self._ball + 3] = ball
        if self._camera.look(self._data):
            paddle = paddle_position(self.policy.metadata, angles)
            self.heights.append(float(ball[2] - paddle[2]))


def play(name: str, settings: Settings, start: Start, seed: int) -> Played:
    """Plays one episode with cameras that the arm has just calibrated."""
    policy = load_policy(name)
    env = nominal_env(name)
    mjcf = str(resource_path("mjcf/bounce_ball.xml"))
    render_model = make_model(mjcf, settings.ball, settings.side_light, settings.quick)
    try:
        camera = seen_ball(render_model, policy.metadata, settings.ball, settings.rate, seed)
    except UserError as refusal:
        raise UserError(f"with the cameras of seed {seed}, {refusal}") from refusal
    episode = SeenEpisode(policy, env, camera, render_model)
    arm_qpos = list(env.addresses.arm_qpos)
    arm_qvel = list(env.addresses.arm_qvel)
    ball_qpos = list(env.addresses.balls[0].qpos[:3])
    ball_qvel = list(env.addresses.balls[0].qvel[:3])
    qpos = start.qpos.copy()
    qvel = start.qvel.copy()
    episode.reset(qpos[arm_qpos], qpos[ball_qpos][None], qvel[ball_qvel][None])
    qpos_path = [qpos.copy()]
    qvel_path = [qvel.copy()]
    num_steps = env.config.episode_steps
    is_seen = len(camera.errors) > 0
    if not is_seen:
        # A supervised arm does not begin. Here the hand opens, and the ball falls.
        qpos[ball_qpos[2]] = LOST - 0.1
        qpos_path.append(qpos.copy())
        qvel_path.append(qvel.copy())
        num_steps = 0
    for _ in range(num_steps):
        episode.control_step(start.goal)
        qpos[arm_qpos], qvel[arm_qvel] = episode.simulator.joint_state()
        qpos[ball_qpos], qvel[ball_qvel] = np.split(episode.balls[0, :6], 2)
        qpos_path.append(qpos.copy())
        qvel_path.append(qvel.copy())
        if qpos[ball_qpos[2]] < LOST:
            break
    camera.close()
    return Played(
        qpos=np.array(qpos_path),
        qvel=np.array(qvel_path),
        alarm=episode.alarm if is_seen else "no ball was seen",
        calibration=camera.calibration.report(),
        num_pairs=camera.num_pairs,
        errors=np.array(camera.errors).reshape(-1, 3),
        heights=np.array(episode.heights),
        tracking_times=np.array(camera.tracking_times),
    )


def judge_episodes(env: Env, states, played: list[Played]) -> Report:
    """The environment's results of episodes that were played elsewhere.

    Args:
      states: of the environment after the episodes' reset, batch last.
    """
    statistics = empty_statistics(env, states)
    for step in range(env.config.episode_steps):
        # A lost ball stays where it was last.
        qpos = np.stack([p.qpos[min(step + 1, len(p.qpos) - 1)] for p in played], axis=-1)
        qvel = np.stack([p.qvel[min(step + 1, len(p.qvel) - 1)] for p in played], axis=-1)
        states, statistics = judge_step(env, states, qpos, qvel, statistics, step)
    return judge(env, statistics)


def print_seeing(played: list[Played]) -> None:
    """Prints how well the ball was seen."""
    errors = np.concatenate([p.errors for p in played])
    heights = np.concatenate([p.heights for p in played])
    times = 1e3 * np.concatenate([p.tracking_times for p in played])
    num_pairs = sum(p.num_pairs for p in played)
    missed = num_pairs - len(errors)
    print(f"{num_pairs:,} pairs, {missed} ({100.0 * missed / num_pairs:.2f}%) without a ball")
    if not len(errors):
        return
    in_flight = errors[heights > FREE_FLIGHT]
    x, y, z = 1e3 * np.sqrt(np.mean(in_flight**2, axis=0))
    distances = np.linalg.norm(errors, axis=1)
    print(f"free flight: off by {x:.2f}, {y:.2f}, {z:.2f} mm (x, y, z; root mean square)")
    print(
        f"all: {1e3 * np.sqrt(np.mean(distances**2)):.2f} mm, at most {1e3 * distances.max():.1f} "
        f"mm; {np.count_nonzero(distances > FAR)} farther than {1e3 * FAR:.0f} mm"
    )
    middle, late = np.percentile(times, [50.0, 99.0])
    print(
        f"tracker: {middle:.2f} ms a pair (median), {late:.2f} ms (99th percentile), processor time"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("policy")
    parser.add_argument("--episodes", type=int, default=16)
    parser.add_argument("--rate", type=float, default=120.0, help="pictures in a second")
    parser.add_argument("--ball", choices=["white", "orange"], default="white")
    parser.add_argument("--side-light", action="store_true", help="light from one side")
    parser.add_argument("--quick", action="store_true", help="no shadows")
    parser.add_argument("--seed", type=int, default=1, help="of the starts and of the cameras")
    parser.add_argument("--jobs", type=int, default=1, help="processes at once")
    args = parser.parse_args()
    env = nominal_env(args.policy)
    reset = jax.jit(reset_episodes, static_argnums=(0, 2))
    states = reset(env, jax.random.key(args.seed), args.episodes)
    qpos, qvel = (np.array(x, float) for x in states.pipeline_state.physics[:2])
    goals = jax.tree.map(np.asarray, states.pipeline_state.goal)
    starts = [
        Start(qpos[:, i], qvel[:, i], {name: float(x[..., i]) for name, x in goals.items()})
        for i in range(args.episodes)
    ]
    settings = Settings(args.rate, args.ball, args.side_light, args.quick)
    begun = time.monotonic()
    # A process that renders must not be a fork of one that runs JAX.
    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(args.jobs, spawn) as pool:
        run = functools.partial(play, args.policy, settings)
        camera_seeds = range(1000 * args.seed, 1000 * args.seed + args.episodes)
        played = list(pool.map(run, starts, camera_seeds))
    print(f"played in {time.monotonic() - begun:.0f} s")
    print_seeing(played)
    print(f"first calibration: {played[0].calibration}")
    alarms = [f"episode {i}: {p.alarm}" for i, p in enumerate(played) if p.alarm]
    print(f"{len(alarms)} alarms; {', '.join(alarms) or 'none'}")
    report = judge_episodes(env, states, played)
    for result in report.results:
        print(f"{result.name}: {result.value} ({result.measured}; {result.bound}), {result.passed}")


if __name__ == "__main__":
    main()
