"""Folders of runs and checkpoints, and functions that find them.

    runs/<task>/<time stamp, UTC>/
        config.yaml                     the resolved config
        robot/                          a copy of --mjcf and its files (`runs.robot`)
        task/                           a copy of the task's file (`runs.task`)
        events.out.tfevents.*           TensorBoard scalars
        results.json                    all evaluations, and the time of each activity
        checkpoints/latest/<steps>/     the newest state
        checkpoints/best/<steps>/       the state with the best evaluation
            policy/                     the policy's arrays (zarr in OCDBT)
            training/                   the training state's arrays; optional
            run.json                    the steps, the config, the evaluations so far
            manifest.json               size and SHA-256 of every other file

A run with several seeds has one folder per seed, such as seed_003/, with the layout of a run with
one seed; the run's own checkpoints/latest/ holds the state of all seeds.

Functions that search raise a `UserError` if they find nothing.
"""

import contextlib
import datetime
import itertools
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

from rich.console import Console

import bounce_mjx
from bounce_mjx.config.files import dump_config
from bounce_mjx.errors import UserError
from bounce_mjx.files import check_name
from bounce_mjx.resources import POLICIES, PRETRAINED, TASK_POLICIES, resource_path
from bounce_mjx.runs.config import BASE, CONFIG_FILE, TrainConfig, runs_folder
from bounce_mjx.runs.files import write_atomically
from bounce_mjx.runs.progress import load_results
from bounce_mjx.runs.robot import ROBOT, copy_robot
from bounce_mjx.runs.task import copy_task
from bounce_mjx.tasks.registry import DEFAULT, find_task, is_file

CheckpointName = Literal["latest", "best"]
POLICY_OF_TASK = {DEFAULT: PRETRAINED} | {task: task for task in TASK_POLICIES}
"""The policy that comes with the package for a task."""
LATEST = "latest"
"""Name of the newest run on the command line."""
CHECKPOINTS = "checkpoints"
REPLACED = ".discarded"
# A terminal obeys these characters.
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")
_STAMP = "%Y-%m-%d_%H-%M-%S"


class Checkpoint(NamedTuple):
    """Location of a checkpoint."""

    run: Path
    """The run's folder."""
    folder: Path
    """The checkpoint's own folder."""
    steps: int
    """Environment steps trained."""


MIRROR_LAW = Checkpoint(Path("mirror law"), Path("mirror law"), 0)
"""In place of a checkpoint, the baseline `baselines.mirror`."""


def create_run(config: TrainConfig) -> Path:
    """Creates a new run's folder, named after the current time (UTC), with the config in it.

    Raises:
      UserError: the folder cannot be written, or the robot cannot be copied into it.
    """
    check_name(config.log_dir.absolute())
    # Not the local time, which is another one on another machine, and in autumn goes back.
    stamp = datetime.datetime.now(datetime.UTC).strftime(_STAMP)
    try:
        config.log_dir.mkdir(parents=True, exist_ok=True)
        for copy in itertools.count(1):
            folder = config.log_dir / (stamp if copy == 1 else f"{stamp}_{copy}")
            try:
                folder.mkdir()
            except FileExistsError:
                continue
            try:
                save_config(folder, config)
            except (UserError, OSError):
                shutil.rmtree(folder, ignore_errors=True)
                raise
            return folder
    except OSError as error:
        raise UserError(
            f"the run's folder cannot be made in {config.log_dir} ({error.strerror}); choose a "
            "folder that can be written with --log-dir"
        ) from error


def save_config(run: Path, config: TrainConfig) -> None:
    """Writes the run's resolved config, and copies of its robot and of its task's file unless the
    run has them."""
    if is_file(config.task):
        config = config.model_copy(update={"task": copy_task(config.task, run)})
    if (mjcf := config.env.mjcf) is not None:
        if not mjcf.is_relative_to((run / ROBOT).absolute()):
            mjcf = copy_robot(mjcf, run).absolute()
        # The run's folder may be moved.
        env = config.env.model_copy(update={"mjcf": mjcf.relative_to(run.absolute())})
        config = config.model_copy(update={"env": env})
    write_config(run, config)


def write_config(run: Path, config: TrainConfig) -> None:
    """Writes the run's config as it is, without copies."""
    head = f"# bounce_mjx {bounce_mjx.__version__}\n{BASE}: null\n"
    write_atomically(run / CONFIG_FILE, head + dump_config(config))


def seed_folder(run: Path, seed: int) -> Path:
    """Folder of a run's seed."""
    return run / f"seed_{seed:03d}"


def runs_of_seeds(run: Path) -> list[Path]:
    """Existing folders of a run's seeds; the run itself if it has one seed."""
    seeds = (path for path in run.glob("seed_*") if re.fullmatch("seed_[0-9]+", path.name))
    return sorted(path for path in seeds if not path.is_symlink()) or [run]


def check_links(run: Path) -> None:
    """Checks that a run's folder holds no links, through which training would write elsewhere;
    those of Weights & Biases do not count, as it makes them anew.

    Raises:
      UserError: there is one, as there may be in a run from someone else.
    """
    for path in run.rglob("*"):
        if path.is_symlink() and "wandb" not in path.relative_to(run).parts[:-1]:
            raise UserError(
                f"{path} is a link, and training writes only into the folder of its run; remove "
                "it, or replace it with its target"
            )


def find_run(path: Path) -> Path:
    """Folder of the run that contains a path; the path may be the folder itself."""
    # Unlike os.path.isdir, Path.is_dir raises an error for a name that is too long.
    if not os.path.isdir(path):
        raise UserError(
            f"there is no checkpoint folder {path}; give a run's folder such as "
            "runs/bounce_ball/<time stamp>"
        )
    for folder in (path, *Path(os.path.abspath(path)).parents):
        if (folder / CONFIG_FILE).is_file():
            if _CONTROL.search(str(folder)):
                raise UserError(f"{folder} has a control character in its name; rename it")
            check_name(folder.absolute())
            return folder
    raise UserError(
        f"{path} is not in a run's folder, as there is no {CONFIG_FILE}; give a folder that "
        "bounce-mjx train made"
    )


def newest_run(log_dir: Path) -> Path:
    """Folder of the newest run with a checkpoint, by the time stamps in the runs' names; a run
    without one counts from the last start of its training."""
    found = runs_in(log_dir)
    if not found:
        raise UserError(
            f"there is no run with a checkpoint in {log_dir}; train one with bounce-mjx train, or "
            "give a run's folder"
        )
    return found[-1]


def named_run(path: Path | None, log_dir: Path) -> Path:
    """A run's folder or a path in it, as the user named it: None and `LATEST` (unless there is a
    folder with that name) stand for the newest run in `log_dir`."""
    is_name = path is None or (str(path) == LATEST and not os.path.isdir(path))
    return newest_run(log_dir) if is_name else path


def runs_in(folder: Path) -> list[Path]:
    """Runs with a checkpoint in a folder, such as those of several seeds, the oldest first."""
    return sorted(filter(_has_checkpoint, _runs(folder)), key=_started)


def find_checkpoint(path: Path) -> Checkpoint:
    """Finds a checkpoint.

    Args:
      path: a run's folder (finds its best checkpoint, or its latest if there is no best), a folder
        of checkpoints in it, or a checkpoint.
    """
    run, place = find_run(path), Path(os.path.abspath(path))
    if place == Path(os.path.abspath(run)):
        run = _best_seed(run)
        place = Path(os.path.abspath(run))
    elif place in (siblings := stored_checkpoints(place.parent)).values():
        return Checkpoint(run, place, next(n for n, p in siblings.items() if p == place))
    inner = (place / CHECKPOINTS / name for name in ("best", "latest"))
    return _checkpoint_in(run, path, place, *inner)


def latest_checkpoint(run: Path) -> Checkpoint:
    """Newest checkpoint of a run, from which its training resumes."""
    return _checkpoint_in(run, run, run / CHECKPOINTS / "latest")


def best_checkpoint(run: Path) -> Checkpoint:
    """Checkpoint of a run with the best evaluation."""
    return _checkpoint_in(run, run, run / CHECKPOINTS / "best")


def pretrained_checkpoint(name: str = PRETRAINED) -> Checkpoint:
    """Checkpoint of a policy in `POLICIES`."""
    return best_checkpoint(resource_path(POLICIES[name]))


def choose_checkpoint(path: Path | None, log_dir: Path, console: Console) -> Checkpoint:
    """Checkpoint to show or to evaluate; prints the choice if the user made none.

    Args:
      path: see `find_checkpoint`; or `LATEST` or a name in `POLICIES`, unless there is a folder
        with that name. For None, the newest run in `log_dir`, or the package's policy of a task
        whose default folder of runs is empty.
    """
    if str(path) in POLICIES and not os.path.isdir(path):
        return pretrained_checkpoint(str(path))
    try:
        run = named_run(path, log_dir)
    except UserError:
        folders = {runs_folder(find_task(t)): policy for t, policy in POLICY_OF_TASK.items()}
        if path is not None or log_dir not in folders:
            raise
        console.out(f"no run in {log_dir}: using the policy that comes with the package")
        return pretrained_checkpoint(folders[log_dir])
    if not os.path.isdir(run):
        raise UserError(
            f"there is no run {run}, and no policy of this name; give a run's folder such as "
            f"runs/bounce_ball/<time stamp>, or {', '.join(POLICIES)}"
        )
    if run != path:
        for line in _introduction(run, log_dir):
            console.out(line, highlight=False)
    return find_checkpoint(run)


def _introduction(run: Path, log_dir: Path) -> Iterator[str]:
    """Lines that say which run is used, how good it is, and which run may be meant instead."""
    results = load_results(_best_seed(run))
    yield f"using the newest run: {run} ({results.best.summary if results else 'not evaluated'})"
    if results is None or not results.best.passed:
        for other in sorted(_runs(log_dir), key=_started, reverse=True):
            # A damaged file of another run is no reason to stop.
            with contextlib.suppress(UserError):
                found = load_results(_best_seed(other)) if _has_checkpoint(other) else None
                if found is not None and found.best.passed:
                    yield f"an older run met all its results: {other}"
                    break
    newest = max(_runs(log_dir), key=_started)
    if newest != run:
        yield f"a newer run has no checkpoint yet: {newest}"


def stored_checkpoints(folder: Path) -> dict[int, Path]:
    """Checkpoints in a folder by their steps."""
    paths = []
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        # One look, as a training may rename them meanwhile.
        paths = [folder / entry.name for entry in entries if entry.is_dir()]
    # A checkpoint marked as replaced counts until its successor is in place.
    for suffix in ("", REPLACED):
        fitting = [path for path in paths if path.suffix == suffix]
        if found := {int(p.stem): p for p in fitting if p.stem.isdecimal()}:
            return found
    return {}


def replacement(folder: Path) -> Path | None:
    """The checkpoint that a training has put in the place of another one; None if there is none, or
    the other one is still there."""
    stored = stored_checkpoints(folder.parent) if folder.stem.isdecimal() else {}
    return None if folder in stored.values() or not stored else stored[max(stored)]


def _best_seed(run: Path) -> Path:
    """Folder of a run's best seed; the run itself if it has one seed."""
    results = {seed: load_results(seed) for seed in runs_of_seeds(run) if seed != run}
    scores = {seed: found.best.score for seed, found in results.items() if found}
    return max(scores, key=scores.get, default=run)


def _runs(log_dir: Path) -> list[Path]:
    """Folders of runs, with and without a checkpoint, whose names can be printed."""
    configs = filter(os.path.isfile, log_dir.glob(f"*/{CONFIG_FILE}"))
    return [path.parent for path in configs if not _CONTROL.search(path.parent.name)]


def _started(run: Path) -> tuple[float, int, str]:
    """Sort key of the time at which a run was started: by the time stamp in its name, or without
    one, by the time at which its config was written."""
    found = re.search(r"(\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d)(?:_(\d+))?", run.name)
    if found is not None:
        with contextlib.suppress(ValueError, OverflowError):
            time = datetime.datetime.strptime(found[1], _STAMP).replace(tzinfo=datetime.UTC)
            return time.timestamp(), int(found[2] or 1), run.name
    return os.path.getmtime(run / CONFIG_FILE), 1, run.name


def _has_checkpoint(run: Path) -> bool:
    return any(stored_checkpoints(folder) for folder in (run / CHECKPOINTS).glob("*"))


def _checkpoint_in(run: Path, named: Path, *folders: Path) -> Checkpoint:
    """The newest checkpoint in the first of the folders that has one.

    Args:
      named: what the user named, for the error.
    """
    for folder in folders:
        if stored := stored_checkpoints(folder.absolute()):
            return Checkpoint(run, stored[max(stored)], max(stored))
    raise UserError(
        f"{named} has no checkpoint, because the first one follows the first evaluation; train "
        "longer or give another run's folder"
    )
