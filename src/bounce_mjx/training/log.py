"""A callback that logs for TensorBoard."""

import contextlib
import os
import re
import struct
import sys
import time
from pathlib import Path
from typing import Any

from bounce_mjx.config.files import flat
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.training.events import Event

# TensorBoard reads the files whose names have it.
_NAME = "events.out.tfevents"
_STAMP = re.compile(rf"{re.escape(_NAME)}\.(\d+)")


class TensorBoardLog:
    """A log in the folder of each run. What cannot be written, as on a full disk, is lost; the log
    stays readable, and goes on once there is room.

    TensorboardX's `SummaryWriter` has a thread, which the first error ends, and then its queue
    blocks for ever.
    """

    def __init__(self, resumed: int | None = None):
        """
        Args:
          resumed: the step from which a resumed run continues; TensorBoard drops all later points.
        """
        # Imported here, as the imports take a quarter of a second; and without PyTorch, which
        # tensorboardX imports where it is installed and which takes four seconds.
        is_free = sys.modules.setdefault("torch", None) is None
        try:
            from tensorboardX import record_writer, summary
            from tensorboardX.proto import event_pb2
        finally:
            if is_free:
                del sys.modules["torch"]
        self.summary = summary
        self._event = event_pb2.Event
        self._session_log = event_pb2.SessionLog
        self._checksum = record_writer.masked_crc32c
        self._resumed = resumed
        self._files: dict[Path, _LogFile] = {}

    def start(self, run: Path, config: TrainConfig) -> None:
        """Logs the config as hyperparameters."""
        plain = {}
        for name, value in flat(config.model_dump(mode="json")).items():
            plain[name] = value if isinstance(value, int | float) else str(value)
        shown = dict.fromkeys(("results/mean_return", "episode/return"), 0.0)
        for part in self.summary.hparams(plain, shown):
            self.add(run, 0, summary=part)

    def __call__(self, event: Event) -> None:
        """Writes the points of an event."""
        values = []
        for name, value in event.metrics.items():
            values += self.summary.scalar(name, value).value
        self.add(event.run, event.steps, summary=self.summary.Summary(value=values))

    def add(self, folder: Path, steps: int, **content: Any) -> None:
        """Writes an entry into the log of a folder, which exists."""
        if folder not in self._files:
            self._files[folder] = _LogFile(folder, self._head())
        self._files[folder].write(self._record(step=steps, **content))

    def _head(self) -> bytes:
        """The first entries of a file."""
        head = self._record(file_version="brain.Event:2")
        if self._resumed is not None:
            start = self._session_log(status=self._session_log.START)
            head += self._record(step=self._resumed + 1, session_log=start)
        return head

    def _record(self, **content: Any) -> bytes:
        """An entry in the format of TensorBoard's files."""
        data = self._event(wall_time=time.time(), **content).SerializeToString()
        length = struct.pack("<Q", len(data))
        return length + self._checksum_of(length) + data + self._checksum_of(data)

    def _checksum_of(self, content: bytes) -> bytes:
        return struct.pack("<I", self._checksum(content))


class _LogFile:
    """A file of entries, which has each of them whole or not at all."""

    def __init__(self, folder: Path, head: bytes):
        """
        Args:
          head: what the file begins with.
        """
        # TensorBoard reads files in the order of their names, and the clock may have been set back.
        stamp = int(time.time())
        for path in folder.glob(f"{_NAME}.*"):
            if found := _STAMP.match(path.name):
                stamp = max(stamp, int(found[1]) + 1)
        self._path = folder / f"{_NAME}.{stamp:010d}.{os.getpid()}"
        self._head = head
        self._file = None

    def write(self, entry: bytes) -> None:
        """Writes an entry, unless there is no room for it."""
        with contextlib.suppress(OSError):
            if self._file is None:
                self._file = self._path.open("xb", buffering=0)
            size = self._file.tell()
            content = entry if size else self._head + entry
            written = 0
            try:
                written = self._file.write(content)
            finally:
                if written != len(content):
                    self._file.truncate(size)
                    self._file.seek(size)
