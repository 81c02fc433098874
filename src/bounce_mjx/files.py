"""Files that other people may have changed: nothing is written through a link."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yields the name of a new file next to `path`, with its suffix, which replaces it at the end
    of the block; after an exception, the new file is removed.

    A link at `path` is replaced, too, and its target stays as it is.

    Raises:
      OSError: the file cannot replace the other.
    """
    new = path.with_name(f".unfinished-{os.urandom(8).hex()}{path.suffix}")
    try:
        yield new
        new.replace(path)
    finally:
        new.unlink(missing_ok=True)
