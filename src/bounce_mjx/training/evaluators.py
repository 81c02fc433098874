"""The compiled evaluations of a training's policies."""

import concurrent.futures
import dataclasses
import os
from collections.abc import Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from bounce_mjx.env.env import Env
from bounce_mjx.evaluation.episodes import run_episodes
from bounce_mjx.evaluation.results import Report, judge
from bounce_mjx.evaluation.statistics import RECORDED_EPISODES, Measured
from bounce_mjx.learning.policy import Policy, make_networks
from bounce_mjx.runs.checkpoints import policy_shapes
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.progress import Progress
from bounce_mjx.training import hosts
from bounce_mjx.training.setup import compiler_options
from bounce_mjx.training.trainer import each_seed

Tree = TypeVar("Tree")
Chunk = Measured
"""Statistics and recording of some episodes of an evaluation, with several seeds of each [S, ...],
the episodes last."""

# Added to the seed of the selecting evaluations to get the seed of the final one, which no config
# can contain.
_FINAL = 2**31


class Evaluators:
    """The program that evaluates the S policies of a training run, compiled in the background.

    Training selects its best policy by evaluations that all use the same resets. The figures of
    the selected policy are then measured once more on fresh resets, because the best of many
    evaluations on the same resets is biased upwards.

    With a screening, an evaluation begins with as many episodes as the screening has, and doubles
    them as long as a policy may be the best of its seed. The program runs those of the screening,
    and a full evaluation runs it several times: it is then the only evaluation to be compiled.
    """

    def __init__(
        self, config: TrainConfig, env: Env, mesh: Mesh, pool: concurrent.futures.Executor
    ):
        """Starts the compilation in a pool."""
        self._config = config
        self._env = env
        axes = mesh.axis_names if config.num_seeds > 1 else ()
        self._sharding = NamedSharding(mesh, PartitionSpec(*axes))
        self._replicated = NamedSharding(mesh, PartitionSpec())
        self._chunk = min(config.screening_episodes or config.eval_episodes, config.eval_episodes)
        # On a CPU a chunk uses one core, and XLA runs the programs that one thread starts one after
        # another, so each core has a thread. MJX has one: it calls LAPACK, and in jaxlib two
        # batched calls of it may wait for each other for ever.
        on_cpu = mesh.size == 1 and mesh.devices.flat[0].platform == "cpu"
        self._threads = os.cpu_count() if on_cpu and env.engine.name == "fused" else 1
        self._program = pool.submit(self._lower().compile)

    def wait(self) -> None:
        """Waits until the program is compiled."""
        self._program.result()

    def select(self, policies: Sequence[Policy], progresses: Sequence[Progress]) -> list[Report]:
        """A report of each policy: of a full evaluation, or of its first episodes, as a
        `Report.screening`, where these say that no policy may be the best of its seed.

        Args:
          progresses: what each seed has reached so far.
        """
        full = self._config.eval_episodes
        chunks: list[Chunk] = []
        episodes = self._chunk
        while True:
            chunks += self._run(policies, self._config.eval_seed, len(chunks), episodes)
            reports = self._judge(chunks, episodes)
            if episodes == full:
                return reports
            pairs = zip(progresses, reports, strict=True)
            if not any(progress.may_be_best(report) for progress, report in pairs):
                return [dataclasses.replace(report, screening=True) for report in reports]
            episodes = min(2 * episodes, full)

    def final(self, policies: Sequence[Policy]) -> list[Report]:
        """A full report of each policy, on resets that no selection has seen."""
        seed = self._config.eval_seed + _FINAL
        episodes = self._config.eval_episodes
        return self._judge(self._run(policies, seed, 0, episodes), episodes)

    def _lower(self) -> jax.stages.Lowered:
        """The program (policy, seed, index of the first episode) -> statistics and recording of a
        chunk of episodes."""
        config = self._config
        env = self._env
        networks = make_networks(config.ppo, env.observation_size, env.action_size)
        # No recordings of several seeds, because a batched loop would copy them at every step.
        recorded = RECORDED_EPISODES if config.num_seeds == 1 else 0

        def run(policy: Policy, keys: jax.Array):
            states = jax.vmap(env.reset, out_axes=-1)(keys)
            return run_episodes(env, networks, policy, states, recorded)

        several = config.num_seeds > 1
        run_all = jax.vmap(run, in_axes=(0, None)) if several else run

        def evaluate(policy: Policy, seed: jax.Array, first: jax.Array):
            # Keys are made inside the program: outside it, each operation would take a tenth of a
            # second. The last chunk may reach beyond the last episode.
            keys = jax.random.split(jax.random.PRNGKey(seed), config.eval_episodes)
            return run_all(policy, jnp.take(keys, first + jnp.arange(self._chunk), 0, mode="clip"))

        program = jax.jit(
            evaluate,
            in_shardings=(self._sharding, self._replicated, self._replicated),
            out_shardings=self._replicated,
            compiler_options=compiler_options(),
        )
        seeds = (config.num_seeds,) if several else ()
        shapes = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct((*seeds, *x.shape), x.dtype), policy_shapes(config)
        )
        return program.lower(shapes, np.uint32(0), np.int32(0))

    def _run(self, policies: Sequence[Policy], seed: int, ready: int, episodes: int) -> list[Chunk]:
        """Simulates the chunks of an evaluation that are still missing.

        Args:
          ready: number of chunks that are there.
          episodes: number of episodes that all chunks together have at least.
        """
        program = self._program.result()
        policy = policies[0]
        if self._config.num_seeds > 1:
            policy = jax.tree.map(lambda *leaves: np.stack(leaves), *policies)
        on_devices = hosts.distribute(policy, jax.tree.map(lambda _: self._sharding, policy))

        def evaluate(start: int) -> Chunk:
            chunk = program(on_devices, np.uint32(seed), np.int32(start))
            # Otherwise one thread would start all of them at once.
            return jax.block_until_ready(chunk)

        with concurrent.futures.ThreadPoolExecutor(self._threads) as pool:
            return list(pool.map(evaluate, range(ready * self._chunk, episodes, self._chunk)))

    def _judge(self, chunks: Sequence[Chunk], episodes: int) -> list[Report]:
        """A report of each policy from the first episodes of an evaluation."""
        seeds = self._config.num_seeds
        parts, recordings = zip(*chunks, strict=True)
        recording = None
        if seeds == 1:
            recorded = min(RECORDED_EPISODES, episodes)
            recording = _joined(recordings[: -(-recorded // self._chunk)], recorded)
        statistics = _joined(parts, episodes)
        return [judge(self._env, each, recording) for each in each_seed(statistics, seeds)]


def _joined(chunks: Sequence[Tree], episodes: int) -> Tree:
    """The first episodes of all chunks as NumPy arrays; the episodes are the last axis."""
    parts = jax.device_get(chunks)
    return jax.tree.map(lambda *x: np.concatenate(x, axis=-1)[..., :episodes], *parts)
