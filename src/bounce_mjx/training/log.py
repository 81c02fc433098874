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
      first_step: that from which a run is resumed; what was logged later is taken back.
      suffix: of the file's name, which otherwise is that of any log opened in the same second.
      config: of the run, to be logged as text.
    """
    # tensorboardX imports PyTorch where that is installed, which takes seconds; this way they
    # pass beside the compilation.
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
    """How tensorboardX opens the files of a log."""

    def directory_check(self, path: str) -> None:
        Path(path.removeprefix(f"{_LOG_PREFIX}:")).mkdir(parents=True, exist_ok=True)

    def open(self, path: str) -> "_LogFile":
        return _LogFile(Path(path.removeprefix(f"{_LOG_PREFIX}:")))


class _LogFile:
    """A file that keeps what a full disk does not take until it does. With an ordinary one, the
    thread of tensorboardX would end, and with it, in silence, the training."""

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
