"""False alarms of the supervisor's rules over simulated episodes, and the time from a fault until
the arm brakes.

    python benchmarks/supervisor.py robust --episodes 1024 --jobs 16
    python benchmarks/supervisor.py robust --episodes 1024 --latencies 0.06 0.03
    python benchmarks/supervisor.py --episodes 128 --no-faults

The last line is for every policy that comes with the package, each in its own worlds. What a policy
measured in an episode is given to the rules step by step; the first alarm is printed, and it is
false unless the ball is lost (`ball_lost`). The faults: from a random step on, the encoder of one
joint repeats its last angle, or the camera its last picture; the commands and the other readings
stay as they were in the episode.
"""

import argparse
import concurrent.futures
import multiprocessing
from collections import Counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bounce_mjx import load_policy
from bounce_mjx.deploy.faults import Fault, Watch, check_balls, picture_age
from bounce_mjx.deploy.metadata import Metadata
from bounce_mjx.deploy.samples import ImpossibleMeasurement, Samples, Seen
from bounce_mjx.env.env import Env, State
from bounce_mjx.evaluation.episodes import reset_episodes
from bounce_mjx.learning.policy import make_networks
from bounce_mjx.resources import POLICIES, resource_path
from bounce_mjx.runs.checkpoints import read_policy
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.runs.folders import find_checkpoint
from bounce_mjx.training.setup import set_up_jax

_BATCH = 128
"""Episodes that are simulated at once."""
MEASURED = ("joint_angles", "joint_velocities", "ball_position", "ball_age")


def recorder(name: str, episodes: int, latencies: list[float] | None) -> Any:
    """Function: key -> what the robot's computer knows in each step of episodes [N, T, ...]."""
    checkpoint = find_checkpoint(resource_path(POLICIES[name]))
    config = load_run_config(checkpoint.run)
    settings = config.env
    policy = read_policy(checkpoint, config)
    if latencies:
        fixed = {"action_latency": (latencies[0],) * 2, "ball_latency": (latencies[1],) * 2}
        worlds = settings.randomization.model_copy(update=fixed)
        settings = settings.model_copy(update={"randomization": worlds})
    env = Env(settings)
    networks = make_networks(config.ppo, env.observation_size, env.action_size)

    def row(state: State, action: jax.Array) -> dict[str, jax.Array]:
        now = state.pipeline_state
        truth = env.kinematics(now)
        angles = truth.joint_angles
        velocities = truth.joint_velocities
        ball = truth.ball_position
        age = jnp.zeros(())
        if now.sensing is not None:
            angles = now.sensing.histories["joint_angles"][0]
            velocities = now.sensing.histories["joint_velocities"][0]
            ball = now.sensing.picture.position
            age = now.sensing.picture.age
        control, actuation = env.control(now, action)
        if actuation.setpoint is not None:
            command = actuation.setpoint.position
        else:
            command = control.ctrl[: env.action_size]
        # The servo shares the offset of the encoder's zero.
        command = command + now.world.get("encoder_bias", 0.0)
        return {
            "joint_angles": angles,
            "joint_velocities": velocities,
            "commands": command,
            "ball_position": ball,
            "ball_age": age,
        }

    @jax.jit
    def run(key: jax.Array) -> dict[str, jax.Array]:
        def step(carry: tuple, _: None) -> tuple:
            states, running = carry
            actions = jnp.clip(networks.act(policy, states.obs.T).T, -1.0, 1.0)
            seen = jax.vmap(row, in_axes=-1, out_axes=-1)(states, actions)
            states = jax.vmap(env.step, in_axes=-1, out_axes=-1)(states, actions)
            return (states, running & (states.done == 0)), seen | {"running": running}

        start = (reset_episodes(env, key, episodes), jnp.ones(episodes, bool))
        _, rows = jax.lax.scan(step, start, None, length=env.config.episode_steps)
        return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), rows)

    return run


class Found(NamedTuple):
    """What the rules say about one episode."""

    length: int
    """Control steps."""
    at: int
    """Step of the first alarm."""
    alarm: str
    """Code of the first alarm; empty if there is none."""
    bridged: int
    """Samples that were taken as impossible."""
    delays: dict[str, float]
    """Times from injected faults until a rule is broken, s; infinite where none is in 200 steps."""


def first_alarm(
    metadata: Metadata, episode: dict[str, np.ndarray], start: int = 0
) -> tuple[int, str, int]:
    """The first step from one on that breaks a rule, the rule's code, and the number of bridged
    samples until then."""
    samples = Samples(metadata)
    watch = Watch(metadata)
    max_age = picture_age(metadata)
    angles = episode["joint_angles"]
    commands = episode["commands"]
    seen = samples.rest(Seen(), angles[0])
    followed = watch.rest(angles[0], angles[0])
    bridged = 0
    for step in range(len(angles)):
        given = {name: np.ravel(episode[name][step]) for name in MEASURED}
        given["time"] = np.array([step * metadata.control_dt])
        command = commands[step - 1] if step else angles[0]
        try:
            seen, measured, steps = samples.take(seen, given)
            age = max(seen.clock.now - seen.picture.taken, float(measured["ball_age"][0]))
            check_balls(seen.picture.balls, age, max_age, seen.paddle[-1][1])
            followed = watch.follow(
                followed, measured["joint_angles"], command, steps, seen.is_arm_bridged
            )
        except (ImpossibleMeasurement, Fault) as error:
            if step >= start:
                return step, error.fault, bridged
            continue
        bridged += any(np.any(measured[name] != given[name]) for name in MEASURED)
    return len(angles), "", bridged


def delays(
    metadata: Metadata, episode: dict[str, np.ndarray], rng: np.random.Generator
) -> dict[str, float]:
    """Times from a fault until a rule is broken, s; infinite where none is in 200 steps. Empty for
    an episode of less than 400 steps."""
    before = 100
    length = len(episode["ball_age"])
    if length < 400:
        return {}
    step = int(rng.integers(before, length - 200))
    part = {key: value[step - before : step + 200] for key, value in episode.items()}
    repeated: dict[str, tuple[str, int | slice]] = {"a picture": ("ball_position", slice(None))}
    for joint in range(len(metadata.joint_names)):
        repeated[f"the angle of joint {joint + 1}"] = ("joint_angles", joint)
    times = {}
    for name, (quantity, entry) in repeated.items():
        changed = {key: value.copy() for key, value in part.items()}
        changed[quantity][before:, entry] = changed[quantity][before, entry]
        at, fault, _ = first_alarm(metadata, changed, before)
        times[name] = (at - before) * metadata.control_dt if fault else np.inf
    return times


def judge(
    metadata: Metadata, episode: dict[str, np.ndarray], seed: int, has_faults: bool = True
) -> Found:
    """What the rules say about one episode and, if it is to have some, about faults in it."""
    length = int(np.sum(episode["running"]))
    episode = {name: values[:length].astype(float) for name, values in episode.items()}
    at, fault, bridged = first_alarm(metadata, episode)
    late = delays(metadata, episode, np.random.default_rng(seed)) if has_faults else {}
    return Found(length, at, fault, bridged, late)


def report(name: str, found: list[Found], steps: int) -> None:
    """Prints the first alarms of a policy's episodes, and the times from faults."""
    lasted = sum(one.length == steps for one in found)
    alarms = dict(Counter(one.alarm or "none" for one in found))
    bridged = sum(one.bridged for one in found)
    print(
        f"{name}: {lasted} of {len(found)} episodes last; first alarms: {alarms}; "
        f"{bridged} samples bridged",
        flush=True,
    )
    for one in [one for one in found if one.alarm][:10]:
        print(f"  {one.alarm} in step {one.at} of {one.length}", flush=True)
    kinds = {kind for one in found for kind in one.delays}
    for kind in sorted(kinds):
        values = np.array([one.delays[kind] for one in found if one.delays])
        shares = (f"{np.mean(values <= limit):.0%} within {limit} s" for limit in (0.3, 0.5))
        print(f"  {kind} repeats: {np.median(values):.2f} s, {', '.join(shares)}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("policies", nargs="*", default=list(POLICIES), help="names")
    parser.add_argument("--episodes", type=int, default=128, help="rounded up to whole batches")
    parser.add_argument("--latencies", type=float, nargs=2, help="of action and ball, s")
    parser.add_argument("--no-faults", action="store_true", help="count false alarms alone")
    parser.add_argument("--seed", type=int, default=0, help="of the episodes")
    parser.add_argument("--jobs", type=int, default=1, help="processes at once")
    given = parser.parse_args()
    set_up_jax()
    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(given.jobs, spawn) as pool:
        waiting = []
        for name in given.policies:
            batch = min(_BATCH, given.episodes)
            metadata = load_policy(name).metadata
            run = recorder(name, batch, given.latencies)
            found = []
            for number in range(-(-given.episodes // batch)):
                rows = jax.tree.map(np.asarray, run(jax.random.key(1000 * given.seed + number)))
                for n in range(batch):
                    episode = {key: value[n] for key, value in rows.items()}
                    seed = number * batch + n
                    task = pool.submit(judge, metadata, episode, seed, not given.no_faults)
                    found.append(task)
            waiting.append((name, found, rows["running"].shape[1]))
        for name, found, steps in waiting:
            report(name, [one.result() for one in found], steps)


if __name__ == "__main__":
    main()
