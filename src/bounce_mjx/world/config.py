"""Settings of the world, which each task extends with its own."""

import dataclasses
import math
import numbers
import os
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import pydantic
from pydantic import Field

from bounce_mjx.config import settings
from bounce_mjx.config.places import where_made, where_raised
from bounce_mjx.config.settings import is_finite
from bounce_mjx.errors import UserError, reason_of, shorten
from bounce_mjx.robot.config import NEED_SITE, RobotConfig, Vector, is_packaged
from bounce_mjx.world.limits import Limits
from bounce_mjx.world.observation import ObservationConfig, ObservationLayout
from bounce_mjx.world.randomization import EACH_JOINT, TERMS, RandomizationConfig

PADDLE_HOME = (0.59356, 0.0, 0.0498)
"""Centre of the paddle of the project's own arm at a reset, m, from which the tasks' defaults
follow."""


NumBalls = Annotated[int, pydantic.BeforeValidator(settings.whole_number), Field(ge=1, le=3)]
"""Number of balls, up to `robot.model.MAX_BALLS`."""


@dataclasses.dataclass(frozen=True)
class Goal:
    """A number that the policy has to follow: sampled at a reset and after each interval
    (`randomization.goal_interval`), or set by a user.

    Raises:
      UserError: nothing can be sampled from its range, or its limits exclude a part of it.
    """

    low: float
    """Lower end of the range from which it is sampled."""
    high: float
    """Upper end of that range."""
    unit: str = ""
    """Unit; empty for a pure number."""
    least: float = -math.inf
    """Smallest value that a user may set."""
    greatest: float = math.inf
    """Greatest value that a user may set."""
    span: tuple[float, float] | None = None
    """Range that a viewer offers within the limits; by default, and at least, the range from which
    it is sampled."""
    step: float = 0.05
    """Change by a key of a viewer."""
    names: tuple[str, ...] = ()
    """Names of the values 0 to 1, 1 to 2, ..., if they are choices; a user may give a name. None is
    a number, which would be taken for a value."""
    hidden: bool = False
    """Whether the policy need not see it, because it acts through other goals."""
    setting: str = "a goal"
    """The setting that gives its range, for an error."""
    reason: str = ""
    """Why its limits are what they are, for an error, such as "as max_distance is 0.7 m"."""

    def __post_init__(self) -> None:
        place = where_made()
        is_range = is_finite(self.low) and is_finite(self.high) and self.low <= self.high
        if not is_range:
            raise UserError(
                f"a goal{place} is sampled from {_words(self.low)} to {_words(self.high)}; give "
                "two finite numbers, the lower one first"
            )
        if not self.least <= self.low <= self.high <= self.greatest:
            raise UserError(
                f"{self.setting}{place}: a goal is sampled from {self.low:.4g} to "
                f"{self.high:.4g}, but must be {self._limits}"
            )
        if self.span is not None and not self._is_span():
            raise UserError(
                f"a goal{place} is offered as {shorten(repr(self.span))}; give two finite "
                "numbers, the lower one first"
            )
        if not (is_finite(self.step) and self.step > 0.0):
            raise UserError(
                f"a goal{place} has the step {shorten(repr(self.step))}; give a number above 0"
            )
        are_names = isinstance(self.names, tuple) and all(map(_is_name, self.names))
        if not are_names:
            raise UserError(
                f"a goal{place} has the names {shorten(repr(self.names))}; give a tuple of "
                "names, of which none is a number"
            )

    def _is_span(self) -> bool:
        """Whether the span is two finite numbers, the lower one first."""
        is_pair = isinstance(self.span, tuple | list) and len(self.span) == 2
        return is_pair and all(map(is_finite, self.span)) and self.span[0] <= self.span[1]

    @property
    def offered(self) -> tuple[float, float]:
        """The range that a viewer offers: the span and the range from which it is sampled, within
        the limits."""
        ends = (self.low, self.high, *(self.span or ()))
        return max(self.least, min(ends)), min(self.greatest, max(ends))

    @property
    def _limits(self) -> str:
        """The limits of a user's value, in words, with their reason."""
        ends = (">=", self.least), ("<=", self.greatest)
        limits = " and ".join(f"{sign} {end:.4g}" for sign, end in ends if math.isfinite(end))
        unit = f" ({self.unit})" if self.unit else ""
        return f"{limits}{unit}" + (f", {self.reason}" if self.reason else "")

    def checked(self, value: Any, label: str) -> float:
        """A user's value as a number.

        Args:
          label: what has the value, for the error.

        Raises:
          UserError: it is not a number within the limits.
        """
        if isinstance(value, str) and value in self.names:
            return float(self.names.index(value))
        try:
            number = math.nan if isinstance(value, bool) else float(value)
        except (TypeError, ValueError):
            number = math.nan
        if math.isfinite(number) and self.least <= number <= self.greatest:
            return number
        wanted = " or ".join([*self.names, f"a finite number {self._limits}".rstrip()])
        raise UserError(f"{label} is {shorten(repr(value))}, but must be {wanted}")


def _is_name(value: Any) -> bool:
    """Whether a value is a word, and not a number in letters."""
    if not isinstance(value, str):
        return False
    try:
        float(value)
    except ValueError:
        return True
    return False


def _words(value: Any) -> str:
    """A number, or what stands in its place, for an error."""
    is_number = isinstance(value, numbers.Real) and not isinstance(value, bool)
    return f"{value:g}" if is_number else shorten(repr(value))


class ActionConfig(settings.StrictModel):
    """What an action adds to."""

    base: Literal["measured", "target"] = "measured"
    """measured: the measured joint angle. target: the last target, before latency and lag, with
    which a joint reaches its full speed despite these."""
    max_lead: Annotated[settings.Positive, Field(le=3.0)] = 0.15
    """Largest distance of the last target from the measured angle, rad; for the base target."""


class ResetConfig(settings.StrictModel):
    """The noise of a reset, to which the terms `joint_start` and `ball_start` of the randomisation
    add."""

    joint_angles: Annotated[settings.NonNegative, Field(le=3.0)] = 0.1
    """Half-width of the uniform noise of the joint angles, rad."""
    joint_velocities: Annotated[settings.NonNegative, Field(le=10.0)] = 0.01
    """Half-width of the uniform noise of the joint velocities, rad/s."""
    ball_position: Annotated[settings.NonNegative, Field(le=1.0)] = 0.01
    """Half-width of the uniform noise of each ball coordinate, m."""


class WorldSettings(settings.StrictModel):
    """The settings that a named world may have (`world.named`): those of a robot, its sensors and
    its ball."""

    robot: RobotConfig = RobotConfig()
    """Adoption of an arm."""
    physics_dt: Annotated[settings.Positive, Field(ge=1e-5, le=0.1)] = 0.001
    """Physics time step, s; at most an eighth of a period of the contact, an eighth that is 2.5 ms
    for the project's own robot."""
    control_dt: Annotated[settings.Positive, Field(ge=1e-5, le=0.1)] = 0.01
    """Time between two actions, s; a whole number of physics steps."""
    friction: settings.Friction | None = None
    """Coefficient of sliding friction between ball and paddle; null for the MJCF's, which is 0 for
    the project's own robot. `randomization.contact_friction` replaces it."""
    ball_inertia: settings.BallInertia | None = None
    """Moment of inertia of the ball per mass and squared radius: 0.4 of a solid ball, 0.667 of a
    hollow one, as table-tennis balls are; null for the MJCF's, which is 0.4 for the project's own
    robot. It acts where the ball has friction. `randomization.ball_inertia` replaces it."""
    action_scale: Annotated[settings.Positive, Field(le=0.5)] = 0.02
    """Change of the servo target for an action of 1, rad."""
    max_joint_velocity: Annotated[settings.Positive, Field(le=50.0)] = 2.0 * math.pi
    """The episode ends when a joint is faster than this, rad/s."""
    randomization: RandomizationConfig = RandomizationConfig()
    """The world that each episode samples."""


class WorldConfig(WorldSettings):
    """The settings of an environment, of which a world is a part: robot, ball, time steps, resets,
    sensors and randomisation. The config of a task extends it."""

    task: ClassVar[Any] = None
    """The class of the task that these settings are of (`task.Task`)."""

    physics: Literal["auto", "fused", "mjx"] = "auto"
    """Physics engine: fused (fast, for one kind of model), mjx (any MJCF), auto (fused if it
    supports the model)."""
    mjcf: Path | None = None
    """MJCF file to simulate; null for the project's own robot. package:NAME/FILE is a file of an
    installed Python package, and menagerie:NAME a model of MuJoCo Menagerie."""
    episode_seconds: settings.Duration = 20.0
    """Length of an episode before it is truncated, s."""
    action: ActionConfig = ActionConfig()
    """What an action adds to."""
    default_joint_angles: Annotated[tuple[settings.Finite, ...], Field(min_length=1)] = tuple(
        math.radians(a) for a in (0, 40, 110, 0, -60, 0)
    )
    """Position of each acting joint at a reset, before noise, rad."""
    num_balls: NumBalls = 1
    """Number of balls; those that the MJCF lacks are copies of its first one."""
    ball_init_pos: Vector = (
        0.58856,
        0.0,
        0.45,
    )
    """Ball position at a reset, before noise, m; each further ball starts 0.1 m above the last."""
    reset: ResetConfig = ResetConfig()
    """The noise of a reset."""
    observation: ObservationConfig = ObservationConfig()
    """The quantities that the policy sees."""

    @pydantic.model_validator(mode="after")
    def _check_time_steps(self):
        """A control step is a whole number of physics steps."""
        substeps = self.control_dt / self.physics_dt
        if round(substeps) < 1 or not math.isclose(substeps, round(substeps), rel_tol=1e-6):
            raise ValueError(
                f"control_dt {self.control_dt} is not a whole number of physics steps of "
                f"{self.physics_dt} s; choose a multiple of physics_dt"
            )
        return self

    @pydantic.model_validator(mode="after")
    def _check_contact_duration(self):
        """A contact is not shorter than its physics steps can simulate."""
        durations = self.randomization.contact_duration
        least = 4.0 * self.physics_dt
        if durations is not None and min(durations) < least * (1.0 - 1e-6):
            raise ValueError(
                f"randomization.contact_duration begins at {min(durations):g} s, but a contact "
                f"needs four physics steps, which are {least:g} s with physics_dt "
                f"{self.physics_dt:g}; give at least that, or a shorter physics_dt"
            )
        return self

    @pydantic.model_validator(mode="after")
    def _check_max_lead(self):
        """An action of 1 has its full effect."""
        if self.action.base == "target" and self.action.max_lead < self.action_scale:
            raise ValueError(
                f"action.max_lead is {self.action.max_lead:g}, which is less than the action_scale "
                f"{self.action_scale:g}, so that no action would have its full effect; give more"
            )
        return self

    @pydantic.model_validator(mode="after")
    def _check_num_joints(self):
        """What has a number for each acting joint has as many as there are."""
        counts = {}
        for name, of_joints in self.robot.limits:
            if of_joints is not None:
                counts[f"robot.limits.{name}"] = len(of_joints)
        for name in self.randomization.terms:
            low, _ = getattr(self.randomization, name)
            if TERMS[name].size is EACH_JOINT and isinstance(low, tuple):
                counts[f"randomization.{name}"] = len(low)
        for key, count in counts.items():
            if count != self.num_joints:
                raise ValueError(
                    f"{key} has {count} numbers, but default_joint_angles has {self.num_joints}; "
                    "give one for each acting joint"
                )
        return self

    @pydantic.model_validator(mode="after")
    def _check_limits(self):
        """The arm's limits fit the action and the control step."""
        limits = self.robot.limits
        if limits.velocity is not None and self.action.base == "measured":
            # A setpoint that follows the measured angle, which follows the setpoint, oscillates.
            raise ValueError(
                "robot.limits are of commands that move, to which an action adds, but action.base "
                "is measured; set action.base to target"
            )
        for acceleration, jerk in zip(limits.acceleration or (), limits.jerk or (), strict=False):
            if 2.0 * acceleration / jerk > self.control_dt:
                raise ValueError(
                    f"robot.limits.jerk {jerk:g} is too low: the acceleration cannot turn from "
                    f"{acceleration:g} to the opposite within control_dt {self.control_dt:g}; "
                    f"give at least {2.0 * acceleration / self.control_dt:g}"
                )
        return self

    @pydantic.model_validator(mode="after")
    def _check_effects(self):
        """A setting that has no effect is a mistake. Only a value other than the default is one, as
        the config of a run names all settings."""
        unused = {}
        if not self.robot.site:
            unused |= {f"robot.{name}": ("robot.site", "leave it out") for name in NEED_SITE}
        if self.action.base == "measured":
            unused["action.max_lead"] = ("the action.base target", "leave it out")
            # It may be the task's.
            unused["observation.servo_lead"] = ("the action.base target", "set it to 0")
        for key, (needed, remedy) in unused.items():
            group_name, name = key.split(".")
            group = getattr(self, group_name)
            if getattr(group, name) != settings.default_of(type(group).model_fields[name]):
                raise ValueError(f"{key} has no effect without {needed}; set that too, or {remedy}")
        return self

    @pydantic.model_validator(mode="after")
    def _check_goals(self):
        """The goals are within their limits, and there are some where they are sampled again."""
        try:
            goals = self.goals
        except UserError as error:
            raise ValueError(str(error)) from error
        except Exception as error:
            place = where_raised(error)
            text = f"{type(error).__name__}: {shorten(reason_of(error), 300)}"
            raise ValueError(f"the goals{place} end in {text}; correct them") from error
        if self.task is None or goals:
            return self
        for name, value in (
            ("goal_interval", self.randomization.goal_interval is not None),
            ("first_goal_range", self.randomization.first_goal_range < 1.0),
        ):
            if value:
                raise ValueError(
                    f"randomization.{name} is given, but the task {self.task.__name__} has no "
                    "goals; leave it out"
                )
        return self

    @pydantic.field_validator("mjcf")
    @classmethod
    def _make_absolute(cls, path: Path | None) -> Path | None:
        """A run's config is read from other folders too, and by people: without .. in it."""
        if path is None or is_packaged(path):
            return path
        return Path(os.path.abspath(os.path.expanduser(path)))

    @classmethod
    def settings_at(cls, paddle: tuple[float, float, float]) -> dict[str, Any]:
        """The settings that depend on where an arm holds the paddle at a reset. A task adds its
        own.

        Another arm's ball starts 0.4 m over the paddle's centre, displaced as the task's start is
        from the world's: the 5 mm of the world's own start beside its paddle are left out.

        Args:
          paddle: centre of the level paddle at `default_joint_angles`, m.
        """
        world_start = settings.default_of(WorldConfig.model_fields["ball_init_pos"])
        task_start = settings.default_of(cls.model_fields["ball_init_pos"])
        over_paddle = (0.0, 0.0, 0.4)
        position = []
        for i in range(3):
            coordinate = task_start[i] - world_start[i] + paddle[i] + over_paddle[i]
            # Without a negative zero.
            position.append(round(coordinate, 4) + 0.0)
        return {"ball_init_pos": position}

    @property
    def num_joints(self) -> int:
        """Number of acting joints, which is the number of actions."""
        return len(self.default_joint_angles)

    @property
    def layout(self) -> ObservationLayout:
        """The order of the entries of the observation."""
        return self.observation.layout(self.num_joints, self.num_balls)

    def in_world(self, randomization: RandomizationConfig) -> Self:
        """The same task, observation and actions in another world. How often the task samples its
        goals is no part of a world: without an interval of its own, the world has that of the
        task's default."""
        default = settings.default_of(type(self).model_fields["randomization"])
        if randomization.goal_interval is None:
            kept = {"goal_interval": default.goal_interval}
            randomization = randomization.model_copy(update=kept)
        return self.model_copy(update={"randomization": randomization})

    @property
    def goals(self) -> dict[str, Goal]:
        """The goals of the policy, by name; a task's config has its own."""
        return {}

    @property
    def limits(self) -> Limits:
        """What ends an episode by where a ball is; a task has its own."""
        return ()

    @property
    def targets(self) -> tuple[tuple[float, float, float], ...]:
        """Points to which the `limits` are relative at a reset, m; a task whose ball starts at rest
        has those of its goals' ranges."""
        return ()

    @property
    def unseen_noise(self) -> tuple[str, ...]:
        """Terms of the randomisation that change measurements which the policy does not see."""
        observation = self.observation
        if observation.counts("task"):
            # A task may compute its quantities from any measurement.
            return ()
        has_sensor = observation.velocity == "measured"
        is_seen = {
            "joint_velocity_": observation.joint_velocities,
            "ball_velocity_": observation.ball_velocity and has_sensor,
            "ball_position_": observation.ball_position
            or (observation.ball_velocity and not has_sensor),
        }
        unseen = tuple(prefix for prefix, seen in is_seen.items() if not seen)
        return tuple(name for name in self.randomization.terms if name.startswith(unseen))

    @property
    def heights(self) -> dict[str, float]:
        """The world heights that must be above the paddle's at a reset, by their settings, m; a
        task has its own."""
        return {"ball_init_pos": self.ball_init_pos[2]}

    @property
    def ball_bounds(self) -> tuple[float, float]:
        """Largest distance of the ball from the robot's base (m), and its largest measured speed
        (m/s), that an exported policy takes for possible; no episode of a training ends there."""
        return 3.0, 20.0

    @property
    def num_substeps(self) -> int:
        """Physics steps in one control step."""
        return round(self.control_dt / self.physics_dt)

    @property
    def episode_steps(self) -> int:
        """Control steps in one episode, at least one."""
        return max(1, round(self.episode_seconds / self.control_dt))
