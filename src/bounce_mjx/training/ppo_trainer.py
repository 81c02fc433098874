"""The trainer of PPO and its subclasses: the compiled programs of `learning/ppo.py`, on one or
several devices.

The program is the same on any number of devices: arrays over the environments are sharded along
their batch axis, all other arrays are replicated, and XLA adds the reductions of gradients and
statistics. With several seeds each device holds some of them.
"""

import concurrent.futures
import functools
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.learning import ppo
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.registry import find_algorithm
from bounce_mjx.learning.statistics import RunningStatistics
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.training import hosts
from bounce_mjx.training.setup import compiler_options
from bounce_mjx.training.trainer import BlockMetrics, Snapshot, each_seed

_AXIS = "devices"


class PPOTrainer:
    """The `Trainer` that runs an algorithm's programs: PPO, or a subclass of it."""

    checked = ppo.CHECKED

    def __init__(self, config: TrainConfig, env: Env):
        """
        Raises:
          UserError: the config does not fit the devices or the environment.
        """
        self._config = config
        self._observation_size = env.observation_size
        self.mesh = make_mesh(config.num_devices, config.ppo, config.num_seeds)
        """The devices on which it trains."""
        algorithm = find_algorithm(config.algorithm)(config.ppo, env, config.training_episode_steps)
        init = algorithm.init
        run = algorithm.run
        make_key = jax.random.PRNGKey
        self._seeds = np.uint32(config.seed)
        if config.num_seeds > 1:
            init, run = ppo.population(algorithm)
            make_key = jax.vmap(make_key)
            self._seeds = config.seed + np.arange(config.num_seeds, dtype=np.uint32)
        self.state: ppo.TrainingState | None = None
        """The current state, on the devices."""

        def initial_state(seeds: jax.Array) -> ppo.TrainingState:
            """The first training state of one seed [] or of S seeds [S]."""
            return init(make_key(seeds))

        def train_block(state: ppo.TrainingState) -> tuple[ppo.TrainingState, ppo.Metrics]:
            return run(state, config.iterations_per_block)

        # One object each, not methods, so that JAX traces them only once.
        self._initial_state = initial_state
        self._train_block = train_block

    @functools.cached_property
    def state_template(self) -> ppo.TrainingState:
        """Shapes and types of the state, `jax.ShapeDtypeStruct` as its leaves."""
        return jax.eval_shape(self._initial_state, self._seeds)

    @functools.cached_property
    def _sharding(self) -> ppo.TrainingState:
        """Of the state. With several seeds each device holds some of them; with one seed each
        device holds some environments and everything else."""

        def shard(x: jax.Array, *axes: str | None) -> NamedSharding:
            return NamedSharding(self.mesh, PartitionSpec(*axes))

        state = self.state_template
        if self._config.num_seeds > 1:
            return jax.tree.map(lambda x: shard(x, _AXIS), state)
        # The environments are the last axis of each array (`env.vector`).
        env = jax.tree.map(lambda x: shard(x, *[None] * (x.ndim - 1), _AXIS), state.env)
        return jax.tree.map(shard, state)._replace(env=env)

    def compile(self, pool: concurrent.futures.Executor) -> concurrent.futures.Future:
        """Starts the compilation in a pool; the future is that of a block's program, and `start`
        waits for that of the initial state, which a resumed training does not need."""
        run = jax.jit(
            self._train_block,
            in_shardings=(self._sharding,),
            out_shardings=(self._sharding, NamedSharding(self.mesh, PartitionSpec())),
            donate_argnums=0,
            compiler_options=compiler_options(tunes_products=True),
        )
        self._run_program = pool.submit(run.lower(self.state_template).compile)
        options = compiler_options(runs_once=True)
        init = jax.jit(self._initial_state, out_shardings=self._sharding, compiler_options=options)
        self._init_program = pool.submit(init.lower(self._seeds).compile)
        return self._run_program

    def start(
        self, state: Any = None, networks: tuple[ppo.Params, RunningStatistics] | None = None
    ) -> None:
        """Starts from the seeds, or from the state of a `snapshot`.

        Args:
          networks: those of an earlier training, which each seed starts with, and the statistics of
            their inputs; not with a state.
        """
        if state is not None:
            self.state = hosts.distribute(state, self._sharding)
            return
        self.state = jax.block_until_ready(self._init_program.result()(self._seeds))
        if networks is not None:
            initial = multihost_utils.process_allgather(self.state, tiled=True)
            params, statistics = jax.tree.map(
                lambda old, new: np.broadcast_to(new, old.shape),
                (initial.params, initial.statistics),
                networks,
            )
            warm = initial._replace(params=params, statistics=statistics)
            self.state = hosts.distribute(warm, self._sharding)

    def train_block(self) -> BlockMetrics:
        """Trains for a block of I iterations.

        Returns:
          Metrics, each [S, I]. "fault" is the number, from 1, of the first quantity of `checked`
          that was not finite in an iteration; 0 if all were finite.
        """
        self.state, metrics = self._run_program.result()(self.state)
        shape = (self._config.num_seeds, -1)
        return {name: np.asarray(x).reshape(shape) for name, x in metrics.items()}

    def snapshot(self) -> Snapshot:
        """The policies and the whole state, in every process."""
        state = multihost_utils.process_allgather(self.state, tiled=True)
        seeds = each_seed(state, self._config.num_seeds)
        policies = [ppo.policy_of(seed, self._observation_size) for seed in seeds]
        networks = [{"params": seed.params, "statistics": seed.statistics} for seed in seeds]
        return Snapshot(policies, state, networks)


def make_mesh(num_devices: int | None, config: PPOConfig, num_seeds: int = 1) -> Mesh:
    """A mesh of the first `num_devices` devices.

    Args:
      num_devices: number of devices; None means one, or all devices if there are several hosts.

    Raises:
      UserError: there are fewer devices, or the environments (one seed) or the seeds (several)
        cannot be divided among them, or a device of some host would be unused.
    """
    devices = jax.devices()
    if num_devices is None:
        num_devices = 1 if jax.process_count() == 1 else len(devices)
    if num_devices > len(devices):
        raise UserError(
            f"num_devices is {num_devices}, but the number of devices here is {len(devices)}; give "
            f"--num-devices {len(devices)}"
        )
    if jax.process_count() > 1 and num_devices < len(devices):
        raise UserError(f"num_devices is {num_devices}, but the hosts have {len(devices)}; omit it")
    if num_seeds > 1:
        if num_seeds % num_devices:
            raise UserError(
                f"num_seeds {num_seeds} cannot be divided among {num_devices} devices; choose a "
                f"multiple of {num_devices}"
            )
    else:
        groups = ppo.num_groups(config)
        if groups % num_devices:
            raise UserError(
                f"num_envs {config.num_envs} with num_minibatches {config.num_minibatches} makes "
                f"{groups} groups of environments, which cannot be divided among {num_devices} "
                f"devices; choose a power of two as num_envs, and a divisor of {groups} as "
                "num_devices"
            )
    return Mesh(devices[:num_devices], (_AXIS,))
