"""The TensorBoard log of a training."""

import contextlib
import typing
from pathlib import Path

from bounce_mjx.config.files import dump_config
from bounce_mjx.runs.config import TrainConfig

if typing.TYPE_CHECKING:
    from tensorboardX import SummaryWriter


def open_log(
    run: Path,
    first_step: int | None = None,
    suffix: str = "",
    config: TrainConfig | None = None,
) -> "SummaryWriter":
    """Opens a TensorBoard log in a run's folder.

    Args:
      first_step: the step from which a resumed run continues; TensorBoard drops all later points.
      suffix: suffix of the file's name; two logs opened in the same second need different suffixes.
      config: the run's config, to be logged as text.
    """
    # Imported here because tensorboardX imports PyTorch if it is installed; that takes seconds,
    # which overlap with the compilation.
    from tensorboardX import SummaryWriter
    from tensorboardX.record_writer import register_writer_factory

    register_writer_factory(_LOG_PREFIX, _LogFiles())
    purge_step = None if first_step is None else first_step + 1
    log = SummaryWriter(
        logdir=f"{_LOG_PREFIX}:{run}",
        purge_step=purge_step,
        flush_secs=10,
        filename_suffix=suffix,
    )
    if config is not None:
        log.add_text("config", f"```yaml\n{dump_config(config)}```", first_step or 0)
    return log


_LOG_PREFIX = "bounce_mjx"


class _LogFiles:
    """Opens the files of a log for tensorboardX."""

    def directory_check(self, path: str) -> None:
        Path(path.removeprefix(f"{_LOG_PREFIX}:")).mkdir(parents=True, exist_ok=True)

    def open(self, path: str) -> "_LogFile":
        return _LogFile(Path(path.removeprefix(f"{_LOG_PREFIX}:")))


class _LogFile:
    """A file that keeps its data in memory while the disk is full, and writes it later.

    An ordinary file would raise in tensorboardX's thread: the thread would end, its queue would
    fill up, and the training would hang without a message.
    """

    def __init__(self, path: Path):
        self._path = path
        self._waiting = bytearray()

    def write(self, data: bytes) -> None:
        self._waiting += data

    def flush(self) -> None:
        with contextlib.suppress(OSError), self._path.open("ab", buffering=0) as file:
            while self._waiting:
                del self._waiting[: file.write(self._waiting)]

    def close(self) -> None:
        self.flush()
