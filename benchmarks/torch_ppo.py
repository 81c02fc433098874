"""rsl_rl's and skrl's PPO for `jax_vs_torch.py`, with this project's hyperparameters as far as each
library has them, and with its networks and normalisation.

| here               | rsl_rl                                             | skrl                |
|--------------------|----------------------------------------------------|---------------------|
| rate's steering    | factor 1.5 (here 1.1)                              | so, once per epoch  |
| rate's limits      | 1e-5 to 1e-2, no decay                             | as here             |
| max_grad_norm      | actor and critic separately (here together)        | as here             |
| KL                 | exact for two Gaussians (here Schulman's estimate) | as here             |
| advantages         | as here                                            | normalised together |
| minibatches        | shuffled once per iteration (here once per epoch)  | as here             |
| statistics         | grow step by step (here by rollouts)               | in the first epoch  |
| value at time-outs | of the state before it (here of the last state)    | as here             |
| min_noise_std      | none                                               | none                |
"""

import itertools
from typing import Any

import numpy as np
import torch
from rsl_rl.algorithms import PPO as RslRlPPO
from rsl_rl.models import MLPModel
from skrl.agents.torch.ppo import PPO as SkrlPPO
from skrl.agents.torch.ppo import PPO_CFG
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.resources.schedulers.torch import KLAdaptiveLR
from torch import nn

from bounce_mjx.adapters.torch import TorchVectorEnv
from bounce_mjx.adapters.torch.policy import to_policy
from bounce_mjx.adapters.torch.rsl_rl_env import RslRlVecEnv
from bounce_mjx.adapters.torch.skrl_env import SkrlEnv
from bounce_mjx.env.env import Env
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import Policy
from bounce_mjx.learning.ppo import max_learning_rate
from bounce_mjx.learning.statistics import MAX_NORMALIZED, MIN_STD, MIN_VARIANCE


def make_vector_env(config: PPOConfig, env: Env, seed: int) -> TorchVectorEnv:
    """The environments of a learner."""
    torch.manual_seed(seed)
    return TorchVectorEnv(
        env,
        config.num_envs,
        seed=seed,
        critic_metrics=config.critic_metrics,
        reward_scale=config.reward_scale,
    )


class RslRlLearner:
    """rsl_rl's PPO and storage in the loop of rsl_rl's runner, but without the runner's log, which
    would wait for the device at every step."""

    def __init__(self, config: PPOConfig, env: Env, seed: int):
        self.config = config
        self.env = RslRlVecEnv(make_vector_env(config, env, seed))
        self.env.episode_length_buf = torch.randint_like(
            self.env.episode_length_buf, self.env.max_episode_length
        )
        self.algorithm = RslRlPPO.construct_algorithm(
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
        return to_policy(actor.mlp, seen.mean, seen.std, actor.distribution.log_std_param)


class SkrlLearner:
    """skrl's PPO in the loop of skrl's trainers. At the end of an episode it gets the terminal
    observation, so that it bootstraps a time-out from that observation."""

    def __init__(self, config: PPOConfig, env: Env, seed: int):
        self.config = config
        vector = make_vector_env(config, env, seed)
        self.env = SkrlEnv(vector)
        self._observations, _ = self.env.reset()
        vector.clock = torch.randint_like(vector.clock, vector.episode_steps)
        self.agent = SkrlPPO(
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

    def learn(self) -> None:
        """Trains for an iteration."""
        if self.agent.scheduler is not None:
            self.agent.scheduler.max_lr = float(max_learning_rate(self.config, self._iteration))
        self._iteration += 1
        self.agent.tracking_data.clear()
        for _ in range(self.config.rollout_length):
            self._step()

    def policy(self) -> Policy:
        """The current policy, without action noise."""
        actor, seen = self.agent.policy, self.agent.checkpoint_modules["observation_preprocessor"]
        return to_policy(actor.mlp, seen.mean, seen.std, actor.log_std)

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


class InputNormalizer(nn.Module):
    """`learning.statistics` as a module: running statistics, and normalisation with them.

    rsl_rl uses it as its observation normaliser (`update`), skrl as its preprocessor (`train`).
    """

    def __init__(self, size: int, device: torch.device | str | None = None):
        super().__init__()
        self.register_buffer("count", torch.zeros((), dtype=torch.int64, device=device))
        self.register_buffer("mean", torch.zeros(size, device=device))
        self.register_buffer("summed_variance", torch.zeros(size, device=device))
        self.register_buffer("std", torch.ones(size, device=device))

    @torch.no_grad()
    def update(self, observation: torch.Tensor) -> None:
        """Adds observations [..., N] to the statistics (Chan, Golub and LeVeque 1979)."""
        batch = observation.reshape(-1, observation.shape[-1])
        old_count = self.count.clone()
        self.count += batch.shape[0]
        batch_mean = batch.mean(0)
        delta = batch_mean - self.mean
        self.mean += delta * (batch.shape[0] / self.count)
        self.summed_variance += (batch - batch_mean).square().sum(0)
        self.summed_variance += delta.square() * (old_count * batch.shape[0] / self.count)
        self.std = torch.sqrt(self.summed_variance / self.count + MIN_VARIANCE)

    def forward(self, observation: torch.Tensor, train: bool = False) -> torch.Tensor:
        """Normalises observations [..., N]; `train` adds them to the statistics first."""
        if train:
            self.update(observation)
        clipped = ((observation - self.mean) / self.std).clamp(-MAX_NORMALIZED, MAX_NORMALIZED)
        return torch.where(self.std > MIN_STD, clipped, torch.zeros_like(clipped))


class RslRlNetwork(MLPModel):
    """rsl_rl's model with this project's normalisation and initial weights."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, obs_normalization=False, **kwargs)
        self.obs_normalization = True
        self.obs_normalizer = InputNormalizer(self.obs_dim)
        init_weights(self.mlp, output_gain=2**0.5 if self.distribution is None else 0.01)


def rsl_rl_config(config: PPOConfig) -> dict[str, Any]:
    """The config in the form that rsl_rl's algorithms expect."""
    network = {
        "class_name": RslRlNetwork,
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
        self.log_std = nn.Parameter(
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


def make_mlp(
    config: PPOConfig, num_inputs: int, num_outputs: int, output_gain: float
) -> nn.Sequential:
    """The hidden layers of the config with SiLU between them, and a linear output."""
    sizes = [num_inputs, *config.hidden_layers, num_outputs]
    layers: list[nn.Module] = []
    for inputs, outputs in itertools.pairwise(sizes):
        layers += [nn.Linear(inputs, outputs), nn.SiLU()]
    mlp = nn.Sequential(*layers[:-1])
    init_weights(mlp, output_gain)
    return mlp


def init_weights(mlp: nn.Sequential, output_gain: float) -> None:
    """Sets orthogonal weights as in `learning/networks.py`: gain sqrt(2), and `output_gain` in the
    last layer."""
    linears = [module for module in mlp if isinstance(module, nn.Linear)]
    for linear in linears:
        gain = output_gain if linear is linears[-1] else 2**0.5
        nn.init.orthogonal_(linear.weight, gain)
        nn.init.zeros_(linear.bias)
