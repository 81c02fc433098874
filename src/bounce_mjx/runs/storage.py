"""Files of a run: validated JSON, atomic writes, a manifest that verifies a checkpoint, and the
lock of a single writer."""

import contextlib
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, TypeVar

import pydantic
from pydantic_core import to_jsonable_python

from bounce_mjx.errors import UserError, reason_of, shorten

MANIFEST_FILE = "manifest.json"

ModelT = TypeVar("ModelT", bound=pydantic.BaseModel)


class Manifest(pydantic.BaseModel):
    """manifest.json: size and SHA-256 of every other file in a folder, a checkpoint or a run's copy
    of its robot, by name, but for those that begin with a dot, such as a file system's own."""

    format: Literal[1] = 1
    """A later version's would mean something else."""
    files: dict[str, dict[str, int | str]]


def to_plain(data: Any) -> Any:
    """Data as what JSON can express; non-finite numbers become null."""
    # `pydantic_core.to_json` fails for paths that are not UTF-8.
    return to_jsonable_python(data, inf_nan_mode="null")


def to_json(data: Any) -> str:
    """Data as JSON, see `to_plain`."""
    return json.dumps(to_plain(data), indent=2) + "\n"


def read_stored(path: Path, model: type[ModelT]) -> ModelT | None:
    """The content of a JSON file that a command wrote; None if there is none.

    Raises:
      UserError: the file is damaged.
    """
    if not path.is_file():
        return None
    try:
        return model.model_validate_json(path.read_bytes())
    # One of pydantic's is a ValueError.
    except (OSError, ValueError) as error:
        reason = shorten(reason_of(error), 200)
        raise UserError(f"{path} is damaged ({reason}); delete it to continue") from error


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


def write_atomically(path: Path, content: str | bytes) -> None:
    """Writes a file; readers see either the complete old content or the complete new one. Nothing
    is written through a link (`new_file`)."""
    with new_file(path) as new, new.open("wb") as file:
        file.write(content.encode() if isinstance(content, str) else content)
        file.flush()
        os.fsync(file.fileno())


@contextlib.contextmanager
def plain_path(folder: Path) -> Iterator[Path]:
    """Yields a path of a folder for orbax, which takes a bracket in a path for a pattern and then
    loses arrays, and for tensorstore, to which a backslash is a slash: a link where the path has
    one."""
    path = folder.absolute()
    if not set("[]\\") & set(str(path)):
        yield path
        return
    with tempfile.TemporaryDirectory() as place:
        link = Path(place) / "link"
        link.symlink_to(path, target_is_directory=True)
        yield link


def write_output(path: Path, content: str | bytes) -> None:
    """Writes a file that the user named, like `write_atomically`; a device or a pipe, such as
    /dev/stdout, stays one.

    Raises:
      UserError: it cannot be written.
    """
    # A path in it may not be UTF-8.
    content = content.encode(errors="replace") if isinstance(content, str) else content
    with writable(path, "give another file or folder"):
        is_special = path.exists() and not path.is_file()
        (Path.write_bytes if is_special else write_atomically)(path, content)


@contextlib.contextmanager
def writable(path: Path, advice: str) -> Iterator[None]:
    """Around the writing of what the user named.

    Args:
      advice: the end of the error, such as "choose another --out".

    Raises:
      UserError: it cannot be written.
    """
    try:
        yield
    except OSError as error:
        raise UserError(f"{path} cannot be written ({error.strerror}); {advice}") from error


def check_output(path: Path | None, flag: str, suffixes: tuple[str, ...] = ()) -> None:
    """Fails before the work if a file that the user named with a flag could not be written.

    Args:
      suffixes: the ends of the name that it may have; by default, any.

    Raises:
      UserError: it has another suffix, it or its folder may not be written, it is a folder, or is
        in one that does not exist.
    """
    if path is None:
        return
    if suffixes and path.suffix.lower() not in suffixes:
        raise UserError(f"{flag} {path} does not end in {' or '.join(suffixes)}; rename it")
    folder = path.absolute().parent
    if not os.path.isdir(folder):
        raise UserError(f"the folder of {flag} {path} does not exist; make it")
    if os.path.isdir(path):
        raise UserError(f"{flag} {path} is a folder; give a file")
    written = [path] if os.path.exists(path) else []
    # A new file beside it replaces a file; a device or a pipe is written itself.
    if not written or os.path.isfile(path):
        written.append(folder)
    for place in written:
        if not os.access(place, os.W_OK):
            raise UserError(f"{flag}: {place} may not be written; give another file")


def seal(folder: Path) -> None:
    """Writes the manifest of a folder; all other files must be complete."""
    write_atomically(folder / MANIFEST_FILE, to_json(Manifest(files=_describe_files(folder))))


def check_integrity(folder: Path) -> None:
    """Raises OSError or ValueError if a file does not match the manifest."""
    manifest = Manifest.model_validate_json((folder / MANIFEST_FILE).read_bytes())
    found = _describe_files(folder)
    expected = manifest.files
    for name in sorted(found.keys() | expected.keys()):
        if found.get(name) != expected.get(name):
            raise ValueError(f"{name} is {'not as it was written' if name in found else 'missing'}")


def _describe_files(folder: Path) -> dict[str, dict[str, int | str]]:
    """Entries of a manifest."""
    entries = {}
    for path in folder.rglob("*"):
        if path.is_file() and not path.name.startswith(".") and path.name != MANIFEST_FILE:
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            entry = {"size": path.stat().st_size, "sha256": digest}
            entries[path.relative_to(folder).as_posix()] = entry
    return entries


@contextlib.contextmanager
def lock_run(run: Path) -> Iterator[None]:
    """Holds the lock that gives a run's folder a single writer; the kernel releases it when the
    process dies.

    On a file system without locks on folders, such as NFS, and on Windows, every process gets it.

    Raises:
      UserError: another process holds the lock.
    """
    try:
        import fcntl
    except ImportError:
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
                    f"{run} is in use by another training process; stop it, or wait for its end"
                ) from error
        yield
    finally:
        os.close(descriptor)
