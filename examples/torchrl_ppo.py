"""TorchRL: its tutorial's PPO on 256 environments in one step.

`python examples/torchrl_ppo.py` needs the extra `torchrl`.
"""

import argparse

import gymnasium
import torch
from tensordict.nn import TensorDictModule
from tensordict.nn.distributions import NormalParamExtractor
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

name = "bounce_mjx/BounceBall-v0"
env = GymWrapper(gymnasium.make_vec(name, arguments.num_envs, autoreset_mode="Disabled"))


def mlp(outputs: int, *last: torch.nn.Module) -> torch.nn.Module:
    layers = torch.nn.Linear(29, 128), torch.nn.ELU(), torch.nn.Linear(128, outputs)
    return torch.nn.Sequential(*layers, *last)


actor = ProbabilisticActor(
    TensorDictModule(mlp(12, NormalParamExtractor()), ["observation"], ["loc", "scale"]),
    in_keys=["loc", "scale"],
    distribution_class=TanhNormal,
    return_log_prob=True,
)
critic = ValueOperator(mlp(1), in_keys=["observation"])
frames = 32 * arguments.num_envs
collector = Collector(
    env, actor, frames_per_batch=frames, total_frames=max(frames, arguments.steps)
)
advantage = GAE(gamma=0.98, lmbda=0.95, value_network=critic, average_gae=True)
loss_module = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=0.0)
optimizer = torch.optim.Adam(loss_module.parameters(), lr=1e-3)
for number, batch in enumerate(collector):
    batch["next", "reward"] *= 0.1
    for _ in range(4):
        advantage(batch)
        flat = batch.reshape(-1)
        for chosen in torch.randperm(len(flat)).chunk(4):
            losses = loss_module(flat[chosen])
            loss = losses["loss_objective"] + losses["loss_critic"]
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    print(f"batch={number}, reward={10 * batch['next', 'reward'].mean():.3f}")
collector.shutdown()
