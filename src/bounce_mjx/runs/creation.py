"""What a run's folder begins with: the config, and copies of the robot and of the user's own
code."""

import contextlib
import datetime
import itertools
import os
import shutil
from pathlib import Path

from bounce_mjx.config.files import dump_config
from bounce_mjx.config.user_code import code_file_of
from bounce_mjx.errors import UserError
from bounce_mjx.lazy import mujoco
from bounce_mjx.learning.registry import own_algorithm
from bounce_mjx.resources import VERSION
from bounce_mjx.runs.config import CONFIG_FILE, ROBOT, TrainConfig, dump_sources
from bounce_mjx.runs.presets import BASE
from bounce_mjx.runs.storage import seal, writable, write_atomically
from bounce_mjx.task.registry import own_task


def create_run(config: TrainConfig) -> Path:
    """Creates a new run's folder, named after the current time (UTC), with the config in it.

    Raises:
      UserError: the folder cannot be written, or the robot cannot be copied into it.
    """
    # Not the local time, which is another one on another machine, and in autumn goes back.
    stamp = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d_%H-%M-%S")
    with writable(config.log_dir, "choose another folder with --log-dir"):
        config.log_dir.mkdir(parents=True, exist_ok=True)
        for copy in itertools.count(1):
            folder = config.log_dir / (stamp if copy == 1 else f"{stamp}_{copy}")
            with contextlib.suppress(FileExistsError):
                folder.mkdir()
                break
        try:
            save_config(folder, config)
        except (UserError, OSError):
            shutil.rmtree(folder, ignore_errors=True)
            raise
    return folder


def save_config(run: Path, config: TrainConfig) -> None:
    """Writes the run's resolved config, and copies of its robot and of the code of its own task and
    algorithm, unless the run has them."""
    own = {"task": own_task(config.task), "algorithm": own_algorithm(config.algorithm)}
    for key, kind in own.items():
        code = None if kind is None else code_file_of(kind)
        if code is not None and not (run / key).exists():
            (run / key).mkdir()
            write_atomically(run / key / code.path.name, code.content)
    if (mjcf := config.env.mjcf) is not None:
        # As a config's own path is absolute and without .. in it.
        here = Path(os.path.abspath(run))
        if not mjcf.is_relative_to(here / ROBOT):
            mjcf = copy_robot(mjcf, here)
        # The run's folder may be moved.
        env = config.env.model_copy(update={"mjcf": mjcf.relative_to(here)})
        config = config.model_copy(update={"env": env})
    write_config(run, config)


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

    mjcf = locate(mjcf)
    folder = run / ROBOT
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
        raise UserError(f"{mjcf} names {min(outside)} by an absolute path; give a relative one")
    return copied


def _files_of(mjcf: Path) -> list[Path]:
    """An MJCF file and every file that it names."""
    return [Path(os.path.abspath(name)) for name in mujoco.mju_getXMLDependencies(str(mjcf))]


def write_config(run: Path, config: TrainConfig) -> None:
    """Writes the run's config as it is, without copies."""
    head = f"# bounce_mjx {VERSION}\n{BASE}: null\n"
    write_atomically(run / CONFIG_FILE, head + dump_config(config) + dump_sources(config))
