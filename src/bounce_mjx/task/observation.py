"""The observation: its parts, their sizes and units, and their order."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp


class Part(NamedTuple):
    """One part of the observation."""

    name: str
    size: int
    """Number of entries."""
    unit: str
    """Unit of the entries; empty for a pure number."""


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
        # One scalar an entry, which XLA fuses with the physics; whole arrays would be copied.
        return jnp.stack([values[part.name][i] for part in self.parts for i in range(part.size)])


OBSERVATION = ObservationLayout(
    (
        Part("joint_angles", 6, "rad"),
        Part("ball_position", 3, "m"),
        Part("ball_quaternion", 4, ""),
        Part("joint_velocities", 6, "rad/s"),
        Part("ball_velocity", 3, "m/s"),
        Part("ball_angular_velocity", 3, "rad/s"),
        Part("paddle_position", 3, "m"),
        Part("target_height", 1, "m"),
    )
)


class Kinematics(NamedTuple):
    """The true positions and velocities of an environment, without the noise that an observation
    may have."""

    joint_angles: jax.Array
    """Of Joint1..Joint6 [6], rad."""
    ball_position: jax.Array
    """World position of the centre [3], m."""
    ball_quaternion: jax.Array
    """Orientation [4] in the order w, x, y, z."""
    joint_velocities: jax.Array
    """Of Joint1..Joint6 [6], rad/s."""
    ball_velocity: jax.Array
    """World velocity [3], m/s."""
    ball_angular_velocity: jax.Array
    """In the ball's frame [3], rad/s."""
    paddle_position: jax.Array
    """World position of the centre [3], m."""
