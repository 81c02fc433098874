"""rsl_rl's own runner on the environment, with the project's tuned settings; then its exports.

`python examples/rsl_rl_ppo.py` needs the extra `torch`; the ONNX file also needs
`pip install onnx onnxscript`.
"""

from pathlib import Path
from typing import Any

import torch
from rsl_rl.runners import OnPolicyRunner

from bounce_mjx import BounceBall
from bounce_mjx.adapters.torch import TorchVectorEnv
from bounce_mjx.adapters.torch.rsl_rl_ppo import RslRlVecEnv, algorithm_config
from bounce_mjx.learning.config import PPOConfig


def main(folder: Path = Path("rsl_rl_ppo"), iterations: int = 300, **settings: Any) -> torch.Tensor:
    """Trains, exports the policy and acts with the export; the mean reward of its steps [T].

    Args:
      settings: fields of `PPOConfig`.
    """
    config = PPOConfig(**settings)
    env = RslRlVecEnv(
        TorchVectorEnv(BounceBall(), config.num_envs, reward_scale=config.reward_scale)
    )
    train_config = algorithm_config(config) | {"save_interval": 50}
    runner = OnPolicyRunner(env, train_config, log_dir=str(folder), device=str(env.device))
    runner.learn(iterations, init_at_random_ep_len=True)
    runner.export_policy_to_jit(str(folder))
    runner.export_policy_to_onnx(str(folder))

    policy = torch.jit.load(folder / "policy.pt", map_location=env.device)
    observations, _ = env.reset()
    rewards = []
    for _ in range(100):
        observations, reward, *_ = env.step(policy(observations["policy"]))
        rewards.append(reward.mean())
    return torch.stack(rewards)


if __name__ == "__main__":
    print(main().mean())
