"""The observation: its quantities, how many past values of each it holds, and their order."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Literal, NamedTuple, get_args

from pydantic import Field

from bounce_mjx.config.places import where_made
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.errors import UserError, shorten
from bounce_mjx.lazy import jax, jnp

History = Annotated[int, Field(ge=0, le=100)]
Group = Literal["state", "goal", "past", "task"]
"""Places of quantities in the observation, in their order."""


@dataclasses.dataclass(frozen=True)
class Quantity:
    """The entries of a quantity that an observation may contain: the metadata of its setting.

    Raises:
      UserError: there is no such size or group, or a goal has not one number.
    """

    size: int | None
    """Number of entries of one value; None for one entry for each acting joint."""
    unit: str = ""
    """Unit of the entries; empty for a pure number."""
    group: Group = "task"
    """Place in the observation: state for the present state, goal for the goals, past for
    what the world remembers, task for the task's own quantities."""
    per_ball: bool = False
    """Whether each ball has its entries, one ball after another."""

    def __post_init__(self) -> None:
        groups = get_args(Group)
        is_size = self.size is None or (type(self.size) is int and self.size >= 1)
        if not is_size:
            raise UserError(
                f"{self}{where_made()} has the size {shorten(repr(self.size))}; give a number of "
                "entries, or None for one of each joint"
            )
        if self.group not in groups:
            raise UserError(
                f"{self}{where_made()} has the group {self.group!r}; choose from "
                f"{', '.join(groups)}"
            )
        if self.group == "goal" and (self.size != 1 or self.per_ball):
            raise UserError(
                f"{self}{where_made()} shows a goal, which is one number; give "
                f'task.Quantity(1, {self.unit!r}, "goal")'
            )

    def entries(self, num_joints: int, num_balls: int) -> int:
        """Number of entries of one value."""
        size = num_joints if self.size is None else self.size
        return num_balls * size if self.per_ball else size


class Part(NamedTuple):
    """One part of the observation."""

    name: str
    size: int
    """Number of entries of one value."""
    unit: str
    """Unit of the entries; empty for a pure number."""
    count: int
    """Number of values, the newest first."""

    @property
    def length(self) -> int:
        """Number of entries of all values."""
        return self.count * self.size


class ObservationConfig(StrictModel):
    """The quantities that the policy sees, and how many values of each: 0 for none, 1 for the
    newest, N for the last N, the newest first. Each of the group state is a field of `Kinematics`
    too."""

    joint_angles: Annotated[History, Quantity(None, "rad", "state")] = 1
    """Measured positions of the acting joints: 0 leaves them out, and N shows the last N, as for
    each quantity."""
    ball_position: Annotated[History, Quantity(3, "m", "state", True)] = 1
    """Measured position of the ball."""
    ball_quaternion: Annotated[History, Quantity(4, "", "state", True)] = 1
    """Orientation of the ball, which no sensor of a robot measures."""
    joint_velocities: Annotated[History, Quantity(None, "rad/s", "state")] = 1
    """Measured velocities of the acting joints."""
    ball_velocity: Annotated[History, Quantity(3, "m/s", "state", True)] = 1
    """Measured velocity of the ball."""
    ball_angular_velocity: Annotated[History, Quantity(3, "rad/s", "state", True)] = 1
    """Spin of the ball, which no sensor of a robot measures."""
    paddle_position: Annotated[History, Quantity(3, "m", "state")] = 1
    """Centre of the paddle by the forward kinematics of the measured joint angles."""
    action: Annotated[History, Quantity(None, "", "past")] = 0
    """Actions of the last control steps."""
    servo_lead: Annotated[History, Quantity(None, "rad", "past")] = 0
    """Distances of the last servo targets from the measured joint angles, for the action's base
    target."""
    ball_age: Annotated[History, Quantity(1, "s", "past")] = 0
    """Time since the camera picture of the ball was taken."""
    velocity: Literal["measured", "differences"] = "measured"
    """Source of ball_velocity: a sensor, or the differences between camera pictures."""

    @classmethod
    def quantities(cls) -> dict[str, Quantity]:
        """All quantities by name, in the order of the observation."""
        groups = get_args(Group)
        quantities = {}
        for name, field in cls.model_fields.items():
            for mark in field.metadata:
                if isinstance(mark, Quantity):
                    quantities[name] = mark
        in_order = sorted(quantities.items(), key=lambda item: groups.index(item[1].group))
        return dict(in_order)

    def counts(self, group: str | None = None) -> dict[str, int]:
        """The number of values of each quantity that the policy sees, all or those of a group."""
        counts = {}
        for name, quantity in self.quantities().items():
            count = getattr(self, name)
            if count > 0 and group in (None, quantity.group):
                counts[name] = count
        return counts

    def layout(self, num_joints: int, num_balls: int = 1) -> ObservationLayout:
        """The order of the entries, for an arm with this number of acting joints and for this
        number of balls."""
        quantities = self.quantities()
        parts = []
        for name, count in self.counts().items():
            size = quantities[name].entries(num_joints, num_balls)
            parts.append(Part(name, size, quantities[name].unit, count))
        return ObservationLayout(tuple(parts))

    @property
    def is_momentary(self) -> bool:
        """Whether the true state of one instant and the goals determine the whole
        observation."""
        past = any(count > 1 for count in self.counts().values())
        remembered = self.counts("past") or self.counts("task")
        return not past and not remembered and self.velocity == "measured"


@dataclasses.dataclass(frozen=True)
class ObservationLayout:
    """The order of the parts in the observation vector; `layout[name]` is a part's slice."""

    parts: tuple[Part, ...]

    @property
    def size(self) -> int:
        """Length of the observation vector."""
        return sum(part.length for part in self.parts)

    def __getitem__(self, name: str) -> slice:
        """Entries of the part `name`, such as `obs[layout["ball_position"]]`."""
        start = 0
        for part in self.parts:
            if part.name == name:
                return slice(start, start + part.length)
            start += part.length
        raise KeyError(name)

    def pack(self, values: dict[str, jax.Array]) -> jax.Array:
        """The observation [size] from the values of every part, [part.length].

        Raises:
          UserError: a part has another number of entries, which JAX would cut off or repeat.
        """
        # One scalar per entry, which XLA fuses with the physics; whole arrays would be copied.
        entries = []
        for part in self.parts:
            num_entries = len(values[part.name])
            if num_entries != part.length:
                raise UserError(
                    f"the observation's quantity {part.name} gets {num_entries} numbers, but takes "
                    f"{part.length}, which are {part.count} values of the size {part.size}; return "
                    "as many, or change the size of its Quantity"
                )
            for i in range(part.length):
                entries.append(values[part.name][i])
        return jnp.stack(entries)


class Kinematics(NamedTuple):
    """The true positions and velocities of an environment, without the noise that an observation
    may have. With several balls, their quantities have one row for each ball: [B, 3], [B, 4]."""

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
