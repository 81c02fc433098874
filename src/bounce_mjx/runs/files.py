"""Files of a run: validated JSON, atomic writes, and a manifest that verifies a checkpoint."""

import hashlib
import json
import os
from pathlib import Path
from typing import Any, TypeVar

import pydantic
from pydantic_core import to_jsonable_python

PARTIAL = ".partial"
MANIFEST_FILE = "manifest.json"
_MAX_JSON_BYTES = 64 * 2**20

ModelT = TypeVar("ModelT", bound=pydantic.BaseModel)


class Manifest(pydantic.BaseModel):
    """manifest.json: size and SHA-256 of every other file in a checkpoint, by name."""

    format: int = 1
    files: dict[str, dict[str, int | str]]


def to_json(plain: Any) -> str:
    """Plain data as JSON. Non-finite numbers, which JSON cannot express, become null."""
    # `pydantic_core.to_json` fails for paths that are not UTF-8.
    return json.dumps(to_jsonable_python(plain, inf_nan_mode="null"), indent=2) + "\n"


def read_json(path: Path, model: type[ModelT]) -> ModelT:
    """Reads and validates a JSON file; raises OSError or ValueError if it does not fit `model`."""
    if path.stat().st_size > _MAX_JSON_BYTES:
        raise ValueError(f"{path.name} is too large")
    try:
        return model.model_validate(json.loads(path.read_text(encoding="utf-8")))
    except pydantic.ValidationError as error:
        raise ValueError(f"{path.name}: {first_mistake(error)}") from error
    except RecursionError as error:
        raise ValueError(f"{path.name} is nested too deeply") from error


def first_mistake(error: pydantic.ValidationError) -> str:
    """First validation error in stored data, on one line: its place and the expected type."""
    first = error.errors(include_url=False, include_input=False)[0]
    return f"{'.'.join(map(str, first['loc']))[:80]}: {first['msg']}".removeprefix(": ")


def write_atomically(path: Path, text: str) -> None:
    """Writes a text file; readers see either the complete old text or the complete new text."""
    partial = path.with_name(path.name + PARTIAL)
    try:
        partial.write_text(text, encoding="utf-8")
        sync(partial)
        partial.rename(path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise


def sync(path: Path) -> None:
    """Flushes a file, or the entries of a folder, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def seal(folder: Path) -> None:
    """Writes the manifest of a checkpoint; all other files must be complete."""
    write_atomically(folder / MANIFEST_FILE, to_json(Manifest(files=_describe_files(folder))))


def check_integrity(folder: Path) -> None:
    """Raises OSError or ValueError if a file does not match the manifest."""
    found = _describe_files(folder)
    expected = read_json(folder / MANIFEST_FILE, Manifest).files
    for name in sorted(found.keys() | expected.keys()):
        if name not in found:
            raise ValueError(f"{name} is missing")
        if found[name] != expected.get(name):
            raise ValueError(f"{name} is not as it was written")


def _describe_files(folder: Path) -> dict[str, dict[str, int | str]]:
    """Entries of a manifest; ValueError for links and devices, which may be endless."""
    entries = {}
    for path in folder.rglob("*"):
        if path.is_symlink() or not (path.is_file() or path.is_dir()):
            raise ValueError(f"{path.name} is not a regular file")
        if path.is_file() and not path.name.startswith(".") and path.name != MANIFEST_FILE:
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            entry = {"size": path.stat().st_size, "sha256": digest}
            entries[path.relative_to(folder).as_posix()] = entry
    return entries
