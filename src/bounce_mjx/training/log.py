"""The logs of a training run: TensorBoard, and Weights & Biases if it is asked for."""

import contextlib
import hashlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from bounce_mjx.config.files import dump_config
from bounce_mjx.errors import UserError, reason_of
from bounce_mjx.runs.config import TrainConfig

# Time after which points appear in TensorBoard, s.
_FLUSH_SECONDS = 10.0


def open_log(
    run: Path,
    first_step: int | None = None,
    suffix: str = "",
    config: TrainConfig | None = None,
    wandb: str | None = None,
) -> "TensorBoardLog":
    """Opens a TensorBoard log in a run's folder.

    Args:
      first_step: the step from which a resumed run continues; TensorBoard drops all later points.
      suffix: suffix of the file's name; two logs opened in the same second need different suffixes.
      config: the run's config, to be logged as text.
      wandb: project of Weights & Biases that receives the scalars too; needs the config.
    """
    log = TensorBoardLog(run, suffix) if wandb is None else WandbLog(run, wandb, config)
    if first_step is not None:
        log.purge(first_step + 1)
    if config is not None:
        log.add_text("config", f"```yaml\n{dump_config(config)}```", first_step or 0)
    return log


class TensorBoardLog:
    """A log for TensorBoard. What cannot be written, as on a full disk, is lost up to the next
    `flush` that succeeds.

    TensorboardX's `SummaryWriter` has a thread, which the first error ends, and then its queue
    blocks for ever.
    """

    def __init__(self, run: Path, suffix: str = ""):
        from tensorboardX import event_file_writer, summary
        from tensorboardX.proto import event_pb2

        self._summary, self._events = summary, event_pb2
        self._new_writer = event_file_writer.EventsWriter
        self._run, self._suffix, self._files = run, suffix, 0
        self._writer, self._flushed = None, time.monotonic()
        run.mkdir(parents=True, exist_ok=True)
        self.flush()

    def add_scalar(self, name: str, value: float, steps: int) -> None:
        self._add(step=steps, summary=self._summary.scalar(name, value))

    def add_text(self, name: str, text: str, steps: int) -> None:
        self._add(step=steps, summary=self._summary.text(name, text))

    def add_image(self, name: str, pixels: np.ndarray, steps: int) -> None:
        """Adds a picture [height, width, 3]."""
        self._add(step=steps, summary=self._summary.image(name, pixels, dataformats="HWC"))

    def purge(self, steps: int) -> None:
        """Makes TensorBoard drop the points of earlier files at these steps and later."""
        start = self._events.SessionLog(status=self._events.SessionLog.START)
        self._add(step=steps, session_log=start)

    def flush(self) -> None:
        """Writes everything to the file. A file with a point that is only half written ends there
        for its readers, so that a new one follows it."""
        self._flushed = time.monotonic()
        with self._losing():
            if self._writer is None:
                number = f".{self._files}" if self._files else ""
                self._files += 1
                self._writer = self._new_writer(f"{self._run / 'events'}", self._suffix + number)
            self._writer.flush()

    def close(self) -> None:
        self.flush()

    def _add(self, **content: Any) -> None:
        event = self._events.Event(wall_time=time.time(), **content)
        with self._losing():
            if self._writer is not None:
                self._writer.write_event(event)
        if time.monotonic() - self._flushed > _FLUSH_SECONDS:
            self.flush()

    @contextlib.contextmanager
    def _losing(self) -> Iterator[None]:
        """Around an operation on the file; after an error, nothing more goes there."""
        try:
            yield
        except OSError:
            self._writer = None


class WandbLog(TensorBoardLog):
    """A TensorBoard log whose scalars go to a run of Weights & Biases too; the run has the config
    and the results by itself. A resumed training continues its run."""

    def __init__(self, run: Path, project: str, config: TrainConfig):
        """
        Raises:
          UserError: Weights & Biases refuses the run, for example without an account.
        """
        super().__init__(run)
        # Imported only when it is asked for; it is optional and takes seconds.
        import wandb

        try:
            self._tracker = wandb.init(
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
        super().add_scalar(name, value, steps)
        self._tracker.log({name: value}, step=steps)

    def close(self) -> None:
        super().close()
        self._tracker.finish()
