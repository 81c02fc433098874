"""skrl: its own trainer; then a run that `bounce-mjx eval` reads.

`python examples/skrl_ppo.py` needs the extra `torch`.
"""

import argparse
from pathlib import Path

import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.resources.preprocessors.torch import RunningStandardScaler
from skrl.resources.schedulers.torch import KLAdaptiveLR
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed

from bounce_mjx import BounceBall
from bounce_mjx.adapters.torch import TorchVectorEnv
from bounce_mjx.adapters.torch.policy import to_policy, write_run
from bounce_mjx.adapters.torch.skrl_env import SkrlEnv

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--num-envs", type=int, default=4096)
parser.add_argument("--steps", type=int, default=40_000_000, help="of all environments together")
parser.add_argument("--out", type=Path, default=Path("runs/skrl"))
parser.add_argument("--seed", type=int, default=0)
arguments = parser.parse_args()
ROLLOUT = 32

set_seed(arguments.seed)
task = BounceBall()
env = SkrlEnv(TorchVectorEnv(task, arguments.num_envs, seed=arguments.seed, reward_scale=0.1))
spaces = {name: getattr(env, name) for name in ("observation_space", "state_space", "action_space")}


def mlp(inputs: int, outputs: int) -> torch.nn.Sequential:
    """A policy of this project has SiLU between its layers."""
    wide = [torch.nn.Linear(inputs, 128), torch.nn.SiLU(), torch.nn.Linear(128, 128)]
    return torch.nn.Sequential(*wide, torch.nn.SiLU(), torch.nn.Linear(128, outputs))


class Actor(GaussianMixin, Model):
    def __init__(self):
        Model.__init__(self, **spaces, device=env.device)
        GaussianMixin.__init__(self)
        self.net = mlp(self.num_observations, self.num_actions)
        self.log_std = torch.nn.Parameter(torch.full((self.num_actions,), -1.0))

    def compute(self, inputs, role=""):
        return self.net(inputs["observations"]), {"log_std": self.log_std}


class Critic(DeterministicMixin, Model):
    def __init__(self):
        Model.__init__(self, **spaces, device=env.device)
        DeterministicMixin.__init__(self)
        self.net = mlp(self.num_states, 1)

    def compute(self, inputs, role=""):
        return self.net(inputs["states"]), {}


scaler = {"device": env.device, "clip_threshold": 10.0}
settings = PPO_CFG(
    rollouts=ROLLOUT,
    learning_epochs=4,
    mini_batches=16,
    discount_factor=0.98,
    learning_rate=3e-4,
    learning_rate_scheduler=KLAdaptiveLR,
    learning_rate_scheduler_kwargs={"kl_threshold": 0.01},
    observation_preprocessor=RunningStandardScaler,
    observation_preprocessor_kwargs=scaler | {"size": env.observation_space},
    value_clip=0.0,
    state_preprocessor=RunningStandardScaler,
    state_preprocessor_kwargs=scaler | {"size": env.state_space},
    time_limit_bootstrap=True,
    experiment={"directory": str(arguments.out), "experiment_name": "skrl"},
)
memory = RandomMemory(memory_size=ROLLOUT, num_envs=env.num_envs, device=env.device)
models = {"policy": Actor(), "value": Critic()}
agent = PPO(models=models, memory=memory, cfg=settings, **spaces, device=env.device)
timesteps = max(ROLLOUT, arguments.steps // arguments.num_envs)
SequentialTrainer(env=env, agents=agent, cfg={"timesteps": timesteps, "headless": True}).train()

seen = agent.checkpoint_modules["observation_preprocessor"]
std = seen.running_variance.sqrt() + seen.epsilon
policy = to_policy(models["policy"].net, seen.running_mean, std, models["policy"].log_std)
steps = timesteps * arguments.num_envs
print("bounce-mjx eval", write_run(arguments.out, task, policy, steps, arguments.seed))
