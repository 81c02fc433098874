"""brax's PPO as a trainer of `jax_vs_torch.py`, on the fused or on the mjx physics.

The networks, the normalisation and the environments' step are this project's, the wrappers and the
trainer brax's. The differences of the hyperparameters from ours:

| PPOConfig                            | brax                                                     |
|--------------------------------------|----------------------------------------------------------|
| settings not listed below            | the same                                                 |
| compute_dtype                        | float32 (configs/default.yaml: bfloat16)                 |
| mean_noise_bound                     | none (configs/default.yaml: 0.1)                         |
| value_cost                           | the same; passed doubled, as brax halves it              |
| learning_rate, its limits, target_kl | the same; adapted by a factor of 1.5 (ours 1.1)          |
| final_max_learning_rate, decay_steps | none: max_learning_rate stays                            |
| KL                                   | exact for two Gaussians (ours Schulman's estimate)       |
| optimizer                            | Adam's epsilon is 1e-8 (ours 1e-5)                       |
| minibatches                          | of whole rollouts (ours of single steps)                 |
| advantages                           | anew by the current network in each minibatch            |
| gae_lambda                           | not on the first of the later errors                     |
| statistics                           | updated after the update (ours before)                   |
| value at a time-out                  | none; the step's advantage is 0 (ours of the last state) |
| start of the training                | all episodes together (ours at different times)          |
| resets                               | each environment always resets to its first state        |
| training_episode_seconds             | not used by any trainer here, but env.episode_seconds    |
| shared_critic                        | refused                                                  |
"""

import time
from typing import Literal

import brax.training.agents.ppo.train as brax_ppo
import jax
import jax.numpy as jnp
from brax.envs.base import State, Wrapper
from brax.training.agents.ppo.networks import PPONetworks
from brax.training.distribution import NormalDistribution
from brax.training.networks import FeedForwardNetwork
from trainer_interface import OnBlock, TrainingEnded, block_iterations

from bounce_mjx.adapters.brax import device_put_replicated
from bounce_mjx.adapters.brax.ppo import ppo_settings
from bounce_mjx.env.bounce_ball import BounceBall
from bounce_mjx.errors import UserError
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import NetworkFunctions, Policy, make_networks
from bounce_mjx.learning.statistics import MIN_VARIANCE, Normalizer, normalize
from bounce_mjx.runs.config import TrainConfig


class CriticObservation(Wrapper):
    """Observations for the policy and for the critic, as this project's networks expect them."""

    def __init__(self, env: BounceBall, critic_metrics: tuple[str, ...]):
        super().__init__(env)
        self._names = critic_metrics

    def reset(self, rng: jax.Array) -> State:
        return self._observe(self.env.reset(rng))

    def step(self, state: State, action: jax.Array) -> State:
        # The environment knows one array.
        inner = state.replace(obs=state.obs["state"])
        return self._observe(self.env.step(inner, action))

    def _observe(self, state: State) -> State:
        extra = [state.metrics[name][None] for name in self._names]
        return state.replace(
            obs={"state": state.obs, "critic": jnp.concatenate([state.obs, *extra])}
        )


def train(physics: Literal["auto", "mjx"], config: TrainConfig, on_block: OnBlock) -> None:
    """brax's PPO with its own wrappers."""
    env = BounceBall(config.env.model_copy(update={"physics": physics}))
    ppo = config.ppo
    if ppo.critic_metrics is None:
        ppo = ppo.model_copy(update={"critic_metrics": env.task.critic_metrics})
    steps_per_epoch = block_iterations(config) * ppo.batch_steps
    epochs = -(-config.total_steps // steps_per_epoch)
    settings = ppo_settings(config) | {"num_timesteps": epochs * steps_per_epoch}
    started = time.perf_counter()
    on_block.prepare()

    def on_params(steps: int, _, params) -> None:
        nonlocal started
        seconds = time.perf_counter() - started
        # brax also calls it before the first step.
        if steps:
            statistics, policy_params, _ = params
            policy = Policy(_normalizer(statistics, "state"), policy_params)
            if on_block(steps, seconds, policy):
                raise TrainingEnded
        started = time.perf_counter()

    def networks(_, action_size: int, preprocess_observations_fn):
        del preprocess_observations_fn
        return brax_networks(ppo, env.observation_size, action_size)

    try:
        with device_put_replicated():
            brax_ppo.train(
                environment=CriticObservation(env, ppo.critic_metrics),
                **settings,
                normalize_observations_std_eps=MIN_VARIANCE,
                network_factory=networks,
                max_devices_per_host=1,
                num_evals=epochs + 1,
                run_evals=False,
                policy_params_fn=on_params,
                seed=config.seed,
            )
    except TrainingEnded:
        pass


def brax_networks(config: PPOConfig, observation_size: int, action_size: int) -> PPONetworks:
    """This project's networks, with its normalisation, for brax's trainer.

    Raises:
      UserError: the config has a shared critic, which brax's networks lack.
    """
    if config.shared_critic:
        raise UserError("brax's networks share no layers; leave --shared-critic out")
    networks = make_networks(config, observation_size, action_size, len(config.critic_metrics))

    def adapt(network: NetworkFunctions, key: str) -> FeedForwardNetwork:
        return FeedForwardNetwork(
            init=network.init,
            apply=lambda statistics, params, observation: network.apply(
                params, normalize(observation[key], _normalizer(statistics, key))
            ),
        )

    return PPONetworks(
        policy_network=adapt(networks.policy_network, "state"),
        value_network=adapt(networks.value_network, "critic"),
        parametric_action_distribution=NormalDistribution(action_size),
    )


def _normalizer(statistics, key: str) -> Normalizer:
    """The normaliser of one entry of brax's observation."""
    return Normalizer(statistics.mean[key], statistics.std[key])
