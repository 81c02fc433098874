"""Output files that a user names."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from bounce_mjx.errors import UserError
from bounce_mjx.files import new_file


def check_writable(path: Path, flag: str, suffixes: tuple[str, ...]) -> None:
    """Checks an output file before the recording.

    Raises:
      UserError: the suffix is not one of `suffixes`, or no file can be made there.
    """
    if path.suffix.lower() not in suffixes:
        raise UserError(f"{flag} {path} does not end in {' or '.join(suffixes)}; rename it")
    folder = path.absolute().parent
    if not folder.is_dir():
        raise UserError(f"the folder of {flag} {path} does not exist; make it")
    if path.is_dir():
        raise UserError(f"{flag} {path} is a folder; give a file")
    if not os.access(path if path.exists() else folder, os.W_OK):
        raise UserError(f"{flag} {path} may not be written; give another file")


@contextlib.contextmanager
def new_output(path: Path, flag: str) -> Iterator[Path]:
    """A `new_file` at the path that the user gave.

    Raises:
      UserError: the file cannot be written.
    """
    try:
        with new_file(path) as new:
            yield new
    except OSError as error:
        raise UserError(
            f"{flag} {path} cannot be written ({error.strerror}); give another file"
        ) from error
