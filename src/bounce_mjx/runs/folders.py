"""Where runs and checkpoints lie, and how they are found.

    runs/bounce_ball/<time stamp>/
        config.yaml                     the resolved config
        events.out.tfevents.*           TensorBoard scalars
        results.json                    all evaluations, and where the time went
        checkpoints/latest/<steps>/     the newest state
        checkpoints/best/<steps>/       the state with the best evaluation
            policy/                     the policy, written by orbax
            training/                   the training state, written by orbax; optional
            run.json                    the steps, the config, the evaluations so far
            manifest.json               size and SHA-256 of every other file

A run of several seeds has a folder for each, such as seed_003/, laid out like the folder of a run
of one seed; the run's own checkpoints/latest/ holds the state of all seeds.

Every function that finds something raises a `UserError` where there is nothing to find.
"""

import datetime
import itertools
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Literal, NamedTuple

from rich.console import Console

from bounce_mjx.config.files import dump_config
from bounce_mjx.errors import UserError
from bounce_mjx.resources import resource_path
from bounce_mjx.runs.config import CONFIG_FILE, TrainConfig
from bounce_mjx.runs.files import write_atomically
from bounce_mjx.runs.progress import load_results

CheckpointName = Literal["latest", "best"]
PRETRAINED = "pretrained"
SHIPPED = {PRETRAINED: PRETRAINED, "robust": f"{PRETRAINED}/robust"}
"""Names of the policies that come with the package, and the folders of their runs."""
CHECKPOINTS = "checkpoints"
REPLACED = ".discarded"


class Checkpoint(NamedTuple):
    """Where a checkpoint lies."""

    run: Path
    """The run's folder."""
    folder: Path
    """The checkpoint's own folder."""
    steps: int
    """Environment steps trained."""


def create_run(config: TrainConfig) -> Path:
    """Makes a new run's folder, named by the time, with the config in it.

    Raises:
      UserError: the folder cannot be written.
    """
    stamp = datetime.datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    try:
        config.log_dir.mkdir(parents=True, exist_ok=True)
        for copy in itertools.count(1):
            folder = config.log_dir / (stamp if copy == 1 else f"{stamp}_{copy}")
            try:
                folder.mkdir()
            except FileExistsError:
                continue
            save_config(folder, config)
            return folder
    except OSError as error:
        raise UserError(
            f"the run's folder cannot be made in {config.log_dir} ({error.strerror}); choose a "
            "folder that can be written with --log-dir"
        ) from error


def save_config(run: Path, config: TrainConfig) -> None:
    """Writes the run's resolved config."""
    write_atomically(run / CONFIG_FILE, dump_config(config))


def seed_folders(run: Path, seeds: Iterable[int]) -> list[Path]:
    """The folders of the seeds of a run."""
    return [run / f"seed_{seed:03d}" for seed in seeds]


def runs_of_seeds(run: Path) -> list[Path]:
    """The seeds' folders in a run; the run itself if it has one seed."""
    return sorted(run.glob("seed_*")) or [run]


def find_run(path: Path) -> Path:
    """The run's folder that a path is or lies in."""
    # Unlike Path.is_dir, false for a name that is too long.
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
    """The newest run's folder that holds a checkpoint."""
    found = [p.parent.parent for p in log_dir.glob(f"*/{CHECKPOINTS}/*") if stored_checkpoints(p)]
    if not found:
        raise UserError(
            f"there is no run with a checkpoint in {log_dir}; train one with bounce-mjx train, or "
            "give a run's folder"
        )
    return max(found)


def find_checkpoint(path: Path) -> Checkpoint:
    """Finds a checkpoint.

    Args:
      path: a run's folder (its best checkpoint, or else its latest), a folder of checkpoints in
        it, or a checkpoint itself.
    """
    run, place = find_run(path), Path(os.path.abspath(path))
    if place == Path(os.path.abspath(run)):
        run = _best_seed(run)
        place = Path(os.path.abspath(run))
    elif place in (siblings := stored_checkpoints(place.parent)).values():
        return Checkpoint(run, place, next(n for n, p in siblings.items() if p == place))
    for folder in (place, place / CHECKPOINTS / "best", place / CHECKPOINTS / "latest"):
        if stored := stored_checkpoints(folder):
            return Checkpoint(run, stored[max(stored)], max(stored))
    raise UserError(f"{path} holds no checkpoint; train longer or give another run's folder")


def latest_checkpoint(run: Path) -> Checkpoint:
    """The newest state of a run, from which its training is resumed."""
    return find_checkpoint(run / CHECKPOINTS / "latest")


def best_checkpoint(run: Path) -> Checkpoint:
    """The state of a run with the best evaluation."""
    return find_checkpoint(run / CHECKPOINTS / "best")


def pretrained_checkpoint(name: str = PRETRAINED) -> Checkpoint:
    """The checkpoint of a policy in `SHIPPED`."""
    folder = resource_path(SHIPPED[name])
    if not folder.is_dir():
        others = " or ".join(other for other in SHIPPED if other != name)
        raise UserError(
            f"the policy {name} is not in this version of the package; give {others} or a run's "
            "folder"
        )
    return best_checkpoint(folder)


def choose_checkpoint(path: Path | None, log_dir: Path, console: Console) -> Checkpoint:
    """The checkpoint to show or to evaluate; prints the choice where the user made none.

    Args:
      path: see `find_checkpoint`; or a name in `SHIPPED`, unless there is a folder of that name.
        Where it is None and the default folder of runs is empty, the choice is `PRETRAINED`.
    """
    if str(path) in SHIPPED and not path.is_dir():
        return pretrained_checkpoint(str(path))
    if path is not None:
        return find_checkpoint(path)
    try:
        run = newest_run(log_dir)
    except UserError:
        if log_dir != TrainConfig().log_dir:
            raise
        console.out(f"no run in {log_dir}: using the policy that comes with the package")
        return pretrained_checkpoint()
    console.out(f"using the newest run: {run}", highlight=False)
    return find_checkpoint(run)


def stored_checkpoints(folder: Path) -> dict[int, Path]:
    """The checkpoints in a folder by their steps."""
    # One that is being replaced counts until the next has its place.
    for suffix in ("", REPLACED):
        paths = [p for p in folder.glob("*") if p.suffix == suffix and p.is_dir()]
        if found := {int(p.stem): p for p in paths if p.stem.isdecimal()}:
            return found
    return {}


def _best_seed(run: Path) -> Path:
    """The folder of a run's best seed; the run itself if it has one seed."""
    results = {seed: load_results(seed) for seed in runs_of_seeds(run) if seed != run}
    scores = {seed: found.best.score for seed, found in results.items() if found}
    return max(scores, key=scores.get, default=run)
