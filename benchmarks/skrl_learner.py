"""skrl's PPO for `jax_vs_torch.py`, with this project's hyperparameters, networks and
normalisation.

| PPOConfig                    | skrl                                                          |
|------------------------------|---------------------------------------------------------------|
| settings not listed below    | the same                                                      |
| compute_dtype                | float32 (configs/default.yaml: bfloat16)                      |
| mean_noise_bound             | none (configs/default.yaml: 0.1)                              |
| target_kl                    | adapts once per epoch by 1.5 (here once per minibatch by 1.1) |
| optimizer                    | Adam's epsilon is 1e-8 (here 1e-5)                            |
| advantages                   | normalised over the whole rollout (here in each minibatch)    |
| statistics                   | updated during the first epoch (here before the update)       |
| training_episode_seconds     | not used by any trainer here, but env.episode_seconds         |
| activation                   | SiLU; others are refused                                      |
| critic_layers, shared_critic | the policy's hidden_layers, none; others are refused          |
"""

from typing import Any

import numpy as np
import optax
import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.resources.schedulers.torch import KLAdaptiveLR
from torch_networks import InputNormalizer, make_mlp, make_vector_env

from bounce_mjx.adapters.torch.policy import to_policy
from bounce_mjx.adapters.torch.skrl_env import SkrlEnv
from bounce_mjx.env.env import Env
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import Policy


class SkrlLearner:
    """skrl's PPO in the loop of skrl's trainers. At the end of an episode it gets the terminal
    observation, so that it bootstraps a time-out from that observation."""

    def __init__(self, config: PPOConfig, env: Env, seed: int):
        self.config = config
        vector = make_vector_env(config, env, seed)
        self.env = SkrlEnv(vector)
        self._observations, _ = self.env.reset()
        vector.clock = torch.randint_like(vector.clock, vector.episode_steps)
        self.agent = PPO(
            models={"policy": _Actor(config, self.env), "value": _Critic(config, self.env)},
            memory=RandomMemory(
                memory_size=config.rollout_length,
                num_envs=config.num_envs,
                device=self.env.device,
            ),
            cfg=skrl_config(config, self.env),
            **_spaces(self.env),
        )
        self.agent.init()
        self.agent.enable_training_mode(True)
        self._iteration = 0
        # The limit of our rule, `PPO.max_learning_rate`.
        self._max_learning_rate = optax.exponential_decay(
            config.max_learning_rate,
            transition_steps=config.decay_steps / config.batch_steps,
            decay_rate=config.final_max_learning_rate / config.max_learning_rate,
            end_value=config.final_max_learning_rate,
        )

    def learn(self) -> None:
        """Trains for an iteration."""
        if self.agent.scheduler is not None:
            self.agent.scheduler.max_lr = float(self._max_learning_rate(self._iteration))
        self._iteration += 1
        self.agent.tracking_data.clear()
        for _ in range(self.config.rollout_length):
            self._step()

    def policy(self) -> Policy:
        """The current policy, without action noise."""
        actor = self.agent.policy
        seen = self.agent.checkpoint_modules["observation_preprocessor"]
        return to_policy(actor.mlp, seen.mean, seen.std, actor.log_std).policy

    def _step(self) -> None:
        """Runs one step of every environment, and an update at the end of a rollout."""
        clock = {"timestep": 0, "timesteps": 0}
        self.agent.pre_interaction(**clock)
        with torch.no_grad():
            states = self.env.state()
            actions, _ = self.agent.act(self._observations, states, **clock)
            following, rewards, terminated, truncated, infos = self.env.step(actions)
            ended = self.env.result
            self.agent.record_transition(
                observations=self._observations,
                states=states,
                actions=actions,
                rewards=rewards,
                next_observations=ended.final_observation,
                next_states=torch.cat([ended.final_observation, ended.final_critic_metrics], -1),
                terminated=terminated,
                truncated=truncated,
                infos=infos,
                **clock,
            )
        self.agent.post_interaction(**clock)
        self._observations = following


def skrl_config(config: PPOConfig, env: SkrlEnv) -> PPO_CFG:
    """The config in the form that skrl's agent expects."""
    return PPO_CFG(
        rollouts=config.rollout_length,
        learning_epochs=config.num_epochs,
        mini_batches=config.num_minibatches,
        discount_factor=config.discount,
        gae_lambda=config.gae_lambda,
        learning_rate=config.learning_rate,
        learning_rate_scheduler=KLAdaptiveLR if config.target_kl > 0.0 else None,
        learning_rate_scheduler_kwargs={
            "kl_threshold": config.target_kl,
            "min_lr": config.min_learning_rate,
            "max_lr": config.max_learning_rate,
        },
        observation_preprocessor=InputNormalizer,
        observation_preprocessor_kwargs={
            "size": env.observation_space.shape[0],
            "device": env.device,
        },
        state_preprocessor=InputNormalizer,
        state_preprocessor_kwargs={"size": env.state_space.shape[0], "device": env.device},
        grad_norm_clip=config.max_grad_norm,
        ratio_clip=config.clip_epsilon,
        value_clip=0.0,
        entropy_loss_scale=config.entropy_cost,
        value_loss_scale=config.value_cost,
        time_limit_bootstrap=True,
        experiment={"write_interval": 0, "checkpoint_interval": 0},
    )


def _spaces(env: SkrlEnv) -> dict[str, Any]:
    return {
        "observation_space": env.observation_space,
        "state_space": env.state_space,
        "action_space": env.action_space,
        "device": env.device,
    }


class _Actor(GaussianMixin, Model):
    def __init__(self, config: PPOConfig, env: SkrlEnv):
        Model.__init__(self, **_spaces(env))
        GaussianMixin.__init__(self)
        self.mlp = make_mlp(config, self.num_observations, self.num_actions, output_gain=0.01)
        self.log_std = torch.nn.Parameter(
            torch.full((self.num_actions,), float(np.log(config.init_noise_std)))
        )

    def compute(
        self, inputs: dict[str, Any], role: str = ""
    ) -> tuple[torch.Tensor, dict[str, Any]]:
        return self.mlp(inputs["observations"]), {"log_std": self.log_std}


class _Critic(DeterministicMixin, Model):
    def __init__(self, config: PPOConfig, env: SkrlEnv):
        Model.__init__(self, **_spaces(env))
        DeterministicMixin.__init__(self)
        self.mlp = make_mlp(config, self.num_states, 1, output_gain=2**0.5)

    def compute(
        self, inputs: dict[str, Any], role: str = ""
    ) -> tuple[torch.Tensor, dict[str, Any]]:
        return self.mlp(inputs["states"]), {}
