"""Training on several hosts, with one process per host (or per device). Process 0 is the leader.

Every process runs the same program on its shard of the environments. Only the leader calls the
callbacks and writes; the others learn what it has decided (`exchange`), and send their shards of
the state (`PPOTrainer`). All of them read: a run that is resumed, or a warm start, lies where each
host finds it.
"""

import contextlib
import itertools
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
from jax._src import distributed
from jax.sharding import Sharding

from bounce_mjx.config.files import flat
from bounce_mjx.errors import UserError, exit_on_user_error, reason_of, shorten
from bounce_mjx.interrupt import in_daemon_thread, leave
from bounce_mjx.runs.config import TrainConfig

Tree = TypeVar("Tree")

# Time for the other processes to print their own sentences: once the leader has ended, JAX aborts
# them at once.
_GRACE_SECONDS = 1.0
# No time limit for a value of another process, ms: longer than any compilation. JAX ends the wait
# for a dead process.
_NO_LIMIT_MS = 10**9

_exchanges = itertools.count()


def join(
    coordinator_address: str | None, num_processes: int | None, process_id: int | None, limit: int
) -> None:
    """Joins the processes of one run; it must be called before any other use of JAX. From now on,
    JAX aborts this process if another one has died.

    Slurm, Open MPI or Kubernetes supply what is None.

    Args:
      limit: time limit of the wait for the other processes, s.

    Raises:
      UserError: an argument is missing and no launcher supplies it, or the processes did not find
        each other in time.
    """

    # Later than our own, as JAX's ends the process with a stack trace.
    limit_of_jax = 2 * limit + 60

    def connect() -> None:
        jax.distributed.initialize(
            coordinator_address, num_processes, process_id, initialization_timeout=limit_of_jax
        )

    try:
        in_daemon_thread(connect).result(limit)
        # Waits for the devices of all hosts.
        jax.devices()
    # One that is late is a TimeoutError without a text.
    except Exception as error:
        raise UserError(
            f"the processes cannot be joined ({reason_of(error)[:200]}); start each with "
            "--coordinator-address, --num-processes and --process-id, or raise --host-timeout"
        ) from error


def check_equal_configs(config: TrainConfig, resume: Path | None) -> None:
    """Compares the configs of all processes.

    Args:
      resume: the run to continue.

    Raises:
      UserError: they differ, and so would the programs and the states of the processes.
    """
    # Only the leader makes the run's folder.
    plain = config.model_dump(mode="json", exclude={"log_dir"})
    plain["resume"] = resume and os.path.abspath(resume)
    first, *others = map(flat, exchange(plain))
    for i, other in enumerate(others, start=1):
        for key in sorted(first.keys() | other.keys()):
            if first.get(key) != other.get(key):
                ours = shorten(json.dumps(first.get(key)))
                theirs = shorten(json.dumps(other.get(key)))
                raise UserError(
                    f"processes 0 and {i} differ in {key}, {ours} and {theirs}; give equal flags"
                )


def exchange(value: Any) -> list[Any]:
    """The values of all processes, by number; every process must call this at the same point. They
    are plain data, and go through JAX's coordination service. An exchange between the devices would
    fail after 30 s, and another process may compile for longer."""
    processes = distributed.global_state
    if processes.client is None:
        return [value]
    number = next(_exchanges)
    own_key = f"bounce_mjx/{number}/{processes.process_id}"
    processes.client.key_value_set(own_key, json.dumps(value))
    values = []
    for i in range(processes.num_processes):
        text = processes.client.blocking_key_value_get(f"bounce_mjx/{number}/{i}", _NO_LIMIT_MS)
        values.append(json.loads(text))
    if number > 0:
        # Every process has set its value of this exchange, and so has read all of the one before.
        processes.client.key_value_delete(f"bounce_mjx/{number - 1}/{processes.process_id}")
    return values


@contextlib.contextmanager
def leave_on_user_error() -> Iterator[None]:
    """As `exit_on_user_error`, within that of the command; but one of several processes leaves
    without JAX's wait for the others at exit, once they have had `_GRACE_SECONDS` for their own
    sentences."""
    try:
        with exit_on_user_error():
            yield
    except SystemExit as error:
        if error.code and jax.distributed.is_initialized():
            time.sleep(_GRACE_SECONDS)
            leave(error.code)
        raise


def is_leader() -> bool:
    """Whether this process writes the run's folder and prints messages for the user."""
    return jax.process_index() == 0


def any_of(flag: bool) -> bool:
    """Whether the flag is set in any process. Every process must call this at the same point; there
    it waits for the others without a time limit."""
    return any(exchange(flag))


def wait_for_all() -> None:
    """Waits until every process has come to this point, see `any_of`."""
    any_of(False)


def distribute(tree: Tree, shardings: Any) -> Tree:
    """Arrays that are whole and equal in every process, as arrays on the devices."""

    def put(x: np.ndarray, sharding: Sharding) -> jax.Array:
        return jax.make_array_from_callback(x.shape, sharding, lambda index: x[index])

    return jax.tree.map(put, jax.tree.map(np.asarray, tree), shardings)
