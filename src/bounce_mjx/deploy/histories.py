"""Observations from the measurements of each control step: the NumPy twin of `task/sensing.py`.

Its function `remember` is the reference for every history; a test compares the two.
"""

import numpy as np

from bounce_mjx.deploy.chain import Chain
from bounce_mjx.deploy.estimator import Estimator
from bounce_mjx.deploy.metadata import Metadata

Measurements = dict[str, np.ndarray]

# Quantities with one value for each bounce: those fixed by the flight before the bounce, and those
# measured at the ball's lowest point.
OF_FLIGHT = frozenset(("apex_error", "bounce_interval"))
OF_LOWEST = frozenset(("bounce_position", "bounce_joint_angles", "bounce_joint_velocities"))
OF_BOUNCES = OF_FLIGHT | OF_LOWEST

# Smallest difference between the times of two pictures, s.
_SAME_PICTURE = 1e-4
# Shortest time between two pictures in a difference quotient, s.
_SHORTEST = 1e-3


class Histories:
    """Last values of each observed quantity.

    Measurements are arrays by name, as many as the policy needs: `joint_angles` [J],
    `joint_velocities` [J], `ball_position` [3], `ball_velocity` [3], `target_height` [1],
    `ball_age` [1], and so on; units m, rad and s.
    """

    def __init__(self, metadata: Metadata, measured: Measurements):
        """Fills the history with the measurements of the first control step."""
        self._metadata, self._chain = metadata, Chain(metadata)
        self._ball = measured.get("ball_position", np.zeros(3))
        self._ball_velocity = np.zeros(3)
        # Without time stamps, each picture arrives after the latency that the filter expects.
        self._latency = (metadata.estimator and metadata.estimator.latency) or 0.0
        self._age = float(measured["ball_age"][0]) if "ball_age" in measured else self._latency
        height = self._ball[2]
        self._flight_apex, self._lowest = height, height
        self._is_low = False
        self._flight_time = 0.0
        zero, joints = np.zeros(1), np.zeros(len(metadata.joint_names))
        angles = measured.get("joint_angles", joints)
        self._estimator = None
        if metadata.estimator is not None:
            self._estimator = Estimator(metadata, self._ball, angles, self._age)
        start = {
            "past_actions": joints,
            "ball_age": np.array([self._age]),
            "ball_velocity": self._ball_velocity,
            "apex_error": zero,
            "bounce_position": self._ball[:2],
            "bounce_interval": zero,
            "bounce_joint_angles": angles,
            "bounce_joint_velocities": measured.get("joint_velocities", joints),
            "paddle_position": self._chain.paddle_position(angles),
        } | measured
        self.values = {
            part.name: np.tile(start[part.name], (part.history, 1)) for part in metadata.observation
        }
        """Last values of each quantity [history, size], the newest first."""

    def add(self, measured: Measurements, action: np.ndarray, is_real: bool = True) -> None:
        """Adds the measurements of the next control step, and the action [J] of the step before.

        Args:
          is_real: False for measurements that were interpolated, which the state estimator ignores.
        """
        metadata = self._metadata
        angles = measured.get("joint_angles")
        paddle = np.zeros(3) if angles is None else self._chain.paddle_position(angles)
        measured = measured | {"past_actions": action, "paddle_position": paddle}
        bounces = self._bounces(measured, paddle[2] + metadata.bounce_max_distance)
        if "ball_position" in measured:
            measured |= self._ball_now(measured, is_real)
        for name, past in self.values.items():
            if name not in OF_BOUNCES:
                past[1:] = past[:-1].copy()
                past[0] = measured[name]
            elif name in bounces:
                starts, value = bounces[name]
                if starts:
                    past[1:] = past[:-1].copy()
                past[0] = value

    def _ball_now(self, measured: Measurements, is_real: bool) -> Measurements:
        """Position and velocity of the ball if they are not measured; updates the last picture.
        Without a measured age, a picture is new as soon as the position differs."""
        held_age = self._age + self._metadata.control_dt
        position = measured["ball_position"]
        if "ball_age" in measured:
            age = float(measured["ball_age"][0])
            is_new = held_age - age > _SAME_PICTURE
        else:
            is_new = bool(np.any(position != self._ball))
            age = self._latency if is_new else held_age
        if is_new:
            elapsed = max(held_age - age, _SHORTEST)
            self._ball_velocity = (position - self._ball) / elapsed
            self._ball = position
        self._age = age
        sources = {"differences": {"ball_velocity": self._ball_velocity}}
        if self._estimator is not None:
            estimate = self._estimator.add(
                position if is_new and is_real else None, age, measured["joint_angles"]
            )
            sources["filter"] = dict(zip(("ball_position", "ball_velocity"), estimate, strict=True))
        return {
            name: sources[source][name]
            for name, source in (
                ("ball_position", self._metadata.position),
                ("ball_velocity", self._metadata.velocity),
            )
            if source in sources
        }

    def _bounces(
        self, measured: Measurements, near_height: float
    ) -> dict[str, tuple[bool, np.ndarray]]:
        """Changed quantities of bounces: a flag for the start of a new bounce, and the value.

        A bounce starts when the ball is first measured near the paddle; its values are taken at the
        ball's lowest measured point.
        """
        if not OF_BOUNCES & self.values.keys():
            return {}
        ball = measured["ball_position"]
        height = ball[2]
        is_low = bool(height < near_height)
        starts = is_low and not self._is_low
        at_lowest = starts or (is_low and height < self._lowest)
        flight_time = self._flight_time + self._metadata.control_dt
        changed = {}
        if starts:
            changed["bounce_interval"] = starts, np.array([flight_time])
            if "target_height" in measured:
                changed["apex_error"] = starts, self._flight_apex - measured["target_height"]
        if at_lowest:
            changed["bounce_position"] = starts, ball[:2]
            for name in ("joint_angles", "joint_velocities"):
                if name in measured:
                    changed[f"bounce_{name}"] = starts, measured[name]
            self._lowest = height
        self._flight_apex = height if is_low else max(self._flight_apex, height)
        self._is_low = is_low
        self._flight_time = 0.0 if starts else flight_time
        return changed
