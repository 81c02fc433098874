"""The compiled programs of a training, of one seed or several, on one device or several."""

import concurrent.futures
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh

from bounce_mjx.config import TrainConfig
from bounce_mjx.devices import compiler_options, replicated, state_sharding
from bounce_mjx.env import BounceBall
from bounce_mjx.evaluation import Report, judge, make_evaluator, make_recording_evaluator
from bounce_mjx.policy import make_networks
from bounce_mjx.ppo import Trainer, TrainingState, policy_of
from bounce_mjx.recording import RECORDED_EPISODES

Metrics = dict[str, np.ndarray]


class Programs(NamedTuple):
    """What a training runs. With several seeds, the arrays of a state have them as first axis."""

    init: Callable[[], TrainingState]
    run: Callable[[TrainingState], tuple[TrainingState, Metrics]]
    """A block of I iterations; metrics are [seeds, I]."""
    evaluate: Callable[[TrainingState], list[Report]]
    """A report of each seed."""


def num_iterations(config: TrainConfig) -> int:
    """Iterations in one block."""
    return max(1, round(config.block_steps / config.ppo.batch_steps))


def initial_key(config: TrainConfig) -> np.ndarray:
    """Key of a training [2]; of several seeds [seeds, 2], each that of a training of its own."""
    seeds = config.seed + np.arange(config.num_seeds)
    keys = np.stack([jax.random.PRNGKey(seed) for seed in seeds])
    return keys[0] if config.num_seeds == 1 else keys


def compile_programs(
    config: TrainConfig,
    env: BounceBall,
    trainer: Trainer,
    mesh: Mesh,
    pool: concurrent.futures.Executor,
    beside: Callable[[], None] = lambda: None,
) -> Programs:
    """Compiles the programs side by side, as each takes seconds; returns once the training can
    start. The longest goes first: Python traces one program at a time, while XLA compiles others.

    Args:
      trainer: of one seed, or of the population of several.
      beside: called when the training is traced, to start what may go on beside its compilation.
    """
    key = initial_key(config)
    shapes = jax.eval_shape(trainer.init, key)
    sharding, everywhere = state_sharding(mesh, shapes, config.num_seeds), replicated(mesh)

    init = jax.jit(trainer.init, out_shardings=sharding)
    run = jax.jit(
        lambda state: trainer.run(state, num_iterations(config)),
        in_shardings=(sharding,),
        out_shardings=(sharding, everywhere),
        donate_argnums=0,
        compiler_options=compiler_options(),
    )
    compiled_run = pool.submit(run.lower(shapes).compile)
    compiled_init = pool.submit(init.lower(key).compile)
    beside()

    networks = make_networks(config.ppo, env.observation_size, env.action_size)

    def compile_evaluator(episodes: int):
        if config.num_seeds == 1:
            evaluate = make_recording_evaluator(env, networks, episodes, RECORDED_EPISODES)
        else:
            # Without recordings, which a batched loop would copy at every step.
            without = jax.vmap(make_evaluator(env, networks, episodes), in_axes=(0, None))
            evaluate = lambda policy, key: (without(policy, key), None)  # noqa: E731
        program = jax.jit(
            lambda state, key: evaluate(policy_of(state), key),
            in_shardings=(sharding, everywhere),
            out_shardings=everywhere,
            compiler_options=compiler_options(),
        )
        return program.lower(shapes, key_shape).compile()

    key_shape = jax.ShapeDtypeStruct((2,), np.uint32)
    evaluator = pool.submit(compile_evaluator, config.eval_episodes)
    screening = (
        pool.submit(compile_evaluator, config.screening_episodes)
        if config.screening_episodes
        else None
    )
    eval_key, screening_key = np.asarray(jax.random.split(jax.random.PRNGKey(config.eval_seed)))

    def measure(
        program: concurrent.futures.Future, state: TrainingState, key: np.ndarray
    ) -> list[Report]:
        statistics, recording = program.result()(state, key)
        if config.num_seeds == 1:
            return [judge(env, statistics)._replace(recording=recording)]
        statistics = jax.device_get(statistics)
        return [
            judge(env, jax.tree.map(lambda x, i=i: x[i], statistics))
            for i in range(config.num_seeds)
        ]

    def evaluate(state: TrainingState) -> list[Report]:
        if screening is not None:
            screened = measure(screening, state, screening_key)
            if not any(report.passed for report in screened):
                return screened
        return measure(evaluator, state, eval_key)

    def run_block(state: TrainingState) -> tuple[TrainingState, Metrics]:
        state, metrics = compiled_run.result()(state)
        many = (config.num_seeds, -1)
        return state, {name: np.asarray(value).reshape(many) for name, value in metrics.items()}

    compiled_run.result()
    return Programs(lambda: compiled_init.result()(key), run_block, evaluate)
