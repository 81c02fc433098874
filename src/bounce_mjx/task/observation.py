"""The observation: its quantities, how many past values of each it holds, and their order."""

from __future__ import annotations

import dataclasses
import functools
from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from bounce_mjx.config.settings import StrictModel
from bounce_mjx.lazy import jax, jnp

History = Annotated[int, Field(ge=0, le=100)]


class Part(NamedTuple):
    """One part of the observation."""

    name: str
    size: int
    """Number of entries."""
    unit: str
    """Unit of the entries; empty for a pure number."""


QUANTITIES = (
    Part("joint_angles", 6, "rad"),
    Part("ball_position", 3, "m"),
    Part("ball_quaternion", 4, ""),
    Part("joint_velocities", 6, "rad/s"),
    Part("ball_velocity", 3, "m/s"),
    Part("ball_angular_velocity", 3, "rad/s"),
    Part("paddle_position", 3, "m"),
    Part("target_height", 1, "m"),
    Part("action", 6, ""),
    Part("ball_age", 1, "s"),
    Part("apex_error", 1, "m"),
    Part("bounce_position", 2, "m"),
    Part("bounce_interval", 1, "s"),
    Part("bounce_joint_angles", 6, "rad"),
    Part("bounce_joint_velocities", 6, "rad/s"),
)
"""The quantities that an observation may contain, in order, and the size of one value of each."""

BOUNCE_QUANTITIES = frozenset(part.name for part in QUANTITIES[10:])
"""Quantities that have one value per bounce instead of one per control step."""


class ObservationConfig(StrictModel):
    """The quantities that the policy sees, and how many values of each: 0 for none, 1 for the
    newest, N for the last N, the newest first."""

    joint_angles: History = 1
    """Measured angles of Joint1..Joint6."""
    ball_position: History = 1
    """Measured position of the ball."""
    ball_quaternion: History = 1
    """Orientation of the ball, which no sensor of a robot measures."""
    joint_velocities: History = 1
    """Measured velocities of Joint1..Joint6."""
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
    velocity: Literal["measured", "differences"] = "measured"
    """Source of ball_velocity: a sensor, or the differences between pictures."""

    @functools.cached_property
    def layout(self) -> ObservationLayout:
        """The order of the entries."""
        sizes = ((p, getattr(self, p.name)) for p in QUANTITIES)
        return ObservationLayout(tuple(p._replace(size=p.size * n) for p, n in sizes if n))

    @property
    def is_momentary(self) -> bool:
        """Whether the true state of one instant determines the whole observation."""
        past = any(getattr(self, p.name) > 1 for p in QUANTITIES)
        remembered = any(getattr(self, p.name) for p in QUANTITIES[8:])
        return not past and not remembered and self.velocity == "measured"


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


OBSERVATION = ObservationConfig().layout
"""The layout of the original specification, the default."""


class Kinematics(NamedTuple):
    """The true positions and velocities of an environment, without the noise that an observation
    may have."""

    joint_angles: jax.Array
    """Angles of Joint1..Joint6 [6], rad."""
    ball_position: jax.Array
    """World position of the centre [3], m."""
    ball_quaternion: jax.Array
    """Orientation [4] in the order w, x, y, z."""
    joint_velocities: jax.Array
    """Velocities of Joint1..Joint6 [6], rad/s."""
    ball_velocity: jax.Array
    """World velocity [3], m/s."""
    ball_angular_velocity: jax.Array
    """Angular velocity in the ball's frame [3], rad/s."""
    paddle_position: jax.Array
    """World position of the centre [3], m."""
