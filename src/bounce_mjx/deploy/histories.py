"""The world's quantities from the measurements of each control step: the NumPy twin of
`world/sensing.py`. A test compares the two."""

from collections.abc import Iterable

import numpy as np

from bounce_mjx.deploy.chain import Chain
from bounce_mjx.deploy.metadata import Input, Metadata

Measurements = dict[str, np.ndarray]

# Smallest difference between the times of two pictures, s.
_SAME_PICTURE = 1e-4
# Shortest time between two pictures in a difference quotient, s.
_SHORTEST = 1e-3


class Histories:
    """Last values of each observed quantity of the world, and of each command.

    Measurements are arrays by name, as many as the policy needs: `joint_angles` [J],
    `joint_velocities` [J], `ball_position` [3], `ball_velocity` [3], `ball_age` [1], commands [1],
    and so on; of several balls one after another, [6] or [9]; units m, rad and s.
    """

    def __init__(self, metadata: Metadata, inputs: Iterable[Input], measured: Measurements):
        """Fills the history with the measurements of the first control step.

        Args:
          inputs: those that the histories are for.
        """
        self._metadata, self._chain = metadata, Chain(metadata)
        self._no_joints = np.zeros(len(metadata.joint_names))
        self._ball_velocity = np.zeros(3 * metadata.num_balls)
        self._ball = measured.get("ball_position", self._ball_velocity)
        self._age = float(measured["ball_age"][0]) if "ball_age" in measured else 0.0
        start = {"ball_velocity": self._ball_velocity}
        self.newest = start | self._complete(measured, self._no_joints)
        """Newest value of each quantity, also of those that the policy does not see."""
        self.values = {i.name: np.tile(self.newest[i.name], (i.history, 1)) for i in inputs}
        """Last values of each input [history, size], the newest first."""

    def add(self, measured: Measurements, action: np.ndarray) -> None:
        """Adds the measurements of the next control step, and the action [J] of the step before."""
        self.newest = self._complete(measured, action)
        if "ball_position" in measured and self._metadata.velocity == "differences":
            self.newest["ball_velocity"] = self._difference(measured)
        for name, past in self.values.items():
            past[1:] = past[:-1].copy()
            past[0] = self.newest[name]

    def _complete(self, measured: Measurements, action: np.ndarray) -> Measurements:
        """The measurements, and the quantities that depend on nothing else."""
        angles = measured.get("joint_angles", self._no_joints)
        return {
            "action": action,
            "past_actions": action,
            "paddle_position": self._chain.paddle(angles)[0],
            "ball_picture": measured.get("ball_position", self._ball),
        } | measured

    def _difference(self, measured: Measurements) -> np.ndarray:
        """Velocity of the ball by the difference of its last two pictures; updates the last one.
        Without a measured age, a picture is new as soon as the position differs."""
        held_age = self._age + self._metadata.control_dt
        position = measured["ball_position"]
        if "ball_age" in measured:
            age = float(measured["ball_age"][0])
            is_new = held_age - age > _SAME_PICTURE
        else:
            is_new = bool(np.any(position != self._ball))
            age = 0.0 if is_new else held_age
        if is_new:
            elapsed = max(held_age - age, _SHORTEST)
            self._ball_velocity = (position - self._ball) / elapsed
            self._ball = position
        self._age = age
        return self._ball_velocity
