"""The trainer in JAX: the compiled programs of `ppo.py`, on one or several devices."""

import concurrent.futures
import functools
from collections.abc import Callable

import jax
import numpy as np

from bounce_mjx.env.env import Env
from bounce_mjx.learning.config import find_algorithm
from bounce_mjx.learning.ppo import (
    CHECKED,
    Params,
    TrainingState,
    policy_of,
    population,
    warm_started,
)
from bounce_mjx.learning.statistics import RunningStatistics
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.training import hosts
from bounce_mjx.training.devices import make_mesh, replicated, state_sharding
from bounce_mjx.training.setup import compiler_options
from bounce_mjx.training.trainer import Metrics, Snapshot, iterations_per_block


class PPOTrainer:
    """This project's PPO; see `Trainer`."""

    checked = CHECKED

    def __init__(self, config: TrainConfig, env: Env):
        """
        Raises:
          UserError: the config does not fit the devices or the environment.
        """
        self._config, self._observation_size = config, env.observation_size
        # On MJX, a block may take minutes, and could not be stopped before its end.
        on_mjx = env.engine.name == "mjx"
        self._compiled_iterations = 1 if on_mjx else iterations_per_block(config)
        self.mesh = make_mesh(config.num_devices, config.ppo, config.num_seeds)
        trainer = find_algorithm(config.algorithm)(config.ppo, env, episode_steps(config))
        self._trainer = trainer if config.num_seeds == 1 else population(trainer)
        seeds = config.seed + np.arange(config.num_seeds, dtype=np.uint32)
        self._seeds = seeds[0] if config.num_seeds == 1 else seeds
        self.state: TrainingState | None = None
        """The current state, on the devices."""

        def initial_state(seeds: jax.Array) -> TrainingState:
            """The first training state of one seed [] or of S seeds [S]."""
            key = jax.random.PRNGKey
            return self._trainer.init((jax.vmap(key) if seeds.ndim else key)(seeds))

        def train_block(state: TrainingState) -> tuple[TrainingState, Metrics]:
            return self._trainer.run(state, self._compiled_iterations)

        # One object each, not methods, so that JAX traces them only once.
        self._initial_state, self._train_block = initial_state, train_block

    @functools.cached_property
    def _shapes(self) -> TrainingState:
        return jax.eval_shape(self._initial_state, self._seeds)

    @property
    def _sharding(self) -> TrainingState:
        return state_sharding(self.mesh, self._shapes, self._config.num_seeds)

    def state_template(self) -> TrainingState:
        return self._shapes

    def compile(self, pool: concurrent.futures.Executor) -> concurrent.futures.Future:
        run = jax.jit(
            self._train_block,
            in_shardings=(self._sharding,),
            out_shardings=(self._sharding, replicated(self.mesh)),
            donate_argnums=0,
            compiler_options=compiler_options(tunes_products=True),
        )
        self._run = pool.submit(run.lower(self._shapes).compile)
        init = jax.jit(
            self._initial_state,
            out_shardings=self._sharding,
            compiler_options=compiler_options(runs_once=True),
        )
        self._init = pool.submit(init.lower(self._seeds).compile)
        return self._run

    def start(self, state: TrainingState | None = None) -> None:
        if state is None:
            self.state = jax.block_until_ready(self._init.result()(self._seeds))
        else:
            self.state = hosts.distribute(state, self._sharding)

    def warm_start(self, params: Params, statistics: RunningStatistics) -> None:
        self.start(warm_started(self.snapshot().state, params, statistics))

    def run(self, iterations: int, stopping: Callable[[], bool]) -> Metrics:
        program, parts = self._run.result(), []
        for _ in range(iterations // self._compiled_iterations):
            self.state, metrics = program(self.state)
            shape = (self._config.num_seeds, -1)
            parts.append({name: np.asarray(x).reshape(shape) for name, x in metrics.items()})
            if stopping():
                break
        return {name: np.concatenate([part[name] for part in parts], 1) for name in parts[0]}

    def snapshot(self) -> Snapshot:
        state = hosts.gather(self.state)
        seeds = [state]
        if self._config.num_seeds > 1:
            count = range(self._config.num_seeds)
            seeds = [jax.tree.map(lambda x, i=i: x[i], state) for i in count]
        return Snapshot(
            [policy_of(seed, self._observation_size) for seed in seeds],
            state,
            [{"params": seed.params, "statistics": seed.statistics} for seed in seeds],
        )


def episode_steps(config: TrainConfig) -> int:
    """Control steps after which the training truncates an episode."""
    limit = config.ppo.training_episode_seconds
    if limit is None:
        return config.env.episode_steps
    return min(config.env.episode_steps, max(1, round(limit / config.env.control_dt)))
