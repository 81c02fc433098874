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

from bounce_mjx import environment
from bounce_mjx.adapters.sb3 import Sb3VecEnv

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--num-envs", type=int, default=256)
parser.add_argument("--steps", type=int, default=8_000_000)
parser.add_argument("--judged-steps", type=int, default=2000)
parser.add_argument("--seed", type=int, default=0)
arguments = parser.parse_args()

GAMMA = 0.98
BALL_X = 6
"""Place of the ball's x in the observation: after the six joint angles."""
START_X = 0.58856
"""Where the ball starts, m."""
SETTLING_STEPS = 200
"""Steps before the ball's x counts: 2 s."""
EVAL_SEED = 1_000_000
"""Of the first judged environment, far from the training's seeds, which count up from --seed: what
the policy has trained on does not judge it."""


def learning_rate(progress_remaining: float) -> float:
    """The schedule, in which `progress_remaining` falls from 1 to 0."""
    return 1e-3 * progress_remaining + 1e-5


# Most failures come in the first second; short episodes have more first seconds to learn from.
train_envs = VecNormalize(
    Sb3VecEnv(environment(), arguments.num_envs, max_episode_steps=400), gamma=GAMMA
)
model = PPO(
    "MlpPolicy",
    train_envs,
    n_steps=32,
    batch_size=8 * arguments.num_envs,
    n_epochs=4,
    gamma=GAMMA,
    learning_rate=learning_rate,
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

# Episodes of full length. An environment whose episode has ended is left out from then on.
eval_envs = gymnasium.make_vec("bounce_mjx/BounceBall-v0", arguments.num_envs)
observation, _ = eval_envs.reset(seed=EVAL_SEED)
is_alive = np.ones(arguments.num_envs, bool)
most_bounces = np.zeros(arguments.num_envs)
is_near_start = []
for step in range(arguments.judged_steps):
    normalized = train_envs.normalize_obs(observation)
    action, _ = model.predict(normalized, deterministic=True)
    observation, _, terminated, _, info = eval_envs.step(action)
    is_alive = is_alive & ~terminated
    # The info is empty where all environments start anew.
    n_bounces = info.get("n_bounces", np.zeros(arguments.num_envs))
    most_bounces = np.maximum(most_bounces, is_alive * n_bounces)
    if step >= SETTLING_STEPS:
        distances = np.abs(observation[is_alive, BALL_X] - START_X)
        is_near_start.append(distances <= 0.05)

bouncing_share = np.mean(most_bounces >= 3)
print(f"1. at least 3 bounces: {bouncing_share:.1%} of the episodes (99% expected)")
if is_near_start:
    near_share = np.concatenate(is_near_start).mean()
    print(f"2. within 5 cm of x: {near_share:.1%} of the steps (95% expected)")
print(f"5. stable: {is_alive.mean():.1%} of the episodes (99% expected)")
