"""The interface between the job and an algorithm that trains policies."""

import concurrent.futures
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np
from jax.sharding import Mesh

from bounce_mjx.learning.policy import Policy
from bounce_mjx.learning.ppo import Params
from bounce_mjx.learning.statistics import RunningStatistics
from bounce_mjx.runs.config import TrainConfig

Metrics = dict[str, np.ndarray]


class Snapshot(NamedTuple):
    """The policies and the state of a training run at one moment, as pytrees of NumPy arrays."""

    policies: list[Policy]
    """The policy of each seed."""
    state: Any
    """Everything that is needed to continue the training; numbers of at most 32 bits."""
    networks: list[dict[str, Any]] | None = None
    """What another training can start with, for each seed: "params" and "statistics" of both
    networks."""


def iterations_per_block(config: TrainConfig) -> int:
    """Iterations I in one block."""
    return max(1, round(config.block_steps / config.ppo.batch_steps))


def in_whole_blocks(config: TrainConfig) -> TrainConfig:
    """The config with the `total_steps` that are trained: the nearest number of whole blocks."""
    block = iterations_per_block(config) * config.ppo.batch_steps
    return config.model_copy(
        update={"total_steps": block * max(1, round(config.total_steps / block))}
    )


def each_seed(tree: Any, num_seeds: int) -> list[Any]:
    """The trees of S seeds from one whose arrays are [S, ...]; with one seed, the tree itself."""
    if num_seeds == 1:
        return [tree]
    return [jax.tree.map(lambda x, i=i: x[i], tree) for i in range(num_seeds)]


class Trainer(Protocol):
    """S independent runs of one algorithm, one for each seed."""

    mesh: Mesh
    """The devices on which it trains."""
    checked: tuple[str, ...]
    """The quantities that must stay finite, in the order of their computation."""

    state_template: Any
    """Shapes and types of the state, `jax.ShapeDtypeStruct` as its leaves."""

    def compile(self, pool: concurrent.futures.Executor) -> concurrent.futures.Future:
        """Starts the compilation in a pool; the future is done when training can start."""

    def start(
        self, state: Any = None, networks: tuple[Params, RunningStatistics] | None = None
    ) -> None:
        """Starts from the seeds, or from the state of a `snapshot`.

        Args:
          networks: those of an earlier training, which each seed starts with, and the statistics of
            their inputs.
        """

    def run(self) -> Metrics:
        """Trains for a block of I iterations.

        Returns:
          Metrics, each [S, I]. "fault" is the number, from 1, of the first quantity of `checked`
          that was not finite in an iteration; 0 if all were finite.
        """

    def snapshot(self) -> Snapshot:
        """The policies and the whole state."""
