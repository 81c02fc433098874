"""The trainers that `jax_vs_torch.py` compares, one function each.

Each trains on the config's environment until `on_block` returns True. `on_block` receives the
number of environment steps so far, the block's time in seconds, and the policy.

The differences of the libraries' hyperparameters from ours are in the tables of
`rsl_rl_learner.py`, `skrl_learner.py` and `brax_trainer.py`; `fast_td3_trainer.py` and
`flash_sac_trainer.py` run their authors' scripts with their settings. All but brax spread the
episodes' beginnings, and sample a new start at each reset. A process imports only the
library that it measures.
"""

import concurrent.futures
import functools
import time
from collections.abc import Callable
from typing import Literal, Protocol

import jax
import jax.numpy as jnp
from trainer_interface import OnBlock, block_iterations

from bounce_mjx.env.bounce_ball import BounceBall
from bounce_mjx.learning.policy import Policy
from bounce_mjx.learning.ppo import PPO, policy_of
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.training.setup import compiler_options

Method = Literal["ours", "brax", "brax_mjx", "rsl_rl", "skrl", "fast_td3", "flash_sac"]


def train_ours(config: TrainConfig, on_block: OnBlock) -> None:
    """This project's trainer."""
    env = BounceBall(config.env)
    # As the others, and unlike `bounce-mjx train`, it does not use `training_episode_seconds`.
    trainer = PPO(config.ppo, env, config.env.episode_steps)
    iterations = block_iterations(config)
    key = jax.random.PRNGKey(config.seed)
    init = jax.jit(trainer.init, compiler_options=compiler_options(runs_once=True))
    run = jax.jit(
        trainer.run,
        static_argnums=1,
        donate_argnums=0,
        compiler_options=compiler_options(tunes_products=True),
    )
    with concurrent.futures.ThreadPoolExecutor() as pool:
        shapes = jax.eval_shape(init, key)
        lowered_run = run.lower(shapes, iterations)
        compiled_run = pool.submit(lowered_run.compile)
        lowered_init = init.lower(key)
        compiled_init = pool.submit(lowered_init.compile)
        on_block.prepare()
        state = jax.block_until_ready(compiled_init.result()(key))
        run_block = compiled_run.result()
    steps = 0
    ended = False
    while not ended:
        started = time.perf_counter()
        state, _ = jax.block_until_ready(run_block(state))
        seconds = time.perf_counter() - started
        steps += iterations * config.ppo.batch_steps
        # Copied because the next block reuses the state's memory.
        policy = jax.tree.map(jnp.copy, policy_of(state, env.observation_size))
        ended = on_block(steps, seconds, policy)


def train_rsl_rl(config: TrainConfig, on_block: OnBlock) -> None:
    """rsl_rl on the PyTorch adapter."""
    from rsl_rl_learner import RslRlLearner

    learner = RslRlLearner(config.ppo, BounceBall(config.env), config.seed)
    _train_learner(learner, config, on_block)


def train_skrl(config: TrainConfig, on_block: OnBlock) -> None:
    """skrl on the PyTorch adapter."""
    from skrl_learner import SkrlLearner

    learner = SkrlLearner(config.ppo, BounceBall(config.env), config.seed)
    _train_learner(learner, config, on_block)


class Learner(Protocol):
    """PPO of a PyTorch library."""

    def learn(self) -> None:
        """Trains for an iteration."""

    def policy(self) -> Policy:
        """The current policy, without action noise."""


def _train_learner(learner: Learner, config: TrainConfig, on_block: OnBlock) -> None:
    on_block.prepare()
    iterations = block_iterations(config)
    steps = 0
    ended = False
    while not ended:
        started = time.perf_counter()
        for _ in range(iterations):
            learner.learn()
        # Reading the policy waits until the device has computed it.
        policy = jax.block_until_ready(learner.policy())
        seconds = time.perf_counter() - started
        steps += iterations * config.ppo.batch_steps
        ended = on_block(steps, seconds, policy)


def train_brax(physics: Literal["auto", "mjx"], config: TrainConfig, on_block: OnBlock) -> None:
    """brax's PPO with its own wrappers."""
    import brax_trainer

    brax_trainer.train(physics, config, on_block)


def train_fast_td3(config: TrainConfig, on_block: OnBlock) -> None:
    """FastTD3's own script."""
    import fast_td3_trainer

    fast_td3_trainer.train(config, on_block)


def train_flash_sac(config: TrainConfig, on_block: OnBlock) -> None:
    """FlashSAC's own script."""
    import flash_sac_trainer

    flash_sac_trainer.train(config, on_block)


TRAINERS: dict[Method, Callable[[TrainConfig, OnBlock], None]] = {
    "ours": train_ours,
    "brax": functools.partial(train_brax, "auto"),
    "brax_mjx": functools.partial(train_brax, "mjx"),
    "rsl_rl": train_rsl_rl,
    "skrl": train_skrl,
    "fast_td3": train_fast_td3,
    "flash_sac": train_flash_sac,
}
