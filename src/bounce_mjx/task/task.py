"""The interface between an environment's world and its task."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

from bounce_mjx.config.places import where_made
from bounce_mjx.config.settings import is_finite
from bounce_mjx.errors import RENAMED, UserError, shorten
from bounce_mjx.lazy import jax, jnp, np
from bounce_mjx.task.results import Episodes, Figure, Result
from bounce_mjx.world.config import WorldConfig
from bounce_mjx.world.observation import Kinematics

if TYPE_CHECKING:
    from bounce_mjx.robot.model import Geometry

TaskState = Any
"""A pytree that a task keeps of an episode."""

Values = dict[str, "jax.Array"]
"""Numbers by name."""


class Start(NamedTuple):
    """The start of an episode, as a task sees it."""

    truth: Kinematics
    """Positions and velocities after the reset."""
    goal: Values
    """Value [] of each goal."""
    draws: jax.Array
    """Uniform random numbers between 0 and 1 [num_draws]."""


class Step(NamedTuple):
    """A control step, as a task sees it: what is true, whatever the sensors measure."""

    truth: Kinematics
    """Positions and velocities after the step."""
    goal: Values
    """Value [] of each goal during the step, which the policy saw as it chose the action."""
    action: jax.Array
    """Clipped action [n]."""
    last_action: jax.Array
    """Clipped action of the previous step [n]."""
    ball_radius: jax.Array | float | None = None
    """Radius [] of the first ball in this episode, m, to which the others stay in proportion; None
    for that of the task's `geometry`."""
    seconds: jax.Array | float = 0.0
    """Time since the reset [], s, as `Moment.seconds`. An environment counts its steps only for a
    task whose step reads it."""


class TaskStep(NamedTuple):
    """A task's part of a control step."""

    state: TaskState
    """The task's state after the step."""
    reward: Values
    """Weighted terms [] of the reward, which is their sum."""
    ended: jax.Array
    """Whether the task ends the episode [], bool."""
    metrics: Values
    """Further numbers [] of the step."""

    def plus(self, reward: Values | None = None, metrics: Values | None = None) -> TaskStep:
        """The step with more weighted terms and metrics, for a task that extends another one.

        Raises:
          UserError: a name is taken.
        """
        return self._replace(
            reward=_joined("term of the reward", self.reward, reward or {}),
            metrics=_joined("metric", self.metrics, metrics or {}),
        )


class Moment(NamedTuple):
    """A control step of an episode that is measured."""

    truth: Kinematics
    """Positions and velocities after the step."""
    goal: Values
    """Value [] of each goal after the step; the metrics are of those during the step."""
    state: TaskState
    """The task's state after the step."""
    metrics: Values
    """The environment's metrics of the step, each []."""
    seconds: jax.Array
    """Time since the reset [], s."""
    goal_seconds: jax.Array
    """Time since the goals were sampled [], s; at most `seconds`."""


class Tally(NamedTuple):
    """Numbers of a control step, each []."""

    sums: Values
    """Numbers that are summed over the steps of an episode."""
    maxima: Values = {}
    """Numbers of which the greatest over the steps of an episode counts; at least 0."""

    def plus(self, sums: Values | None = None, maxima: Values | None = None) -> Tally:
        """The tally with more numbers, for a task that extends another one.

        Raises:
          UserError: a name is taken.
        """
        return Tally(
            sums=_joined("sum", self.sums, sums or {}),
            maxima=_joined("maximum", self.maxima, maxima or {}),
        )


def _joined(kind: str, own: Values, more: Values) -> Values:
    """Two mappings as one, of which no name hides another."""
    if taken := sorted(own.keys() & more.keys()):
        raise UserError(f"the task has the {kind} {taken[0]} already; choose another name")
    return own | more


class Marker(NamedTuple):
    """A shape in the scene without contact. A site of its name in the MJCF replaces its look."""

    name: str
    position: tuple[float, float, float]
    """Centre, m."""
    size: tuple[float, float, float]
    """Half-sizes of a box or of a frame; radius and half-height of a cylinder, and 0, m."""
    rgba: tuple[float, float, float, float]
    shape: Literal["box", "frame", "cylinder"] = "box"
    """A frame is the outline of a box around its z axis."""


class Recording(NamedTuple):
    """T control steps of K episodes, in a report as NumPy arrays; entries after the end of an
    episode are undefined."""

    joint_angles: jax.Array
    """Positions of the acting joints after the step [T, n, K], rad."""
    ball: jax.Array
    """Ball positions after the step [T, 3, K], m."""
    paddle: jax.Array
    """Positions of the paddle's centre after the step [T, 3, K], m."""
    goal: dict[str, jax.Array]
    """Goals after the step [T, K]."""
    running: jax.Array
    """Whether the episode had not ended before the step [T, K], bool."""
    terminated: jax.Array
    """Whether the episode ended on the step, and not by its time limit [T, K], bool."""
    command_velocity: jax.Array | None = None
    """Velocities of the joints' commands at the end of the step [T, n, K], rad/s; None if the
    commands do not move within limits."""
    qpos: jax.Array | None = None
    """Generalised positions after the step [T, nq, K], in MuJoCo's order."""
    metrics: dict[str, jax.Array] = {}
    """Metrics of the step [T, K]."""


@dataclasses.dataclass(frozen=True)
class Curve:
    """A number that the training logs: how a metric adds up over a rollout.

    Raises:
      UserError: it has no tag or metric, or its scale is no number.
    """

    tag: str
    """Name in the log."""
    metric: str
    """Metric of the environment's step."""
    over: str = "steps"
    """steps for the mean over steps, episodes for the mean of the last values of episodes, or the
    metric that counts the events over which it is the mean; the metric is then 0 on all other
    steps."""
    title: str = ""
    """Title in the report; "" leaves it out there."""
    scale: float = 1.0
    """Factor from the metric's unit to `unit`. The log has the metric's own."""
    unit: str = ""
    """Unit in the report and on the console, such as cm; "" for a number without one."""

    @property
    def heading(self) -> str:
        """The title with the unit, as a report has it over the curve."""
        return f"{self.title}, {self.unit}" if self.unit else self.title

    def __post_init__(self) -> None:
        for name in ("tag", "metric", "over"):
            value = getattr(self, name)
            # A report has curves of no metric.
            is_name = isinstance(value, str) and (value or name == "metric")
            if not is_name:
                raise UserError(
                    f"the {name} of a task.Curve{where_made()} is {shorten(repr(value))}; give a "
                    "name"
                )
        for name in ("title", "unit"):
            value = getattr(self, name)
            if not isinstance(value, str):
                raise UserError(
                    f"the {name} of the curve {self.tag}{where_made()} is {shorten(repr(value))}; "
                    "give words"
                )
        if not is_finite(self.scale):
            raise UserError(
                f"the scale of the curve {self.tag}{where_made()} is {shorten(repr(self.scale))}; "
                "give a finite number"
            )


class Histogram(NamedTuple):
    """A histogram of errors, with lines at a bound on each side of 0."""

    title: str
    """With the unit of the values."""
    counted: str
    """What is counted, such as bounces."""
    values: np.ndarray
    """[N]."""
    bound: float


class Hits(NamedTuple):
    """Positions of the ball over the paddle at some steps, in the paddle's own frame."""

    title: str
    steps: np.ndarray
    """Whether a step of a recording is drawn [T, K], bool."""


class Task:
    """A task: what the arm and the ball are to do. A subclass holds all that belongs to it.

    The methods compute one environment, without a batch axis, and are pure: `jax.vmap` and
    `jax.jit` apply to them.
    """

    Config: ClassVar[type[WorldConfig]]
    """The settings of an environment with this task: those of the world, and the task's own. It
    overrides `goals`, `heights`, `ball_bounds` and `settings_at` of the world where the task
    needs others; a field of its `observation` with a `Quantity` is a quantity of the task."""
    folder: ClassVar[str] = ""
    """Name of the folder of its runs in runs/; by default, the class's name in lower case."""
    curves: ClassVar[tuple[Curve, ...]] = ()
    """What a training logs and prints, and a report draws, of the metrics. A metric that no curve
    shows or is over is logged as its mean over the steps."""
    num_balls: ClassVar[tuple[int, ...]] = (1,)
    """Numbers of balls (`WorldConfig.num_balls`) that it takes."""
    ball_rests: ClassVar[bool] = True
    """Whether the ball may rest on the paddle; if not, a robot's supervisor stops at one that stays
    near it."""
    ball_thrown: ClassVar[bool] = True
    """Whether the ball may start elsewhere than over the paddle."""
    ball_dropped: ClassVar[bool] = True
    """Whether the ball starts in the air, where a person lets go of it; of a ball that lies on the
    paddle, a named world's `ball_start` says nothing."""
    num_draws: ClassVar[int] = 0
    """Random numbers that a reset samples for the task."""
    critic_metrics: ClassVar[tuple[str, ...]] = ()
    """Metrics that the value network sees by default, because the reward depends on them and the
    observation does not contain them."""

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        if "Config" not in cls.__dict__:
            inherited = getattr(cls, "Config", None)
            base = "task.WorldConfig" if inherited is None else inherited.__qualname__
            raise UserError(
                f"the task {cls.__name__} has no Config of its own, and settings belong to one "
                f"task; write Config, a class that extends {base}"
            )
        if not (isinstance(cls.Config, type) and issubclass(cls.Config, WorldConfig)):
            raise UserError(
                f"the Config of the task {cls.__name__} is {shorten(repr(cls.Config))}; give a "
                "class that extends task.WorldConfig"
            )
        for kind in (cls, cls.Config):
            overridden = [name for name in RENAMED if hasattr(kind, RENAMED[name])]
            for name in vars(kind).keys() & set(overridden):
                raise UserError(
                    f"the task {cls.__name__} has {name}, which is {RENAMED[name]} today and would "
                    "not be called; rename it"
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
        """Sizes and places of ball and paddle in the model. An environment sets those of its own
        model (`env.task.geometry = ...`); a task without one compiles the config's model here."""
        # Imported here, as a process that reads the settings alone needs no JAX.
        from bounce_mjx.robot.model import find_addresses, read_geometry
        from bounce_mjx.world.model import world_model

        model = world_model(self.config, visual=False)
        return read_geometry(model, find_addresses(model), self.config.default_joint_angles)

    def check(self) -> None:
        """Refuses settings that the task cannot have with this `geometry`; called once, before the
        first episode.

        Raises:
          UserError: it cannot.
        """

    def throw(self, draws: jax.Array, goal: Values) -> tuple[jax.Array, jax.Array] | None:
        """Position [3] (m) and velocity [3] (m/s) of the ball at a reset, before the noise and the
        terms of the randomisation, of each ball [B, 3] if there are several; None for balls at rest
        at `ball_init_pos` and above it.

        Args:
          draws: uniform random numbers between 0 and 1 [num_draws].
          goal: value [] of each goal, as it is sampled.
        """
        return None

    def reset(self, start: Start) -> TaskState:
        """The task's state at the start of an episode."""
        raise self._lacking("reset", "returns its state at the start of an episode")

    def step(self, state: TaskState, step: Step) -> TaskStep:
        """The task's part of a control step: events, reward, end and metrics. The new state has
        the structure, shapes and types of that of `reset`.

        Args:
          state: the task's state before the step.
        """
        raise self._lacking("step", "returns a task.TaskStep")

    def first_goal(self, goal: Values) -> Values:
        """The goals from a new sample, at a reset or within an episode, for a task in which a
        sample is not what the policy has to follow, such as the middle of a path.

        Args:
          goal: value [] of each goal, as it is sampled.
        """
        return goal

    def next_goal(self, state: TaskState, goal: Values) -> Values:
        """The goals of the coming step, for a task whose goals move within an episode: those
        at its end, at which it is judged. It is called at a reset and after every step; at a reset
        and at a redraw, on the result of `first_goal`.

        Args:
          state: the task's state after the step or the reset.
          goal: value [] of each goal until now.
        """
        return goal

    def first_quantities(self, measured: Values) -> tuple[TaskState, Values]:
        """What the task remembers of the measurements at a reset, and the first value [size] of
        each quantity of the observation that is the task's own.

        Args:
          measured: value [size] of each quantity of the world and of each goal; of several
            balls [B, size].
        """
        return (), {}

    def next_quantities(
        self, memory: TaskState, histories: Values, measured: Values
    ) -> tuple[TaskState, Values]:
        """What the task remembers after the measurements of a control step, and the histories of
        its own quantities.

        Args:
          memory: what it remembered before.
          histories: [H, size] of its own quantities that the policy sees, the newest first.
          measured: as in `first_quantities`.
        """
        return memory, histories

    def tally(self, moment: Moment) -> Tally:
        """What a control step adds to the figures of its episode."""
        return Tally({})

    def results(self, episodes: Episodes) -> tuple[Result, ...]:
        """The expected results, from the figures of E episodes."""
        raise self._lacking("results", "returns a tuple of task.Result")

    def details(self, episodes: Episodes) -> dict[str, Figure]:
        """Further figures by name; a unit is the end of the name, such as `mean_error_m`."""
        return {}

    def plots(self, recording: Recording) -> tuple[Histogram | Hits, ...]:
        """What a report draws of the first episodes of an evaluation, as NumPy arrays."""
        return ()

    def markers(self, goal: dict[str, float], metrics: Mapping[str, float]) -> tuple[Marker, ...]:
        """Shapes in the scene; the same names in the same order for all.

        Args:
          metrics: of the last step; each is 0 before the first one.
        """
        return ()

    def levels(self, goal: dict[str, float]) -> dict[str, float]:
        """Heights that a plot shows in addition to those of ball and paddle, m: a `target_height`
        by default."""
        return {"target": goal["target_height"]} if "target_height" in goal else {}

    def readings(self, goal: dict[str, float], metrics: dict[str, float]) -> dict[str, str]:
        """What a viewer writes over an environment, by name; the first stands for all where there
        is little room."""
        return {}

    def focus(self) -> tuple[float, float, float]:
        """Point at which a viewer looks, m: the paddle below the ball at a reset."""
        x, y, z = self.config.ball_init_pos
        return x, y, z - 0.4

    def _lacking(self, method: str, purpose: str) -> UserError:
        """The error of a task without a method that it needs."""
        return UserError(
            f"the task {type(self).__name__} has no method {method}; write one, which {purpose}"
        )


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
