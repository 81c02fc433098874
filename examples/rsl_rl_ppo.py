"""rsl_rl: its own runner trains; then its exports, and a run that `bounce-mjx eval` reads.

`python examples/rsl_rl_ppo.py` needs the extra `torch`.
"""

import argparse
from pathlib import Path

import torch
from rsl_rl.runners import OnPolicyRunner

from bounce_mjx import BounceBall
from bounce_mjx.adapters.torch import TorchVectorEnv
from bounce_mjx.adapters.torch.policy import to_policy, write_run
from bounce_mjx.adapters.torch.rsl_rl_env import RslRlVecEnv

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--num-envs", type=int, default=4096)
parser.add_argument("--steps", type=int, default=40_000_000, help="of all environments together")
parser.add_argument("--out", type=Path, default=Path("runs/rsl_rl"))
parser.add_argument("--seed", type=int, default=0)
arguments = parser.parse_args()

NUM_STEPS_PER_ENV = 32
# A reward is up to 12 a step, which would be large for the value network.
REWARD_SCALE = 0.1

torch.manual_seed(arguments.seed)
task = BounceBall()
env = RslRlVecEnv(
    TorchVectorEnv(task, arguments.num_envs, seed=arguments.seed, reward_scale=REWARD_SCALE)
)

train_cfg = {
    "num_steps_per_env": NUM_STEPS_PER_ENV,
    "save_interval": 50,
    # The critic sees the critic metrics too.
    "obs_groups": {"actor": ["policy"], "critic": ["policy", "critic"]},
    "actor": {
        "class_name": "MLPModel",
        "hidden_dims": [128, 128],
        # rsl_rl's name of SiLU.
        "activation": "swish",
        "obs_normalization": True,
        "distribution_cfg": {
            "class_name": "GaussianDistribution",
            "init_std": 0.4,
            "std_type": "log",
        },
    },
    "critic": {
        "class_name": "MLPModel",
        "hidden_dims": [128, 128],
        "activation": "swish",
        "obs_normalization": True,
    },
    "algorithm": {
        "class_name": "PPO",
        "num_learning_epochs": 4,
        "num_mini_batches": 16,
        "learning_rate": 3e-4,
        "desired_kl": 0.01,
        "gamma": 0.98,
        "entropy_coef": 0.0,
        "use_clipped_value_loss": False,
    },
}
log_dir = arguments.out / "rsl_rl"
runner = OnPolicyRunner(env, train_cfg, log_dir=str(log_dir), device=str(env.device))
num_iterations = max(1, arguments.steps // (NUM_STEPS_PER_ENV * arguments.num_envs))
runner.learn(num_learning_iterations=num_iterations, init_at_random_ep_len=True)
runner.export_policy_to_jit(str(log_dir))
runner.export_policy_to_onnx(str(log_dir))

actor = runner.alg.get_policy()
normalizer = actor.obs_normalizer
policy = to_policy(
    actor.mlp,
    mean=normalizer.mean,
    # rsl_rl divides by this sum.
    std=normalizer.std + normalizer.eps,
    log_std=actor.distribution.log_std_param,
)
num_steps = num_iterations * NUM_STEPS_PER_ENV * arguments.num_envs
run_folder = write_run(arguments.out, task, policy, num_steps, arguments.seed)
print("bounce-mjx eval", run_folder)
