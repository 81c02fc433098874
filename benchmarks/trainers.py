"""The trainers that `jax_vs_torch.py` compares, one function each.

Each trains on the config's environment until `on_block` returns True. `on_block` receives the
number of environment steps so far, the block's time in seconds, and the policy.

For rsl_rl, skrl and skrl_jax, the differences of the hyperparameters from ours are in the tables of
`adapters/torch/rsl_rl_ppo.py` and `adapters/torch/skrl_ppo.py`, and in `skrl_jax.py`. For brax, on
the fused and on the mjx physics:

| PPOConfig                         | brax                                             |
|-----------------------------------|--------------------------------------------------|
| settings not listed below         | the same                                         |
| value_cost                        | the same; passed doubled, as brax halves it      |
| learning_rate, its limits, target_kl | the same; adapted by a factor of 1.5 (ours 1.1) |
| decay_steps                       | none                                             |
| advantages                        | recomputed by the current network for each minibatch |
| resets                            | each environment always resets to its first state |
"""

import concurrent.futures
import functools
import time
from collections.abc import Callable
from typing import Literal, Protocol

import jax
import jax.numpy as jnp
from brax.envs.base import State, Wrapper
from brax.training.agents.ppo.networks import PPONetworks
from brax.training.distribution import NormalDistribution
from brax.training.networks import FeedForwardNetwork

from bounce_mjx.adapters.brax import device_put_replicated
from bounce_mjx.adapters.brax.ppo import ppo_settings
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.policy import Network, Policy, make_networks
from bounce_mjx.learning.ppo import make_trainer, policy_of
from bounce_mjx.learning.statistics import MIN_VARIANCE, Normalizer, normalize
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.task.env import BounceBall
from bounce_mjx.training.setup import compiler_options

Method = Literal["ours", "brax", "brax_mjx", "rsl_rl", "skrl", "skrl_jax"]


class OnBlock(Protocol):
    """Callbacks of a trainer."""

    def prepare(self) -> None:
        """Called once before the first block, when it does not delay the trainer's own tracing."""

    def __call__(self, steps: int, seconds: float, policy: Policy) -> bool:
        """Called after every block; returns whether the training may end."""


def train_ours(config: TrainConfig, on_block: OnBlock) -> None:
    """This project's trainer."""
    env = BounceBall(config.env)
    trainer = make_trainer(config.ppo, env, config.env.episode_steps)
    iterations = block_iterations(config)
    key = jax.random.PRNGKey(config.seed)
    init = jax.jit(trainer.init)
    run = jax.jit(
        trainer.run,
        static_argnums=1,
        donate_argnums=0,
        compiler_options=compiler_options(has_products=trainer.has_products),
    )
    with concurrent.futures.ThreadPoolExecutor() as pool:
        shapes = jax.eval_shape(init, key)
        compiled_run = pool.submit(run.lower(shapes, iterations).compile)
        compiled_init = pool.submit(init.lower(key).compile)
        on_block.prepare()
        state = jax.block_until_ready(compiled_init.result()(key))
        run_block = compiled_run.result()
    steps, ended = 0, False
    while not ended:
        started = time.perf_counter()
        state, _ = jax.block_until_ready(run_block(state))
        seconds = time.perf_counter() - started
        steps += iterations * config.ppo.batch_steps
        # Copied because the next block reuses the state's memory.
        ended = on_block(
            steps, seconds, jax.tree.map(jnp.copy, policy_of(state, env.observation_size))
        )


def train_torch(library: Literal["rsl_rl", "skrl"], config: TrainConfig, on_block: OnBlock) -> None:
    """A PyTorch library on the PyTorch adapter."""
    from bounce_mjx.adapters.torch.trainer import make_learner

    learner = make_learner(library, config.ppo, BounceBall(config.env), config.seed)
    _train_learner(learner, config, on_block)


def train_skrl_jax(config: TrainConfig, on_block: OnBlock) -> None:
    """skrl's JAX side."""
    from skrl_jax import SkrlJaxLearner

    learner = SkrlJaxLearner(config.ppo, BounceBall(config.env), config.seed)
    _train_learner(learner, config, on_block)


def _train_learner(learner, config: TrainConfig, on_block: OnBlock) -> None:
    on_block.prepare()
    iterations = block_iterations(config)
    steps, ended = 0, False
    while not ended:
        started = time.perf_counter()
        learner.learn(iterations)
        # Reading the policy waits until the device has computed it.
        policy = jax.block_until_ready(learner.policy())
        seconds = time.perf_counter() - started
        steps += iterations * config.ppo.batch_steps
        ended = on_block(steps, seconds, policy)


class _TrainingEnded(Exception):
    """Ends brax's training, which offers no other way to stop."""


class CriticObservation(Wrapper):
    """Observations for the policy and for the critic, as this project's networks expect them."""

    def __init__(self, env: BounceBall, critic_metrics: tuple[str, ...]):
        super().__init__(env)
        self._names = critic_metrics

    def reset(self, rng: jax.Array) -> State:
        return self._observe(self.env.reset(rng))

    def step(self, state: State, action: jax.Array) -> State:
        return self._observe(self.env.step(state.replace(obs=state.obs["state"]), action))

    def _observe(self, state: State) -> State:
        extra = [state.metrics[name][None] for name in self._names]
        return state.replace(
            obs={"state": state.obs, "critic": jnp.concatenate([state.obs, *extra])}
        )


def train_brax(physics: Literal["auto", "mjx"], config: TrainConfig, on_block: OnBlock) -> None:
    """brax's PPO with its own wrappers."""
    import brax.training.agents.ppo.train as brax_ppo

    ppo = config.ppo
    env = BounceBall(config.env.model_copy(update={"physics": physics}))
    steps_per_epoch = block_iterations(config) * ppo.batch_steps
    epochs = -(-config.total_steps // steps_per_epoch)
    settings = ppo_settings(config) | {"num_timesteps": epochs * steps_per_epoch}
    started = time.perf_counter()
    on_block.prepare()

    def on_params(steps: int, _, params) -> None:
        nonlocal started
        seconds = time.perf_counter() - started
        if steps:
            statistics = params[0]
            policy = Policy(_normalizer(statistics, "state"), params[1])
            if on_block(steps, seconds, policy):
                raise _TrainingEnded
        started = time.perf_counter()

    def networks(_, action_size: int, preprocess_observations_fn):
        del preprocess_observations_fn
        return brax_networks(ppo, env.observation_size, action_size)

    try:
        with device_put_replicated():
            brax_ppo.train(
                environment=CriticObservation(env, ppo.critic_metrics),
                **settings,
                vf_loss_coefficient=2.0 * ppo.value_cost,
                normalize_observations_std_eps=MIN_VARIANCE,
                network_factory=networks,
                max_devices_per_host=1,
                num_evals=epochs + 1,
                run_evals=False,
                policy_params_fn=on_params,
                seed=config.seed,
            )
    except _TrainingEnded:
        pass


def brax_networks(config: PPOConfig, observation_size: int, action_size: int) -> PPONetworks:
    """This project's networks, with its normalisation, for brax's trainer."""
    networks = make_networks(config, observation_size, action_size, len(config.critic_metrics))

    def adapt(network: Network, key: str) -> FeedForwardNetwork:
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


def block_iterations(config: TrainConfig) -> int:
    """Iterations between two evaluations."""
    return max(1, round(config.eval_every / config.ppo.batch_steps))


TRAINERS: dict[Method, Callable[[TrainConfig, OnBlock], None]] = {
    "ours": train_ours,
    "brax": functools.partial(train_brax, "auto"),
    "brax_mjx": functools.partial(train_brax, "mjx"),
    "rsl_rl": functools.partial(train_torch, "rsl_rl"),
    "skrl": functools.partial(train_torch, "skrl"),
    "skrl_jax": train_skrl_jax,
}
