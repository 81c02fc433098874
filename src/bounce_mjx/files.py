"""Files and folders that other people may have changed: nothing is written through a link."""

import contextlib
import errno
import os
import stat
from collections.abc import Iterator
from pathlib import Path

UNFINISHED = ".unfinished-"
"""Start of the name of a file that is being written."""


@contextlib.contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yields a new, empty file next to `path`, with its suffix, which replaces it at the end of the
    block; after an exception, the new file is removed.

    A link at `path` is replaced, too, and its target stays as it is.

    Raises:
      OSError: the file cannot be made, or cannot replace the other.
    """
    new = path.with_name(f"{UNFINISHED}{os.urandom(8).hex()}{path.suffix}")
    # Fails if there is anything with this name, even a link that leads nowhere.
    os.close(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
    try:
        yield new
        new.replace(path)
    except BaseException:
        new.unlink(missing_ok=True)
        raise


def private_folder(path: Path) -> Path:
    """Makes a folder, or takes an existing one, that this user alone can open.

    Raises:
      OSError: it cannot be made, or it is a link or another user's.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(FileExistsError):
        path.mkdir(mode=0o700)
    status = path.lstat()
    if not stat.S_ISDIR(status.st_mode):
        raise NotADirectoryError(errno.ENOTDIR, "it is a link or a file", str(path))
    # Windows has no such numbers; there, only the user can open a folder under the home.
    if hasattr(os, "getuid") and status.st_uid != os.getuid():
        raise PermissionError(errno.EPERM, "it belongs to another user", str(path))
    path.chmod(0o700)
    return path
