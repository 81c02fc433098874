"""One checkpoint: a folder that is whole or not there, and that holds data only.

    <steps>/
        policy/         orbax; what acting needs
        training/       orbax; what going on needs; left out of a checkpoint that is only to act
        run.json        the steps, the run's config, its evaluations so far
        manifest.json   size and SHA-256 of every other file

Arrays are numbers in OCDBT and zarr, all else is JSON: there is nothing in it that could be run.
The folder is written under another name, brought to the disk, and renamed; so a process that is
killed leaves the checkpoint before it.
"""

import hashlib
import json
import math
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tensorstore
from flax import traverse_util

RECORD_FILE = "run.json"
MANIFEST_FILE = "manifest.json"
_FORMAT = 1
_MAX_JSON_BYTES = 64 * 2**20
_PARTIAL, _REPLACED, _DISCARDED = ".partial", ".replaced", ".discarded"


def write_checkpoint(folder: Path, items: dict[str, Any], record: dict[str, Any]) -> None:
    """Writes a checkpoint, in place of the one that may be there.

    Args:
      items: pytrees of numpy arrays by name.
      record: plain data for run.json.

    Raises:
      OSError: it could not be written; nothing of it is left, and what was there still is.
    """
    # It takes a third of a second to import, and only writing needs it.
    import orbax.checkpoint as ocp

    partial = folder.with_name(folder.name + _PARTIAL)
    remove_leftovers(folder.parent)
    try:
        partial.mkdir(parents=True)
        _check_room(partial, items)
        only_here = ocp.options.MultiprocessingOptions(
            primary_host=jax.process_index(), active_processes={jax.process_index()}
        )
        checkpointer = ocp.Checkpointer(
            ocp.PyTreeCheckpointHandler(multiprocessing_options=only_here),
            multiprocessing_options=only_here,
        )
        for name, tree in items.items():
            checkpointer.save(_absolute(partial / name), args=ocp.args.PyTreeSave(_plain(tree)))
        (partial / RECORD_FILE).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
        seal(partial)
        replaced = folder.with_name(folder.name + _REPLACED)
        if folder.exists():
            folder.rename(replaced)
        partial.rename(folder)
        _sync(folder.parent)
    except Exception as error:
        shutil.rmtree(partial, ignore_errors=True)
        number = re.search(r"os_error_code='(\d+)'", str(error))
        if number is None:
            raise
        # tensorstore reports a full disk as a ValueError.
        raise OSError(int(number[1]), os.strerror(int(number[1]))) from error
    shutil.rmtree(replaced, ignore_errors=True)


def _absolute(path: Path) -> Path:
    """The path without "..", which tensorstore does not take."""
    return Path(os.path.abspath(path))


def _plain(tree: Any) -> Any:
    """The pytree as nested dictionaries of numpy arrays. brax's counters turn theirs into JAX's,
    and of those orbax does not take what lies on one of several hosts."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    names = [jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in leaves]
    arrays = {
        tuple(name.split(".")): np.asarray(leaf)
        for name, (_, leaf) in zip(names, leaves, strict=True)
    }
    return traverse_util.unflatten_dict(arrays)


def seal(folder: Path) -> None:
    """Writes the manifest of a checkpoint, after bringing its other files to the disk."""
    files = {}
    for path in sorted(_regular_files(folder)):
        name = path.relative_to(folder).as_posix()
        if name != MANIFEST_FILE:
            _sync(path)
            files[name] = {"size": path.stat().st_size, "sha256": _sha256(path)}
    write_atomically(
        folder / MANIFEST_FILE, json.dumps({"format": _FORMAT, "files": files}, indent=1) + "\n"
    )
    for parent in {(folder / name).parent for name in files} | {folder}:
        _sync(parent)


def check_integrity(folder: Path) -> None:
    """Compares every file with the manifest.

    Raises:
      ValueError, OSError and others: the checkpoint is not as it was written.
    """
    # Before anything is read, as a link could lead to a file without an end.
    present = {path.relative_to(folder).as_posix(): path for path in _regular_files(folder)}
    if present.pop(MANIFEST_FILE, None) is None:
        raise ValueError(f"it has no {MANIFEST_FILE}")
    manifest = _read_json(folder / MANIFEST_FILE)
    if manifest["format"] != _FORMAT:
        raise ValueError(f"its format is {str(manifest['format'])[:20]}, not {_FORMAT}")
    expected = manifest["files"]
    for name in sorted(present.keys() ^ expected.keys()):
        raise ValueError(f"{name} {'is missing' if name in expected else 'does not belong to it'}")
    for name, path in present.items():
        if path.stat().st_size != expected[name]["size"]:
            raise ValueError(f"{name} does not have the size that it was written with")
        if _sha256(path) != expected[name]["sha256"]:
            raise ValueError(f"{name} is not what was written")


def read_record(folder: Path) -> dict[str, Any]:
    """The plain data of run.json."""
    return _read_json(folder / RECORD_FILE)


def open_item(folder: Path, item: str) -> dict[str, tensorstore.TensorStore]:
    """The arrays of an item by dotted name, not yet read.

    Not by orbax, whose readers print tracebacks from their threads where a file is damaged.
    """
    base = {"driver": "file", "path": f"{_absolute(folder / item)}/"}
    database = {"driver": "ocdbt", "base": base}
    keys = tensorstore.KvStore.open(database).result().list().result()
    opening = {
        name: tensorstore.open(
            {"driver": "zarr", "kvstore": {**database, "path": f"{name}/"}}, open=True, read=True
        )
        for name in {key.decode().rpartition("/")[0] for key in keys}
    }
    return {name: array.result() for name, array in opening.items()}


def read_arrays(arrays: dict[str, tensorstore.TensorStore]) -> dict[str, np.ndarray]:
    """Reads arrays of `open_item` whose shapes and types are what the reader expects.

    Raises:
      ValueError and others: an array cannot be read.
    """
    for name, array in arrays.items():
        chunk = array.chunk_layout.read_chunk.shape or ()
        # The memory of a chunk is taken before its bytes are looked at.
        if math.prod(chunk) > math.prod(max(1, length) for length in array.shape):
            raise ValueError(f"{name} is stored in chunks of {chunk}, larger than itself")
        # orbax writes zstd, whose reader stops at the size of the array; that of blosc takes what
        # the file asks for, up to 2 GB.
        compressor = array.codec.to_json()["compressor"]
        if compressor is not None and compressor["id"] != "zstd":
            raise ValueError(f"{name} is compressed by {compressor['id']}, not zstd")
    reading = {name: array.read() for name, array in arrays.items()}
    return {name: array.result() for name, array in reading.items()}


def stored_checkpoints(folder: Path) -> dict[int, Path]:
    """The checkpoints in a folder by their steps; one that is being written has another name."""
    found = {}
    for path in folder.glob("*"):
        # A process that was killed while it replaced a checkpoint leaves only the replaced one.
        name = path.name.removesuffix(_REPLACED)
        if name.isascii() and name.isdecimal() and path.is_dir():
            if path.name == name or int(name) not in found:
                found[int(name)] = path
    return found


def discard(folder: Path) -> None:
    """Removes a checkpoint, which is at no moment there in part."""
    discarded = folder.with_name(folder.name + _DISCARDED)
    shutil.rmtree(discarded, ignore_errors=True)
    folder.rename(discarded)
    shutil.rmtree(discarded, ignore_errors=True)


def remove_leftovers(folder: Path) -> None:
    """Removes what a killed process left half written or half removed in a folder of
    checkpoints."""
    for path in stored_checkpoints(folder).values():
        if path.name.endswith(_REPLACED):
            path.rename(path.with_name(path.name.removesuffix(_REPLACED)))
    for path in folder.glob("*"):
        if path.name.endswith((_PARTIAL, _REPLACED, _DISCARDED)):
            shutil.rmtree(path, ignore_errors=True)


def write_atomically(path: Path, text: str) -> None:
    """Writes a text file that a reader sees either as it was or whole."""
    partial = path.with_name(path.name + _PARTIAL)
    try:
        partial.write_text(text, encoding="utf-8")
        _sync(partial)
        partial.rename(path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise


def _check_room(folder: Path, items: dict[str, Any]) -> None:
    """Raises the OSError of a full disk before orbax meets it, whose threads would each print a
    traceback."""
    size = sum(leaf.nbytes for leaf in jax.tree.leaves(items))
    # orbax writes the arrays twice, and some files beside them.
    needed = 2 * size + 2**20
    probe = folder / "room"
    with probe.open("wb") as file:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, needed)
        else:
            file.write(bytes(needed))
    probe.unlink()


def _regular_files(folder: Path) -> Iterator[Path]:
    """The files under a folder, without hidden ones.

    Raises:
      ValueError: there is a link or a device, which could lead anywhere.
    """
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_dir(follow_symlinks=False):
                yield from _regular_files(Path(entry.path))
            elif not entry.is_file(follow_symlinks=False):
                raise ValueError(f"{entry.name} is not a regular file")
            elif not entry.name.startswith("."):
                yield Path(entry.path)


def _read_json(path: Path) -> dict[str, Any]:
    if path.stat().st_size > _MAX_JSON_BYTES:
        raise ValueError(f"{path.name} is too large")
    value = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(value, dict):
        raise ValueError(f"{path.name} holds no JSON object")
    return value


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
