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
from torch import nn

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

ROLLOUTS = 32
"""Steps of each environment between updates."""
# A reward is up to 12 a step, which would be large for the value network.
REWARD_SCALE = 0.1
CLIP_THRESHOLD = 10.0
"""Standard deviations at which a policy of this project clips its inputs."""

set_seed(arguments.seed)
task = BounceBall()
env = SkrlEnv(
    TorchVectorEnv(task, arguments.num_envs, seed=arguments.seed, reward_scale=REWARD_SCALE)
)


def mlp(num_inputs: int, num_outputs: int) -> nn.Sequential:
    """Linear layers with SiLU between them, as `to_policy` can read them."""
    return nn.Sequential(
        nn.Linear(num_inputs, 128),
        nn.SiLU(),
        nn.Linear(128, 128),
        nn.SiLU(),
        nn.Linear(128, num_outputs),
    )


spaces = {
    "observation_space": env.observation_space,
    "state_space": env.state_space,
    "action_space": env.action_space,
    "device": env.device,
}


class Policy(GaussianMixin, Model):
    """From observations to the mean and the noise of the actions."""

    def __init__(self):
        Model.__init__(self, **spaces)
        GaussianMixin.__init__(self)
        self.net = mlp(self.num_observations, self.num_actions)
        self.log_std_parameter = nn.Parameter(torch.full((self.num_actions,), -1.0))

    def compute(self, inputs, role=""):
        return self.net(inputs["observations"]), {"log_std": self.log_std_parameter}


class Value(DeterministicMixin, Model):
    """From states, the observations with the critic metrics, to values."""

    def __init__(self):
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self.net = mlp(self.num_states, 1)

    def compute(self, inputs, role=""):
        return self.net(inputs["states"]), {}


policy_model = Policy()
value_model = Value()
cfg = PPO_CFG(
    rollouts=ROLLOUTS,
    learning_epochs=4,
    mini_batches=16,
    discount_factor=0.98,
    learning_rate=3e-4,
    learning_rate_scheduler=KLAdaptiveLR,
    learning_rate_scheduler_kwargs={"kl_threshold": 0.01},
    observation_preprocessor=RunningStandardScaler,
    observation_preprocessor_kwargs={
        "size": env.observation_space,
        "clip_threshold": CLIP_THRESHOLD,
        "device": env.device,
    },
    state_preprocessor=RunningStandardScaler,
    state_preprocessor_kwargs={
        "size": env.state_space,
        "clip_threshold": CLIP_THRESHOLD,
        "device": env.device,
    },
    # 0 leaves the change of the values unclipped.
    value_clip=0.0,
    time_limit_bootstrap=True,
    experiment={"directory": str(arguments.out), "experiment_name": "skrl"},
)
agent = PPO(
    models={"policy": policy_model, "value": value_model},
    memory=RandomMemory(memory_size=ROLLOUTS, num_envs=env.num_envs, device=env.device),
    cfg=cfg,
    observation_space=env.observation_space,
    state_space=env.state_space,
    action_space=env.action_space,
    device=env.device,
)
timesteps = max(ROLLOUTS, arguments.steps // arguments.num_envs)
trainer = SequentialTrainer(env=env, agents=agent, cfg={"timesteps": timesteps, "headless": True})
trainer.train()

preprocessor = agent.checkpoint_modules["observation_preprocessor"]
policy = to_policy(
    policy_model.net,
    mean=preprocessor.running_mean,
    # skrl divides by this sum.
    std=preprocessor.running_variance.sqrt() + preprocessor.epsilon,
    log_std=policy_model.log_std_parameter,
)
num_steps = timesteps * arguments.num_envs
run_folder = write_run(arguments.out, task, policy, num_steps, arguments.seed)
print("bounce-mjx eval", run_folder)
