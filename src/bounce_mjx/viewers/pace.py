"""Simulation in real time."""

import time
from collections.abc import Callable, Iterator

from bounce_mjx.viewers.simulation import EnvFrame, Simulation

_PICTURES_PER_SECOND = 50.0
# If the simulation falls behind by more than this, it slows down instead of catching up, s.
_MAX_LAG = 0.1


def in_real_time(
    simulation: Simulation, seconds: float | None, speed: Callable[[], float]
) -> Iterator[list[EnvFrame]]:
    """Steps a simulation with the clock, and yields for each picture the frames since the last one.

    Args:
      seconds: simulated time; None for no end.
      speed: the present factor of real time; 0 is a pause.
    """
    dt = simulation.env.dt
    left = float("inf") if seconds is None else round(seconds / dt)
    owed, last = 0.0, time.monotonic()
    while left > 0:
        now = time.monotonic()
        owed += speed() * min(now - last, _MAX_LAG) / dt
        due, last = min(int(owed), left), now
        owed, left = owed - due, left - due
        yield [simulation.step() for _ in range(due)]
        time.sleep(1.0 / _PICTURES_PER_SECOND)
