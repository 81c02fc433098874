"""Simulation in real time."""

import time

SPEED_RANGE = (0.1, 2.0)
"""Slowest and fastest speed of a viewer, as factors of real time."""

# If the simulation falls behind by more than this, it slows down instead of catching up, s.
_MAX_LAG = 0.1


class Pace:
    """Number of control steps that are due according to the clock."""

    def __init__(self, dt: float):
        self._dt = dt
        self._owed = 0.0
        self.forget()

    def forget(self) -> None:
        """Skips the time since the last call."""
        self._last = time.monotonic()

    def due(self, speed: float) -> int:
        """Control steps that became due since the last call, at `speed` times real time."""
        now = time.monotonic()
        self._owed += speed * min(now - self._last, _MAX_LAG)
        self._last = now
        steps = int(self._owed / self._dt)
        self._owed -= steps * self._dt
        return steps
