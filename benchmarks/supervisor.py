"""False alarms of the supervisor's rules over simulated episodes, and the time from a fault until
the arm brakes.

    python benchmarks/supervisor.py robust --episodes 1024
    python benchmarks/supervisor.py robust --episodes 1024 --latencies 0.06 0.03
    python benchmarks/supervisor.py --episodes 128

The last line is for every policy that comes with the package, each in its own worlds. An alarm is
false if it comes before the episode ends, and the ball is not lost. The faults: from a random step
on, the encoder of one joint repeats its last angle, or the camera its last picture.
"""

import argparse
from collections import Counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bounce_mjx import load_policy
from bounce_mjx.deploy.faults import Watch, picture_age
from bounce_mjx.deploy.metadata import Metadata
from bounce_mjx.env.env import Env, State
from bounce_mjx.evaluation.episodes import reset_episodes
from bounce_mjx.learning.policy import make_networks
from bounce_mjx.resources import POLICIES, resource_path
from bounce_mjx.runs.checkpoints import read_policy
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.runs.folders import find_checkpoint
from bounce_mjx.training.setup import set_up_jax

_BATCH = 64


def recorder(name: str, episodes: int, latencies: list[float] | None) -> Any:
    """Function: key -> what the robot's computer knows in each step of episodes [N, T, ...]."""
    checkpoint = find_checkpoint(resource_path(POLICIES[name]))
    config = load_run_config(checkpoint.run)
    settings, policy = config.env, read_policy(checkpoint, config)
    if latencies:
        fixed = {"action_latency": (latencies[0],) * 2, "ball_latency": (latencies[1],) * 2}
        worlds = settings.randomization.model_copy(update=fixed)
        settings = settings.model_copy(update={"randomization": worlds})
    env = Env(settings)
    networks = make_networks(config.ppo, env.observation_size, env.action_size)

    def row(state: State, action: jax.Array) -> dict[str, jax.Array]:
        now = state.pipeline_state
        truth = env.kinematics(now)
        angles, velocities = truth.joint_angles, truth.joint_velocities
        ball, age = truth.ball_position, jnp.zeros(())
        if now.sensing is not None:
            seen = now.sensing.histories
            angles, velocities = seen["joint_angles"][0], seen["joint_velocities"][0]
            ball, age = now.sensing.picture.position, now.sensing.picture.age
        control, actuation = env.control(now, action)
        if actuation.setpoint is not None:
            command = actuation.setpoint.position
        else:
            command = control.ctrl[: env.action_size]
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

        start = reset_episodes(env, key, episodes), jnp.ones(episodes, bool)
        rows = jax.lax.scan(step, start, None, length=env.config.episode_steps)[1]
        return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), rows)

    return run


def first(metadata: Metadata, episode: dict[str, np.ndarray], start: int = 0) -> tuple[int, str]:
    """The first step from one on that breaks a rule, and the rule's code."""
    watch = Watch(metadata, picture_age(metadata), 2.0 * metadata.control_dt)
    angles, commands = episode["joint_angles"], episode["commands"]
    watch.rest(angles[0], angles[0])
    watch.begin()
    for step in range(len(angles)):
        measured = {name: np.ravel(values[step]) for name, values in episode.items()}
        sent = commands[step - 1] if step else angles[0]
        found = list(watch.faults(measured, sent))
        if found and step >= start:
            return step, found[0][0]
    return len(angles), "none"


def delays(
    metadata: Metadata, episode: dict[str, np.ndarray], rng: np.random.Generator
) -> dict[str, float]:
    """Times from a fault until a rule is broken, s; infinite where none is in 2 s."""
    length = int(np.sum(episode["running"]))
    if length < 200:
        return {}
    step, found = int(rng.integers(50, length - 100)), {}
    episode = {key: value[step - 50 : min(step + 200, length)] for key, value in episode.items()}
    step, length = 50, len(episode["ball_age"])
    repeated = {
        f"the angle of joint {j + 1}": ("joint_angles", j) for j in range(len(metadata.joint_names))
    }
    for name, (kind, entry) in ({"a picture": ("ball_position", ...)} | repeated).items():
        changed = {key: value.copy() for key, value in episode.items()}
        changed[kind][step:, entry] = changed[kind][step, entry]
        at, _ = first(metadata, changed, step)
        found[name] = (at - step) * metadata.control_dt if at < length else np.inf
    return found


def judge(name: str, given: argparse.Namespace, rng: np.random.Generator) -> None:
    """Prints the first alarms of a policy's episodes, and the times from faults."""
    metadata = load_policy(name).metadata
    run = recorder(name, min(_BATCH, given.episodes), given.latencies)
    alarms, late, lasted = Counter(), {}, 0
    for batch in range(-(-given.episodes // _BATCH)):
        rows = jax.tree.map(np.asarray, run(jax.random.key(1000 * given.seed + batch)))
        for n in range(len(rows["running"])):
            episode = {key: value[n] for key, value in rows.items()}
            length = int(np.sum(episode["running"]))
            lasted += length == len(episode["running"])
            step, fault = first(metadata, episode)
            alarms[fault if step < length else "none"] += 1
            for kind, delay in delays(metadata, episode, rng).items():
                late.setdefault(kind, []).append(delay)
    print(f"{name}: {lasted} episodes last; first alarms: {dict(alarms)}", flush=True)
    for kind, values in late.items():
        share = np.mean(np.array(values) <= 0.5)
        print(f"  {kind} repeats: {np.median(values):.2f} s, {share:.0%} within 0.5 s", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("policies", nargs="*", default=list(POLICIES), help="names")
    parser.add_argument("--episodes", type=int, default=128)
    parser.add_argument("--latencies", type=float, nargs=2, help="of action and ball, s")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    set_up_jax()
    rng = np.random.default_rng(given.seed)
    for name in given.policies:
        judge(name, given, rng)


if __name__ == "__main__":
    main()
