"""The interface between an environment's world and its task."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from bounce_mjx.errors import UserError
from bounce_mjx.lazy import jax, jnp
from bounce_mjx.task.results import Episodes, Figure, Result
from bounce_mjx.task.shown import Curve, Histogram, Hits, Marker, Recording
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.observation import Kinematics

if TYPE_CHECKING:
    from bounce_mjx.robot.geometry import Geometry

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
    draws: jax.Array
    """Uniform random numbers between 0 and 1 [num_draws]."""


class Step(NamedTuple):
    """A control step, as a task sees it: what is true, whatever the sensors measure."""

    truth: Kinematics
    """Positions and velocities after the step."""
    command: Values
    """Value [] of each command during the step, which the policy saw as it chose the action."""
    action: jax.Array
    """Clipped action [n]."""
    last_action: jax.Array
    """Clipped action of the previous step [n]."""
    ball_radius: jax.Array | float | None = None
    """Radius [] of the balls in this episode, m; None for that of the task's `geometry`."""


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


class Moment(NamedTuple):
    """A control step of an episode that is measured."""

    truth: Kinematics
    """Positions and velocities after the step."""
    command: Values
    """Value [] of each command after the step."""
    state: State
    """The task's state after the step."""
    metrics: Values
    """The environment's metrics of the step, each []."""
    seconds: jax.Array
    """Time since the reset [], s."""
    command_seconds: jax.Array
    """Time since the commands were sampled [], s; at most `seconds`."""


class Tally(NamedTuple):
    """Numbers of a control step, each []."""

    sums: Values
    """Numbers that are summed over the steps of an episode."""
    maxima: Values = {}
    """Numbers of which the greatest over the steps of an episode counts; at least 0."""


class Task:
    """A task: what the arm and the ball are to do. A subclass holds all that belongs to it.

    The methods compute one environment, without a batch axis, and are pure: `jax.vmap` and
    `jax.jit` apply to them.
    """

    Config: ClassVar[type[WorldConfig]]
    """The settings of an environment with this task: those of the world, and the task's own."""
    folder: ClassVar[str] = ""
    """Name of the folder of its runs in runs/; by default, the class's name in lower case."""
    curves: ClassVar[tuple[Curve, ...]] = ()
    """What a training logs and a report draws of the metrics; the first is the progress line's. A
    metric without one is logged as its mean over the steps."""
    num_balls: ClassVar[tuple[int, ...]] = (1,)
    """Numbers of balls (`WorldConfig.num_balls`) that it takes."""
    num_draws: ClassVar[int] = 0
    """Random numbers that a reset samples for the task."""
    critic_metrics: ClassVar[tuple[str, ...]] = ()
    """Metrics that the value network sees by default, because the reward depends on them and the
    observation does not contain them."""

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        if "Config" not in cls.__dict__:
            raise UserError(
                f"the task {cls.__name__} has no Config of its own, and settings belong to one "
                f"task; write a class that extends that of {cls.__base__.__name__}"
            )
        owner = vars(cls.Config).get("task")
        # The cell of a notebook may run again.
        if owner and (owner.__module__, owner.__qualname__) != (cls.__module__, cls.__qualname__):
            raise UserError(
                f"the task {cls.__name__} has the Config of {owner.__name__}, and settings belong "
                f"to one task; write a class that extends {cls.Config.__qualname__}"
            )
        cls.Config.task = cls

    def __init__(self, config: WorldConfig):
        self.config = config

    @functools.cached_property
    def geometry(self) -> Geometry:
        """Sizes and places of ball and paddle in the model. An environment sets those of its own;
        a task without one compiles the config's model for them."""
        # The settings alone need no JAX.
        from bounce_mjx.robot.geometry import read_geometry
        from bounce_mjx.robot.model import find_addresses, load_model

        config = self.config
        model = load_model(
            config.mjcf, config.physics_dt, False, config.robot, num_balls=config.num_balls
        )
        return read_geometry(model, find_addresses(model), config.default_joint_angles)

    def throw(self, draws: jax.Array, command: Values) -> tuple[jax.Array, jax.Array] | None:
        """Position [3] (m) and velocity [3] (m/s) of the ball at a reset, before the noise and the
        terms of the randomisation, of each ball [B, 3] if there are several; None for balls at rest
        at `ball_init_pos` and above it.

        Args:
          draws: uniform random numbers between 0 and 1 [num_draws].
          command: value [] of each command, as it is sampled.
        """
        return None

    def reset(self, start: Start) -> State:
        """The task's state at the start of an episode."""
        raise NotImplementedError

    def step(self, state: State, step: Step) -> TaskStep:
        """The task's part of a control step: events, reward, end and metrics.

        Args:
          state: the task's state before the step.
        """
        raise NotImplementedError

    def first_command(self, command: Values) -> Values:
        """The commands where they are sampled, at a reset and within an episode, for a task in
        which a sample is not what the policy has to follow, such as the middle of a path.

        Args:
          command: value [] of each command, as it is sampled.
        """
        return command

    def next_command(self, state: State, command: Values) -> Values:
        """The commands from now on, for a task whose commands move within an episode; it follows
        `first_command` too.

        Args:
          state: the task's state after the step or the reset.
          command: value [] of each command until now.
        """
        return command

    def first_quantities(self, measured: Values) -> tuple[State, Values]:
        """What the task remembers of the measurements at a reset, and the first value [size] of
        each quantity of the observation that is the task's own.

        Args:
          measured: value [size] of each quantity of the world and of each command.
        """
        return (), {}

    def next_quantities(
        self, memory: State, histories: Values, measured: Values
    ) -> tuple[State, Values]:
        """What the task remembers after the measurements of a control step, and the histories of
        its own quantities.

        Args:
          memory: what it remembered before.
          histories: [H, size] of its own quantities that the policy sees, the newest first.
          measured: value [size] of each quantity of the world and of each command.
        """
        return memory, histories

    def tally(self, moment: Moment) -> Tally:
        """What a control step adds to the figures of its episode."""
        return Tally({})

    def results(self, episodes: Episodes) -> tuple[Result, ...]:
        """The expected results, from the figures of E episodes."""
        raise NotImplementedError

    def details(self, episodes: Episodes) -> dict[str, Figure]:
        """Further figures by name; a unit is the end of the name, such as `mean_error_m`."""
        return {}

    def plots(self, recording: Recording) -> tuple[Histogram | Hits, ...]:
        """What a report draws of the first episodes of an evaluation, as NumPy arrays."""
        return ()

    def markers(
        self, command: dict[str, float], metrics: Mapping[str, float]
    ) -> tuple[Marker, ...]:
        """Shapes in the scene; the same names in the same order for all.

        Args:
          metrics: of the last step; each is 0 before the first one.
        """
        return ()

    def levels(self, command: dict[str, float]) -> dict[str, float]:
        """Heights that a plot shows in addition to those of ball and paddle, m: a `target_height`
        by default."""
        return {"target": command["target_height"]} if "target_height" in command else {}

    def readings(self, command: dict[str, float], metrics: dict[str, float]) -> dict[str, str]:
        """What a viewer writes over an environment, by name; the first stands for all where there
        is little room."""
        return {}

    def focus(self) -> tuple[float, float, float]:
        """Point at which a viewer looks, m: the paddle below the ball at a reset."""
        x, y, z = self.config.ball_init_pos
        return x, y, z - 0.4


def latest(
    history: jax.Array,
    value: jax.Array,
    is_new: jax.Array | bool = True,
    changes: jax.Array | bool = True,
) -> jax.Array:
    """A history [H, size] of one of the task's own quantities, the newest first, with its newest
    value [size].

    Args:
      is_new: whether the value is a new one [], bool, for which the older ones move on by one.
      changes: whether the newest value changes at all [], bool.
    """
    shifted = jnp.where(is_new, jnp.concatenate([history[:1], history[:-1]]), history)
    newest = jnp.where(changes, value, shifted[0])
    return jnp.concatenate([newest[None], shifted[1:]])
