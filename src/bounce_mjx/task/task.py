"""The interface between an environment's world and its task."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

from bounce_mjx.lazy import jax
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.observation import Kinematics

State = Any
"""A pytree that a task keeps of an episode."""

Values = dict[str, "jax.Array"]
"""Numbers by name."""


class Start(NamedTuple):
    """The start of an episode, as a task sees it."""

    truth: Kinematics
    """Positions and velocities after the reset."""
    command: Values
    """Value [] of each command."""


class Step(NamedTuple):
    """A control step, as a task sees it: what is true, whatever the sensors measure."""

    truth: Kinematics
    """Positions and velocities after the step."""
    command: Values
    """Value [] of each command during the step."""
    action: jax.Array
    """Clipped action [n]."""
    last_action: jax.Array
    """Clipped action of the previous step [n]."""


class TaskStep(NamedTuple):
    """A task's part of a control step."""

    state: State
    """The task's state after the step."""
    reward: Values
    """Weighted terms [] of the reward, which is their sum."""
    ended: jax.Array
    """Whether the task ends the episode [], bool."""
    metrics: Values
    """Further numbers [] of the step."""


class Task:
    """A task: what the arm and the ball are to do. A subclass holds all that belongs to it.

    The methods compute one environment, without a batch axis, and are pure: `jax.vmap` and
    `jax.jit` apply to them.
    """

    Config: ClassVar[type[WorldConfig]]
    """The settings of an environment with this task: those of the world, and the task's own."""

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        if "Config" in cls.__dict__:
            cls.Config.task = cls

    def __init__(self, config: WorldConfig):
        self.config = config

    def reset(self, start: Start) -> State:
        """The task's state at the start of an episode."""
        raise NotImplementedError

    def step(self, state: State, step: Step) -> TaskStep:
        """The task's part of a control step: events, reward, end and metrics.

        Args:
          state: the task's state before the step.
        """
        raise NotImplementedError

    def first_quantities(self, measured: Values) -> tuple[State, Values]:
        """What the task remembers of the measurements at a reset, and the first value [size] of
        each quantity of the observation that is the task's own.

        Args:
          measured: value [size] of each quantity of the world and of each command.
        """
        return (), {}

    def next_quantities(
        self, memory: State, seen: Values, measured: Values
    ) -> tuple[State, Values]:
        """What the task remembers after the measurements of a control step, and the histories of
        its own quantities.

        Args:
          memory: what it remembered before.
          seen: histories [H, size] of its own quantities that the policy sees, the newest first.
          measured: value [size] of each quantity of the world and of each command.
        """
        return memory, seen
