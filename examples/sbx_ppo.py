"""SBX, Stable-Baselines3 in JAX: PPO on 256 environments in one step.

`python examples/sbx_ppo.py` needs the extra `sbx`.
"""

import argparse

from sbx import PPO

from bounce_mjx.adapters.sb3 import Sb3VecEnv

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--num-envs", type=int, default=256)
parser.add_argument("--steps", type=int, default=8_000_000)
arguments = parser.parse_args()

model = PPO(
    "MlpPolicy",
    Sb3VecEnv(arguments.num_envs),
    n_steps=32,
    batch_size=8 * arguments.num_envs,
    n_epochs=4,
    gamma=0.98,
    learning_rate=lambda left: 1e-3 * left + 1e-5,
    verbose=1,
    seed=0,
)
model.learn(arguments.steps, log_interval=20)
