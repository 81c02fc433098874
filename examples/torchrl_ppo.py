"""TorchRL: its tutorial's PPO, with its names, on 256 environments in one step.

`python examples/torchrl_ppo.py` needs the extra `torchrl`.
"""

import argparse

import gymnasium
import torch
from tensordict.nn import TensorDictModule
from tensordict.nn.distributions import NormalParamExtractor
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import bounce_mjx.adapters.gymnasium  # noqa: F401  registers the environment

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--num-envs", type=int, default=256)
parser.add_argument("--steps", type=int, default=5_000_000)
arguments = parser.parse_args()

ROLLOUT_STEPS = 32
"""Steps of each environment in a batch."""
GAMMA = 0.98
LMBDA = 0.95
CLIP_EPSILON = 0.2
NUM_EPOCHS = 4
NUM_SUB_BATCHES = 4
LEARNING_RATE = 1e-3
# A reward is up to 12 a step, which would be large for the value network.
REWARD_SCALE = 0.1

# TorchRL's collector resets the environments itself.
envs = gymnasium.make_vec("bounce_mjx/BounceBall-v0", arguments.num_envs, autoreset_mode="Disabled")
(num_observations,) = envs.single_observation_space.shape
(num_actions,) = envs.single_action_space.shape
env = GymWrapper(envs)

# The network's outputs are a mean and a raw standard deviation of each action.
actor_net = nn.Sequential(
    nn.Linear(num_observations, 128),
    nn.ELU(),
    nn.Linear(128, 2 * num_actions),
    NormalParamExtractor(),
)
policy_module = ProbabilisticActor(
    TensorDictModule(actor_net, in_keys=["observation"], out_keys=["loc", "scale"]),
    in_keys=["loc", "scale"],
    distribution_class=TanhNormal,
    return_log_prob=True,
)
value_net = nn.Sequential(nn.Linear(num_observations, 128), nn.ELU(), nn.Linear(128, 1))
value_module = ValueOperator(value_net, in_keys=["observation"])

frames_per_batch = ROLLOUT_STEPS * arguments.num_envs
collector = Collector(
    env,
    policy_module,
    frames_per_batch=frames_per_batch,
    total_frames=max(frames_per_batch, arguments.steps),
)
advantage_module = GAE(gamma=GAMMA, lmbda=LMBDA, value_network=value_module, average_gae=True)
loss_module = ClipPPOLoss(policy_module, value_module, clip_epsilon=CLIP_EPSILON, entropy_coeff=0.0)
optim = torch.optim.Adam(loss_module.parameters(), lr=LEARNING_RATE)

for number, tensordict_data in enumerate(collector):
    mean_reward = tensordict_data["next", "reward"].mean()
    tensordict_data["next", "reward"] *= REWARD_SCALE
    for _ in range(NUM_EPOCHS):
        # Anew in each epoch, because the value network has changed.
        advantage_module(tensordict_data)
        data_view = tensordict_data.reshape(-1)
        for indices in torch.randperm(len(data_view)).chunk(NUM_SUB_BATCHES):
            loss_vals = loss_module(data_view[indices])
            loss_value = loss_vals["loss_objective"] + loss_vals["loss_critic"]
            optim.zero_grad()
            loss_value.backward()
            optim.step()
    print(f"batch={number}, reward={mean_reward:.3f}")
collector.shutdown()
