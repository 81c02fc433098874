"""The TensorBoard log of a run."""

import time
from pathlib import Path
from typing import Any

from bounce_mjx.config.files import dump_config, flat
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.training.callbacks import Event


class TensorBoardLog:
    """A log for TensorBoard. What cannot be written, as on a full disk, is lost.

    TensorboardX's `SummaryWriter` has a thread, which the first error ends, and then its queue
    blocks for ever.
    """

    def __init__(self, run: Path):
        from tensorboardX import event_file_writer, summary
        from tensorboardX.proto import event_pb2

        self.summary, self._events = summary, event_pb2
        self._new_writer = event_file_writer.EventsWriter
        self.run, self._writer = run, None
        run.mkdir(parents=True, exist_ok=True)
        self.flush()

    def start(self, config: TrainConfig, steps: int | None) -> None:
        """Logs the config, as text and as hyperparameters.

        Args:
          steps: the step from which a resumed run continues; TensorBoard drops all later points.
        """
        if steps is not None:
            start = self._events.SessionLog(status=self._events.SessionLog.START)
            self._add(step=steps + 1, session_log=start)
        text = f"```yaml\n{dump_config(config)}```"
        self.add(self.summary.text("config", text), steps or 0)
        plain = flat(config.model_dump(mode="json")).items()
        plain = {name: x if isinstance(x, int | float) else str(x) for name, x in plain}
        shown = dict.fromkeys(("results/mean_return", "episode/return"), 0.0)
        for part in self.summary.hparams(plain, shown):
            self.add(part, 0)

    def __call__(self, event: Event) -> None:
        """Writes the points of an event."""
        for name, value in event.metrics.items():
            self.add(self.summary.scalar(name, value), event.steps)
        self.flush()

    def add(self, summary: Any, steps: int) -> None:
        """Adds a summary as tensorboardX makes it."""
        self._add(step=steps, summary=summary)

    def flush(self) -> None:
        """Writes everything to the file. A file with a point that is only half written ends there
        for its readers, so that a new one follows it."""
        try:
            if self._writer is None:
                # Logs that are opened in the same second need different names.
                self._writer = self._new_writer(f"{self.run / 'events'}", f".{time.time_ns()}")
            self._writer.flush()
        except OSError:
            self._writer = None

    def _add(self, **content: Any) -> None:
        try:
            if self._writer is not None:
                event = self._events.Event(wall_time=time.time(), **content)
                self._writer.write_event(event)
        except OSError:
            self._writer = None
