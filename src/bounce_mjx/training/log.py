"""The logs of a training run: TensorBoard, and Weights & Biases if it is asked for."""

import contextlib
import hashlib
import socket
import struct
import sys
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
    """A file for TensorBoard. While the disk is full, its data waits in memory.

    TensorboardX's own writer has a queue, which its `flush` does not empty, and a thread, which the
    first error of a full disk ends.
    """

    def __init__(self, run: Path, suffix: str = ""):
        with _not_importable("torch"):
            from tensorboardX import summary
            from tensorboardX.proto import event_pb2
            from tensorboardX.record_writer import masked_crc32c
        self._summary, self._events, self._checksum = summary, event_pb2, masked_crc32c
        run.mkdir(parents=True, exist_ok=True)
        # TensorBoard reads the files in the order of these numbers, and a clock may go back.
        earlier = [
            int(n)
            for path in run.glob("events.out.tfevents.*")
            if (n := path.name.split(".")[3]).isdecimal()
        ]
        started = max([int(time.time()), *(number + 1 for number in earlier)])
        self._path = run / f"events.out.tfevents.{started}.{socket.gethostname()}{suffix}"
        self._waiting, self._flushed = bytearray(), time.monotonic()
        self._add(file_version="brain.Event:2")

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
        """Writes everything to the file, as far as there is room."""
        self._flushed = time.monotonic()
        with contextlib.suppress(OSError), self._path.open("ab", buffering=0) as file:
            while self._waiting:
                del self._waiting[: file.write(self._waiting)]

    def close(self) -> None:
        self.flush()

    def _add(self, **content: Any) -> None:
        """Adds an event as a TFRecord: its length and its bytes, each with a checksum."""
        event = self._events.Event(wall_time=time.time(), **content).SerializeToString()
        for part in (struct.pack("<Q", len(event)), event):
            self._waiting += part + struct.pack("<I", self._checksum(part))
        if time.monotonic() - self._flushed > _FLUSH_SECONDS:
            self.flush()


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
        super().add_scalar(name, value, steps)
        self._run.log({name: value}, step=steps)

    def close(self) -> None:
        super().close()
        self._run.finish()


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
