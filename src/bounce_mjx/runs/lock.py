"""One writer for a run's folder."""

import contextlib
import errno
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from bounce_mjx.errors import UserError

_LOCK_FILE = ".lock"
# Some network file systems have no locks.
_UNSUPPORTED = {errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS}


@contextlib.contextmanager
def lock_run(run: Path) -> Iterator[None]:
    """Holds the lock of a run's folder; the kernel releases it when the process dies.

    A file system without locks grants it to everyone.

    Raises:
      UserError: another process holds the lock, or the folder cannot be written.
    """
    path = run / _LOCK_FILE
    descriptor = _acquire(run, path)
    try:
        yield
    finally:
        # Unlinked while the lock is held, so that nobody else's file goes.
        with contextlib.suppress(OSError):
            path.unlink()
        os.close(descriptor)


def _acquire(run: Path, path: Path) -> int:
    """The descriptor of the locked file."""
    try:
        while True:
            # Not for writing: such a file would keep an administrator from mounting the disk
            # read-only.
            descriptor = os.open(path, os.O_RDONLY | os.O_CREAT, 0o644)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(descriptor)
                raise
            except OSError as error:
                if error.errno not in _UNSUPPORTED:
                    os.close(descriptor)
                    raise
            # The holder before may have unlinked the file between the two calls.
            if path.exists() and os.path.samestat(os.fstat(descriptor), path.stat()):
                return descriptor
            os.close(descriptor)
    except BlockingIOError as error:
        raise UserError(
            f"{run} is in use by another training; wait for its end, or stop it with Ctrl-C or "
            "SIGTERM, and resume"
        ) from error
    except OSError as error:
        raise UserError(
            f"{run} cannot be written ({error.strerror}); make room there or make it writable"
        ) from error
