"""What the training job asks of a trainer."""

import concurrent.futures
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np
from jax.sharding import Mesh

from bounce_mjx.learning.policy import Policy

BlockMetrics = dict[str, np.ndarray]
"""Metrics of a block of I iterations of S seeds, each [S, I], by name."""


class Snapshot(NamedTuple):
    """The policies and the state of a training run at one moment, as pytrees of NumPy arrays."""

    policies: list[Policy]
    """The policy of each seed."""
    state: Any
    """Everything that is needed to continue the training; numbers of at most 32 bits."""
    networks: list[dict[str, Any]] | None = None
    """What another training can start with, for each seed: "params" and "statistics" of both
    networks; None for an algorithm without these two, such as SAC."""


class Trainer(Protocol):
    """S independent runs of one algorithm, one for each seed. Their policies are
    `learning.policy.Policy`, with parameters as `make_networks(ppo, ...).policy_network.init` gives
    them: evaluations and every command act with the network that the config's `ppo` describes.
    `adapters.torch.policy.to_policy(...).policy` is one of PyTorch's layers.

    The job asks the algorithm for one (`learning.algorithm.Algorithm.make_trainer`). Then it calls
    `compile` and `start`, once each, and `train_block` for each block. It may ask for
    `state_template` at any time, and after `start` for a `snapshot`. `PPOTrainer` is one. The job
    calls `compile` and `train_block` in another thread than the rest, one call after another.
    """

    checked: Sequence[str]
    """The quantities that must stay finite, in the order of their computation."""
    mesh: Mesh
    """The devices on which it trains."""

    @property
    def state_template(self) -> Any:
        """Shapes and types of the state, `jax.ShapeDtypeStruct` as its leaves."""

    def compile(self, pool: concurrent.futures.Executor) -> concurrent.futures.Future:
        """Starts the compilation in a pool; the future is that of a block's program, and `start`
        waits for any other."""

    def start(self, state: Any = None, networks: Any = None) -> None:
        """Starts from the seeds, or from the state of a `snapshot`.

        Args:
          networks: those of an earlier training, which each seed starts with, and the statistics of
            their inputs (`checkpoints.read_warm_start`); not with a state. Always None for an
            algorithm that does not make PPO's networks, to which a warm start is refused.
        """

    def train_block(self) -> BlockMetrics:
        """Trains for a block of I iterations (`TrainConfig.iterations_per_block`), each of
        `ppo.batch_steps` environment steps.

        Returns:
          Metrics, each [S, I]. The job needs three: "fault", the number, from 1, of the first
          quantity of `checked` that was not finite in an iteration, and 0 if all were finite;
          "episode/ended", how many episodes ended; "task/non_finite", how many of them because the
          physics was not finite. Others are for the log, and used where they are there:
          "episode/return" is said after each block; of the first block, each "reward/..." and
          "task/too_fast" tell settings in a wrong unit (`faults.why_unlearnable`).
        """

    def snapshot(self) -> Snapshot:
        """The policies and the whole state, in every process."""


def each_seed(tree: Any, num_seeds: int) -> list[Any]:
    """The trees of S seeds from one whose arrays are [S, ...]; with one seed, the one tree."""
    if num_seeds == 1:
        return [tree]
    return [jax.tree.map(lambda x, i=i: x[i], tree) for i in range(num_seeds)]
