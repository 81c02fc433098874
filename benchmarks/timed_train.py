"""`bounce-mjx train`, with the moments of JAX's own events for `benchmarks/start.py`.

The environment variable TIMED_TRAIN_EVENTS names the JSON file of the events: name, end, duration.
"""

import json
import os
import sys
import time
from pathlib import Path

from bounce_mjx.commands.train import main

# Imported by the command after JAX, which is not to be imported before the command starts.
AFTER_JAX = "bounce_mjx.training.job"

events: list[tuple[str, float, float]] = []


def listen(event: str, arguments: tuple) -> None:
    """Listens to JAX's events from the import of that module on: its event comes once, before the
    module is read."""
    if event != "import" or arguments[0] != AFTER_JAX:
        return
    import jax

    jax.monitoring.register_event_duration_secs_listener(
        lambda event, seconds, **_: events.append((event, time.time(), seconds))
    )
    jax.monitoring.register_event_listener(
        lambda event, **_: events.append((event, time.time(), 0.0))
    )


sys.addaudithook(listen)
try:
    main(sys.argv[1:])
finally:
    Path(os.environ["TIMED_TRAIN_EVENTS"]).write_text(json.dumps(events), encoding="utf-8")
