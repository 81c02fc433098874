"""What each trainer of `trainers.py` is given, and what several of them use."""

import sys
from pathlib import Path
from typing import Any, Protocol

from bounce_mjx.errors import UserError
from bounce_mjx.learning.policy import Actor, Policy
from bounce_mjx.runs.config import TrainConfig


class TrainingEnded(Exception):
    """Ends the training of a library that offers no other way to stop."""


class OnBlock(Protocol):
    """Callbacks of a trainer."""

    def prepare(self, actor: Actor | None = None, policy: Any = None) -> None:
        """Called once before the first block: starts to compile the evaluation, in a thread. Ours
        calls it after its own tracing; the tracing of brax, and the setup of the others, share
        Python's lock with that of the evaluation.

        Args:
          actor: what acts with the policies of the blocks; None for this project's networks.
          policy: a policy of that actor.
        """

    def __call__(self, steps: int, seconds: float, policy: Policy | Any) -> bool:
        """Called after every block; returns whether the training may end."""


def use_source(folder: Path) -> None:
    """Makes the modules of a cloned repository importable.

    Raises:
      UserError: it was not cloned.
    """
    if not folder.is_dir():
        raise UserError(f"{folder} is missing; clone it as the head of its trainer says")
    sys.path.insert(0, str(folder))


def block_iterations(config: TrainConfig) -> int:
    """Iterations between two evaluations."""
    return max(1, round(config.eval_every / config.ppo.batch_steps))
