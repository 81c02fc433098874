"""`bounce-mjx train`, with the moments of JAX's own events for `benchmarks/start.py`.

The environment variable TIMED_TRAIN_EVENTS names the JSON file of the events: name, end, duration.
"""

import json
import os
import time
from pathlib import Path

from bounce_mjx.commands.train import main
from bounce_mjx.training.loop_fusion import join_loops

# Before JAX is imported, as the command itself does it.
join_loops()

import jax  # noqa: E402

events: list[tuple[str, float, float]] = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **_: events.append((event, time.time(), seconds))
)
jax.monitoring.register_event_listener(lambda event, **_: events.append((event, time.time(), 0.0)))
try:
    main()
finally:
    Path(os.environ["TIMED_TRAIN_EVENTS"]).write_text(json.dumps(events), encoding="utf-8")
