"""The TensorBoard log of a run."""

import sys
import time
from pathlib import Path
from typing import Any

from bounce_mjx.config.files import dump_config, flat
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.training.events import Event


class TensorBoardLog:
    """A log for TensorBoard. What cannot be written, as on a full disk, is lost.

    TensorboardX's `SummaryWriter` has a thread, which the first error ends, and then its queue
    blocks for ever.
    """

    def __init__(self, run: Path):
        # Imported here, as the imports take a quarter of a second.
        # TensorboardX imports PyTorch where it is installed, which takes four seconds.
        is_free = sys.modules.setdefault("torch", None) is None
        try:
            from tensorboardX import event_file_writer, summary
            from tensorboardX.proto import event_pb2
        finally:
            if is_free:
                del sys.modules["torch"]
        self.summary, self._events = summary, event_pb2
        self._new_writer = event_file_writer.EventsWriter
        self._run, self._writer = run, None

    def start(self, config: TrainConfig, steps: int | None) -> None:
        """Logs the config, as text and as hyperparameters.

        Args:
          steps: the step from which a resumed run continues; TensorBoard drops all later points.
        """
        if steps is not None:
            start = self._events.SessionLog(status=self._events.SessionLog.START)
            self.add(steps + 1, session_log=start)
        text = f"```yaml\n{dump_config(config)}```"
        self.add(steps or 0, summary=self.summary.text("config", text))
        plain = flat(config.model_dump(mode="json")).items()
        plain = {name: x if isinstance(x, int | float) else str(x) for name, x in plain}
        shown = dict.fromkeys(("results/mean_return", "episode/return"), 0.0)
        for part in self.summary.hparams(plain, shown):
            self.add(0, summary=part)

    def __call__(self, event: Event) -> None:
        """Writes the points of an event."""
        values = (self.summary.scalar(*point).value[0] for point in event.metrics.items())
        self.add(event.steps, summary=self.summary.Summary(value=values))

    def add(self, steps: int, **content: Any) -> None:
        """Writes an entry as tensorboardX makes it. A file with one that is only half written ends
        there for its readers, so that a new one follows it."""
        try:
            if self._writer is None:
                self._run.mkdir(parents=True, exist_ok=True)
                # Logs that are opened in the same second need different names.
                self._writer = self._new_writer(f"{self._run / 'events'}", f".{time.time_ns()}")
            entry = self._events.Event(wall_time=time.time(), step=steps, **content)
            self._writer.write_event(entry)
            self._writer.flush()
        except OSError:
            self._writer = None
