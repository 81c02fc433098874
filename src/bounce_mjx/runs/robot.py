"""The copy of a robot's MJCF in the run that trains it.

    runs/<task>/<time stamp>/robot/
        my_robot.xml        the MJCF, and every file that it names, in their own subfolders
        manifest.json       size and SHA-256 of every file

A run of the project's own robot has no copy.
"""

import hashlib
import os
import shutil
from pathlib import Path

from bounce_mjx.errors import UserError
from bounce_mjx.lazy import mujoco
from bounce_mjx.runs.files import MANIFEST_FILE, seal

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


def _files_of(mjcf: Path) -> list[Path]:
    """An MJCF file and every file that it names."""
    return [Path(os.path.abspath(name)) for name in mujoco.mju_getXMLDependencies(str(mjcf))]


def identify_robot(mjcf: Path, run: Path) -> str:
    """Name of a run's MJCF file, and eight digits of the hash of all copied files."""
    digest = hashlib.sha256((run / ROBOT / MANIFEST_FILE).read_bytes()).hexdigest()
    return f"{mjcf.name} {digest[:8]}"
