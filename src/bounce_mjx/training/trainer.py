"""The interface between the job and an algorithm that trains policies."""

import concurrent.futures
from typing import Any, NamedTuple, Protocol

import numpy as np
from jax.sharding import Mesh

from bounce_mjx.learning.policy import Policy
from bounce_mjx.runs.config import TrainConfig

Metrics = dict[str, np.ndarray]

JAX = "jax"
"""Name of this project's own trainer among the libraries."""


class Snapshot(NamedTuple):
    """A moment of a training as pytrees of numpy arrays."""

    policy: Policy
    state: Any
    """Everything that the training goes on from; numbers of up to 32 bits."""


def iterations_per_block(config: TrainConfig) -> int:
    """Iterations I in one block."""
    return max(1, round(config.block_steps / config.ppo.batch_steps))


class Trainer(Protocol):
    """S independent trainings of one algorithm, the seeds of a run.

    With several seeds, every array of a state and of a policy has them as its first axis.
    """

    library: str
    """Name of the implementation; a run goes on with the one that began it."""
    mesh: Mesh
    """The devices."""
    checked: tuple[str, ...]
    """The quantities that may not become infinite or NaN, in the order of their computation."""

    def state_template(self) -> Any:
        """Shapes and types of the state, `jax.ShapeDtypeStruct` as its leaves."""

    def compile(self, pool: concurrent.futures.Executor) -> concurrent.futures.Future:
        """Starts to compile; the future is done once training can start."""

    def start(self, state: Any | None = None) -> None:
        """Starts from the seeds, or from a state of `snapshot`."""

    def run(self) -> Metrics:
        """Trains for a block of I iterations.

        Returns:
          Metrics, each [S, I]. "fault" is the number, from 1, of the first of `checked` that was
          not finite in an iteration, else 0.
        """

    def snapshot(self) -> Snapshot:
        """The policy and the whole state."""
