"""Somebody beside a simulated arm, who gives the word (`deploy.session.Operator`)."""

from bounce_mjx.deploy.supervisor import State
from bounce_mjx.rehearsal.arm import SimulatedArm

FETCHING = 0.5
"""Time from a stop to the word that sends the arm home, in which a lost ball is fetched, s."""


class SimulatedOperator:
    """Holds the balls until the arm is ready, gives the word and lets go; after a lost ball they
    fetch it, and send the arm home."""

    def __init__(self, arm: SimulatedArm):
        self._arm = arm
        self._stopped: float | None = None
        """Time at which the arm has come to rest after a fault, s."""
        self.heard: list[str] = []
        """What the program said."""

    def has_word(self, state: State) -> bool:
        """As `Operator.has_word`."""
        arm = self._arm
        if state in ("running", "braking"):
            if arm.is_held:
                arm.let_go()
        else:
            arm.is_held = True
        if state != "stopped":
            self._stopped = None
            return state == "ready"
        if self._stopped is None:
            self._stopped = arm.data.time
        return arm.data.time - self._stopped > FETCHING

    def hear(self, words: str) -> None:
        """As `Operator.hear`."""
        self.heard.append(words)
