"""Copies of what a run was trained with, in its folder: its robot's MJCF, in `robot/`, and the
files of a task and an algorithm that are not of the package, in `task/` and `algorithm/`.

    runs/<task>/<time stamp>/robot/
        my_robot.xml        the MJCF, and every file that it names, in their own subfolders
        manifest.json       size and SHA-256 of every file
"""

import os
import shlex
import shutil
import sys
import zlib
from pathlib import Path

from bounce_mjx.errors import UserError
from bounce_mjx.lazy import mujoco
from bounce_mjx.runs.files import MANIFEST_FILE, check_integrity, seal, write_atomically
from bounce_mjx.task.task import Task
from bounce_mjx.tasks import registry

ROBOT = "robot"


def copy_robot(mjcf: Path, run: Path) -> Path:
    """Copies an MJCF file with its meshes, textures and included files into a run's folder, sealed
    by a manifest.

    Args:
      mjcf: a file that MuJoCo compiles, as for `locate`.

    Returns:
      The copy of the MJCF file.

    Raises:
      OSError: a file cannot be read or written.
      UserError: the file is missing, or names another file by its absolute path.
    """
    from bounce_mjx.robot.arm import locate

    mjcf, folder = locate(mjcf), run / ROBOT
    files = _files_of(mjcf)
    root = Path(os.path.commonpath([path.parent for path in files]))
    for path in files:
        copy = folder / path.relative_to(root)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, copy)
    seal(folder)
    copied = folder / Path(os.path.abspath(mjcf)).relative_to(root)
    # An absolute path in the copy still leads to the original.
    if outside := set(_files_of(copied)) & set(files):
        shutil.rmtree(folder)
        raise UserError(
            f"the MJCF file {mjcf} names {min(outside)} by an absolute path, so that a run could "
            f"not keep a copy of the robot; name it relative to the folder of {mjcf.name}"
        )
    return copied


def check_robot(run: Path) -> None:
    """Checks that a run's copy of its robot is as it was written.

    Raises:
      UserError: a file is missing or was edited.
    """
    try:
        check_integrity(run / ROBOT)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(
            f"{run / ROBOT} is not the robot that {run} was trained with ({reason}); restore that "
            "folder, or train a new run with --mjcf"
        ) from error


def _files_of(mjcf: Path) -> list[Path]:
    """An MJCF file and every file that it names."""
    return [Path(os.path.abspath(name)) for name in mujoco.mju_getXMLDependencies(str(mjcf))]


def identify_robot(mjcf: Path, run: Path) -> str:
    """Name of a run's MJCF file, and a checksum of all copied files."""
    manifest = (run / ROBOT / MANIFEST_FILE).read_bytes()
    return f"{mjcf.name} {zlib.crc32(manifest):08x}"


def copy_code(name: str, run: Path, folder: str) -> str:
    """Copies the file of a task or an algorithm, FILE.py:CLASS, into a run's folder, unless the run
    has a copy.

    Returns:
      The copy's FILE.py:CLASS, relative to the run's folder.

    Raises:
      OSError: the copy cannot be written.
      UserError: the file cannot be read.
    """
    file = f"{folder}/{registry.source_file(name).name}"
    if not (run / folder).exists():
        (run / folder).mkdir()
        write_atomically(run / file, registry.read_source(name))
    return f"{file}:{name.rpartition(':')[2]}"


def task_of_run(name: str, run: Path, given: str | None) -> type[Task]:
    """The task of a run; its copy of a task's file is not run unless the user has named code with
    the same content.

    Args:
      name: name in the run's config.
      given: name that the user gave, or None. Another file's task is taken with a warning.

    Raises:
      UserError: the user has not named the file; or the run has another task.
    """
    differs = given is not None and not registry.is_same_code(name, given)
    if not registry.is_file(name):
        if differs:
            raise UserError(
                f"the run {run} was trained with the task {name}, but --task is {given}; leave it "
                "out"
            )
        return registry.find_task(name)
    if differs:
        print(
            f"warning: {given} differs from the task that {run} was trained with; the "
            f"training's is {name}",
            file=sys.stderr,
        )
    if given is not None:
        registry.admit(name, registry.find_task(given))
    task = registry.known_task(name)
    if task is None:
        raise unnamed_code(f"the run {run}", "task", name)
    return task


def unnamed_code(source: str, key: str, name: str) -> UserError:
    """The refusal to run the file of a task or an algorithm that the user has not named."""
    return UserError(
        f"{source} has its {key} in a file, which is code; name it to run it: --{key} "
        f"{shlex.quote(name)}"
    )


def identify_task(name: str) -> str:
    """A task's name; for FILE.py:CLASS without the folder, and with the file's checksum."""
    if not registry.is_file(name):
        return name
    return f"{Path(name).name} {zlib.crc32(registry.read_source(name)):08x}"
