"""The unknown quantities of a robot's world, their prior, and their place in one vector."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np


class Unknown(NamedTuple):
    """A quantity that a log can show; `RandomizationConfig` documents the terms."""

    mean: float
    """Its value before the log is seen, at which the search starts."""
    deviation: float
    """Standard deviation of that knowledge; the log outweighs it where it shows the term at all."""
    step: float
    """Difference at which derivatives are taken."""
    unit: str
    """Of the term of the world: of `delay_variance`, that of the lag."""
    stage: str
    """First stage of the search that varies it: arm, flight or bounce."""
    size: int | None = 0
    """Number of entries; 0 for a number, None for one of each joint."""
    limits: tuple[float, float] = (-np.inf, np.inf)
    ball_step: float | None = None
    """The difference for the pictures, if it is another one: it must move a bounce's instant by
    more than the physics step to which a simulation rounds it. The arm's must be small, as latency
    and lag differ only in the second order. 0 if pictures show nothing that angles do not."""
    own: bool = False
    """Whether each joint's entry moves, nearly, that joint alone: one simulation then serves the
    angles of all."""
    is_factor: bool = False
    """Whether it multiplies the model's number. The vector then has its logarithm, of which the
    deviation and the steps are: 10 is as far from 1 as a tenth."""
    common: float = 0.0
    """Standard deviation of the one factor that all gains and dampings share, besides the deviation
    of each: the torques of an arm's servos are of one make. It leaves the delay of a servo, damping
    / gain, as it is: a slow servo and a long lag look alike."""


_JOINTS = None
# What moves the angles too. The last two, whose stages are the ball's, are searched with it alone.
ARM = {
    # Of action_latency and servo_lag together, s and s^2: see Layout.
    "delay": Unknown(0.035, 0.03, 5e-4, "s", "arm", limits=(0.0, 0.4), ball_step=3e-3),
    "delay_variance": Unknown(2e-4, 4e-4, 1e-5, "s", "arm", limits=(0.0, 0.04), ball_step=6e-5),
    "servo_gain": Unknown(
        1.0, 0.2, 0.02, "", "arm", _JOINTS, (0.1, 100.0), 0.15, own=True, is_factor=True, common=1.0
    ),
    "servo_damping": Unknown(
        1.0, 0.3, 0.02, "", "arm", _JOINTS, (0.05, 20.0), 0.15, own=True, is_factor=True, common=1.0
    ),
    "servo_offset": Unknown(0.0, 0.002, 1e-3, "rad", "arm", _JOINTS, ball_step=0.0, own=True),
    "joint_frictionloss": Unknown(
        1.0, 5.0, 0.5, "N m", "arm", _JOINTS, (0.0, np.inf), 0.0, own=True
    ),
    "link_mass": Unknown(1.0, 0.15, 0.05, "", "arm", _JOINTS, (0.1, 10.0), 0.0, is_factor=True),
    "encoder_bias": Unknown(0.0, 0.01, 8e-3, "rad", "bounce", _JOINTS),
    "gravity_tilt": Unknown(0.0, 0.03, 4e-3, "rad", "flight", 2),
}
BALL = {
    "air_drag": Unknown(0.1, 0.1, 0.02, "1/m", "flight", limits=(0.0, np.inf)),
    "ball_latency": Unknown(0.01, 0.02, 1e-3, "s", "bounce", limits=(-0.03, 0.07)),
    "restitution": Unknown(0.85, 0.08, 0.02, "", "bounce", limits=(0.6, 0.98)),
    "paddle_tilt": Unknown(0.0, 0.02, 8e-3, "rad", "bounce", 2),
    "paddle_offset": Unknown(0.0, 0.006, 8e-3, "m", "bounce", 3),
    "ball_position_bias": Unknown(0.0, 0.012, 2e-3, "m", "bounce", 3),
    "contact_friction": Unknown(0.3, 0.3, 0.05, "", "bounce", limits=(0.0, np.inf)),
}
_TERMS = {"delay": "action_latency", "delay_variance": "servo_lag"}
CAMERA_ROTATION = "camera_rotation"
"""Rotation of the camera's frame about the axes of the base, rad: no term of the world, and 0
unless its prior deviation is given."""
OF_SERVOS = ("servo_lag", "servo_gain", "servo_damping", "joint_frictionloss")
"""Terms of servos that are chosen, and not estimated, for an arm that follows exactly."""
MOTIONS = {
    "bounces in other postures of the arm": "encoder_bias paddle_tilt paddle_offset",
    "bounces at places far apart": f"ball_position_bias {CAMERA_ROTATION}",
    "long flights, and a level under the base,": "gravity_tilt",
    "a known weight on the paddle, or slow motions in other postures,": "link_mass servo_gain",
    "faster motions (bounce-mjx excite --max-velocity)": "servo_damping servo_lag action_latency",
    "slow motions there and back (bounce-mjx excite)": "joint_frictionloss servo_offset",
    "balls with spin, or thrown from the side,": "contact_friction",
    "higher flights": "air_drag",
    "more bounces, at several target heights,": "ball_latency restitution",
}
"""What shows unknowns that a log does not show or separate."""


class Layout:
    """The unknowns in one vector.

    A latency and a short lag delay the angles equally, and differ by the square of the lag. In
    place of `action_latency` and `servo_lag`, the vector therefore has the mean `delay` of both, s,
    and the `delay_variance`, s^2, in which measured angles are nearly linear. The lag's filter
    y += (1 - exp(-dt / lag)) (x - y) delays by the mean m = dt / (exp(dt / lag) - 1), with the
    variance m (m + dt), as its answer to an impulse is a geometric distribution.
    """

    def __init__(
        self, num_joints: int, with_ball: bool, physics_dt: float, camera_rotation: float = 0.0
    ):
        """The unknowns that a log can show.

        Args:
          with_ball: whether it shows bounces.
          physics_dt: step of the simulation and of the lag's filter, s.
          camera_rotation: prior standard deviation of the camera's rotation, rad.
        """
        self.num_joints = num_joints
        self.physics_dt = physics_dt
        self.unknowns = ARM | BALL if with_ball else dict(ARM)
        if not with_ball:
            self.unknowns.pop("encoder_bias")
        elif camera_rotation > 0.0:
            rotation = Unknown(0.0, camera_rotation, 3e-3, "rad", "bounce", 3)
            self.unknowns[CAMERA_ROTATION] = rotation
        each = self.unknowns.values()
        sizes = [num_joints if unknown.size is None else max(unknown.size, 1) for unknown in each]
        ends = np.cumsum(sizes).tolist()
        self.slices = dict(zip(self.unknowns, map(slice, [0, *ends[:-1]], ends), strict=True))
        """Place of each unknown."""
        self.terms = {_TERMS.get(name, name): place for name, place in self.slices.items()}
        """Place of each term of the world; those of `action_latency` and `servo_lag` are where the
        vector has the delay and its variance."""

        def column(field: str) -> np.ndarray:
            return np.repeat([getattr(unknown, field) for unknown in each], sizes, axis=0)

        self._factors = column("is_factor")
        self.mean = self.encode(column("mean"))
        """Prior means [P]."""
        self.deviation = column("deviation")
        """Prior standard deviations [P], beside what the joints share."""
        common = column("common") / self.deviation
        self.precision = np.linalg.inv(np.eye(len(common)) + np.outer(common, common))
        """Inverse of the prior's covariance [P, P], in units of the deviations."""
        self.limits = self.encode(column("limits").T)
        """Lower and upper limits [2, P]."""
        self.units = column("unit").tolist()
        """Of each term's entry."""
        self._stages = column("stage")

    def encode(self, values: np.ndarray) -> np.ndarray:
        """The vector [..., P] of values [..., P], of which factors have their logarithms."""
        return np.where(self._factors, np.log(np.where(self._factors, values, 1.0)), values)

    def decode(self, vector: np.ndarray) -> np.ndarray:
        """The values [..., P] of a vector [..., P]."""
        return np.where(self._factors, np.exp(np.where(self._factors, vector, 0.0)), vector)

    def free(self, stages: Sequence[str]) -> np.ndarray:
        """Which entries [P] the stages vary."""
        return np.isin(self._stages, stages)

    def clip(self, vector: np.ndarray) -> np.ndarray:
        """The vector [..., P] within the limits of each unknown."""
        return np.clip(vector, *self.limits)

    def bounds(self, vector: np.ndarray) -> np.ndarray:
        """Lower and upper bounds [2, P] of a step from a vector [P]: the limits, and a delay that
        leaves a latency of at least 0 at the vector's lag."""
        bounds = self.limits.copy()
        places = self.slices
        bounds[0, places["delay"]] = self._lag_mean(vector[places["delay_variance"]])
        return bounds

    def interior(self, vector: np.ndarray, steps: float) -> np.ndarray:
        """The vector [P] with a delay from which the differences of the angles' derivatives,
        `steps` times each, leave a latency of at least 0: at 0, delay and variance would have one
        effect. The pictures' differences are larger, and near a latency of 0 up to half of each has
        no effect: the pictures then count as less than they show of it."""
        delay_step = self.unknowns["delay"].step
        variance_step = self.unknowns["delay_variance"].step
        places = self.slices
        moved = vector.copy()
        mean = self._lag_mean(vector[places["delay_variance"]] + steps * variance_step)
        moved[places["delay"]] = np.maximum(vector[places["delay"]], mean + steps * delay_step)
        return moved

    def _lag_mean(self, variance: np.ndarray) -> np.ndarray:
        """Mean delay m of a lag with the variance m (m + dt)."""
        dt = self.physics_dt
        return 0.5 * (np.sqrt(dt * dt + 4.0 * variance) - dt)

    def world(self, vector: np.ndarray) -> dict[str, np.ndarray]:
        """Each term's value [..., size], or [...] of a number."""
        values = self.decode(vector)
        world = {
            name: values[..., place.start] if self.unknowns[name].size == 0 else values[..., place]
            for name, place in self.slices.items()
        }
        delay = world.pop("delay")
        variance = world.pop("delay_variance")
        dt = self.physics_dt
        mean = self._lag_mean(np.maximum(variance, 1e-14))
        latency = np.maximum(delay - mean, 0.0)
        return {"action_latency": latency, "servo_lag": dt / np.log1p(dt / mean)} | world

    def vector(self, world: Mapping[str, np.ndarray]) -> np.ndarray:
        """The vector [P] of values by name; a missing one has its prior mean."""
        values = self.decode(self.mean)
        places = self.slices
        for name in set(places) & set(world):
            values[places[name]] = world[name]
        if {"action_latency", "servo_lag"} <= set(world):
            mean = self.physics_dt / np.expm1(self.physics_dt / max(world["servo_lag"], 2e-5))
            values[places["delay"]] = world["action_latency"] + mean
            values[places["delay_variance"]] = mean * (mean + self.physics_dt)
        return self.encode(values)

    def labels(self, joint_names: Sequence[str]) -> list[str]:
        """Name of each entry, for a reader."""
        labels = []
        for term, unknown in zip(self.terms, self.unknowns.values(), strict=True):
            if unknown.size is None:
                labels += [f"{term} of {joint}" for joint in joint_names]
            else:
                labels += [f"{term} {axis}" for axis in "xyz"[: unknown.size]] or [term]
        return labels
