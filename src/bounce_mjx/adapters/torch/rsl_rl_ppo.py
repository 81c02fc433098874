"""rsl_rl (5.x): the environment as a `VecEnv`, and rsl_rl's PPO with this project's
hyperparameters.

| here                    | rsl_rl                                                              |
|-------------------------|---------------------------------------------------------------------|
| num_envs, rollout_length, num_epochs, num_minibatches, discount, gae_lambda, clip_epsilon,      |
| entropy_cost, value_cost, reward_scale, init_noise_std, hidden_layers, critic_metrics | the same |
| initial weights         | the same (`networks.py`)                                            |
| normalisation           | the same formula; the statistics grow step by step (here by rollouts) |
| advantages              | normalised in each minibatch: the same                              |
| learning_rate           | the same start; steered by the KL of each minibatch: the same       |
| target_kl               | `desired_kl`; 0 turns the steering off: the same                    |
| factor of the steering  | 1.5 (here 1.1): fixed in rsl_rl                                     |
| min, max and final_max_learning_rate, decay_steps | 1e-5 to 1e-2, no decay: fixed in rsl_rl   |
| max_grad_norm           | for the actor and the critic separately (here together)             |
| KL                      | exact for two Gaussians (here Schulman's estimate)                  |
| minibatches             | shuffled once per iteration (here once per epoch)                   |
| value at a time-out     | of the state before it (here of the last state)                     |
"""

import sys
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import nn

from bounce_mjx.adapters.torch.learner import Learner
from bounce_mjx.adapters.torch.networks import (
    InputNormalizer,
    init_weights,
    linears_of,
    to_policy,
)
from bounce_mjx.adapters.torch.vector_env import StepResult, TorchVectorEnv
from bounce_mjx.errors import needed
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.metrics import SUM
from bounce_mjx.learning.policy import Policy

with needed("rsl_rl", "bounce_mjx[torch]"):
    from rsl_rl.algorithms import PPO
    from rsl_rl.env import VecEnv
    from rsl_rl.models import MLPModel
    from tensordict import TensorDict


class RslRlVecEnv(VecEnv):
    """B environments with the interface of rsl_rl's runners.

    The observation groups are `policy` [B, N] and `critic` [B, K], the metrics for the value
    network alone. `extras` holds `time_outs` [B] and `log`, means over the batch.
    """

    def __init__(self, env: TorchVectorEnv):
        self.env = env
        self.num_envs = env.num_envs
        self.num_actions = env.num_actions
        self.max_episode_length = env.episode_steps
        self.device = env.device
        self.cfg = env.env.config
        self.step_dt, self.physics_dt = env.env.dt, self.cfg.physics_dt
        self.render_mode = None
        self.action_space = spaces.Box(-1.0, 1.0, (self.num_envs, self.num_actions), np.float32)
        self._seed: int | None = None
        self._observations = self._groups(*env.reset())
        self.result: StepResult | None = None
        """Result of the last step."""

    @property
    def unwrapped(self) -> "RslRlVecEnv":
        """The environments themselves, as there is no wrapper around them."""
        return self

    @property
    def observation_space(self) -> spaces.Dict:
        """The observation groups of all environments."""
        return spaces.Dict(
            {
                name: spaces.Box(-np.inf, np.inf, tuple(group.shape), np.float32)
                for name, group in self._observations.items()
            }
        )

    def seed(self, seed: int = -1) -> int:
        """Sets the seed of the next `reset`; with -1, the next reset continues with the present
        random numbers."""
        self._seed = None if seed < 0 else seed
        return seed

    def reset(self) -> tuple[TensorDict, dict[str, Any]]:
        """Starts a new episode in every environment: observations and empty extras."""
        self._observations = self._groups(*self.env.reset(self._seed))
        self._seed = None
        return self._observations, {}

    def close(self) -> None:
        """Does nothing, as the environments hold no window and no file."""

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Steps that count towards the time limit [B], int64; a copy, which may be set."""
        return self.env.clock.long()

    @episode_length_buf.setter
    def episode_length_buf(self, value: torch.Tensor) -> None:
        self.env.clock = value

    def get_observations(self) -> TensorDict:
        """The current observations."""
        return self._observations

    def step(
        self, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advances every environment under the actions [B, A].

        Returns:
          Observations, rewards [B], dones [B] (bool) and extras.
        """
        result = self.result = self.env.step(actions)
        self._observations = self._groups(result.observation, result.critic_metrics)
        means = zip(self.env.metric_names, result.metrics.unbind(), strict=True)
        log = {f"task/{name}": mean for name, mean in means if not name.startswith(SUM)}
        extras = {"time_outs": result.truncated, "log": log}
        return self._observations, result.reward, result.done, extras

    def _groups(self, observation: torch.Tensor, critic_metrics: torch.Tensor) -> TensorDict:
        # Built on the device, because a conversion would wait for it; without TensorDict's checks,
        # which cost more than the step's views.
        return TensorDict._new_unsafe(
            {"policy": observation, "critic": critic_metrics},
            batch_size=torch.Size([self.num_envs]),
            device=self.device,
        )


class Network(MLPModel):
    """rsl_rl's model with this project's normalisation and initial weights."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, obs_normalization=False, **kwargs)
        self.obs_normalization = True
        self.obs_normalizer = InputNormalizer(self.obs_dim)
        init_weights(self.mlp, output_gain=2**0.5 if self.distribution is None else 0.01)


class RslRlLearner(Learner):
    """rsl_rl's PPO and storage in the same loop as rsl_rl's runner, but without the runner's log,
    which would wait for the device at every step."""

    library = "rsl_rl"
    losses = ("loss/policy", "loss/value", "policy/entropy", "policy/learning_rate")

    def _build(self) -> None:
        self.env = RslRlVecEnv(self.vector)
        self.env.episode_length_buf = torch.randint_like(
            self.env.episode_length_buf, self.env.max_episode_length
        )
        # Otherwise rsl_rl prints its networks.
        sys.modules[PPO.__module__].print = lambda *_: None
        self.algorithm = PPO.construct_algorithm(
            self.env.get_observations(),
            self.env,
            algorithm_config(self.config),
            str(self.env.device),
        )
        self.optimizer = self.algorithm.optimizer
        self.algorithm.train_mode()

    def policy(self) -> Policy:
        actor = self.algorithm.get_policy()
        return to_policy(
            self.config,
            actor.obs_normalizer,
            linears_of(actor.mlp),
            actor.distribution.log_std_param,
        )

    def _iterate(self) -> tuple[torch.Tensor, dict[str, float]]:
        steps = []
        with torch.inference_mode():
            for _ in range(self.config.rollout_length):
                actions = self.algorithm.act(self.env.get_observations())
                observations, rewards, dones, extras = self.env.step(actions)
                self.algorithm.process_env_step(observations, rewards, dones, extras)
                steps.append(self.env.result.metrics)
            self.algorithm.compute_returns(observations)
        loss = self.algorithm.update()
        return torch.stack(steps), {
            "loss/policy": loss["surrogate"],
            "loss/value": loss["value"],
            "policy/entropy": loss["entropy"],
            "policy/learning_rate": self.algorithm.learning_rate,
        }

    def _modules(self) -> dict[str, nn.Module]:
        return {"actor": self.algorithm.actor, "critic": self.algorithm.critic}

    def _set_learning_rate(self, rate: float) -> None:
        super()._set_learning_rate(rate)
        self.algorithm.learning_rate = rate

    def _observed(self) -> dict[str, torch.Tensor]:
        return dict(self.env.get_observations().items())

    def _observe(self, **observed: torch.Tensor) -> None:
        self.env.get_observations().update(observed)


def algorithm_config(config: PPOConfig) -> dict[str, Any]:
    """The config in the form that rsl_rl's runners and algorithms expect."""
    network = {
        "class_name": Network,
        "hidden_dims": list(config.hidden_layers),
        "activation": "swish",
    }
    return {
        "num_steps_per_env": config.rollout_length,
        "save_interval": 1_000_000_000,
        # The environment never returns non-finite values, and this check would wait for the device.
        "check_for_nan": False,
        "multi_gpu": None,
        "obs_groups": {"actor": ["policy"], "critic": ["policy", "critic"]},
        "actor": network
        | {
            "distribution_cfg": {
                "class_name": "GaussianDistribution",
                "init_std": config.init_noise_std,
                "std_type": "log",
            }
        },
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
