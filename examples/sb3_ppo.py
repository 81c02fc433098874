"""Stable-Baselines3: PPO on 256 environments in one step; then three of the five results.

`python examples/sb3_ppo.py` needs the extra `sb3`.
"""

import argparse
import math

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from bounce_mjx.adapters.sb3 import Sb3VecEnv

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--num-envs", type=int, default=256)
parser.add_argument("--steps", type=int, default=8_000_000)
parser.add_argument("--judged-steps", type=int, default=2000)
parser.add_argument("--seed", type=int, default=0)
arguments = parser.parse_args()

# Most failures come in the first second; short episodes have more first seconds to learn from.
envs = VecNormalize(Sb3VecEnv(arguments.num_envs, max_episode_steps=400), gamma=0.98)
model = PPO(
    "MlpPolicy",
    envs,
    n_steps=32,
    batch_size=8 * arguments.num_envs,
    n_epochs=4,
    gamma=0.98,
    learning_rate=lambda left: 1e-3 * left + 1e-5,
    target_kl=0.03,
    max_grad_norm=1.0,
    policy_kwargs={
        "net_arch": [128, 128],
        "activation_fn": torch.nn.ELU,
        "log_std_init": math.log(0.4),
    },
    device="cpu",
    verbose=1,
    seed=arguments.seed,
)
model.learn(arguments.steps, log_interval=20)

judged = gymnasium.make_vec("bounce_mjx/BounceBall-v0", arguments.num_envs)
observation, _ = judged.reset(seed=1)
alive, most, near = np.ones(arguments.num_envs, bool), np.zeros(arguments.num_envs), []
for step in range(arguments.judged_steps):
    action, _ = model.predict(envs.normalize_obs(observation), deterministic=True)
    observation, _, terminated, _, info = judged.step(action)
    alive &= ~terminated
    most = np.maximum(most, alive * info.get("n_bounces", 0.0))
    if step >= 200:
        near.append(np.abs(observation[alive, 6] - 0.58856) <= 0.05)
print(f"1. at least 3 bounces: {np.mean(most >= 3):.1%} of the episodes (99% expected)")
if near:
    print(f"2. within 5 cm of x: {np.concatenate(near).mean():.1%} of the steps (95% expected)")
print(f"5. stable: {alive.mean():.1%} of the episodes (99% expected)")
