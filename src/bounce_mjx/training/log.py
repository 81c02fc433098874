"""A callback that logs for TensorBoard."""

import sys
import time
from pathlib import Path
from typing import Any

from bounce_mjx.config.files import flat
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.training.events import Event


class TensorBoardLog:
    """A log in the folder of each run. What cannot be written, as on a full disk, is lost.

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
            from tensorboardX import event_file_writer, summary
            from tensorboardX.proto import event_pb2
        finally:
            if is_free:
                del sys.modules["torch"]
        self.summary, self._events = summary, event_pb2
        self._new_writer = event_file_writer.EventsWriter
        self._resumed, self._writers = resumed, {}

    def start(self, run: Path, config: TrainConfig) -> None:
        """Logs the config as hyperparameters."""
        if self._resumed is not None:
            start = self._events.SessionLog(status=self._events.SessionLog.START)
            self.add(run, self._resumed + 1, session_log=start)
        plain = flat(config.model_dump(mode="json")).items()
        plain = {name: x if isinstance(x, int | float) else str(x) for name, x in plain}
        shown = dict.fromkeys(("results/mean_return", "episode/return"), 0.0)
        for part in self.summary.hparams(plain, shown):
            self.add(run, 0, summary=part)

    def __call__(self, event: Event) -> None:
        """Writes the points of an event."""
        values = (self.summary.scalar(*point).value[0] for point in event.metrics.items())
        self.add(event.run, event.steps, summary=self.summary.Summary(value=values))

    def add(self, folder: Path, steps: int, **content: Any) -> None:
        """Writes an entry as tensorboardX makes it. A file with one that is only half written ends
        there for its readers, so that a new one follows it."""
        try:
            if folder not in self._writers:
                folder.mkdir(parents=True, exist_ok=True)
                # Logs that are opened in the same second need different names.
                writer = self._new_writer(f"{folder / 'events'}", f".{time.time_ns()}")
                self._writers[folder] = writer
            entry = self._events.Event(wall_time=time.time(), step=steps, **content)
            self._writers[folder].write_event(entry)
            self._writers[folder].flush()
        except OSError:
            self._writers.pop(folder, None)
