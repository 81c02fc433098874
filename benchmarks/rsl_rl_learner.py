"""rsl_rl's PPO for `jax_vs_torch.py`, with this project's hyperparameters, networks and
normalisation.

| PPOConfig                            | rsl_rl                                                  |
|--------------------------------------|---------------------------------------------------------|
| settings not listed below            | the same                                                |
| compute_dtype                        | float32 (configs/default.yaml: bfloat16)                |
| mean_noise_bound                     | none (configs/default.yaml: 0.1)                        |
| learning_rate                        | the same start; steered by a factor of 1.5 (here 1.1)   |
| min_learning_rate, max_learning_rate | 1e-5 and 1e-2: fixed in rsl_rl                          |
| final_max_learning_rate, decay_steps | none                                                    |
| max_grad_norm                        | for the actor and the critic separately (here together) |
| KL                                   | exact for two Gaussians (here Schulman's estimate)      |
| optimizer                            | Adam's epsilon is 1e-8 (here 1e-5)                      |
| minibatches                          | shuffled once per iteration (here once per epoch)       |
| statistics                           | updated after the update (here before)                  |
| value at a time-out                  | of the state before it (here of the last state)         |
| training_episode_seconds             | not used by any trainer here, but env.episode_seconds   |
| activation                           | SiLU; others are refused                                |
| critic_layers, shared_critic         | the policy's hidden_layers, none; others are refused    |
"""

from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from torch_networks import InputNormalizer, init_weights, make_vector_env

from bounce_mjx.adapters.torch.policy import to_policy
from bounce_mjx.adapters.torch.rsl_rl_env import RslRlVecEnv
from bounce_mjx.env.env import Env
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import Policy


class RslRlLearner:
    """rsl_rl's PPO and storage in the loop of rsl_rl's runner, but without the runner's log, which
    would wait for the device at every step."""

    def __init__(self, config: PPOConfig, env: Env, seed: int):
        self.config = config
        self.env = RslRlVecEnv(make_vector_env(config, env, seed))
        self.env.episode_length_buf = torch.randint_like(
            self.env.episode_length_buf, self.env.max_episode_length
        )
        self.algorithm = PPO.construct_algorithm(
            self.env.get_observations(), self.env, rsl_rl_config(config), str(self.env.device)
        )
        self.algorithm.train_mode()

    def learn(self) -> None:
        """Trains for an iteration."""
        with torch.inference_mode():
            for _ in range(self.config.rollout_length):
                actions = self.algorithm.act(self.env.get_observations())
                observations, rewards, dones, extras = self.env.step(actions)
                self.algorithm.process_env_step(observations, rewards, dones, extras)
            self.algorithm.compute_returns(observations)
        self.algorithm.update()

    def policy(self) -> Policy:
        """The current policy, without action noise."""
        actor = self.algorithm.get_policy()
        seen = actor.obs_normalizer
        return to_policy(actor.mlp, seen.mean, seen.std, actor.distribution.log_std_param).policy


class Network(MLPModel):
    """rsl_rl's model with this project's normalisation and initial weights."""

    def __init__(self, *args: Any, **kwargs: Any):
        # Otherwise it would make a normaliser of its own.
        super().__init__(*args, obs_normalization=False, **kwargs)
        self.obs_normalization = True
        self.obs_normalizer = InputNormalizer(self.obs_dim)
        init_weights(self.mlp, output_gain=2**0.5 if self.distribution is None else 0.01)


def rsl_rl_config(config: PPOConfig) -> dict[str, Any]:
    """The config in the form that rsl_rl's algorithms expect."""
    network = {
        "class_name": Network,
        "hidden_dims": list(config.hidden_layers),
        "activation": "swish",
    }
    noise = {
        "class_name": "GaussianDistribution",
        "init_std": config.init_noise_std,
        "std_type": "log",
    }
    return {
        "num_steps_per_env": config.rollout_length,
        "multi_gpu": None,
        "obs_groups": {"actor": ["policy"], "critic": ["policy", "critic"]},
        "actor": network | {"distribution_cfg": noise},
        "critic": network,
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": config.num_epochs,
            "num_mini_batches": config.num_minibatches,
            "clip_param": config.clip_epsilon,
            "gamma": config.discount,
            "lam": config.gae_lambda,
            "value_loss_coef": config.value_cost,
            "entropy_coef": config.entropy_cost,
            "learning_rate": config.learning_rate,
            "max_grad_norm": config.max_grad_norm,
            "use_clipped_value_loss": False,
            "schedule": "adaptive" if config.target_kl > 0.0 else "fixed",
            "desired_kl": config.target_kl,
            "normalize_advantage_per_mini_batch": True,
        },
    }
