"""Training on several hosts, with one process per host (or per device). Process 0 is the leader.

Every process runs the same program on its shard of the environments. Only the leader decides, reads
and writes; the others receive its decisions (`exchange`) and send their shards of the state
(`gather`).
"""

import atexit
import concurrent.futures
import contextlib
import ctypes
import json
import os
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import jax
import numpy as np
from jax._src import distributed
from jax.experimental import multihost_utils
from jax.sharding import Sharding

from bounce_mjx.config.files import flat
from bounce_mjx.errors import UserError, reason_of, shorten
from bounce_mjx.interrupt import in_daemon_thread
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.training.peers import DEFAULT_TIMEOUT, Peers

Tree = TypeVar("Tree")

_peers: Peers | None = None
_ADDRESS = "bounce_mjx/address"


def _advice() -> str:
    return "start all processes again"


def join(
    coordinator_address: str | None = None,
    num_processes: int | None = None,
    process_id: int | None = None,
    timeout: float = DEFAULT_TIMEOUT,
) -> None:
    """Joins the processes of one run; it must be called before any other use of JAX. From now
    on, the death of one ends the others with an error message.

    Without arguments, Slurm, Open MPI or Kubernetes supply them.

    Args:
      timeout: seconds to wait for the other processes at the start; also the seconds without a sign
        of life after which a process counts as dead.

    Raises:
      UserError: only some of the arguments are given, no launcher supplies the others, or the
        processes did not find or cannot reach each other in time.
    """
    global _peers
    given = {
        "--coordinator-address": coordinator_address,
        "--num-processes": num_processes,
        "--process-id": process_id,
    }
    missing = [flag for flag, value in given.items() if value is None]
    if missing and len(missing) < len(given):
        raise UserError(
            f"{', '.join(f for f in given if f not in missing)} needs {', '.join(missing)} as well;"
            " give all three, or only --distributed under Slurm, Open MPI or Kubernetes"
        )
    if sys.platform == "win32":
        raise UserError("several hosts cannot train together on Windows; use Linux, such as WSL 2")
    _divert_native_output()

    def connect() -> Peers | None:
        # JAX's own time limits end the process with a stack trace, so they must be longer than
        # ours.
        jax.distributed.initialize(
            coordinator_address,
            num_processes,
            process_id,
            initialization_timeout=int(2 * timeout + 60),
            heartbeat_timeout_seconds=int(2 * timeout + 60),
        )
        return _connect(timeout)

    try:
        # Ctrl-C cannot interrupt these functions, but it can interrupt the wait for a thread.
        _peers = in_daemon_thread(connect).result(timeout)
        # Waits for the devices of all hosts. The processes must be connected before: nothing else
        # ends this wait if one of them has died.
        in_daemon_thread(jax.devices).result()
    except UserError:
        raise
    except concurrent.futures.TimeoutError as error:
        where = f" at {coordinator_address}" if coordinator_address else ""
        raise UserError(
            f"the processes of this training did not find each other{where} within {timeout:g} s; "
            "check that all of them run, and that they reach the host and port of process 0, or "
            "give them more time with --host-timeout"
        ) from error
    except Exception as error:
        reason = reason_of(error)[:200]
        raise UserError(
            f"the processes of this training cannot be joined ({reason}); start one process per "
            "host with --coordinator-address HOST:PORT, --num-processes N and --process-id I"
        ) from error


def _connect(timeout: float) -> Peers | None:
    """Connects the processes that JAX has joined; None if there is only one.

    Raises:
      UserError: they cannot reach each other.
    """
    # Not through JAX's devices, which wait for all processes, the dead ones too.
    joined = distributed.global_state
    if joined.num_processes == 1:
        return None
    host = joined.coordinator_address.rpartition(":")[0].strip("[]")
    peers = Peers(joined.process_id, joined.num_processes, timeout, lambda: _advice(), _exit)
    if joined.process_id == 0:
        address, server = peers.listen()
        joined.client.key_value_set(_ADDRESS, address)
        connect = partial(peers.accept, server)
    else:
        address = joined.client.blocking_key_value_get(_ADDRESS, int(1000 * timeout))
        connect = partial(peers.connect, host, address)
    try:
        connect()
    except OSError as error:
        raise UserError(
            f"the processes of this training cannot reach each other at {host}, port "
            f"{address.split()[0]} ({error}); open the ports between the hosts"
        ) from error
    return peers


def advise(advice: Callable[[], str]) -> None:
    """Sets the end of the message about the death of a process, which says how to continue."""
    global _advice
    _advice = advice


def agree(config: TrainConfig, resume: Path | None) -> None:
    """Compares the configs of all processes.

    Args:
      resume: the run to continue.

    Raises:
      UserError: they differ, and so would the programs and the states of the processes.
    """
    # Only the leader uses the folder of the runs.
    plain = config.model_dump(mode="json", exclude={"log_dir"})
    plain["resume"] = resume and os.path.abspath(resume)
    first, *others = map(flat, _exchange(plain))
    for i, other in enumerate(others, start=1):
        for key in sorted(first.keys() | other.keys()):
            ours, theirs = first.get(key), other.get(key)
            if ours != theirs:
                ours, theirs = (shorten(json.dumps(value)) for value in (ours, theirs))
                raise UserError(
                    f"the processes of this training differ in {key}, which is {ours} in process 0 "
                    f"and {theirs} in process {i}; start all with the same flags"
                )


def _exchange(value: Any) -> list[Any]:
    """The values of all processes, by number; the value of this process if it is alone."""
    return [value] if _peers is None else _peers.exchange(value)


def disconnect() -> None:
    """Marks the end of the common work: from now on every process may end at any time."""
    if _peers is not None:
        _peers.close()


@contextlib.contextmanager
def leave_at_once() -> Iterator[None]:
    """If one of several processes fails, ends it without JAX's wait for the others at exit."""
    try:
        yield
    except SystemExit as error:
        if error.code and _native_log is not None:
            _exit(error.code)
        raise
    except Exception:
        if _peers is None:
            raise
        # The death of another process makes JAX's collective fail here; `Peers` reports which one
        # died.
        time.sleep(3.0)
        traceback.print_exc()
        _exit(1)


def is_leader() -> bool:
    """Whether this process writes the run's folder and prints messages for the user."""
    return jax.process_index() == 0


def any_of(flag: bool) -> bool:
    """Whether the flag is set in any process. Every process must call this at the same point; there
    it waits for the others without a time limit."""
    return any(_exchange(flag))


def text_from_leader(text: str | None) -> str:
    """Returns the leader's text in every process; the others pass None."""
    return _exchange(text)[0]


def gather(tree: Tree) -> Tree:
    """A pytree of arrays that are sharded over devices of several hosts, as whole NumPy arrays in
    every process."""
    if jax.process_count() == 1:
        return jax.tree.map(np.asarray, tree)
    return multihost_utils.process_allgather(tree, tiled=True)


def distribute(tree: Tree, shardings: Any) -> Tree:
    """Arrays that are whole and equal in every process, as arrays on the devices."""

    def put(x, sharding: Sharding) -> jax.Array:
        x = np.asarray(x)
        return jax.make_array_from_callback(x.shape, sharding, lambda index: x[index])

    return jax.tree.map(put, tree, shardings)


_native_log: str | None = None
# A reference to the callback, because ctypes keeps none.
_on_abort = None


def _divert_native_output() -> None:
    """Redirects the output of JAX's C++ code to a file, and turns its abort into a one-sentence
    message.

    When process 0 dies, C++ prints pages and aborts in the same instant in which `Peers` notices.
    """
    global _native_log, _on_abort
    sys.stderr.flush()
    sys.stderr = os.fdopen(os.dup(2), "w", buffering=1, encoding="utf-8", errors="replace")
    file, _native_log = tempfile.mkstemp(prefix="bounce_mjx_", suffix=".log")
    os.dup2(file, 2)
    os.close(file)
    atexit.register(Path(_native_log).unlink, missing_ok=True)

    def abort(_: int) -> None:
        # `Peers` has more information, and ends this process within this time if another one died.
        time.sleep(3.0)
        print(
            f"error: JAX aborted this process; {_native_log} has the reason",
            file=sys.stderr,
            flush=True,
        )
        os._exit(1)

    _on_abort = ctypes.CFUNCTYPE(None, ctypes.c_int)(abort)
    # Not with the module `signal`, whose handlers run only in the main thread.
    libc = ctypes.CDLL(None)
    libc.signal.argtypes = [ctypes.c_int, ctypes.c_void_p]
    libc.signal(signal.SIGABRT, ctypes.cast(_on_abort, ctypes.c_void_p))


def _exit(status: Any) -> NoReturn:
    sys.stdout.flush()
    sys.stderr.flush()
    if _native_log is not None:
        Path(_native_log).unlink(missing_ok=True)
    os._exit(status if isinstance(status, int) else 1)
