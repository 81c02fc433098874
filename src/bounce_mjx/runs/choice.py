"""The trained policy that comes with the package, and the choice of a checkpoint.

`pretrained/` has the layout of a run's folder, without what only going on needs; the command
`python -m bounce_mjx.ship RUN` makes it.
"""

from pathlib import Path

from rich.console import Console

from bounce_mjx.errors import UserError
from bounce_mjx.resources import resource_path
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.runs.folder import Checkpoint, best_checkpoint, find_checkpoint, newest_run

PRETRAINED = "pretrained"


def pretrained_checkpoint() -> Checkpoint:
    """The checkpoint that comes with the package."""
    return best_checkpoint(resource_path(PRETRAINED))


def choose_checkpoint(path: Path | None, log_dir: Path, console: Console) -> Checkpoint:
    """The checkpoint to show or to evaluate; tells which where none is named.

    Args:
      path: as `find_checkpoint` takes it; None for the newest run in `log_dir`, or for the policy
        that comes with the package where the default folder of runs holds none.

    Raises:
      UserError: there is none.
    """
    if path is not None:
        return find_checkpoint(path, log_dir)
    try:
        run = newest_run(log_dir)
    except UserError:
        if log_dir != TrainConfig().log_dir:
            raise
        console.print(f"no run in {log_dir}: the policy that comes with the package is taken")
        return pretrained_checkpoint()
    console.print(f"the newest run is taken: {run}", highlight=False, soft_wrap=True)
    return find_checkpoint(run, log_dir)
