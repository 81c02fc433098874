"""The compiled programs of a training, of one seed or several, on one device or several."""

import concurrent.futures
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh

from bounce_mjx.evaluation.episodes import make_evaluator, make_recording_evaluator
from bounce_mjx.evaluation.recording import RECORDED_EPISODES
from bounce_mjx.evaluation.results import Report, judge
from bounce_mjx.learning.policy import make_networks
from bounce_mjx.learning.ppo import Trainer, TrainingState, policy_of
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.task.env import BounceBall
from bounce_mjx.training.devices import replicated, state_sharding
from bounce_mjx.training.setup import compiler_options

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


def initial_shapes(config: TrainConfig, trainer: Trainer) -> TrainingState:
    """Shapes of the training's state (`jax.eval_shape`)."""
    return jax.eval_shape(functools.partial(_initial_state, trainer), _seeds(config))


def _initial_state(trainer: Trainer, seeds: jax.Array) -> TrainingState:
    """State at the start of the training of a seed [], or of those of several [S]."""
    key = jax.random.PRNGKey
    return trainer.init((jax.vmap(key) if seeds.ndim else key)(seeds))


def _seeds(config: TrainConfig) -> np.ndarray:
    """The seed [], or several [S], of a training each."""
    seeds = config.seed + np.arange(config.num_seeds, dtype=np.uint32)
    return seeds[0] if config.num_seeds == 1 else seeds


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
    seeds, shapes = _seeds(config), initial_shapes(config, trainer)
    sharding, everywhere = state_sharding(mesh, shapes, config.num_seeds), replicated(mesh)

    init = jax.jit(functools.partial(_initial_state, trainer), out_shardings=sharding)
    run = jax.jit(
        lambda state: trainer.run(state, num_iterations(config)),
        in_shardings=(sharding,),
        out_shardings=(sharding, everywhere),
        donate_argnums=0,
        compiler_options=compiler_options(),
    )
    compiled_run = pool.submit(run.lower(shapes).compile)
    compiled_init = pool.submit(init.lower(seeds).compile)
    beside()

    networks = make_networks(config.ppo, env.observation_size, env.action_size)

    def compile_evaluator(episodes: int, stream: int):
        if config.num_seeds == 1:
            evaluate = make_recording_evaluator(env, networks, episodes, RECORDED_EPISODES)
        else:
            # Without recordings, which a batched loop would copy at every step.
            without = jax.vmap(make_evaluator(env, networks, episodes), in_axes=(0, None))
            evaluate = lambda policy, key: (without(policy, key), None)  # noqa: E731
        program = jax.jit(
            lambda state, seed: evaluate(
                policy_of(state), jax.random.split(jax.random.PRNGKey(seed))[stream]
            ),
            in_shardings=(sharding, everywhere),
            out_shardings=everywhere,
            compiler_options=compiler_options(),
        )
        return program.lower(shapes, eval_seed).compile()

    # Keys are made inside the programs: each operation outside takes JAX a tenth of a second.
    eval_seed = np.uint32(config.eval_seed)
    evaluator = pool.submit(compile_evaluator, config.eval_episodes, 0)
    screening = (
        pool.submit(compile_evaluator, config.screening_episodes, 1)
        if config.screening_episodes
        else None
    )

    def measure(program: concurrent.futures.Future, state: TrainingState) -> list[Report]:
        statistics, recording = program.result()(state, eval_seed)
        if config.num_seeds == 1:
            return [judge(env, statistics)._replace(recording=recording)]
        statistics = jax.device_get(statistics)
        return [
            judge(env, jax.tree.map(lambda x, i=i: x[i], statistics))
            for i in range(config.num_seeds)
        ]

    def evaluate(state: TrainingState) -> list[Report]:
        if screening is not None:
            screened = measure(screening, state)
            if not any(report.passed for report in screened):
                return screened
        return measure(evaluator, state)

    def run_block(state: TrainingState) -> tuple[TrainingState, Metrics]:
        state, metrics = compiled_run.result()(state)
        many = (config.num_seeds, -1)
        return state, {name: np.asarray(value).reshape(many) for name, value in metrics.items()}

    compiled_run.result()
    return Programs(lambda: compiled_init.result()(seeds), run_block, evaluate)
