"""skrl's PPO in JAX on this environment, for `jax_vs_torch.py`.

The hyperparameters are the same as in `torch_ppo.py`, except that skrl's JAX side
clips the gradients of each network separately and adapts a learning rate for each network.
"""

from typing import Any

import flax.linen as nn
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import skrl
from skrl.agents.jax.ppo import PPO, PPO_CFG
from skrl.memories.jax import RandomMemory
from skrl.models.jax import DeterministicMixin, GaussianMixin, Model
from skrl.resources.schedulers.jax import KLAdaptiveLR

from bounce_mjx.env import vector
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import Policy
from bounce_mjx.learning.ppo import max_learning_rate
from bounce_mjx.learning.statistics import init_statistics, normalize, update
from bounce_mjx.tasks.bounce_ball import BounceBall


class SkrlJaxLearner:
    """skrl's agent, stepped as skrl's trainers do. At the end of an episode it gets the terminal
    observation, so that it bootstraps a time-out from that observation."""

    def __init__(self, config: PPOConfig, env: BounceBall, seed: int):
        skrl.config.jax.key = seed
        if config.critic_metrics is None:
            config = config.model_copy(update={"critic_metrics": env.task.critic_metrics})
        self.config = config
        self._observation_size = env.observation_size
        num_states = env.observation_size + len(config.critic_metrics)
        spaces = {
            "observation_space": gymnasium.spaces.Box(-np.inf, np.inf, (env.observation_size,)),
            "state_space": gymnasium.spaces.Box(-np.inf, np.inf, (num_states,)),
            "action_space": gymnasium.spaces.Box(-1.0, 1.0, (env.action_size,)),
        }
        actor, critic = make_models(config)
        models = {"policy": actor(**spaces), "value": critic(**spaces)}
        for role, model in models.items():
            model.init_state_dict(role=role)
        self.agent = PPO(
            models=models,
            memory=RandomMemory(memory_size=config.rollout_length, num_envs=config.num_envs),
            cfg=PPO_CFG(
                rollouts=config.rollout_length,
                learning_epochs=config.num_epochs,
                mini_batches=config.num_minibatches,
                discount_factor=config.discount,
                gae_lambda=config.gae_lambda,
                learning_rate=config.learning_rate,
                learning_rate_scheduler=KLAdaptiveLR,
                learning_rate_scheduler_kwargs=self._schedule(0),
                observation_preprocessor=Normalizer,
                observation_preprocessor_kwargs={"size": env.observation_size},
                state_preprocessor=Normalizer,
                state_preprocessor_kwargs={"size": num_states},
                grad_norm_clip=config.max_grad_norm,
                ratio_clip=config.clip_epsilon,
                value_clip=0.0,
                entropy_loss_scale=config.entropy_cost,
                value_loss_scale=config.value_cost,
                time_limit_bootstrap=True,
                experiment={"write_interval": 0, "checkpoint_interval": 0},
            ),
            **spaces,
        )
        self.agent.init()
        self.agent.enable_training_mode(True)

        def add_metrics(observation: jax.Array, metrics: dict[str, jax.Array]) -> jax.Array:
            extra = [metrics[name][:, None] for name in config.critic_metrics]
            return jnp.concatenate([observation, *extra], axis=-1)

        def start(key):
            reset_key, clock_key = jax.random.split(key)
            state = vector.reset(env, reset_key, config.num_envs)
            clock = jax.random.randint(clock_key, (config.num_envs,), 0, env.config.episode_steps)
            return state._replace(clock=clock)

        def step(state, action, key):
            key, reset_key = jax.random.split(key)
            state, result = vector.step(env, state, action, reset_key, env.config.episode_steps)
            return (
                state,
                key,
                add_metrics(result.observation, state.env.metrics),
                add_metrics(result.final_observation, result.metrics),
                config.reward_scale * result.reward[:, None],
                result.terminated[:, None],
                result.truncated[:, None],
            )

        key, self._key = jax.random.split(jax.random.PRNGKey(seed))
        self._env_state = jax.jit(start)(key)
        self._step_env = jax.jit(step)
        self._states = add_metrics(vector.observe(self._env_state), self._env_state.env.metrics)
        self._iteration = 0

    def learn(self) -> None:
        """Trains for an iteration."""
        clock = {"timestep": 0, "timesteps": 0}
        schedule = KLAdaptiveLR(**self._schedule(self._iteration))
        self.agent.policy_scheduler = self.agent.value_scheduler = schedule
        self._iteration += 1
        self.agent.tracking_data.clear()
        for _ in range(self.config.rollout_length):
            n = self._observation_size
            states = self._states
            actions, _ = self.agent.act(states[:, :n], states, **clock)
            (
                self._env_state,
                self._key,
                self._states,
                final_states,
                rewards,
                terminated,
                truncated,
            ) = self._step_env(self._env_state, actions, self._key)
            self.agent.record_transition(
                observations=states[:, :n],
                states=states,
                actions=actions,
                rewards=rewards,
                next_observations=final_states[:, :n],
                next_states=final_states,
                terminated=terminated,
                truncated=truncated,
                infos={},
                **clock,
            )
            self.agent.post_interaction(**clock)

    def policy(self) -> Policy:
        """The current policy, without action noise."""
        params = self.agent.policy.state_dict.params["params"]
        depth = len(self.config.hidden_layers)
        hidden = {f"hidden_{i}": params[f"Dense_{i}"] for i in range(depth)}
        return Policy(
            self.agent.checkpoint_modules["observation_preprocessor"].statistics.normalizer,
            {
                "params": {
                    "MLP_0": hidden,
                    "Dense_0": params[f"Dense_{depth}"],
                    "std_logparam": {"log_value": params["log_std"]},
                }
            },
        )

    def _schedule(self, iteration: int) -> dict[str, float]:
        return {
            "kl_threshold": self.config.target_kl,
            "min_lr": self.config.min_learning_rate,
            "max_lr": float(max_learning_rate(self.config, iteration)),
        }


class Normalizer:
    """This project's normalisation as a skrl preprocessor."""

    def __init__(self, size: int):
        self.statistics = init_statistics(size)
        self._update = jax.jit(update)
        self._normalize = jax.jit(normalize)

    def __call__(self, observation: jax.Array | None, train: bool = False) -> jax.Array | None:
        if observation is None:
            return None
        if train:
            self.statistics = self._update(self.statistics, observation)
        return self._normalize(observation, self.statistics.normalizer)


def make_models(config: PPOConfig) -> tuple[type[Model], type[Model]]:
    """The config's policy and value networks as skrl models."""
    wide = nn.initializers.orthogonal(2**0.5)

    def hidden(x: jax.Array) -> jax.Array:
        for width in config.hidden_layers:
            x = nn.silu(nn.Dense(width, kernel_init=wide)(x))
        return x

    class Actor(GaussianMixin, Model):
        def __init__(self, observation_space, state_space, action_space, device=None, **kwargs):
            Model.__init__(
                self,
                observation_space=observation_space,
                state_space=state_space,
                action_space=action_space,
                device=device,
                **kwargs,
            )
            GaussianMixin.__init__(self)

        @nn.compact
        def __call__(self, inputs: dict[str, Any], role: str):
            start = nn.initializers.constant(np.log(config.init_noise_std))
            log_std = self.param("log_std", start, (self.num_actions,))
            narrow = nn.initializers.orthogonal(0.01)
            x = hidden(inputs["observations"])
            return nn.Dense(self.num_actions, kernel_init=narrow)(x), {"log_std": log_std}

    class Critic(DeterministicMixin, Model):
        def __init__(self, observation_space, state_space, action_space, device=None, **kwargs):
            Model.__init__(
                self,
                observation_space=observation_space,
                state_space=state_space,
                action_space=action_space,
                device=device,
                **kwargs,
            )
            DeterministicMixin.__init__(self)

        @nn.compact
        def __call__(self, inputs: dict[str, Any], role: str):
            return nn.Dense(1, kernel_init=wide)(hidden(inputs["states"])), {}

    return Actor, Critic
