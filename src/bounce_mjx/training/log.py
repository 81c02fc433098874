"""The logs of a training: TensorBoard, and Weights & Biases if it is asked for."""

import contextlib
import hashlib
import sys
import typing
from collections.abc import Iterator, Sequence
from pathlib import Path

from bounce_mjx.config.files import dump_config
from bounce_mjx.errors import UserError, reason_of
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
    with _not_importable("torch"):
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


class WandbLog:
    """A run of Weights & Biases, with the methods of `SummaryWriter` that a training uses. A
    resumed training continues its run."""

    def __init__(self, run: Path, project: str, config: TrainConfig):
        """
        Raises:
          UserError: Weights & Biases refuses the run, for example without an account.
        """
        # Imported only when it is asked for; it is optional and takes seconds.
        import wandb

        try:
            self._run = wandb.init(
                project=project,
                name=run.name,
                id=hashlib.sha256(str(run.absolute()).encode()).hexdigest()[:16],
                resume="allow",
                reinit="create_new",
                dir=run,
                config=config.model_dump(mode="json"),
            )
        except Exception as error:
            reason = reason_of(error)
            raise UserError(
                f"--wandb {project} is refused ({reason}); run wandb login, or set WANDB_MODE to "
                "offline"
            ) from error

    def add_scalar(self, name: str, value: float, steps: int) -> None:
        self._run.log({name: value}, step=steps)

    def add_text(self, name: str, text: str, steps: int) -> None:
        """Text stays in TensorBoard; the config and the results are in the run already."""

    def flush(self) -> None:
        """Weights & Biases sends its data by itself."""

    def close(self) -> None:
        self._run.finish()


class Logs:
    """Several logs that receive the same."""

    def __init__(self, logs: Sequence["SummaryWriter | WandbLog"]):
        self._logs = logs

    def add_scalar(self, name: str, value: float, steps: int) -> None:
        for log in self._logs:
            log.add_scalar(name, value, steps)

    def add_text(self, name: str, text: str, steps: int) -> None:
        for log in self._logs:
            log.add_text(name, text, steps)

    def flush(self) -> None:
        for log in self._logs:
            log.flush()

    def close(self) -> None:
        for log in self._logs:
            log.close()


@contextlib.contextmanager
def _not_importable(module: str) -> Iterator[None]:
    """Hides an installed module that is not imported yet. TensorBoardX imports PyTorch, for seconds
    in which a short training would wait for its log, only to recognise tensors."""
    if module in sys.modules:
        yield
        return
    # Python's own mark of a module that cannot be imported.
    sys.modules[module] = None
    try:
        yield
    finally:
        del sys.modules[module]


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
