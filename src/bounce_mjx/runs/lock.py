"""Lock that gives a run's folder a single writer."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from bounce_mjx.errors import UserError

try:
    import fcntl
except ImportError:
    # On Windows.
    fcntl = None


@contextlib.contextmanager
def lock_run(run: Path) -> Iterator[None]:
    """Holds the lock of a run's folder; the kernel releases it when the process dies.

    On a file system without locks on folders, such as NFS, and on Windows, every process gets it.

    Raises:
      UserError: another process holds the lock.
    """
    if fcntl is None:
        yield
        return
    descriptor = os.open(run, os.O_RDONLY)
    try:
        # Any other OSError means that the file system has no locks.
        with contextlib.suppress(OSError):
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise UserError(
                    f"{run} is in use by another training process; wait until it ends, or stop it "
                    "with Ctrl-C or SIGTERM, and resume"
                ) from error
        yield
    finally:
        os.close(descriptor)
