"""Where a training's time goes, and how much is left."""

import time


class Clock:
    """Adds up the seconds of each phase, and estimates the time to the last step."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        """Seconds by phase."""
        self._lap_started = time.perf_counter()
        self.restart_estimate(0)

    def lap(self, phase: str) -> None:
        """Adds the time since the last lap to that of a phase."""
        now = time.perf_counter()
        self.seconds[phase] = self.seconds.get(phase, 0.0) + now - self._lap_started
        self._lap_started = now

    def restart_estimate(self, steps: int) -> None:
        """Estimates the time that is left from what follows, after a number of steps."""
        self._started = time.monotonic()
        self._first_steps = steps

    def left(self, steps: int, total_steps: int) -> float:
        """Estimated time to the last step, s, at the mean speed with the evaluations. A block must
        have ended since `restart_estimate`."""
        share = (total_steps - steps) / (steps - self._first_steps)
        return share * (time.monotonic() - self._started)
