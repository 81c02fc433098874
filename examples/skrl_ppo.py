"""skrl: its PPO on 256 environments in one step.

`python examples/skrl_ppo.py` needs the extra `torch`.
"""

import argparse

import gymnasium
import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.trainers.torch import SequentialTrainer

import bounce_mjx  # noqa: F401  registers the environment

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--num-envs", type=int, default=256)
parser.add_argument("--steps", type=int, default=20_000, help="steps of each environment")
arguments = parser.parse_args()

env = wrap_env(
    gymnasium.make_vec("bounce_mjx/BounceBall-v0", arguments.num_envs, autoreset_mode="SameStep")
)
spaces = {"observation_space": env.observation_space, "action_space": env.action_space}


class Actor(GaussianMixin, Model):
    def __init__(self):
        Model.__init__(self, **spaces, device=env.device)
        GaussianMixin.__init__(self)
        self.net = torch.nn.Sequential(
            torch.nn.Linear(29, 128), torch.nn.ELU(), torch.nn.Linear(128, 6)
        )
        self.log_std = torch.nn.Parameter(torch.full((6,), -1.0))

    def compute(self, inputs, role=""):
        return self.net(inputs["observations"]), {"log_std": self.log_std}


class Critic(DeterministicMixin, Model):
    def __init__(self):
        Model.__init__(self, **spaces, device=env.device)
        DeterministicMixin.__init__(self)
        self.net = torch.nn.Sequential(
            torch.nn.Linear(29, 128), torch.nn.ELU(), torch.nn.Linear(128, 1)
        )

    def compute(self, inputs, role=""):
        return self.net(inputs["observations"]), {}


settings = PPO_CFG(rollouts=32, learning_epochs=4, mini_batches=4, discount_factor=0.98)
memory = RandomMemory(memory_size=32, num_envs=env.num_envs, device=env.device)
models = {"policy": Actor(), "value": Critic()}
agent = PPO(models=models, memory=memory, cfg=settings, **spaces, device=env.device)
SequentialTrainer(env=env, agents=agent, cfg={"timesteps": arguments.steps}).train()
