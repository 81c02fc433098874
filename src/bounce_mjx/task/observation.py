"""The observation: its quantities, how many past values of each it holds, and their order."""

from __future__ import annotations

import dataclasses
import functools
from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from bounce_mjx.config.settings import NonNegative, Positive, StrictModel
from bounce_mjx.lazy import jax, jnp

History = Annotated[int, Field(ge=0, le=100)]


class Quantity(NamedTuple):
    """A quantity that an observation may contain."""

    name: str
    size: int | None
    """Number of entries of one value; None for one entry for each acting joint."""
    unit: str
    """Unit of the entries; empty for a pure number."""


class Part(NamedTuple):
    """One part of the observation."""

    name: str
    size: int
    """Number of entries."""
    unit: str
    """Unit of the entries; empty for a pure number."""


QUANTITIES = (
    Quantity("joint_angles", None, "rad"),
    Quantity("ball_position", 3, "m"),
    Quantity("ball_quaternion", 4, ""),
    Quantity("joint_velocities", None, "rad/s"),
    Quantity("ball_velocity", 3, "m/s"),
    Quantity("ball_angular_velocity", 3, "rad/s"),
    Quantity("paddle_position", 3, "m"),
    Quantity("target_height", 1, "m"),
    Quantity("action", None, ""),
    Quantity("ball_age", 1, "s"),
    Quantity("apex_error", 1, "m"),
    Quantity("bounce_position", 2, "m"),
    Quantity("bounce_interval", 1, "s"),
    Quantity("bounce_joint_angles", None, "rad"),
    Quantity("bounce_joint_velocities", None, "rad/s"),
)
"""The quantities that an observation may contain, in order, and the size of one value of each."""


def parts(num_joints: int) -> tuple[Part, ...]:
    """One value of each quantity for an arm with this number of acting joints, in order."""
    return tuple(Part(q.name, num_joints if q.size is None else q.size, q.unit) for q in QUANTITIES)


BOUNCE_QUANTITIES = frozenset(
    "apex_error bounce_position bounce_interval bounce_joint_angles bounce_joint_velocities".split()
)
"""Quantities that have one value per bounce instead of one per control step."""


class ObservationConfig(StrictModel):
    """The quantities that the policy sees, and how many values of each: 0 for none, 1 for the
    newest, N for the last N, the newest first."""

    joint_angles: History = 1
    """Measured positions of the acting joints."""
    ball_position: History = 1
    """Measured position of the ball."""
    ball_quaternion: History = 1
    """Orientation of the ball, which no sensor of a robot measures."""
    joint_velocities: History = 1
    """Measured velocities of the acting joints."""
    ball_velocity: History = 1
    """Measured or estimated velocity of the ball."""
    ball_angular_velocity: History = 1
    """Spin of the ball, which no sensor of a robot measures."""
    paddle_position: History = 1
    """Centre of the paddle by the forward kinematics of the measured joint angles."""
    target_height: History = 1
    """Target height."""
    action: History = 0
    """Actions of the last control steps."""
    ball_age: History = 0
    """Time since the picture of the ball was taken."""
    apex_error: History = 0
    """Highest measured ball position minus the target height, of the flights before the last
    bounces."""
    bounce_position: History = 0
    """Measured horizontal position of the ball at the lowest point of the last bounces."""
    bounce_interval: History = 0
    """Time between the last bounces."""
    bounce_joint_angles: History = 0
    """Measured joint angles at the lowest points of the last bounces."""
    bounce_joint_velocities: History = 0
    """Measured joint velocities at the lowest points of the last bounces."""
    position: Literal["measured", "filter"] = "measured"
    """Source of ball_position: the last picture, or the estimate of the Kalman filter
    (env.estimator)."""
    velocity: Literal["measured", "differences", "filter"] = "measured"
    """Source of ball_velocity: a sensor, the differences between pictures, or the estimate of the
    Kalman filter (env.estimator)."""

    def layout(self, num_joints: int) -> ObservationLayout:
        """The order of the entries for an arm with this number of acting joints."""
        values = ((part, getattr(self, part.name)) for part in parts(num_joints))
        return ObservationLayout(tuple(p._replace(size=p.size * n) for p, n in values if n))

    @property
    def is_momentary(self) -> bool:
        """Whether the true state of one instant determines the whole observation."""
        past = any(getattr(self, p.name) > 1 for p in QUANTITIES)
        remembered = any(getattr(self, name) for name in {"action", "ball_age"} | BOUNCE_QUANTITIES)
        sources = {self.position, self.velocity}
        return not past and not remembered and sources == {"measured"}

    @property
    def is_filtered(self) -> bool:
        """Whether the policy sees an estimate of the Kalman filter."""
        return bool(
            (self.ball_position and self.position == "filter")
            or (self.ball_velocity and self.velocity == "filter")
        )


class EstimatorConfig(StrictModel):
    """The Kalman filter of a bouncing ball between camera and policy, which computes the sources
    `filter` of env.observation."""

    measurement_noise: Positive = 0.002
    """Standard deviation of each measured ball coordinate, m."""
    process_noise: NonNegative = 0.2
    """Standard deviation that unknown forces give to each component of the ball's velocity within
    1 s, m/s; it grows with the square root of the time."""
    restitution: Annotated[float, Field(ge=0.1, le=1.0)] = 0.85
    """Restitution of the ball on the paddle."""
    restitution_noise: NonNegative = 0.05
    """Standard deviation of the restitution."""
    contact_time: Annotated[float, Field(ge=0.002, le=0.05)] = 0.01
    """Time that the ball touches the paddle in a bounce, s."""
    paddle_noise: NonNegative = 0.002
    """Standard deviation of the paddle's height by forward kinematics, m."""
    air_drag: NonNegative = 0.0
    """Deceleration of the ball by the air divided by its squared speed, 1/m."""
    latency: NonNegative | None = None
    """Expected time from a picture to its arrival, s, if the camera does not stamp its pictures;
    null for pictures with the time at which they were taken."""


@dataclasses.dataclass(frozen=True)
class ObservationLayout:
    """The order of the parts in the observation vector; `layout[name]` is a part's slice."""

    parts: tuple[Part, ...]

    @functools.cached_property
    def size(self) -> int:
        """Length of the observation vector."""
        return sum(part.size for part in self.parts)

    @functools.cached_property
    def _slices(self) -> dict[str, slice]:
        slices, start = {}, 0
        for part in self.parts:
            slices[part.name] = slice(start, start + part.size)
            start += part.size
        return slices

    def __getitem__(self, name: str) -> slice:
        """Entries of the part `name`, such as `obs[layout["ball_position"]]`."""
        return self._slices[name]

    def pack(self, values: dict[str, jax.Array]) -> jax.Array:
        """The observation [size] from the value of every part, [part.size]."""
        # One scalar per entry, which XLA fuses with the physics; whole arrays would be copied.
        return jnp.stack([values[part.name][i] for part in self.parts for i in range(part.size)])


OBSERVATION = ObservationConfig().layout(6)
"""The layout of the original specification: the default quantities, and six joints."""


class Kinematics(NamedTuple):
    """The true positions and velocities of an environment, without the noise that an observation
    may have."""

    joint_angles: jax.Array
    """Positions of the acting joints [n], rad; of a slide, m."""
    ball_position: jax.Array
    """World position of the centre [3], m."""
    ball_quaternion: jax.Array
    """Orientation [4] in the order w, x, y, z."""
    joint_velocities: jax.Array
    """Velocities of the acting joints [n], rad/s; of a slide, m/s."""
    ball_velocity: jax.Array
    """World velocity [3], m/s."""
    ball_angular_velocity: jax.Array
    """Angular velocity in the ball's frame [3], rad/s."""
    paddle_position: jax.Array
    """World position of the centre [3], m."""
