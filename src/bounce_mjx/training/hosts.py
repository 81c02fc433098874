"""Training on several hosts: one process a host (or a device), of which the first is the leader.

Every process runs the same program on its part of the environments. What the leader alone decides
or reads is told to the others; what all hold parts of is gathered, for the leader to save.
"""

from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Sharding

from bounce_mjx.errors import UserError

Tree = TypeVar("Tree")


def join(
    coordinator_address: str | None = None,
    num_processes: int | None = None,
    process_id: int | None = None,
) -> None:
    """Joins the processes of one training; must come before any other use of JAX.

    Without arguments, Slurm, Open MPI and Kubernetes tell them.

    Raises:
      UserError: only some of the arguments are given and nothing tells the others, or the leader
        cannot be reached.
    """
    given = {
        "--coordinator-address": coordinator_address,
        "--num-processes": num_processes,
        "--process-id": process_id,
    }
    missing = [flag for flag, value in given.items() if value is None]
    if missing and len(missing) < len(given):
        raise UserError(
            f"{', '.join(f for f in given if f not in missing)} needs {', '.join(missing)} as well;"
            " give all three, or only --distributed where Slurm, Open MPI or Kubernetes tell them"
        )
    try:
        jax.distributed.initialize(coordinator_address, num_processes, process_id)
    except (RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(
            f"the processes of this training cannot be joined ({reason}); start one process a host "
            "with --coordinator-address HOST:PORT, --num-processes N and --process-id I"
        ) from error


def is_leader() -> bool:
    """Whether this process writes the run's folder and talks to the user."""
    return jax.process_index() == 0


def any_of(flag: bool) -> bool:
    """Whether the flag is set in any process; all must ask at the same point."""
    if jax.process_count() == 1:
        return flag
    return bool(multihost_utils.process_allgather(np.array(flag)).any())


def text_from_leader(text: str | None) -> str:
    """The leader's text, in every process; the others give None."""
    if jax.process_count() == 1:
        return text
    encoded = np.frombuffer((text or "").encode(), np.uint8)
    length = int(multihost_utils.broadcast_one_to_all(np.int32(len(encoded))))
    padded = encoded if is_leader() else np.zeros(length, np.uint8)
    return bytes(multihost_utils.broadcast_one_to_all(padded)).decode()


def gather(tree: Tree) -> Tree:
    """A pytree of arrays that lie on devices of several hosts, as whole numpy arrays in every
    process."""
    if jax.process_count() == 1:
        return jax.tree.map(np.asarray, tree)
    return multihost_utils.process_allgather(tree, tiled=True)


def distribute(tree: Tree, shardings: Any) -> Tree:
    """Whole arrays, the same in every process, as arrays on the devices."""

    def put(x, sharding: Sharding) -> jax.Array:
        x = np.asarray(x)
        return jax.make_array_from_callback(x.shape, sharding, lambda index: x[index])

    return jax.tree.map(put, tree, shardings)
