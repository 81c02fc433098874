"""Folders of runs and checkpoints, and functions that find them. Everywhere, a `run` is the path of
a run's folder, or of a seed's, which looks like one (`training.run.Run` reads it for a user); a
`place` is that or a path in it, such as a checkpoint.

    runs/<task>/<time stamp, UTC>/      <task> as in `runs_folder`: that of bounce is bounce_ball
        config.yaml                     the resolved config
        robot/                          a copy of --mjcf and its files, with a manifest
        task/, algorithm/               copies of the code of own ones
        events.out.tfevents.*           TensorBoard scalars
        results.json                    all evaluations, and the time of each activity
        report.html, video/             of `train`, with --report and --video
        robustness.*, failures.png      of the commands `robustness` and `eval --failures`
        checkpoints/<number>/           the newest states, as many as keep_checkpoints says, and
                                        the best evaluation
            policy/                     the policy's arrays
            training/                   the training state's arrays; only where a run can resume
            networks/                   both networks, for another training; not of every algorithm
            record/                     the steps, the config, the evaluations so far and its own
            manifest.json               size and SHA-256 of every other file
        checkpoints/<number>.damaged    a damaged one, which a resumed training has set aside

A checkpoint's number is that of the steps trained; see `Checkpoint`.

A run with several seeds has one folder per seed, such as seed_003/, with the layout of a run with
one seed and its best checkpoint, without training/. The run's own checkpoints/ hold the state of
all seeds: training/ and record/ alone.

What finds them, and raises a `UserError` where there is nothing:

| from | function | finds |
|---|---|---|
| a user's word, or none | `place_or_newest` | the place that it names, or the newest run |
| | `choose_checkpoint` | the checkpoint to show: of the word, the newest run or the package |
| a place | `run_of` | its run |
| a place, or a policy's name | `find_checkpoint` | the best checkpoint there, of the best seed |
| a run's or a seed's own folder | `best_checkpoint`, `latest_checkpoint` | one of its own |
| | `stored_checkpoints`, `runs_of_seeds` | all of its checkpoints or seeds |
| a folder of runs | `runs_in` | all runs that have a checkpoint |
"""

import contextlib
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from bounce_mjx.errors import UserError, suggest, warn_once
from bounce_mjx.resources import (
    POLICIES,
    PRETRAINED,
    TASK_POLICIES,
    policy_folder,
    policy_path,
    resource_path,
)
from bounce_mjx.runs.config import CONFIG_FILE, ROBOT, load_run_config, runs_folder
from bounce_mjx.runs.progress import load_results
from bounce_mjx.runs.records import Checkpoint, DamagedCheckpoint, Record, verify
from bounce_mjx.task.registry import DEFAULT, find_task

LATEST = "latest"
"""Name of the newest run on the command line."""
CHECKPOINTS = "checkpoints"

MIRROR_LAW = Checkpoint(Path("mirror law"), Path("mirror law"), 0)
"""In place of a checkpoint, the baseline `baselines.mirror`."""


def is_users_run(run: Path) -> bool:
    """Whether this is the folder of a run of the user's, beside whose files others may be written;
    no policy of the package, by whatever path, and not the mirror law."""
    if run == MIRROR_LAW.run:
        return False
    policies = {os.path.realpath(resource_path(folder)) for folder in POLICIES.values()}
    return os.path.realpath(run) not in policies


def runs_of_seeds(run: Path) -> list[Path]:
    """Existing folders of a run's seeds, such as seed_003; the run itself if it has one seed."""
    found = []
    for path in run.glob("seed_*"):
        if re.fullmatch("seed_[0-9]+", path.name) and not path.is_symlink():
            found.append(path)
    return sorted(found) or [run]


def run_of(place: Path) -> Path:
    """Folder of the run of a place."""
    # Unlike os.path.isdir, Path.is_dir raises an error for a name that is too long.
    if not os.path.isdir(place):
        near = suggest(str(place), [LATEST, *POLICIES])
        advice = near or "give a run's folder such as runs/bounce_ball/<time stamp>"
        raise UserError(f"there is no run and no policy {place}; {advice}")
    for folder in (place, *Path(os.path.abspath(place)).parents):
        if (folder / CONFIG_FILE).is_file():
            return folder
    if runs := runs_in(place):
        raise UserError(f"{place} is a folder of runs; give one of them, such as {runs[-1]}")
    raise UserError(
        f"{place} is not in a run's folder, as there is no {CONFIG_FILE}; give a folder that "
        "bounce-mjx train made"
    )


def means_newest(path: Path | None) -> bool:
    """Whether what the user gives as a run means the newest one: nothing, or `LATEST` unless there
    is a folder with that name."""
    return path is None or (str(path) == LATEST and not os.path.isdir(path))


def check_log_dir(paths: Sequence[Path | None]) -> None:
    """Checks that --log-dir, where the newest run is looked for, has an effect.

    Args:
      paths: what the user gives as runs.

    Raises:
      UserError: each is that of a run or a policy.
    """
    if not any(map(means_newest, paths)):
        raise UserError(
            f"--log-dir is where the newest run is looked for, and {paths[0]} is named; omit one "
            "of them"
        )


def place_or_newest(path: Path | None, log_dir: Path) -> Path:
    """The place that the user names; where that is none (`means_newest`), the newest run with a
    checkpoint in `log_dir`."""
    if not means_newest(path):
        return path
    if not (found := runs_in(log_dir)):
        raise UserError(
            f"there is no run with a checkpoint in {log_dir}; train one with bounce-mjx train, or "
            "give a run's folder"
        )
    return found[-1]


def runs_in(folder: Path) -> list[Path]:
    """Runs with a checkpoint in a folder, such as those of several seeds, the oldest first by the
    time stamps of their names; before them, names without a stamp."""
    runs = [path.parent for path in folder.glob(f"*/{CONFIG_FILE}") if path.is_file()]
    # The length orders the numbers of runs that began in the same second.
    stamp = len("2026-01-31_23-59-59")
    runs.sort(key=lambda run: (run.name[0].isdigit(), run.name[:stamp], len(run.name), run.name))
    return list(filter(stored_checkpoints, runs))


def find_checkpoint(path: str | Path) -> Checkpoint:
    """Finds a checkpoint.

    Args:
      path: a run's folder (finds its best checkpoint, or its latest if there is no best), a folder
        of checkpoints in it, or a checkpoint; or a name in `POLICIES`, unless there is a folder
        with that name.

    Raises:
      UserError: there is none, or it holds the state of several seeds, and no policy.
    """
    place = policy_path(path)
    run = run_of(place)
    if os.path.samefile(place, run):
        run = _best_seed(run)
        place = run
    seeds = runs_of_seeds(run)
    if seeds == [run]:
        return best_checkpoint(run, place)
    advice = f"give {run} for its best policy, or a seed such as {seeds[0]}"
    if place == run:
        advice = f"no policy is evaluated yet; resume it: bounce-mjx train {run}"
    state = f"holds the state of all {len(seeds)} seeds, with which a training resumes"
    raise UserError(f"{place} {state}; {advice}")


def latest_checkpoint(run: Path, place: Path | None = None) -> Checkpoint:
    """Newest checkpoint of a run that is intact, or its only one, from which its training resumes.

    Args:
      place: folder of the run in which it lies; that of a checkpoint finds this one.
    """
    return max(_intact_checkpoints(run, place), key=lambda checkpoint: checkpoint.number)


def best_checkpoint(
    run: Path, place: Path | None = None, newest: Checkpoint | None = None
) -> Checkpoint:
    """Intact checkpoint of a run with the best evaluation; among equals and without one, the
    newest.

    Args:
      place: see `latest_checkpoint`.
      newest: the newest one that counts; None if all do.
    """
    records = _intact_checkpoints(run, place, newest)

    def quality(checkpoint: Checkpoint) -> tuple[Any, ...]:
        record = records[checkpoint]
        # One without an evaluation is below any.
        score = record.report.score if record and record.report else ()
        return score, checkpoint.number

    return max(records, key=quality)


def _intact_checkpoints(
    run: Path, place: Path | None, newest: Checkpoint | None = None
) -> dict[Checkpoint, Record | None]:
    """The intact checkpoints in a folder of a run, at least one, with their records. A warning
    names the damaged ones.

    A single checkpoint is not read, and has None for its record, as there is nothing to compare it
    with: if it is damaged, whoever reads it refuses it.
    """
    stored = _checkpoints_in(run, place or run)
    if newest is not None:
        stored = [checkpoint for checkpoint in stored if checkpoint.number <= newest.number]
    if len(stored) == 1:
        return {stored[0]: None}
    intact: dict[Checkpoint, Record | None] = {}
    damaged: list[DamagedCheckpoint] = []
    for checkpoint in stored:
        try:
            intact[checkpoint] = verify(checkpoint)
        except DamagedCheckpoint as error:
            # A training may have replaced it meanwhile.
            if checkpoint.folder.exists():
                damaged.append(error)
    if damaged and not intact:
        raise damaged[-1]
    for error in damaged:
        warn_once(f"{error.damage}; another one is used")
    if not intact:
        # A training has replaced all of them meanwhile.
        return _intact_checkpoints(run, place, newest)
    return intact


def set_damaged_aside(run: Path) -> list[Path]:
    """Renames the damaged checkpoints of a run, so that no save removes what may be repaired; their
    new folders. One that cannot be renamed stays."""
    aside = []
    for checkpoint in stored_checkpoints(run):
        try:
            verify(checkpoint)
        except DamagedCheckpoint:
            with contextlib.suppress(OSError):
                aside.append(checkpoint.folder.rename(_free_name(f"{checkpoint.folder}.damaged")))
    return aside


def _free_name(path: str) -> Path:
    """The path if there is nothing, or else with the first number that is free, from _2."""
    free = path
    number = 2
    while os.path.lexists(free):
        free = f"{path}_{number}"
        number += 1
    return Path(free)


def choose_checkpoint(
    path: Path | None, log_dir: Path, tell: Callable[[str], None] = print
) -> Checkpoint:
    """Checkpoint that a path stands for, to show or to evaluate.

    Args:
      path: see `find_checkpoint`; or `LATEST` or a name in `POLICIES`, unless there is a folder
        with that name. For None, the newest run in `log_dir`, or the package's policy of a task
        whose default folder of runs is empty.
      tell: gets a line about the choice if the user made none.
    """
    if policy_folder(path):
        return find_checkpoint(path)
    try:
        place = place_or_newest(path, log_dir)
    except UserError:
        policy = _policy_of_folder(log_dir)
        if path is not None or policy is None:
            raise
        tell(f"no run in {log_dir}: using the policy that comes with the package")
        return find_checkpoint(resource_path(POLICIES[policy]))
    if place != path:
        results = load_results(_best_seed(place))
        known = results.best.summary if results else "not evaluated"
        tell(f"using the newest run: {place}{_arm_of(place)} ({known})")
    return find_checkpoint(place)


def _arm_of(run: Path) -> str:
    """The arm of a run in words, as a folder has the runs of all arms; empty for the project's own,
    and for a run whose config cannot be read."""
    try:
        mjcf = load_run_config(run).env.mjcf
    except UserError:
        return ""
    if mjcf is None:
        return ""
    # The run's own copy is in a folder of one name for all arms.
    is_copy = mjcf.parent.name == ROBOT
    return f" of the arm {mjcf.stem if is_copy else f'{mjcf.parent.name}/{mjcf.name}'}"


def _policy_of_folder(log_dir: Path) -> str | None:
    """Name of the package's policy of the task whose default folder of runs this is."""
    policies = {DEFAULT: PRETRAINED}
    for task in TASK_POLICIES:
        policies[task] = task
    for task, policy in policies.items():
        if log_dir == runs_folder(find_task(task)):
            return policy
    return None


def stored_checkpoints(run: Path) -> list[Checkpoint]:
    """Checkpoints of a run."""
    folder = Path(os.path.abspath(run / CHECKPOINTS))
    paths = []
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        # One look, as a training may remove them meanwhile.
        paths = [folder / entry.name for entry in entries if entry.name.isdecimal()]
    return [Checkpoint(run, path, int(path.name)) for path in paths if path.is_dir()]


def _checkpoints_in(run: Path, place: Path) -> list[Checkpoint]:
    """The checkpoints of a run in one of its folders, at least one."""
    place = Path(os.path.abspath(place))
    stored = stored_checkpoints(run)
    inside = [checkpoint for checkpoint in stored if checkpoint.folder.is_relative_to(place)]
    if not stored:
        raise UserError(
            f"{run} has no checkpoint, as its training ended before the first one or another "
            "version wrote it; start again"
        )
    if not inside:
        raise UserError(f"{place} holds no checkpoint of its run; give {run}, or one of its own")
    return inside


def _best_seed(run: Path) -> Path:
    """Folder of a run's best seed; the run itself if it has one seed."""
    scores = {}
    for folder in runs_of_seeds(run):
        results = None if folder == run else load_results(folder)
        if results is not None:
            scores[folder] = results.best.score
    return max(scores, key=scores.get, default=run)
