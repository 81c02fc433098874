"""Folders of runs and checkpoints, and functions that find them.

    runs/<task>/<time stamp, UTC>/
        config.yaml                     the resolved config
        robot/                          a copy of --mjcf and its files (`runs.robot`)
        task/, algorithm/               copies of the files of own ones (`runs.task`)
        events.out.tfevents.*           TensorBoard scalars
        results.json                    all evaluations, and the time of each activity
        checkpoints/<steps>/            of the newest state, and of the one with the best evaluation
            policy/                     the policy's arrays
            training/                   the training state's arrays; optional
            networks/                   both networks, for another training; optional
            record/                     the steps, the config, the evaluations so far
            metrics/                    the score of the evaluation
            manifest.json               size and SHA-256 of every other file

A run with several seeds has one folder per seed, such as seed_003/, with the layout of a run with
one seed; the run's own checkpoints/ holds the state of all seeds.

Functions that search raise a `UserError` if they find nothing.
"""

import contextlib
import datetime
import itertools
import json
import os
import re
import shutil
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

import bounce_mjx
from bounce_mjx.config.files import dump_config
from bounce_mjx.errors import UserError
from bounce_mjx.resources import POLICIES, PRETRAINED, TASK_POLICIES, resource_path
from bounce_mjx.runs import old
from bounce_mjx.runs.config import BASE, CONFIG_FILE, TrainConfig, runs_folder
from bounce_mjx.runs.files import writable, write_atomically
from bounce_mjx.runs.progress import load_results
from bounce_mjx.runs.robot import ROBOT, copy_robot
from bounce_mjx.runs.task import copy_code
from bounce_mjx.tasks.registry import DEFAULT, find_task, is_file

POLICY_OF_TASK = {DEFAULT: PRETRAINED} | {task: task for task in TASK_POLICIES}
"""The policy that comes with the package for a task."""
LATEST = "latest"
"""Name of the newest run on the command line."""
CHECKPOINTS = "checkpoints"
_STAMP = "%Y-%m-%d_%H-%M-%S"


class Checkpoint(NamedTuple):
    """Location of a checkpoint."""

    run: Path
    """The run's folder."""
    folder: Path
    """The checkpoint's own folder."""
    steps: int
    """Its number: the environment steps trained, or one more where a checkpoint without an
    evaluation had that number."""


MIRROR_LAW = Checkpoint(Path("mirror law"), Path("mirror law"), 0)
"""In place of a checkpoint, the baseline `baselines.mirror`."""


def refuse_brackets(folder: Path) -> None:
    """UserError if orbax would lose arrays in this folder: its search takes brackets for a
    pattern."""
    if "[" in str(folder.absolute()):
        raise UserError(
            f"{folder.absolute()} has a square bracket, and orbax loses the arrays of checkpoints "
            "in such a folder; give --log-dir, or move the run to, a folder without one"
        )


def create_run(config: TrainConfig) -> Path:
    """Creates a new run's folder, named after the current time (UTC), with the config in it.

    Raises:
      UserError: the folder cannot be written, or the robot cannot be copied into it.
    """
    refuse_brackets(config.log_dir)
    # Not the local time, which is another one on another machine, and in autumn goes back.
    stamp = datetime.datetime.now(datetime.UTC).strftime(_STAMP)
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
    """Writes the run's resolved config, and copies of its robot and of its task's file unless the
    run has them."""
    if is_file(config.task):
        config = config.model_copy(update={"task": copy_code(config.task, run)})
    if is_file(config.algorithm):
        copied = copy_code(config.algorithm, run, "algorithm")
        config = config.model_copy(update={"algorithm": copied})
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
    return sorted(filter(stored_checkpoints, _runs(folder)), key=_started)


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
    inside = [x for x in stored_checkpoints(run) if x.folder.is_relative_to(place)]
    return _first_of(_by_quality(inside), path)


def latest_checkpoint(run: Path) -> Checkpoint:
    """Newest checkpoint of a run, from which its training resumes."""
    return _first_of(sorted(stored_checkpoints(run), key=lambda x: -x.steps), run)


def best_checkpoint(run: Path) -> Checkpoint:
    """Checkpoint of a run with the best evaluation; without one, the newest."""
    return _first_of(_by_quality(stored_checkpoints(run)), run)


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
        results = load_results(_best_seed(run))
        known = results.best.summary if results else "not evaluated"
        console.out(f"using the newest run: {run} ({known})", highlight=False)
    return find_checkpoint(run)


def stored_checkpoints(run: Path) -> list[Checkpoint]:
    """Checkpoints of a run."""
    folder, paths = Path(os.path.abspath(run / CHECKPOINTS)), []
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        # One look, as a training may remove them meanwhile.
        paths = [folder / entry.name for entry in entries if entry.name.isdecimal()]
    paths = paths or [path for name in ("best", "latest") for path in old.stored(folder, name)]
    return [Checkpoint(run, path, int(path.name)) for path in paths if path.is_dir()]


def _first_of(checkpoints: list[Checkpoint], named: Path) -> Checkpoint:
    """
    Args:
      named: what the user named, for the error.
    """
    if not checkpoints:
        raise UserError(
            f"{named} has no checkpoint, because the first one follows the first evaluation; train "
            "longer or give another run's folder"
        )
    return checkpoints[0]


def _by_quality(checkpoints: list[Checkpoint]) -> list[Checkpoint]:
    """Checkpoints, the best one first; among equals, the newest."""
    return sorted(checkpoints, key=lambda x: (_score(x.folder), x.steps), reverse=True)


def _score(folder: Path) -> tuple[float, ...]:
    """Quality of a checkpoint, greater than () if it was evaluated."""
    if folder.parent.name == "best":
        return (0.0,)
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError):
        return tuple(json.loads((folder / "metrics/metrics").read_bytes())["score"])
    return ()


def _best_seed(run: Path) -> Path:
    """Folder of a run's best seed; the run itself if it has one seed."""
    results = {seed: load_results(seed) for seed in runs_of_seeds(run) if seed != run}
    scores = {seed: found.best.score for seed, found in results.items() if found}
    return max(scores, key=scores.get, default=run)


def _runs(log_dir: Path) -> list[Path]:
    """Folders of runs, with and without a checkpoint."""
    return [path.parent for path in log_dir.glob(f"*/{CONFIG_FILE}") if path.is_file()]


def _started(run: Path) -> tuple[float, int, str]:
    """Sort key of the time at which a run was started: by the time stamp in its name, or without
    one, by the time at which its config was written."""
    found = re.search(r"(\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d)(?:_(\d+))?", run.name)
    if found is not None:
        with contextlib.suppress(ValueError, OverflowError):
            time = datetime.datetime.strptime(found[1], _STAMP).replace(tzinfo=datetime.UTC)
            return time.timestamp(), int(found[2] or 1), run.name
    return os.path.getmtime(run / CONFIG_FILE), 1, run.name
