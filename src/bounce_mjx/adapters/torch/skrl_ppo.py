"""skrl (2.x): the environment as a `Wrapper`, and skrl's PPO with this project's hyperparameters.

| here                    | skrl                                                                |
|-------------------------|---------------------------------------------------------------------|
| num_envs, rollout_length, num_epochs, num_minibatches, discount, gae_lambda, clip_epsilon,      |
| entropy_cost, value_cost, reward_scale, max_grad_norm, init_noise_std, hidden_layers,           |
| critic_metrics, initial weights | the same                                                    |
| normalisation           | the same formula; the first epoch updates the statistics            |
| value at a time-out     | of the last state: the same, because the learner passes it on       |
| learning_rate, its limits, decay_steps | the same                                             |
| target_kl               | adapts once per epoch by 1.5 (here once per minibatch by 1.1)       |
| advantages              | normalised over the whole rollout (here in each minibatch)          |
"""

import functools
import sys
from typing import Any

import gymnasium
import numpy as np
import torch

from bounce_mjx.adapters.torch.learner import Learner
from bounce_mjx.adapters.torch.networks import (
    InputNormalizer,
    init_weights,
    linears_of,
    make_mlp,
    to_policy,
)
from bounce_mjx.adapters.torch.vector_env import StepResult, TorchVectorEnv
from bounce_mjx.errors import needed
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import Policy
from bounce_mjx.learning.ppo import max_learning_rate

with needed("skrl", "bounce_mjx[torch]"):
    from skrl.agents.torch.ppo import PPO, PPO_CFG
    from skrl.envs.wrappers.torch import Wrapper
    from skrl.envs.wrappers.torch import wrap_env as _skrls_wrap_env
    from skrl.memories.torch import RandomMemory
    from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
    from skrl.resources.schedulers.torch import KLAdaptiveLR


class SkrlEnv(Wrapper):
    """B environments with the interface of skrl's trainers; skrl's `wrap_env` returns them as they
    are.

    Rewards, terminated and truncated are [B, 1]; `state()` is the value network's input, the
    observation and the critic metrics [B, N + K].
    """

    # skrl's properties would ask the environment that is wrapped.
    observation_space: gymnasium.Space = None
    state_space: gymnasium.Space = None
    action_space: gymnasium.Space = None

    def __init__(self, env: TorchVectorEnv):
        super().__init__(env)
        self.observation_space = _unbounded(env.num_observations)
        self.state_space = _unbounded(env.num_observations + len(env.critic_metrics))
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (env.num_actions,))
        self._states: torch.Tensor | None = None
        self.result: StepResult | None = None
        """Result of the last step."""

    def reset(self) -> tuple[torch.Tensor, dict[str, Any]]:
        """Starts a new episode in every environment."""
        observation, critic_metrics = self._env.reset()
        self._states = torch.cat([observation, critic_metrics], dim=-1)
        return observation, {}

    def step(
        self, actions: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advances every environment under the actions [B, A]."""
        result = self.result = self._env.step(actions)
        self._states = torch.cat([result.observation, result.critic_metrics], dim=-1)
        return (
            result.observation,
            result.reward[:, None],
            result.terminated[:, None],
            result.truncated[:, None],
            {},
        )

    def state(self) -> torch.Tensor:
        """Inputs of the value network [B, N + K]."""
        return self._states

    def terminal_observations(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Observations and states after the last step, before any reset; at the end of an episode,
        its last ones."""
        result = self.result
        states = torch.cat([result.final_observation, result.final_critic_metrics], dim=-1)
        return result.final_observation, states

    def render(self, *args: Any, **kwargs: Any) -> None:
        """Does nothing: skrl calls it at every step."""

    def close(self) -> None:
        """Does nothing: the environment holds no resources."""


@functools.wraps(_skrls_wrap_env)
def _wrap_env(env: Any, *args: Any, **kwargs: Any) -> Any:
    return env if isinstance(env, SkrlEnv) else _skrls_wrap_env(env, *args, **kwargs)


# skrl's function knows only the classes of other packages, and scripts call it on every
# environment. They may have imported it already.
for _module in list(sys.modules.values()):
    if getattr(_module, "__dict__", {}).get("wrap_env") is _skrls_wrap_env:
        _module.wrap_env = _wrap_env


class SkrlLearner(Learner):
    """skrl's PPO in the same loop as skrl's trainers. At the end of an episode it gets the terminal
    observation, so that it bootstraps a time-out from that observation."""

    library = "skrl"
    losses = ("loss/policy", "loss/value", "policy/action_std", "policy/learning_rate")

    def _build(self) -> None:
        self.env = SkrlEnv(self.vector)
        self._observations, _ = self.env.reset()
        self._states = self.env.state()
        self.vector.clock = torch.randint_like(self.vector.clock, self.vector.episode_steps)
        models = {"policy": _Actor(self.config, self.env), "value": _Critic(self.config, self.env)}
        self.agent = PPO(
            models=models,
            memory=RandomMemory(
                memory_size=self.config.rollout_length,
                num_envs=self.config.num_envs,
                device=self.env.device,
            ),
            cfg=agent_config(self.config, self.env),
            **_spaces(self.env),
        )
        self.agent.init()
        self.agent.enable_training_mode(True)
        self.optimizer = self.agent.optimizer

    def policy(self) -> Policy:
        actor = self.agent.policy
        return to_policy(
            self.config, self.agent._observation_preprocessor, linears_of(actor.mlp), actor.log_std
        )

    def _iterate(self) -> tuple[torch.Tensor, dict[str, float]]:
        if self.agent.scheduler is not None:
            self.agent.scheduler.max_lr = float(max_learning_rate(self.config, self.iteration))
        self.agent.tracking_data.clear()
        steps = torch.stack([self._step() for _ in range(self.config.rollout_length)])
        tracked = self.agent.tracking_data
        return steps, {
            "loss/policy": tracked["Loss / Policy loss"][-1],
            "loss/value": tracked["Loss / Value loss"][-1],
            "policy/action_std": tracked["Policy / Standard deviation"][-1],
            "policy/learning_rate": self.optimizer.param_groups[0]["lr"],
        }

    def _modules(self) -> dict[str, torch.nn.Module]:
        return {
            "policy": self.agent.policy,
            "value": self.agent.value,
            "observation_statistics": self.agent._observation_preprocessor,
            "state_statistics": self.agent._state_preprocessor,
        }

    def _observed(self) -> dict[str, torch.Tensor]:
        return {"observations": self._observations, "states": self._states}

    def _observe(self, observations: torch.Tensor, states: torch.Tensor) -> None:
        self._observations, self._states = observations, states

    def _step(self) -> torch.Tensor:
        """Runs one step of every environment, and an update at the end of a rollout; returns the
        step's metrics."""
        clock = {"timestep": 0, "timesteps": 0}
        self.agent.pre_interaction(**clock)
        with torch.no_grad():
            actions, _ = self.agent.act(self._observations, self._states, **clock)
            following, rewards, terminated, truncated, infos = self.env.step(actions)
            final_observations, final_states = self.env.terminal_observations()
            self.agent.record_transition(
                observations=self._observations,
                states=self._states,
                actions=actions,
                # skrl adds the bootstrapped value in place.
                rewards=rewards.clone(),
                next_observations=final_observations,
                next_states=final_states,
                terminated=terminated,
                truncated=truncated,
                infos=infos,
                **clock,
            )
        self.agent.post_interaction(**clock)
        self._observations, self._states = following, self.env.state()
        return self.env.result.metrics


def agent_config(config: PPOConfig, env: SkrlEnv) -> PPO_CFG:
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
        self.mlp = make_mlp(config, self.num_observations, self.num_actions)
        init_weights(self.mlp, output_gain=0.01)
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
        self.mlp = make_mlp(config, self.num_states, 1)
        init_weights(self.mlp, output_gain=2**0.5)

    def compute(
        self, inputs: dict[str, Any], role: str = ""
    ) -> tuple[torch.Tensor, dict[str, Any]]:
        return self.mlp(inputs["states"]), {}


def _unbounded(size: int) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(-np.inf, np.inf, (size,))
