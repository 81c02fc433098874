"""The compiled evaluations of a training's policies."""

import concurrent.futures
import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from bounce_mjx.evaluation.episodes import make_evaluator, make_recording_evaluator
from bounce_mjx.evaluation.recording import RECORDED_EPISODES
from bounce_mjx.evaluation.results import Report, judge
from bounce_mjx.learning.policy import Policy, make_networks
from bounce_mjx.learning.statistics import init_normalizer
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.task.env import BounceBall
from bounce_mjx.training import hosts
from bounce_mjx.training.setup import compiler_options

# Added to the seed of the selecting evaluations to get the seed of the final one, which no config
# can contain.
_FINAL = 2**31


class Evaluators:
    """The programs that evaluate the S policies of a training, compiled in the background.

    A training selects its best policy by evaluations that all use the same resets. The figures of
    the selected policy are then measured once more on fresh resets, because the best of many
    evaluations on the same resets is biased upwards.
    """

    def __init__(
        self,
        config: TrainConfig,
        env: BounceBall,
        mesh: Mesh,
        pool: concurrent.futures.Executor,
    ):
        """Starts the compilation."""
        self._config, self._env = config, env
        axes = mesh.axis_names if config.num_seeds > 1 else ()
        self._sharding = NamedSharding(mesh, PartitionSpec(*axes))
        self._replicated = NamedSharding(mesh, PartitionSpec())
        self._full = pool.submit(self._compile, config.eval_episodes, 0)
        self._screening = (
            pool.submit(self._compile, config.screening_episodes, 1)
            if config.screening_episodes
            else None
        )

    def wait(self) -> None:
        """Waits until all programs are compiled."""
        for program in filter(None, (self._full, self._screening)):
            program.result()

    def select(self, policy: Policy) -> list[Report]:
        """A report of each policy; if no policy passes the screening, the reports of the
        screening."""
        if self._screening is not None:
            screened = self._measure(self._screening, policy, self._config.eval_seed)
            if not any(report.passed for report in screened):
                return [dataclasses.replace(report, screening=True) for report in screened]
        return self._measure(self._full, policy, self._config.eval_seed)

    def final(self, policy: Policy) -> list[Report]:
        """A full report of each policy, on resets that no selection has seen."""
        return self._measure(self._full, policy, self._config.eval_seed + _FINAL)

    def _compile(self, episodes: int, stream: int) -> Callable[[Policy, np.uint32], Any]:
        config, env = self._config, self._env
        networks = make_networks(config.ppo, env.observation_size, env.action_size)
        if config.num_seeds == 1:
            evaluate = make_recording_evaluator(env, networks, episodes, RECORDED_EPISODES)
        else:
            # No recordings, because a batched loop would copy them at every step.
            evaluate_all = jax.vmap(make_evaluator(env, networks, episodes), in_axes=(0, None))
            evaluate = lambda policy, key: (evaluate_all(policy, key), None)  # noqa: E731
        # Keys are made inside the program: outside it, each operation would take a tenth of a
        # second.
        program = jax.jit(
            lambda policy, seed: evaluate(
                policy, jax.random.split(jax.random.PRNGKey(seed))[stream]
            ),
            in_shardings=(self._sharding, self._replicated),
            out_shardings=self._replicated,
            compiler_options=compiler_options(),
        )
        return program.lower(policy_shapes(config, env), np.uint32(0)).compile()

    def _measure(
        self, program: concurrent.futures.Future, policy: Policy, seed: int
    ) -> list[Report]:
        shardings = jax.tree.map(lambda _: self._sharding, policy)
        on_devices = hosts.distribute(policy, shardings)
        statistics, recording = program.result()(on_devices, np.uint32(seed))
        if self._config.num_seeds == 1:
            return [dataclasses.replace(judge(self._env, statistics), recording=recording)]
        statistics = jax.device_get(statistics)
        return [
            judge(self._env, jax.tree.map(lambda x, i=i: x[i], statistics))
            for i in range(self._config.num_seeds)
        ]


def policy_shapes(config: TrainConfig, env: BounceBall) -> Policy:
    """Shapes of a training's policy; with several seeds, the seeds are the first axis."""
    networks = make_networks(config.ppo, env.observation_size, env.action_size)
    shapes = jax.eval_shape(
        lambda: Policy(
            init_normalizer(env.observation_size),
            networks.policy_network.init(jax.random.PRNGKey(0)),
        )
    )
    seeds = (config.num_seeds,) if config.num_seeds > 1 else ()
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((*seeds, *x.shape), x.dtype), shapes)
