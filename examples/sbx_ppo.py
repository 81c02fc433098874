"""SBX, Stable-Baselines3 in JAX: PPO on 256 environments in one step.

`python examples/sbx_ppo.py` needs the extra `sbx`.
"""

import argparse

from sbx import PPO

from bounce_mjx import environment
from bounce_mjx.adapters.sb3 import Sb3VecEnv

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--num-envs", type=int, default=256)
parser.add_argument("--steps", type=int, default=8_000_000)
arguments = parser.parse_args()


def learning_rate(progress_remaining: float) -> float:
    """The schedule, in which `progress_remaining` falls from 1 to 0."""
    return 1e-3 * progress_remaining + 1e-5


model = PPO(
    "MlpPolicy",
    Sb3VecEnv(environment(), arguments.num_envs),
    n_steps=32,
    batch_size=8 * arguments.num_envs,
    n_epochs=4,
    gamma=0.98,
    learning_rate=learning_rate,
    verbose=1,
    seed=0,
)
model.learn(arguments.steps, log_interval=20)
