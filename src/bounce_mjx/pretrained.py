"""The trained policy that comes with the package, and the choice of a checkpoint.

`pretrained/` has the layout of a run's folder without what only training needs; the command
`python -m bounce_mjx.ship RUN` makes it.
"""

from pathlib import Path

from bounce_mjx.errors import UserError
from bounce_mjx.resources import resource_path
from bounce_mjx.runs import Checkpoint, find_checkpoint, newest_run

PRETRAINED = "pretrained"


def pretrained_checkpoint() -> Checkpoint:
    """The checkpoint that comes with the package."""
    folder = resource_path(PRETRAINED)
    return find_checkpoint(folder, folder)


def choose_checkpoint(path: Path | None, log_dir: Path) -> Checkpoint:
    """The checkpoint to show or to evaluate.

    Args:
      path: as `find_checkpoint` takes it; None for the newest run in `log_dir`, or the policy that
        comes with the package where `log_dir` holds no run.

    Raises:
      UserError: there is none at `path`.
    """
    if path is not None:
        return find_checkpoint(path, log_dir)
    try:
        return find_checkpoint(newest_run(log_dir), log_dir)
    except UserError:
        if log_dir.exists():
            raise
        return pretrained_checkpoint()
