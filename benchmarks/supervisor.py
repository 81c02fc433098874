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
from numpy.lib.stride_tricks import sliding_window_view

from bounce_mjx import load_policy
from bounce_mjx.deploy.chain import paddle_pose
from bounce_mjx.deploy.faults import EARLIER, FLYING, faults, make_bounds, picture_age
from bounce_mjx.deploy.metadata import Metadata
from bounce_mjx.env.env import Env, State
from bounce_mjx.evaluation.episodes import reset_episodes
from bounce_mjx.learning.policy import make_networks
from bounce_mjx.resources import POLICIES, resource_path
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.runs.folders import find_checkpoint
from bounce_mjx.runs.reading import read_policy
from bounce_mjx.training.setup import set_up_jax
from bounce_mjx.world import sensing

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
            angles, velocities = sensing.measured_joints(now.world, now.clock.counter, truth)
            ball, age = now.sensing.picture.position, now.sensing.picture.age
        _, actuation = env.control(now, action)
        if actuation.setpoint is not None:
            command = actuation.setpoint.position
        else:
            command = env.servo_targets(now.physics, action)[: env.action_size]
        return {
            "angles": angles,
            "velocities": velocities,
            "commands": command,
            "ball": ball.reshape(-1, 3),
            "age": age,
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


def windows(values: np.ndarray, steps: int) -> np.ndarray:
    """The last values [T, steps, J] of each step; before the first one, the arm rested."""
    padded = np.concatenate([np.repeat(values[:1], steps - 1, axis=0), values])
    return np.moveaxis(sliding_window_view(padded, steps, axis=0), -1, 1)


def facts(metadata: Metadata, episode: dict[str, np.ndarray], window: int) -> dict[str, Any]:
    """The facts of each step [T] for the rules, as the supervisor finds them."""
    angles, ball, age = episode["angles"], episode["ball"], episode["age"]
    sent = np.concatenate([angles[:1], episode["commands"][:-1]])
    paddle, _ = paddle_pose(metadata, angles)
    times = np.arange(len(angles)) * metadata.control_dt
    is_new = np.append(True, np.any(ball[1:] != ball[:-1], axis=(1, 2)))
    newest = np.maximum.accumulate(np.where(is_new, np.arange(len(angles)), 0))
    taken = (times - age)[newest]
    numbers, pictures = np.cumsum(is_new) - 1, np.append(np.flatnonzero(is_new), -1)
    before, earlier = (pictures[np.maximum(numbers - k, -1)] for k in (1, EARLIER))
    flies = np.max(ball[..., 2], axis=1) > paddle[:, 2] + FLYING
    balls = [np.where(i[:, None, None] < 0, np.nan, ball[i]) for i in (before, earlier)]
    between = np.maximum(taken - taken[before], metadata.control_dt)
    return {
        "angles": windows(angles, window + 1),
        "commands": windows(sent, window + 1),
        "velocities": episode["velocities"],
        "paddle": paddle,
        "ball": ball,
        "ball_motion": (ball - balls[0]) / between[:, None, None],
        "earlier_ball": balls[1],
        "age": np.where(flies, np.maximum(age, times - taken), age),
    }


def first(found: list, step: int = 0) -> tuple[int, str]:
    """The first step from one on that breaks a rule, and the rule's code."""
    steps = [
        (step + int(np.argmax(wrong[step:])), rule.fault)
        for rule, wrong, _ in found
        if np.any(wrong[step:])
    ]
    return min(steps, key=lambda s: s[0], default=(len(found[0][1]), "none"))


def delays(
    metadata: Metadata,
    bounds: dict[str, Any],
    episode: dict[str, np.ndarray],
    rng: np.random.Generator,
) -> dict[str, float]:
    """Times from a fault until a rule is broken, s; infinite where none is in 2 s."""
    length = int(np.sum(episode["running"]))
    if length < 200:
        return {}
    step, found = int(rng.integers(50, length - 100)), {}
    episode = {key: value[step - 50 : min(step + 200, length)] for key, value in episode.items()}
    step, length = 50, len(episode["age"])
    repeated = {
        f"the angle of joint {j + 1}": ("angles", j) for j in range(len(metadata.joint_names))
    }
    for name, (kind, entry) in ({"a picture": ("ball", ...)} | repeated).items():
        changed = {key: value.copy() for key, value in episode.items()}
        changed[kind][step:, entry] = changed[kind][step, entry]
        at, _ = first(faults(bounds, facts(metadata, changed, bounds["angles"].window)), step)
        found[name] = (at - step) * metadata.control_dt if at < length else np.inf
    return found


def judge(name: str, given: argparse.Namespace, rng: np.random.Generator) -> None:
    """Prints the first alarms of a policy's episodes, and the times from faults."""
    metadata = load_policy(name).metadata
    bounds = make_bounds(metadata, picture_age(metadata), 2.0, None)
    run = recorder(name, min(_BATCH, given.episodes), given.latencies)
    alarms, late, lasted = Counter(), {}, 0
    for batch in range(-(-given.episodes // _BATCH)):
        rows = jax.tree.map(np.asarray, run(jax.random.key(1000 * given.seed + batch)))
        for n in range(len(rows["age"])):
            episode = {key: value[n] for key, value in rows.items()}
            length = int(np.sum(episode["running"]))
            lasted += length == len(episode["running"])
            step, fault = first(faults(bounds, facts(metadata, episode, bounds["angles"].window)))
            alarms[fault if step < length else "none"] += 1
            for kind, delay in delays(metadata, bounds, episode, rng).items():
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
