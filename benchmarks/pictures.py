"""False alarms of the supervisor in play on MuJoCo's C engine, with few and noisy pictures and
times that jitter.

    python benchmarks/pictures.py --jobs 16    # every policy, 300 s at 60 and 120 Hz, 5 and 8 mm
    python benchmarks/pictures.py robust --rates 60 --noises 0.008 --seconds 60

Each policy plays as in a rehearsal, in sessions of 20 s, until its episodes have the asked time
together, or three times as much was simulated: a ball that is lost is fetched, and the arm sent
home. A stop is true where the ball was lost, where the simulation had two balls touch in the 0.4 s
before, and where one had stopped to bounce: it hopped less than 5 cm for 0.4 s, or less than 15 cm
for the 2 s in which a ball has to leave the paddle; else it is a false alarm. The arm has no other
errors than those given here and a little noise of its encoders. A policy whose arm's package is
missing is named and left out.
"""

import argparse
import concurrent.futures
import itertools
import multiprocessing
from collections import Counter
from typing import NamedTuple

import mujoco
import numpy as np

from bounce_mjx import load_policy
from bounce_mjx.deploy.environments import environment_config
from bounce_mjx.deploy.session import Episode, play
from bounce_mjx.errors import UserError
from bounce_mjx.rehearsal import faults as inject
from bounce_mjx.rehearsal.arm import SimulatedArm, goals_in_turn
from bounce_mjx.rehearsal.faults import Act, Injection
from bounce_mjx.rehearsal.operator import SimulatedOperator
from bounce_mjx.resources import POLICIES

SESSION = 20.0
"""Length of a session, s."""
MOST = 3.0
"""Time that is simulated at most, as a share of the time that is to be played."""
LOOKED_AT = 0.4
"""Time before a stop in which balls touched, s."""
TOUCHING = 0.041
"""Distance of two balls' centres at which they touch, m."""
HOPPING = ((0.4, 0.0725), (2.0, 0.1725))
"""A ball that stayed below a height above the paddle's centre (m) for a time (s) bounces no more:
it lies 2.25 cm above it, and hops 5 or 15 cm."""
WORLD = {
    "ball_latency": 0.01,
    "ball_velocity_noise": 0.1,
    "joint_angle_noise": 1e-4,
    "joint_velocity_noise": 0.01,
}
"""The other errors of each arm, by the keys of `env.randomization`."""


class Case(NamedTuple):
    """A policy and what it sees."""

    policy: str
    rate: float
    """Of the pictures, Hz."""
    noise: float
    """Standard deviation of the ball's place in a picture along an axis, m."""
    jitter: float
    """Largest error of a sample's time, s."""
    seconds: float
    """To be played, s."""


class Played(NamedTuple):
    """What happened in the sessions of a case."""

    seconds: float
    episodes: int
    stops: Counter[str]
    """True ones by what happened."""
    alarms: Counter[str]
    """False ones by their code."""
    reasons: list[str]
    """Of the first false ones, with their session and time."""


def jitters(size: float) -> Act:
    """Times of the samples that are wrong by up to a size (s)."""
    return inject.put(
        "time", lambda moment: moment.measured["time"] + moment.arm.random.uniform(-size, size)
    )


def what_happened(arm: SimulatedArm, episode: Episode) -> str | None:
    """Why a stop of an episode was true; None of a false alarm."""
    if episode.fault == "ball_lost":
        return "ball lost"
    end = episode.start + episode.seconds
    longest = max(seconds for seconds, _ in HOPPING)
    times = []
    places = []
    for moved in arm.path:
        if end - longest < moved.time <= end:
            arm.data.qpos = moved.qpos
            mujoco.mj_kinematics(arm.model, arm.data)
            times.append(moved.time)
            places.append([arm.data.xpos[ball.body] - arm.paddle for ball in arm.balls])
    ages = end - np.array(times)
    # [T, B, 3], relative to the paddle.
    balls = np.array(places)
    late = balls[ages < LOOKED_AT]
    for first, second in itertools.combinations(np.moveaxis(late, 1, 0), 2):
        if np.linalg.norm(first - second, axis=-1).min() < TOUCHING:
            return "balls touched"
    for seconds, height in HOPPING:
        heights = balls[ages < seconds, :, 2]
        if episode.seconds > seconds and heights.max(axis=0).min() < height:
            return "ball no longer bounced"
    return None


def run(case: Case) -> Played:
    """The sessions of a case."""
    config = environment_config(policy=case.policy)
    policy = load_policy(case.policy)
    world = WORLD | {"camera_rate": case.rate, "ball_position_noise": case.noise}
    injection = Injection(jitters(case.jitter), after=0.0)
    seconds = 0.0
    episodes = 0
    stops: Counter[str] = Counter()
    alarms: Counter[str] = Counter()
    reasons = []
    for session in range(round(MOST * case.seconds / SESSION)):
        arm = SimulatedArm(config, world, seed=session, injection=injection)
        goals = goals_in_turn(config, {})
        played = play(policy, arm, SESSION, SimulatedOperator(arm), goals, {})
        for episode in played.episodes:
            seconds += episode.seconds
            episodes += 1
            if episode.fault is None:
                continue
            cause = what_happened(arm, episode)
            if cause is not None:
                stops[cause] += 1
                continue
            alarms[episode.fault] += 1
            reasons.append(f"session {session}, {episode.start:.2f} s: {episode.reason}")
        if seconds >= case.seconds:
            break
    return Played(seconds, episodes, stops, alarms, reasons[:5])


def report(case: Case, played: Played) -> None:
    """Prints the stops of a case."""
    print(
        f"{case.policy:12s} {case.rate:3.0f} Hz {1e3 * case.noise:2.0f} mm  "
        f"{played.seconds:5.0f} s in {played.episodes:3d} episodes; "
        f"stops: {_counts(played.stops)}; false alarms: {_counts(played.alarms)}",
        flush=True,
    )
    for reason in played.reasons:
        print(f"    {reason}", flush=True)


def _counts(counter: Counter[str]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counter.items()) or "none"


def playable(names: list[str]) -> list[str]:
    """Those policies whose arm is here; names the others."""
    found = []
    for name in names:
        try:
            environment_config(policy=name)
        except UserError as error:
            print(f"{name:12s} left out: {error}", flush=True)
        else:
            found.append(name)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("policies", nargs="*", default=list(POLICIES), help="names")
    parser.add_argument("--rates", type=float, nargs="+", default=[60.0, 120.0], help="Hz")
    parser.add_argument("--noises", type=float, nargs="+", default=[0.005, 0.008], help="m")
    parser.add_argument("--jitter", type=float, default=0.003, help="of the times, s")
    parser.add_argument("--seconds", type=float, default=300.0, help="to be played")
    parser.add_argument("--jobs", type=int, default=1, help="processes at once")
    given = parser.parse_args()
    cases = [
        Case(policy, rate, noise, given.jitter, given.seconds)
        for policy in playable(given.policies)
        for rate in given.rates
        for noise in given.noises
    ]
    # A process that is forked after JAX was imported may hang.
    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(given.jobs, spawn) as pool:
        for case, played in zip(cases, pool.map(run, cases), strict=True):
            report(case, played)


if __name__ == "__main__":
    main()
