"""Policies in the worlds of hidden robots: what identification buys.

    python benchmarks/identify.py --seeds 0-19 --logs LOGS
    python train_jax.py robust_small --config finetune --world LOGS/0.yaml
    python benchmarks/identified_training.py --seed 0 --policies RUN robust

The first command writes the log and the identified world of each robot of benchmarks/identify.py.
A robot that has a flaw is measured without it.
"""

import argparse
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from identify import hidden_robot, sensor_terms

from bounce_mjx.env.env import Env
from bounce_mjx.evaluation.c_episodes import make_mujoco_evaluator
from bounce_mjx.evaluation.config import DEFAULT_EPISODES, DEFAULT_SEED
from bounce_mjx.evaluation.episodes import make_evaluator
from bounce_mjx.evaluation.results import Report, judge
from bounce_mjx.evaluation.suite import neutral_goals
from bounce_mjx.runs.checkpoints import read_actor
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.runs.folders import choose_checkpoint
from bounce_mjx.training.setup import set_up_jax
from bounce_mjx.world.randomization import RandomizationConfig


def measure(path: Path, seed: int, episodes: int, physics: str) -> Report:
    """The results of a policy in the world of one hidden robot, with the task's default target."""
    checkpoint = choose_checkpoint(path, Path("runs"))
    config = load_run_config(checkpoint.run)
    world = hidden_robot(seed).world | sensor_terms()
    values = {name: np.asarray(value, float).tolist() for name, value in world.items()}
    randomization = RandomizationConfig(**{name: (value, value) for name, value in values.items()})
    env = Env(config.env.model_copy(update={"randomization": randomization}))
    set_up_jax(env.config)
    _, policy, actor = read_actor(checkpoint, config)
    goals = neutral_goals(env.config)
    ranges = env.ranges() | goals
    ranges = jax.tree.map(lambda end: jnp.asarray(end, jnp.float32)[None], ranges)
    make = make_mujoco_evaluator if physics == "mujoco" else make_evaluator
    evaluate = make(env, actor(env), episodes)
    statistics, recording = evaluate(policy, jax.random.PRNGKey(DEFAULT_SEED), ranges)
    return judge(env, statistics, recording, goals)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True, help="the robot")
    parser.add_argument("--policies", type=Path, nargs="+", required=True)
    parser.add_argument("--episodes", type=int, default=DEFAULT_EPISODES)
    parser.add_argument("--physics", choices=("fused", "mujoco"), default="mujoco")
    given = parser.parse_args()
    for path in given.policies:
        report = measure(path, given.seed, given.episodes, given.physics)
        results = {r.name: (r.value, r.passed) for r in report.results}
        print(json.dumps({"seed": given.seed, "policy": str(path)} | results), flush=True)


if __name__ == "__main__":
    main()
